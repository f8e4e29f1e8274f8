//! Numbers of all kinds, and what becomes of them in volumes of 8 and 16 bit.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use bytes::Bytes;
use serde::{Deserialize, Serialize};

/// How a number is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Number {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Number {
    /// By Zarr's and Neuroglancer's name, such as `uint8`.
    pub(crate) fn named(name: &str) -> Option<Self> {
        Some(match name {
            "uint8" => Self::U8,
            "int8" => Self::I8,
            "uint16" => Self::U16,
            "int16" => Self::I16,
            "uint32" => Self::U32,
            "int32" => Self::I32,
            "uint64" => Self::U64,
            "int64" => Self::I64,
            "float32" => Self::F32,
            "float64" => Self::F64,
            _ => return None,
        })
    }

    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// Whether it can be a label.
    pub(crate) fn is_whole(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }
}

/// Smallest and largest of some numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "[u64; 2]", into = "[u64; 2]")]
pub(crate) struct Spread {
    pub(crate) min: f64,
    pub(crate) max: f64,
}

/// By their bits: decimal digits may say neighbours.
impl From<[u64; 2]> for Spread {
    fn from(bits: [u64; 2]) -> Self {
        let [min, max] = bits.map(f64::from_bits);
        Self { min, max }
    }
}

impl From<Spread> for [u64; 2] {
    fn from(Spread { min, max }: Spread) -> Self {
        [min, max].map(f64::to_bits)
    }
}

/// What becomes of numbers that are wider than 16 bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
enum Way {
    /// They are what they are; signed ones are moved up by half their range.
    Kept,
    /// Whole numbers less this one.
    Less(i64),
    /// From this window to 1 to 65535.
    Window(Spread),
    /// Names of things, of which only sameness matters: what they are up to 65535, scattered over 1 to 65535 beyond.
    Names,
}

/// To values of a volume, from stored numbers. 0 stays, or becomes, "nothing measured" where it is the least.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Values {
    number: Number,
    big_endian: bool,
    way: Way,
    #[serde(skip)]
    told: AtomicBool,
    /// A name that was met and is shown as another number; 0 for none.
    #[serde(skip)]
    renamed: AtomicU64,
}

impl Values {
    /// Those of numbers of 8 or 16 bit; `None` for wider ones, for which [`Self::fitted`] is.
    pub(crate) fn kept(number: Number, big_endian: bool) -> Option<Self> {
        (number.bytes() <= 2).then(|| Self::new(number, big_endian, Way::Kept))
    }

    /// Those of numbers that name things: the same whatever some of them are. `None` for numbers that cannot.
    pub(crate) fn names(number: Number, big_endian: bool) -> Option<Self> {
        { number.is_whole() }.then(|| Self::new(number, big_endian, Way::Names))
    }

    /// Those of wide numbers, of which a sample has this spread.
    pub(crate) fn fitted(number: Number, big_endian: bool, spread: Option<Spread>) -> Self {
        let spread = spread.unwrap_or(Spread { min: 0.0, max: 1.0 });
        let Spread { min, max } = spread;
        let way = if !number.is_whole() {
            let max = if max > min { max } else { min + 1.0 };
            Way::Window(Spread { min, max })
        } else if min >= 0.0 && max <= f64::from(u16::MAX) {
            Way::Less(0)
        } else if max - min < f64::from(u16::MAX) && min.abs() < 2_f64.powi(52) {
            // Whole, and below 2^52.
            #[expect(clippy::cast_possible_truncation, reason = "checked in the line above")]
            let less = min as i64 - 1;
            Way::Less(less)
        } else {
            Way::Window(spread)
        };
        Self::new(number, big_endian, way)
    }

    fn new(number: Number, big_endian: bool, way: Way) -> Self {
        Self {
            number,
            big_endian,
            way,
            told: AtomicBool::new(false),
            renamed: AtomicU64::new(0),
        }
    }

    /// A name that is shown as another number, if one was met.
    pub(crate) fn renamed(&self) -> Option<u64> {
        let name = self.renamed.load(Ordering::Relaxed);
        (name != 0).then_some(name)
    }

    /// Where a value of the volume comes from, as a line: the number times the first plus the second. Means nothing of names.
    pub(crate) fn scale(&self) -> (f64, f64) {
        match (self.way, self.number) {
            (Way::Kept, Number::I8) => (1.0, 128.0),
            (Way::Kept, Number::I16) => (1.0, 32_768.0),
            (Way::Kept | Way::Names, _) => (1.0, 0.0),
            (Way::Less(less), _) => (1.0, -(less as f64)),
            (Way::Window(Spread { min, max }), _) => {
                let factor = 65_534.0 / (max - min);
                (factor, 1.0 - min * factor)
            }
        }
    }

    /// Whether only sameness of values means anything.
    pub(crate) fn are_names(&self) -> bool {
        self.way == Way::Names
    }

    /// What the user should know, if anything.
    pub(crate) fn note(&self) -> Option<String> {
        let number = self.number;
        match self.way {
            Way::Kept if matches!(number, Number::I8 | Number::I16) => Some(format!(
                "its values are signed ({number}); they are shown moved up by half their range"
            )),
            Way::Kept => None,
            Way::Less(0) => Some(format!(
                "its values are {number}; they are shown in 16 bit as they are, as those looked at fit"
            )),
            Way::Less(less) => Some(format!(
                "its values are {number}; they are shown in 16 bit less {less}, which loses nothing of those looked at"
            )),
            Way::Window(Spread { min, max }) => {
                let none = match number.is_whole() {
                    true => "",
                    false => ", and what is no number (NaN) as nothing measured",
                };
                Some(format!(
                    "its values are {number}; those from {min} to {max} are shown in 65535 steps, what lies beyond as the ends{none}"
                ))
            }
            Way::Names if number.bytes() <= 2 => None,
            Way::Names => Some(format!(
                "its values are names of things ({number}); up to 65535 they are shown as they are, each larger one as one of \
                 65535 numbers, which different things may share"
            )),
        }
    }

    /// The value of what was never stored, whose number is that of the format's.
    pub(crate) fn of_missing(&self, fill: &[u8]) -> u16 {
        if matches!(self.way, Way::Window(_)) && fill.iter().all(|&byte| byte == 0) {
            return 0;
        }
        let value = self.convert(Bytes::copy_from_slice(fill));
        match *value {
            [low] => low.into(),
            [low, high, ..] => u16::from_le_bytes([low, high]),
            [] => 0,
        }
    }

    /// Bytes that hold these values, from those of numbers.
    pub(crate) fn convert(&self, stored: Bytes) -> Bytes {
        match (self.number, self.way) {
            (Number::U8, _) | (Number::I8, Way::Names) => stored,
            (Number::I8, _) => stored.iter().map(|byte| byte ^ 0x80).collect(),
            (Number::U16, _) if !self.big_endian => stored,
            (Number::U16, _) => self.of(&stored, u16::from_le_bytes, |value| value),
            // Whatever the sign: other names, and 0 is nothing.
            (Number::I16, Way::Names) => self.of(&stored, u16::from_le_bytes, |value| value),
            (Number::I16, _) => self.of(&stored, i16::from_le_bytes, |value| {
                value.cast_unsigned() ^ 0x8000
            }),
            (Number::U32, _) => self.of(&stored, u32::from_le_bytes, |v| {
                self.whole(v.into(), v.into())
            }),
            (Number::I32, _) => self.of(&stored, i32::from_le_bytes, |v| {
                self.whole(v.into(), i64::from(v).cast_unsigned())
            }),
            (Number::U64, _) => self.of(&stored, u64::from_le_bytes, |v| {
                self.whole(i64::try_from(v).unwrap_or(i64::MAX), v)
            }),
            (Number::I64, _) => self.of(&stored, i64::from_le_bytes, |v| {
                self.whole(v, v.cast_unsigned())
            }),
            (Number::F32, _) => self.of(&stored, f32::from_le_bytes, |v| self.windowed(v.into())),
            (Number::F64, _) => self.of(&stored, f64::from_le_bytes, |v| self.windowed(v)),
        }
    }

    fn of<T, const N: usize>(
        &self,
        stored: &[u8],
        number: fn([u8; N]) -> T,
        value: impl Fn(T) -> u16,
    ) -> Bytes {
        let mut bytes = Vec::with_capacity(stored.len() / N * 2);
        for stored in stored.as_chunks::<N>().0 {
            let mut stored = *stored;
            if self.big_endian {
                stored.reverse();
            }
            bytes.extend(value(number(stored)).to_le_bytes());
        }
        bytes.into()
    }

    fn whole(&self, value: i64, name: u64) -> u16 {
        match self.way {
            Way::Kept | Way::Less(_) => {
                let less = if let Way::Less(less) = self.way {
                    less
                } else {
                    0
                };
                let shown = value.saturating_sub(less);
                let cut = shown.clamp(0, u16::MAX.into());
                if cut != shown {
                    self.beyond(value as f64);
                }
                u16::try_from(cut).expect("cut to its range")
            }
            Way::Window(_) => self.windowed(value as f64),
            Way::Names => u16::try_from(name).unwrap_or_else(|_| {
                self.renamed.store(name, Ordering::Relaxed);
                // Fibonacci hashing: neighbours in number are far apart.
                let mixed = (name ^ (name >> 32)).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
                u16::try_from(1 + mixed % 65_535).expect("at most 65535")
            }),
        }
    }

    fn windowed(&self, value: f64) -> u16 {
        let Way::Window(Spread { min, max }) = self.way else {
            return 0;
        };
        // What is no number was not measured, and zeros before everything that was are padding.
        if value.is_nan() || (value == 0.0 && min > 0.0) {
            return 0;
        }
        if value < min || value > max {
            self.beyond(value);
        }
        let share = ((value - min) / (max - min)).clamp(0.0, 1.0);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "from 1 to 65535"
        )]
        let shown = 1 + (share * 65_534.0).round() as u16;
        shown
    }

    /// Tells, once, that a value is not shown as what it is.
    fn beyond(&self, value: f64) {
        if !self.told.swap(true, Ordering::Relaxed) {
            log::warn!(
                "the image has values such as {value} that lie beyond those that were looked at when it \
                        was opened; they are shown as the nearest that can be shown"
            );
        }
    }

    /// Spread of stored numbers, without those that are none.
    pub(crate) fn spread(number: Number, big_endian: bool, stored: &[u8]) -> Option<Spread> {
        fn of<T, const N: usize>(
            stored: &[u8],
            swap: bool,
            number: fn([u8; N]) -> T,
            to: fn(T) -> f64,
        ) -> Option<Spread> {
            let mut spread: Option<Spread> = None;
            for stored in stored.as_chunks::<N>().0 {
                let mut stored = *stored;
                if swap {
                    stored.reverse();
                }
                let value = to(number(stored));
                if value.is_finite() {
                    let Spread { min, max } = spread.unwrap_or(Spread {
                        min: value,
                        max: value,
                    });
                    spread = Some(Spread {
                        min: min.min(value),
                        max: max.max(value),
                    });
                }
            }
            spread
        }
        let swap = big_endian;
        match number {
            Number::U8 => of(stored, swap, u8::from_le_bytes, f64::from),
            Number::I8 => of(stored, swap, i8::from_le_bytes, f64::from),
            Number::U16 => of(stored, swap, u16::from_le_bytes, f64::from),
            Number::I16 => of(stored, swap, i16::from_le_bytes, f64::from),
            Number::U32 => of(stored, swap, u32::from_le_bytes, f64::from),
            Number::I32 => of(stored, swap, i32::from_le_bytes, f64::from),
            Number::U64 => of(stored, swap, u64::from_le_bytes, |v| v as f64),
            Number::I64 => of(stored, swap, i64::from_le_bytes, |v| v as f64),
            Number::F32 => of(stored, swap, f32::from_le_bytes, f64::from),
            Number::F64 => of(stored, swap, f64::from_le_bytes, |v| v),
        }
    }
}

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::U8 => "uint8",
            Self::I8 => "int8",
            Self::U16 => "uint16",
            Self::I16 => "int16",
            Self::U32 => "uint32",
            Self::I32 => "int32",
            Self::U64 => "uint64",
            Self::I64 => "int64",
            Self::F32 => "float32",
            Self::F64 => "float64",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(values: &Values, stored: impl IntoIterator<Item = Vec<u8>>) -> Vec<u16> {
        let stored: Vec<u8> = stored.into_iter().flatten().collect();
        let bytes = values.convert(stored.into());
        bytes
            .as_chunks()
            .0
            .iter()
            .map(|two| u16::from_le_bytes(*two))
            .collect()
    }

    fn fitted(number: Number, min: f64, max: f64) -> Values {
        Values::fitted(number, false, Some(Spread { min, max }))
    }

    #[test]
    fn whole_numbers_that_fit_stay_what_they_are() {
        let u32s = |v: &[u32]| {
            v.iter()
                .map(|v| v.to_le_bytes().to_vec())
                .collect::<Vec<_>>()
        };
        let values = fitted(Number::U32, 0.0, 40_000.0);
        assert_eq!(
            shown(&values, u32s(&[0, 1, 40_000, 65_535, 70_000])),
            [0, 1, 40_000, 65_535, 65_535]
        );
        // Far from 0, but close together: nothing is lost.
        let values = fitted(Number::U32, 1_000_000.0, 1_065_000.0);
        assert_eq!(
            shown(&values, u32s(&[1_000_000, 1_000_001, 1_065_000])),
            [1, 2, 65_001]
        );
        assert_eq!(values.scale(), (1.0, -999_999.0));
        let i32s = [-5_i32, 0, 7].map(|v| v.to_be_bytes().to_vec());
        let spread = Values::spread(Number::I32, true, &i32s.concat());
        assert_eq!(
            spread,
            Some(Spread {
                min: -5.0,
                max: 7.0
            })
        );
        let values = Values::fitted(Number::I32, true, spread);
        assert_eq!(shown(&values, i32s), [1, 6, 13]);
    }

    #[test]
    fn what_does_not_fit_gets_a_window_and_is_told() {
        let f32s = [f32::NAN, -3.0, -1.0, 0.0, 3.0, 9.0].map(|v| v.to_le_bytes().to_vec());
        let values = fitted(Number::F32, -1.0, 3.0);
        assert_eq!(shown(&values, f32s), [0, 1, 1, 16_385, 65_535, 65_535]);
        let (factor, shift) = values.scale();
        assert!((3.0 * factor + shift - 65_535.0).abs() < 1e-6);
        let note = values.note().unwrap();
        assert!(
            note.contains("float32") && note.contains("-1 to 3") && note.contains("(NaN)"),
            "{note}"
        );
        let u32s = [0_u32, 1 << 31, 1 << 20].map(|v| v.to_le_bytes().to_vec());
        let values = fitted(Number::U32, 0.0, f64::from(1_u32 << 31));
        assert_eq!(shown(&values, u32s), [1, 65_535, 33]);
        let note = values.note().unwrap();
        assert!(!note.contains("NaN"), "{note}");
        assert!(fitted(Number::F64, 2.0, 2.0).scale().0.is_finite());
    }

    #[test]
    fn names_stay_different_as_far_as_they_can() {
        let values = Values::names(Number::U64, false).unwrap();
        let names = (0..1000_u64).map(|n| (n * 1_000_003).to_le_bytes().to_vec());
        let mut scattered = shown(&values, names);
        assert_eq!(scattered[0], 0);
        scattered.sort_unstable();
        scattered.dedup();
        assert!(scattered.len() > 950, "{} of 1000", scattered.len());
        assert!(values.note().unwrap().contains("share"));
        // Those that fit are what they are, and what is beyond them is no one thing.
        let ids = [1_u64, 2, 65_535, 65_536, 65_537, 70_000, u64::MAX];
        let shown = shown(&values, ids.map(|v| v.to_le_bytes().to_vec()));
        assert_eq!(shown[..3], [1, 2, 65_535]);
        let mut different = shown.clone();
        different.sort_unstable();
        different.dedup();
        assert_eq!(different.len(), ids.len(), "{shown:?}");
        assert!(!shown.contains(&0));
        assert!(Values::names(Number::F32, false).is_none());
    }

    #[test]
    fn signed_names_are_names_and_0_is_nothing() {
        let values = Values::names(Number::I16, true).unwrap();
        let stored = [0_i16, 1, 32_767, -1].map(|v| v.to_be_bytes().to_vec());
        assert_eq!(shown(&values, stored), [0, 1, 32_767, 65_535]);
        assert!(values.note().is_none());
        let values = Values::names(Number::I32, false).unwrap();
        let stored = [0_i32, 7, -7].map(|v| v.to_le_bytes().to_vec());
        let shown = shown(&values, stored);
        assert_eq!(shown[..2], [0, 7]);
        assert!(shown[2] > 7);
        assert_eq!(values.of_missing(&[0; 4]), 0);
    }

    #[test]
    fn narrow_numbers_are_kept() {
        let values = Values::kept(Number::I16, true).unwrap();
        let stored = [-32_768_i16, 0, 32_767].map(|v| v.to_be_bytes().to_vec());
        assert_eq!(shown(&values, stored), [0, 0x8000, 0xffff]);
        assert_eq!(values.scale(), (1.0, 32_768.0));
        assert!(Values::kept(Number::U32, false).is_none());
    }
}
