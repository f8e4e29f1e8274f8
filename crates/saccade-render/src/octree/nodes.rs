//! Where nodes are kept: blocks of eight siblings, as shaders read them.

use super::values::Values;
use crate::layout::{NODE_BINS, NODE_CHILDREN, NODE_RANGE, NODE_VALID, NODE_WORDS, SIBLINGS};

/// What a node says about the values of a channel, as shaders read it.
type Texel = [u32; NODE_WORDS as usize];

/// What a node knows about a channel from what was noted at the node itself.
///
/// What its children know together is not part of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Own {
    pub(crate) values: Values,
    /// Levels for whose samples the values hold, as bits.
    pub(crate) valid: u32,
}

impl Own {
    pub(crate) const NOTHING: Self = Self {
        values: Values::NONE,
        valid: 0,
    };
    /// Space past the volume's end: no level has a sample there.
    pub(crate) const OUTSIDE: Self = Self {
        values: Values::NONE,
        valid: u32::MAX,
    };
}

/// What a node says about a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Known {
    pub(crate) values: Values,
    /// Levels for whose samples the values hold, as bits.
    pub(crate) valid: u32,
    /// Levels with a resident brick that overlaps the node, as bits.
    pub(crate) resident: u32,
}

#[derive(Clone, Copy, Debug)]
struct Block {
    /// Node whose children these are; the root's block has none.
    parent: u32,
    /// When it was last written to.
    touched: u64,
    in_use: bool,
    dirty: bool,
    /// Nodes of it that have children, and channels of nodes that note a resident brick: none may be forgotten.
    kept: u16,
}

/// Nodes, in blocks of eight. Block 0 holds the root and seven nodes that are never used.
#[derive(Debug)]
pub(crate) struct Nodes {
    channels: u32,
    capacity: u32,
    /// Per node and channel.
    texels: Vec<Texel>,
    /// Per node and channel, levels with a resident brick, as bits.
    resident: Vec<u32>,
    own: Vec<Own>,
    blocks: Vec<Block>,
    free: Vec<u32>,
    dirty: Vec<u32>,
    used: u32,
    /// Where the search for a block to forget goes on.
    hand: u32,
    now: u64,
    /// Blocks looked at in search of one to forget.
    searched: u64,
}

/// The root.
pub(crate) const ROOT: u32 = 0;
/// Blocks looked at in search of one to forget.
const SEARCH: u32 = 512;

impl Nodes {
    /// A root that knows nothing. At most `capacity` blocks, two at least.
    pub(crate) fn new(channels: u32, capacity: u32) -> Self {
        let mut nodes = Self {
            channels,
            capacity: capacity.max(2),
            texels: Vec::new(),
            resident: Vec::new(),
            own: Vec::new(),
            blocks: Vec::new(),
            free: Vec::new(),
            dirty: Vec::new(),
            used: 0,
            hand: 0,
            now: 0,
            searched: 0,
        };
        nodes.add(ROOT, |_| Own::NOTHING);
        nodes
    }

    pub(crate) fn channels(&self) -> u32 {
        self.channels
    }

    /// `(in use, capacity)` \[blocks\].
    pub(crate) fn blocks(&self) -> (u32, u32) {
        (self.used, self.capacity)
    }

    /// Blocks written to since the last [`Self::flush`].
    pub(crate) fn dirty(&self) -> usize {
        self.dirty.len()
    }

    /// Hands out what changed since the last call: first texel, texels, and levels that are resident there. Forgets it.
    pub(crate) fn flush(&mut self, mut upload: impl FnMut(u32, &[Texel], &[u32])) {
        self.dirty.sort_unstable();
        let per_block = self.channels * SIBLINGS;
        let mut dirty = self.dirty.drain(..).peekable();
        while let Some(first) = dirty.next() {
            let mut end = first + 1;
            while dirty.next_if_eq(&end).is_some() {
                end += 1;
            }
            for block in &mut self.blocks[first as usize..end as usize] {
                block.dirty = false;
            }
            let [from, to] = [first, end].map(|block| (block * per_block) as usize);
            upload(
                first * per_block,
                &self.texels[from..to],
                &self.resident[from..to],
            );
        }
    }

    /// Something happens from now on that is newer than what was.
    pub(crate) fn tick(&mut self) {
        self.now += 1;
    }

    /// Keeps a node from being forgotten until the next [`Self::tick`].
    pub(crate) fn touch(&mut self, node: u32) {
        self.blocks[(node / SIBLINGS) as usize].touched = self.now;
    }

    /// First child of a node, if it has any.
    pub(crate) fn children(&self, node: u32) -> Option<u32> {
        let block = self.texels[self.at(node, 0)][NODE_CHILDREN as usize];
        (block != 0).then_some(block * SIBLINGS)
    }

    /// Gives a node eight children and returns the first; `None` when there is no room.
    ///
    /// `own` tells what a child knows from the start.
    pub(crate) fn split(&mut self, node: u32, own: impl Fn(u32) -> Own) -> Option<u32> {
        debug_assert!(self.children(node).is_none(), "a node has eight children");
        if self.used == self.capacity {
            self.forget_some()?;
        }
        let block = self.add(node, own);
        self.blocks[(node / SIBLINGS) as usize].kept += 1;
        self.set_children(node, block);
        Some(block * SIBLINGS)
    }

    fn add(&mut self, parent: u32, own: impl Fn(u32) -> Own) -> u32 {
        let fresh = Block {
            parent,
            touched: self.now,
            in_use: true,
            dirty: false,
            kept: 0,
        };
        self.used += 1;
        let block = if let Some(block) = self.free.pop() {
            // The device may be about to get what was there before.
            let dirty = self.blocks[block as usize].dirty;
            self.blocks[block as usize] = Block { dirty, ..fresh };
            block
        } else {
            self.blocks.push(fresh);
            let texels = self.blocks.len() * (SIBLINGS * self.channels) as usize;
            self.texels.resize(texels, [0; NODE_WORDS as usize]);
            self.resident.resize(texels, 0);
            self.own.resize(texels, Own::NOTHING);
            u32::try_from(self.blocks.len() - 1).expect("at most the capacity")
        };
        for index in 0..SIBLINGS {
            let node = block * SIBLINGS + index;
            let own = own(index);
            for channel in 0..self.channels {
                self.set_own(node, channel, own);
                let at = self.at(node, channel);
                self.texels[at] = texel(own.values, own.valid, 0);
                self.resident[at] = 0;
            }
        }
        self.mark(block);
        block
    }

    /// Forgets what the nodes of a block know of a channel; `false` where there is no such block.
    pub(crate) fn clear(&mut self, block: u32, channel: u32) -> bool {
        let Some(state) = self.blocks.get(block as usize) else {
            return false;
        };
        if state.in_use {
            for node in block * SIBLINGS..(block + 1) * SIBLINGS {
                let outside = self.own(node, channel) == Own::OUTSIDE;
                let own = if outside { Own::OUTSIDE } else { Own::NOTHING };
                self.set_own(node, channel, own);
                let Own { values, valid } = own;
                let resident = 0;
                self.set_known(
                    node,
                    channel,
                    Known {
                        values,
                        valid,
                        resident,
                    },
                );
            }
        }
        true
    }

    /// Takes a node's children away. They have none themselves.
    pub(crate) fn join(&mut self, node: u32) {
        let Some(first) = self.children(node) else {
            return;
        };
        debug_assert!((first..first + SIBLINGS).all(|child| self.children(child).is_none()));
        let block = first / SIBLINGS;
        self.blocks[block as usize].in_use = false;
        self.free.push(block);
        self.used -= 1;
        self.blocks[(node / SIBLINGS) as usize].kept -= 1;
        self.set_children(node, 0);
    }

    fn set_children(&mut self, node: u32, block: u32) {
        for channel in 0..self.channels {
            let at = self.at(node, channel);
            self.texels[at][NODE_CHILDREN as usize] = block;
        }
        self.mark(node / SIBLINGS);
    }

    /// Forgets the detail in some block that no resident brick is noted in: of those that were
    /// looked at, the one written to longest ago. What its nodes knew together stays known.
    fn forget_some(&mut self) -> Option<()> {
        let count = u32::try_from(self.blocks.len()).expect("at most the capacity");
        let mut oldest = None;
        for _ in 0..SEARCH.min(count) {
            self.searched += 1;
            self.hand = (self.hand + 1) % count;
            let block = self.blocks[self.hand as usize];
            // What was written to just now is being grown at this moment.
            let may_go =
                block.in_use && self.hand != 0 && block.touched < self.now && block.kept == 0;
            if may_go && oldest.is_none_or(|(touched, _)| block.touched < touched) {
                oldest = Some((block.touched, block.parent));
            }
        }
        let (_, parent) = oldest?;
        for channel in 0..self.channels {
            let Known { values, valid, .. } = self.known(parent, channel);
            self.set_own(parent, channel, Own { values, valid });
        }
        self.join(parent);
        Some(())
    }

    pub(crate) fn own(&self, node: u32, channel: u32) -> Own {
        self.own[self.at(node, channel)]
    }

    /// Changes what was noted at a node; what it says follows from [`Self::set_known`].
    pub(crate) fn set_own(&mut self, node: u32, channel: u32, own: Own) {
        let at = self.at(node, channel);
        self.own[at] = own;
    }

    pub(crate) fn known(&self, node: u32, channel: u32) -> Known {
        let at = self.at(node, channel);
        let word = |word: u32| self.texels[at][word as usize];
        Known {
            values: Values::from_words(word(NODE_BINS), word(NODE_RANGE)),
            valid: word(NODE_VALID),
            resident: self.resident[at],
        }
    }

    pub(crate) fn set_known(&mut self, node: u32, channel: u32, known: Known) {
        let at = self.at(node, channel);
        let block = &mut self.blocks[(node / SIBLINGS) as usize];
        block.kept -= u16::from(self.resident[at] != 0);
        block.kept += u16::from(known.resident != 0);
        let children = self.texels[at][NODE_CHILDREN as usize];
        let texel = texel(known.values, known.valid, children);
        if (self.texels[at], self.resident[at]) != (texel, known.resident) {
            self.texels[at] = texel;
            self.resident[at] = known.resident;
            self.mark(node / SIBLINGS);
        }
    }

    fn mark(&mut self, block: u32) {
        let state = &mut self.blocks[block as usize];
        if !std::mem::replace(&mut state.dirty, true) {
            self.dirty.push(block);
        }
    }

    fn at(&self, node: u32, channel: u32) -> usize {
        (node * self.channels + channel) as usize
    }

    /// Blocks looked at in search of one to forget, since the last call.
    pub(crate) fn take_searched(&mut self) -> u64 {
        std::mem::take(&mut self.searched)
    }

    /// Counts again what must not be forgotten.
    #[cfg(test)]
    pub(crate) fn check_kept(&self) {
        for (block, at) in self.blocks.iter().zip((0..).step_by(SIBLINGS as usize)) {
            let nodes = || at..at + SIBLINGS;
            let residents = nodes().flat_map(|node| (0..self.channels).map(move |c| (node, c)));
            let residents = residents.filter(|(node, c)| self.known(*node, *c).resident != 0);
            let parents = nodes().filter(|node| self.children(*node).is_some());
            let kept = residents.count() + parents.count();
            assert!(
                !block.in_use || kept == usize::from(block.kept),
                "{block:?}"
            );
        }
    }

    /// All of it, as the device is to have it.
    #[cfg(test)]
    pub(crate) fn as_uploaded(&self) -> (&[Texel], &[u32]) {
        (&self.texels, &self.resident)
    }
}

fn texel(values: Values, valid: u32, children: u32) -> Texel {
    let mut texel = [0; NODE_WORDS as usize];
    texel[NODE_BINS as usize] = values.bins;
    texel[NODE_RANGE as usize] = values.range_word();
    texel[NODE_VALID as usize] = valid;
    texel[NODE_CHILDREN as usize] = children;
    texel
}
