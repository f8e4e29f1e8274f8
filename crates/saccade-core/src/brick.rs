//! Bricks and their ids \[000 §4.2.2\].

use std::fmt;

use glam::UVec3;
use serde::{Deserialize, Serialize};

use crate::levels::Level;
use crate::voxel_box::VoxelBox;

/// Edge of a brick without its border \[voxels\].
pub const BRICK_EDGE: u32 = 32;
/// Voxels of the neighbours that a brick carries on each side, for interpolation.
pub const BRICK_BORDER: u32 = 1;
/// Edge of a brick as stored, with its border \[voxels\].
pub const BRICK_STORED_EDGE: u32 = BRICK_EDGE + 2 * BRICK_BORDER;
/// Voxels of a brick as stored.
pub const BRICK_STORED_VOXELS: usize = (BRICK_STORED_EDGE as usize).pow(3);

const SPATIAL_BITS: u32 = 16;
const LEVEL_BITS: u32 = 5;
const CHANNEL_BITS: u32 = 64 - 3 * SPATIAL_BITS - LEVEL_BITS;

/// Levels a volume can have.
pub const MAX_LEVELS: usize = 1 << LEVEL_BITS;
/// Channels a volume can have.
pub const MAX_CHANNELS: usize = 1 << CHANNEL_BITS;
/// Bricks an axis can have; 65,536 of them reach past 888 PB volumes.
pub const MAX_BRICKS_PER_AXIS: u32 = 1 << SPATIAL_BITS;

/// Names one brick of a volume: channel, level and position, in 64 bits.
///
/// Ids order by channel, level, then z, y, x.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct BrickId(u64);

/// A part of a brick address does not fit its field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no brick id can hold channel {channel}, level {level}, brick {brick}")]
pub struct BrickIdError {
    /// Channel asked for; below [`MAX_CHANNELS`] fits.
    pub channel: u32,
    /// Level asked for; below [`MAX_LEVELS`] fits.
    pub level: u32,
    /// Position asked for; below [`MAX_BRICKS_PER_AXIS`] on each axis fits.
    pub brick: UVec3,
}

impl BrickId {
    /// The id of the brick at `brick` \[bricks of the level\].
    ///
    /// # Errors
    ///
    /// Any part too large for its field: ids are checked, never wrapped.
    pub fn new(channel: u32, level: u32, brick: UVec3) -> Result<Self, BrickIdError> {
        let fits = (channel as usize) < MAX_CHANNELS
            && (level as usize) < MAX_LEVELS
            && brick.max_element() < MAX_BRICKS_PER_AXIS;
        if !fits {
            return Err(BrickIdError {
                channel,
                level,
                brick,
            });
        }
        let mut bits = u64::from(channel);
        bits = bits << LEVEL_BITS | u64::from(level);
        for part in [brick.z, brick.y, brick.x] {
            bits = bits << SPATIAL_BITS | u64::from(part);
        }
        Ok(Self(bits))
    }

    fn field(self, shift: u32, bits: u32) -> u32 {
        let value = self.0 >> shift & ((1 << bits) - 1);
        u32::try_from(value).unwrap_or_else(|_| unreachable!("fields have at most 16 bits"))
    }

    /// Channel.
    pub fn channel(self) -> u32 {
        self.field(3 * SPATIAL_BITS + LEVEL_BITS, CHANNEL_BITS)
    }

    /// Level.
    pub fn level(self) -> u32 {
        self.field(3 * SPATIAL_BITS, LEVEL_BITS)
    }

    /// Position \[bricks of the level\].
    pub fn brick(self) -> UVec3 {
        let axis = |n| self.field(n * SPATIAL_BITS, SPATIAL_BITS);
        UVec3::new(axis(0), axis(1), axis(2))
    }

    /// Voxels the brick holds \[voxels of its level\], without border, cut at the level's end.
    pub fn voxels(self, level: &Level) -> VoxelBox {
        let min = self.brick() * BRICK_EDGE;
        VoxelBox::new(min, (min + BRICK_EDGE).min(level.extent))
    }
}

impl fmt::Debug for BrickId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "BrickId({self})")
    }
}

impl fmt::Display for BrickId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "channel {} level {} brick {}",
            self.channel(),
            self.level(),
            self.brick()
        )
    }
}

/// Bricks per axis that cover `extent` voxels.
pub fn bricks_of(extent: UVec3) -> UVec3 {
    (extent + (BRICK_EDGE - 1)) / BRICK_EDGE
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CHANNELS: u32 = 1 << CHANNEL_BITS;
    const LEVELS: u32 = 1 << LEVEL_BITS;

    proptest! {
        #[test]
        fn ids_are_reversible(
            channel in 0..CHANNELS,
            level in 0..LEVELS,
            x in 0..MAX_BRICKS_PER_AXIS,
            y in 0..MAX_BRICKS_PER_AXIS,
            z in 0..MAX_BRICKS_PER_AXIS,
        ) {
            let id = BrickId::new(channel, level, UVec3::new(x, y, z)).unwrap();
            prop_assert_eq!((id.channel(), id.level()), (channel, level));
            prop_assert_eq!(id.brick(), UVec3::new(x, y, z));
        }
    }

    #[test]
    fn ids_never_wrap() {
        assert!(BrickId::new(CHANNELS, 0, UVec3::ZERO).is_err());
        assert!(BrickId::new(0, LEVELS, UVec3::ZERO).is_err());
        assert!(BrickId::new(0, 0, UVec3::new(0, 1 << 16, 0)).is_err());
        let largest = BrickId::new(0, 0, UVec3::new(62_499, 62_499, 7_812));
        assert!(
            largest.is_ok(),
            "the 888 PB volume of Table 1 is addressable"
        );
    }
}
