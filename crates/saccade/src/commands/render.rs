//! `saccade render`: a picture without a window.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use glam::{DVec3, UVec2};
use saccade_core::camera::Camera;
use saccade_core::transfer::{OpacityPoint, TransferFunction};
use saccade_render::{Gpu, Heat, Mode, View};
use saccade_stream::{Detail, Session, SessionOptions, SettleError, Status};
use saccade_view::{
    MOST_CUTS, Plane, Shown, ShownError, background_from_text, box_from_text, channels_from_text,
    details_from_text, heat_from_text, mode_from_text, plane_from_text, set_details, show_channels,
    thickness_from_text,
};

use crate::arguments::{CatalogArgument, picture, picture_size, seconds};
use crate::open::Place;
use crate::report::{say, tell};
use crate::stitching::Stitching;

/// How finely channels are drawn, in one argument.
#[derive(Clone, Debug)]
struct Details(Vec<(Option<u32>, Detail)>);

fn details(text: &str) -> Result<Details, ShownError> {
    details_from_text(text).map(Details)
}

/// A list of channels, in one argument.
#[derive(Clone)]
struct Channels(Vec<u32>);

fn channels(text: &str) -> Result<Channels, ShownError> {
    channels_from_text(text).map(Channels)
}

/// A value of the value type's range.
fn iso(text: &str) -> Result<f32, String> {
    let value: Option<f32> = text.parse().ok();
    let value = value.filter(|value| (0.0..=1.0).contains(value));
    value.ok_or_else(|| "give a number from 0 to 1".to_owned())
}

/// Draw a volume into a PNG file. Waits until the picture is complete.
#[derive(Args)]
pub(crate) struct Render {
    /// Address of a server, or a visualization archive: its folder, or s3://bucket/prefix with
    /// --catalog; or an OME-Zarr or precomputed image: its folder, http(s)://, s3:// or gs:// address
    #[arg(value_name = "URL|ARCHIVE|IMAGE")]
    place: Place,

    #[command(flatten)]
    catalog: CatalogArgument,

    /// The PNG file to write
    #[arg(short, long, value_name = "FILE", value_parser = picture)]
    output: PathBuf,

    /// Name of the volume [default: the first]
    #[arg(long)]
    volume: Option<String>,

    /// From where: yaw,pitch,distance,x,y,z[,fov] in degrees and nanometres [default: the whole
    /// volume]
    #[arg(long, allow_hyphen_values = true)]
    camera: Option<Camera>,

    /// Size of the picture [pixels]
    #[arg(long, value_name = "WxH", value_parser = picture_size, default_value = "1280x720")]
    size: UVec2,

    /// Channels to show, as numbers from 0 with commas [default: the first four]
    #[arg(long, value_name = "N,...", value_parser = channels)]
    channels: Option<Channels>,

    /// How to draw: light (that matter sends out and takes up), maximum (the strongest value along
    /// each ray) or surface (where values pass a bound)
    #[arg(long, value_parser = mode_from_text, default_value = "light")]
    mode: Mode,

    /// With --mode surface, the value of the surface, 0 to 1 of the value type's range [default: between the
    /// opacities' ends]
    #[arg(long, value_name = "VALUE", value_parser = iso)]
    iso: Option<f32>,

    /// Show a part only: two opposite corners [voxels of the finest level]
    /// [default: all of it]
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", value_parser = box_from_text, allow_hyphen_values = true)]
    clip: Option<[DVec3; 2]>,

    /// Show one plane: across an axis, as in z=40, or with any normal and through any point, as in
    /// 1,0.5,0@300,200,40 [voxels of the finest level; normals in nm] [default: all depths]
    #[arg(long, value_name = "PLANE", value_parser = plane_from_text, allow_hyphen_values = true)]
    slice: Option<Plane>,

    /// With --slice, show what is around the plane as well, so thick in all [nm]; 0 is the plane alone
    #[arg(long, value_name = "NM", value_parser = thickness_from_text, default_value = "0", requires = "slice")]
    slab: f64,

    /// Cut away what the normal of a plane does not point to; planes as with --slice, up to four times
    /// [default: nothing]
    #[arg(long, value_name = "PLANE", value_parser = plane_from_text, allow_hyphen_values = true)]
    cut: Vec<Plane>,

    /// Draw the work of rays, black, red, yellow, white: lookups (page table entries read), nodes (of the
    /// residency octree) or samples, and how much is white, as in nodes=40 [default: the volume]
    #[arg(long, value_name = "WORK[=FULL]", value_parser = heat_from_text)]
    heat: Option<Heat>,

    /// How finely channels are drawn: full, content (no level that differs by less than a hundredth from the next
    /// coarser one), levels coarser than the view asks for, as in 2, or the levels that are drawn, 0 the finest, as
    /// in 1-4, 1- or 1-4+1 (one coarser than the view asks for); for all channels, or each as in 0:full,2:1-4+1
    #[arg(long, value_name = "DETAIL,...", value_parser = details, default_value = "full")]
    detail: Details,

    /// Colours and opacities of the first channel shown: auto, a JSON file, or JSON itself
    #[arg(long, value_name = "JSON", default_value = "auto")]
    transfer: String,

    /// Behind everything, as #rrggbb
    #[arg(long, value_name = "COLOUR", value_parser = background_from_text, default_value = "#000000")]
    background: [f32; 3],

    /// Levels coarser (above 0) or finer (below) than one voxel a pixel
    #[arg(
        long,
        value_name = "LEVELS",
        default_value_t = 0.0,
        allow_hyphen_values = true
    )]
    lod_bias: f32,

    /// Ceiling for GPU memory [MiB]
    #[arg(long, value_name = "MIB", default_value_t = 512)]
    gpu_memory: u32,

    /// How long to wait for the picture to be complete [s]; 0 takes what one frame brings, which is
    /// of use with --partial
    #[arg(long, value_name = "SECONDS", value_parser = seconds, default_value = "60")]
    timeout: Duration,

    /// Write the picture even if it is not complete by then
    #[arg(long)]
    partial: bool,

    #[command(flatten)]
    stitching: Stitching,
}

impl Render {
    pub(crate) async fn run(self) -> Result<()> {
        let transfer = self.transfer_function()?;
        let opened = self
            .place
            .open(&self.catalog, self.volume.as_deref(), &self.stitching)
            .await?;
        let source = opened.source;
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
        shown.check(source.volume())?;
        let gpu = Gpu::headless().await?;
        let gpu_bytes = u64::from(self.gpu_memory) << 20;
        let options = SessionOptions {
            gpu_bytes,
            ..SessionOptions::default()
        };
        let camera = self
            .camera
            .unwrap_or_else(|| Camera::around(source.volume()));
        let mut session = Session::new(&gpu, source, options)?;
        let channels = self.channels.as_ref().map(|Channels(list)| &list[..]);
        show_channels(&mut session, channels, transfer)?;
        let Details(details) = &self.detail;
        set_details(&mut session, details)?;
        if let Some(iso) = self.iso {
            for channel in (0..).take(session.channels().len()) {
                session.set_iso(channel, Some(iso))?;
            }
        }
        let view = View {
            background: self.background,
            mode: shown.drawn_mode(),
            clip: shown.clip(session.volume()),
            heat: shown.heat,
            lod_bias: self.lod_bias,
            ..View::new(camera, self.size)
        };
        let status = match session.settle(&view, self.timeout).await {
            Ok(status) => status,
            Err(SettleError::Timeout { status, .. } | SettleError::Failed { status })
                if self.partial =>
            {
                *status
            }
            Err(SettleError::Timeout { .. }) if self.timeout.is_zero() => bail!(
                "one frame did not complete the picture, and it was not written; --timeout waits \
                 longer, --partial takes it as it is"
            ),
            Err(error) => {
                return Err(error).context(
                    "the picture is not complete and was not written; --timeout waits longer, \
                     --partial takes it as it is",
                );
            }
        };
        let picture = session.renderer().read_pixels().await?;
        image::save_buffer_with_format(
            &self.output,
            &picture.rgba,
            picture.size.x,
            picture.size.y,
            image::ExtendedColorType::Rgba8,
            image::ImageFormat::Png,
        )
        .with_context(|| format!("cannot write the picture {}", self.output.display()))?;
        let counted = session.channels().iter().map(|c| c.histogram.total());
        let empty = status.revision == 0 && counted.sum::<u64>() == 0;
        tell(&fidelity(&status, empty));
        if let Some(failure) = &status.progress.failure {
            say(&format!("not all could be read: {failure}"));
        }
        Ok(())
    }

    /// `None` for the automatic one.
    fn transfer_function(&self) -> Result<Option<TransferFunction>> {
        if self.transfer == "auto" {
            return Ok(None);
        }
        let inline = self.transfer.trim_start().starts_with('{');
        let (json, place) = if inline {
            (self.transfer.clone(), "--transfer".to_owned())
        } else {
            let json = std::fs::read_to_string(&self.transfer)
                .with_context(|| format!("cannot read the transfer function {}", self.transfer))?;
            (json, self.transfer.clone())
        };
        let transfer = serde_json::from_str(&json)
            .with_context(|| format!("this is no transfer function as JSON: {place}"))?;
        refuse_nonsense(&transfer).with_context(|| format!("this shows nothing: {place}"))?;
        Ok(Some(transfer))
    }
}

/// A transfer function with which no picture can be drawn.
fn refuse_nonsense(transfer: &TransferFunction) -> Result<()> {
    let [low, high] = transfer.window;
    ensure!(
        low.is_finite() && high.is_finite() && low != high,
        "the two ends of the window have to differ, not {low} and {high}"
    );
    let length = transfer.opacity_length_nm;
    ensure!(
        length.is_finite() && length > 0.0,
        "opacity_length_nm has to be above 0, not {length}"
    );
    let within = |value: f32| (0.0..=1.0).contains(&value);
    let sensible = |point: &OpacityPoint| within(point.value) && within(point.opacity);
    ensure!(
        transfer.opacity.iter().all(sensible),
        "values and opacities go from 0 to 1"
    );
    ensure!(
        transfer.opacity.is_sorted_by(|a, b| a.value <= b.value),
        "the points of the opacity have to be in the order of their values"
    );
    Ok(())
}

/// How true the picture is, on one line.
fn fidelity(status: &Status, empty: bool) -> String {
    let level = match status.fidelity.level {
        Some(level) => format!("level {level}"),
        None => "nothing of the volume in view".to_owned(),
    };
    // Files have no revision.
    let revision = match status.revision {
        0 => String::new(),
        revision => format!(", revision {revision}"),
    };
    if empty {
        // Complete it is, but so is every picture of nothing.
        "nothing was acquired yet: the picture is empty".to_owned()
    } else if status.complete {
        format!("complete, {level}{revision}")
    } else {
        let missing = status.fidelity.missing;
        format!("{missing} bricks missing, {level}{revision}")
    }
}
