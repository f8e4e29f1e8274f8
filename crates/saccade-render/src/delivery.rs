//! Bricks on their way in.

use saccade_core::brick::BrickId;

/// What a delivered brick holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BrickVoxels<'a> {
    /// The voxels with their border, as measured, x fastest, little-endian:
    /// [`BRICK_STORED_VOXELS`](saccade_core::brick::BRICK_STORED_VOXELS) values of the volume's type.
    Voxels(&'a [u8]),
    /// Nothing was acquired there.
    Empty,
}

/// What became of a delivered brick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The next frame draws it.
    Resident,
    /// The next frame knows that nothing is there.
    Empty,
    /// Everything in memory is in use. Draw on: the frames that follow become coarser until they
    /// fit, and ask for the brick again if they still want it.
    NoRoom,
}

/// A brick that cannot be taken: the caller's mistake.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DeliveryError {
    /// The volume has no such brick.
    #[error("the volume has no {id}")]
    NoSuchBrick {
        /// As given.
        id: BrickId,
    },
    /// Too few or too many voxels.
    #[error("{id} came with {got} bytes instead of {expected}")]
    Length {
        /// As given.
        id: BrickId,
        /// Bytes given.
        got: usize,
        /// Bytes of a brick with its border.
        expected: usize,
    },
}

/// Whether a brick still is what the volume holds, as far as whoever delivers it knows.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Freshness {
    Current,
    Outdated,
}
