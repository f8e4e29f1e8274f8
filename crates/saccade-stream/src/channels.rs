//! How each channel of a volume is shown.

use saccade_core::transfer::{ColorMap, Histogram, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_render::ChannelView;

use crate::detail::Detail;

/// Channels shown at first, of a volume that has more.
const SHOWN_AT_FIRST: usize = 4;

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

    /// Colours and opacities that suit the histogram, for channel `index` of `volume`.
    fn suggested(&self, volume: &Volume, index: usize) -> TransferFunction {
        let size_nm = volume.size_nm();
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
    let channel = |(index, name): (usize, &String)| {
        let histogram = Histogram::new(volume.dtype);
        let mut channel = Channel {
            name: name.clone(),
            visible: index < SHOWN_AT_FIRST,
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
