//! What the application opens with.

#[cfg(not(target_family = "wasm"))]
#[path = "options/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "options/wasm.rs"]
mod platform;

use std::sync::Arc;

use glam::{DVec3, UVec2};
use saccade_core::camera::Camera;
use saccade_core::transfer::{TransferFunction, linear_from_srgb};
use saccade_core::volume::Volume;
use saccade_render::{ChannelError, FalseColors, Gpu, Mode, RendererError, View};
use saccade_source::VolumeSource;
use saccade_stream::policy::Limits;
use saccade_stream::{Detail, Session, SessionError, SessionOptions, Wake};

use crate::detail::text_of;
use crate::shown::{OutsideError, Shown, ShownError};

/// What the application opens with. Where something is said of channels, `None` stands for all of them, and later words
/// go before earlier ones.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewOptions {
    /// From where; the whole volume from a corner otherwise.
    pub camera: Option<Camera>,
    /// Colours and opacities of channels, `None` of the first one that is seen; those that are not told follow the data.
    pub transfers: Vec<(Option<u32>, Option<TransferFunction>)>,
    /// Channels that are seen; the first few otherwise.
    pub channels: Option<Vec<u32>>,
    /// How finely channels are drawn; as the view asks for otherwise.
    pub details: Vec<(Option<u32>, Detail)>,
    /// Values of channels' surfaces, `[0, 1]` of the value type's range; between the ends of the opacities otherwise.
    pub isos: Vec<(Option<u32>, f32)>,
    /// Which part of the volume, and how.
    pub shown: Shown,
    /// Behind everything, linear RGB in `[0, 1]`.
    pub background: [f32; 3],
    /// Levels coarser (above 0) or finer than one voxel a pixel.
    pub lod_bias: f32,
    /// What colours tell besides values.
    pub false_colors: FalseColors,
    /// Whether there is anything but the picture.
    pub ui: bool,
    /// Ceiling for GPU memory \[bytes\].
    pub gpu_bytes: u64,
    /// Ceiling for chunks in main memory, requests at once and so on.
    pub limits: Limits,
}

impl Default for ViewOptions {
    fn default() -> Self {
        Self {
            camera: None,
            transfers: Vec::new(),
            channels: None,
            details: Vec::new(),
            isos: Vec::new(),
            shown: Shown::default(),
            background: [0.0; 3],
            lod_bias: 0.0,
            false_colors: FalseColors::None,
            ui: true,
            gpu_bytes: 512 << 20,
            limits: Limits::default(),
        }
    }
}

/// What people say how a volume is shown with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AskedWith {
    /// `--mode surface`.
    CommandLine,
    /// `mode=surface`.
    Address,
}

impl AskedWith {
    fn option(self, name: &str) -> String {
        match self {
            Self::CommandLine => format!("--{name}"),
            Self::Address => format!("{name}="),
        }
    }

    fn choice(self, name: &str, value: &str) -> String {
        match self {
            Self::CommandLine => format!("--{name} {value}"),
            Self::Address => format!("{name}={value}"),
        }
    }
}

/// Why a volume cannot be shown so.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OptionsError {
    /// Nothing of it would be seen.
    #[error(transparent)]
    Outside(#[from] OutsideError),
    /// It has other channels.
    #[error(transparent)]
    Channels(#[from] ChannelError),
    /// It cannot be shown at all.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// There is no room for as much as a picture needs.
    #[error(
        "{given} MiB of GPU memory are too few for this volume; allow {needed} or more (--gpu-memory {needed}, \
         or gpu-memory={needed} in the page's address)"
    )]
    GpuMemory {
        /// The ceiling \[MiB\].
        given: u64,
        /// One that would do \[MiB\].
        needed: u64,
    },
    /// There is no room for as many channels.
    #[error(
        "{given} MiB of GPU memory are too few for {got} channels of this volume together; allow {needed} or more \
         (--gpu-memory {needed}, or gpu-memory={needed} in the page's address), or show {most} at most (--channels)"
    )]
    ChannelMemory {
        /// The ceiling \[MiB\].
        given: u64,
        /// One that would do \[MiB\].
        needed: u64,
        /// How many channels were to be seen.
        got: usize,
        /// How many can be.
        most: usize,
    },
}

impl ViewOptions {
    /// Refuses what a volume does not have, and what shows nothing of it.
    ///
    /// # Errors
    ///
    /// [`OptionsError`] says what there is.
    pub fn check(&self, volume: &Volume) -> Result<(), OptionsError> {
        self.shown.check(volume)?;
        let channels = u32::try_from(volume.channels.len()).unwrap_or(u32::MAX);
        let seen = self.channels.iter().flatten().map(|channel| Some(*channel));
        let named = seen
            .chain(self.transfers.iter().map(|(channel, _)| *channel))
            .chain(self.details.iter().map(|(channel, _)| *channel))
            .chain(self.isos.iter().map(|(channel, _)| *channel));
        match named.flatten().find(|channel| *channel >= channels) {
            Some(channel) => Err(ChannelError::NoSuchChannel { channel, channels }.into()),
            None => Ok(()),
        }
    }

    /// A session of a volume that is shown so.
    ///
    /// # Errors
    ///
    /// [`OptionsError`] for what the volume does not have, and where there is too little memory.
    pub fn session(
        &self,
        gpu: &Gpu,
        source: Arc<dyn VolumeSource>,
        frames_in_flight: usize,
        wake: Wake,
    ) -> Result<Session, OptionsError> {
        let options = SessionOptions {
            gpu_bytes: self.gpu_bytes,
            limits: self.limits.clone(),
            frames_in_flight,
            wake,
            seen: self.channels.clone(),
        };
        let session = Session::new(gpu, source, options);
        let mut session = session.map_err(|error| too_little(&error).unwrap_or(error.into()))?;
        { self.show_channels(&mut session) }
            .map_err(|error| too_many(&error).unwrap_or(error.into()))?;
        Ok(session)
    }

    /// What was asked for and does not show in the first picture, in sentences that name what was asked with.
    pub fn without_effect(&self, volume: &Volume, with: AskedWith) -> Vec<String> {
        let mut told = Vec::new();
        let option = |name| with.option(name);
        let shown = &self.shown;
        let surfaces = shown.drawn_mode() == Mode::IsoSurface;
        if shown.mode == Mode::IsoSurface && !surfaces {
            told.push(format!(
                "{} does not show in a plane alone, which has values as they are: {} gives it a thickness",
                with.choice("mode", "surface"),
                option("slab")
            ));
        } else if !self.isos.is_empty() && !surfaces {
            told.push(format!(
                "{} shows where surfaces are drawn: add {}, or leave it out",
                option("iso"),
                with.choice("mode", "surface")
            ));
        }
        if shown.heat.is_some() && self.false_colors != FalseColors::None {
            told.push(format!(
                "{} does not show with {}, which draws the work of rays instead",
                option("false-colors"),
                option("heat")
            ));
        }
        if shown.slab_nm > 0.0 && shown.slice.is_none() {
            told.push(format!(
                "{} shows around a plane: add {}, or leave it out",
                option("slab"),
                option("slice")
            ));
        }
        for cut in shown.cuts.iter().flatten() {
            let whole = [DVec3::ZERO, volume.extent().as_dvec3()];
            if cut.range_of(volume, whole)[0] >= 0.0 {
                let DVec3 { x, y, z } = whole[1];
                told.push(format!(
                    "{} takes nothing away: its plane is outside of the volume of {x} x {y} x {z} voxels, or in a face, and what its \
                     normal points to stays",
                    option("cut")
                ));
            }
        }
        let seen = self.channels.clone();
        let seen = seen.unwrap_or_else(|| saccade_stream::shown_at_first(volume));
        let isos = self.isos.iter().filter(|_| surfaces);
        let named = (self.transfers.iter().map(|(of, _)| ("transfer", *of)))
            .chain(self.details.iter().map(|(of, _)| ("detail", *of)))
            .chain(isos.map(|(of, _)| ("iso", *of)));
        for (name, of) in named {
            if let Some(channel) = of
                && !seen.contains(&channel)
            {
                told.push(format!(
                    "{} of channel {channel} does not show, nor does that channel: name it with {}",
                    option(name),
                    option("channels")
                ));
            }
        }
        let last = u32::try_from(volume.levels.len().saturating_sub(1)).unwrap_or(u32::MAX);
        let beyond = self.details.iter().filter(|(_, detail)| match detail {
            Detail::Chosen { levels, coarser } => *levels.start() > last || *coarser > last,
            Detail::Full | Detail::ByContent => false,
        });
        for (_, detail) in beyond {
            told.push(format!(
                "{} {} asks for levels that this volume does not have: it has 0 to {last}, and is drawn from level {last}",
                option("detail"),
                text_of(detail)
            ));
        }
        let transfers =
            { self.transfers.iter() }.filter_map(|(of, transfer)| Some((of, transfer.as_ref()?)));
        for (of, transfer) in transfers.filter(|(of, _)| of.is_none_or(|of| seen.contains(&of))) {
            let of = of.map_or_else(String::new, |channel| format!(" of channel {channel}"));
            let [low, high] = transfer.window;
            if shown.drawn_mode() == Mode::EmissionAbsorption
                && transfer.opacity.iter().all(|point| point.opacity <= 0.0)
            {
                told.push(format!(
                    "{}{of} is transparent everywhere, so that nothing of it shows: give it points of \"opacity\" above 0",
                    option("transfer")
                ));
            } else if low.min(high) >= 1.0 || low.max(high) <= 0.0 {
                told.push(format!(
                    "{}{of} has a window beyond all values, which are 0 to 1, so that all of them have one colour",
                    option("transfer")
                ));
            }
        }
        told.dedup();
        told
    }

    /// One picture of a volume.
    pub fn view(&self, volume: &Volume, size: UVec2) -> View {
        let image = size.as_dvec2();
        let framing = || Camera::framing(volume, image).near_enough(volume, image);
        let camera = self.camera.unwrap_or_else(framing);
        View {
            background: self.background,
            mode: self.shown.drawn_mode(),
            clip: self.shown.clip(volume),
            heat: self.shown.heat,
            lod_bias: self.lod_bias,
            false_colors: self.false_colors,
            ..View::new(camera, size)
        }
    }

    fn show_channels(&self, session: &mut Session) -> Result<(), ChannelError> {
        if let Some(channels) = &self.channels {
            // Hidden first: never are too many seen on the way.
            for (index, channel) in (0..).zip(session.channels().to_vec()) {
                if channel.visible && !channels.contains(&index) {
                    session.set_visible(index, false)?;
                }
            }
            for &channel in channels {
                session.set_visible(channel, true)?;
            }
        }
        let first = self.first_seen(session);
        for (channel, transfer) in &self.transfers {
            let channel = channel.unwrap_or(first);
            match transfer {
                Some(transfer) => session.set_transfer_function(channel, transfer.clone())?,
                None => session.set_automatic_transfer_function(channel)?,
            }
        }
        let all = u32::try_from(session.channels().len()).unwrap_or(u32::MAX);
        let those = |channel: Option<u32>| match channel {
            Some(channel) => channel..channel.saturating_add(1),
            None => 0..all,
        };
        for (channel, detail) in &self.details {
            for channel in those(*channel) {
                session.set_detail(channel, detail.clone())?;
            }
        }
        for (channel, iso) in &self.isos {
            for channel in those(*channel) {
                session.set_iso(channel, Some(*iso))?;
            }
        }
        Ok(())
    }

    /// The channel that is named first, or the first that is seen.
    pub(crate) fn first_seen(&self, session: &Session) -> u32 {
        let named = self.channels.iter().flatten().next().copied();
        let seen = || (0..).zip(session.channels()).find(|(_, c)| c.visible);
        let first = named.or_else(|| seen().map(|(index, _)| index));
        first.unwrap_or(0)
    }
}

/// What would do, where memory is too little.
fn too_little(error: &SessionError) -> Option<OptionsError> {
    match error {
        SessionError::Renderer {
            source: RendererError::Ceiling { ceiling, needed },
            ..
        } => Some(OptionsError::GpuMemory {
            given: ceiling >> 20,
            needed: needed.div_ceil(1 << 20),
        }),
        SessionError::Channels { source } => too_many(source),
        _ => None,
    }
}

/// What would do, where memory is too little for channels.
fn too_many(error: &ChannelError) -> Option<OptionsError> {
    match *error {
        ChannelError::Memory {
            got,
            most,
            ceiling,
            needed,
        } => Some(OptionsError::ChannelMemory {
            given: ceiling >> 20,
            needed: needed.div_ceil(1 << 20),
            got,
            most,
        }),
        _ => None,
    }
}

/// Ceiling for GPU memory from whole MiB \[bytes\].
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn gpu_memory_from_text(text: &str) -> Result<u64, ShownError> {
    memory_from_text(
        text,
        1,
        u32::MAX,
        "ceiling for GPU memory",
        "whole MiB from 1 on, as in 512",
    )
}

/// Ceiling for chunks in main memory from whole MiB \[bytes\].
///
/// # Errors
///
/// [`ShownError`] on anything else, less than anything can be shown with, and, in a browser, more than pages have.
pub fn host_memory_from_text(text: &str) -> Result<u64, ShownError> {
    use platform::{HOST_MEMORY_WANTED, MOST_HOST_MIB};
    let what = "ceiling for main memory";
    memory_from_text(text, 16, MOST_HOST_MIB, what, HOST_MEMORY_WANTED)
}

fn memory_from_text(
    text: &str,
    least: u32,
    most: u32,
    what: &'static str,
    wanted: &'static str,
) -> Result<u64, ShownError> {
    let mib = text.trim().parse().ok();
    match mib.filter(|mib: &u32| (least..=most).contains(mib)) {
        Some(mib) => Ok(u64::from(mib) << 20),
        None => ShownError::of(text, what, wanted),
    }
}

/// Text that names no colour.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("background {text:?} is not #rrggbb")]
pub struct BackgroundError {
    /// As given.
    pub text: String,
}

/// Linear RGB from `#rrggbb` in sRGB; the `#` may be missing.
///
/// # Errors
///
/// [`BackgroundError`] on anything else.
pub fn background_from_text(text: &str) -> Result<[f32; 3], BackgroundError> {
    let error = || BackgroundError {
        text: text.to_owned(),
    };
    let digits = text.trim().trim_start_matches('#');
    if digits.len() != 6 || !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Err(error());
    }
    let mut linear = [0.0; 3];
    for (part, at) in linear.iter_mut().zip([0, 2, 4]) {
        let value = u8::from_str_radix(&digits[at..at + 2], 16).map_err(|_| error())?;
        *part = linear_from_srgb(f32::from(value) / 255.0);
    }
    Ok(linear)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backgrounds_are_hexadecimal_srgb() {
        assert_eq!(background_from_text("#000000"), Ok([0.0; 3]));
        assert_eq!(background_from_text("ffFFff"), Ok([1.0; 3]));
        let [r, g, b] = background_from_text("#808000").unwrap();
        assert!((r - 0.2159).abs() < 1e-3 && r == g && b == 0.0);
        for bad in ["", "white", "#fff", "#12345g", "#1234567", "+1+2+3", "日本"] {
            assert!(background_from_text(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn memory_is_in_whole_mebibytes() {
        assert_eq!(gpu_memory_from_text("4"), Ok(4 << 20));
        assert_eq!(host_memory_from_text(" 16 "), Ok(16 << 20));
        assert_eq!(gpu_memory_from_text("8192"), Ok(8192 << 20));
        for bad in ["", "0", "-1", "1.5", "2GB", "9999999999"] {
            let told = gpu_memory_from_text(bad).unwrap_err().to_string();
            assert!(
                told.contains("GPU memory") && told.contains("MiB"),
                "{told}"
            );
            assert!(host_memory_from_text(bad).is_err(), "{bad:?}");
        }
        let told = host_memory_from_text("15").unwrap_err().to_string();
        assert!(
            told.contains("\"15\"") && told.contains("from 16"),
            "{told}"
        );
    }

    #[test]
    fn what_does_not_show_is_told() {
        let size = glam::UVec3::new(90, 80, 70);
        let mut volume = Volume::new("v", size, DVec3::ONE).unwrap();
        volume.channels = (0..6).map(|n| n.to_string()).collect();
        let asked_with =
            |options: &ViewOptions, with| options.without_effect(&volume, with).join("\n");
        let told = |options: &ViewOptions| asked_with(options, AskedWith::CommandLine);
        let surface = Shown {
            mode: Mode::IsoSurface,
            ..Shown::default()
        };
        let mut options = ViewOptions {
            isos: vec![(Some(1), 0.5), (None, 0.2)],
            transfers: vec![(None, None), (Some(3), None)],
            details: vec![(Some(0), Detail::Full)],
            ..ViewOptions::default()
        };
        assert!(told(&options).contains("--mode surface") && told(&options).lines().count() == 1);
        options.shown = surface;
        assert_eq!(told(&options), "");
        // A plane alone shows values.
        options.shown.slice = Some(crate::plane::Plane::through_voxel(2, 5.0));
        assert!(told(&options).contains("--slab"));
        options.shown.slab_nm = 9.0;
        assert_eq!(told(&options), "");
        // The first four are seen, unless others are named.
        options.transfers.push((Some(4), None));
        assert!(told(&options).contains("--transfer of channel 4"));
        options.channels = Some(vec![4, 5]);
        let all = told(&options);
        for part in [
            "--transfer of channel 3",
            "--detail of channel 0",
            "--iso of channel 1",
        ] {
            assert!(all.contains(part), "{part}: {all}");
        }
        assert_eq!(all.lines().count(), 3, "{all}");
        options = ViewOptions {
            false_colors: FalseColors::Level,
            ..ViewOptions::default()
        };
        assert_eq!(told(&options), "");
        options.shown.heat = crate::shown::heat_from_text("nodes").ok();
        assert!(told(&options).contains("--heat"));
        // In the words of a page's address.
        options.isos = vec![(None, 0.5)];
        let address = asked_with(&options, AskedWith::Address);
        for part in [
            "iso= shows",
            "add mode=surface",
            "false-colors= does",
            "with heat=",
        ] {
            assert!(address.contains(part), "{part}: {address}");
        }
        assert!(!address.contains("--"), "{address}");
        options = ViewOptions::default();
        options.shown.slab_nm = 40.0;
        let address = asked_with(&options, AskedWith::Address);
        assert!(address.starts_with("slab= ") && address.contains("slice="));
    }

    #[test]
    fn levels_and_cuts_beyond_the_volume_are_told() {
        let size = glam::UVec3::new(90, 80, 70);
        let volume = Volume::new("v", size, DVec3::ONE).unwrap();
        let told = |options: &ViewOptions| {
            { options.without_effect(&volume, AskedWith::CommandLine) }.join("\n")
        };
        assert_eq!(volume.levels.len(), 3);
        let with = |detail: &str| {
            told(&ViewOptions {
                details: crate::details_from_text(detail).unwrap(),
                ..ViewOptions::default()
            })
        };
        for fits in ["full", "content", "2", "2-", "0-9", "1-2+2", "0:2-7"] {
            assert_eq!(with(fits), "", "{fits}");
        }
        for (beyond, as_text) in [
            ("7-9", "7-9"),
            ("3-", "3-"),
            ("9", "9"),
            ("0:1-2+3", "1-2+3"),
        ] {
            let said = with(beyond);
            let parts = [format!("--detail {as_text} "), "0 to 2".to_owned()];
            assert!(parts.iter().all(|part| said.contains(part)), "{said}");
        }
        let cut = |text: &str| {
            let mut options = ViewOptions::default();
            assert!(options.shown.cut(crate::plane_from_text(text).unwrap()));
            told(&options)
        };
        for cuts in ["z=1", "x=89", "0,0,-1@0,0,69", "1,1,1@1,0,0"] {
            assert_eq!(cut(cuts), "", "{cuts}");
        }
        for idle in ["z=0", "y=-3", "0,0,-1@0,0,70", "1,1,1@0,0,0"] {
            assert!(cut(idle).contains("90 x 80 x 70"), "{idle}");
        }
    }

    #[test]
    fn transfer_functions_that_show_nothing_are_told() {
        let size = glam::UVec3::new(90, 80, 70);
        let volume = Volume::new("v", size, DVec3::ONE).unwrap();
        let with = |window: [f32; 2], opacities: &[f32], mode: Mode| {
            let mut transfer =
                saccade_core::transfer::Histogram::default().transfer_function(DVec3::ONE);
            transfer.window = window;
            let points = opacities
                .iter()
                .map(|&opacity| saccade_core::transfer::OpacityPoint {
                    value: 0.5,
                    opacity,
                });
            transfer.opacity = points.collect();
            let options = ViewOptions {
                transfers: vec![(Some(0), Some(transfer))],
                shown: Shown {
                    mode,
                    ..Shown::default()
                },
                ..ViewOptions::default()
            };
            { options.without_effect(&volume, AskedWith::CommandLine) }.join("\n")
        };
        for opacities in [&[][..], &[0.0], &[0.0, 0.0]] {
            assert!(with([0.0, 1.0], opacities, Mode::EmissionAbsorption).contains("transparent"));
            assert_eq!(with([0.0, 1.0], opacities, Mode::Maximum), "");
        }
        for mode in [Mode::EmissionAbsorption, Mode::Maximum] {
            for window in [[2.0, 3.0], [1.0, 1.5], [-2.0, 0.0]] {
                assert!(with(window, &[0.5], mode).contains("window"), "{window:?}");
            }
            for window in [[0.0, 1.0], [-1.0, 0.1], [0.9, 2.0]] {
                assert_eq!(with(window, &[0.0, 0.5], mode), "", "{window:?}");
            }
        }
    }

    #[test]
    fn what_the_volume_does_not_have_is_refused() {
        let size = glam::UVec3::new(90, 80, 70);
        let mut volume = Volume::new("v", size, DVec3::ONE).unwrap();
        volume.channels = vec!["a".to_owned(), "b".to_owned()];
        let check = |options: ViewOptions| options.check(&volume).map_err(|e| e.to_string());
        for channel in [0, 1, 2, 9] {
            let with = [
                ViewOptions {
                    channels: Some(vec![0, channel]),
                    ..ViewOptions::default()
                },
                ViewOptions {
                    transfers: vec![(None, None), (Some(channel), None)],
                    ..ViewOptions::default()
                },
                ViewOptions {
                    details: vec![(Some(channel), Detail::Full)],
                    ..ViewOptions::default()
                },
                ViewOptions {
                    isos: vec![(Some(channel), 0.5)],
                    ..ViewOptions::default()
                },
            ];
            for options in with {
                let told = check(options);
                match channel {
                    0 | 1 => assert_eq!(told, Ok(())),
                    _ => assert!(told.unwrap_err().contains("the volume has 2")),
                }
            }
        }
        let outside = Shown {
            slice: Some(crate::plane::Plane::through_voxel(2, 70.0)),
            ..Shown::default()
        };
        let told = check(ViewOptions {
            shown: outside,
            ..ViewOptions::default()
        });
        assert!(told.unwrap_err().contains("z=70"));
    }
}
