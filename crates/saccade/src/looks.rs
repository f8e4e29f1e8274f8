//! How a volume is shown: arguments that a window and a picture without one have in common.

use anyhow::{Context, Result, ensure};
use clap::Args;
use glam::DVec3;
use saccade_core::camera::Camera;
use saccade_core::transfer::TransferFunction;
use saccade_render::{FalseColors, Heat, Mode};
use saccade_stream::Detail;
use saccade_stream::policy::Limits;
use saccade_view::{
    MOST_CUTS, Plane, Shown, ShownError, ViewOptions, background_from_text, box_from_text,
    channel_of_text, channels_from_text, details_from_text, false_colors_from_text,
    gpu_memory_from_text, heat_from_text, host_memory_from_text, isos_from_text, mode_from_text,
    plane_from_text, slice_from_text, thickness_from_text, transfer_from_text,
};

/// How finely channels are drawn, in one argument.
#[derive(Clone)]
struct Details(Vec<(Option<u32>, Detail)>);

fn details(text: &str) -> Result<Details, ShownError> {
    details_from_text(text).map(Details)
}

/// Values of surfaces, in one argument.
#[derive(Clone)]
struct Isos(Vec<(Option<u32>, f32)>);

fn isos(text: &str) -> Result<Isos, ShownError> {
    isos_from_text(text).map(Isos)
}

/// A list of channels, in one argument.
#[derive(Clone)]
struct Channels(Vec<u32>);

fn channels(text: &str) -> Result<Channels, ShownError> {
    channels_from_text(text).map(Channels)
}

/// How a volume is shown.
#[derive(Args)]
pub(crate) struct Looks {
    /// From where: yaw,pitch,distance,x,y,z[,fov] in degrees and nanometres; pitch from -90 to 90, distance above
    /// 0, fov above 0 and below 180, 35 if not told; x,y,z is what is looked at, from the volume's corner
    /// [default: the whole volume]
    #[arg(long, allow_hyphen_values = true)]
    camera: Option<Camera>,

    /// Channels to show, as numbers from 0 with commas [default: the first four]
    #[arg(long, value_name = "N,...", value_parser = channels, allow_negative_numbers = true)]
    channels: Option<Channels>,

    /// How to draw: light (that matter sends out and takes up), maximum (the strongest value along
    /// each ray) or surface (where values pass a bound)
    #[arg(long, value_parser = mode_from_text, default_value = "light")]
    mode: Mode,

    /// With --mode surface, the value of the surface, 0 to 1 of the value type's range; for all channels, or each as
    /// in 0:0.4,2:0.6 [default: between the opacities' ends]
    #[arg(long, value_name = "VALUE,...", value_parser = isos, allow_negative_numbers = true)]
    iso: Option<Isos>,

    /// Show a part only: two opposite corners [voxels of the finest level]
    /// [default: all of it]
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", value_parser = box_from_text, allow_hyphen_values = true)]
    clip: Option<[DVec3; 2]>,

    /// Show one plane: across an axis through the middle of a voxel, as in z=40, or with any normal and through
    /// any point, as in 1,0.5,0@300,200,40 [voxels of the finest level; normals in nm] [default: all depths]
    #[arg(long, value_name = "PLANE", value_parser = slice_from_text, allow_hyphen_values = true)]
    slice: Option<Plane>,

    /// With --slice, show what is around the plane as well, so thick in all [nm]; 0 is the plane alone
    #[arg(
        long,
        value_name = "NM",
        value_parser = thickness_from_text,
        default_value = "0",
        requires = "slice",
        allow_negative_numbers = true
    )]
    slab: f64,

    /// Cut away what the normal of a plane does not point to; planes as with --slice, but z=40 lies before voxel 40,
    /// so that voxels from 40 on stay; 0,0,-1@0,0,40 keeps those before; up to four times [default: nothing]
    #[arg(long, value_name = "PLANE", value_parser = plane_from_text, allow_hyphen_values = true)]
    cut: Vec<Plane>,

    /// Draw the work of rays, black, red, yellow, white: lookups (page table entries read), nodes (of the
    /// residency octree) or samples, and how much is white, as in nodes=40 [default: the volume]
    #[arg(long, value_name = "WORK[=FULL]", value_parser = heat_from_text)]
    heat: Option<Heat>,

    /// Tint what is not drawn from the level that it should be, and show what is missing (residency), or tint each part
    /// by the level that it is drawn from (level), or do not (none)
    #[arg(long, value_name = "WHICH", value_parser = false_colors_from_text, default_value = "none")]
    false_colors: FalseColors,

    /// How finely channels are drawn: full, content (no level that differs by less than a hundredth from the next
    /// coarser one), levels coarser than the view asks for, as in 2, or the levels that are drawn, 0 the finest, as
    /// in 1-4, 1- or 1-4+1 (one coarser than the view asks for), the coarsest of the volume where it has none of them;
    /// for all channels, or each as in 0:full,2:1-4+1
    #[arg(
        long,
        value_name = "DETAIL,...",
        value_parser = details,
        default_value = "full",
        allow_negative_numbers = true
    )]
    detail: Details,

    /// Colours and opacities: auto, a JSON file, or JSON itself; of the first channel shown, or of channel N, as in
    /// 2:FILE, may be repeated; the last of each channel counts [default: auto]
    #[arg(long, value_name = "[N:]JSON")]
    transfer: Vec<String>,

    /// Behind everything, as #rrggbb
    #[arg(long, value_name = "COLOUR", value_parser = background_from_text, default_value = "#000000")]
    background: [f32; 3],

    /// Levels coarser (above 0) or finer (below) than one voxel a pixel
    #[arg(
        long,
        value_name = "LEVELS",
        value_parser = lod_bias_from_text,
        default_value = "0",
        allow_hyphen_values = true
    )]
    lod_bias: f32,

    /// Ceiling for GPU memory [MiB]; where it is full, pictures are coarser
    #[arg(
        long,
        value_name = "MIB",
        value_parser = gpu_memory_from_text,
        default_value = "512",
        allow_negative_numbers = true
    )]
    gpu_memory: u64,

    /// Ceiling for chunks in main memory [MiB]; what is not kept is read again
    #[arg(
        long,
        value_name = "MIB",
        value_parser = host_memory_from_text,
        default_value = "512",
        allow_negative_numbers = true
    )]
    host_memory: u64,
}

impl Looks {
    /// Reads files of transfer functions.
    pub(crate) fn options(self) -> Result<ViewOptions> {
        let mut shown = Shown {
            mode: self.mode,
            within: self.clip,
            slice: self.slice,
            slab_nm: self.slab,
            heat: self.heat,
            ..Shown::default()
        };
        for plane in self.cut {
            ensure!(
                shown.cut(plane),
                "{MOST_CUTS} planes can cut at once; give --cut fewer times"
            );
        }
        let transfers = self.transfer.iter().map(|text| transfer(text));
        let Details(details) = self.detail;
        Ok(ViewOptions {
            camera: self.camera,
            transfers: transfers.collect::<Result<_>>()?,
            channels: self.channels.map(|Channels(list)| list),
            details,
            isos: self.iso.map(|Isos(list)| list).unwrap_or_default(),
            shown,
            background: self.background,
            lod_bias: self.lod_bias,
            false_colors: self.false_colors,
            gpu_bytes: self.gpu_memory,
            limits: Limits {
                host_bytes: self.host_memory,
                ..Limits::default()
            },
            ..ViewOptions::default()
        })
    }
}

fn lod_bias_from_text(text: &str) -> Result<f32, String> {
    let bias = text.trim().parse().ok();
    bias.filter(|bias: &f32| !bias.is_nan())
        .ok_or_else(|| "a number of levels, as in 1 or -0.5".to_owned())
}

/// Of a channel, or of the first that is seen; `None` follows the data.
fn transfer(text: &str) -> Result<(Option<u32>, Option<TransferFunction>)> {
    let (channel, text) = channel_of_text(text);
    if text == "auto" {
        return Ok((channel, None));
    }
    let (json, place) = match text.starts_with('{') {
        true => (text.to_owned(), "--transfer"),
        false => {
            ensure!(
                !text.is_empty(),
                "--transfer names no file; give auto, a JSON file, or JSON itself"
            );
            let json = std::fs::read_to_string(text);
            let json = json.with_context(|| format!("cannot read the transfer function {text}"))?;
            (json, text)
        }
    };
    let transfer = transfer_from_text(&json);
    let transfer = transfer.with_context(|| format!("nothing can be shown with {place}"))?;
    Ok((channel, Some(transfer)))
}
