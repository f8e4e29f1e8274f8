//! What nothing names.

use std::hash::BuildHasher as _;

use super::repair::position_of;
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::catalog::CatalogError;
use crate::storage::Entry;

impl Check<'_> {
    /// Finds what nothing names.
    pub(super) async fn orphans(&mut self, objects: &[Entry]) -> Result<(), CheckError> {
        let now = self.archive.catalog().clock().now();
        for object in objects {
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
            let origin = self.whence(&object.name).await?;
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
                Whence::Read => "",
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
        match self.archive.catalog().cursor(volume).await {
            Ok(read) if position < read.offset => Ok(Whence::Read),
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
