//! What nothing names.

use std::collections::HashMap;
use std::hash::BuildHasher as _;

use super::repair::position_of;
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::catalog::{CatalogError, Naming};
use crate::storage::Entry;

impl Check<'_> {
    /// Finds what nothing names.
    pub(super) async fn orphans(&mut self) -> Result<(), CheckError> {
        let now = self.archive.catalog().clock().now();
        for object in self.objects {
            let volume = volume_of(&object.name).unwrap_or_default();
            if self.is_unknown(volume) || self.may_be_of_a_tile(&object.name) {
                continue;
            }
            if self.named.contains(&self.hasher.hash_one(&object.name)) {
                continue;
            }
            let age = object.modified.and_then(|at| now.duration_since(at).ok());
            if age.is_none_or(|age| age < self.options.safe_age) {
                self.report.young += 1;
                continue;
            }
            if self.strays.is_none() {
                self.strays = Some(self.find_strays().await?);
            }
            let hash = self.hasher.hash_one(&object.name);
            let stray = self.strays.as_ref().and_then(|all| all.get(&hash));
            if let Some(stray) = stray.cloned() {
                self.stray(object, volume, stray).await?;
                continue;
            }
            let origin = self.whence(&object.name).await?;
            if origin == Whence::ToBeDone {
                self.report.young += 1;
                continue;
            }
            let may_be_lost = origin == Whence::Read && self.lacking.contains(volume);
            if may_be_lost {
                self.doubtful.insert(volume.to_owned());
            }
            let repair = if self.options.repair && origin == Whence::Read && !may_be_lost {
                self.archive.storage().delete(&object.name).await?;
                Some(Repair::Deleted)
            } else {
                None
            };
            let why = match origin {
                Whence::Read if may_be_lost => {
                    ", but the catalog lacks tiles, of which it may be: with --acquisition FOLDER the records tell; until then \
                     they are not deleted"
                }
                Whence::Read | Whence::ToBeDone => "",
                Whence::Later => {
                    ", which are of a record that the catalog has not read: if it is an older copy, `saccade ingest` goes on \
                     from there; they are never deleted"
                }
                Whence::Foreign => {
                    ", and they are no pyramid of this catalog's; they are never deleted"
                }
            };
            self.report.findings.push(Finding {
                kind: FindingKind::Orphan,
                volume: None,
                tile: None,
                object: Some(object.name.clone()),
                reason: format!("nothing names these {} bytes{why}", object.size),
                repair,
            });
        }
        Ok(())
    }

    /// Rows that name pyramids of which no tile that was met does.
    async fn find_strays(&self) -> Result<HashMap<u64, Naming>, CheckError> {
        let (mut strays, mut after) = (HashMap::new(), i64::MIN);
        loop {
            let rows = self.archive.catalog().namings_after(after).await?;
            let Some(last) = rows.last() else {
                return Ok(strays);
            };
            after = last.row;
            for row in rows {
                let hash = self.hasher.hash_one(&row.pyramid);
                if !self.named.contains(&hash) {
                    strays.insert(hash, row);
                }
            }
        }
    }

    /// An object is named by a row that was not met with the tiles of its volume.
    async fn stray(
        &mut self,
        object: &Entry,
        volume: &str,
        stray: Naming,
    ) -> Result<(), CheckError> {
        let named = self.archive.catalog().is_named(volume, &object.name);
        match named.await {
            // It was entered since the tiles were looked at.
            Ok(true) => {
                self.report.young += 1;
                return Ok(());
            }
            Ok(false) | Err(CatalogError::UnknownVolume { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        self.doubtful.insert(volume.to_owned());
        let why = if stray.has_volume {
            "it is not met with the tiles of its volume".to_owned()
        } else {
            format!("the catalog has no volume of its number {}", stray.volume)
        };
        let without_copy = match self.known.contains(volume) {
            true => {
                "`saccade check --repair --acquisition FOLDER` finds from the records which tiles are lost, and `saccade ingest` \
                 enters them anew"
                    .to_owned()
            }
            false => format!(
                "`saccade ingest FOLDER` of its acquisition makes volume {volume:?}, which the catalog lacks, and its tiles anew"
            ),
        };
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: None,
            tile: Some(stray.tile),
            object: Some(object.name.clone()),
            reason: format!(
                "a row of the catalog names these {} bytes, but {why}: they are never deleted. Put a copy of the catalog in its \
                 place; without one, {without_copy}",
                object.size
            ),
            repair: None,
        });
        Ok(())
    }

    /// Whether nothing is known of a volume.
    fn is_unknown(&self, volume: &str) -> bool {
        // One without a name may be any that the catalog does not name.
        let nameless = self.unknown.iter().any(|name| name.contains('\u{fffd}'));
        self.unknown.contains(volume) || (nameless && !self.known.contains(volume))
    }

    /// Whether an object may be what a tile should name whose row does not say so.
    fn may_be_of_a_tile(&self, object: &str) -> bool {
        let (volume, position) = (volume_of(object), position_of(object));
        let of = volume.zip(position);
        of.is_some_and(|(volume, position)| self.kept.contains(&(volume.to_owned(), position)))
    }
}

/// Where an object comes from that nothing names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Whence {
    /// A record that the catalog has read: what came of it is entered, or will never be.
    Read,
    /// One that ingest is to work on, once more if a repair gave it back: the tile may be named again, and its image be gone.
    ToBeDone,
    /// One that it has not read.
    Later,
    /// None of this catalog's volumes.
    Foreign,
}

impl Check<'_> {
    async fn whence(&self, object: &str) -> Result<Whence, CheckError> {
        let parts: Vec<&str> = object.split('/').collect();
        let ["tiles", volume, section, pyramid] = parts[..] else {
            return Ok(Whence::Foreign);
        };
        let (Some(position), Ok(_)) = (position_of(pyramid), section.parse::<u32>()) else {
            return Ok(Whence::Foreign);
        };
        let catalog = self.archive.catalog();
        match catalog.cursor(volume).await {
            // How far they were read is not known.
            Ok(_) if self.unread.contains(volume) => Ok(Whence::Later),
            Ok(read) if position < read.offset => {
                let to_be_done = catalog.is_to_be_done(volume, position).await?;
                Ok(match to_be_done {
                    true => Whence::ToBeDone,
                    false => Whence::Read,
                })
            }
            Ok(_) => Ok(Whence::Later),
            // How far they were read is not known.
            Err(CatalogError::SpoiltCursor { .. }) => Ok(Whence::Later),
            Err(CatalogError::UnknownVolume { .. }) => Ok(Whence::Foreign),
            Err(error) => Err(error.into()),
        }
    }
}

/// The volume whose tile's a pyramid is.
fn volume_of(pyramid: &str) -> Option<&str> {
    Some(pyramid.strip_prefix("tiles/")?.split_once('/')?.0)
}
