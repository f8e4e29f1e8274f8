//! The application, handed from a window whose device was lost to the next.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use saccade_source::VolumeSource;

use crate::app::{App, StartError, Surroundings};
use crate::options::ViewOptions;

/// What windows begin with, one after another.
#[derive(Clone)]
pub(crate) struct Handover {
    /// For the first.
    start: Rc<RefCell<Option<Start>>>,
    /// The application, while no window has it.
    app: Rc<RefCell<Option<App>>>,
}

struct Start {
    source: Arc<dyn VolumeSource>,
    options: ViewOptions,
    surroundings: Surroundings,
}

/// The application in a window. It is left behind when the window ends.
pub(crate) struct Shown {
    /// There until this is dropped.
    app: Option<App>,
    left: Rc<RefCell<Option<App>>>,
}

impl Handover {
    pub(crate) fn new(
        source: Arc<dyn VolumeSource>,
        options: ViewOptions,
        surroundings: Surroundings,
    ) -> Self {
        let start = Start {
            source,
            options,
            surroundings,
        };
        Self {
            start: Rc::new(RefCell::new(Some(start))),
            app: Rc::default(),
        }
    }

    /// For a new window: the application of the one before, or a new one.
    pub(crate) fn window(
        &self,
        context: &eframe::CreationContext<'_>,
    ) -> Result<Shown, StartError> {
        let app = match (self.app.take(), self.start.take()) {
            (Some(mut app), _) => {
                if let Err(error) = app.revive(context) {
                    // For another try.
                    self.app.replace(Some(app));
                    return Err(error);
                }
                app
            }
            (None, Some(start)) => {
                App::new(context, start.source, start.options, start.surroundings)?
            }
            (None, None) => return Err(StartError::Gone),
        };
        Ok(Shown {
            app: Some(app),
            left: self.app.clone(),
        })
    }
}

#[cfg(test)]
#[cfg(target_os = "linux")]
impl Shown {
    pub(crate) fn app_mut(&mut self) -> &mut App {
        self.app.as_mut().expect("there until it is dropped")
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        self.left.replace(self.app.take());
    }
}

impl eframe::App for Shown {
    fn ui(&mut self, ui: &mut egui::Ui, frame: &mut eframe::Frame) {
        if let Some(app) = &mut self.app {
            app.ui(ui, frame);
        }
    }

    fn clear_color(&self, visuals: &egui::Visuals) -> [f32; 4] {
        let app = self.app.as_ref();
        app.map_or([0.0, 0.0, 0.0, 1.0], |app| app.clear_color(visuals))
    }

    fn persist_egui_memory(&self) -> bool {
        false
    }
}
