//! Coarser levels when the working set does not fit.

use super::slots::Frame;

/// One step of the bias \[levels\]: the working set shrinks to about 60 % of what it was.
const STEP: f32 = 0.25;
/// No volume has more levels.
const MOST: f32 = 32.0;
/// Share of the slots in use below which a finer level is tried.
const ROOM: f32 = 0.5;
/// Complete frames in a row before it is.
const PATIENCE: u32 = 4;
/// Frames for which what did not fit one view counts in those that follow it: while the camera moves, a level that does
/// not fit is tried, and its bricks are loaded, once in so many frames.
const REMEMBERED: u32 = 40;
/// Frames in a row in which bricks of the coarsest level found no room, before that is taken for what it will stay.
const STARVES: u32 = 3;

/// The level-of-detail bias that memory asks for.
///
/// It rises one step when bricks found no room, once per frame that has seen the last rise. It falls
/// one step when some pictures in a row are complete and leave room enough for the step, whether the camera moves or
/// not. What did not fit is remembered as long as the view stays, so that a still camera settles, and a little longer.
#[derive(Debug, Default)]
pub(crate) struct Pressure {
    bias: f32,
    /// First frame drawn with the bias in force.
    since: Frame,
    /// Something found no room since the last report.
    refused: bool,
    /// The highest bias that did not fit this view, or one of those before it.
    too_fine: Option<f32>,
    /// Frames after which that is forgotten, once the view is another.
    forgotten_in: Option<u32>,
    complete: u32,
    /// Frames in a row in which nothing coarser could help.
    starved: u32,
}

impl Pressure {
    /// In force \[levels\].
    pub(crate) fn bias(&self) -> f32 {
        self.bias
    }

    /// Something found no room.
    pub(crate) fn refuse(&mut self) {
        self.refused = true;
    }

    /// Another view: what did not fit the last one may fit this one.
    pub(crate) fn view_changed(&mut self) {
        // Views that follow each other do not put it off.
        if self.too_fine.is_some() && self.forgotten_in.is_none() {
            self.forgotten_in = Some(REMEMBERED);
        }
    }

    /// Whether bricks find no room, and coarser ones do not exist.
    pub(crate) fn is_starved(&self) -> bool {
        self.starved >= STARVES
    }

    /// A frame is known: whether it was complete, and all that it wanted of the coarsest level, and which share of the
    /// slots it used.
    ///
    /// Returns whether the bias moved or is about to, so that another frame is worth drawing.
    pub(crate) fn report(
        &mut self,
        frame: Frame,
        next: Frame,
        (complete, coarsest): (bool, bool),
        used: f32,
    ) -> bool {
        let refused = std::mem::take(&mut self.refused);
        if frame < self.since {
            return false;
        }
        self.complete = if complete { self.complete + 1 } else { 0 };
        if refused && !complete && coarsest {
            self.starved = self.starved.saturating_add(1);
            return !self.is_starved();
        }
        self.starved = 0;
        if refused && !complete {
            (self.too_fine, self.forgotten_in) = (Some(self.bias), None);
            self.change(self.bias + STEP, next);
            return true;
        }
        self.forgotten_in = self.forgotten_in.map(|frames| frames.saturating_sub(1));
        if self.forgotten_in == Some(0) {
            (self.too_fine, self.forgotten_in) = (None, None);
        }
        let finer = self.bias - STEP;
        let known_too_fine = self.too_fine.is_some_and(|bias| finer <= bias);
        let may_fall = finer >= 0.0 && !(known_too_fine && self.forgotten_in.is_none());
        if !(may_fall && complete && used < ROOM) {
            return false;
        }
        if self.complete >= PATIENCE && !known_too_fine {
            self.change(finer, next);
        }
        true
    }

    fn change(&mut self, bias: f32, next: Frame) {
        self.bias = bias.clamp(0.0, MOST);
        self.since = next;
        self.complete = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames of a view whose working set at bias 0 is `size` times the memory, shrinking by
    /// `shrink` a level; returns the bias after each.
    fn frames(pressure: &mut Pressure, count: u64, size: f32, shrink: f32) -> Vec<f32> {
        looks(pressure, count, size, shrink, false)
    }

    /// The same with a camera that moves, or stays.
    fn looks(pressure: &mut Pressure, count: u64, size: f32, shrink: f32, moves: bool) -> Vec<f32> {
        let first = pressure.since + 1;
        let biases = (first..first + count).map(|frame| {
            if moves {
                pressure.view_changed();
            }
            // In whole levels, as a distant view does: all of it changes at once.
            let used = size / shrink.powf(pressure.bias().floor());
            if used > 1.0 {
                pressure.refuse();
            }
            pressure.report(frame, frame + 1, (used <= 1.0, false), used.min(1.0));
            pressure.bias()
        });
        biases.collect()
    }

    #[test]
    fn settles_for_any_size_and_shrinkage() {
        for size in [0.3, 1.1, 3.0, 50.0, 4000.0] {
            for shrink in [4.0, 8.0] {
                let mut pressure = Pressure::default();
                let biases = frames(&mut pressure, 300, size, shrink);
                let settled = biases[200..].iter().all(|b| *b == biases[299]);
                assert!(settled, "size {size}, shrinkage {shrink}: {biases:?}");
                assert_eq!(biases[299] == 0.0, size <= 1.0);
                assert!(size / shrink.powf(biases[299].floor()) <= 1.0);
            }
        }
    }

    #[test]
    fn falls_again_when_the_view_allows() {
        let mut pressure = Pressure::default();
        frames(&mut pressure, 100, 50.0, 8.0);
        assert!(pressure.bias() >= 1.0);
        pressure.view_changed();
        assert_eq!(frames(&mut pressure, 200, 0.1, 8.0).last(), Some(&0.0));
    }

    #[test]
    fn falls_while_the_camera_moves() {
        let mut pressure = Pressure::default();
        looks(&mut pressure, 100, 50.0, 8.0, true);
        assert!(pressure.bias() >= 1.0);
        assert_eq!(looks(&mut pressure, 300, 0.1, 8.0, true).last(), Some(&0.0));
    }

    /// A level whose bricks fill four times the memory, while the next coarser one needs less than half of it.
    #[test]
    fn a_moving_camera_tries_what_does_not_fit_now_and_then_only() {
        let mut pressure = Pressure::default();
        looks(&mut pressure, 100, 4.0, 16.0, true);
        let biases = looks(&mut pressure, 400, 4.0, 16.0, true);
        let tried = biases
            .windows(2)
            .filter(|pair| pair[1].floor() < pair[0].floor());
        let tried = tried.count();
        assert!(
            (3..=400 / REMEMBERED as usize + 1).contains(&tried),
            "{tried} times: {biases:?}"
        );
    }

    #[test]
    fn who_is_starved_at_the_coarsest_level_is_told_so_until_there_is_room() {
        let mut pressure = Pressure::default();
        let mut frame = 0;
        let mut report = |pressure: &mut Pressure, refused, complete| {
            frame += 1;
            if refused {
                pressure.refuse();
            }
            pressure.report(frame, frame + 1, (complete, true), 1.0)
        };
        assert!(report(&mut pressure, true, false) && !pressure.is_starved());
        assert!(report(&mut pressure, true, false) && !pressure.is_starved());
        let again = report(&mut pressure, true, false);
        assert!(pressure.is_starved() && !again, "drawn for nothing");
        assert_eq!(pressure.bias(), 0.0, "nothing is coarser");
        report(&mut pressure, false, true);
        assert!(!pressure.is_starved());
    }

    #[test]
    fn frames_from_before_a_change_are_not_counted_again() {
        let mut pressure = Pressure::default();
        pressure.refuse();
        pressure.report(5, 9, (false, false), 1.0);
        for frame in 6..9 {
            pressure.refuse();
            pressure.report(frame, 9, (false, false), 1.0);
        }
        assert_eq!(
            pressure.bias(),
            STEP,
            "frames 6 to 8 were drawn with the old bias"
        );
    }
}
