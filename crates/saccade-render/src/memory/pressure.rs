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

/// The level-of-detail bias that memory asks for.
///
/// It rises one step when bricks found no room, once per frame that has seen the last rise. It falls
/// one step when the picture is complete and leaves room enough for the step. What did not fit is
/// remembered until the view changes, so that a still camera settles.
#[derive(Debug, Default)]
pub(crate) struct Pressure {
    bias: f32,
    /// First frame drawn with the bias in force.
    since: Frame,
    /// Something found no room since the last report.
    refused: bool,
    /// The highest bias that did not fit this view.
    too_fine: Option<f32>,
    complete: u32,
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
        self.too_fine = None;
        self.complete = 0;
    }

    /// A frame is known: whether it was complete, and which share of the slots it used.
    ///
    /// Returns whether the bias moved or is about to, so that another frame is worth drawing.
    pub(crate) fn report(&mut self, frame: Frame, next: Frame, complete: bool, used: f32) -> bool {
        let refused = std::mem::take(&mut self.refused);
        if frame < self.since {
            return false;
        }
        self.complete = if complete { self.complete + 1 } else { 0 };
        if refused && !complete {
            self.too_fine = Some(self.bias);
            self.change(self.bias + STEP, next);
            return true;
        }
        let finer = self.bias - STEP;
        let may_fall = finer >= 0.0 && self.too_fine.is_none_or(|bias| finer > bias);
        if !(may_fall && complete && used < ROOM) {
            return false;
        }
        if self.complete >= PATIENCE {
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
        let frames = 1..=count;
        let biases = frames.map(|frame| {
            // In whole levels, as a distant view does: all of it changes at once.
            let used = size / shrink.powf(pressure.bias().floor());
            if used > 1.0 {
                pressure.refuse();
            }
            pressure.report(frame, frame + 1, used <= 1.0, used.min(1.0));
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
        let mut pressure = Pressure {
            since: 0,
            ..pressure
        };
        pressure.view_changed();
        assert_eq!(frames(&mut pressure, 200, 0.1, 8.0).last(), Some(&0.0));
    }

    #[test]
    fn frames_from_before_a_change_are_not_counted_again() {
        let mut pressure = Pressure::default();
        pressure.refuse();
        pressure.report(5, 9, false, 1.0);
        for frame in 6..9 {
            pressure.refuse();
            pressure.report(frame, 9, false, 1.0);
        }
        assert_eq!(
            pressure.bias(),
            STEP,
            "frames 6 to 8 were drawn with the old bias"
        );
    }
}
