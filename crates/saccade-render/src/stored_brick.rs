use std::borrow::Cow;

use saccade_core::volume::Polarity;

/// A brick's voxels as the brick cache holds them.
#[derive(Debug)]
pub(crate) struct StoredBrick<'a> {
    /// With border, x fastest.
    pub(crate) voxels: Cow<'a, [u8]>,
    /// Smallest and largest, border included: interpolation reaches it.
    pub(crate) range: [u8; 2],
}

impl<'a> StoredBrick<'a> {
    pub(crate) fn new(raw: &'a [u8], polarity: Polarity) -> Self {
        let voxels = match polarity {
            Polarity::Bright => Cow::Borrowed(raw),
            Polarity::Dark => raw.iter().map(|&v| Polarity::Dark.stored(v)).collect(),
        };
        let values = || voxels.iter().copied();
        let range = [values().fold(u8::MAX, u8::min), values().fold(0, u8::max)];
        Self { voxels, range }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_of_stored_values() {
        let brick = StoredBrick::new(&[0, 1, 200], Polarity::Dark);
        assert_eq!((&*brick.voxels, brick.range), (&[0, 255, 56][..], [0, 255]));
        let brick = StoredBrick::new(&[7, 1, 200], Polarity::Bright);
        assert_eq!((&*brick.voxels, brick.range), (&[7, 1, 200][..], [1, 200]));
    }
}
