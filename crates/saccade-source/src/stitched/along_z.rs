//! Which sections a voxel takes its samples from.

use std::ops::Range;

use saccade_core::levels::Level;

use super::index::{Acquired, TileIndex};
use super::resample::Sample;
use glam::DVec2;

/// Of the sections that a voxel spans, all of these nearest ones are looked at; of those behind, ever
/// fewer.
const NEAR_SECTIONS: u8 = 4;

/// What is shown where sections between two others have no tile of the channel at all: lost, left out, or still to come.
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

    /// Of voxel `z` of a channel's level: those it spans that have tiles of the channel, the one nearest its centre first, as
    /// far as they are looked at; or those around it.
    pub(super) fn of(
        index: &TileIndex,
        (along_z, gaps): (AlongZ, Gaps),
        (channel, level): (u32, Level),
        z: u32,
    ) -> Self {
        let range = sections_within(level, z);
        let centre = (f64::from(z) + 0.5) * level.downsampling.z;
        let offset = |section: &u32| f64::from(*section) + 0.5 - centre;
        let mut sections = index.acquired(channel, range.clone());
        if sections.is_empty() && gaps != Gaps::Empty {
            let (below, above) = index.around(channel, range);
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
        let looked_at = ranked
            .filter(|(rank, _)| *rank <= usize::from(NEAR_SECTIONS) || rank.is_power_of_two());
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

/// Those whose middle lies within voxel `z` of a level.
fn sections_within(level: Level, z: u32) -> Range<u32> {
    let span = level.downsampling.z;
    let first = |z: f64| DVec2::splat((z * span - 0.5).ceil().max(0.0)).as_uvec2().x;
    first(z.into())..first(f64::from(z) + 1.0)
}

/// Where a section of a volume is seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Reach {
    /// Planes of level 0 whose voxels, or those around them of coarser levels, look at it.
    pub(super) sections: Range<u32>,
    /// Whether they may be others everywhere, not only where its tiles lie, because of whether it has any.
    pub(super) everywhere: bool,
}

impl Reach {
    /// In its own plane, where its tiles lie.
    pub(super) fn own(section: u32) -> Self {
        Self {
            sections: section..section.saturating_add(1),
            everywhere: false,
        }
    }

    /// What both are.
    pub(super) fn union(self, other: Self) -> Self {
        let (a, b) = (self.sections, other.sections);
        Self {
            sections: a.start.min(b.start)..a.end.max(b.end),
            everywhere: self.everywhere || other.everywhere,
        }
    }
}

/// Says where sections are seen, in the words of [`Sections::of`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Reaches<'v> {
    pub(super) along_z: AlongZ,
    pub(super) gaps: Gaps,
    pub(super) levels: &'v [Level],
}

impl Reaches<'_> {
    /// Of a section in a channel, as long as these sections have tiles; `turned` if it had none before, or has none afterwards.
    pub(super) fn of(
        &self,
        acquired: &Acquired,
        channel: u32,
        section: u32,
        turned: bool,
    ) -> Reach {
        let mut reach = Reach::own(section);
        let own = reach.sections.clone();
        let (below, above) = acquired.around(channel, own);
        let is_filled = |a: u32, b: u32| (1..=self.gaps.longest()).contains(&(b - a - 1));
        let mut filled = false;
        if acquired.has(channel, section) {
            let halves = matches!(self.gaps, Gaps::Nearest(_)) && !turned;
            if let Some(below) = below.filter(|below| is_filled(*below, section)) {
                let to = if halves {
                    below.midpoint(section)
                } else {
                    below
                };
                (reach.sections.start, filled) = (to + 1, true);
            }
            if let Some(above) = above.filter(|above| is_filled(section, *above)) {
                let half = || section.midpoint(above) + 1;
                (reach.sections.end, filled) = (if halves { half() } else { above }, true);
            }
        } else if let Some((below, above)) = below.zip(above)
            && is_filled(below, above)
        {
            (reach.sections, filled) = (below + 1..above, true);
        }
        reach.everywhere = turned && (filled || self.ranks_count(acquired, channel, section));
        reach
    }

    /// Of a section at some time, whatever others had tiles then; `turned` if it may have had its first, or lost its last.
    pub(super) fn at_some_time(&self, section: u32, turned: bool, depth: u32) -> Reach {
        let longest = self.gaps.longest();
        let own = Reach::own(section).sections;
        let most = { self.levels.iter() }.map(|level| level.downsampling.z.min(depth.into()));
        let ranked = most.fold(0.0, f64::max) > f64::from(self.unranked());
        Reach {
            sections: own.start.saturating_sub(longest)..own.end.saturating_add(longest),
            everywhere: turned && (longest > 0 || ranked),
        }
    }

    /// Of so few sections that a voxel spans, none hides by its rank that another is looked at, or changes what share it has.
    fn unranked(&self) -> u8 {
        match self.along_z {
            AlongZ::Nearest => NEAR_SECTIONS,
            AlongZ::Linear => 2,
        }
    }

    /// Whether a voxel that spans a section shows other sections otherwise where it has no tile, by whether it has any elsewhere.
    fn ranks_count(&self, acquired: &Acquired, channel: u32, section: u32) -> bool {
        self.levels.iter().any(|level| {
            let middle = (f64::from(section) + 0.5) / level.downsampling.z;
            let z = DVec2::splat(middle).as_uvec2().x;
            let others = acquired.within(channel, sections_within(*level, z));
            let others = others.filter(|other| *other != section);
            others.take(self.unranked().into()).count() == usize::from(self.unranked())
        })
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
