//! What a check tells.

use std::collections::BTreeMap;

use serde::Serialize;

/// What was looked at, and what was found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CheckReport {
    /// Tiles that the catalog names.
    pub tiles: u64,
    /// Their pyramids' size \[bytes\]; of quick checks, what the storage says.
    pub bytes: u64,
    /// Pyramids without checksums, which older versions wrote.
    pub without_checksums: u64,
    /// Replaced pyramids that wait for their deletion.
    pub retired: u64,
    /// Unnamed objects that are too young to be called orphans.
    pub young: u64,
    /// Images that are set aside: `saccade ingest` told why, and what it shows of itself does.
    pub set_aside: u64,
    /// Images that were announced, and that `saccade ingest` has not taken in yet.
    pub queued: u64,
    /// What is not as it should be.
    pub findings: Vec<Finding>,
}

/// Something that is not as it should be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What it is.
    pub kind: FindingKind,
    /// The volume, if it belongs to one.
    pub volume: Option<String>,
    /// The tile, if it is one's.
    pub tile: Option<String>,
    /// The object in the storage.
    pub object: Option<String>,
    /// What is wrong.
    pub reason: String,
    /// What was done about it.
    pub repair: Option<Repair>,
}

impl Finding {
    /// Whether it is mended, or will be.
    fn is_mended(&self) -> bool {
        matches!(
            self.repair,
            Some(
                Repair::Queued
                    | Repair::Recounted
                    | Repair::Moved
                    | Repair::Confirmed
                    | Repair::Kept
                    | Repair::Reread
                    | Repair::Reindexed
                    | Repair::Restored
                    | Repair::Renamed
                    | Repair::Renumbered
                    | Repair::TakenAway
            )
        )
    }
}

/// What can be wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum FindingKind {
    /// The catalog's own file is damaged: what it says means nothing until it is mended.
    Unsound,
    /// The catalog names a pyramid that is not there.
    Missing,
    /// A pyramid is not what was written.
    Damaged,
    /// A pyramid is whole, but that of another tile.
    Mistaken,
    /// A tile lies where nothing can: numbers that are none, or outside the volume.
    Misplaced,
    /// Two tiles name one pyramid.
    Shared,
    /// What the catalog says of a tile or of a volume cannot be understood, or is not what the records say.
    Spoilt,
    /// The catalog lacks a tile whose record it has read.
    Lost,
    /// The catalog's counts are not those of its tiles.
    Miscounted,
    /// A pyramid that nothing names. Harmless, but it takes space.
    Orphan,
}

/// What was done about a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Repair {
    /// The object is deleted.
    Deleted,
    /// The tile's record waits for ingest, which makes the pyramid anew.
    Queued,
    /// The tiles, or the changes, were counted anew.
    Recounted,
    /// The tile lies where its records say.
    Moved,
    /// The tile stays where it lies.
    Confirmed,
    /// The pyramid is no longer to be deleted.
    Kept,
    /// The tile is no longer called deleted.
    Restored,
    /// The tile has its own name, or names its own pyramid, again.
    Renamed,
    /// The tile is of the record of which its pyramid is.
    Renumbered,
    /// The tile is none, or was deleted before, and is taken away.
    TakenAway,
    /// How far the records were read is found out from them: ingest goes on from there.
    Reread,
    /// The indexes of the catalog's file are made anew, and it is sound.
    Reindexed,
    /// The tile is in quarantine, for its record or image is not to be had.
    Quarantined,
}

impl FindingKind {
    /// Whether something is lost; else only space is.
    pub fn is_damage(self) -> bool {
        self != Self::Orphan
    }
}

impl CheckReport {
    /// Findings that are damage and not on the way to be mended.
    pub fn damage(&self) -> usize {
        let damage = self
            .findings
            .iter()
            .filter(|finding| finding.kind.is_damage() && !finding.is_mended());
        damage.count()
    }
}

/// How many findings there are of each kind.
pub fn count(findings: &[Finding]) -> BTreeMap<FindingKind, usize> {
    let mut counts = BTreeMap::new();
    for finding in findings {
        *counts.entry(finding.kind).or_default() += 1;
    }
    counts
}
