//! Virtual memory: which brick is where \[000 §4.1\].
//!
//! A state machine in main memory, without a GPU. The renderer copies what it changed to the device
//! and feeds it what frames report. Every entry, of the directory or of a resident page table block,
//! has a *physical* number: the directory's come first, then those of the page table cache, block
//! after block. Shaders mark misses by that number; the way back to the brick is here.

mod dirty;
mod entry;
pub(crate) mod plan;
pub(crate) mod pressure;
mod slots;
#[cfg(test)]
mod tests;

use glam::UVec3;
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BrickId};
use saccade_core::levels::Level;
use saccade_core::page_table::PageTables;
use saccade_core::voxel_box::VoxelBox;

pub(crate) use dirty::{Array, Dirty};
pub(crate) use entry::Entry;
pub(crate) use slots::Frame;
use slots::Slots;

/// A resident page table block.
#[derive(Clone, Copy, Debug)]
struct Block {
    /// Physical entry that names it.
    parent: u32,
    channel: u32,
    level: u32,
    /// Its step on the way from the directory, which is step 0.
    step: u32,
    /// First brick under it.
    origin: UVec3,
    /// Entries that lead to bricks of the volume; the others lead past its end.
    within: u32,
    /// Of those, empty ones. When all are, the block is not needed any more.
    empty: u32,
    /// First frame that can have seen it.
    since: Frame,
}

/// A resident brick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Brick {
    /// Physical entry that names it.
    entry: u32,
    id: BrickId,
}

/// Where a delivered brick goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Placement {
    /// Write its voxels to this slot.
    Slot(u32),
    /// Noted as empty.
    Empty,
    /// All slots or all blocks are in use.
    NoRoom,
}

/// What a reported physical entry stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Want {
    /// A brick that is not there.
    Brick(BrickId),
    /// A page table block, which is there now.
    Table,
    /// A page table block for which there is no room.
    NoRoom,
    /// Nothing any more.
    Nothing,
}

/// The page directory, the page table cache and the brick cache's slots.
#[derive(Debug)]
pub(crate) struct VirtualMemory {
    tables: PageTables,
    directory: Vec<Entry>,
    entries: Vec<Entry>,
    blocks: Slots<Block>,
    bricks: Slots<Brick>,
    dirty: Dirty,
    /// Bricks that lost their slot since the last [`Self::take_evicted`].
    evicted: Vec<BrickId>,
    /// The frame that will be drawn next.
    next: Frame,
    /// The latest frame whose use of slots is known; slots it used stay.
    reported: Frame,
    /// The finest level that it wanted.
    finest_wanted: u32,
    /// Neither a brick nor a block is finer and could go.
    no_spare: [bool; 2],
}

impl VirtualMemory {
    /// Everything unmapped.
    pub(crate) fn new(tables: PageTables, blocks: u32, bricks: u32) -> Self {
        let block_entries = tables.shape().block_entries();
        Self {
            directory: vec![Entry::UNMAPPED; tables.directory_entries() as usize],
            entries: vec![Entry::UNMAPPED; blocks as usize * block_entries as usize],
            blocks: Slots::new(blocks),
            bricks: Slots::new(bricks),
            dirty: Dirty::new(blocks),
            evicted: Vec::new(),
            next: 1,
            reported: 0,
            finest_wanted: 0,
            no_spare: [false; 2],
            tables,
        }
    }

    pub(crate) fn tables(&self) -> &PageTables {
        &self.tables
    }

    /// `(resident, slots)` of bricks.
    pub(crate) fn bricks(&self) -> (u32, u32) {
        (self.bricks.len(), self.bricks.capacity())
    }

    /// `(resident, slots)` of page table blocks.
    pub(crate) fn blocks(&self) -> (u32, u32) {
        (self.blocks.len(), self.blocks.capacity())
    }

    /// Hands out what changed since the last call: array, first entry, entries.
    pub(crate) fn flush(&mut self, mut upload: impl FnMut(Array, u32, &[Entry])) {
        let block_entries = self.tables.shape().block_entries();
        for (array, range) in self.dirty.take(block_entries) {
            let entries = match array {
                Array::Directory => &self.directory,
                Array::Tables => &self.entries,
            };
            upload(
                array,
                range.start,
                &entries[range.start as usize..range.end as usize],
            );
        }
    }

    /// A frame was submitted; what is delivered from now on is seen by the one after it.
    pub(crate) fn frame_submitted(&mut self) {
        self.next += 1;
    }

    /// The next frame's number.
    pub(crate) fn next_frame(&self) -> Frame {
        self.next
    }

    /// Slots used by a frame: a bit per brick slot, then per block. Returns how many
    /// `(bricks, blocks)`.
    pub(crate) fn note_usage(&mut self, frame: Frame, usage: &[u32]) -> (u32, u32) {
        self.reported = self.reported.max(frame);
        let (mut bricks, mut blocks) = (0, 0);
        for (word, &bits) in (0_u32..).zip(usage) {
            let mut bits = bits;
            while bits != 0 {
                let slot = word * 32 + bits.trailing_zeros();
                bits &= bits - 1;
                if let Some(block) = slot.checked_sub(self.bricks.capacity()) {
                    self.blocks.touch(block, frame);
                    blocks += 1;
                } else {
                    self.bricks.touch(slot, frame);
                    bricks += 1;
                }
            }
        }
        (bricks, blocks)
    }

    /// The finest level that the latest frame wanted. What is finer stands in for something, at best.
    pub(crate) fn note_finest(&mut self, level: u32) {
        self.finest_wanted = level;
        self.no_spare = [false; 2];
    }

    /// What an entry that a frame stumbled on stands for. Adds the missing table if it `may`.
    pub(crate) fn want(&mut self, frame: Frame, physical: u32, may_add: bool) -> Want {
        let Some((origin, channel, level, step)) = self.locate(frame, physical) else {
            return Want::Nothing;
        };
        if !self.get(physical).is_wanted() {
            return Want::Nothing;
        }
        let Ok(id) = BrickId::new(channel, level, origin) else {
            return Want::Nothing;
        };
        if !self.contains(id) {
            Want::Nothing
        } else if step + 1 == self.tables.shape().depth {
            Want::Brick(id)
        } else if !may_add {
            Want::Nothing
        } else if self.add_block(physical, id, step + 1).is_some() {
            Want::Table
        } else {
            Want::NoRoom
        }
    }

    /// Bricks that lost their slot since the last call, in order.
    pub(crate) fn take_evicted(&mut self) -> std::vec::Drain<'_, BrickId> {
        self.evicted.drain(..)
    }

    /// Whether the volume has such a brick.
    pub(crate) fn contains(&self, id: BrickId) -> bool {
        let level = self.tables.levels().get(id.level() as usize);
        let channels = self.tables.directory_entries() / self.tables.entries_per_channel();
        level.is_some_and(|l| id.brick().cmplt(l.bricks).all()) && id.channel() < channels
    }

    /// Maps a brick with voxels. The slot is this brick's until it is evicted.
    pub(crate) fn place(&mut self, id: BrickId) -> Placement {
        let Some(entry) = self.walk(id, true) else {
            return Placement::NoRoom;
        };
        let slot = match self.get(entry).slot() {
            Some(slot) => slot,
            None => match self.add_brick(Brick { entry, id }) {
                Some(slot) => slot,
                None => return Placement::NoRoom,
            },
        };
        self.bricks.touch(slot, self.next);
        self.set(entry, Entry::of_slot(slot));
        Placement::Slot(slot)
    }

    /// Notes that a brick holds nothing.
    pub(crate) fn place_empty(&mut self, id: BrickId) -> Placement {
        if self.resolve(id) == Entry::EMPTY {
            return Placement::Empty;
        }
        let Some(entry) = self.walk(id, true) else {
            return Placement::NoRoom;
        };
        if let Some(slot) = self.get(entry).slot() {
            self.remove_brick(slot);
        }
        self.set(entry, Entry::EMPTY);
        self.fold(entry);
        Placement::Empty
    }

    /// Marks what a box of level-0 voxels touches as out of date, at all levels.
    pub(crate) fn invalidate(&mut self, levels: &[Level], voxels: VoxelBox) {
        for (index, level) in (0_u32..).zip(levels) {
            let touched = level.box_from_voxels(voxels).grown(BRICK_BORDER);
            let touched = touched.intersection(VoxelBox::of_size(level.extent));
            if touched.is_empty() {
                continue;
            }
            let bricks =
                VoxelBox::new(touched.min / BRICK_EDGE, (touched.max - 1) / BRICK_EDGE + 1);
            self.invalidate_blocks(index, bricks);
            self.invalidate_directory(index, bricks);
        }
    }

    /// Marks one brick as out of date, whatever is known of it.
    pub(crate) fn invalidate_brick(&mut self, id: BrickId) {
        if let Some(entry) = self.walk(id, true) {
            self.set(entry, self.get(entry).stale());
            return;
        }
        // No room to tell this brick from its neighbours: nothing is known of all of them.
        let mut at = self.tables.directory_index(id);
        for step in 1..self.tables.shape().depth {
            let Some(block) = self.get(at).slot() else {
                break;
            };
            at = self.physical(block, self.tables.entry_in_block(id, step));
        }
        if self.get(at) == Entry::EMPTY {
            self.set(at, Entry::UNMAPPED);
        }
    }

    /// Drops every brick of a channel. What is known to be empty stays so.
    pub(crate) fn drop_bricks(&mut self, channel: u32) {
        for slot in 0..self.bricks.capacity() {
            let owner = self.bricks.owner(slot);
            if owner.is_some_and(|brick| brick.id.channel() == channel) {
                self.evict_brick(slot);
            }
        }
    }

    /// The resident bricks of a channel.
    pub(crate) fn resident(&self, channel: u32) -> impl Iterator<Item = BrickId> {
        let ids = self.bricks.iter().map(|(_, brick)| brick.id);
        ids.filter(move |id| id.channel() == channel)
    }

    /// The entry a shader ends at on the way to a brick.
    pub(crate) fn resolve(&self, id: BrickId) -> Entry {
        let mut entry = self.get(self.tables.directory_index(id));
        for step in 1..self.tables.shape().depth {
            let Some(block) = entry.slot() else { break };
            entry = self.get(self.physical(block, self.tables.entry_in_block(id, step)));
        }
        entry
    }

    /// The physical entry of a brick, through blocks that are there or, if asked for, made.
    fn walk(&mut self, id: BrickId, make: bool) -> Option<u32> {
        let mut at = self.tables.directory_index(id);
        for step in 1..self.tables.shape().depth {
            let block = match self.get(at).slot() {
                Some(block) => block,
                None if make => self.add_block(at, id, step)?,
                None => return None,
            };
            // Keeps the blocks above from being evicted for the ones below.
            self.blocks.touch(block, self.next);
            at = self.physical(block, self.tables.entry_in_block(id, step));
        }
        Some(at)
    }

    fn add_brick(&mut self, brick: Brick) -> Option<u32> {
        if !self.bricks.has_free() {
            let unused = self.bricks.oldest_unused(self.reported);
            let evicted = unused.or_else(|| self.spare_brick(brick.id.level()))?;
            self.evict_brick(evicted);
        }
        self.bricks.insert(brick, self.next)
    }

    /// A brick that is used, and only stands in for others such as one of this level: else all that is coarser might have no
    /// room for ever.
    fn spare_brick(&mut self, level: u32) -> Option<u32> {
        if self.no_spare[0] {
            return None;
        }
        let finest = self.finest_wanted.min(level);
        let spare = self.bricks.oldest_spare(|brick| brick.id.level() < finest);
        self.no_spare[0] = spare.is_none() && finest == self.finest_wanted;
        spare
    }

    /// The same of page table blocks.
    fn spare_block(&mut self, level: u32) -> Option<u32> {
        if self.no_spare[1] {
            return None;
        }
        let finest = self.finest_wanted.min(level);
        let spare = self.blocks.oldest_spare(|block| block.level < finest);
        self.no_spare[1] = spare.is_none() && finest == self.finest_wanted;
        spare
    }

    fn evict_brick(&mut self, slot: u32) {
        if let Some(brick) = self.remove_brick(slot) {
            self.set(brick.entry, Entry::UNMAPPED);
        }
    }

    fn remove_brick(&mut self, slot: u32) -> Option<Brick> {
        let brick = self.bricks.remove(slot)?;
        self.evicted.push(brick.id);
        Some(brick)
    }

    /// Puts a block of unknown entries, or of empty ones where that was known, under an entry.
    fn add_block(&mut self, parent: u32, id: BrickId, step: u32) -> Option<u32> {
        if !self.blocks.has_free() {
            let unused = self.blocks.oldest_unused(self.reported);
            let evicted = unused.or_else(|| self.spare_block(id.level()))?;
            self.evict_block(evicted);
        }
        let shape = self.tables.shape();
        let per_entry = shape.block_edge.pow(shape.depth - 1 - step);
        let bricks_under = per_entry * shape.block_edge;
        let origin = id.brick() / bricks_under * bricks_under;
        let rest = self.tables.levels()[id.level() as usize].bricks - origin;
        let within = rest
            .min(UVec3::splat(bricks_under))
            .map(|n| n.div_ceil(per_entry));
        let within = within.element_product();
        let (content, empty) = match self.get(parent) {
            Entry::EMPTY => (Entry::EMPTY, within),
            _ => (Entry::UNMAPPED, 0),
        };
        let block = Block {
            parent,
            channel: id.channel(),
            level: id.level(),
            step,
            origin,
            within,
            empty,
            since: self.next,
        };
        let slot = self.blocks.insert(block, self.next)?;
        let first = slot as usize * shape.block_entries() as usize;
        self.entries[first..][..shape.block_entries() as usize].fill(content);
        self.dirty.block(slot, 0..shape.block_entries());
        self.set(parent, Entry::of_slot(slot));
        Some(slot)
    }

    /// Takes a block and all under it out of memory. Used longest ago, so was all under it.
    fn evict_block(&mut self, slot: u32) {
        let Some(block) = self.blocks.remove(slot) else {
            return;
        };
        self.set(block.parent, Entry::UNMAPPED);
        let leaf = block.step + 1 == self.tables.shape().depth;
        for entry in 0..self.tables.shape().block_entries() {
            let Some(below) = self.get(self.physical(slot, entry)).slot() else {
                continue;
            };
            if leaf {
                self.remove_brick(below);
            } else {
                self.evict_block(below);
            }
        }
    }

    /// Replaces a block of empty entries by one empty entry above, as far up as that goes.
    fn fold(&mut self, entry: u32) {
        let Some(slot) = self.block_of(entry) else {
            return;
        };
        let Some(&block) = self.blocks.owner(slot) else {
            return;
        };
        if block.empty == block.within {
            self.blocks.remove(slot);
            self.set(block.parent, Entry::EMPTY);
            self.fold(block.parent);
        }
    }

    fn invalidate_blocks(&mut self, level: u32, bricks: VoxelBox) {
        let shape = self.tables.shape();
        for slot in 0..self.blocks.capacity() {
            let Some(&block) = self.blocks.owner(slot) else {
                continue;
            };
            let per_entry = shape.block_edge.pow(shape.depth - 1 - block.step);
            let covered = per_entry * shape.block_edge;
            let under = VoxelBox::new(
                block.origin,
                block.origin.saturating_add(UVec3::splat(covered)),
            );
            let touched = under.intersection(bricks);
            if block.level != level || touched.is_empty() {
                continue;
            }
            let leaf = block.step + 1 == shape.depth;
            let within = VoxelBox::new(touched.min - block.origin, touched.max - block.origin);
            for cell in within.cells(UVec3::splat(per_entry)) {
                let entry = (cell.z * shape.block_edge + cell.y) * shape.block_edge + cell.x;
                let physical = self.physical(slot, entry);
                match self.get(physical) {
                    entry if leaf => self.set(physical, entry.stale()),
                    Entry::EMPTY => self.set(physical, Entry::UNMAPPED),
                    _ => {}
                }
            }
        }
    }

    fn invalidate_directory(&mut self, level: u32, bricks: VoxelBox) {
        let table = self.tables.levels()[level as usize];
        let per_channel = self.tables.entries_per_channel();
        let channels = self.tables.directory_entries() / per_channel;
        for cell in bricks.cells(UVec3::splat(self.tables.shape().bricks_per_entry())) {
            let flat = (cell.z * table.directory.y + cell.y) * table.directory.x + cell.x;
            for channel in 0..channels {
                let entry = channel * per_channel + table.directory_base + flat;
                if self.get(entry) == Entry::EMPTY {
                    self.set(entry, Entry::UNMAPPED);
                }
            }
        }
    }

    /// First brick under a physical entry, its channel and level, and the entry's step.
    fn locate(&self, frame: Frame, physical: u32) -> Option<(UVec3, u32, u32, u32)> {
        let shape = self.tables.shape();
        let Some(slot) = self.block_of(physical) else {
            return self.locate_in_directory(physical);
        };
        let block = self
            .blocks
            .owner(slot)
            .filter(|block| block.since <= frame)?;
        let entry = (physical - self.tables.directory_entries()) % shape.block_entries();
        let edge = shape.block_edge;
        let cell = UVec3::new(entry % edge, entry / edge % edge, entry / edge / edge);
        let per_entry = edge.pow(shape.depth - 1 - block.step);
        Some((
            block.origin + cell * per_entry,
            block.channel,
            block.level,
            block.step,
        ))
    }

    fn locate_in_directory(&self, entry: u32) -> Option<(UVec3, u32, u32, u32)> {
        let per_channel = self.tables.entries_per_channel();
        let (channel, rest) = (entry / per_channel, entry % per_channel);
        let levels = self.tables.levels();
        let level = levels
            .partition_point(|table| table.directory_base <= rest)
            .checked_sub(1)?;
        let table = levels[level];
        let flat = rest - table.directory_base;
        let size = table.directory;
        let cell = UVec3::new(
            flat % size.x,
            flat / size.x % size.y,
            flat / size.x / size.y,
        );
        let level = u32::try_from(level).ok()?;
        Some((
            cell * self.tables.shape().bricks_per_entry(),
            channel,
            level,
            0,
        ))
    }

    /// The block that a physical entry is in; `None` for the directory's.
    fn block_of(&self, physical: u32) -> Option<u32> {
        let in_cache = physical.checked_sub(self.tables.directory_entries())?;
        Some(in_cache / self.tables.shape().block_entries())
    }

    fn physical(&self, block: u32, entry: u32) -> u32 {
        self.tables.directory_entries() + block * self.tables.shape().block_entries() + entry
    }

    fn get(&self, physical: u32) -> Entry {
        match physical.checked_sub(self.tables.directory_entries()) {
            None => self.directory[physical as usize],
            Some(in_cache) => self.entries[in_cache as usize],
        }
    }

    fn set(&mut self, physical: u32, entry: Entry) {
        let Some(in_cache) = physical.checked_sub(self.tables.directory_entries()) else {
            self.directory[physical as usize] = entry;
            self.dirty.directory(physical);
            return;
        };
        let before = std::mem::replace(&mut self.entries[in_cache as usize], entry);
        let block_entries = self.tables.shape().block_entries();
        let (slot, at) = (in_cache / block_entries, in_cache % block_entries);
        if let Some(block) = self.blocks.owner_mut(slot) {
            block.empty -= u32::from(before == Entry::EMPTY);
            block.empty += u32::from(entry == Entry::EMPTY);
        }
        self.dirty.block(slot, at..at + 1);
    }
}
