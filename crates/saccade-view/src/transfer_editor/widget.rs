//! The plot: histogram behind, colours below, corners to hold.

use egui::{Color32, Mesh, Pos2, Rect, Sense, Shape, Stroke, Ui, pos2, vec2};
use saccade_core::transfer::{Histogram, TransferFunction};

use super::{PlotPoint, TransferEditor, add, bars, near, remove};

const HEIGHT: f32 = 140.0;
const RAMP: f32 = 12.0;
const CORNER: f32 = 5.0;
/// Bars of the histogram.
const BARS: usize = 256;
/// How far from a corner the hand still takes it \[points\].
const REACH: f32 = 12.0;

/// Shows the plot and applies what the user does to it. Whether `transfer` changed.
///
/// The plot spans the values that there are: 16-bit microscopes rarely use all their bits.
pub(crate) fn show(
    ui: &mut Ui,
    editor: &mut TransferEditor,
    transfer: &mut TransferFunction,
    histogram: &Histogram,
) -> bool {
    let span = span(histogram);
    let mut plotted = stretched(transfer, 1.0 / span);
    let changed = show_plot(ui, editor, &mut plotted, &histogram.bars([0.0, span], BARS));
    if changed {
        *transfer = stretched(&plotted, span);
    }
    changed
}

/// Value at the right edge of the plot.
pub(crate) fn span(histogram: &Histogram) -> f32 {
    let largest = f32::from(histogram.largest());
    let bits = histogram.significant_bits();
    (((1_u32 << bits) - 1) as f32 / largest).min(1.0)
}

/// The same with values `factor` times as large.
fn stretched(transfer: &TransferFunction, factor: f32) -> TransferFunction {
    let mut stretched = transfer.clone();
    stretched.window = stretched.window.map(|value| value * factor);
    for corner in &mut stretched.opacity {
        corner.value *= factor;
    }
    stretched
}

fn show_plot(
    ui: &mut Ui,
    editor: &mut TransferEditor,
    transfer: &mut TransferFunction,
    counts: &[u64],
) -> bool {
    let size = vec2(ui.available_width(), HEIGHT + RAMP);
    let (whole, response) = ui.allocate_exact_size(size, Sense::click_and_drag());
    let response = response.on_hover_text(
        "Drag a corner to change opacity. Double-click adds one, right-click removes it.",
    );
    let plot = Rect::from_min_size(whole.min, vec2(whole.width(), HEIGHT));
    let reach = PlotPoint {
        value: REACH / plot.width(),
        opacity: REACH / plot.height(),
    };

    let mut changed = false;
    if let Some(pointer) = response
        .interact_pointer_pos()
        .map(|p| plot_from_screen(plot, p))
    {
        if response.double_clicked() {
            changed |= near(transfer, pointer, reach).is_none() && add(transfer, pointer);
        } else if response.secondary_clicked() {
            let corner = near(transfer, pointer, reach);
            changed |= corner.is_some_and(|corner| remove(transfer, corner));
        } else if response.drag_started_by(egui::PointerButton::Primary) {
            // Where the button went down, not where the drag was noticed.
            let from = ui.input(|i| i.pointer.press_origin());
            let from = from.map_or(pointer, |p| plot_from_screen(plot, p));
            editor.grab(transfer, from, reach);
        }
        if response.dragged_by(egui::PointerButton::Primary) {
            changed |= editor.drag(transfer, pointer);
        }
    }
    if response.drag_stopped() {
        editor.release();
    }
    let hovered = response.hover_pos().map(|p| plot_from_screen(plot, p));
    let hovered = hovered.and_then(|p| near(transfer, p, reach));
    paint(ui, whole, plot, transfer, counts, editor.held().or(hovered));
    changed
}

fn plot_from_screen(plot: Rect, at: Pos2) -> PlotPoint {
    let within = (at - plot.min) / plot.size();
    PlotPoint {
        value: within.x,
        opacity: 1.0 - within.y,
    }
}

fn screen_from_plot(plot: Rect, value: f32, opacity: f32) -> Pos2 {
    plot.min + vec2(value, 1.0 - opacity) * plot.size()
}

fn paint(
    ui: &Ui,
    whole: Rect,
    plot: Rect,
    transfer: &TransferFunction,
    counts: &[u64],
    active: Option<usize>,
) {
    let painter = ui.painter_at(whole.expand(CORNER + 2.0));
    let visuals = ui.visuals();
    painter.rect_filled(whole, 2.0, visuals.extreme_bg_color);

    let bar = plot.width() / BARS as f32;
    let faint = visuals.weak_text_color().gamma_multiply(0.5);
    for (index, height) in bars(counts).into_iter().enumerate() {
        if height > 0.0 {
            let top = screen_from_plot(plot, index as f32 / BARS as f32, height);
            let rect = Rect::from_min_max(top, pos2(top.x + bar, plot.max.y));
            painter.rect_filled(rect, 0.0, faint);
        }
    }

    painter.add(ramp(
        Rect::from_min_max(pos2(whole.min.x, plot.max.y), whole.max),
        transfer,
    ));
    for end in transfer.window {
        let x = screen_from_plot(plot, end.clamp(0.0, 1.0), 0.0).x;
        painter.vline(
            x,
            plot.y_range(),
            Stroke::new(1.0, visuals.weak_text_color()),
        );
    }

    let line: Vec<Pos2> = std::iter::once((0.0, transfer.opacity_at(0.0)))
        .chain(transfer.opacity.iter().map(|p| (p.value, p.opacity)))
        .chain(std::iter::once((1.0, transfer.opacity_at(1.0))))
        .map(|(value, opacity)| screen_from_plot(plot, value, opacity))
        .collect();
    let colour = visuals.strong_text_color();
    painter.line(line, Stroke::new(1.5, colour));
    for (i, corner) in transfer.opacity.iter().enumerate() {
        let at = screen_from_plot(plot, corner.value, corner.opacity);
        let fill = if active == Some(i) {
            colour
        } else {
            visuals.extreme_bg_color
        };
        painter.circle(at, CORNER, fill, Stroke::new(1.5, colour));
    }
}

/// The colours that values get.
fn ramp(rect: Rect, transfer: &TransferFunction) -> Shape {
    let mut mesh = Mesh::default();
    let steps = 64_u8;
    for step in 0..=steps {
        let value = f32::from(step) / f32::from(steps);
        let [r, g, b] = transfer.color_at(value);
        let colour: Color32 = egui::Rgba::from_rgb(r, g, b).into();
        let x = rect.min.x + value * rect.width();
        mesh.colored_vertex(pos2(x, rect.min.y), colour);
        mesh.colored_vertex(pos2(x, rect.max.y), colour);
        if step > 0 {
            let first = u32::from(step) * 2 - 2;
            mesh.add_triangle(first, first + 1, first + 2);
            mesh.add_triangle(first + 1, first + 2, first + 3);
        }
    }
    Shape::mesh(mesh)
}

#[cfg(test)]
mod tests {
    use egui::{Context, Event, Modifiers, PointerButton, RawInput};
    use saccade_core::transfer::OpacityPoint;

    use super::*;

    /// A hand on the plot of a window 400 points wide, without a screen.
    struct Hand {
        context: Context,
        editor: TransferEditor,
        transfer: TransferFunction,
        time: f64,
        changes: u32,
    }

    impl Hand {
        fn new() -> Self {
            let plain = Histogram::default().transfer_function(glam::DVec3::ONE);
            let corner = |value, opacity| OpacityPoint { value, opacity };
            let transfer = TransferFunction {
                opacity: vec![corner(0.25, 0.5), corner(0.75, 0.5)],
                ..plain
            };
            let context = Context::default();
            let mut hand = Self {
                context,
                editor: TransferEditor::default(),
                transfer,
                time: 0.0,
                changes: 0,
            };
            hand.frame(Vec::new());
            hand
        }

        fn frame(&mut self, events: Vec<Event>) {
            self.time += 0.02;
            let screen = Rect::from_min_size(Pos2::ZERO, vec2(400.0, 300.0));
            let input = RawInput {
                screen_rect: Some(screen),
                time: Some(self.time),
                events,
                ..RawInput::default()
            };
            let histogram = Histogram::default();
            let context = self.context.clone();
            drop(context.run_ui(input, |ui| {
                let changed = show(ui, &mut self.editor, &mut self.transfer, &histogram);
                self.changes += u32::from(changed);
            }));
        }

        fn move_to(&mut self, value: f32, opacity: f32) -> Pos2 {
            let plot = Rect::from_min_size(Pos2::ZERO, vec2(400.0, HEIGHT));
            let at = screen_from_plot(plot, value, opacity);
            self.frame(vec![Event::PointerMoved(at)]);
            at
        }

        fn button(&mut self, pos: Pos2, button: PointerButton, pressed: bool) {
            let modifiers = Modifiers::NONE;
            self.frame(vec![Event::PointerButton {
                pos,
                button,
                pressed,
                modifiers,
            }]);
        }

        fn click(&mut self, value: f32, opacity: f32, button: PointerButton) {
            let at = self.move_to(value, opacity);
            self.button(at, button, true);
            self.button(at, button, false);
        }
    }

    /// Twelve bits in sixteen fill the plot, and what the hand does is told in values.
    #[test]
    fn the_plot_spans_the_values_there_are() {
        let mut histogram = Histogram::new(saccade_core::volume::Dtype::Uint16);
        assert_eq!(span(&histogram), 1.0);
        histogram.add(&3000_u16.to_le_bytes().repeat(500));
        let span = span(&histogram);
        assert!((span - 4095.0 / 65_535.0).abs() < 1e-6);
        let plain = histogram.transfer_function(glam::DVec3::ONE);
        let back = stretched(&stretched(&plain, 1.0 / span), span);
        assert!((back.window[1] - plain.window[1]).abs() < 1e-6);
        assert!((back.opacity[0].value - plain.opacity[0].value).abs() < 1e-6);
    }

    #[test]
    fn a_corner_is_dragged() {
        let mut hand = Hand::new();
        let at = hand.move_to(0.25, 0.5);
        hand.button(at, PointerButton::Primary, true);
        hand.move_to(0.35, 0.6);
        let to = hand.move_to(0.5, 0.9);
        hand.button(to, PointerButton::Primary, false);
        let moved = hand.transfer.opacity[0];
        assert!(
            (moved.value - 0.5).abs() < 0.01 && (moved.opacity - 0.9).abs() < 0.01,
            "{moved:?}"
        );
        let changes = hand.changes;
        hand.move_to(0.1, 0.1);
        assert_eq!(hand.changes, changes, "let go is let go");
    }

    #[test]
    fn two_clicks_add_a_corner_and_the_other_button_removes_one() {
        let mut hand = Hand::new();
        hand.click(0.5, 0.2, PointerButton::Primary);
        assert_eq!(hand.changes, 0, "one click does nothing");
        hand.click(0.5, 0.2, PointerButton::Primary);
        assert_eq!(hand.transfer.opacity.len(), 3);
        assert!((hand.transfer.opacity[1].opacity - 0.2).abs() < 0.01);
        hand.click(0.75, 0.5, PointerButton::Secondary);
        assert_eq!(hand.transfer.opacity.len(), 2);
        assert_eq!(hand.transfer.opacity[0].value, 0.25);
        assert_eq!(hand.changes, 2);
    }
}
