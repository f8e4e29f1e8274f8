//! The application itself: input to camera, camera to picture, picture to screen.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use eframe::egui_wgpu::RenderState;
use egui::{CentralPanel, Key, Panel, PointerButton, Response, Sense, Ui};
use glam::{DVec2, dvec2};
use saccade_core::camera::Camera;
use saccade_render::wgpu::DeviceType;
use saccade_render::{Gpu, View};
use saccade_source::VolumeSource;
use saccade_stream::{Again, Session, SessionError, Status, Wake};
use web_time::Instant;

use crate::acquisition::{Acquisition, AcquisitionReader};
use crate::facts::{Facts, PageStatus, line};
use crate::glyphs;
use crate::navigate::{Input, moved};
use crate::options::{OptionsError, ViewOptions};
use crate::panel::{self, About, Open, Opener, Settings};
use crate::picture::{Picture, Place};
use crate::quality::{Cost, Events, Quality};
use crate::revival::Revivals;
use crate::setup::gpu_of;
use crate::transfer_editor::TransferEditor;

/// The application.
pub(crate) struct App {
    pub(crate) session: Session,
    state: RenderState,
    /// Of the window there is now.
    context: Arc<Mutex<egui::Context>>,
    wake: Wake,
    ui: bool,
    home: Camera,
    pub(crate) camera: Camera,
    settings: Settings,
    editor: TransferEditor,
    panel_open: bool,
    picture: Picture,
    quality: Quality,
    cost: Cost,
    acquisition: Acquisition,
    notes: Vec<String>,
    opener: Option<Opener>,
    pub(crate) status: Option<Status>,
    pub(crate) preview: bool,
    /// Whether the volume changed since the size of the picture was chosen.
    changed: bool,
    start: Instant,
    /// What scripts are told after each frame, as JSON.
    publish: Box<dyn Fn(String)>,
    /// What is done once the GPU is gone.
    lost: Lost,
    revivals: Revivals,
    /// The GPU is gone, and [`Self::lost`] was told.
    is_lost: bool,
}

/// Told of a window whose GPU is gone, and whether another device is worth a try: not where one after another is lost.
pub(crate) type Lost = Box<dyn Fn(&egui::Context, bool)>;

/// What surrounds the application.
pub(crate) struct Surroundings {
    /// Given the status as JSON after each frame.
    pub(crate) publish: Box<dyn Fn(String)>,
    /// Called once when a GPU is gone.
    pub(crate) lost: Lost,
    /// Where the state of the acquisition is asked for.
    pub(crate) acquisition: Option<AcquisitionReader>,
    /// What the user should know of how values are shown, in sentences.
    pub(crate) notes: Vec<String>,
    /// Opens the image at an address instead, where that can be done.
    pub(crate) open: Option<Open>,
}

/// Why the application cannot start.
#[derive(Debug, thiserror::Error)]
pub(crate) enum StartError {
    /// The window draws without a GPU.
    #[error("the window has no GPU device")]
    NoDevice,
    /// The application was lost with its window.
    #[error("there is nothing left to show")]
    Gone,
    /// The volume cannot be shown.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// It cannot be shown as asked for.
    #[error(transparent)]
    Options(#[from] OptionsError),
}

impl App {
    pub(crate) fn new(
        context: &eframe::CreationContext<'_>,
        source: Arc<dyn VolumeSource>,
        options: ViewOptions,
        surroundings: Surroundings,
    ) -> Result<Self, StartError> {
        let state = state_of(context)?;
        context.egui_ctx.set_theme(egui::Theme::Dark);
        glyphs::provide(&context.egui_ctx);
        let window = Arc::new(Mutex::new(context.egui_ctx.clone()));
        let repaint = window.clone();
        let wake: Wake = Arc::new(move || lock(&repaint).request_repaint());
        let gpu = gpu_of(&state);
        gpu.when_lost(asks_to_repaint(&context.egui_ctx));
        let software = is_software(&gpu);
        let home = Camera::around(source.volume());
        let frames_in_flight = if software { 1 } else { 2 };
        let session = options.session(&gpu, source, frames_in_flight, wake.clone())?;
        let selected = options.first_seen(&session);
        Ok(Self {
            session,
            state,
            context: window,
            wake,
            ui: options.ui,
            home,
            camera: options.camera.unwrap_or(home),
            settings: Settings {
                lod_bias: options.lod_bias,
                substitute: true,
                false_colors: options.false_colors,
                background: options.background,
                shown: options.shown,
                selected,
            },
            editor: TransferEditor::default(),
            panel_open: true,
            picture: Picture::default(),
            quality: Quality::new(software),
            cost: Cost::default(),
            acquisition: Acquisition::new(surroundings.acquisition),
            notes: surroundings.notes,
            opener: surroundings.open.map(Opener::new),
            status: None,
            preview: false,
            changed: false,
            start: start(),
            publish: surroundings.publish,
            lost: surroundings.lost,
            revivals: Revivals::default(),
            is_lost: false,
        })
    }

    /// Goes on in a new window, whose device is another, with all that was chosen and read in the last one.
    pub(crate) fn revive(
        &mut self,
        context: &eframe::CreationContext<'_>,
    ) -> Result<(), StartError> {
        let state = state_of(context)?;
        let gpu = gpu_of(&state);
        self.session.set_gpu(&gpu)?;
        gpu.when_lost(asks_to_repaint(&context.egui_ctx));
        self.state = state;
        // Widths of panels and the like.
        let before = std::mem::replace(&mut *lock(&self.context), context.egui_ctx.clone());
        let widgets = before.data(Clone::clone);
        context.egui_ctx.data_mut(|data| *data = widgets);
        context.egui_ctx.set_theme(egui::Theme::Dark);
        self.picture = Picture::default();
        self.quality = Quality::new(is_software(&gpu));
        self.cost = Cost::default();
        self.status = None;
        self.is_lost = false;
        Ok(())
    }

    /// Tells once that the device is lost; nothing is drawn with it any more.
    fn leave(&mut self, context: &egui::Context) {
        // What draws the user interface would fail at buffers that there are no more.
        context.graphics_mut(|layers| *layers = Default::default());
        if !std::mem::replace(&mut self.is_lost, true) {
            let may_revive = self.revivals.may_revive(self.start.elapsed());
            (self.lost)(context, may_revive);
        }
    }

    /// The panels around the picture. They show what the last frame told.
    fn panels(&mut self, ui: &mut Ui) {
        Panel::bottom("fidelity").show(ui, |ui| {
            ui.horizontal(|ui| {
                let side = ui.selectable_label(self.panel_open, "Settings");
                self.panel_open ^= side.clicked();
                if let Some(status) = &self.status {
                    let acquisition = self.acquisition.status();
                    let facts = Facts {
                        status,
                        preview: self.preview,
                        acquisition,
                    };
                    panel::line(ui, &line(&facts));
                }
            });
        });
        let mut open = self.panel_open;
        let side = Panel::right("settings").default_size(270.0).min_size(220.0);
        let home = side.show_collapsible(ui, &mut open, |ui| {
            let about = About {
                camera: &self.camera,
                notes: &self.notes,
                opener: self.opener.as_mut(),
            };
            panel::show(
                ui,
                &mut self.session,
                &mut self.editor,
                &mut self.settings,
                about,
            )
        });
        self.panel_open = open;
        if home.is_some_and(|shown| shown.inner) {
            self.camera = self.home;
        }
    }

    /// The picture and what the hand does to it.
    fn scene(&mut self, ui: &mut Ui) {
        let place = Place::inside(ui.available_rect_before_wrap(), ui.ctx().pixels_per_point());
        let response = ui.interact(
            place.rect,
            ui.scope_id().with("scene"),
            Sense::click_and_drag(),
        );
        let input = input_on(ui, &response);
        let height = f64::from(place.rect.height());
        let (volume, image) = (self.session.volume(), place.size.as_dvec2());
        let home = Camera::framing(volume, image).near_enough(volume, image);
        if self.camera == self.home {
            // As the window is made narrower, nothing is cut off.
            self.camera = home;
        }
        self.home = home;
        let camera = moved(self.camera, &input, height, self.home);
        let moving = camera != self.camera || response.dragged();
        self.camera = camera;
        if input.arrows != DVec2::ZERO || input.closer != 0.0 {
            // Held keys send no events of their own.
            ui.ctx().request_repaint();
        }

        let now = self.start.elapsed();
        let events = Events {
            moving,
            changed: std::mem::take(&mut self.changed),
            settled: self.status.as_ref().is_some_and(|status| status.settled),
            cost: self.cost(place),
        };
        // A picture alone is always as it should be.
        let scale = if self.ui {
            self.quality.scale(now, events)
        } else {
            1.0
        };
        let view = View {
            lod_bias: self.settings.lod_bias,
            substitute: self.settings.substitute,
            false_colors: self.settings.false_colors,
            background: self.settings.background,
            mode: self.settings.shown.drawn_mode(),
            clip: self.settings.shown.clip(self.session.volume()),
            heat: self.settings.shown.heat,
            ..View::new(self.camera, place.scaled(scale))
        };
        let status = self.session.frame(&view);
        self.preview = scale < 1.0;
        self.picture
            .paint(ui.painter(), place, self.session.renderer(), &self.state);
        self.publish_status(&status, &view);
        self.schedule(ui, &status, now);
        let revision = self
            .status
            .as_ref()
            .map_or(status.revision, |before| before.revision);
        self.changed |= status.revision != revision;
        self.status = Some(status);
    }

    /// What pictures cost, with what the last frame told.
    fn cost(&mut self, place: Place) -> Cost {
        if let Some(status) = &self.status
            && let Some(time) = status.frame_time
        {
            let drawn = status.frame_size.as_dvec2().element_product();
            let full = place.size.as_dvec2().element_product();
            self.cost.learn(drawn / full.max(1.0), time);
        }
        self.cost
    }

    fn publish_status(&self, status: &Status, view: &View) {
        let facts = Facts {
            status,
            preview: self.preview,
            acquisition: self.acquisition.status(),
        };
        let volume = &self.session.volume().name;
        let channels = self.session.channels();
        let page = PageStatus::new(&facts, volume, &view.camera, view.size, channels);
        match serde_json::to_string(&page) {
            Ok(json) => (self.publish)(json),
            Err(error) => log::error!("no status: {error}"),
        }
    }

    /// Asks for the next frame where one is needed; without need, nothing is drawn.
    fn schedule(&mut self, ui: &Ui, status: &Status, now: Duration) {
        let context = ui.ctx();
        match status.again {
            Again::Now => context.request_repaint(),
            Again::After(time) => context.request_repaint_after(time),
            Again::WhenWoken => {}
        }
        let refine = self.quality.refines_in(now);
        let ask = self.acquisition.update(status.revision, now, &self.wake);
        for time in refine.into_iter().chain(ask) {
            context.request_repaint_after(time);
        }
        // The panels were laid out before this frame's news.
        let news = self.status.as_ref().is_none_or(|before| {
            before.fidelity != status.fidelity
                || before.complete != status.complete
                || before.settled != status.settled
                || before.progress.failure != status.progress.failure
                || before.revision != status.revision
        });
        if self.ui && news {
            context.request_repaint();
        }
    }
}

impl eframe::App for App {
    fn ui(&mut self, ui: &mut Ui, _frame: &mut eframe::Frame) {
        let is_gone = |app: &Self| app.session.renderer().gpu().is_lost();
        if !is_gone(self) {
            if self.ui {
                self.panels(ui);
            }
            CentralPanel::no_frame().show(ui, |ui| self.scene(ui));
        }
        if is_gone(self) {
            self.leave(ui.ctx());
        }
    }

    fn clear_color(&self, _visuals: &egui::Visuals) -> [f32; 4] {
        [0.0, 0.0, 0.0, 1.0]
    }

    fn persist_egui_memory(&self) -> bool {
        false
    }
}

fn state_of(context: &eframe::CreationContext<'_>) -> Result<RenderState, StartError> {
    let state = context.wgpu_render_state.clone();
    state.ok_or(StartError::NoDevice)
}

/// Where nothing changes nothing is drawn, and a loss would show only when somebody moves.
fn asks_to_repaint(context: &egui::Context) -> impl Fn() + Send + Sync + 'static {
    let context = context.clone();
    move || context.request_repaint()
}

fn is_software(gpu: &Gpu) -> bool {
    gpu.adapter().device_type == DeviceType::Cpu
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg_attr(
    not(target_family = "wasm"),
    expect(
        clippy::disallowed_methods,
        reason = "natively this is the ban's own replacement"
    )
)]
fn start() -> Instant {
    Instant::now()
}

/// What the user did to the picture.
fn input_on(ui: &Ui, response: &Response) -> Input {
    // All that asks the context comes first: asked from within `input`, it would wait for itself.
    let typing = ui.ctx().egui_wants_keyboard_input();
    let points = |v: egui::Vec2| dvec2(v.x.into(), v.y.into());
    let delta = points(response.drag_delta());
    let over = response.hovered();
    let dragged = response.dragged();
    let primary = response.dragged_by(PointerButton::Primary);
    let other =
        response.dragged_by(PointerButton::Secondary) || response.dragged_by(PointerButton::Middle);
    let double_clicked = response.double_clicked();
    ui.input(|i| {
        let touch = i.multi_touch().filter(|_| over || dragged);
        let drag = |held: bool| {
            if held && touch.is_none() {
                delta
            } else {
                DVec2::ZERO
            }
        };
        let held = |key: Key| f64::from(u8::from(!typing && i.key_down(key)));
        let pressed = |key: Key| !typing && i.key_pressed(key);
        let pinch = if over { f64::from(i.zoom_delta()) } else { 1.0 };
        let wheel = if over && touch.is_none() {
            i.smooth_scroll_delta().y
        } else {
            0.0
        };
        let closer = (held(Key::Plus) + held(Key::Equals)).min(1.0) - held(Key::Minus);
        Input {
            primary: drag(primary),
            other: drag(other),
            fingers: touch.map_or(DVec2::ZERO, |t| points(t.translation_delta)),
            pinch,
            wheel: wheel.into(),
            arrows: dvec2(
                held(Key::ArrowRight) - held(Key::ArrowLeft),
                held(Key::ArrowDown) - held(Key::ArrowUp),
            ),
            closer,
            shift: i.modifiers.shift,
            reset: double_clicked || pressed(Key::F) || pressed(Key::R),
            seconds: f64::from(i.stable_dt.min(0.1)),
        }
    })
}

#[cfg(test)]
mod tests {
    use egui::{Context, Event, Modifiers, Pos2, RawInput, Rect, pos2, vec2};

    use super::*;

    /// A hand on a window without a screen.
    #[derive(Default)]
    struct Hand {
        context: Context,
        time: f64,
    }

    impl Hand {
        fn frame(&mut self, mut events: Vec<Event>, modifiers: Modifiers) -> Input {
            self.time += 0.02;
            events.insert(0, Event::ModifiersChanged(modifiers));
            let screen = Rect::from_min_size(Pos2::ZERO, vec2(400.0, 300.0));
            let input = RawInput {
                screen_rect: Some(screen),
                time: Some(self.time),
                events,
                ..RawInput::default()
            };
            let mut got = Input::default();
            drop(self.context.run_ui(input, |ui| {
                let id = ui.scope_id().with("scene");
                let response = ui.interact(screen, id, Sense::click_and_drag());
                got = input_on(ui, &response);
            }));
            got
        }

        /// Presses `button`, moves by 30 points to the right, lets go; all movements together.
        fn drag(&mut self, button: PointerButton, modifiers: Modifiers) -> Input {
            let press = |pos, pressed| Event::PointerButton {
                pos,
                button,
                pressed,
                modifiers,
            };
            let (from, to) = (pos2(100.0, 100.0), pos2(130.0, 100.0));
            self.frame(vec![Event::PointerMoved(from)], modifiers);
            self.frame(vec![press(from, true)], modifiers);
            let first = self.frame(vec![Event::PointerMoved(pos2(115.0, 100.0))], modifiers);
            let second = self.frame(vec![Event::PointerMoved(to)], modifiers);
            self.frame(vec![press(to, false)], modifiers);
            Input {
                primary: first.primary + second.primary,
                other: first.other + second.other,
                ..second
            }
        }
    }

    #[test]
    fn each_button_drags_its_own_way() {
        let mut hand = Hand::default();
        hand.frame(Vec::new(), Modifiers::NONE);
        let by = dvec2(30.0, 0.0);
        for (button, primary, other) in [
            (PointerButton::Primary, by, DVec2::ZERO),
            (PointerButton::Secondary, DVec2::ZERO, by),
            (PointerButton::Middle, DVec2::ZERO, by),
        ] {
            let input = hand.drag(button, Modifiers::NONE);
            assert_eq!((input.primary, input.other), (primary, other), "{button:?}");
            assert!(!input.shift);
        }
        assert!(hand.drag(PointerButton::Primary, Modifiers::SHIFT).shift);
        let still = hand.frame(Vec::new(), Modifiers::NONE);
        assert_eq!((still.primary, still.other), (DVec2::ZERO, DVec2::ZERO));
    }

    #[test]
    fn keys_are_held_and_pressed() {
        let mut hand = Hand::default();
        let press = |key, pressed| Event::Key {
            key,
            physical_key: None,
            pressed,
            repeat: false,
            modifiers: Modifiers::NONE,
        };
        hand.frame(Vec::new(), Modifiers::NONE);
        let input = hand.frame(vec![press(Key::ArrowLeft, true)], Modifiers::NONE);
        assert_eq!(input.arrows, dvec2(-1.0, 0.0));
        let input = hand.frame(Vec::new(), Modifiers::NONE);
        assert_eq!(input.arrows, dvec2(-1.0, 0.0), "still held");
        let input = hand.frame(vec![press(Key::ArrowLeft, false)], Modifiers::NONE);
        assert_eq!(input.arrows, DVec2::ZERO);
        assert!(hand.frame(vec![press(Key::F, true)], Modifiers::NONE).reset);
        assert!(!hand.frame(Vec::new(), Modifiers::NONE).reset, "once");
    }
}
