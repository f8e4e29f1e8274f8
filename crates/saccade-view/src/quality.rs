//! Smaller pictures while the hand moves, where full ones would take too long.

use std::time::Duration;

/// A picture that takes longer than this feels stuck to the hand.
const TARGET: Duration = Duration::from_millis(60);
/// Growing back needs this much room, so that the size does not flicker.
const ROOM: f64 = 0.7;
/// After so long without a movement the picture is refined.
const STILL: Duration = Duration::from_millis(200);
/// Sizes a picture may have, as parts of the full one along each axis.
const SCALES: [f64; 6] = [1.0, 0.75, 0.5, 0.35, 0.25, 0.18];

/// Chooses the size of pictures.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Quality {
    step: usize,
    moved: Option<Duration>,
}

impl Quality {
    /// Part of the full size that the next picture should have.
    ///
    /// `full` is the time that a picture of full size takes, as far as known.
    pub(crate) fn scale(&mut self, now: Duration, moving: bool, full: Option<Duration>) -> f64 {
        if moving {
            self.moved = Some(now);
        }
        if self.is_still(now) {
            return 1.0;
        }
        if let Some(full) = full {
            let full = full.as_secs_f64();
            let fits = |scale: f64, room: f64| full * scale * scale <= room * TARGET.as_secs_f64();
            let last = SCALES.len() - 1;
            while self.step < last && !fits(SCALES[self.step], 1.0) {
                self.step += 1;
            }
            while self.step > 0 && fits(SCALES[self.step - 1], ROOM) {
                self.step -= 1;
            }
        }
        SCALES[self.step]
    }

    /// Time until the picture is to be refined, if it is to be.
    pub(crate) fn refines_in(&self, now: Duration) -> Option<Duration> {
        let until = self.moved? + STILL;
        (until > now && self.step > 0).then(|| until - now)
    }

    fn is_still(&self, now: Duration) -> bool {
        self.moved.is_none_or(|moved| now >= moved + STILL)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn a_fast_gpu_never_shrinks_the_picture() {
        let mut quality = Quality::default();
        for now in (0..2_000).step_by(16) {
            assert_eq!(quality.scale(ms(now), true, Some(ms(20))), 1.0);
        }
        assert_eq!(
            quality.refines_in(ms(2_000)),
            None,
            "there is nothing to refine"
        );
    }

    #[test]
    fn a_slow_one_does_while_the_hand_moves_and_refines_after() {
        let mut quality = Quality::default();
        assert_eq!(
            quality.scale(ms(0), false, Some(ms(900))),
            1.0,
            "nobody moved yet"
        );
        assert_eq!(quality.scale(ms(10), true, Some(ms(900))), 0.25);
        assert_eq!(
            quality.scale(ms(100), false, Some(ms(900))),
            0.25,
            "a short pause"
        );
        assert_eq!(quality.refines_in(ms(100)), Some(ms(110)));
        assert_eq!(quality.scale(ms(210), false, Some(ms(900))), 1.0);
        assert_eq!(quality.refines_in(ms(210)), None);
    }

    #[test]
    fn sizes_do_not_flicker_around_a_boundary() {
        let mut quality = Quality::default();
        let mut changes = 0;
        let mut last = quality.scale(ms(0), true, Some(ms(100)));
        for n in 0..100 {
            // At three quarters a full picture of 100 ms just fits.
            let full = if n % 2 == 0 { ms(104) } else { ms(96) };
            let scale = quality.scale(ms(n), true, Some(full));
            changes += u32::from(scale != last);
            last = scale;
        }
        assert!(changes <= 1, "{changes} changes of size");
    }

    #[test]
    fn nothing_known_changes_nothing() {
        assert_eq!(Quality::default().scale(ms(0), true, None), 1.0);
    }
}
