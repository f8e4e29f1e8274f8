//! The same volume by brute force, in f64 and straight from the raw tiles. Slow and obvious; shares
//! nothing with what it judges but the words of the catalog.

use std::collections::BTreeMap;

/// A raw tile: pixels, and `[a, b, c, d, tx, ty]` from pixels to voxels.
#[derive(Clone)]
pub(super) struct RawTile {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) pixels: Vec<u8>,
    pub(super) transform: [f64; 6],
    pub(super) section: u32,
    /// Larger for what changed later.
    pub(super) age: u64,
}

impl RawTile {
    /// Pixels that are not all zero in each 128 x 128 piece of level `k`, and the level's means.
    fn level(&self, k: usize) -> Level {
        let f = 1 << k;
        let (w, h) = (self.width.div_ceil(f), self.height.div_ceil(f));
        let mut means = vec![0.0; w * h];
        for y in 0..h {
            for x in 0..w {
                let (mut sum, mut count) = (0.0, 0.0);
                for py in y * f..((y + 1) * f).min(self.height) {
                    for px in x * f..((x + 1) * f).min(self.width) {
                        sum += f64::from(self.pixels[py * self.width + px]);
                        count += 1.0;
                    }
                }
                means[y * w + x] = sum / count;
            }
        }
        Level {
            w,
            h,
            f: f as f64,
            means,
        }
    }

    /// The coarsest level: the first that fits into one 128 x 128 piece.
    fn coarsest(&self) -> usize {
        let mut k = 0;
        while self.width.max(self.height).div_ceil(1 << k) > 128 {
            k += 1;
        }
        k
    }

    /// Tile pixels per voxel along an axis.
    fn pixels_per_voxel(&self) -> f64 {
        let [a, b, c, d, ..] = self.transform;
        1.0 / (a * d - b * c).abs().sqrt()
    }

    fn pixel(&self, x: f64, y: f64) -> (f64, f64) {
        let [a, b, c, d, tx, ty] = self.transform;
        let det = a * d - b * c;
        let (x, y) = (x - tx, y - ty);
        ((d * x - c * y) / det, (a * y - b * x) / det)
    }

    fn distance(&self, x: f64, y: f64) -> f64 {
        let [a, b, c, d, tx, ty] = self.transform;
        let (w, h) = (self.width as f64 / 2.0, self.height as f64 / 2.0);
        let (cx, cy) = (a * w + c * h + tx, b * w + d * h + ty);
        (x - cx).powi(2) + (y - cy).powi(2)
    }
}

struct Level {
    w: usize,
    h: usize,
    f: f64,
    means: Vec<f64>,
}

impl Level {
    fn is_blank(&self, u: f64, v: f64) -> bool {
        let (x, y) = (
            u.floor() as usize / 128 * 128,
            v.floor() as usize / 128 * 128,
        );
        let rows = y..(y + 128).min(self.h);
        let mut all = rows.flat_map(|y| (x..(x + 128).min(self.w)).map(move |x| (x, y)));
        all.all(|(x, y)| self.means[y * self.w + x] < 0.5)
    }

    fn sample(&self, u: f64, v: f64) -> f64 {
        let (u, v) = (u - 0.5, v - 0.5);
        let at = |x: f64, y: f64| {
            let x = x.clamp(0.0, self.w as f64 - 1.0) as usize;
            let y = y.clamp(0.0, self.h as f64 - 1.0) as usize;
            self.means[y * self.w + x]
        };
        let (x, y) = (u.floor(), v.floor());
        let (s, t) = (u - x, v - y);
        let top = at(x, y) * (1.0 - s) + at(x + 1.0, y) * s;
        let bottom = at(x, y + 1.0) * (1.0 - s) + at(x + 1.0, y + 1.0) * s;
        top * (1.0 - t) + bottom * t
    }
}

/// All voxels of a level of `extent`, each the size of `down` level-0 voxels, x fastest.
///
/// Tiles are given with their ids, and are all of one size.
pub(super) fn stitch(tiles: &BTreeMap<i64, RawTile>, extent: [u32; 3], down: [f64; 3]) -> Vec<u8> {
    let wanted = |t: &RawTile| {
        (t.pixels_per_voxel() * (down[0] * down[1]).sqrt())
            .log2()
            .round()
    };
    // Voxels larger than pixels of the coarsest level are means of several samples.
    let finer = tiles.values().map(|t| wanted(t) - t.coarsest() as f64);
    let finer = finer.fold(0.0, f64::max).min(4.0);
    let by = 2_f64.powf(finer);
    let level_of = |t: &RawTile| (wanted(t) - finer).clamp(0.0, t.coarsest() as f64) as usize;
    let levels: BTreeMap<_, _> = tiles
        .iter()
        .map(|(id, t)| (*id, t.level(level_of(t))))
        .collect();
    let (step_x, step_y) = (down[0] / by, down[1] / by);

    let of_section = |section| tiles.iter().filter(move |(_, t)| t.section == section);
    let sample = |near: &[(&i64, &RawTile)], x: f64, y: f64| {
        let mut best: Option<(f64, u64, i64, f64)> = None;
        for (id, tile) in near {
            let (u, v) = tile.pixel(x, y);
            let inside = u >= 0.0 && v >= 0.0 && u < tile.width as f64 && v < tile.height as f64;
            let level = &levels[*id];
            let (u, v) = (u / level.f, v / level.f);
            if !inside || level.is_blank(u, v) {
                continue;
            }
            let key = (tile.distance(x, y), u64::MAX - tile.age, **id);
            if best.is_none_or(|b| key < (b.0, b.1, b.2)) {
                best = Some((key.0, key.1, **id, level.sample(u, v)));
            }
        }
        best.map(|b| b.3.max(1.0))
    };

    let mut voxels = Vec::new();
    for z in 0..extent[2] {
        let (low, high) = (f64::from(z) * down[2], f64::from(z + 1) * down[2]);
        let middle = (low + high) / 2.0;
        let mut sections: Vec<u32> = tiles.values().map(|t| t.section).collect();
        sections.sort_unstable();
        sections.dedup();
        sections.retain(|s| f64::from(*s) + 0.5 >= low && f64::from(*s) + 0.5 < high);
        let off = |s: &u32| (f64::from(*s) + 0.5 - middle).abs();
        sections.sort_by(|a, b| off(a).partial_cmp(&off(b)).unwrap().then(a.cmp(b)));
        // The nearest four are looked at, then the 8th, 16th, ...
        let sections: Vec<u32> = (1_u32..)
            .zip(sections)
            .filter(|(n, _)| *n <= 4 || n.count_ones() == 1)
            .map(|(_, s)| s)
            .collect();
        let sections: Vec<Vec<_>> = sections.iter().map(|s| of_section(*s).collect()).collect();
        for y in 0..extent[1] {
            for x in 0..extent[0] {
                let (mut sum, mut count) = (0.0, 0.0);
                for j in 0..by as u32 {
                    for i in 0..by as u32 {
                        let px = (f64::from(x) * by + f64::from(i) + 0.5) * step_x;
                        let py = (f64::from(y) * by + f64::from(j) + 0.5) * step_y;
                        let seen = sections.iter().find_map(|near| sample(near, px, py));
                        sum += seen.unwrap_or(0.0);
                        count += if seen.is_some() { 1.0 } else { 0.0 };
                    }
                }
                let value: f64 = if count > 0.0 { sum / count } else { 0.0 };
                voxels.push(value.round() as u8);
            }
        }
    }
    voxels
}
