//! What a frame was, read back later.

use saccade_core::brick::{BrickId, MAX_LEVELS};

use crate::layout::{
    COUNT_LOOKUPS, COUNT_MISSES, COUNT_NODES, COUNT_RAYS, COUNT_SAMPLES, COUNT_SAMPLES_HIGH,
    COUNT_STALE, COUNT_SUBSTITUTED, COUNTERS, FEWEST_LOOKUPS, FINEST_LEVEL, MISSES, MOST_LOOKUPS,
    MOST_SUBSTITUTED_LEVELS,
};

/// What a frame was. Arrives some frames later; not every frame has one.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameReport {
    /// Number that [`Renderer::render`](crate::Renderer::render) gave.
    pub frame: u64,
    /// Bricks the frame wanted and that are still not there, most wanted first.
    ///
    /// May be empty while the frame is incomplete; the next one will know more ([`Self::redraw`]).
    pub misses: Vec<BrickId>,
    /// How true the picture is.
    pub fidelity: Fidelity,
    /// Another frame of the same view will be different, even if nothing is delivered until then:
    /// page tables were added, or the level of detail is about to change.
    pub redraw: bool,
    /// Bricks find no room although all that is wanted is of the coarsest level there is: less detail does not help, more memory
    /// does ([`Renderer::enough_memory`](crate::Renderer::enough_memory)).
    pub starved: bool,
    /// Level-of-detail bias in force: the view's plus what memory asked for.
    pub lod_bias: f32,
    /// Part of `lod_bias` that was added because the bricks of the view do not fit the memory.
    pub memory_bias: f32,
    /// Whether the octree knew all that was delivered and noted before the frame. Where it did not, the picture is the
    /// same; it took longer, and bricks may be missed that were noted to be hidden.
    pub octree_is_current: bool,
    /// What the rays did.
    pub statistics: Statistics,
    /// Memory in use.
    pub memory: MemoryUse,
}

impl FrameReport {
    /// Whether everything the frame wanted was there, up to date, at the level it wanted.
    pub fn is_complete(&self) -> bool {
        self.fidelity.missing == 0
    }
}

/// How true a picture is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fidelity {
    /// Missing bricks, at least: unseen tables count as one, and a ray counts a few, front first.
    pub missing: u32,
    /// Of those, bricks drawn as they were before they changed.
    pub stale: u32,
    /// Levels between what was wanted and what was drawn instead, at most.
    pub substituted_levels: u32,
    /// Finest level wanted; `None` where no ray met the volume.
    pub level: Option<u32>,
}

/// What the rays of a frame did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Statistics {
    /// Samples taken.
    pub samples: u64,
    /// Rays that met the volume.
    pub rays: u32,
    /// Entries read of the page directory and of page tables \[000 fig. 6\].
    pub lookups: u32,
    /// Entries read by the ray, of those that met the volume, that read the fewest, and the most.
    pub lookups_per_ray: [u32; 2],
    /// Nodes of the residency octree visited.
    pub nodes: u32,
    /// Ray segments drawn from another level than wanted.
    pub substituted: u32,
    /// Bricks in use.
    pub bricks_used: u32,
    /// Page table blocks in use.
    pub blocks_used: u32,
}

/// Memory on the device \[bytes\]: [`Self::total`] stays below the ceiling, as long as the picture takes no more than
/// is kept for it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MemoryUse {
    /// The brick cache.
    pub bricks: u64,
    /// The page directory, the page table cache and what marks their entries.
    pub tables: u64,
    /// The residency octree.
    pub octree: u64,
    /// Buffers for reading back.
    pub readback: u64,
    /// The picture.
    pub image: u64,
    /// The ceiling that was set.
    pub ceiling: u64,
    /// Places for bricks.
    pub brick_slots: u32,
    /// Of those, filled.
    pub bricks_resident: u32,
    /// Places for page table blocks.
    pub table_slots: u32,
    /// Of those, filled.
    pub tables_resident: u32,
    /// Places for blocks of eight octree nodes.
    pub node_blocks: u32,
    /// Of those, filled.
    pub node_blocks_used: u32,
}

impl MemoryUse {
    /// What counts against the ceiling.
    pub fn total(&self) -> u64 {
        self.bricks + self.tables + self.octree + self.readback + self.image
    }
}

/// A report as the device wrote it.
#[derive(Debug)]
pub(crate) struct RawReport<'a> {
    counters: &'a [u32],
    /// A bit per brick slot, then per page table block.
    pub(crate) usage: &'a [u32],
    misses: &'a [u32],
}

impl<'a> RawReport<'a> {
    pub(crate) fn new(words: &'a [u32], usage_words: u32) -> Self {
        let (counters, rest) = words.split_at(COUNTERS as usize);
        let (usage, misses) = rest.split_at(usage_words as usize);
        Self {
            counters,
            usage,
            misses,
        }
    }

    fn counter(&self, index: u32) -> u32 {
        self.counters[index as usize]
    }

    /// Physical entries missed, most urgent first.
    pub(crate) fn misses_by_urgency(&self) -> impl Iterator<Item = u32> + use<> {
        let count = self.counter(COUNT_MISSES).min(MISSES) as usize;
        let (pairs, _) = self.misses.as_chunks::<2>();
        // Positive floats sort as their bits do.
        let mut misses: Vec<_> = pairs[..count]
            .iter()
            .map(|[entry, urgency]| (*urgency, *entry))
            .collect();
        misses.sort_unstable();
        misses.into_iter().map(|(_, entry)| entry)
    }

    pub(crate) fn fidelity(&self) -> Fidelity {
        let levels = u32::try_from(MAX_LEVELS).expect("32 levels");
        let level = self.counter(FINEST_LEVEL);
        Fidelity {
            missing: self.counter(COUNT_MISSES),
            stale: self.counter(COUNT_STALE),
            substituted_levels: self.counter(MOST_SUBSTITUTED_LEVELS),
            level: (level > 0).then(|| levels.saturating_sub(level)),
        }
    }

    pub(crate) fn statistics(&self, bricks_used: u32, blocks_used: u32) -> Statistics {
        Statistics {
            samples: u64::from(self.counter(COUNT_SAMPLES_HIGH)) << 32
                | u64::from(self.counter(COUNT_SAMPLES)),
            rays: self.counter(COUNT_RAYS),
            lookups: self.counter(COUNT_LOOKUPS),
            lookups_per_ray: match self.counter(COUNT_RAYS) {
                0 => [0, 0],
                _ => [
                    u32::MAX - self.counter(FEWEST_LOOKUPS),
                    self.counter(MOST_LOOKUPS),
                ],
            },
            nodes: self.counter(COUNT_NODES),
            substituted: self.counter(COUNT_SUBSTITUTED),
            bricks_used,
            blocks_used,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_counted_beyond_one_word() {
        let mut words = vec![0; (COUNTERS + 2 * MISSES) as usize];
        words[COUNT_SAMPLES as usize] = 7;
        let samples = |words: &[u32]| RawReport::new(words, 0).statistics(0, 0).samples;
        assert_eq!(samples(&words), 7);
        words[COUNT_SAMPLES_HIGH as usize] = 3;
        assert_eq!(samples(&words), 3 * (1 << 32) + 7);
    }
}
