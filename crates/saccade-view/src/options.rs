//! What the application opens with.

use saccade_core::camera::Camera;
use saccade_core::transfer::{TransferFunction, linear_from_srgb};
use saccade_render::ChannelError;
use saccade_stream::policy::Limits;
use saccade_stream::{Detail, Session};

use crate::shown::Shown;

/// What the application opens with.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewOptions {
    /// From where; the whole volume from a corner otherwise.
    pub camera: Option<Camera>,
    /// Colours and opacities of the first channel that is seen; following the data otherwise.
    pub transfer: Option<TransferFunction>,
    /// Channels that are seen; the first few otherwise.
    pub channels: Option<Vec<u32>>,
    /// How finely channels are drawn, one or all of them; as the view asks for otherwise.
    pub details: Vec<(Option<u32>, Detail)>,
    /// Which part of the volume, and how.
    pub shown: Shown,
    /// Behind everything, linear RGB in `[0, 1]`.
    pub background: [f32; 3],
    /// Whether there is anything but the picture.
    pub ui: bool,
    /// Ceiling for GPU memory \[bytes\].
    pub gpu_bytes: u64,
    /// Ceiling for chunks in main memory, requests at once and so on.
    pub limits: Limits,
}

impl Default for ViewOptions {
    fn default() -> Self {
        Self {
            camera: None,
            transfer: None,
            channels: None,
            details: Vec::new(),
            shown: Shown::default(),
            background: [0.0; 3],
            ui: true,
            gpu_bytes: 512 << 20,
            limits: Limits::default(),
        }
    }
}

/// Shows these channels of a session and no others, if any are named; the first of them with these
/// colours and opacities, if any are.
///
/// # Errors
///
/// [`ChannelError`] for channels that the volume does not have, or too many.
pub fn show_channels(
    session: &mut Session,
    channels: Option<&[u32]>,
    transfer: Option<TransferFunction>,
) -> Result<(), ChannelError> {
    if let Some(channels) = channels {
        // Hidden first: never are too many seen on the way.
        for (index, channel) in (0..).zip(session.channels().to_vec()) {
            if channel.visible && !channels.contains(&index) {
                session.set_visible(index, false)?;
            }
        }
        for &channel in channels {
            session.set_visible(channel, true)?;
        }
    }
    if let Some(transfer) = transfer {
        let first = channels.and_then(|channels| channels.first());
        session.set_transfer_function(first.copied().unwrap_or(0), transfer)?;
    }
    Ok(())
}

/// Draws channels so finely, later wishes after earlier ones; `None` stands for all of them.
///
/// # Errors
///
/// [`ChannelError`] for channels that the volume does not have.
pub fn set_details(
    session: &mut Session,
    details: &[(Option<u32>, Detail)],
) -> Result<(), ChannelError> {
    let all = u32::try_from(session.channels().len()).unwrap_or(u32::MAX);
    for (channel, detail) in details {
        for channel in channel.map_or(0..all, |channel| channel..channel.saturating_add(1)) {
            session.set_detail(channel, detail.clone())?;
        }
    }
    Ok(())
}

/// Text that names no colour.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("background {text:?} is not #rrggbb")]
pub struct BackgroundError {
    /// As given.
    pub text: String,
}

/// Linear RGB from `#rrggbb` in sRGB; the `#` may be missing.
///
/// # Errors
///
/// [`BackgroundError`] on anything else.
pub fn background_from_text(text: &str) -> Result<[f32; 3], BackgroundError> {
    let error = || BackgroundError {
        text: text.to_owned(),
    };
    let digits = text.trim().trim_start_matches('#');
    if digits.len() != 6 || !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Err(error());
    }
    let mut linear = [0.0; 3];
    for (part, at) in linear.iter_mut().zip([0, 2, 4]) {
        let value = u8::from_str_radix(&digits[at..at + 2], 16).map_err(|_| error())?;
        *part = linear_from_srgb(f32::from(value) / 255.0);
    }
    Ok(linear)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backgrounds_are_hexadecimal_srgb() {
        assert_eq!(background_from_text("#000000"), Ok([0.0; 3]));
        assert_eq!(background_from_text("ffFFff"), Ok([1.0; 3]));
        let [r, g, b] = background_from_text("#808000").unwrap();
        assert!((r - 0.2159).abs() < 1e-3 && r == g && b == 0.0);
        for bad in ["", "white", "#fff", "#12345g", "#1234567", "+1+2+3", "日本"] {
            assert!(background_from_text(bad).is_err(), "{bad:?}");
        }
    }
}
