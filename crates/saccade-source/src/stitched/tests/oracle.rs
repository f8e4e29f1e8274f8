//! The same volume by brute force, in f64 and straight from the raw tiles. Slow and obvious; shares
//! nothing with what it judges but the words of the catalog.

use std::collections::BTreeMap;

/// A raw tile: pixels, and `[a, b, c, d, tx, ty]` from pixels to voxels.
#[derive(Clone)]
pub(super) struct RawTile {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) pixels: Vec<u16>,
    pub(super) transform: [f64; 6],
    pub(super) section: u32,
    pub(super) channel: u32,
    /// Larger for an image that was recorded later.
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

    fn sample(&self, between: Between, u: f64, v: f64) -> f64 {
        let (u, v) = (u - 0.5, v - 0.5);
        let at = |x: f64, y: f64| {
            let x = x.clamp(0.0, self.w as f64 - 1.0) as usize;
            let y = y.clamp(0.0, self.h as f64 - 1.0) as usize;
            self.means[y * self.w + x]
        };
        let (x, y) = (u.floor(), v.floor());
        let mut sum = 0.0;
        for j in -2..4 {
            for i in -2..4 {
                let (px, py) = (x + f64::from(i), y + f64::from(j));
                let weight = between.weight(u - px) * between.weight(v - py);
                if weight != 0.0 {
                    sum += weight * at(px, py);
                }
            }
        }
        sum
    }
}

/// What lies between pixels.
#[derive(Clone, Copy, Debug)]
pub(super) enum Between {
    Box,
    Tent,
    /// Keys' kernel of a = -1/2.
    Keys,
}

impl Between {
    /// Of a pixel that lies `t` to the left.
    fn weight(self, t: f64) -> f64 {
        let d = t.abs();
        match self {
            Self::Box => f64::from((-0.5..0.5).contains(&t)),
            Self::Tent => (1.0 - d).max(0.0),
            Self::Keys if d <= 1.0 => 1.5 * d.powi(3) - 2.5 * d.powi(2) + 1.0,
            Self::Keys if d < 2.0 => -0.5 * d.powi(3) + 2.5 * d.powi(2) - 4.0 * d + 2.0,
            Self::Keys => 0.0,
        }
    }
}

/// How to stitch.
#[derive(Clone, Copy, Debug)]
pub(super) struct How {
    pub(super) between: Between,
    pub(super) blend: bool,
    pub(super) along_z: bool,
    /// Gaps of at most so many sections are filled, from both sides or the nearer one.
    pub(super) gaps: u32,
    pub(super) gaps_mix: bool,
    pub(super) channel: u32,
    /// The largest value there is.
    pub(super) most: u16,
}

impl How {
    pub(super) const PLAIN: Self = Self {
        between: Between::Tent,
        blend: false,
        along_z: false,
        gaps: 0,
        gaps_mix: false,
        channel: 0,
        most: 255,
    };
}

/// All voxels of a level of `extent`, each the size of `down` level-0 voxels, x fastest.
///
/// Tiles are given with their ids.
pub(super) fn stitch(
    tiles: &BTreeMap<i64, RawTile>,
    extent: [u32; 3],
    down: [f64; 3],
    how: How,
) -> Vec<u16> {
    let tiles: BTreeMap<_, _> = tiles
        .iter()
        .filter(|(_, t)| t.channel == how.channel)
        .collect();
    let mut with_tiles: Vec<u32> = tiles.values().map(|t| t.section).collect();
    with_tiles.sort_unstable();
    with_tiles.dedup();
    let wanted = |t: &RawTile| {
        (t.pixels_per_voxel() * (down[0] * down[1]).sqrt())
            .log2()
            .round()
    };
    // Voxels larger than pixels of the coarsest level are means of several samples.
    let finer = |t: &RawTile| (wanted(t) - t.coarsest() as f64).clamp(0.0, 4.0);
    let level_of = |t: &RawTile, by: f64| {
        let wanted = (t.pixels_per_voxel() * (down[0] * down[1]).sqrt() / by).log2();
        wanted.round().clamp(0.0, t.coarsest() as f64) as usize
    };
    let levels: BTreeMap<_, Vec<Level>> = tiles
        .iter()
        .map(|(id, t)| (**id, (0..=t.coarsest()).map(|k| t.level(k)).collect()))
        .collect();
    // Whether a tile's bounds touch a voxel.
    let touches = |t: &RawTile, x: u32, y: u32| {
        let [a, b, c, d, tx, ty] = t.transform;
        let (w, h) = (t.width as f64, t.height as f64);
        let spread = |from: f64, along: f64, across: f64, voxel: u32, down: f64| {
            let (low, high) = (
                along.min(0.0) + across.min(0.0),
                along.max(0.0) + across.max(0.0),
            );
            let (low, high) = ((from + low) / down, (from + high) / down);
            low < f64::from(voxel) + 1.0 && high > f64::from(voxel)
        };
        spread(tx, a * w, c * h, x, down[0]) && spread(ty, b * w, d * h, y, down[1])
    };

    let of_section = |section| tiles.iter().filter(move |(_, t)| t.section == section);
    let sample = |near: &[(&&i64, &&RawTile)], by: f64, x: f64, y: f64| {
        let mut there = Vec::new();
        for (id, tile) in near {
            let (u, v) = tile.pixel(x, y);
            let (w, h) = (tile.width as f64, tile.height as f64);
            let inside = u >= 0.0 && v >= 0.0 && u < w && v < h;
            let level = &levels[**id][level_of(tile, by)];
            if !inside || levels[**id][0].is_blank(u, v) {
                continue;
            }
            let size = 1.0 / tile.pixels_per_voxel();
            let to_edge = u.min(v).min(w - u).min(h - v).max(1e-3) * size;
            let key = (tile.distance(x, y), u64::MAX - tile.age, ***id);
            let value = level.sample(how.between, u / level.f, v / level.f);
            there.push((size, key, to_edge, value.clamp(1.0, f64::from(how.most))));
        }
        let finest = there.iter().map(|t| t.0).fold(f64::MAX, f64::min);
        there.retain(|t| t.0 <= 1.5 * finest);
        if how.blend {
            let weights: f64 = there.iter().map(|t| t.2).sum();
            let sum: f64 = there.iter().map(|t| t.2 * t.3).sum();
            return (!there.is_empty()).then(|| sum / weights);
        }
        let first = |a: &&(f64, (f64, u64, i64), _, _), b: &&(_, (f64, u64, i64), _, _)| {
            a.1.partial_cmp(&b.1).unwrap()
        };
        there.iter().min_by(first).map(|t| t.3)
    };

    let mut voxels = Vec::new();
    for z in 0..extent[2] {
        let (low, high) = (f64::from(z) * down[2], f64::from(z + 1) * down[2]);
        let middle = (low + high) / 2.0;
        let mut sections = with_tiles.clone();
        sections.retain(|s| f64::from(*s) + 0.5 >= low && f64::from(*s) + 0.5 < high);
        let mut fills = false;
        if sections.is_empty() {
            let before = with_tiles.iter().rfind(|s| f64::from(**s) + 0.5 < low);
            let behind = with_tiles.iter().find(|s| f64::from(**s) + 0.5 >= high);
            if let (Some(before), Some(behind)) = (before, behind)
                && behind - before <= how.gaps + 1
            {
                let (a, b) = (f64::from(*before) + 0.5, f64::from(*behind) + 0.5);
                sections = match how.gaps_mix {
                    true => vec![*before, *behind],
                    false if middle - a <= b - middle => vec![*before],
                    false => vec![*behind],
                };
                fills = how.gaps_mix;
            }
        }
        let off = |s: &u32| (f64::from(*s) + 0.5 - middle).abs();
        sections.sort_by(|a, b| off(a).partial_cmp(&off(b)).unwrap().then(a.cmp(b)));
        // The nearest four are looked at, then the 8th, 16th, ...
        let sections: Vec<u32> = (1_u32..)
            .zip(sections)
            .filter(|(n, _)| *n <= 4 || n.count_ones() == 1)
            .map(|(_, s)| s)
            .collect();
        let is_below = |s: &u32| f64::from(*s) + 0.5 <= middle;
        let below: Vec<u32> = sections.iter().copied().filter(is_below).collect();
        let above: Vec<u32> = sections.iter().copied().filter(|s| !is_below(s)).collect();
        let near = |sections: &[u32]| -> Vec<Vec<_>> {
            sections.iter().map(|s| of_section(*s).collect()).collect()
        };
        let voxel = |sections: &[Vec<(&&i64, &&RawTile)>], x: u32, y: u32| -> f64 {
            // As finely as a tile needs that is there in the first section that has any.
            let there = |near: &Vec<(&&i64, &&RawTile)>| {
                let there = near.iter().filter(|(_, t)| touches(t, x, y));
                there.map(|(_, t)| finer(t)).reduce(f64::max)
            };
            let by = 2_f64.powf(sections.iter().find_map(there).unwrap_or(0.0));
            let (step_x, step_y) = (down[0] / by, down[1] / by);
            let (mut sum, mut count) = (0.0, 0.0);
            for j in 0..by as u32 {
                for i in 0..by as u32 {
                    let px = (f64::from(x) * by + f64::from(i) + 0.5) * step_x;
                    let py = (f64::from(y) * by + f64::from(j) + 0.5) * step_y;
                    let seen = sections.iter().find_map(|near| sample(near, by, px, py));
                    sum += seen.unwrap_or(0.0);
                    count += if seen.is_some() { 1.0 } else { 0.0 };
                }
            }
            if count > 0.0 { sum / count } else { 0.0 }
        };
        let (all, lower, upper) = (near(&sections), near(&below), near(&above));
        let mixes = fills
            || (how.along_z && !below.is_empty() && !above.is_empty() && off(&below[0]) > 0.0);
        for y in 0..extent[1] {
            for x in 0..extent[0] {
                let value = if mixes {
                    let (a, b) = (off(&below[0]), off(&above[0]));
                    match (voxel(&lower, x, y), voxel(&upper, x, y)) {
                        (0.0, value) | (value, 0.0) => value,
                        (low, high) => (low * b + high * a) / (a + b),
                    }
                } else {
                    voxel(&all, x, y)
                };
                voxels.push(value.round() as u16);
            }
        }
    }
    voxels
}
