//! Which sections a voxel takes its samples from.

use saccade_core::levels::Level;

use super::index::TileIndex;
use super::resample::Sample;
use glam::DVec2;

/// Of the sections that a voxel spans, all of these nearest ones are looked at; of those behind, ever
/// fewer.
const NEAR_SECTIONS: usize = 4;

/// What is shown where sections between two others have no tile at all: lost, or still to come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Gaps {
    /// Nothing.
    #[default]
    Empty,
    /// The nearer of the sections around a gap of at most this many sections, of two equally near
    /// ones the first.
    Nearest(u32),
    /// What lies between the sections around a gap of at most this many sections, in proportion.
    /// Where one of them has no tile, the other.
    Linear(u32),
}

impl Gaps {
    /// The longest gap that is filled \[sections\].
    pub(super) fn longest(self) -> u32 {
        match self {
            Self::Empty => 0,
            Self::Nearest(most) | Self::Linear(most) => most,
        }
    }
}

/// What a voxel is that spans several sections.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum AlongZ {
    /// What the section nearest to its centre has.
    #[default]
    Nearest,
    /// What lies at its centre, in proportion between the nearest sections below and above that it spans.
    /// Where there is a tile on one side only, what is there.
    Linear,
}

/// Where a voxel's samples come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Sections {
    /// The first of these that has a tile there.
    FirstOf(Vec<u32>),
    /// The first of each of these that has a tile there; of the second ones this many parts of
    /// 65,536.
    Between(Vec<u32>, Vec<u32>, u32),
}

impl Sections {
    /// All that may be looked at.
    pub(super) fn all(&self) -> impl Iterator<Item = u32> {
        let (first, then) = match self {
            Self::FirstOf(sections) => (&**sections, &[][..]),
            Self::Between(below, above, _) => (&**below, &**above),
        };
        first.iter().chain(then).copied()
    }

    /// Of voxel `z` of a level: those it spans that have tiles, the one nearest its centre first, as
    /// far as they are looked at; or those around it.
    pub(super) fn of(
        index: &TileIndex,
        (along_z, gaps): (AlongZ, Gaps),
        level: Level,
        z: u32,
    ) -> Self {
        let span = level.downsampling.z;
        let z = f64::from(z);
        // Those whose middle lies within the voxel.
        let first = |z: f64| DVec2::splat((z * span - 0.5).ceil().max(0.0)).as_uvec2().x;
        let range = first(z)..first(z + 1.0);
        let centre = (z + 0.5) * span;
        let offset = |section: &u32| f64::from(*section) + 0.5 - centre;
        let mut sections = index.acquired(range.clone());
        if sections.is_empty() && gaps != Gaps::Empty {
            let (below, above) = index.around(range);
            let gap = below
                .zip(above)
                .filter(|(a, b)| b - a - 1 <= gaps.longest());
            return match (gap, gaps) {
                (Some((below, above)), Gaps::Linear(_)) => {
                    let part = part_of_upper(-offset(&below), offset(&above));
                    Self::Between(vec![below], vec![above], part)
                }
                (Some((below, above)), _) if -offset(&below) <= offset(&above) => {
                    Self::FirstOf(vec![below])
                }
                (Some((_, above)), _) => Self::FirstOf(vec![above]),
                (None, _) => Self::FirstOf(sections),
            };
        }
        // Stable: of two equally near ones, the first.
        sections.sort_by(|a, b| offset(a).abs().total_cmp(&offset(b).abs()));
        let ranked = (1_usize..).zip(sections);
        let looked_at = ranked.filter(|(rank, _)| *rank <= NEAR_SECTIONS || rank.is_power_of_two());
        let sections: Vec<u32> = looked_at.map(|(_, section)| section).collect();
        if along_z == AlongZ::Linear && { sections.iter() }.all(|section| offset(section) != 0.0) {
            let side =
                |below: bool| { sections.iter() }.filter(move |s| (offset(s) < 0.0) == below);
            if let (Some(low), Some(high)) = (side(true).next(), side(false).next()) {
                let part = part_of_upper(-offset(low), offset(high));
                let [below, above] = [true, false].map(|below| side(below).copied().collect());
                return Self::Between(below, above, part);
            }
        }
        Self::FirstOf(sections)
    }
}

/// Parts of 65,536 that the upper of two sections has, so far from each.
fn part_of_upper(from_lower: f64, from_upper: f64) -> u32 {
    let part = from_lower / (from_lower + from_upper) * 65_536.0;
    DVec2::splat(part.round()).as_uvec2().x.min(65_536)
}

/// Values of a plane between two others, of the upper one `part` of 65,536. 0 is no value.
pub(super) fn between<S: Sample>(below: &mut [S], above: &[S], part: u32) {
    for (below, above) in below.iter_mut().zip(above) {
        let [a, b] = [*below, *above].map(|v| u32::from(v.into()));
        let mixed = (a * (65_536 - part) + b * part + 32_768) >> 16;
        *below = match (a, b) {
            (0, _) => *above,
            (_, 0) => *below,
            _ => S::of(u16::try_from(mixed).unwrap_or(u16::MAX)),
        };
    }
}
