//! How each channel of a volume is shown.

use saccade_core::transfer::{ColorMap, Histogram, TransferFunction};
use saccade_core::volume::{Polarity, Volume, VoxelKind};
use saccade_render::ChannelView;

use crate::detail::Detail;

/// Channels shown at first, of a volume that has more and does not say which.
const SHOWN_AT_FIRST: usize = 4;
/// Channels shown at first at most, where the volume says which.
const MOST_AT_FIRST: usize = 16;

/// How a channel is shown.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// Its name, as the volume has it.
    pub name: String,
    /// Whether it is seen.
    pub visible: bool,
    /// Its values, as far as a few chunks tell. Follows changes while it is seen.
    pub histogram: Histogram,
    /// Colours and opacities.
    pub transfer: TransferFunction,
    /// Whether they follow the histogram.
    pub automatic: bool,
    /// Value of the surface where surfaces are drawn, `[0, 1]`; `None` follows the opacities.
    pub iso: Option<f32>,
    /// How finely it is drawn.
    pub detail: Detail,
    /// The finest level that its values need, as far as the bricks that arrived tell; looked for with
    /// [`Detail::ByContent`].
    pub finest_needed: u32,
}

impl Channel {
    /// Value of the surface where surfaces are drawn, `[0, 1]`.
    pub fn iso_value(&self) -> f32 {
        let corners = &self.transfer.opacity;
        let ends = corners.first().zip(corners.last());
        let middle = ends.map_or(0.5, |(first, last)| (first.value + last.value) / 2.0);
        self.iso.unwrap_or(middle)
    }

    /// Colours and opacities for channel `index` of `volume`: as the volume says, and else as suits the histogram.
    fn suggested(&self, volume: &Volume, index: usize) -> TransferFunction {
        let mut transfer = self.suiting(volume, index);
        let look = volume.look(index);
        if let Some(color) = look.color {
            transfer.color_map = ColorMap::to_color(color);
        }
        if let Some([low, high]) = look.window {
            transfer.window = [low, high];
            // Whoever chose the window for sections chose no opacity: what is bright in it is opaque, and what the
            // histogram takes for background stays transparent.
            if transfer.polarity == Polarity::Bright
                && let [first, last] = &mut transfer.opacity[..]
            {
                let most = low + 0.875 * (high - low);
                first.value = first.value.clamp(low, most);
                last.value = high;
            }
        }
        transfer
    }

    /// Colours and opacities that suit the histogram.
    fn suiting(&self, volume: &Volume, index: usize) -> TransferFunction {
        let size_nm = volume.size_nm();
        if volume.kind == VoxelKind::Labels {
            return self.histogram.transfer_function_of_labels(size_nm);
        }
        if volume.channels.len() == 1 {
            return self.histogram.transfer_function(size_nm);
        }
        // Stains are bright, each in a colour of its own.
        let index = u32::try_from(index).unwrap_or(u32::MAX);
        TransferFunction {
            color_map: ColorMap::of_channel(index),
            ..self
                .histogram
                .transfer_function_of(Polarity::Bright, size_nm)
        }
    }

    /// Sets colours and opacities as the histogram suggests.
    pub(crate) fn follow_histogram(&mut self, volume: &Volume, index: usize) {
        self.transfer = self.suggested(volume, index);
        self.automatic = true;
    }
}

/// All channels of a volume as they are shown at first.
pub(crate) fn of_volume(volume: &Volume) -> Vec<Channel> {
    let seen = shown_at_first(volume);
    let channel = |(index, name): (usize, &String)| {
        let number = u32::try_from(index).unwrap_or(u32::MAX);
        let histogram = Histogram::new(volume.dtype);
        let mut channel = Channel {
            name: name.clone(),
            visible: seen.contains(&number),
            transfer: histogram.transfer_function(volume.size_nm()),
            histogram,
            automatic: true,
            iso: None,
            detail: Detail::Full,
            finest_needed: 0,
        };
        channel.follow_histogram(volume, index);
        channel
    };
    volume.channels.iter().enumerate().map(channel).collect()
}

/// Channels that are shown at first: those that the volume does not hide, or the first few of them.
pub fn shown_at_first(volume: &Volume) -> Vec<u32> {
    let open = (0..volume.channels.len()).filter(|index| !volume.look(*index).hidden);
    let open: Vec<usize> = open.collect();
    let chosen = open.len() < volume.channels.len() && open.len() <= MOST_AT_FIRST;
    let most = if chosen {
        MOST_AT_FIRST
    } else {
        SHOWN_AT_FIRST
    };
    let numbers = open
        .into_iter()
        .map(|index| u32::try_from(index).unwrap_or(u32::MAX));
    numbers.take(most).collect()
}

/// Those that are seen, as renderers take them.
pub(crate) fn views(channels: &[Channel]) -> Vec<ChannelView> {
    let seen = (0..).zip(channels).filter(|(_, channel)| channel.visible);
    let views = seen.map(|(index, channel)| {
        let (levels, coarser) = match &channel.detail {
            Detail::Full => (0..=u32::MAX, 0),
            Detail::ByContent => (channel.finest_needed..=u32::MAX, 0),
            Detail::Chosen { levels, coarser } => (levels.clone(), *coarser),
        };
        ChannelView {
            iso: channel.iso_value(),
            levels,
            coarser,
            significant_bits: channel.histogram.significant_bits(),
            ..ChannelView::new(index, channel.transfer.clone())
        }
    });
    views.collect()
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, UVec3};
    use saccade_core::volume::Look;

    use super::*;

    fn volume(channels: usize) -> Volume {
        let volume = Volume::new("v", UVec3::splat(40), DVec3::ONE).unwrap();
        let names = (0..channels).map(|n| format!("c{n}"));
        Volume {
            channels: names.collect(),
            ..volume
        }
    }

    #[test]
    fn many_channels_are_bright_in_colours_of_their_own() {
        let channels = of_volume(&volume(9));
        assert_eq!(views(&channels).len(), SHOWN_AT_FIRST);
        let maps = channels.iter().map(|c| c.transfer.color_map);
        let maps: Vec<_> = maps.take(6).collect();
        for (index, map) in maps.iter().enumerate() {
            assert!(!maps[..index].contains(map), "{map:?} twice");
        }
        assert!(
            channels
                .iter()
                .all(|c| c.transfer.polarity == Polarity::Bright)
        );
        let single = of_volume(&volume(1));
        assert_eq!(single[0].transfer.color_map, ColorMap::Gray);
    }

    #[test]
    fn what_the_volume_says_of_a_channel_is_kept_while_the_histogram_changes() {
        let look = |color, window, hidden| Look {
            color,
            window,
            hidden,
        };
        let mut volume = volume(6);
        volume.looks = vec![
            look(Some([255, 128, 0]), Some([0.25, 0.5]), false),
            look(Some([0, 0, 255]), None, true),
        ];
        let mut channels = of_volume(&volume);
        let seen: Vec<u32> = views(&channels).iter().map(|view| view.channel).collect();
        assert_eq!(seen, [0, 2, 3, 4, 5], "all but what is hidden");
        assert_eq!(channels[1].transfer.color_map, ColorMap::Color([0, 0, 255]));
        assert_eq!(channels[2].transfer.color_map, ColorMap::of_channel(2));
        // Background at 10, signal at 100 of 255.
        channels[0].histogram.add(&[10; 900]);
        channels[0].histogram.add(&[100; 90]);
        channels[0].follow_histogram(&volume, 0);
        let transfer = &channels[0].transfer;
        assert_eq!(transfer.color_map, ColorMap::Color([255, 128, 0]));
        assert_eq!(transfer.window, [0.25, 0.5]);
        assert_eq!(transfer.opacity_at(0.2), 0.0);
        assert!(transfer.opacity_at(0.4) > 0.3 && transfer.opacity_at(0.5) > 0.8);
        // Background that reaches into the window stays transparent as well.
        channels[0].histogram.add(&[90; 5000]);
        channels[0].follow_histogram(&volume, 0);
        assert_eq!(channels[0].transfer.opacity_at(0.34), 0.0);
        assert!(channels[0].transfer.opacity_at(0.5) > 0.8);
        let mut single = volume.clone();
        single.channels.truncate(1);
        single.looks.truncate(1);
        let channel = of_volume(&single).remove(0);
        assert_eq!(channel.transfer.window, [0.25, 0.5]);
    }

    #[test]
    fn surfaces_follow_the_opacities_until_somebody_says_otherwise() {
        let mut channel = of_volume(&volume(1)).remove(0);
        channel.histogram.add(&[40; 900]);
        channel.histogram.add(&[200; 90]);
        channel.follow_histogram(&volume(1), 0);
        let middle = channel.iso_value();
        assert!(channel.transfer.opacity[0].value < middle);
        channel.iso = Some(0.9);
        assert_eq!(channel.iso_value(), 0.9);
    }
}
