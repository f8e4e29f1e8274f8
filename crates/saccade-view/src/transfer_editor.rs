//! Editing a transfer function: which corner the hand holds, and what moving it does.
//!
//! Positions are in the plot's own space: value to the right, opacity up, both `[0, 1]`.

mod widget;

use saccade_core::transfer::{OpacityPoint, TransferFunction};

pub(crate) use widget::{show, span};

/// Corners keep this distance in value: a slope is never infinite.
const APART: f32 = 0.5 / 255.0;

/// What is being edited.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct TransferEditor {
    /// Corner in the hand.
    held: Option<usize>,
}

/// A position in the plot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PlotPoint {
    pub(crate) value: f32,
    pub(crate) opacity: f32,
}

impl TransferEditor {
    /// Takes hold of the corner within `reach` of `at`, the nearest if there are several.
    pub(crate) fn grab(&mut self, transfer: &TransferFunction, at: PlotPoint, reach: PlotPoint) {
        self.held = near(transfer, at, reach);
    }

    /// Moves the corner in the hand. It stays between its neighbours. Whether anything moved.
    pub(crate) fn drag(&mut self, transfer: &mut TransferFunction, to: PlotPoint) -> bool {
        let Some(held) = self.held.filter(|&held| held < transfer.opacity.len()) else {
            return false;
        };
        let value_of = |i: usize| transfer.opacity[i].value;
        let low = held
            .checked_sub(1)
            .map_or(0.0, |left| value_of(left) + APART);
        let right = held + 1;
        let high = if right < transfer.opacity.len() {
            value_of(right) - APART
        } else {
            1.0
        };
        let corner = OpacityPoint {
            value: within(to.value, low, high),
            opacity: within(to.opacity, 0.0, 1.0),
        };
        let moved = transfer.opacity[held] != corner;
        transfer.opacity[held] = corner;
        moved
    }

    /// Lets go.
    pub(crate) fn release(&mut self) {
        self.held = None;
    }

    /// The corner in the hand.
    pub(crate) fn held(self) -> Option<usize> {
        self.held
    }
}

/// `x` between two bounds; the lower where there is no room, or no number.
fn within(x: f32, low: f32, high: f32) -> f32 {
    if x.is_nan() {
        low
    } else {
        x.min(high).max(low)
    }
}

/// The corner within `reach` of `at`.
pub(crate) fn near(transfer: &TransferFunction, at: PlotPoint, reach: PlotPoint) -> Option<usize> {
    let distance = |corner: &OpacityPoint| {
        let (dx, dy) = (corner.value - at.value, corner.opacity - at.opacity);
        (dx / reach.value).hypot(dy / reach.opacity)
    };
    let corners = transfer.opacity.iter().map(distance).enumerate();
    let nearest = corners.min_by(|(_, a), (_, b)| a.total_cmp(b))?;
    (nearest.1 <= 1.0).then_some(nearest.0)
}

/// Adds a corner where there is room for one. Whether it did.
pub(crate) fn add(transfer: &mut TransferFunction, at: PlotPoint) -> bool {
    let corner = OpacityPoint {
        value: within(at.value, 0.0, 1.0),
        opacity: within(at.opacity, 0.0, 1.0),
    };
    let next = transfer.opacity.partition_point(|p| p.value < corner.value);
    let left = next.checked_sub(1).map(|left| transfer.opacity[left].value);
    let right = transfer.opacity.get(next).map(|right| right.value);
    let free = |other: Option<f32>| other.is_none_or(|v| (v - corner.value).abs() >= APART);
    let room = free(left) && free(right);
    if room {
        transfer.opacity.insert(next, corner);
    }
    room
}

/// Removes a corner; the last one stays. Whether it did.
pub(crate) fn remove(transfer: &mut TransferFunction, corner: usize) -> bool {
    let removes = corner < transfer.opacity.len() && transfer.opacity.len() > 1;
    if removes {
        transfer.opacity.remove(corner);
    }
    removes
}

/// Height of each bar of a histogram, `[0, 1]`: logarithmic, since tissue is mostly background.
pub(crate) fn bars(counts: &[u64]) -> Vec<f32> {
    let most = counts.iter().copied().max().unwrap_or(0);
    let full = (most as f32).ln_1p();
    let height = |&count: &u64| match most {
        0 => 0.0,
        _ => (count as f32).ln_1p() / full,
    };
    counts.iter().map(height).collect()
}

#[cfg(test)]
mod tests {
    use saccade_core::transfer::Histogram;

    use super::*;

    const REACH: PlotPoint = PlotPoint {
        value: 0.03,
        opacity: 0.05,
    };

    fn at(value: f32, opacity: f32) -> PlotPoint {
        PlotPoint { value, opacity }
    }

    fn corner(value: f32, opacity: f32) -> OpacityPoint {
        OpacityPoint { value, opacity }
    }

    fn transfer(corners: &[(f32, f32)]) -> TransferFunction {
        let plain = Histogram::default().transfer_function(glam::DVec3::ONE);
        TransferFunction {
            opacity: corners.iter().map(|&(v, o)| corner(v, o)).collect(),
            ..plain
        }
    }

    #[test]
    fn the_nearest_corner_within_reach_is_taken() {
        let transfer = transfer(&[(0.2, 0.5), (0.22, 0.5), (0.8, 1.0)]);
        for (at, want) in [
            (at(0.2, 0.5), Some(0)),
            (at(0.215, 0.51), Some(1)),
            (at(0.82, 0.97), Some(2)),
            (at(0.5, 0.5), None),
            (at(0.2, 0.56), None),
        ] {
            assert_eq!(near(&transfer, at, REACH), want, "at {at:?}");
        }
    }

    #[test]
    fn corners_never_pass_their_neighbours() {
        for to in [-1.0, 0.0, 0.3, 0.5, 0.7, 2.0, f32::NAN, f32::INFINITY] {
            let mut transfer = transfer(&[(0.2, 0.5), (0.5, 0.5), (0.6, 0.5)]);
            let mut editor = TransferEditor::default();
            editor.grab(&transfer, at(0.5, 0.5), REACH);
            editor.drag(&mut transfer, at(to, to));
            let values: Vec<f32> = transfer.opacity.iter().map(|p| p.value).collect();
            assert!(
                values.windows(2).all(|v| v[0] < v[1]),
                "{values:?} after {to}"
            );
            assert!((0.0..=1.0).contains(&transfer.opacity[1].opacity));
            assert_eq!(transfer.opacity[0], corner(0.2, 0.5), "the others stay");
        }
    }

    #[test]
    fn nothing_moves_without_a_corner_in_the_hand() {
        let mut transfer = transfer(&[(0.2, 0.5)]);
        let mut editor = TransferEditor::default();
        assert!(!editor.drag(&mut transfer, at(0.9, 0.9)));
        editor.grab(&transfer, at(0.2, 0.5), REACH);
        assert!(editor.drag(&mut transfer, at(0.9, 0.9)));
        assert!(
            !editor.drag(&mut transfer, at(0.9, 0.9)),
            "it is already there"
        );
        editor.release();
        assert!(!editor.drag(&mut transfer, at(0.1, 0.1)));
        // The transfer function was replaced under the hand.
        editor.held = Some(7);
        assert!(!editor.drag(&mut transfer, at(0.1, 0.1)));
    }

    #[test]
    fn corners_are_added_in_order_and_removed_to_the_last() {
        let mut transfer = transfer(&[(0.2, 0.0), (0.8, 1.0)]);
        assert!(add(&mut transfer, at(0.5, 0.9)));
        assert!(add(&mut transfer, at(3.0, -1.0)));
        let all = [(0.2, 0.0), (0.5, 0.9), (0.8, 1.0), (1.0, 0.0)].map(|(v, o)| corner(v, o));
        assert_eq!(transfer.opacity, all);
        assert!(
            !add(&mut transfer, at(0.5001, 0.2)),
            "no room beside the second"
        );
        assert!(!remove(&mut transfer, 9));
        for left in [3, 2, 1] {
            assert!(remove(&mut transfer, 0));
            assert_eq!(transfer.opacity.len(), left);
        }
        assert!(!remove(&mut transfer, 0));
    }

    #[test]
    fn bars_are_between_nothing_and_all() {
        assert_eq!(bars(&[0; 7]), [0.0; 7]);
        let mut counts = [0; 256];
        (counts[3], counts[4]) = (1, 1_000_000);
        let bars = bars(&counts);
        assert_eq!((bars[0], bars[4]), (0.0, 1.0));
        assert!(bars[3] > 0.03, "a single voxel is seen");
    }
}
