//! `saccade render`: a picture without a window.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use glam::UVec2;
use saccade_render::Gpu;
use saccade_stream::{SessionOptions, SettleError, Status};
use saccade_view::AskedWith;

use crate::arguments::{CatalogArgument, picture, picture_size, seconds};
use crate::looks::Looks;
use crate::open::Place;
use crate::report::{say, tell};
use crate::stitching::Stitching;

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

    /// Size of the picture [pixels]
    #[arg(long, value_name = "WxH", value_parser = picture_size, default_value = "1280x720")]
    size: UVec2,

    #[command(flatten)]
    looks: Looks,

    /// How long to wait for the picture to be complete [s]; 0 takes what one frame brings, which is
    /// of use with --partial
    #[arg(
        long,
        value_name = "SECONDS",
        value_parser = seconds,
        default_value = "60",
        allow_negative_numbers = true
    )]
    timeout: Duration,

    /// Write the picture even if it is not complete by then
    #[arg(long)]
    partial: bool,

    #[command(flatten)]
    stitching: Stitching,
}

impl Render {
    pub(crate) async fn run(self) -> Result<()> {
        let options = self.looks.options()?;
        let opened = self
            .place
            .open(&self.catalog, self.volume.as_deref(), &self.stitching)
            .await?;
        let source = opened.source;
        options.check(source.volume())?;
        for sentence in options.without_effect(source.volume(), AskedWith::CommandLine) {
            say(&sentence);
        }
        let gpu = Gpu::headless().await?;
        let view = options.view(source.volume(), self.size);
        let usual = SessionOptions::default();
        let mut session = options.session(&gpu, source, usual.frames_in_flight, usual.wake)?;
        let status = match session.settle(&view, self.timeout).await {
            Ok(status) => status,
            Err(SettleError::Timeout { status, .. } | SettleError::Failed { status })
                if self.partial =>
            {
                *status
            }
            Err(SettleError::TooMuch { status, .. }) if self.partial => *status,
            Err(SettleError::TooMuch { source, status }) => {
                let size = source.needed.map(|needed| needed.div_ceil(1 << 20));
                let more = size.map_or_else(String::new, |mib| {
                    format!("give {mib} or more with --gpu-memory, ")
                });
                bail!(
                    "{} bricks of what is in view find no room in {} MiB of GPU memory, though drawn from the coarsest \
                     level: {more}show fewer channels with --channels, or less of the volume with --clip or from nearer \
                     (--camera); --partial takes the picture without them",
                    status.fidelity.missing,
                    source.ceiling >> 20
                )
            }
            Err(SettleError::Timeout { .. }) if self.timeout.is_zero() => bail!(
                "one frame did not complete the picture, and it was not written; --timeout waits \
                 longer, --partial takes it as it is"
            ),
            Err(SettleError::TooLarge { source }) => bail!(
                "a picture of {}x{} pixels does not fit {} MiB of GPU memory beside the bricks that it \
                 takes; give {} or more with --gpu-memory, or draw a smaller one with --size",
                source.size.x,
                source.size.y,
                source.ceiling >> 20,
                source.needed.div_ceil(1 << 20)
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
        let levels = session.volume().levels.len();
        tell(&fidelity(&status, levels, empty));
        if let Some(failure) = &status.progress.failure {
            say(&format!("not all could be read: {failure}"));
        }
        Ok(())
    }
}

/// How true the picture is, on one line; of a volume of so many levels.
fn fidelity(status: &Status, levels: usize, empty: bool) -> String {
    if status.frame_time.is_none() {
        return "one frame was drawn and not waited for: what it misses is not known".to_owned();
    }
    let level = match status.fidelity.level {
        Some(level) => format!("level {level}"),
        None => "nothing of the volume in view".to_owned(),
    };
    // Files have no revision.
    let revision = match status.revision {
        0 => String::new(),
        revision => format!(", revision {revision}"),
    };
    // Coarser than the coarsest there is none.
    let most = u8::try_from(levels.saturating_sub(1)).unwrap_or(u8::MAX);
    let full = match status.memory_bias.min(f32::from(most)) {
        bias if bias > 0.0 => format!(
            ", coarser by {bias:.1} levels: GPU memory is full; give more with --gpu-memory"
        ),
        _ => String::new(),
    };
    if empty && status.complete {
        // So is every picture of nothing.
        "nothing was acquired yet: the picture is empty".to_owned()
    } else if status.complete {
        format!("complete, {level}{revision}{full}")
    } else {
        let missing = status.fidelity.missing;
        format!("{missing} bricks missing, {level}{revision}{full}")
    }
}
