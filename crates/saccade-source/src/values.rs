//! Numbers of all kinds, and what becomes of them in volumes of 8 and 16 bit.

mod inside;
mod spread;

use std::fmt;
use std::sync::OnceLock;

use bytes::Bytes;
use serde::{Deserialize, Serialize};

pub(crate) use inside::Inside;
use spread::Figure;
pub(crate) use spread::Spread;

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

    /// Whether it can be a whole number below 0.
    fn is_signed(self) -> bool {
        matches!(self, Self::I8 | Self::I16 | Self::I32 | Self::I64)
    }

    /// Whether it can be a label.
    pub(crate) fn is_whole(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }
}

/// What becomes of numbers that are wider than 16 bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
enum Way {
    /// They are what they are; signed ones are moved up by half their range.
    Kept,
    /// Whole numbers less this one.
    Less(i128),
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
    /// A number that was met and is not shown as what it is: one beyond the others, or a name that is another.
    #[serde(skip)]
    met: OnceLock<Figure>,
}

/// A stored number as it is shown, and whether that says something else than it does.
type Shown = (u16, bool);

/// Whole numbers of up to 64 bit, in their order from 0 on.
trait Ordered: Copy {
    /// What 0 is.
    const ZERO: u64;

    fn ordered(self) -> u64;

    fn exact(self) -> i128 {
        i128::from(self.ordered()) - i128::from(Self::ZERO)
    }
}

impl Ordered for u64 {
    const ZERO: Self = 0;

    fn ordered(self) -> u64 {
        self
    }
}

impl Ordered for i64 {
    const ZERO: u64 = 1 << 63;

    fn ordered(self) -> u64 {
        self.cast_unsigned() ^ Self::ZERO
    }
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
        let spread = spread.unwrap_or(match number.is_whole() {
            true => Spread::Whole { min: 0, max: 1 },
            false => Spread::Real { min: 0.0, max: 1.0 },
        });
        let most = i128::from(u16::MAX);
        let way = match spread {
            Spread::Whole { min, max } if min >= 0 && max <= most => Way::Less(0),
            Spread::Whole { min, max } if max - min < most => Way::Less(min - 1),
            Spread::Real { min, max } if max <= min => {
                // A window has some width, also where numbers are so large that 1 is none.
                let room = (min.abs() * 1e-9).max(1.0);
                Way::Window(match min + room {
                    max if max.is_finite() => Spread::Real { min, max },
                    _ => Spread::Real {
                        min: min - room,
                        max: min,
                    },
                })
            }
            spread => Way::Window(spread),
        };
        Self::new(number, big_endian, way)
    }

    fn new(number: Number, big_endian: bool, way: Way) -> Self {
        Self {
            number,
            big_endian,
            way,
            met: OnceLock::new(),
        }
    }

    /// A name that is shown as another number, if one was met.
    pub(crate) fn renamed(&self) -> Option<i128> {
        match (self.way, self.met.get()) {
            (Way::Names, Some(Figure::Whole(name))) => Some(*name),
            _ => None,
        }
    }

    /// Where a value of the volume comes from, as a line: the number times the first plus the second. Means nothing of names.
    pub(crate) fn scale(&self) -> (f64, f64) {
        let line = |min: f64, half: f64| {
            let factor = 32_767.0 / half;
            (factor, 1.0 - min * factor)
        };
        match (self.way, self.number) {
            (Way::Kept, Number::I8) => (1.0, 128.0),
            (Way::Kept, Number::I16) => (1.0, 32_768.0),
            (Way::Kept | Way::Names, _) => (1.0, 0.0),
            (Way::Less(less), _) => (1.0, -(less as f64)),
            (Way::Window(Spread::Whole { min, max }), _) => {
                line(min as f64, (max - min) as f64 / 2.0)
            }
            (Way::Window(Spread::Real { min, max }), _) => line(min, max / 2.0 - min / 2.0),
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
            Way::Window(spread) => {
                let (min, max, none) = match spread {
                    Spread::Whole { min, max } => (Figure::Whole(min), Figure::Whole(max), ""),
                    Spread::Real { min, max } => (
                        Figure::Real(min),
                        Figure::Real(max),
                        ", and what is no number (NaN) as nothing measured",
                    ),
                };
                Some(format!(
                    "its values are {number}; those from {min} to {max} are shown in 65535 steps, what lies beyond as the ends{none}"
                ))
            }
            Way::Names if number.bytes() <= 2 => None,
            Way::Names => {
                let negative = match number.is_signed() {
                    true => ", and each negative one,",
                    false => "",
                };
                Some(format!(
                    "its values are names of things ({number}); up to 65535 they are shown as they are, each larger one{negative} as \
                     one of 65535 numbers, which different things may share"
                ))
            }
        }
    }

    /// The value of what was never stored, whose number is that of the format's.
    pub(crate) fn of_missing(&self, fill: &[u8]) -> u16 {
        if matches!(self.way, Way::Window(_)) && fill.iter().all(|&byte| byte == 0) {
            return 0;
        }
        let value = self.convert(Bytes::copy_from_slice(fill), None);
        match *value {
            [low] => low.into(),
            [low, high, ..] => u16::from_le_bytes([low, high]),
            [] => 0,
        }
    }

    /// Bytes that hold these values, from those of a chunk's numbers, of which these are inside of the image; all without a word.
    pub(crate) fn convert(&self, stored: Bytes, inside: Option<&Inside>) -> Bytes {
        let chunk = Stored {
            values: self,
            bytes: &stored,
            inside,
        };
        match (self.number, self.way) {
            (Number::U8, _) => stored,
            (Number::I8, Way::Names) => {
                chunk.judge(
                    i8::from_le_bytes,
                    |name| name < 0,
                    |name| Figure::Whole(name.into()),
                );
                stored
            }
            (Number::I8, _) => stored.iter().map(|byte| byte ^ 0x80).collect(),
            (Number::U16, _) if !self.big_endian => stored,
            (Number::U16, _) => chunk.each(
                u16::from_le_bytes,
                |value| (value, false),
                |value| Figure::Whole(value.into()),
            ),
            // Negative ones become other names: 0 is nothing, and the others are what they are.
            (Number::I16, Way::Names) => chunk.each(
                i16::from_le_bytes,
                |value| (value.cast_unsigned(), value < 0),
                |value| Figure::Whole(value.into()),
            ),
            (Number::I16, _) => chunk.each(
                i16::from_le_bytes,
                |value| (value.cast_unsigned() ^ 0x8000, false),
                |value| Figure::Whole(value.into()),
            ),
            (Number::U32, _) => chunk.whole(|bytes| u64::from(u32::from_le_bytes(bytes))),
            (Number::I32, _) => chunk.whole(|bytes| i64::from(i32::from_le_bytes(bytes))),
            (Number::U64, _) => chunk.whole(u64::from_le_bytes),
            (Number::I64, _) => chunk.whole(i64::from_le_bytes),
            (Number::F32, _) => chunk.real(|bytes| f64::from(f32::from_le_bytes(bytes))),
            (Number::F64, _) => chunk.real(f64::from_le_bytes),
        }
    }

    /// Tells, once, that a number is not shown as what it is.
    fn beyond(&self, number: Figure) {
        if self.met.set(number).is_err() {
            return;
        }
        match self.way {
            // Of wide ones it is told when the image is opened.
            Way::Names if self.number.bytes() > 2 => {}
            Way::Names => log::warn!(
                "the labels have negative ids such as {number}; each is shown as another number"
            ),
            _ => log::warn!(
                "the image has values such as {number} that lie beyond those that were looked at when it \
                 was opened; they are shown as the nearest that can be shown"
            ),
        }
    }
}

/// Numbers of a chunk that become values.
struct Stored<'a> {
    values: &'a Values,
    bytes: &'a [u8],
    inside: Option<&'a Inside>,
}

impl Stored<'_> {
    /// One after the other, by how it is shown. Of those that are shown as something else, one inside of the image is told.
    fn each<T: Copy, const N: usize>(
        &self,
        number: impl Fn([u8; N]) -> T,
        shown: impl Fn(T) -> Shown,
        figure: impl Fn(T) -> Figure,
    ) -> Bytes {
        let mut bytes = Vec::with_capacity(self.bytes.len() / N * 2);
        let mut any = false;
        for stored in self.bytes.as_chunks::<N>().0 {
            let (value, other) = shown(number(self.native(*stored)));
            any |= other;
            bytes.extend(value.to_le_bytes());
        }
        if any {
            self.judge(number, |number| shown(number).1, figure);
        }
        bytes.into()
    }

    /// Tells of a number inside of the image of which this holds, if none was told of before.
    fn judge<T: Copy, const N: usize>(
        &self,
        number: impl Fn([u8; N]) -> T,
        is_other: impl Fn(T) -> bool,
        figure: impl Fn(T) -> Figure,
    ) {
        if self.values.met.get().is_some() {
            return;
        }
        let stored = self.bytes.as_chunks::<N>().0;
        let find = |stored: &[[u8; N]]| {
            let mut numbers = stored.iter().map(|stored| number(self.native(*stored)));
            numbers.find(|number| is_other(*number))
        };
        let found = match self.inside {
            None => find(stored),
            Some(inside) => inside.runs().find_map(|run| find(stored.get(run)?)),
        };
        if let Some(number) = found {
            self.values.beyond(figure(number));
        }
    }

    /// With the low byte first.
    fn native<const N: usize>(&self, mut stored: [u8; N]) -> [u8; N] {
        if self.values.big_endian {
            stored.reverse();
        }
        stored
    }

    fn whole<T: Ordered, const N: usize>(&self, number: impl Fn([u8; N]) -> T) -> Bytes {
        let figure = |number: T| Figure::Whole(number.exact());
        // Within the type, as it was seen there.
        let place = |number: i128| {
            let place = number + i128::from(T::ZERO);
            u64::try_from(place.clamp(0, u64::MAX.into())).expect("cut to its range")
        };
        match self.values.way {
            Way::Names => self.each(
                number,
                |number| {
                    let name = number.ordered() ^ T::ZERO;
                    match u16::try_from(name) {
                        Ok(name) => (name, false),
                        Err(_) => (scattered(name), true),
                    }
                },
                figure,
            ),
            Way::Window(Spread::Whole { min, max }) => {
                let (low, high) = (place(min), place(max));
                let span = (high - low) as f64;
                let is_padding = |place| place == T::ZERO && min > 0;
                self.each(
                    number,
                    |number| {
                        let place = number.ordered();
                        if is_padding(place) {
                            return (0, false);
                        }
                        // Exactly how far up it lies, and then which share of the whole way that is.
                        let up = place.clamp(low, high) - low;
                        (step(up as f64 / span), place < low || place > high)
                    },
                    figure,
                )
            }
            Way::Kept | Way::Less(_) | Way::Window(Spread::Real { .. }) => {
                let less = match self.values.way {
                    Way::Less(less) => less,
                    _ => 0,
                };
                // The least that is shown, and as what.
                let (low, first) = match less {
                    0 => (T::ZERO, 0),
                    less => (place(less + 1), 1),
                };
                let is_padding = |place| place == T::ZERO && less > 0;
                self.each(
                    number,
                    |number| {
                        let place = number.ordered();
                        match place.checked_sub(low) {
                            Some(up) => match u16::try_from(up.saturating_add(first)) {
                                Ok(value) => (value, false),
                                Err(_) => (u16::MAX, true),
                            },
                            None => (0, !is_padding(place)),
                        }
                    },
                    figure,
                )
            }
        }
    }

    fn real<const N: usize>(&self, number: impl Fn([u8; N]) -> f64) -> Bytes {
        let (min, max) = match self.values.way {
            Way::Window(Spread::Real { min, max }) => (min, max),
            _ => (0.0, 1.0),
        };
        let shown = |value: f64, share: f64| {
            // What is no number was not measured, and zeros before everything that was are padding.
            if value.is_nan() || (value == 0.0 && min > 0.0) {
                return (0, false);
            }
            (step(share), value < min || value > max)
        };
        let span = max - min;
        if span.is_finite() {
            let shown = |value| shown(value, (value - min) / span);
            return self.each(number, shown, Figure::Real);
        }
        // From the least to the largest it is further than any number is large.
        let (low, span) = (min / 2.0, max / 2.0 - min / 2.0);
        let shown = |value| shown(value, (value / 2.0 - low) / span);
        self.each(number, shown, Figure::Real)
    }
}

/// The step of 1 to 65535 at this share of the way.
fn step(share: f64) -> u16 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "from 1 to 65535"
    )]
    let shown = 1 + (share.clamp(0.0, 1.0) * 65_534.0).round() as u16;
    shown
}

/// A number of 1 to 65535 for a name. Fibonacci hashing: neighbours in number are far apart.
fn scattered(name: u64) -> u16 {
    let mixed = (name ^ (name >> 32)).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    u16::try_from(1 + mixed % 65_535).expect("at most 65535")
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

#[cfg(all(test, not(target_family = "wasm")))]
mod tests;
