use std::borrow::Cow;

use saccade_core::volume::{Dtype, Polarity};

/// A brick's voxels as the brick cache holds them, with border, x fastest.
#[derive(Debug)]
pub(crate) struct StoredBrick<'a> {
    pub(crate) voxels: StoredVoxels<'a>,
    /// Smallest and largest, border included: interpolation reaches it.
    pub(crate) range: [u16; 2],
}

/// Voxels of either type.
#[derive(Debug)]
pub(crate) enum StoredVoxels<'a> {
    Uint8(Cow<'a, [u8]>),
    Uint16(Cow<'a, [u16]>),
}

impl StoredVoxels<'_> {
    /// As the device takes them: little-endian.
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            Self::Uint8(voxels) => voxels,
            Self::Uint16(voxels) => bytemuck::cast_slice(voxels),
        }
    }
}

impl<'a> StoredBrick<'a> {
    /// From voxels as measured, little-endian.
    pub(crate) fn new(raw: &'a [u8], dtype: Dtype, polarity: Polarity) -> Self {
        match dtype {
            Dtype::Uint16 => {
                let measured = || {
                    let (pairs, _) = raw.as_chunks::<2>();
                    pairs.iter().copied().map(u16::from_le_bytes)
                };
                let voxels = match (polarity, bytemuck::try_cast_slice(raw)) {
                    (Polarity::Bright, Ok(voxels)) if cfg!(target_endian = "little") => {
                        Cow::Borrowed(voxels)
                    }
                    (Polarity::Bright, _) => measured().collect(),
                    (Polarity::Dark, _) => measured().map(u16::wrapping_neg).collect(),
                };
                let range = range(&voxels, u16::MAX, 0);
                let voxels = StoredVoxels::Uint16(voxels);
                Self { voxels, range }
            }
            _ => {
                let voxels = match polarity {
                    Polarity::Bright => Cow::Borrowed(raw),
                    Polarity::Dark => raw.iter().map(|&v| Polarity::Dark.stored(v)).collect(),
                };
                let range = range(&voxels, u8::MAX, 0).map(u16::from);
                let voxels = StoredVoxels::Uint8(voxels);
                Self { voxels, range }
            }
        }
    }
}

fn range<T: Ord + Copy>(values: &[T], largest: T, smallest: T) -> [T; 2] {
    let values = || values.iter().copied();
    [
        values().fold(largest, T::min),
        values().fold(smallest, T::max),
    ]
}

#[cfg(test)]
#[expect(clippy::cast_possible_truncation, reason = "values are made to fit")]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_of_stored_values() {
        let brick = StoredBrick::new(&[0, 1, 200], Dtype::Uint8, Polarity::Dark);
        assert_eq!(
            (brick.voxels.bytes(), brick.range),
            (&[0, 255, 56][..], [0, 255])
        );
        let brick = StoredBrick::new(&[7, 1, 200], Dtype::Uint8, Polarity::Bright);
        assert_eq!(
            (brick.voxels.bytes(), brick.range),
            (&[7, 1, 200][..], [1, 200])
        );
    }

    #[test]
    fn sixteen_bit_is_little_endian_wherever_it_lies() {
        let raw = [9, 0, 0, 1, 0, 5, 1, 0xff];
        for from in [0, 1, 2] {
            let brick = StoredBrick::new(&raw[from..from + 6], Dtype::Uint16, Polarity::Bright);
            assert_eq!(brick.voxels.bytes(), &raw[from..from + 6]);
        }
        let brick = StoredBrick::new(&raw[..6], Dtype::Uint16, Polarity::Dark);
        assert_eq!(brick.range, [0x10000 - 0x500, 0xffff - 8].map(|v| v as u16));
        let empty = StoredBrick::new(&[0; 4], Dtype::Uint16, Polarity::Dark);
        assert_eq!(empty.range, [0, 0]);
    }
}
