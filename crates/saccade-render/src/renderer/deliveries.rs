//! Bricks that come, change, or are known before they come.

use saccade_core::brick::{BRICK_STORED_VOXELS, BrickId};
use saccade_core::volume::Polarity;
use saccade_core::voxel_box::VoxelBox;

use super::Renderer;
use crate::delivery::{BrickVoxels, Delivery, DeliveryError, Freshness};
use crate::memory::Placement;
use crate::octree::{BrickValues, Values};
use crate::stored_brick::StoredBrick;
use crate::transfer_table::largest;

impl Renderer {
    /// Takes a brick. The next frame draws it.
    ///
    /// Each brick is 39 kB on its way to the device: bound how many come between two frames.
    ///
    /// # Errors
    ///
    /// [`DeliveryError`] when the brick is not one of this volume's or has the wrong size.
    pub fn deliver(
        &mut self,
        id: BrickId,
        voxels: BrickVoxels<'_>,
    ) -> Result<Delivery, DeliveryError> {
        self.take(id, voxels, Freshness::Current)
    }

    /// Takes a brick that changed on its way: the next frame draws it, and misses it again.
    ///
    /// # Errors
    ///
    /// As [`Self::deliver`].
    pub fn deliver_outdated(
        &mut self,
        id: BrickId,
        voxels: BrickVoxels<'_>,
    ) -> Result<Delivery, DeliveryError> {
        self.take(id, voxels, Freshness::Outdated)
    }

    fn take(
        &mut self,
        id: BrickId,
        voxels: BrickVoxels<'_>,
        freshness: Freshness,
    ) -> Result<Delivery, DeliveryError> {
        if !self.memory.contains(id) {
            return Err(DeliveryError::NoSuchBrick { id });
        }
        let stored = match voxels {
            BrickVoxels::Voxels(raw) => {
                let dtype = self.volume.dtype;
                let (got, expected) = (raw.len(), BRICK_STORED_VOXELS * dtype.bytes());
                if got != expected {
                    return Err(DeliveryError::Length { id, got, expected });
                }
                let polarity = self.polarity[id.channel() as usize];
                Some(StoredBrick::new(raw, dtype, polarity))
            }
            BrickVoxels::Empty => None,
        };
        // Voxels of which none was acquired are as good as none.
        let placement = match &stored {
            Some(brick) if brick.range[1] > 0 => self.memory.place(id),
            _ => self.memory.place_empty(id),
        };
        if freshness == Freshness::Outdated {
            self.memory.invalidate_brick(id);
        }
        self.note(id, placement, stored.as_ref(), freshness);
        Ok(match (placement, stored) {
            (Placement::Slot(slot), Some(brick)) => {
                self.resources.write_brick(&self.gpu, slot, &brick);
                Delivery::Resident
            }
            (Placement::NoRoom, _) => {
                if self.wanted.contains(&id) {
                    self.pressure.refuse();
                }
                Delivery::NoRoom
            }
            (Placement::Slot(_) | Placement::Empty, _) => Delivery::Empty,
        })
    }

    /// Tells the octree of a delivered brick and of what it displaced.
    fn note(
        &mut self,
        id: BrickId,
        placement: Placement,
        stored: Option<&StoredBrick<'_>>,
        freshness: Freshness,
    ) {
        self.note_evicted();
        let Some(octree) = &mut self.octree else {
            return;
        };
        // Values that no longer hold would hide what came instead of them.
        let current = freshness == Freshness::Current;
        let values = match stored {
            _ if !current => None,
            Some(brick) => octree.values_of(id, &brick.voxels),
            None => Some(BrickValues::uniform(Values::ZERO)),
        };
        match (placement, values) {
            (Placement::Slot(_), values) => octree.insert(id, values),
            // What is known of a brick outlives it, even one that found no room.
            (Placement::Empty | Placement::NoRoom, Some(values)) => octree.note(id, values),
            (Placement::Empty | Placement::NoRoom, None) => {}
        }
    }

    /// Tells the octree which bricks have lost their slots.
    pub(super) fn note_evicted(&mut self) {
        for evicted in self.memory.take_evicted() {
            if let Some(octree) = &mut self.octree {
                octree.remove(evicted);
            }
        }
    }

    /// Notes that measured voxels of a brick and its border are `min` to `max`, which a source may
    /// know before the brick is built. Some of its voxels may not have been acquired.
    ///
    /// Returns whether the transfer function hides all of that: as a rule, frames from the next one
    /// on do without the brick. One that asks for it again needs it, since what is known of
    /// different levels mixes. Always `false` without a residency octree.
    pub fn note_range(&mut self, id: BrickId, [min, max]: [u16; 2]) -> bool {
        let Some(octree) = self.octree.as_mut().filter(|_| self.memory.contains(id)) else {
            return false;
        };
        let Some(bins) = octree.bins_of(id.channel()) else {
            return false;
        };
        // Not acquired is stored as 0, and interpolation reaches everything from there on.
        let stored = match self.polarity[id.channel() as usize] {
            Polarity::Bright => max,
            Polarity::Dark if max == 0 => 0,
            Polarity::Dark => {
                let inverted = u32::from(largest(self.volume.dtype)) + 1 - u32::from(min.max(1));
                u16::try_from(inverted).unwrap_or(u16::MAX)
            }
        };
        octree.note(id, BrickValues::uniform(Values::between(0, stored, bins)));
        let mut seen = self.channels.iter();
        let table = seen.find(|(view, _)| view.channel == id.channel());
        table.is_some_and(|(_, table)| table.hides_for_good(0, stored))
    }

    /// Whether there are values of a channel that are not seen, so that it is worth knowing the bounds of a
    /// brick's before it is delivered.
    pub fn may_hide(&self, channel: u32) -> bool {
        let mut seen = self.channels.iter();
        let table = seen.find(|(view, _)| view.channel == channel);
        self.octree.is_some() && table.is_some_and(|(_, table)| table.hides_for_good(0, 1))
    }

    /// Level-0 voxels changed: their bricks are wanted again at all levels.
    ///
    /// Resident ones stay in the picture until their replacement is delivered, and count as missing.
    pub fn invalidate(&mut self, voxels: VoxelBox) {
        self.memory.invalidate(&self.volume.levels, voxels);
        if let Some(octree) = &mut self.octree {
            octree.invalidate(voxels);
        }
    }
}
