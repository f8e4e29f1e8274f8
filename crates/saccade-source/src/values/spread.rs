//! From which number to which some numbers are.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Number;

/// A number, as it is and as messages say it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Figure {
    /// Of any whole type.
    Whole(i128),
    /// Of any other.
    Real(f64),
}

/// Whole numbers have all their digits; others none that only say how large they are.
impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Whole(value) => value.fmt(f),
            Self::Real(value) if value == 0.0 || !value.is_finite() => value.fmt(f),
            Self::Real(value) if (1e-5..1e15).contains(&value.abs()) => value.fmt(f),
            Self::Real(value) => fmt::LowerExp::fmt(&value, f),
        }
    }
}

/// Smallest and largest of some numbers, none of which is infinite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Spread {
    /// Of whole numbers: exactly.
    Whole { min: i128, max: i128 },
    /// Of others.
    Real {
        #[serde(with = "bits")]
        min: f64,
        #[serde(with = "bits")]
        max: f64,
    },
}

/// Numbers are sent by their bits: decimal digits may say neighbours.
pub(super) mod bits {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(in crate::values) fn serialize<S: Serializer>(
        value: &f64,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        value.to_bits().serialize(to)
    }

    pub(in crate::values) fn deserialize<'a, D: Deserializer<'a>>(
        from: D,
    ) -> Result<f64, D::Error> {
        u64::deserialize(from).map(f64::from_bits)
    }
}

/// Smallest and largest, by an order.
fn ends<T: Copy + PartialOrd>(values: impl Iterator<Item = T>) -> Option<(T, T)> {
    values.fold(None, |ends, value| {
        let (min, max) = ends.unwrap_or((value, value));
        Some((
            if value < min { value } else { min },
            if value > max { value } else { max },
        ))
    })
}

impl Spread {
    /// That of stored numbers, without those that are none, or infinite.
    pub(crate) fn of(number: Number, big_endian: bool, stored: &[u8]) -> Option<Self> {
        fn values<'a, T, const N: usize>(
            stored: &'a [u8],
            swap: bool,
            number: fn([u8; N]) -> T,
        ) -> impl Iterator<Item = T> + 'a
        where
            T: 'a,
        {
            stored.as_chunks::<N>().0.iter().map(move |stored| {
                let mut stored = *stored;
                if swap {
                    stored.reverse();
                }
                number(stored)
            })
        }
        macro_rules! whole {
            ($type:ty) => {{
                let (min, max) = ends(values(stored, big_endian, <$type>::from_le_bytes))?;
                Some(Self::Whole {
                    min: min.into(),
                    max: max.into(),
                })
            }};
        }
        macro_rules! real {
            ($type:ty) => {{
                let values = values(stored, big_endian, <$type>::from_le_bytes);
                let (min, max) = ends(values.filter(|value| value.is_finite()))?;
                Some(Self::Real {
                    min: min.into(),
                    max: max.into(),
                })
            }};
        }
        match number {
            Number::U8 => whole!(u8),
            Number::I8 => whole!(i8),
            Number::U16 => whole!(u16),
            Number::I16 => whole!(i16),
            Number::U32 => whole!(u32),
            Number::I32 => whole!(i32),
            Number::U64 => whole!(u64),
            Number::I64 => whole!(i64),
            Number::F32 => real!(f32),
            Number::F64 => real!(f64),
        }
    }

    /// That of both.
    pub(crate) fn with(self, other: Self) -> Self {
        match (self, other) {
            (
                Self::Whole { min, max },
                Self::Whole {
                    min: low,
                    max: high,
                },
            ) => Self::Whole {
                min: min.min(low),
                max: max.max(high),
            },
            (
                Self::Real { min, max },
                Self::Real {
                    min: low,
                    max: high,
                },
            ) => Self::Real {
                min: min.min(low),
                max: max.max(high),
            },
            // The numbers of an image are of one type.
            (this, _) => this,
        }
    }
}
