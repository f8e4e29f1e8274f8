//! `saccade view`: the application in a window.

use anyhow::Result;
use clap::Args;
use saccade_core::camera::Camera;
use saccade_view::{SourceSpec, ViewOptions, background_from_text, run};

use crate::arguments::CatalogArgument;
use crate::open::{Opened, Place};
use crate::stitching::Stitching;

/// Look at a volume in a window of its own.
#[derive(Args)]
pub(crate) struct View {
    /// Address of a server, or a visualization archive: its folder, or s3://bucket/prefix with
    /// --catalog; or an OME-Zarr or precomputed image: its folder, http(s)://, s3:// or gs:// address
    #[arg(value_name = "URL|ARCHIVE|IMAGE")]
    place: Place,

    #[command(flatten)]
    catalog: CatalogArgument,

    /// Name of the volume [default: the first]
    #[arg(long)]
    volume: Option<String>,

    /// From where: yaw,pitch,distance,x,y,z[,fov] in degrees and nanometres [default: the whole
    /// volume]
    #[arg(long, allow_hyphen_values = true)]
    camera: Option<Camera>,

    /// Behind everything, as #rrggbb
    #[arg(long, value_name = "COLOUR", value_parser = background_from_text, default_value = "#000000")]
    background: [f32; 3],

    /// Ceiling for GPU memory [MiB]
    #[arg(long, value_name = "MIB", default_value_t = 512)]
    gpu_memory: u32,

    #[command(flatten)]
    stitching: Stitching,
}

impl View {
    pub(crate) async fn run(self) -> Result<()> {
        let opened = self
            .place
            .open(&self.catalog, self.volume.as_deref(), &self.stitching)
            .await?;
        let Opened {
            source,
            acquisition,
        } = opened;
        let options = ViewOptions {
            camera: self.camera,
            background: self.background,
            gpu_bytes: u64::from(self.gpu_memory) << 20,
            ..ViewOptions::default()
        };
        Ok(run(
            SourceSpec::Open {
                source,
                acquisition,
            },
            options,
        )
        .await?)
    }
}
