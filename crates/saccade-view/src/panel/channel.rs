//! How one channel is shown.

use egui::{Color32, Rgba, Slider, SliderClamping, Ui};
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_stream::{Detail, Session};

use crate::detail;
use crate::transfer_editor::{self, TransferEditor};

/// Colours and opacities of a channel.
pub(super) fn transfer(
    ui: &mut Ui,
    session: &mut Session,
    editor: &mut TransferEditor,
    selected: u32,
) {
    let Some(channel) = session.channels().get(selected as usize).cloned() else {
        return;
    };
    let mut transfer = channel.transfer;
    let mut changed = transfer_editor::show(ui, editor, &mut transfer, &channel.histogram);
    changed |= polarity(ui, &mut transfer);
    changed |= colours(ui, &mut transfer.color_map);
    let span = transfer_editor::span(&channel.histogram);
    let [low, high] = &mut transfer.window;
    changed |= ui
        .add(Slider::new(low, 0.0..=span).text("First colour at"))
        .changed();
    changed |= ui
        .add(Slider::new(high, 0.0..=span).text("Last colour at"))
        .changed();
    changed |= opacity_length(ui, &mut transfer, session.volume());
    let done = if changed {
        session.set_transfer_function(selected, transfer)
    } else {
        Ok(())
    };
    let button = ui.add_enabled(!channel.automatic, egui::Button::new("Follow the data"));
    let follow = button
        .on_hover_text("Colours and opacities from the histogram, while data arrive")
        .clicked();
    let followed = match follow {
        true => session.set_automatic_transfer_function(selected),
        false => Ok(()),
    };
    if let Err(error) = done.and(followed) {
        log::error!("{error}");
    }
}

/// A map that has a name, or black to any colour.
fn colours(ui: &mut Ui, map: &mut ColorMap) -> bool {
    let before = *map;
    ui.horizontal(|ui| {
        egui::ComboBox::from_id_salt("colours")
            .selected_text(map_name(*map))
            .show_ui(ui, |ui| {
                for choice in ColorMap::ALL {
                    ui.selectable_value(map, choice, map_name(choice));
                }
            });
        let [r, g, b] = map.linear_rgb(1.0);
        let [r, g, b, _] = Color32::from(Rgba::from_rgb(r, g, b)).to_array();
        let mut color = [r, g, b];
        let button = ui.color_edit_button_srgb(&mut color);
        if button.on_hover_text("Black to any colour").changed() {
            *map = ColorMap::to_color(color);
        }
        ui.label("Colours");
    });
    *map != before
}

/// How thick what has the opacities of the plot is.
fn opacity_length(ui: &mut Ui, transfer: &mut TransferFunction, volume: &Volume) -> bool {
    let thinnest = volume.voxel_nm.min_element() / 10.0;
    let thickest = volume.size_nm().max_element().max(thinnest);
    let slider = Slider::new(&mut transfer.opacity_length_nm, thinnest..=thickest)
        .logarithmic(true)
        .clamping(SliderClamping::Edits)
        .max_decimals(1)
        .text("nm so opaque");
    ui.add(slider)
        .on_hover_text("How thick what has the opacities of the plot is: less is denser")
        .changed()
}

/// How finely a channel is drawn.
pub(super) fn detail(ui: &mut Ui, session: &mut Session, selected: u32) {
    let Some(channel) = session.channels().get(selected as usize) else {
        return;
    };
    let (before, needed) = (channel.detail.clone(), channel.finest_needed);
    let last = session.volume().levels.len().saturating_sub(1);
    let last = u32::try_from(last).unwrap_or(u32::MAX);
    let bounds = detail::bounds(&before, last);
    let coarser = |coarser| detail::chosen(bounds, bounds, last, coarser);
    let mut detail = before.clone();
    let by_content = before == Detail::ByContent;
    let now = match detail::coarser(&before) {
        _ if by_content && needed > 0 => format!("by content: from level {needed}"),
        _ if by_content => "by content".to_owned(),
        0 => "as fine as the view".to_owned(),
        1 => "1 level coarser".to_owned(),
        levels => format!("{levels} levels coarser"),
    };
    egui::ComboBox::from_label("Detail")
        .selected_text(now)
        .show_ui(ui, |ui| {
            for (choice, text) in [
                (coarser(0), "as fine as the view"),
                (Detail::ByContent, "by content"),
                (coarser(1), "1 level coarser"),
                (coarser(2), "2 levels coarser"),
                (coarser(3), "3 levels coarser"),
            ] {
                ui.selectable_value(&mut detail, choice, text);
            }
        })
        .response
        .on_hover_text(
            "Coarser channels leave memory to others. By content: levels that differ by less than a \
             hundredth from the next coarser one are left out.",
        );
    // By content, levels are found and not chosen.
    if last > 0 && !by_content {
        let mut moved = bounds;
        let [finest, coarsest] = &mut moved;
        let finest = ui.add(Slider::new(finest, 0..=last).text("finest level"));
        finest.on_hover_text("No finer one is drawn, however near it is; 0 is the finest there is");
        let coarsest = ui.add(Slider::new(coarsest, 0..=last).text("coarsest level"));
        coarsest.on_hover_text("No coarser one is drawn, however far it is");
        if moved != bounds {
            detail = detail::chosen(moved, bounds, last, detail::coarser(&before));
        }
    }
    if detail != before
        && let Err(error) = session.set_detail(selected, detail)
    {
        log::error!("{error}");
    }
}

fn polarity(ui: &mut Ui, transfer: &mut TransferFunction) -> bool {
    let before = transfer.polarity;
    ui.horizontal(|ui| {
        ui.label("Structures are");
        ui.selectable_value(&mut transfer.polarity, Polarity::Dark, "dark");
        ui.selectable_value(&mut transfer.polarity, Polarity::Bright, "bright");
    });
    transfer.polarity != before
}

/// As people see it in a menu.
fn map_name(map: ColorMap) -> String {
    let name = map.to_string();
    let mut letters = name.chars();
    let first = letters.next().map(|first| first.to_ascii_uppercase());
    first.into_iter().chain(letters).collect()
}

#[cfg(test)]
mod tests {
    use egui::{Context, Event, Modifiers, PointerButton, Pos2, RawInput, Rect, pos2, vec2};
    use saccade_core::transfer::Histogram;

    use super::*;

    /// Shows something, and then does what a hand does.
    fn hand(events: &[Event], mut show: impl FnMut(&mut Ui)) {
        let context = Context::default();
        for event in std::iter::once(None).chain(events.iter().map(Some)) {
            let input = RawInput {
                screen_rect: Some(Rect::from_min_size(Pos2::ZERO, vec2(400.0, 300.0))),
                events: event.cloned().into_iter().collect(),
                ..RawInput::default()
            };
            drop(context.run_ui(input, &mut show));
        }
    }

    fn press(pos: Pos2, pressed: bool) -> Event {
        Event::PointerButton {
            pos,
            button: PointerButton::Primary,
            pressed,
            modifiers: Modifiers::NONE,
        }
    }

    #[test]
    fn colours_that_nobody_touches_stay() {
        let others = [[1, 2, 3], [255, 128, 0], [9, 200, 77]].map(ColorMap::Color);
        for map in ColorMap::ALL.into_iter().chain(others) {
            let mut shown = map;
            hand(&[], |ui| assert!(!colours(ui, &mut shown)));
            assert_eq!(shown, map);
        }
    }

    #[test]
    fn the_opacity_length_stays_until_it_is_moved() {
        let volume = Volume::new("v", glam::UVec3::splat(100), glam::DVec3::splat(4.0)).unwrap();
        let mut transfer = Histogram::default().transfer_function(volume.size_nm());
        // Beyond both ends, as a file may say.
        for length in [0.001, 30.0, 1e6] {
            transfer.opacity_length_nm = length;
            hand(&[], |ui| {
                assert!(!opacity_length(ui, &mut transfer, &volume));
            });
            assert_eq!(transfer.opacity_length_nm, length);
        }
        let mut changes = 0;
        let at = pos2(60.0, 12.0);
        let events = [Event::PointerMoved(at), press(at, true), press(at, false)];
        hand(&events, |ui| {
            changes += u32::from(opacity_length(ui, &mut transfer, &volume));
        });
        assert!(changes > 0);
        assert!((0.4..400.0).contains(&transfer.opacity_length_nm));
    }
}
