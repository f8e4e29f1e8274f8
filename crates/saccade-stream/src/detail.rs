//! How finely a channel is drawn, and how fine its values are [001 sections 7.4 and 11.2].

use std::ops::RangeInclusive;

use glam::{DVec3, IVec3, UVec3};
use saccade_core::brick::{
    BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BRICK_STORED_VOXELS, BrickId, bricks_of,
};
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;

/// Bricks of a level that are looked at, and have to be, before it is judged; all where it has fewer.
const JUDGED_BRICKS: u32 = 16;
/// A level is not needed when the next coarser one has all but this share of its variance.
const MOST_LOST: f64 = 0.01;

/// How finely a channel is drawn.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Detail {
    /// One voxel a pixel, as the view asks for.
    #[default]
    Full,
    /// No level that differs from the next coarser one by less than a hundredth of the values' variance, or not at
    /// all: found from the bricks that arrive.
    ByContent,
    /// As somebody chose.
    Chosen {
        /// Levels that are drawn, 0 the finest; the nearest of them where another is wanted.
        levels: RangeInclusive<u32>,
        /// Levels coarser than others that suffice.
        coarser: u32,
    },
}

/// How much detail the levels of a channel have, from some of its bricks.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Content {
    levels: Vec<Spread>,
    /// Smallest and largest of all values that were looked at, 0 for what was not acquired.
    range: Option<[u16; 2]>,
    /// Finest voxels that have changed since these bricks were looked at, and before.
    changed: [u64; 2],
}

impl Default for Content {
    fn default() -> Self {
        let few = u64::from(JUDGED_BRICKS) * u64::from(BRICK_EDGE).pow(3);
        Self {
            levels: Vec::new(),
            range: None,
            changed: [0, few],
        }
    }
}

/// Squared differences of values.
#[derive(Clone, Debug, Default, PartialEq)]
struct Spread {
    /// Which bricks were looked at.
    bricks: Vec<UVec3>,
    /// So many are enough to judge by; nothing is known of a level without any.
    enough: u32,
    /// From the mean of their brick.
    all: f64,
    /// From the mean of the voxel of the next coarser level that they are in.
    lost: f64,
}

impl Content {
    /// Whether a brick would tell something new.
    pub(crate) fn wants(&self, id: BrickId) -> bool {
        let known = self.levels.get(id.level() as usize);
        known.is_none_or(|spread| !spread.is_judged() && !spread.bricks.contains(&id.brick()))
    }

    /// Forgets what was seen when as many finest voxels have changed since as ever before, or half of all `whole`:
    /// a volume that grows is looked at again and again, ever more seldom.
    pub(crate) fn change(&mut self, voxels: u64, whole: u64) {
        let [since, before] = &mut self.changed;
        *since = since.saturating_add(voxels);
        if *since >= (*before).min(whole / 2) {
            *before = before.saturating_add(*since);
            *since = 0;
            self.levels.clear();
            self.range = None;
        }
    }

    /// Takes a brick's values, stored with its border, little-endian, into account.
    pub(crate) fn note(&mut self, volume: &Volume, id: BrickId, voxels: &[u8]) {
        let (at, next) = (id.level() as usize, id.level() as usize + 1);
        if at >= volume.levels.len() {
            return;
        }
        let values: Vec<u16> = match volume.dtype {
            Dtype::Uint16 => {
                let (pairs, _) = voxels.as_chunks::<2>();
                pairs.iter().copied().map(u16::from_le_bytes).collect()
            }
            _ => voxels.iter().copied().map(u16::from).collect(),
        };
        // Of the coarsest level, too: its few bricks show what those that were looked at elsewhere leave out.
        self.range = { inside(volume, id, &values) }.fold(self.range, |range, value| {
            let [least, most] = range.unwrap_or([value; 2]);
            Some([least.min(value), most.max(value)])
        });
        let Some([here, coarser]) = volume.levels.get(at..=next) else {
            return;
        };
        if self.levels.len() <= at {
            self.levels.resize(next, Spread::default());
        }
        let spread = &mut self.levels[at];
        let there = bricks_of(here.extent);
        spread.enough = { there.element_product() }.clamp(1, JUDGED_BRICKS);
        spread.bricks.push(id.brick());
        let edge = block_edge(coarser.downsampling / here.downsampling);
        if values.len() == BRICK_STORED_VOXELS {
            spread.add(&values, edge);
        }
    }

    /// The finest level that has to be drawn, as far as is known.
    pub(crate) fn finest_needed(&self) -> u32 {
        // One value everywhere is the same at all levels. Bricks of one value each tell nothing: others may have more.
        let alike = self
            .range
            .is_some_and(|[least, most]| least == most && least > 0);
        let needed = |s: &Spread| s.is_judged() && s.lost > MOST_LOST * s.all;
        let not_needed =
            |s: &Spread| s.is_judged() && (s.all > 0.0 || alike) && s.lost <= MOST_LOST * s.all;
        let first = self.levels.iter().position(needed);
        let below = &self.levels[..first.unwrap_or(self.levels.len())];
        let last = below.iter().rposition(not_needed);
        last.map_or(0, |level| u32::try_from(level).unwrap_or(u32::MAX) + 1)
    }
}

/// Voxels of a level, per axis, that one of the next coarser level is the mean of.
fn block_edge(ratio: DVec3) -> UVec3 {
    ratio
        .round()
        .clamp(DVec3::ONE, DVec3::splat(f64::from(BRICK_EDGE)))
        .as_uvec3()
}

/// Values of a stored brick that lie in the volume: what it carries around that was not acquired anywhere.
fn inside(volume: &Volume, id: BrickId, values: &[u16]) -> impl Iterator<Item = u16> {
    let extent = volume.levels[id.level() as usize].extent.as_ivec3();
    let low = (id.brick() * BRICK_EDGE).as_ivec3() - IVec3::splat(BRICK_BORDER.cast_signed());
    let is_whole = values.len() == BRICK_STORED_VOXELS;
    let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
    { cells.zip(values) }.filter_map(move |(cell, value)| {
        let at = low + cell.as_ivec3();
        let is_inside = at.cmpge(IVec3::ZERO).all() && at.cmplt(extent).all();
        (is_inside || !is_whole).then_some(*value)
    })
}

impl Spread {
    fn is_judged(&self) -> bool {
        self.enough > 0 && self.bricks.len() >= self.enough as usize
    }

    /// Blocks with a voxel that was not acquired are left out.
    fn add(&mut self, values: &[u16], edge: UVec3) {
        let count = f64::from(edge.element_product());
        let (mut blocks, mut sum, mut squares) = (0.0, 0.0, 0.0);
        let starts = |axis: usize| {
            let (edge, from) = (edge[axis], BRICK_BORDER);
            (0..BRICK_EDGE / edge).map(move |block| from + block * edge)
        };
        for z in starts(2) {
            for y in starts(1) {
                for x in starts(0) {
                    let (mut of_block, mut of_squares, mut least) = (0.0, 0.0, u16::MAX);
                    for k in z..z + edge.z {
                        for j in y..y + edge.y {
                            let row = (k * BRICK_STORED_EDGE + j) * BRICK_STORED_EDGE + x;
                            let row = row as usize;
                            for &value in &values[row..row + edge.x as usize] {
                                least = least.min(value);
                                of_block += f64::from(value);
                                of_squares += f64::from(value) * f64::from(value);
                            }
                        }
                    }
                    if least > 0 {
                        blocks += 1.0;
                        sum += of_block;
                        squares += of_squares;
                        self.lost += of_squares - of_block * of_block / count;
                    }
                }
            }
        }
        if blocks > 0.0 {
            // Whole numbers differ by none or by one at least; less is rounding.
            let all = squares - sum * sum / (blocks * count);
            self.all += if all < 0.25 { 0.0 } else { all };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(dtype: Dtype) -> Volume {
        let volume = Volume::new("v", UVec3::new(4000, 4000, 400), DVec3::new(4.0, 4.0, 40.0));
        Volume {
            dtype,
            ..volume.unwrap()
        }
    }

    /// A stored brick.
    fn brick(dtype: Dtype, value: impl Fn(UVec3) -> f64) -> Vec<u8> {
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE));
        #[expect(clippy::cast_possible_truncation, reason = "between 1 and 60000")]
        #[expect(clippy::cast_sign_loss, reason = "between 1 and 60000")]
        let value = |at| value(at) as u16;
        let bytes = cells.iter().map(value).flat_map(|v| match dtype {
            Dtype::Uint16 => v.to_le_bytes().to_vec(),
            _ => v.to_le_bytes()[..1].to_vec(),
        });
        bytes.collect()
    }

    /// Some brick of a level, another for each number.
    fn id(level: u32, number: u32) -> BrickId {
        BrickId::new(0, level, UVec3::new(number, 0, 0)).unwrap()
    }

    fn noted(dtype: Dtype, levels: &[(u32, f64)]) -> Content {
        let volume = volume(dtype);
        let scale = if dtype == Dtype::Uint16 { 250.0 } else { 1.0 };
        let mut content = Content::default();
        for &(level, wavelength) in levels {
            let wave = |x: u32| (f64::from(x) * std::f64::consts::TAU / wavelength).sin();
            let value = |at: UVec3| scale * (120.0 + 50.0 * wave(at.x) + 50.0 * wave(at.y));
            for number in 0..JUDGED_BRICKS {
                assert!(content.wants(id(level, number)));
                content.note(&volume, id(level, number), &brick(dtype, value));
                assert!(!content.wants(id(level, number)), "it was looked at");
            }
            assert!(!content.wants(id(level, 99)));
        }
        content
    }

    #[test]
    fn levels_that_the_next_one_shows_as_well_are_not_needed() {
        for dtype in [Dtype::Uint8, Dtype::Uint16] {
            let needed = |levels: &[(u32, f64)]| noted(dtype, levels).finest_needed();
            // Long waves at level 0, so level 1 suffices; it has short ones.
            assert_eq!(needed(&[(0, 32.0)]), 1);
            assert_eq!(needed(&[(0, 32.0), (1, 4.0)]), 1);
            assert_eq!(needed(&[(0, 32.0), (1, 32.0), (2, 5.0)]), 2);
            assert_eq!(needed(&[(0, 4.0)]), 0);
            // Not seen yet is not more than what is coarser.
            assert_eq!(needed(&[(2, 32.0)]), 3);
            assert_eq!(needed(&[(0, 4.0), (2, 32.0)]), 0, "level 0 is needed");
        }
    }

    #[test]
    fn what_has_changed_much_is_judged_anew_and_ever_more_seldom() {
        let mut content = noted(Dtype::Uint8, &[(0, 32.0)]);
        let judged = content.clone().levels;
        let few = 16 * 32 * 32 * 32;
        content.change(few - 1, 1 << 40);
        assert_eq!(content.finest_needed(), 1, "little has changed");
        content.change(1, 1 << 40);
        assert_eq!(
            (content.finest_needed(), content.wants(id(0, 0))),
            (0, true)
        );
        let mut times = 0;
        for _ in 0..1000 {
            content.levels.clone_from(&judged);
            content.change(few, 1 << 40);
            times += u32::from(content.levels.is_empty());
        }
        assert!((7..11).contains(&times), "{times}");
        // All of it has changed, however often it did before.
        for _ in 0..3 {
            content.levels.clone_from(&judged);
            content.change(few, few);
            assert!(content.levels.is_empty());
        }
        content.change(u64::MAX, u64::MAX);
        content.change(u64::MAX, u64::MAX);
    }

    #[test]
    fn where_all_is_alike_the_next_coarser_level_shows_the_same() {
        for dtype in [Dtype::Uint8, Dtype::Uint16] {
            let volume = volume(dtype);
            let coarsest = u32::try_from(volume.levels.len() - 1).unwrap();
            let of = |value: f64| brick(dtype, move |_| value);
            let alike = |levels: u32| {
                let mut content = Content::default();
                for level in 0..levels {
                    for number in 0..JUDGED_BRICKS {
                        content.note(&volume, id(level, number), &of(251.0));
                    }
                }
                content.note(&volume, id(coarsest, 0), &of(251.0));
                content
            };
            assert_eq!(alike(0).finest_needed(), 0, "nothing fine was seen");
            assert_eq!(alike(1).finest_needed(), 1);
            assert_eq!(alike(3).finest_needed(), 3);
            // The same bricks, in a volume that has something else somewhere.
            let other = brick(dtype, |at| if at.x == 30 { 250.0 } else { 251.0 });
            for seen in [other, of(250.0), of(0.0)] {
                let mut content = alike(1);
                content.note(&volume, id(coarsest, 0), &seen);
                assert_eq!(content.finest_needed(), 0);
            }
            let mut content = alike(1);
            content.change(u64::MAX, u64::MAX);
            content.note(&volume, id(0, 0), &of(9.0));
            assert_eq!((content.finest_needed(), content.range), (0, Some([9; 2])));
        }
    }

    /// Two bricks of level 0 and one of the next, of which most lies outside.
    #[test]
    fn a_level_of_few_bricks_is_judged_by_all_of_them() {
        let extent = UVec3::new(45, 29, 23);
        let volume = Volume::new("v", extent, DVec3::splat(4.0)).unwrap();
        assert_eq!(volume.levels.len(), 2);
        let stored = |id: BrickId, value: fn(IVec3) -> f64| {
            let low = (id.brick() * BRICK_EDGE).as_ivec3() - 1;
            let extent = volume.levels[id.level() as usize].extent.as_ivec3();
            brick(Dtype::Uint8, |cell| {
                let at = low + cell.as_ivec3();
                let inside = at.cmpge(IVec3::ZERO).all() && at.cmplt(extent).all();
                if inside { value(at) } else { 0.0 }
            })
        };
        let steep = |at: IVec3| if at.x % 2 == 0 { 50.0 } else { 90.0 };
        for (value, needed) in [((|_| 90.0) as fn(IVec3) -> f64, 1), (steep, 0)] {
            let mut content = Content::default();
            for (id, judged) in [
                (id(1, 0), 0),
                (id(0, 0), 0),
                (id(0, 0), 0),
                (id(0, 1), needed),
            ] {
                if content.wants(id) {
                    content.note(&volume, id, &stored(id, value));
                }
                assert_eq!(content.finest_needed(), judged, "{id}");
            }
            assert!(!content.wants(id(0, 0)));
        }
    }

    #[test]
    fn what_is_lost_is_what_block_means_do_not_say() {
        // Alternating 10 and 30 along x: blocks of two lose all of it, of one nothing.
        let values: Vec<u16> = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE))
            .iter()
            .map(|at| if at.x % 2 == 0 { 10 } else { 30 })
            .collect();
        let voxels = f64::from(BRICK_EDGE.pow(3));
        let mut spread = Spread::default();
        spread.add(&values, UVec3::new(2, 1, 1));
        assert!((spread.all - 100.0 * voxels).abs() < 1e-3);
        assert!((spread.lost - 100.0 * voxels).abs() < 1e-3);
        let mut along_y = Spread::default();
        along_y.add(&values, UVec3::new(1, 2, 1));
        assert!((along_y.all - 100.0 * voxels).abs() < 1e-3 && along_y.lost.abs() < 1e-3);
    }

    #[test]
    fn nothing_is_judged_by_few_bricks_or_by_what_was_not_acquired() {
        let volume = volume(Dtype::Uint8);
        let mut content = Content::default();
        content.note(&volume, id(0, 0), &brick(Dtype::Uint8, |_| 90.0));
        assert_eq!(content.finest_needed(), 0);
        let mut content = Content::default();
        // Half of it not acquired: a step that no voxel has.
        let half = brick(Dtype::Uint8, |at| if at.x < 17 { 0.0 } else { 90.0 });
        for number in 0..JUDGED_BRICKS {
            content.note(&volume, id(0, number), &half);
        }
        assert_eq!(content.levels[0].lost, 0.0);
        assert_eq!(
            content.finest_needed(),
            0,
            "where it ends, coarser levels differ"
        );
        let coarsest = u32::try_from(volume.levels.len() - 1).unwrap();
        content.note(&volume, id(coarsest, 0), &half);
        content.note(&volume, id(coarsest + 7, 0), &half);
        assert!(content.wants(id(coarsest, 0)), "there is nothing coarser");
    }
}
