//! How a list is followed, and why it cannot be.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use glam::{DVec2, DVec3, UVec3};
use saccade_archive::acquisition::AcquisitionError;
use saccade_core::volume::Dtype;

use super::super::looking::Passes;
use super::super::{Pattern, WatchError};
use super::source;
use crate::replay::ReplayError;

/// How a folder with a list is followed.
#[derive(Clone, Debug, PartialEq)]
pub struct ListConfig {
    /// The list: `file x y z` per line, a tile configuration of Fiji, Render's tile specifications, or a TrakEM2
    /// project.
    pub list: PathBuf,
    /// Name of the volume.
    pub name: String,
    /// Voxel size \[nm\].
    pub voxel_nm: DVec3,
    /// Size of the volume \[voxels\]; what the tiles span that are listed at first if `None`.
    pub extent: Option<UVec3>,
    /// Type of the voxels; as the images say that are there at first if `None`.
    pub dtype: Option<Dtype>,
    /// Names of the channels; those that the list names at first if `None`.
    pub channels: Option<Vec<String>>,
    /// How the images' names say the channel, as [`Pattern::of_channels`] reads it; if `None`, as tile specifications of
    /// Render say, or all of the first.
    pub channel_in: Option<Pattern>,
    /// Where the list has the volume's corner \[pixels\]; the low corner of the tiles listed at first if `None`.
    pub origin: Option<DVec2>,
    /// Number of the first section; that of the tiles listed at first if `None`.
    pub first: Option<u32>,
    /// Size of a pixel \[voxels\].
    pub scale: f64,
    /// Pause between looks.
    pub poll: Duration,
    /// For how long the list must not have changed before it is read.
    pub rest: Duration,
    /// For how long it must not have changed before it is read if it names tiles no more: who writes it anew, slowly or
    /// with pauses, has not come to them yet.
    pub drop_after: Duration,
    /// Folders and files asked per look.
    pub budget: usize,
    /// Whether the folder is the one that was followed, and has moved, whatever the times of its files say.
    pub moved: bool,
}

impl ListConfig {
    /// For how long a list rests, if nothing else is said.
    pub const REST: Duration = Duration::from_secs(1);

    /// For how long a list rests that names tiles no more, if nothing else is said.
    pub const DROP_AFTER: Duration = Duration::from_secs(30);

    /// Looks whether the list can be read; nothing is made yet.
    ///
    /// # Errors
    ///
    /// [`ListError::List`], [`ListError::Unfit`], [`ListError::Channels`].
    pub fn check(&self) -> Result<(), ListError> {
        let listing = source::read(self, true);
        let listing = listing.map_err(|e| ListError::List { source: e.into() })?;
        listing.check_fit(self)?;
        listing.check_channels(self)
    }
}

/// Why a list cannot be followed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ListError {
    /// The records cannot be kept, or the folder cannot be looked into.
    #[error(transparent)]
    Watch(#[from] WatchError),
    /// The list makes no sense.
    #[error("the list of tiles cannot be used; mend it, or name another with --list")]
    List {
        /// Why.
        source: Arc<AcquisitionError>,
    },
    /// The list is not there.
    #[error("the list of tiles is not there; put it back, or name another with --list: {}", path.display())]
    Gone {
        /// The list.
        path: PathBuf,
    },
    /// It is not said of which channel the images are.
    #[error(
        "the list does not say of which of the channels its images are: say with --channel-in where their names tell it, \
         such as --channel-in '{{}}_{{channel}}.tif', or leave --channels out: {}",
        list.display()
    )]
    Channels {
        /// The list.
        list: PathBuf,
    },
    /// No image's name says its channel.
    #[error(
        "no image that the list names fits --channel-in {pattern}, such as {first:?}: {why}; give it as they are named: {}",
        list.display()
    )]
    Unfit {
        /// The pattern.
        pattern: String,
        /// The first image.
        first: String,
        /// Why it does not fit.
        why: String,
        /// The list.
        list: PathBuf,
    },
    /// The list names nothing.
    #[error(
        "the list of tiles names no tile: it may be about to be written; if nothing is to be shown any more, end \
         ingest instead: {}",
        path.display()
    )]
    Empty {
        /// The list.
        path: PathBuf,
    },
    /// No image can be read, from which the volume's size or bits could be told.
    #[error(
        "none of the {tiles} images that the list names, such as {such_as}, is there and can be read, so that {} of the volume \
         are not known; copy them into {}, or say {}: {}",
        unknown,
        folder.display(),
        options,
        list.display()
    )]
    NoImages {
        /// Tiles of the list.
        tiles: usize,
        /// The first of which it can be told why, or of all, as the list names it, and why.
        such_as: String,
        /// What of the volume cannot be told.
        unknown: &'static str,
        /// The options that would say it.
        options: &'static str,
        /// Where images are looked for.
        folder: PathBuf,
        /// The list.
        list: PathBuf,
    },
    /// The sections span too much.
    #[error(
        "the sections of the list are too many for a volume, which has {most} at most: {}{file:?} is in section \
         {section}, and the first one is {first}; mend the list, or say --extent: {}",
        line.map_or_else(String::new, |line| format!("line {line}: ")),
        list.display()
    )]
    Sections {
        /// The image of the last section.
        file: String,
        /// Its line, if it was found.
        line: Option<usize>,
        /// Its section.
        section: u32,
        /// The volume's first section.
        first: u32,
        /// Sections that a volume has at most.
        most: u32,
        /// The list.
        list: PathBuf,
    },
    /// The tiles span too much.
    #[error(transparent)]
    Frame(#[from] ReplayError),
}

impl From<AcquisitionError> for ListError {
    fn from(error: AcquisitionError) -> Self {
        Self::Watch(error.into())
    }
}

impl ListError {
    /// Whether a later look may succeed.
    pub(super) fn passes(&self) -> Passes {
        match self {
            Self::Watch(error) => Passes::of(error),
            // Somebody may be about to mend it.
            Self::List { .. }
            | Self::Gone { .. }
            | Self::Empty { .. }
            | Self::NoImages { .. }
            | Self::Unfit { .. } => Passes::Soon,
            Self::Sections { .. } | Self::Channels { .. } | Self::Frame(_) => Passes::Never,
        }
    }
}
