//! What `saccade ingest` follows: records, or a folder whose file names or list say what lies where.

use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Result, bail, ensure};
use clap::Args;
use glam::{DVec2, DVec3, UVec3};
use saccade_archive::acquisition::{AcquisitionError, AcquisitionInfo, refuse_link_out};
use saccade_archive::clock::{Clock as _, SystemClock};
use saccade_core::volume::Dtype;
use saccade_ingest::ingest::IngestOptions;
use saccade_ingest::replay::find_list;
use saccade_ingest::watch::{ListConfig, Pattern, WatchConfig, kept_list, was_followed};

use crate::arguments::{corner, extent, pitch, scale, voxel_nm};
use crate::report::say;

/// A folder without records: file names, or a list, say what lies where.
#[derive(Args)]
#[group(id = "bare")]
pub(crate) struct Bare {
    /// The folder holds no records: its file names are like this, such as
    /// 's{section}/r{row}_c{column}_{channel}.tif'; {channel} and folders as needed, {} is anything
    /// [default: tiles.jsonl, or a list, names the files]
    #[arg(long, value_name = "PATTERN", requires_all = ["extent", "voxel", "pitch"])]
    pattern: Option<Pattern>,

    /// The folder holds no records: this file says where its images lie [pixels]. A tile configuration of Fiji, tile
    /// specifications of Render (JSON), a TrakEM2 project, or `file x y z` per line; it may still grow and change
    /// [default: the one that is found in the folder, if it has no records]
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with = "pattern",
        requires = "voxel"
    )]
    list: Option<PathBuf>,

    /// Size of the volume [voxels], with --pattern or a list [default: as volume.json says, or as the tiles span that are
    /// listed at first]
    #[arg(long, value_name = "X,Y,Z", value_parser = extent)]
    extent: Option<UVec3>,

    /// Voxel size [nm], with --pattern or a list [default: as volume.json says]
    #[arg(long, value_name = "X,Y,Z", value_parser = voxel_nm)]
    voxel: Option<DVec3>,

    /// From a tile's corner to the next column's and the next row's [voxels], with --pattern [default: as
    /// tiles.jsonl or the list says]
    #[arg(long, value_name = "X,Y", value_parser = pitch, requires = "pattern")]
    pitch: Option<DVec2>,

    /// Where the list has the corner of the volume [pixels] [default: the low corner of the tiles that are listed at
    /// first]
    #[arg(long, value_name = "X,Y", value_parser = corner, conflicts_with = "pattern", allow_hyphen_values = true)]
    origin: Option<DVec2>,

    /// Size of a pixel [voxels], with --pattern or a list [default: 1]
    #[arg(long, value_name = "NUMBER", value_parser = scale)]
    pixel: Option<f64>,

    /// For how long a list must not have changed [s] before tiles are deleted that it names no more, or before it is told
    /// that it makes no sense at the start: who writes it, slowly or with pauses, may not have come to the end [default: 30]
    #[arg(long, value_name = "SECONDS", value_parser = clap::value_parser!(u32).range(1..=86_400), conflicts_with = "pattern")]
    drop_after: Option<u32>,

    /// Number of the first section, row and column of --pattern, or of the first section of a list [default: 0, or that of
    /// the tiles that are listed at first]
    #[arg(long, value_name = "NUMBER")]
    first: Option<u32>,

    /// Names of the channels, in order, with --pattern or a list [default: one without a name, or those that the list names
    /// at first]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    channels: Vec<String>,

    /// Where the names of a list's images say the channel, such as '{}_{channel}.tif' or '{channel}/{}' [default: as tile
    /// specifications of Render name images of several channels, or one channel]
    #[arg(long, value_name = "PATTERN", value_parser = Pattern::of_channels, conflicts_with = "pattern")]
    channel_in: Option<Pattern>,

    /// The folder is the one that was followed under this name and has moved here, though its files have other times, as copies may
    #[arg(long)]
    moved: bool,

    /// Bits of a voxel, 8 or 16, with --pattern or a list [default: 8, or as the images have that are listed at first]
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u8).range(8..=16))]
    bits: Option<u8>,
}

/// Whether what keeps a folder from being followed is a file that has changed within `settled`, and may not be whole yet.
pub(crate) fn is_being_written(error: &anyhow::Error, settled: Duration) -> bool {
    let files = error.chain().filter_map(|cause| {
        let shared = cause.downcast_ref::<Arc<AcquisitionError>>();
        match { cause.downcast_ref() }.or(shared.map(AsRef::as_ref))? {
            // Nothing that is written to a link's end makes it stay inside.
            AcquisitionError::LeadsOut { .. } => None,
            found => Some(found.path().to_owned()),
        }
    });
    let mut files = files.filter_map(|path| path.metadata().ok().filter(Metadata::is_file));
    files.any(|file| {
        let written = file.modified().ok();
        // One of a time that is to come has not changed for long.
        let ago = written.and_then(|at| SystemClock.now().duration_since(at).ok());
        ago.is_some_and(|ago| ago < settled)
    })
}

/// What is followed.
pub(crate) enum Followed {
    /// An acquisition archive.
    Records,
    /// File names that say what lies where.
    Pattern(WatchConfig),
    /// A list that does.
    List(ListConfig),
}

impl Bare {
    /// For how long what is whole has not changed.
    pub(crate) fn settled(&self) -> Duration {
        self.drop_after.map_or(ListConfig::DROP_AFTER, |seconds| {
            Duration::from_secs(seconds.into())
        })
    }

    /// What to follow in a folder; `name` is the volume's, and `kept` where that was kept which an earlier run found.
    pub(crate) fn followed(
        &self,
        folder: &Path,
        name: &str,
        kept: Option<&Path>,
    ) -> Result<Followed> {
        if let Some(config) = self.watched(name)? {
            return Ok(Followed::Pattern(config));
        }
        match AcquisitionInfo::read(folder) {
            Ok(_) => {
                if let Some(option) = self.of_lists() {
                    bail!(
                        "the folder has records, which say what {option} says: leave it out: {}",
                        folder.display()
                    );
                }
                Ok(Followed::Records)
            }
            Err(nothing @ AcquisitionError::NoInfo { .. }) => {
                let before = kept.and_then(|kept| kept_list(folder, kept));
                if self.list.is_none()
                    && let Some(before) = &before
                {
                    // What was a file when it was found may be a link by now.
                    refuse_link_out(before)?;
                }
                let list = match self.list.clone().or_else(|| before.clone()) {
                    Some(list) => Some(list),
                    None => find_list(folder)?,
                };
                let Some(list) = list else {
                    if let Some(option) = self.of_lists() {
                        bail!(
                            "{option} is for folders with a list of their images or whose file names say where these lie, \
                             but no list was found: name it with --list, or say with --pattern how the files are named: {}",
                            folder.display()
                        );
                    }
                    return Err(nothing.into());
                };
                let config = self.listed(list, name)?;
                // One that was followed before may be about to be mended.
                if before.is_none() {
                    config.check()?;
                }
                say(&format!(
                    "the places are those of {}",
                    config.list.display()
                ));
                Ok(Followed::List(config))
            }
            Err(e) => Err(e.into()),
        }
    }

    /// What was followed before and is not there now, and what to call it to those who look from elsewhere.
    pub(crate) fn away(&self, folder: &Path, kept: &Path) -> Option<(PathBuf, &'static str)> {
        if !was_followed(folder, kept) {
            return None;
        }
        if !folder.is_dir() {
            return Some((folder.to_owned(), "the folder"));
        }
        let list = kept_list(folder, kept)?;
        // Another one is another matter.
        let is_meant = self.list.as_ref().is_none_or(|named| {
            let named = std::path::absolute(named).unwrap_or_else(|_| named.clone());
            let around = named.parent().and_then(|around| around.canonicalize().ok());
            let named = match (around, named.file_name()) {
                (Some(around), Some(name)) => around.join(name),
                _ => named,
            };
            named == list
        });
        (is_meant && self.pattern.is_none() && !list.is_file())
            .then_some((list, "the list of its tiles"))
    }

    /// An option that folders with records have no use for, if one is given.
    fn of_lists(&self) -> Option<&'static str> {
        let given = [
            (self.list.is_some(), "--list"),
            (self.extent.is_some(), "--extent"),
            (self.voxel.is_some(), "--voxel"),
            (self.origin.is_some(), "--origin"),
            (self.pixel.is_some(), "--pixel"),
            (self.first.is_some(), "--first"),
            (self.bits.is_some(), "--bits"),
            (self.drop_after.is_some(), "--drop-after"),
            (!self.channels.is_empty(), "--channels"),
            (self.channel_in.is_some(), "--channel-in"),
            (self.moved, "--moved"),
        ];
        let first = given.into_iter().find(|(given, _)| *given);
        first.map(|(_, option)| option)
    }

    fn dtype(&self) -> Result<Option<Dtype>> {
        Ok(match self.bits {
            None => None,
            Some(8) => Some(Dtype::Uint8),
            Some(16) => Some(Dtype::Uint16),
            Some(bits) => bail!("voxels have 8 or 16 bits, not {bits}"),
        })
    }

    fn watched(&self, name: &str) -> Result<Option<WatchConfig>> {
        let (Some(pattern), Some(extent), Some(voxel_nm), Some(pitch)) =
            (&self.pattern, self.extent, self.voxel, self.pitch)
        else {
            return Ok(None);
        };
        let mut info = AcquisitionInfo::new(name, extent, voxel_nm);
        info.channels.clone_from(&self.channels);
        info.dtype = self.dtype()?.unwrap_or(Dtype::Uint8);
        if let Some(mistake) = info.channel_mistake() {
            bail!("{mistake}; name each once with --channels");
        }
        Ok(Some(WatchConfig {
            pattern: pattern.clone(),
            info,
            pitch,
            scale: self.pixel.unwrap_or(1.0),
            first: self.first.unwrap_or(0),
            poll: IngestOptions::DEFAULT.poll,
            budget: WatchConfig::BUDGET,
            moved: self.moved,
        }))
    }

    fn listed(&self, list: PathBuf, name: &str) -> Result<ListConfig> {
        let Some(voxel_nm) = self.voxel else {
            bail!(
                "a list says where the tiles of this folder lie, but not how large a voxel is: give --voxel X,Y,Z \
                 (pixel size, and thickness of the sections [nm]): {}",
                list.display()
            );
        };
        let config = ListConfig {
            list,
            name: name.to_owned(),
            voxel_nm,
            extent: self.extent,
            dtype: self.dtype()?,
            channels: (!self.channels.is_empty()).then(|| self.channels.clone()),
            channel_in: self.channel_in.clone(),
            origin: self.origin,
            first: self.first,
            scale: self.pixel.unwrap_or(1.0),
            poll: IngestOptions::DEFAULT.poll,
            rest: ListConfig::REST,
            drop_after: self.settled(),
            budget: WatchConfig::BUDGET,
            moved: self.moved,
        };
        let mut info = AcquisitionInfo::new(name, UVec3::ONE, voxel_nm);
        info.channels.clone_from(&self.channels);
        if let Some(mistake) = info.channel_mistake() {
            bail!("{mistake}; name each once with --channels");
        }
        ensure!(
            config.list.is_file(),
            "the list of tiles is not there; name another with --list: {}",
            config.list.display()
        );
        Ok(config)
    }
}
