//! Named colour maps, as a few corners in sRGB.

use serde::{Deserialize, Serialize};

use super::linear_from_srgb;

/// Colours along `[0, 1]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ColorMap {
    /// Black to white.
    #[default]
    Gray,
    /// Black, slate, white: radiographs.
    Bone,
    /// Dark violet, teal, yellow; even steps for the eye, safe for the colour-blind.
    Viridis,
    /// Black, purple, orange, cream.
    Inferno,
    /// Black to green: the usual fluorophore.
    Green,
    /// Black to magenta: beside green, for the colour-blind.
    Magenta,
    /// Black to cyan.
    Cyan,
    /// Black to yellow.
    Yellow,
    /// Black to red.
    Red,
    /// Black to a blue that is bright enough to be seen.
    Blue,
}

impl ColorMap {
    /// Every map, in the order menus show them.
    pub const ALL: [Self; 10] = [
        Self::Gray,
        Self::Bone,
        Self::Viridis,
        Self::Inferno,
        Self::Green,
        Self::Magenta,
        Self::Cyan,
        Self::Yellow,
        Self::Red,
        Self::Blue,
    ];

    /// Maps of one hue each, for the first channel, the second, and so on, again from the start.
    pub fn of_channel(channel: u32) -> Self {
        const HUES: [ColorMap; 7] = [
            ColorMap::Green,
            ColorMap::Magenta,
            ColorMap::Cyan,
            ColorMap::Yellow,
            ColorMap::Red,
            ColorMap::Blue,
            ColorMap::Gray,
        ];
        HUES[channel as usize % HUES.len()]
    }

    /// Evenly spaced corners, sRGB bytes.
    const fn corners(self) -> &'static [[u8; 3]] {
        match self {
            Self::Gray => &[[0, 0, 0], [255, 255, 255]],
            Self::Bone => &[[0, 0, 0], [84, 84, 116], [168, 199, 199], [255, 255, 255]],
            Self::Viridis => &[
                [68, 1, 84],
                [59, 82, 139],
                [33, 145, 140],
                [94, 201, 98],
                [253, 231, 37],
            ],
            Self::Inferno => &[
                [0, 0, 4],
                [87, 16, 110],
                [188, 55, 84],
                [249, 142, 9],
                [252, 255, 164],
            ],
            Self::Green => &[[0, 0, 0], [0, 255, 0]],
            Self::Magenta => &[[0, 0, 0], [255, 0, 255]],
            Self::Cyan => &[[0, 0, 0], [0, 255, 255]],
            Self::Yellow => &[[0, 0, 0], [255, 255, 0]],
            Self::Red => &[[0, 0, 0], [255, 40, 40]],
            Self::Blue => &[[0, 0, 0], [70, 110, 255]],
        }
    }

    /// sRGB at `t` in `[0, 1]`, each part in `[0, 1]`.
    pub fn srgb(self, t: f32) -> [f32; 3] {
        let corners = self.corners();
        let last = corners.len() - 1;
        // At most 5 corners: exact in f32.
        let at = t.clamp(0.0, 1.0) * last as f32;
        #[expect(
            clippy::cast_possible_truncation,
            reason = "within 0..=4; NaN becomes 0"
        )]
        let index = (at as usize).min(last - 1);
        let within = at - index as f32;
        let mix = |a: u8, b: u8| f32::from(a) + within * (f32::from(b) - f32::from(a));
        std::array::from_fn(|i| mix(corners[index][i], corners[index + 1][i]) / 255.0)
    }

    /// Linear RGB at `t` in `[0, 1]`.
    pub fn linear_rgb(self, t: f32) -> [f32; 3] {
        self.srgb(t).map(linear_from_srgb)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_and_corners_are_exact() {
        assert_eq!(ColorMap::Gray.srgb(0.0), [0.0; 3]);
        assert_eq!(ColorMap::Gray.srgb(1.0), [1.0; 3]);
        assert_eq!(
            ColorMap::Viridis.srgb(0.5),
            [33, 145, 140].map(|v: u8| f32::from(v) / 255.0)
        );
    }
}
