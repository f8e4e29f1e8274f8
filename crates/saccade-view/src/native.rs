//! The application in a window of its own.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use egui::ViewportInfo;
use saccade_source::remote::{RemoteSource, volumes};
use saccade_source::{SourceError, VolumeSource};

use crate::acquisition::{AcquisitionReader, from_server};
use crate::app::Surroundings;
use crate::handover::{Handover, Shown};
use crate::options::ViewOptions;
use crate::setup::wgpu_options;

/// What to show.
#[derive(Clone)]
pub enum SourceSpec {
    /// A source that is already open.
    Open {
        /// Where voxels come from.
        source: Arc<dyn VolumeSource>,
        /// Where the state of the acquisition is asked for, if anybody knows it.
        acquisition: Option<AcquisitionReader>,
    },
    /// A volume of a Saccade server.
    Server {
        /// Such as `http://localhost:8080`.
        address: String,
        /// Its name; the server's first otherwise.
        volume: Option<String>,
    },
}

/// Why the window could not be opened, or closed by itself.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ViewError {
    /// The volume cannot be opened.
    #[error("there is nothing to show")]
    Source(#[from] SourceError),
    /// The server has no volumes yet.
    #[error("the server offers no volumes yet: {address}")]
    NoVolumes {
        /// As given.
        address: String,
    },
    /// No driver, or none that suits.
    #[error(
        "no GPU adapter can draw in this window; install a Vulkan driver for your card, or the \
         software one (Debian and Ubuntu: apt-get install mesa-vulkan-drivers)"
    )]
    Gpu {
        /// What the adapters said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The driver gave up while the window was open, and again with each device that came next.
    #[error(
        "the GPU was lost again and again; update its driver, or use less of its memory (--gpu-memory)"
    )]
    Lost,
    /// No display, or no window on it.
    #[error(
        "no window could be opened; is there a display? Without one, use `saccade render` or a browser"
    )]
    Window {
        /// What the display said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The volume cannot be shown.
    #[error("the volume cannot be shown")]
    Start {
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

/// Opens a window and returns when it is closed. Should the GPU be lost, the window is opened again with another
/// device, in its place and with all that was chosen.
///
/// To be awaited on the program's first thread, as windows demand, inside of a multi-threaded Tokio
/// runtime; it blocks that thread.
///
/// # Errors
///
/// [`ViewError`] says what to install or to change.
pub async fn run(spec: SourceSpec, options: ViewOptions) -> Result<(), ViewError> {
    let (source, acquisition) = open(spec).await?;
    let windows = Windows::new(source, acquisition, options);
    windows.run(eframe::NativeOptions::default, |app| Box::new(app))
}

/// One window after another: each ends when it is closed, or when its device is lost.
struct Windows {
    title: String,
    handover: Handover,
    /// What was known of the last window, if it ended because its device was lost, and whether another is worth a try.
    lost: Rc<RefCell<Option<(ViewportInfo, bool)>>>,
}

impl Windows {
    fn new(
        source: Arc<dyn VolumeSource>,
        acquisition: Option<AcquisitionReader>,
        options: ViewOptions,
    ) -> Self {
        let lost: Rc<RefCell<Option<_>>> = Rc::default();
        let told = lost.clone();
        let surroundings = Surroundings {
            publish: Box::new(|_| ()),
            lost: Box::new(move |window, may_revive| {
                let seen = window.input(|input| input.viewport().clone());
                told.replace(Some((seen, may_revive)));
                window.send_viewport_cmd(egui::ViewportCommand::Close);
            }),
            acquisition,
            // Whoever opened the image has told them.
            notes: Vec::new(),
            open: None,
        };
        Self {
            title: format!("{} · Saccade", source.volume().name),
            handover: Handover::new(source, options, surroundings),
            lost,
        }
    }

    /// Opens windows until one is closed. `around` is what is put around the application in each.
    fn run<'a>(
        &self,
        options: impl Fn() -> eframe::NativeOptions,
        around: impl Fn(Shown) -> Box<dyn eframe::App + 'a>,
    ) -> Result<(), ViewError> {
        loop {
            let before = self.lost.take();
            let native = eframe::NativeOptions {
                viewport: self.viewport(before.as_ref().map(|(window, _)| window)),
                renderer: eframe::Renderer::Wgpu,
                wgpu_options: wgpu_options(),
                dithering: false,
                ..options()
            };
            let create = Box::new(|context: &eframe::CreationContext<'_>| {
                Ok(around(self.handover.window(context)?))
            });
            eframe::run_native("saccade", native, create).map_err(view_error)?;
            match *self.lost.borrow() {
                None => return Ok(()),
                Some((_, false)) => return Err(ViewError::Lost),
                Some((_, true)) => {}
            }
            log::warn!("the GPU was lost; going on with a new device");
        }
    }

    /// Where the window was whose device was lost, if there was one.
    fn viewport(&self, before: Option<&ViewportInfo>) -> egui::ViewportBuilder {
        let usual = egui::vec2(1280.0, 800.0);
        let builder = egui::ViewportBuilder::default().with_title(&self.title);
        let Some(before) = before else {
            return builder.with_inner_size(usual);
        };
        let size = before.inner_rect.map_or(usual, |rect| rect.size());
        let mut builder = builder.with_inner_size(size);
        if let Some(outer) = before.outer_rect {
            builder = builder.with_position(outer.min);
        }
        builder
            .with_maximized(before.maximized.unwrap_or(false))
            .with_fullscreen(before.fullscreen.unwrap_or(false))
    }
}

async fn open(
    spec: SourceSpec,
) -> Result<(Arc<dyn VolumeSource>, Option<AcquisitionReader>), ViewError> {
    match spec {
        SourceSpec::Open {
            source,
            acquisition,
        } => Ok((source, acquisition)),
        SourceSpec::Server { address, volume } => {
            let name = match volume {
                Some(name) => name,
                None => {
                    let mut names = volumes(&address).await?.into_iter();
                    names.next().ok_or(ViewError::NoVolumes {
                        address: address.clone(),
                    })?
                }
            };
            let source = RemoteSource::open(&address, &name).await?;
            let acquisition = from_server(source.status_reader());
            Ok((Arc::new(source), Some(acquisition)))
        }
    }
}

fn view_error(error: eframe::Error) -> ViewError {
    match error {
        eframe::Error::AppCreation(source) => ViewError::Start { source },
        eframe::Error::Wgpu(source) => ViewError::Gpu {
            source: source.into(),
        },
        other => ViewError::Window {
            source: other.to_string().into(),
        },
    }
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests;
