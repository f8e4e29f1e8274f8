//! Which sections a voxel takes its samples from.

use saccade_core::levels::Level;

use super::index::TileIndex;
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

/// Where a voxel's samples come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Sections {
    /// The first of these that has a tile there.
    FirstOf(Vec<u32>),
    /// Two sections around a gap; of the upper one this many parts of 256.
    Between(u32, u32, u32),
}

impl Sections {
    /// Of voxel `z` of a level: those it spans that have tiles, the one nearest its centre first, as
    /// far as they are looked at; or those around it.
    pub(super) fn of(index: &TileIndex, gaps: Gaps, level: Level, z: u32) -> Self {
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
                    let part = -offset(&below) / f64::from(above - below) * 256.0;
                    let part = DVec2::splat(part.round()).as_uvec2().x;
                    Self::Between(below, above, part.min(256))
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
        Self::FirstOf(looked_at.map(|(_, section)| section).collect())
    }
}

/// Values of a plane between two others, of the upper one `part` of 256. 0 is no value.
pub(super) fn between(below: &mut [u8], above: &[u8], part: u32) {
    for (below, above) in below.iter_mut().zip(above) {
        let [a, b] = [*below, *above].map(u32::from);
        let mixed = (a * (256 - part) + b * part + 128) >> 8;
        *below = match (a, b) {
            (0, _) => *above,
            (_, 0) => *below,
            _ => u8::try_from(mixed).unwrap_or(u8::MAX),
        };
    }
}
