use std::collections::BTreeSet;
use std::ops::{Bound, Range};

/// Of each channel, the sections that have a tile.
#[derive(Debug)]
pub(in crate::stitched) struct Acquired(Box<[BTreeSet<u32>]>);

impl Acquired {
    pub(super) fn new(of_channels: Vec<Vec<u32>>) -> Self {
        let of_channels = of_channels.into_iter();
        Self(of_channels.map(BTreeSet::from_iter).collect())
    }

    /// All channels, by number.
    pub(in crate::stitched) fn channels(&self) -> impl Iterator<Item = u32> + use<> {
        0..u32::try_from(self.0.len()).unwrap_or(u32::MAX)
    }

    fn of(&self, channel: u32) -> Option<&BTreeSet<u32>> {
        self.0.get(channel as usize)
    }

    pub(in crate::stitched) fn has(&self, channel: u32, section: u32) -> bool {
        self.of(channel).is_some_and(|of| of.contains(&section))
    }

    /// Those of a channel in a range, ascending.
    pub(in crate::stitched) fn within(
        &self,
        channel: u32,
        sections: Range<u32>,
    ) -> impl Iterator<Item = u32> {
        let sections = sections.start..sections.end.max(sections.start);
        let of = self.of(channel).into_iter();
        of.flat_map(move |of| of.range(sections.clone()).copied())
    }

    /// The nearest ones of a channel below and above a range.
    pub(in crate::stitched) fn around(
        &self,
        channel: u32,
        sections: Range<u32>,
    ) -> (Option<u32>, Option<u32>) {
        let Some(of) = self.of(channel) else {
            return (None, None);
        };
        let below = of.range(..sections.start).next_back();
        let end = Bound::Included(sections.end.max(sections.start));
        let above = of.range((end, Bound::Unbounded)).next();
        (below.copied(), above.copied())
    }

    /// The channels of which a section's having a tile is other than it was.
    pub(super) fn turned(&self, section: u32, has: &[bool]) -> Vec<u32> {
        let has = self.channels().zip(has);
        let turned = has.filter(|(channel, has)| self.has(*channel, section) != **has);
        turned.map(|(channel, _)| channel).collect()
    }

    /// It has a tile of these channels that it had none of, or the other way round.
    pub(super) fn turn(&mut self, section: u32, channels: &[u32]) {
        for channel in channels {
            let of = &mut self.0[*channel as usize];
            if !of.remove(&section) {
                of.insert(section);
            }
        }
    }

    /// Memory it takes on the heap, about \[bytes\].
    pub(super) fn bytes(&self) -> usize {
        let sections: usize = self.0.iter().map(BTreeSet::len).sum();
        // Trees are at least half full.
        size_of_val(&*self.0) + 2 * sections * size_of::<u32>()
    }
}
