//! What the records say, and giving tiles back to ingest.

use std::path::PathBuf;

use super::names::Name;
use super::{Check, CheckError, FindingKind, Repair};
use crate::acquisition::{Record, RecordReader, TileRecord, image_path};
use crate::catalog::{Quarantined, Tile, VolumeEntry, Waiting};

/// How the reasons begin for which a check sets tiles aside; ingest's never do.
pub(super) const WRONG: &str = "what the catalog says of it was found wrong";
pub(super) const DAMAGED: &str = "its pyramid was found damaged";

impl Check<'_> {
    /// The position of the record that a tile's pyramid was made of, or is to be: what its name says, unless the records are at
    /// hand and say that this is none of the tile's.
    pub(super) async fn position(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<Option<u64>, CheckError> {
        let said = position_of(&tile.pyramid);
        let is_its = |at: u64| match self.source(entry, Some(&tile.name), Some(at)) {
            Source::There(..) | Source::ImageGone(_) => Some(true),
            Source::NoRecord => Some(false),
            Source::NoRecords => None,
        };
        if said.is_some_and(|said| is_its(said) != Some(false)) {
            return Ok(said);
        }
        let others = self.other_positions(entry, tile).await?;
        let its = others.iter().copied().find(|at| is_its(*at) == Some(true));
        Ok(its.or(said).or(others.first().copied()))
    }

    /// Positions of records that may be a tile's and not its pyramid's: what its row says, and the newest of its name.
    pub(super) async fn other_positions(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<Vec<u64>, CheckError> {
        let catalog = self.archive.catalog();
        let row = catalog.origin(&entry.volume.name, tile.id).await?;
        let newest = { self.records.as_ref() }.and_then(|records| records.newest_of(&tile.name));
        let said = row.map(|row| row.position).into_iter().chain(newest);
        let name = Name::of(&tile.pyramid);
        let is_own = |at: u64| {
            name.is_some_and(|name| name.volume == entry.volume.name && name.position == at)
        };
        Ok(said.filter(|at| !is_own(*at)).collect())
    }

    /// Gives a tile back to ingest, or puts it into quarantine.
    pub(super) async fn repair(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        kind: FindingKind,
        source: Source,
        reason: &str,
    ) -> Result<Repair, CheckError> {
        let what = match kind {
            FindingKind::Spoilt => WRONG,
            _ => DAMAGED,
        };
        let reason = format!("{what}: {reason}");
        if let Source::There(position, record) = source {
            self.queue(entry, position, record, reason).await?;
            return Ok(Repair::Queued);
        }
        let what = Quarantined {
            file: tile.pyramid.clone(),
            tile: Some(tile.name.clone()),
            reason,
            bytes: None,
            at: self.archive.catalog().clock().now(),
            awaited: None,
        };
        let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
        commit.quarantine(&what).await?;
        commit.finish().await?;
        Ok(Repair::Quarantined)
    }

    /// Whether what a tile was made of is at hand: of this tile, if that is said.
    pub(super) fn source(
        &self,
        entry: &VolumeEntry,
        tile: Option<&str>,
        at: Option<u64>,
    ) -> Source {
        let found = at.and_then(|at| Some((at, self.record_at(entry, at)?)));
        match found {
            Some((at, (folder, Record::Tile(record))))
                if tile.is_none_or(|tile| record.tile == tile) =>
            {
                let is_there = image_path(&folder, &record.file).is_some_and(|i| i.is_file());
                match is_there {
                    true => Source::There(at, record),
                    false => Source::ImageGone(record.file),
                }
            }
            _ if self.records_are_known(entry) => Source::NoRecord,
            _ => Source::NoRecords,
        }
    }

    /// Whether the records of a volume are at hand.
    fn records_are_known(&self, entry: &VolumeEntry) -> bool {
        let of = self.folder_of(entry).zip(self.read);
        of.is_some_and(|(folder, read)| RecordReader::new(&folder, read).recognize().is_ok())
    }

    /// Has ingest work on a record again.
    pub(super) async fn queue(
        &self,
        entry: &VolumeEntry,
        position: u64,
        record: TileRecord,
        reason: String,
    ) -> Result<(), CheckError> {
        let waiting = Waiting {
            position,
            record,
            reason,
        };
        let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
        commit.wait(&waiting).await?;
        commit.finish().await?;
        Ok(())
    }

    /// The folder of a volume's records, if there is one.
    pub(super) fn folder_of(&self, entry: &VolumeEntry) -> Option<PathBuf> {
        let kept = { self.options.watched.iter() }.map(|all| all.join(&entry.volume.name));
        let mut kept = kept.filter(|folder| folder.join(RecordReader::FILE).is_file());
        let is_anothers = self.of_others.contains(&entry.volume.name);
        let asked = || self.options.acquisition.clone().filter(|_| !is_anothers);
        kept.next().or_else(asked)
    }

    /// The record at a position, and the folder of its acquisition, if the records are those that were read.
    pub(super) fn record_at(&self, entry: &VolumeEntry, at: u64) -> Option<(PathBuf, Record)> {
        let folder = self.folder_of(entry)?;
        RecordReader::new(&folder, self.read?).recognize().ok()?;
        let record = super::cursor::record_at(&folder, at)?;
        Some((folder, record))
    }

    /// The record of a tile, of this one if that is said, at a position, if its image is still there.
    pub(super) fn tile_record(
        &self,
        entry: &VolumeEntry,
        tile: Option<&str>,
        at: u64,
    ) -> Option<TileRecord> {
        match self.source(entry, tile, Some(at)) {
            Source::There(_, record) => Some(record),
            _ => None,
        }
    }
}

/// What a tile was made of.
#[derive(Debug)]
pub(super) enum Source {
    /// A record, and its image.
    There(u64, TileRecord),
    /// A record whose image is not there any more.
    ImageGone(String),
    /// The records at hand have none of it.
    NoRecord,
    /// No records are at hand.
    NoRecords,
}

impl Source {
    /// What is to be done where it cannot be made anew, after what is wrong; whether its pyramid `is_lost` as well.
    pub(super) fn advice(&self, is_lost: bool) -> String {
        match self {
            Self::There(..) => String::new(),
            Self::ImageGone(file) => {
                let neither = match is_lost {
                    true => "neither of the two is left: ",
                    false => "",
                };
                format!(
                    ", and its image {file:?} is not in the acquisition's folder any more, so that it cannot be made anew: {neither}put \
                     a copy of the image there, and `saccade check --repair --acquisition FOLDER` has ingest do it"
                )
            }
            Self::NoRecord => {
                ", and no record of the acquisition's folder is of it: append the tile's record once more, with the transform that it is to have, and ingest makes it anew"
                    .to_owned()
            }
            Self::NoRecords => {
                "; append the tile's record to its acquisition once more, with the transform that it is to have, and ingest makes it \
                 anew; with --acquisition FOLDER, --repair does so"
                    .to_owned()
            }
        }
    }
}

/// The position of the record that a pyramid was made of: ingest ends names with it.
pub(super) fn position_of(pyramid: &str) -> Option<u64> {
    let stem = pyramid.strip_suffix(".tif")?;
    u64::from_str_radix(stem.rsplit_once('-')?.1, 16).ok()
}
