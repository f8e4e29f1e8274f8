use saccade_core::volume::Polarity;

/// A brick's voxels as the brick cache holds them.
#[derive(Debug)]
pub(crate) struct StoredBrick {
    /// With border, x fastest.
    pub(crate) voxels: Vec<u8>,
    /// Smallest and largest, border included: interpolation reaches it.
    pub(crate) range: [u8; 2],
}

impl StoredBrick {
    pub(crate) fn new(raw: &[u8], polarity: Polarity) -> Self {
        let voxels: Vec<u8> = raw.iter().map(|&value| polarity.stored(value)).collect();
        let range = voxels
            .iter()
            .fold([u8::MAX, 0], |[low, high], &v| [low.min(v), high.max(v)]);
        Self { voxels, range }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_of_stored_values() {
        let brick = StoredBrick::new(&[0, 1, 200], Polarity::Dark);
        assert_eq!(
            (brick.voxels.as_slice(), brick.range),
            (&[0, 255, 56][..], [0, 255])
        );
        let brick = StoredBrick::new(&[7, 1, 200], Polarity::Bright);
        assert_eq!(brick.range, [1, 200]);
    }
}
