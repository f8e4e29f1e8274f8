//! The panel beside the picture and the line below it.

use egui::{Color32, RichText, Slider, Ui};
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_stream::Session;

use crate::facts::{Piece, Tone};
use crate::transfer_editor::{self, TransferEditor};

/// What the user may set, apart from the camera and the transfer function.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Settings {
    pub(crate) lod_bias: f32,
    pub(crate) substitute: bool,
    pub(crate) false_colors: bool,
    /// Linear RGB.
    pub(crate) background: [f32; 3],
}

/// Shows the panel and applies what the user does in it. Whether the camera is to go home.
pub(crate) fn show(
    ui: &mut Ui,
    session: &mut Session,
    editor: &mut TransferEditor,
    settings: &mut Settings,
) -> bool {
    egui::ScrollArea::vertical()
        .show(ui, |ui| {
            describe(ui, &session.volume().clone());
            ui.separator();
            transfer(ui, session, editor);
            ui.separator();
            picture(ui, settings);
            ui.separator();
            let home = ui
                .button("Whole volume")
                .on_hover_text("Double-click, F or R")
                .clicked();
            ui.add_space(4.0);
            ui.weak(
                "Drag turns, right drag or shift pans, wheel zooms. Arrow keys turn, + and - zoom.",
            );
            home
        })
        .inner
}

fn describe(ui: &mut Ui, volume: &Volume) {
    ui.heading(&volume.name);
    let extent = volume.extent();
    ui.label(format!("{} × {} × {} voxels", extent.x, extent.y, extent.z));
    let nm = volume.voxel_nm;
    ui.label(format!("{} × {} × {} nm per voxel", nm.x, nm.y, nm.z));
}

fn transfer(ui: &mut Ui, session: &mut Session, editor: &mut TransferEditor) {
    let mut transfer = session.transfer_function().clone();
    let mut changed =
        transfer_editor::show(ui, editor, &mut transfer, &session.histogram().clone());
    changed |= polarity(ui, &mut transfer);
    egui::ComboBox::from_label("Colours")
        .selected_text(map_name(transfer.color_map))
        .show_ui(ui, |ui| {
            for map in ColorMap::ALL {
                let value = &mut transfer.color_map;
                changed |= ui.selectable_value(value, map, map_name(map)).changed();
            }
        });
    let [low, high] = &mut transfer.window;
    changed |= ui
        .add(Slider::new(low, 0.0..=1.0).text("First colour at"))
        .changed();
    changed |= ui
        .add(Slider::new(high, 0.0..=1.0).text("Last colour at"))
        .changed();
    if changed {
        session.set_transfer_function(transfer);
    }
    let automatic = session.is_transfer_function_automatic();
    let button = ui.add_enabled(!automatic, egui::Button::new("Follow the data"));
    if button
        .on_hover_text("Colours and opacities from the histogram, while data arrive")
        .clicked()
    {
        session.set_automatic_transfer_function();
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

fn map_name(map: ColorMap) -> &'static str {
    match map {
        ColorMap::Gray => "Gray",
        ColorMap::Bone => "Bone",
        ColorMap::Viridis => "Viridis",
        ColorMap::Inferno => "Inferno",
        ColorMap::Green => "Green",
        ColorMap::Magenta => "Magenta",
    }
}

fn picture(ui: &mut Ui, settings: &mut Settings) {
    ui.add(Slider::new(&mut settings.lod_bias, -2.0..=4.0).text("Coarser by levels"))
        .on_hover_text("0 is one voxel a pixel; higher is faster and needs less data");
    ui.checkbox(
        &mut settings.substitute,
        "Other levels stand in for missing bricks",
    );
    ui.checkbox(&mut settings.false_colors, "Tint what is not at its level");
    ui.horizontal(|ui| {
        ui.color_edit_button_rgb(&mut settings.background);
        ui.label("Background");
    });
}

/// The fidelity line.
pub(crate) fn line(ui: &mut Ui, pieces: &[Piece]) {
    ui.horizontal_wrapped(|ui| {
        for (i, piece) in pieces.iter().enumerate() {
            if i > 0 {
                ui.weak("·");
            }
            let text = RichText::new(&piece.text).color(colour(ui, piece.tone));
            let label = ui.label(text);
            if let Some(more) = &piece.more {
                label.on_hover_text(more);
            }
        }
    });
}

fn colour(ui: &Ui, tone: Tone) -> Color32 {
    match tone {
        Tone::Plain => ui.visuals().text_color(),
        Tone::Good => Color32::from_rgb(110, 200, 120),
        Tone::Busy => Color32::from_rgb(230, 180, 80),
        Tone::Bad => ui.visuals().error_fg_color,
    }
}
