//! `saccade export`: a volume, or a part of one, as files that need no Saccade.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Result, bail};
use clap::Args;
use glam::UVec3;
use indicatif::{ProgressBar, ProgressStyle};
use saccade_archive::StorageLocation;
use saccade_archive::storage::Storage;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::VolumeSource;
use saccade_source::export::{ExportError, ExportOptions, ExportProgress, export};
use saccade_source::images::ImageOptions;
use saccade_source::objects::ObjectError;

use crate::arguments::CatalogArgument;
use crate::interrupt::{INTERRUPTED, interrupted};
use crate::open::{Opened, Place};
use crate::report::say;
use crate::stitching::Stitching;

/// A list of channels, in one argument.
#[derive(Clone)]
struct Channels(Vec<u32>);

fn channels(text: &str) -> Result<Channels, String> {
    let numbers = text.split(',').map(|n| n.trim().parse::<u32>());
    let numbers: Result<_, _> = numbers.collect();
    let wrong = |_| format!("{text:?} is no list of channels, as 0,2");
    Ok(Channels(numbers.map_err(wrong)?))
}

fn region(text: &str) -> Result<VoxelBox, String> {
    let numbers = text.split(',').map(|n| n.trim().parse::<u32>().ok());
    let numbers: Option<Vec<u32>> = numbers.collect();
    let Some(&[x0, y0, z0, x1, y1, z1]) = numbers.as_deref() else {
        return Err(format!("{text:?} is not six whole numbers, x,y,z,x,y,z"));
    };
    let region = VoxelBox::new(UVec3::new(x0, y0, z0), UVec3::new(x1, y1, z1));
    if region.is_empty() {
        return Err("the second corner is not beyond the first on every axis".to_owned());
    }
    Ok(region)
}

/// Write a volume, or a part of it, as an OME-Zarr 0.5 image with shards. An export that was
/// interrupted goes on when it is begun again; it ends with 130.
#[derive(Args)]
pub(crate) struct Export {
    /// Address of a server; or a visualization archive: its folder, or s3://bucket/prefix with
    /// --catalog; or an OME-Zarr or precomputed image: its folder or address
    #[arg(value_name = "URL|ARCHIVE|IMAGE")]
    place: Place,

    /// Where the image is to be: an empty or new folder, or s3://bucket/prefix; or where the same export
    /// was begun
    #[arg(value_name = "OUT")]
    out: StorageLocation,

    #[command(flatten)]
    catalog: CatalogArgument,

    /// Name of the volume [default: the first]
    #[arg(long)]
    volume: Option<String>,

    /// A part only: the first voxel, and the one beyond the last on every axis [voxels of the finest
    /// level] [default: all of it]
    #[arg(long, value_name = "X,Y,Z,X,Y,Z", value_parser = region)]
    region: Option<VoxelBox>,

    /// Channels, as numbers from 0 with commas [default: all]
    #[arg(long, value_name = "N,...", value_parser = channels)]
    channels: Option<Channels>,

    /// The volume's level that becomes the finest of the image; each halves the resolution
    #[arg(long, value_name = "LEVEL", default_value_t = 0)]
    finest: u32,

    /// How hard zstd compresses, 1 (fast) to 22 (small); 0 does not
    #[arg(long, value_name = "LEVEL", default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=22))]
    compression: u8,

    /// Let ids of labels above 65535 become other numbers, which several of them may share; without it, such an
    /// export ends with an error
    #[arg(long)]
    rename_labels: bool,

    /// Take forbidden chunks for missing ones where the image's store forbids whatever it does not have, as public
    /// buckets do that may not be listed; without it, such an export ends with an error
    #[arg(long)]
    forbidden_is_missing: bool,

    #[command(flatten)]
    stitching: Stitching,
}

impl Export {
    pub(crate) async fn run(self) -> Result<ExitCode> {
        let volume = self.volume.as_deref();
        let images = ImageOptions {
            forbidden_is_missing: self.forbidden_is_missing,
            ..ImageOptions::default()
        };
        let opened = self
            .place
            .open_with(&self.catalog, volume, &self.stitching, images);
        let Opened {
            source, catalog, ..
        } = opened.await.map_err(hinted)?;
        if let Some(catalog) = catalog {
            // Nobody who looks for the tiles of a place finds these: the image would lack them in silence.
            catalog.refuse_impossible(&source.volume().name).await?;
        }
        let out = self.out.clone();
        let folder = match &out {
            StorageLocation::Folder(folder) => Some(folder.as_path()),
            _ => None,
        };
        let is_new = folder.is_some_and(|folder| !folder.exists());
        let storage = self.out.open().await?;
        let done = self.export(&source, &*storage).await.map_err(hinted);
        drop(storage);
        if let Some(folder) = folder {
            leave(folder, is_new);
        }
        done
    }

    async fn export(
        self,
        source: &Arc<dyn VolumeSource>,
        storage: &dyn Storage,
    ) -> Result<ExitCode> {
        let options = ExportOptions {
            region: self.region,
            channels: self.channels.map(|Channels(list)| list),
            finest: self.finest,
            compression: self.compression,
            rename_labels: self.rename_labels,
            ..ExportOptions::default()
        };
        if let Some(cut) = self
            .region
            .and_then(|region| cut(region, source.volume().extent()))
        {
            say(&cut);
        }
        // Draws nothing where there is no terminal.
        let bar = ProgressBar::new(0).with_style(
            ProgressStyle::with_template("{bar:32} {pos}/{len} shards, {msg}, {eta} left")
                .unwrap_or_else(|_| ProgressStyle::default_bar()),
        );
        let show = |progress: ExportProgress| {
            bar.set_length(progress.shards);
            bar.set_position(progress.done);
            bar.set_message(megabytes(progress.bytes));
        };
        let exporting = export(source, storage, &options, &show);
        let done = tokio::select! {
            // Listens before anything is done.
            biased;
            () = interrupted() => {
                bar.finish_and_clear();
                say("interrupted; the same command goes on with the export");
                return Ok(ExitCode::from(INTERRUPTED));
            }
            done = exporting => done,
        };
        bar.finish_and_clear();
        let done = match done {
            Err(
                error @ (ExportError::Exists
                | ExportError::Other { .. }
                | ExportError::Outdated { .. }),
            ) => {
                bail!("{error}: {}", self.out)
            }
            Err(error @ ExportError::Label { .. }) => bail!("{error} (--rename-labels)"),
            done => done?,
        };
        say(&summary(&done, bar.elapsed().as_secs_f64()));
        Ok(ExitCode::SUCCESS)
    }
}

/// The same, and what to do where nobody knows whether something is forbidden or missing.
fn hinted(error: anyhow::Error) -> anyhow::Error {
    let is_unclear = error.chain().any(|cause| {
        let shared = cause.downcast_ref::<Arc<ObjectError>>().map(|e| &**e);
        let error = cause.downcast_ref::<ObjectError>().or(shared);
        matches!(error, Some(ObjectError::Unclear { .. }))
    });
    match is_unclear {
        true => error
            .context("if what is forbidden is known to be missing, give --forbidden-is-missing"),
        false => error,
    }
}

/// Takes away what is empty in a folder that was written to, or refused, and is no part of an image; and the folder itself where
/// it `is_new` and nothing was written.
fn leave(folder: &Path, is_new: bool) {
    // Neither succeeds where anything is in it.
    drop(std::fs::remove_dir(folder.join(".incoming")));
    if is_new {
        drop(std::fs::remove_dir(folder));
    }
}

/// What to say of a region that reaches beyond the volume.
fn cut(region: VoxelBox, extent: UVec3) -> Option<String> {
    let part = region.intersection(VoxelBox::of_size(extent));
    // What has nothing of the volume is refused.
    (part != region && !part.is_empty()).then(|| {
        let UVec3 { x, y, z } = part.max;
        format!("the region reaches beyond the volume, and is cut at {x},{y},{z}")
    })
}

fn summary(done: &ExportProgress, seconds: f64) -> String {
    if done.was_whole {
        return "nothing to do: all of this export is there".to_owned();
    }
    let mut parts = vec![format!(
        "exported {} in {seconds:.0} s: {} shards",
        megabytes(done.bytes),
        done.shards - done.again,
    )];
    for (count, what) in [
        (done.kept, "were there already"),
        (done.empty, "hold nothing"),
        (done.again, "changed meanwhile and were exported again"),
    ] {
        if count > 0 {
            parts.push(format!("{count} {what}"));
        }
    }
    parts.join(", ")
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_have_two_corners() {
        let read = region("1, 2,3,4,5,6").unwrap();
        assert_eq!(
            (read.min, read.max),
            (UVec3::new(1, 2, 3), UVec3::new(4, 5, 6))
        );
        for wrong in [
            "",
            "1,2,3",
            "1,2,3,1,5,6",
            "1,2,3,4,5,-6",
            "1,2,3,4,5,6,7",
            "a,2,3,4,5,6",
        ] {
            assert!(region(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_is_cut_is_told() {
        let extent = UVec3::new(10, 20, 30);
        let told = |text: &str| cut(region(text).unwrap(), extent);
        assert_eq!(told("0,0,0,10,20,30"), None);
        assert_eq!(told("10,0,0,11,20,30"), None, "refused elsewhere");
        let words = told("1,2,3,10,21,400").unwrap();
        assert!(words.ends_with("cut at 10,20,30"), "{words}");
    }

    #[test]
    fn channels_are_a_list() {
        assert_eq!(channels("2, 0").unwrap().0, [2, 0]);
        for wrong in ["", "a", "1,,2", "-1"] {
            assert!(channels(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_was_done_is_told() {
        let done = ExportProgress {
            shards: 12,
            done: 12,
            kept: 3,
            again: 2,
            bytes: 2_500_000,
            ..ExportProgress::default()
        };
        assert_eq!(
            summary(&done, 4.0),
            "exported 2.5 MB in 4 s: 10 shards, 3 were there already, 2 changed meanwhile and were exported again"
        );
    }
}
