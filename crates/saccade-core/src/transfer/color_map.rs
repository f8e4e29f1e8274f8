//! Colour maps, as a few corners in sRGB: some that have names, and any single hue.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::linear_from_srgb;

/// Colours along `[0, 1]`. As text its name, such as `viridis`, or `#rrggbb`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
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
    /// Black to this colour, sRGB.
    Color([u8; 3]),
}

/// Text that names no colour map.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no colour map; give #rrggbb, or one of {}", ColorMap::ALL.map(ColorMap::name).join(", "))]
pub struct ColorMapError {
    /// As given.
    pub text: String,
}

impl FromStr for ColorMap {
    type Err = ColorMapError;

    fn from_str(text: &str) -> Result<Self, ColorMapError> {
        if let Some(map) = Self::ALL.into_iter().find(|map| map.name() == text) {
            return Ok(map);
        }
        let digits = text.strip_prefix('#').filter(|digits| digits.len() == 6);
        let number = digits.and_then(|digits| match digits.starts_with('+') {
            true => None,
            false => u32::from_str_radix(digits, 16).ok(),
        });
        let number = number.ok_or_else(|| ColorMapError {
            text: text.to_owned(),
        })?;
        let [_, r, g, b] = number.to_be_bytes();
        Ok(Self::Color([r, g, b]))
    }
}

impl fmt::Display for ColorMap {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Color([r, g, b]) => write!(f, "#{r:02x}{g:02x}{b:02x}"),
            named => f.write_str(named.name()),
        }
    }
}

impl TryFrom<String> for ColorMap {
    type Error = ColorMapError;

    fn try_from(text: String) -> Result<Self, ColorMapError> {
        text.parse()
    }
}

impl From<ColorMap> for String {
    fn from(map: ColorMap) -> Self {
        map.to_string()
    }
}

impl ColorMap {
    /// Every map that has a name, in the order menus show them.
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

    /// From black to a colour, sRGB, by its name if it has one.
    pub fn to_color(color: [u8; 3]) -> Self {
        let named = Self::ALL.into_iter();
        let mut named =
            named.filter(|map| matches!(map.corners(), [[0, 0, 0], last] if *last == color));
        named.next().unwrap_or(Self::Color(color))
    }

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

    /// Its name; of a single colour, what it is.
    const fn name(self) -> &'static str {
        match self {
            Self::Gray => "gray",
            Self::Bone => "bone",
            Self::Viridis => "viridis",
            Self::Inferno => "inferno",
            Self::Green => "green",
            Self::Magenta => "magenta",
            Self::Cyan => "cyan",
            Self::Yellow => "yellow",
            Self::Red => "red",
            Self::Blue => "blue",
            Self::Color(_) => "a colour",
        }
    }

    /// Evenly spaced corners, sRGB bytes.
    const fn corners(&self) -> &[[u8; 3]] {
        match self {
            Self::Color(last) => std::slice::from_ref(last),
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
        let Some(last) = corners.len().checked_sub(1).filter(|last| *last > 0) else {
            // A single colour, from black.
            let [r, g, b] = corners.first().copied().unwrap_or_default();
            return [r, g, b].map(|part| f32::from(part) / 255.0 * t.clamp(0.0, 1.0));
        };
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
        let orange = ColorMap::Color([255, 102, 0]);
        assert_eq!(orange.srgb(0.0), [0.0; 3]);
        assert_eq!(orange.srgb(0.5), [0.5, 0.2, 0.0]);
        assert_eq!(ColorMap::Color([255; 3]).srgb(0.3), [0.3; 3]);
        assert_eq!(ColorMap::to_color([255; 3]), ColorMap::Gray);
        assert_eq!(ColorMap::to_color([255, 0, 255]), ColorMap::Magenta);
        assert_eq!(
            ColorMap::to_color([255, 0, 0]),
            ColorMap::Color([255, 0, 0])
        );
    }

    #[test]
    fn maps_are_named_in_text() {
        for map in ColorMap::ALL
            .into_iter()
            .chain([ColorMap::Color([1, 171, 0])])
        {
            let json = serde_json::to_string(&map).unwrap();
            assert_eq!(
                serde_json::from_str::<ColorMap>(&json).unwrap(),
                map,
                "{json}"
            );
        }
        assert_eq!("#01ab00".parse(), Ok(ColorMap::Color([1, 171, 0])));
        for bad in [
            "", "Gray", "a colour", "#12345", "#1234567", "123456", "#+12345", "#日本",
        ] {
            let error = bad.parse::<ColorMap>().unwrap_err().to_string();
            assert!(error.contains("viridis"), "{error}");
        }
    }
}
