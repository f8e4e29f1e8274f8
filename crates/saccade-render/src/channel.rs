//! What is seen of a volume's channels.

use std::ops::RangeInclusive;

use saccade_core::transfer::TransferFunction;

use crate::layout::MOST_CHANNELS;

/// How one channel is seen.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelView {
    /// Which of the volume's.
    pub channel: u32,
    /// Colours and opacities.
    pub transfer: TransferFunction,
    /// Value of the surface where surfaces are drawn, `[0, 1]` of the value type's range: structures
    /// on the side of [`TransferFunction::polarity`] are inside.
    pub iso: f32,
    /// Levels that are drawn, 0 the finest; wanted ones outside are replaced by the nearest inside.
    pub levels: RangeInclusive<u32>,
    /// Levels coarser than others that suffice, and that its bricks may come later: 0 for a channel as
    /// important as any.
    pub coarser: u32,
    /// Bits that nearly all measured values of a 16-bit channel fit in, 8 to 16. Only how much can be
    /// skipped depends on it.
    pub significant_bits: u32,
}

impl ChannelView {
    /// A channel at all levels, as important as any.
    pub fn new(channel: u32, transfer: TransferFunction) -> Self {
        Self {
            channel,
            transfer,
            iso: 0.5,
            levels: 0..=u32::MAX,
            coarser: 0,
            significant_bits: 16,
        }
    }
}

/// Channels that cannot be seen together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChannelError {
    /// The volume has fewer.
    #[error("there is no channel {channel}; the volume has {channels}, counted from 0")]
    NoSuchChannel {
        /// As asked for.
        channel: u32,
        /// How many there are.
        channels: u32,
    },
    /// The same channel twice.
    #[error("channel {channel} is named twice")]
    Twice {
        /// Which.
        channel: u32,
    },
    /// More than can be drawn.
    #[error("{got} channels are too many to be seen at once; show {most} at most")]
    TooMany {
        /// How many were asked for.
        got: usize,
        /// How many can be.
        most: usize,
    },
    /// More than there is memory for, even where each is drawn from its coarsest level.
    #[error(
        "{got} channels do not fit {ceiling} bytes of GPU memory together; allow {needed} or more, or show {most} at most"
    )]
    Memory {
        /// How many were asked for.
        got: usize,
        /// How many fit.
        most: usize,
        /// The ceiling in force \[bytes\].
        ceiling: u64,
        /// One that would do \[bytes\].
        needed: u64,
    },
}

/// Whether these can be seen together.
pub(crate) fn check(views: &[ChannelView], channels: u32) -> Result<(), ChannelError> {
    let got = views.len();
    if got > MOST_CHANNELS {
        let most = MOST_CHANNELS;
        return Err(ChannelError::TooMany { got, most });
    }
    for (index, view) in views.iter().enumerate() {
        let channel = view.channel;
        if channel >= channels {
            return Err(ChannelError::NoSuchChannel { channel, channels });
        }
        if views[..index].iter().any(|other| other.channel == channel) {
            return Err(ChannelError::Twice { channel });
        }
    }
    Ok(())
}
