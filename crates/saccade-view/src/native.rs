//! The application in a window of its own.

use std::sync::Arc;

use saccade_source::remote::{RemoteSource, volumes};
use saccade_source::{SourceError, VolumeSource};

use crate::acquisition::{AcquisitionReader, from_server};
use crate::app::{App, Surroundings};
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
    /// The driver gave up while the window was open.
    #[error(
        "the GPU was lost; restart, and if it happens again update the driver or use less memory"
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

/// Opens a window and returns when it is closed.
///
/// To be awaited on the program's first thread, as windows demand, inside of a multi-threaded Tokio
/// runtime; it blocks that thread.
///
/// # Errors
///
/// [`ViewError`] says what to install or to change.
pub async fn run(spec: SourceSpec, options: ViewOptions) -> Result<(), ViewError> {
    let (source, acquisition) = open(spec).await?;
    let title = format!("{} · Saccade", source.volume().name);
    let native = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default()
            .with_title(title)
            .with_inner_size([1280.0, 800.0]),
        renderer: eframe::Renderer::Wgpu,
        wgpu_options: wgpu_options(),
        dithering: false,
        ..Default::default()
    };
    let lost = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let flag = lost.clone();
    let create = Box::new(move |context: &eframe::CreationContext<'_>| {
        let close = context.egui_ctx.clone();
        let surroundings = Surroundings {
            publish: Box::new(|_| ()),
            lost: Box::new(move || {
                flag.store(true, std::sync::atomic::Ordering::Release);
                close.send_viewport_cmd(egui::ViewportCommand::Close);
            }),
            acquisition,
            // Whoever opened the image has told them.
            notes: Vec::new(),
            open: None,
        };
        let app = App::new(context, source, options, surroundings)?;
        Ok(Box::new(app) as Box<dyn eframe::App>)
    });
    eframe::run_native("saccade", native, create).map_err(view_error)?;
    if lost.load(std::sync::atomic::Ordering::Acquire) {
        Err(ViewError::Lost)
    } else {
        Ok(())
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
