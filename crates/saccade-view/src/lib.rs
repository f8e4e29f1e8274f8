//! The application: a window on a live volume, native and in the browser.
//!
//! The same application runs natively (`run`) and as WebAssembly (`start`). It opens with
//! the whole volume in view and colours that follow the data, shows what arrives while it arrives,
//! and always says how true the picture is.
//!
//! # Spaces and units
//!
//! Pointer movements are points of the user interface, pictures are pixels; both grow to the right
//! and down. Cameras are physical (nm). Colours the user picks are sRGB, those given to the
//! renderer linear.
//!
//! # Promises
//!
//! - Nothing waits for data or for the GPU: reading back is asynchronous, pictures being drawn are
//!   bounded, and while the hand moves they get smaller on slow machines.
//! - Where nothing changes, nothing is drawn.
//! - Without user interface (`ui: false`), the picture equals that of a headless session with the
//!   same camera, size, channels and transfer function, pixel by pixel.
//!
//! # Failure
//!
//! A missing GPU ends the application with a message that says what to install or do. A lost one is
//! replaced: the window, or the page's canvas, is made anew with another device, everything as it was chosen, and the
//! picture returns from main memory; only where one device after another is lost, a message says so. Missing data end
//! nothing: the fidelity line tells.
//!
//! # What it does not do
//!
//! It talks to a GPU only through `saccade-render`, and fetches nothing but through a
//! [`VolumeSource`](saccade_source::VolumeSource).

mod acquisition;
mod app;
mod detail;
mod facts;
#[cfg(all(test, not(target_family = "wasm")))]
mod fuzz_targets;
mod glyphs;
mod handover;
mod navigate;
mod options;
mod page;
mod panel;
mod picture;
mod plane;
mod quality;
mod revival;
mod setup;
mod shown;
mod transfer_editor;
mod transfer_text;

#[cfg(not(target_family = "wasm"))]
mod native;
#[cfg(target_family = "wasm")]
mod web;

pub use acquisition::AcquisitionReader;
pub use detail::details_from_text;
pub use options::{
    AskedWith, BackgroundError, OptionsError, ViewOptions, background_from_text,
    gpu_memory_from_text, host_memory_from_text,
};
pub use page::{PageError, PageOptions};
pub use plane::{Plane, plane_from_text, slice_from_text};
pub use shown::{
    MOST_CUTS, OutsideError, Shown, ShownError, box_from_text, channels_from_text,
    false_colors_from_text, heat_from_text, isos_from_text, mode_from_text, thickness_from_text,
};
pub use transfer_text::{TransferError, channel_of_text, transfer_from_text};

#[cfg(not(target_family = "wasm"))]
pub use native::{SourceSpec, ViewError, run};
#[cfg(target_family = "wasm")]
pub use web::{decode, decoders, prepare_decoder, start, status};
