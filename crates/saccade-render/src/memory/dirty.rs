//! Which entries the device has not seen yet.

use std::ops::Range;

/// One of the two arrays of entries on the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Array {
    /// The page directory.
    Directory,
    /// The page table cache.
    Tables,
}

/// Changed directory entries this near are uploaded in one piece.
const GAP: u32 = 64;

/// Changed entries: single ones of the directory, a range per block.
#[derive(Debug)]
pub(crate) struct Dirty {
    directory: Vec<u32>,
    ranges: Vec<Range<u32>>,
    blocks: Vec<u32>,
}

impl Dirty {
    pub(crate) fn new(blocks: u32) -> Self {
        Self {
            directory: Vec::new(),
            ranges: vec![0..0; blocks as usize],
            blocks: Vec::new(),
        }
    }

    pub(crate) fn directory(&mut self, entry: u32) {
        self.directory.push(entry);
    }

    pub(crate) fn block(&mut self, block: u32, entries: Range<u32>) {
        let range = &mut self.ranges[block as usize];
        if range.start == range.end {
            *range = entries;
            self.blocks.push(block);
        } else {
            *range = range.start.min(entries.start)..range.end.max(entries.end);
        }
    }

    /// All that changed, as few ranges of the arrays; forgets it.
    pub(crate) fn take(&mut self, block_entries: u32) -> Vec<(Array, Range<u32>)> {
        let mut pieces: Vec<(Array, Range<u32>)> = Vec::new();
        self.directory.sort_unstable();
        for entry in self.directory.drain(..) {
            match pieces.last_mut() {
                Some((_, last)) if entry < last.end + GAP => last.end = last.end.max(entry + 1),
                _ => pieces.push((Array::Directory, entry..entry + 1)),
            }
        }
        self.blocks.sort_unstable();
        for block in self.blocks.drain(..) {
            let range = std::mem::take(&mut self.ranges[block as usize]);
            let first = block * block_entries;
            pieces.push((Array::Tables, first + range.start..first + range.end));
        }
        pieces
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_gathered_and_forgotten() {
        let mut dirty = Dirty::new(3);
        for entry in [500, 7, 7, 9] {
            dirty.directory(entry);
        }
        dirty.block(2, 5..6);
        dirty.block(0, 63..64);
        dirty.block(2, 1..2);
        let want = [
            (Array::Directory, 7..10),
            (Array::Directory, 500..501),
            (Array::Tables, 63..64),
            (Array::Tables, 129..134),
        ];
        assert_eq!(dirty.take(64), want);
        assert!(dirty.take(64).is_empty());
    }
}
