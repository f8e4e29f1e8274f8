//! The panel beside the picture and the line below it.

mod channel;

use egui::{Color32, RichText, Slider, SliderClamping, Ui};
use saccade_core::camera::Camera;
use saccade_core::volume::Volume;
use saccade_render::{FalseColors, Heat, Mode, Work};
use saccade_stream::Session;

use crate::facts::{Piece, Tone};
use crate::plane::{AXES, Plane};
use crate::shown::{MOST_CUTS, Shown, WORKS};
use crate::transfer_editor::{self, TransferEditor};

/// What the user may set, apart from the camera and the transfer function.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Settings {
    pub(crate) lod_bias: f32,
    pub(crate) substitute: bool,
    pub(crate) false_colors: FalseColors,
    /// Linear RGB.
    pub(crate) background: [f32; 3],
    /// Which part of the volume, and how.
    pub(crate) shown: Shown,
    /// Channel whose colours and opacities are edited.
    pub(crate) selected: u32,
}

/// Opens the image at an address.
pub(crate) type Open = Box<dyn Fn(&str)>;

/// Where the user types an address.
pub(crate) struct Opener {
    address: String,
    open: Open,
}

impl Opener {
    pub(crate) fn new(open: Open) -> Self {
        let address = String::new();
        Self { address, open }
    }

    fn show(&mut self, ui: &mut Ui) {
        ui.collapsing("Open an image", |ui| {
            let hint = "https://host/image.zarr";
            let field = egui::TextEdit::singleline(&mut self.address).hint_text(hint);
            let field = ui.add(field.desired_width(f32::INFINITY));
            let entered = field.lost_focus() && ui.input(|i| i.key_pressed(egui::Key::Enter));
            let named = !self.address.trim().is_empty();
            let button = ui.add_enabled(named, egui::Button::new("Open"));
            let button = button.on_hover_text(
                "An OME-Zarr image or a Neuroglancer precomputed volume, read by this page itself",
            );
            if named && (entered || button.clicked()) {
                (self.open)(&self.address);
            }
        });
    }
}

/// What the panel tells of the volume, and how another is opened.
pub(crate) struct About<'a> {
    /// From where it is seen.
    pub(crate) camera: &'a Camera,
    /// What the user should know of how values are shown, in sentences.
    pub(crate) notes: &'a [String],
    /// Where another image can be opened.
    pub(crate) opener: Option<&'a mut Opener>,
}

/// Shows the panel and applies what the user does in it. Whether the camera is to go home.
pub(crate) fn show(
    ui: &mut Ui,
    session: &mut Session,
    editor: &mut TransferEditor,
    settings: &mut Settings,
    about: About<'_>,
) -> bool {
    egui::ScrollArea::vertical()
        .show(ui, |ui| {
            describe(ui, &session.volume().clone());
            for note in about.notes {
                ui.weak(note);
            }
            if let Some(opener) = about.opener {
                opener.show(ui);
            }
            ui.separator();
            if session.channels().len() > 1 {
                channels(ui, session, &mut settings.selected);
                ui.separator();
            }
            channel::transfer(ui, session, editor, settings.selected);
            channel::detail(ui, session, settings.selected);
            ui.separator();
            let volume = session.volume().clone();
            shown(ui, session, settings, &volume, about.camera);
            ui.separator();
            picture(ui, settings, &volume);
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

/// The volume's channels: which are seen, and which is edited.
fn channels(ui: &mut Ui, session: &mut Session, selected: &mut u32) {
    let list = session.channels().iter();
    let list: Vec<_> = list
        .map(|c| {
            (
                c.name.clone(),
                c.visible,
                c.transfer.color_at(c.transfer.window[1]),
            )
        })
        .collect();
    let mut refused = None;
    egui::ScrollArea::vertical()
        .id_salt("channels")
        .max_height(180.0)
        .show(ui, |ui| {
            for (index, (name, visible, [r, g, b])) in (0..).zip(list) {
                ui.horizontal(|ui| {
                    let mut seen = visible;
                    if ui.checkbox(&mut seen, "").changed() {
                        refused = session.set_visible(index, seen).err();
                    }
                    let color: Color32 = egui::Rgba::from_rgb(r, g, b).into();
                    let text = RichText::new(name).color(color);
                    if ui.selectable_label(*selected == index, text).clicked() {
                        *selected = index;
                    }
                });
            }
        });
    if let Some(error) = refused {
        // Said for as long as the pointer stays.
        ui.colored_label(ui.visuals().error_fg_color, error.to_string());
    }
}

/// How samples become a picture, and what is cut away.
fn shown(
    ui: &mut Ui,
    session: &mut Session,
    settings: &mut Settings,
    volume: &Volume,
    camera: &Camera,
) {
    let shown = &mut settings.shown;
    ui.horizontal(|ui| {
        for (mode, name, what) in [
            (
                Mode::EmissionAbsorption,
                "Light",
                "Light that matter sends out and takes up",
            ),
            (
                Mode::Maximum,
                "Maximum",
                "The strongest value along each ray",
            ),
            (
                Mode::IsoSurface,
                "Surface",
                "Where values pass a bound, lit from the eye",
            ),
        ] {
            ui.selectable_value(&mut shown.mode, mode, name)
                .on_hover_text(what);
        }
    });
    if shown.drawn_mode() == Mode::IsoSurface
        && let Some(channel) = session.channels().get(settings.selected as usize)
    {
        let span = transfer_editor::span(&channel.histogram);
        let mut iso = channel.iso_value();
        let slider = ui.add(Slider::new(&mut iso, 0.0..=span).text("Surface at"));
        if slider.changed()
            && let Err(error) = session.set_iso(settings.selected, Some(iso))
        {
            log::error!("{error}");
        }
    }
    let extent = volume.extent().as_dvec3();
    slice(ui, shown, volume, camera);
    heat(ui, &mut shown.heat);
    ui.collapsing("Cut away", |ui| {
        let [mut low, mut high] = shown.within.unwrap_or([glam::DVec3::ZERO, extent]);
        let mut changed = false;
        for (axis, name) in AXES.into_iter().enumerate() {
            let from = Slider::new(&mut low[axis], 0.0..=extent[axis]).text(format!("{name} from"));
            changed |= ui.add(from).changed();
            let to = Slider::new(&mut high[axis], 0.0..=extent[axis]).text(format!("{name} to"));
            changed |= ui.add(to).changed();
        }
        if changed {
            shown.within = Some([low, high.max(low)]);
        }
        for cut in &mut shown.cuts {
            let Some(plane) = cut else { continue };
            let keeps = ui
                .horizontal(|ui| {
                    // With two buttons beside it.
                    ui.spacing_mut().slider_width = 80.0;
                    along_normal(ui, plane, volume, "nm");
                    let flip = ui.button("Flip");
                    if flip.on_hover_text("Cut away the other side").clicked() {
                        *plane = plane.flipped();
                    }
                    !ui.button("×")
                        .on_hover_text("Take this plane away")
                        .clicked()
                })
                .inner;
            if !keeps {
                *cut = None;
            }
        }
        ui.horizontal(|ui| {
            let free = shown.cuts.iter().any(Option::is_none);
            let new = ui.add_enabled(free, egui::Button::new("Plane facing the eye"));
            if new
                .on_hover_text("What is nearer than the middle of the view is cut away")
                .clicked()
            {
                shown.cut(facing(camera, volume));
            }
            if ui.button("Nothing").clicked() {
                (shown.within, shown.cuts) = (None, [None; MOST_CUTS]);
            }
        });
    });
}

/// One plane, or a slab around it, instead of all depths.
fn slice(ui: &mut Ui, shown: &mut Shown, volume: &Volume, camera: &Camera) {
    let extent = volume.extent().as_dvec3();
    ui.horizontal(|ui| {
        ui.label("Slice");
        let axis = shown.slice.map(|plane| plane.axis().map(|(axis, _)| axis));
        if ui.selectable_label(axis.is_none(), "none").clicked() {
            shown.slice = None;
        }
        for (index, name) in AXES.into_iter().enumerate() {
            if ui
                .selectable_label(axis == Some(Some(index)), name)
                .clicked()
            {
                let middle = (extent[index] / 2.0).floor();
                shown.slice = Some(Plane::through_voxel(index, middle));
            }
        }
        let oblique = ui.selectable_label(axis == Some(None), "oblique");
        if oblique
            .on_hover_text("Facing the eye, through the middle of the view")
            .clicked()
        {
            shown.slice = Some(facing(camera, volume));
        }
    });
    let Some(plane) = &mut shown.slice else {
        return;
    };
    match plane.axis() {
        Some((axis, at)) => {
            let (mut voxel, last) = (at - 0.5, extent[axis] - 1.0);
            let slider = Slider::new(&mut voxel, 0.0..=last).step_by(1.0);
            let slider = slider.clamping(SliderClamping::Edits).text("voxel");
            if ui.add(slider).changed() {
                *plane = Plane::through_voxel(axis, voxel);
            }
        }
        None => along_normal(ui, plane, volume, "nm from the middle"),
    }
    let thickest = 2.0 * plane.reach(volume);
    let slab = Slider::new(&mut shown.slab_nm, 0.0..=thickest).clamping(SliderClamping::Edits);
    ui.add(slab.text("nm thick"));
}

/// Moves a plane along its normal.
fn along_normal(ui: &mut Ui, plane: &mut Plane, volume: &Volume, unit: &str) {
    let (mut offset, reach) = (plane.offset(volume), plane.reach(volume));
    let slider = ui.add(Slider::new(&mut offset, -reach..=reach).text(unit));
    let slider = slider.on_hover_text("How far from the middle of the volume, along its normal");
    if slider.changed() {
        *plane = plane.at_offset(offset, volume);
    }
}

/// The plane through the middle of the view that faces the eye.
fn facing(camera: &Camera, volume: &Volume) -> Plane {
    Plane {
        normal: camera.physical_from_eye_axes().z_axis,
        point: camera.target.xyz / volume.voxel_nm,
    }
}

/// The work of rays instead of the volume.
fn heat(ui: &mut Ui, heat: &mut Option<Heat>) {
    let name = |heat: Option<Heat>| heat.map_or("the volume", |heat| work_name(heat.of));
    let before = *heat;
    egui::ComboBox::from_label("is drawn")
        .selected_text(name(before))
        .show_ui(ui, |ui| {
            ui.selectable_value(heat, None, name(None));
            for (_, of, full) in WORKS {
                let is_this = before.is_some_and(|heat| heat.of == of);
                if ui.selectable_label(is_this, work_name(of)).clicked() && !is_this {
                    *heat = Some(Heat { of, full });
                }
            }
        })
        .response
        .on_hover_text("What each ray took: black, red, yellow, white");
    if let Some(heat) = heat {
        ui.add(
            Slider::new(&mut heat.full, 1.0..=4096.0)
                .logarithmic(true)
                .clamping(SliderClamping::Edits)
                .text("a ray is white"),
        );
    }
}

fn work_name(work: Work) -> &'static str {
    match work {
        Work::Lookups => "page table entries a ray",
        Work::Nodes => "octree nodes a ray",
        Work::Samples => "samples a ray",
    }
}

fn picture(ui: &mut Ui, settings: &mut Settings, volume: &Volume) {
    // What was asked for beyond its ends stays until somebody moves it; so with the others.
    let bias = Slider::new(&mut settings.lod_bias, -2.0..=4.0).clamping(SliderClamping::Edits);
    ui.add(bias.text("Coarser by levels"))
        .on_hover_text("0 is one voxel a pixel; higher is faster and needs less data");
    ui.checkbox(
        &mut settings.substitute,
        "Other levels stand in for missing bricks",
    );
    false_colors(ui, &mut settings.false_colors, volume);
    ui.horizontal(|ui| {
        // The button rounds.
        let mut background = settings.background;
        if ui.color_edit_button_rgb(&mut background).changed() {
            settings.background = background;
        }
        ui.label("Background");
    });
}

/// What colours tell besides values.
fn false_colors(ui: &mut Ui, colors: &mut FalseColors, volume: &Volume) {
    let choices = [
        (FalseColors::None, "none", "The transfer function's alone"),
        (
            FalseColors::Residency,
            "residency",
            "From green to red what is coarser than it should be, blue what is finer, magenta what is missing",
        ),
        (
            FalseColors::Level,
            "level",
            "The level that each part is drawn from",
        ),
    ];
    ui.horizontal(|ui| {
        ui.label("Tint");
        for (choice, name, what) in choices {
            ui.selectable_value(colors, choice, name)
                .on_hover_text(what);
        }
    });
    if *colors == FalseColors::Level {
        ui.horizontal_wrapped(|ui| {
            ui.spacing_mut().item_spacing.x = 2.0;
            for (level, _) in (0..).zip(&volume.levels) {
                let [r, g, b] = FalseColors::of_level(level);
                let text = RichText::new(format!(" {level} ")).color(Color32::BLACK);
                ui.label(text.background_color(egui::Rgba::from_rgb(r, g, b)));
            }
        });
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_asked_for_stays_until_somebody_moves_it() {
        let size = glam::DVec3::splat(4.0);
        let volume = Volume::new("v", glam::UVec3::splat(100), size).unwrap();
        let shown = Shown {
            slice: Some(Plane::across(2, 50.0)),
            slab_nm: 1e6,
            heat: Some(Heat {
                of: Work::Nodes,
                full: 0.5,
            }),
            ..Shown::default()
        };
        let mut settings = Settings {
            lod_bias: -3.0,
            substitute: true,
            false_colors: FalseColors::Level,
            background: [0.0, 0.5, 1.0],
            shown,
            selected: 0,
        };
        let before = settings;
        let camera = Camera::around(&volume);
        let context = egui::Context::default();
        for _ in 0..2 {
            drop(context.run_ui(egui::RawInput::default(), |ui| {
                slice(ui, &mut settings.shown, &volume, &camera);
                heat(ui, &mut settings.shown.heat);
                picture(ui, &mut settings, &volume);
            }));
        }
        assert_eq!(settings, before);
    }
}
