//! How the channels of a session are shown.

use saccade_core::transfer::TransferFunction;
use saccade_render::ChannelError;

use super::Session;
use super::memory::with_share_of;
use crate::channels::{self, Channel};
use crate::detail::Detail;

impl Session {
    /// How each channel of the volume is shown.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Shows or hides a channel.
    ///
    /// # Errors
    ///
    /// [`ChannelError`] for a channel that the volume does not have, and when too many would be seen, or more than there is
    /// GPU memory for.
    pub fn set_visible(&mut self, channel: u32, visible: bool) -> Result<(), ChannelError> {
        let before = self.channel_mut(channel)?.visible;
        self.channel_mut(channel)?.visible = visible;
        if let Err(error) = self.put_channels() {
            self.channel_mut(channel)?.visible = before;
            return Err(error);
        }
        if visible && !before {
            // Nobody may have counted its values.
            self.refresh.changed();
        }
        self.is_awaited();
        Ok(())
    }

    /// Sets a channel's colours and opacities; they no longer follow the histogram.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_transfer_function(
        &mut self,
        channel: u32,
        transfer: TransferFunction,
    ) -> Result<(), ChannelError> {
        let of = self.channel_mut(channel)?;
        (of.transfer, of.automatic) = (transfer, false);
        self.put_channels()?;
        self.is_awaited();
        Ok(())
    }

    /// Sets the value of a channel's surface, `[0, 1]`, for where surfaces are drawn; `None` lets it follow the
    /// opacities.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_iso(&mut self, channel: u32, iso: Option<f32>) -> Result<(), ChannelError> {
        self.channel_mut(channel)?.iso = iso;
        self.put_channels()?;
        self.is_awaited();
        Ok(())
    }

    /// Sets how finely a channel is drawn.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_detail(&mut self, channel: u32, detail: Detail) -> Result<(), ChannelError> {
        let of = self.channel_mut(channel)?;
        let by_content = detail == Detail::ByContent;
        (of.detail, of.finest_needed) = (detail, 0);
        if by_content {
            let needed = self.contents[channel as usize].finest_needed();
            self.channel_mut(channel)?.finest_needed = needed;
        }
        self.put_channels()?;
        self.is_awaited();
        Ok(())
    }

    /// Lets a channel's colours and opacities follow the histogram, as they do at first.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_automatic_transfer_function(&mut self, channel: u32) -> Result<(), ChannelError> {
        let volume = self.volume().clone();
        let of = self.channel_mut(channel)?;
        of.follow_histogram(&volume, channel as usize);
        self.put_channels()
    }

    pub(super) fn channel_mut(&mut self, channel: u32) -> Result<&mut Channel, ChannelError> {
        let channels = u32::try_from(self.channels.len()).unwrap_or(u32::MAX);
        let of = self.channels.get_mut(channel as usize);
        of.ok_or(ChannelError::NoSuchChannel { channel, channels })
    }

    /// Somebody waits for the picture, as for another view.
    fn is_awaited(&mut self) {
        self.drawn_view = None;
    }

    /// Tells the renderer how channels are shown, if that changed.
    pub(super) fn put_channels(&mut self) -> Result<(), ChannelError> {
        let views = channels::views(&self.channels);
        if self.views != views {
            let kept_bytes = self.kept_bytes;
            let set = self.renderer.set_channels(&views);
            set.map_err(|error| with_share_of(error, kept_bytes))?;
            self.views = views;
            // What was hidden may be seen, and the renderer may have forgotten what it knew.
            self.told.clear();
            self.dirty = true;
        }
        Ok(())
    }
}
