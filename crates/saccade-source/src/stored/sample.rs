//! Some values of an image, by which to choose how all of them are shown.

use super::{Place, copy};
use crate::values::{Number, Spread, Values};

/// Pieces and bytes that are looked at.
const MOST_PIECES: usize = 64;
const MOST_BYTES: usize = 64 << 20;

/// Some of these, evenly; whether others are left.
pub(crate) fn sampled<T: Clone>(all: &[T], bytes_each: usize) -> (Vec<T>, bool) {
    let most = (MOST_BYTES / bytes_each.max(1)).clamp(1, MOST_PIECES);
    let step = all.len().div_ceil(most).max(1);
    (all.iter().step_by(step).cloned().collect(), step > 1)
}

/// The values seen so far.
#[derive(Debug)]
pub(crate) struct Sample {
    spread: Option<Spread>,
    /// Whether there may be others.
    partial: bool,
}

impl Sample {
    pub(crate) fn new(partial: bool) -> Self {
        Self {
            spread: None,
            partial,
        }
    }

    /// Adds the numbers that a piece has in its place.
    pub(crate) fn add(&mut self, stored: &[u8], place: &Place, number: Number, big_endian: bool) {
        let (size, width) = (place.voxels.size(), number.bytes());
        let mut inside = vec![0; size.as_usizevec3().element_product() * width];
        copy(stored, place, place.voxels, &mut inside, size, width);
        if let Some(new) = Values::spread(number, big_endian, &inside) {
            self.widen(new);
        }
    }

    fn widen(&mut self, new: Spread) {
        let Spread { min, max } = self.spread.unwrap_or(new);
        self.spread = Some(Spread {
            min: min.min(new.min),
            max: max.max(new.max),
        });
    }

    /// What to make of such numbers. What the image declares of its values counts where it is not far wider than those
    /// that were seen; floating-point values are given room where not all were.
    pub(crate) fn values(
        mut self,
        number: Number,
        big_endian: bool,
        names: bool,
        declared: impl Iterator<Item = [f64; 2]>,
    ) -> Values {
        if let Some(Spread { min, max }) = self.spread
            && matches!(number, Number::F32 | Number::F64)
        {
            let span = max - min;
            for [low, high] in declared {
                if high - low <= 8.0 * span {
                    self.widen(Spread {
                        min: low,
                        max: high,
                    });
                }
            }
            if self.partial {
                // Averages and samples have less extreme values.
                let room = span / 2.0;
                let low = if min >= 0.0 {
                    (min - room).max(0.0)
                } else {
                    min - room
                };
                self.widen(Spread {
                    min: low,
                    max: max + room,
                });
            }
        }
        Values::fitted(number, big_endian, self.spread, names)
    }
}
