//! The ways to draw a volume that the papers compare with \[000 §8, 001 §9.2\].

mod caster;
mod paged;
mod table;

pub(crate) use caster::{Baseline, Work};

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
}

impl Method {
    /// All of them.
    pub(crate) const ALL: [Self; 4] = [
        Self::PageTables,
        Self::HidingPageTables,
        Self::KdRestart,
        Self::ShortStack,
    ];

    fn is_octree(self) -> bool {
        matches!(self, Self::KdRestart | Self::ShortStack)
    }
}

#[cfg(test)]
mod tests;
