//! Smaller pictures where full ones would take too long: while the hand moves, and until the data
//! of a first look are there.

use std::time::Duration;

/// A picture that takes longer than this feels stuck to the hand.
const MOVING: Duration = Duration::from_millis(60);
/// While data arrive, a picture that takes longer keeps the user interface waiting too long.
const ARRIVING: Duration = Duration::from_millis(400);
/// Of the time that any picture takes, so much is borne: making it smaller would not help.
const ANYWAY: Duration = Duration::from_millis(150);
/// Growing back needs this much room, so that the size does not flicker.
const ROOM: f64 = 0.7;
/// After so long without a movement the picture is refined.
const STILL: Duration = Duration::from_millis(200);
/// Sizes a picture may have, as parts of the full one along each axis.
const SCALES: [f64; 7] = [1.0, 0.75, 0.5, 0.35, 0.25, 0.18, 0.125];
/// Where to begin on a device that draws on the CPU.
const CAUTIOUS: usize = 4;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    /// The hand moved, last at this time.
    Moving(Duration),
    /// Still, but the picture of this size is not finished.
    Arriving,
    /// Full size, until something moves or changes.
    Full,
}

/// What happened since the last picture.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Events {
    /// The hand moved the view.
    pub(crate) moving: bool,
    /// The volume changed.
    pub(crate) changed: bool,
    /// The last picture shows all it can, at the size it has.
    pub(crate) settled: bool,
    /// What pictures cost, as far as known.
    pub(crate) cost: Cost,
}

/// What pictures cost, learned from those that were drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Cost {
    /// Time of any picture, however small.
    least: Option<Duration>,
    /// Time of one of full size.
    full: Option<Duration>,
}

impl Cost {
    /// Pictures up to this part of the full one say what even the smallest costs.
    const SMALL: f64 = 1.0 / 15.0;

    /// A picture with `part` of the full one's pixels took `time`.
    ///
    /// Small ones bound the full one's time from above: some of theirs does not grow with pixels.
    pub(crate) fn learn(&mut self, part: f64, time: Duration) {
        let part = part.clamp(1e-4, 1.0);
        let bound = time.div_f64(part);
        self.full = match self.full {
            Some(full) if part < 1.0 => Some(full.min(bound)),
            _ => Some(bound),
        };
        if part <= Self::SMALL {
            self.least = Some(self.least.map_or(time, |least| least.min(time)));
        }
    }
}

/// Chooses the size of pictures.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quality {
    phase: Phase,
    step: usize,
    /// Step of the last picture.
    last: Option<usize>,
}

impl Quality {
    /// For a device that draws on the CPU, or a real one.
    pub(crate) fn new(software: bool) -> Self {
        let step = if software { CAUTIOUS } else { 0 };
        Self {
            phase: Phase::Arriving,
            step,
            last: None,
        }
    }

    /// Part of the full size that the next picture should have.
    pub(crate) fn scale(&mut self, now: Duration, events: Events) -> f64 {
        self.phase = match self.phase {
            _ if events.moving => Phase::Moving(now),
            Phase::Moving(last) if now < last + STILL => Phase::Moving(last),
            Phase::Moving(_) => Phase::Arriving,
            Phase::Full if events.changed => Phase::Arriving,
            other => other,
        };
        let step = match self.phase {
            Phase::Moving(_) => self.fit(events.cost, MOVING),
            Phase::Arriving => self.fit(events.cost, ARRIVING),
            Phase::Full => 0,
        };
        // A finished preview is followed by the full picture.
        let finished = events.settled && self.last == Some(step);
        let step = if self.phase == Phase::Arriving && finished {
            0
        } else {
            step
        };
        if self.phase == Phase::Arriving && step == 0 {
            self.phase = Phase::Full;
        }
        self.last = Some(step);
        SCALES[step]
    }

    /// The largest size whose picture takes no longer than `target`, beyond what any picture takes.
    fn fit(&mut self, cost: Cost, target: Duration) -> usize {
        if let Some(full) = cost.full {
            let anyway = cost.least.unwrap_or_default().min(ANYWAY);
            let target = (target + anyway).as_secs_f64();
            let full = full.as_secs_f64();
            let fits = |step: usize, room: f64| full * SCALES[step].powi(2) <= room * target;
            while self.step + 1 < SCALES.len() && !fits(self.step, 1.0) {
                self.step += 1;
            }
            while self.step > 0 && fits(self.step - 1, ROOM) {
                self.step -= 1;
            }
        }
        self.step
    }

    /// Time until the hand counts as still, if the picture is to be refined then.
    pub(crate) fn refines_in(&self, now: Duration) -> Option<Duration> {
        match self.phase {
            Phase::Moving(last) if self.step > 0 => Some((last + STILL).saturating_sub(now)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn events(full: u64) -> Events {
        let full = Some(ms(full));
        Events {
            cost: Cost { least: None, full },
            ..Events::default()
        }
    }

    fn moving(full: u64) -> Events {
        Events {
            moving: true,
            ..events(full)
        }
    }

    #[test]
    fn a_fast_gpu_never_shrinks_the_picture() {
        let mut quality = Quality::new(false);
        assert_eq!(quality.scale(ms(0), Events::default()), 1.0);
        for now in (0..2_000).step_by(16) {
            assert_eq!(quality.scale(ms(now), moving(20)), 1.0);
        }
        assert_eq!(
            quality.refines_in(ms(2_000)),
            None,
            "there is nothing to refine"
        );
    }

    #[test]
    fn a_slow_one_does_while_the_hand_moves_and_refines_when_the_preview_is_finished() {
        let mut quality = Quality::new(false);
        quality.scale(ms(0), Events::default());
        assert_eq!(quality.scale(ms(5), events(900)), 1.0, "nobody moved yet");
        assert_eq!(quality.scale(ms(10), moving(900)), 0.25);
        assert_eq!(quality.scale(ms(100), events(900)), 0.25, "a short pause");
        assert_eq!(quality.refines_in(ms(100)), Some(ms(110)));
        assert_eq!(
            quality.scale(ms(210), events(900)),
            0.5,
            "still: a better preview"
        );
        let settled = Events {
            settled: true,
            ..events(900)
        };
        assert_eq!(quality.scale(ms(300), settled), 1.0);
        assert_eq!(
            quality.scale(ms(400), events(900)),
            1.0,
            "finer data do not shrink it again"
        );
        assert_eq!(quality.refines_in(ms(400)), None);
    }

    #[test]
    fn a_preview_of_another_size_is_not_this_one_finished() {
        let mut quality = Quality::new(false);
        quality.scale(ms(0), moving(900));
        // Settled is what the picture of the moving size was.
        let settled = Events {
            settled: true,
            ..events(900)
        };
        assert_eq!(quality.scale(ms(300), settled), 0.5);
        assert_eq!(quality.scale(ms(310), settled), 1.0);
    }

    #[test]
    fn changes_bring_the_preview_back_on_slow_devices_only() {
        for (full, scale) in [(900, 0.5), (100, 1.0)] {
            let mut quality = Quality::new(false);
            quality.scale(ms(0), Events::default());
            assert_eq!(quality.scale(ms(10), events(full)), 1.0);
            let changed = Events {
                changed: true,
                ..events(full)
            };
            assert_eq!(quality.scale(ms(20), changed), scale, "{full} ms");
        }
    }

    #[test]
    fn pictures_are_not_made_smaller_than_helps() {
        let mut cost = Cost::default();
        cost.learn(1.0, ms(3_500));
        cost.learn(0.02, ms(400));
        assert_eq!(
            cost.full,
            Some(ms(3_500)),
            "a small picture says only 20 s at most"
        );
        let size = |cost| {
            let events = Events {
                moving: true,
                cost,
                ..Events::default()
            };
            Quality::new(false).scale(ms(0), events)
        };
        assert_eq!(size(cost), 0.18, "much of the 400 ms is spent anyway");
        assert_eq!(
            size(Cost {
                least: None,
                ..cost
            }),
            0.125
        );
        cost.learn(0.5, ms(1_000));
        assert_eq!(cost.full, Some(ms(2_000)));
        cost.learn(1.0, ms(5_000));
        assert_eq!(
            cost.full,
            Some(ms(5_000)),
            "the full one itself is believed"
        );
    }

    #[test]
    fn a_software_device_begins_small() {
        let mut quality = Quality::new(true);
        assert_eq!(quality.scale(ms(0), Events::default()), 0.25);
        assert_eq!(
            quality.scale(ms(10), events(30)),
            1.0,
            "it is fast enough after all"
        );
    }

    #[test]
    fn sizes_do_not_flicker_around_a_boundary() {
        let mut quality = Quality::new(false);
        let mut changes = 0;
        let mut last = quality.scale(ms(0), moving(100));
        for n in 0..100 {
            // At three quarters a picture of 107 ms just fits.
            let full = if n % 2 == 0 { 104 } else { 96 };
            let scale = quality.scale(ms(n), moving(full));
            changes += u32::from(scale != last);
            last = scale;
        }
        assert!(changes <= 1, "{changes} changes of size");
    }
}
