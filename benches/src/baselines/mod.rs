//! The ways to draw a volume that the papers compare with \[000 §8, 001 §9.2\].

mod caster;
mod paged;
mod table;

pub(crate) use caster::{Baseline, Work, range};

/// How rays find bricks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Method {
    /// Page tables; bricks of zeros are skipped \[001 §9.2.1\].
    PageTables,
    /// Page tables; bricks that the transfer function hides are skipped as well \[000 §4.1.2\].
    HidingPageTables,
    /// An octree of bricks, entered at the top for every brick and channel.
    KdRestart,
    /// An octree of bricks, entered at the lowest of four remembered nodes that holds the place.
    ShortStack,
    /// [`Self::PageTables`] looked up for every sample of every channel, as published \[001 §9.2.1\].
    SampledPageTables,
    /// [`Self::ShortStack`] searched for every sample of every channel, as published \[001 §9.2.2\].
    SampledOctree,
}

impl Method {
    /// Those that sample a brick to its end before they search again.
    pub(crate) const BY_BRICK: [Self; 4] = [
        Self::PageTables,
        Self::HidingPageTables,
        Self::KdRestart,
        Self::ShortStack,
    ];

    /// All of them.
    pub(crate) const ALL: [Self; 6] = [
        Self::PageTables,
        Self::HidingPageTables,
        Self::KdRestart,
        Self::ShortStack,
        Self::SampledPageTables,
        Self::SampledOctree,
    ];

    fn is_octree(self) -> bool {
        matches!(
            self,
            Self::KdRestart | Self::ShortStack | Self::SampledOctree
        )
    }

    /// Whether each sample is searched for anew.
    fn is_sampled(self) -> bool {
        matches!(self, Self::SampledPageTables | Self::SampledOctree)
    }
}

#[cfg(test)]
mod tests;
