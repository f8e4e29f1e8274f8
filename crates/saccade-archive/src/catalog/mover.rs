//! Who has put a tile where it lies.

use saccade_core::transform::SectionFromTile;

use super::database::Row;

/// Who has put a tile where it lies, as its row notes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mover {
    /// The newest of its records.
    Records,
    /// Somebody else, such as `saccade update`, there where this is the number of the transform.
    Somebody(i64),
}

impl Mover {
    pub(super) fn somebody(transform: SectionFromTile) -> Self {
        Self::Somebody(number_of(transform))
    }

    /// `None` where it is not noted: earlier versions did not.
    pub(super) fn of(row: &Row) -> Option<Self> {
        let number = row.get::<Option<i64>>("moved").ok().flatten()?;
        Some(match number {
            0 => Self::Records,
            number => Self::Somebody(number),
        })
    }

    /// As it is kept.
    pub(super) fn number(self) -> i64 {
        match self {
            Self::Records => 0,
            Self::Somebody(number) => number,
        }
    }

    /// Whether somebody has put a tile where this transform has it.
    pub fn is_to(self, transform: SectionFromTile) -> bool {
        self == Self::somebody(transform)
    }
}

/// A number that other transforms hardly have, and that is not 0: FNV-1a of their elements.
fn number_of(transform: SectionFromTile) -> i64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for element in transform.elements() {
        // Of the two zeros a database may keep one.
        for byte in (element + 0.0).to_bits().to_le_bytes() {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
    (hash | 1).cast_signed()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_element_counts() {
        let elements = [1.0, 0.0, 0.0, 1.0, 40.0, -7.5];
        let transform = |elements| SectionFromTile::new(elements).unwrap();
        let here = Mover::somebody(transform(elements));
        assert_ne!(here.number(), 0);
        assert!(here.is_to(transform(elements)) && !Mover::Records.is_to(transform(elements)));
        assert!(here.is_to(transform([1.0, -0.0, 0.0, 1.0, 40.0, -7.5])));
        for n in 0..6 {
            let mut other = elements;
            other[n] += 1e-9;
            assert!(!here.is_to(transform(other)), "{n}");
        }
    }
}
