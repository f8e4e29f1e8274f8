//! `saccade view`: the application in a window.

use anyhow::Result;
use clap::Args;
use saccade_view::{AskedWith, SourceSpec, run};

use crate::arguments::CatalogArgument;
use crate::looks::Looks;
use crate::open::{Opened, Place};
use crate::report::say;
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

    #[command(flatten)]
    looks: Looks,

    #[command(flatten)]
    stitching: Stitching,
}

impl View {
    pub(crate) async fn run(self) -> Result<()> {
        let options = self.looks.options()?;
        let opened = self
            .place
            .open(&self.catalog, self.volume.as_deref(), &self.stitching)
            .await?;
        let Opened {
            source,
            acquisition,
            ..
        } = opened;
        // Before there is a window.
        options.check(source.volume())?;
        for sentence in options.without_effect(source.volume(), AskedWith::CommandLine) {
            say(&sentence);
        }
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
