//! Transforms and deletions from others than the microscope: from registration, or by hand.
//!
//! They are told in the microscope's words, see [`Record`], but go straight to the catalog. So they also reach volumes
//! whose records nobody may append to: those of a folder with a naming pattern or a list. What they say counts until the
//! microscope says otherwise: a new image of a tile lies where its own record says, and brings a deleted tile back.
//!
//! # Transactions
//!
//! What is said of tiles of one section, line after line, becomes so at once. Small groups share a transaction; none has
//! more than [`MOST`] lines, so that ingest is not kept waiting.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::{self, BufRead, Read as _};

use saccade_archive::acquisition::{DeleteRecord, Record, TransformRecord};
use saccade_archive::catalog::{Catalog, CatalogError, DeleteOutcome, TransformOutcome};
use serde::de::IgnoredAny;

use crate::Cancel;
use crate::sense::{CHECK, nonsense};

/// Most lines of one transaction.
pub const MOST: usize = 16_384;

/// Lines of one transaction, where sections have fewer.
const ENOUGH: usize = 256;

/// Mistakes that are told.
const TOLD: usize = 3;

/// What a line says.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// A tile lies elsewhere.
    Transform(TransformRecord),
    /// A tile is no more.
    Delete(DeleteRecord),
}

impl Change {
    /// The tile that it is about.
    pub fn tile(&self) -> &str {
        match self {
            Self::Transform(record) => &record.tile,
            Self::Delete(record) => &record.tile,
        }
    }
}

/// A line of a file of changes.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Its number, from 1.
    pub line: u64,
    /// What it says.
    pub change: Change,
}

/// Why changes could not be made, or not all of them.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UpdateError {
    /// The file cannot be read.
    #[error(
        "cannot read {name}; nothing was changed; check that it exists and that you may read it"
    )]
    Read {
        /// What the system says.
        source: io::Error,
        /// The file.
        name: String,
    },
    /// Some of its lines make no sense.
    #[error(
        "{name} cannot be used, and nothing was changed: {mistakes}; mend it and give it again"
    )]
    Lines {
        /// The first wrong lines, and how many more there are.
        mistakes: String,
        /// The file.
        name: String,
    },
    /// The catalog cannot be used.
    #[error("{}", so_far(*done, *all))]
    Catalog {
        /// Why.
        source: CatalogError,
        /// Lines before.
        done: usize,
        /// All lines.
        all: usize,
    },
}

/// Reads all changes; `name` is for messages.
///
/// # Errors
///
/// [`UpdateError::Read`], and [`UpdateError::Lines`] for lines that are no transforms or deletions.
pub fn read(mut input: impl BufRead, name: &str) -> Result<Vec<Line>, UpdateError> {
    let mut lines = Vec::new();
    let (mut mistakes, mut more) = (Vec::new(), 0_u64);
    let mut text = Vec::new();
    for line in 1.. {
        text.clear();
        // A line without an end is not kept in memory whole.
        let mut part = input.by_ref().take(Record::LONGEST as u64 + 1);
        let read = part.read_until(b'\n', &mut text);
        read.map_err(|source| UpdateError::Read {
            source,
            name: name.to_owned(),
        })?;
        if text.is_empty() {
            break;
        }
        if text.len() > Record::LONGEST {
            mistakes.push(format!("line {line} is no record, but longer than any"));
            break;
        }
        // Some editors begin a text with a mark.
        let text = match line {
            1 => text.strip_prefix("\u{feff}".as_bytes()).unwrap_or(&text),
            _ => &text[..],
        };
        if text.iter().all(u8::is_ascii_whitespace) {
            continue;
        }
        let reason = match Record::parse(text) {
            Ok(Record::Transform(record)) => {
                let wrong = unknown_key(text, &["record", "tile", "transform"]);
                let nonsense = || Some(format!("{}; check {CHECK}", nonsense(record.transform)?));
                match wrong.or_else(nonsense) {
                    Some(reason) => reason,
                    None => {
                        let change = Change::Transform(record);
                        lines.push(Line { line, change });
                        continue;
                    }
                }
            }
            Ok(Record::Delete(record)) => match unknown_key(text, &["record", "tile"]) {
                Some(reason) => reason,
                None => {
                    let change = Change::Delete(record);
                    lines.push(Line { line, change });
                    continue;
                }
            },
            Ok(Record::Tile(_)) => {
                "it is about a new tile, which only `saccade ingest` takes in; what counts here is \
                 \"transform\" and \"delete\""
                    .to_owned()
            }
            Err(reason) => reason,
        };
        if mistakes.len() < TOLD {
            mistakes.push(format!("line {line}: {reason}"));
        } else {
            more += 1;
        }
    }
    if mistakes.is_empty() {
        return Ok(lines);
    }
    let mut mistakes = mistakes.join("; ");
    if more > 0 {
        mistakes.push_str(&format!("; and {more} more lines"));
    }
    let name = name.to_owned();
    Err(UpdateError::Lines { mistakes, name })
}

/// A key that says something of which nothing would come, as it is told.
fn unknown_key(text: &[u8], known: &[&str]) -> Option<String> {
    let keys: BTreeMap<String, IgnoredAny> = serde_json::from_slice(text).ok()?;
    let unknown = keys.into_keys().find(|key| !known.contains(&&**key))?;
    Some(format!(
        "{unknown:?} means nothing here, where only {} count: leave it out",
        known.join(", ")
    ))
}

/// How far a file of changes came.
fn so_far(done: usize, all: usize) -> String {
    match done {
        0 => format!(
            "the catalog could not be changed, and none of the {all} lines took effect; give them again"
        ),
        done => format!(
            "the catalog could not be changed any further: of {all} lines the first {done} took effect, and the others did \
             not; give them again"
        ),
    }
}

/// What became of changes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Tiles that lie elsewhere now.
    pub moved: u64,
    /// Transforms that say what is so.
    pub unchanged: u64,
    /// Tiles that are no more.
    pub deleted: u64,
    /// Lines about tiles that the volume does not have.
    pub unknown: u64,
    /// Lines that cannot be: their tile would lie outside of the volume.
    pub refused: u64,
    /// Lines that were not gone through, because the work was cancelled.
    pub left: u64,
    /// The first of those that were not applied, in words.
    pub not_applied: Vec<String>,
}

impl Summary {
    /// Whether all lines were applied.
    pub fn is_all(&self) -> bool {
        self.unknown + self.refused + self.left == 0
    }

    fn note(&mut self, what: String) {
        if self.not_applied.len() < TOLD {
            self.not_applied.push(what);
        }
    }

    fn add(&mut self, more: Self) {
        self.moved += more.moved;
        self.unchanged += more.unchanged;
        self.deleted += more.deleted;
        self.unknown += more.unknown;
        self.refused += more.refused;
        for what in more.not_applied {
            self.note(what);
        }
    }
}

/// Makes changes of a volume. Cancelling ends it after the current transaction.
///
/// # Errors
///
/// [`UpdateError::Catalog`]; what was done before is so.
pub async fn apply(
    catalog: &Catalog,
    volume: &str,
    lines: &[Line],
    cancel: &Cancel,
) -> Result<Summary, UpdateError> {
    let mut summary = Summary::default();
    let mut done = 0;
    let failed = |source, done| UpdateError::Catalog {
        source,
        done,
        all: lines.len(),
    };
    // Deletions end what the records said so far, and nothing that they say later.
    let read = catalog.cursor(volume).await.map_err(|e| failed(e, 0))?;
    let read = read.offset;
    let mut group: Vec<(&Line, Known)> = Vec::new();
    let mut gone = HashSet::new();
    let ends = lines.iter().enumerate();
    let ends = ends.filter(|(_, line)| matches!(line.change, Change::Delete(_)));
    // The last one of each tile.
    let ends: HashMap<_, _> = ends.map(|(at, line)| (line.change.tile(), at)).collect();
    let mut section = None;
    for (at, line) in lines.iter().enumerate() {
        if cancel.is_cancelled() {
            break;
        }
        let name = line.change.tile();
        let (known, now) = match catalog.tile(volume, name).await {
            Ok(tile) => (tile.is_some(), tile.map(|tile| tile.section)),
            // It can be deleted, and moved if only where it lies is not understood.
            Err(CatalogError::SpoiltTile { .. }) => (true, None),
            Err(e) => return Err(failed(e, done)),
        };
        // A line before may be about to delete it.
        let known = known && !gone.contains(name);
        let now = now.filter(|_| known);
        let is_end = matches!(line.change, Change::Delete(_));
        if is_end && known {
            gone.insert(name);
        }
        let is_deleted = !known
            && (gone.contains(name) || {
                let row = catalog.holder(volume, name).await;
                row.map_err(|e| failed(e, done))?
                    .is_some_and(|row| row.deleted)
            });
        // As when changes are given again of which it is not known whether they took effect.
        let is_ended = is_deleted && ends.get(name).is_some_and(|end| at <= *end);
        let known = match () {
            () if known => Known::There,
            () if is_ended => Known::Ended,
            () if is_deleted => Known::Deleted,
            () => Known::Nothing,
        };
        // Lines about nothing belong to whatever is around them.
        let another = now.is_some() && section.is_some() && now != section;
        if group.len() >= MOST || (another && group.len() >= ENOUGH) {
            let applied = transaction(catalog, volume, &group, read).await;
            summary.add(applied.map_err(|e| failed(e, done))?);
            done += group.len();
            group.clear();
        }
        section = now.or(section);
        group.push((line, known));
    }
    if !group.is_empty() && !cancel.is_cancelled() {
        let applied = transaction(catalog, volume, &group, read).await;
        summary.add(applied.map_err(|e| failed(e, done))?);
        done += group.len();
    }
    summary.left = (lines.len() - done) as u64;
    Ok(summary)
}

/// What is known of a line's tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Known {
    /// The volume has it.
    There,
    /// It is deleted, as this line or a later one says, or an earlier one is about to.
    Ended,
    /// It is deleted, or an earlier line is about to, and is to lie somewhere.
    Deleted,
    /// The volume has none.
    Nothing,
}

/// What became of a line.
enum Outcome {
    Moved,
    Unchanged,
    Deleted,
    Unknown,
    Gone,
    Kept,
    Refused(String),
}

async fn transaction(
    catalog: &Catalog,
    volume: &str,
    lines: &[(&Line, Known)],
    read: u64,
) -> Result<Summary, CatalogError> {
    let mut summary = Summary::default();
    let mut commit = catalog.begin(volume).await?;
    for (Line { line, change }, known) in lines {
        let tile = change.tile();
        let outcome = match change {
            _ if *known == Known::Nothing => Outcome::Unknown,
            _ if *known == Known::Ended => Outcome::Unchanged,
            _ if *known == Known::Deleted => Outcome::Gone,
            Change::Transform(record) => {
                match commit.transform(tile, record.transform, None).await {
                    Ok(TransformOutcome::Moved) => Outcome::Moved,
                    Ok(TransformOutcome::Unchanged) => Outcome::Unchanged,
                    Ok(TransformOutcome::Kept) => Outcome::Kept,
                    Err(outside @ CatalogError::OutsideVolume { .. }) => {
                        Outcome::Refused(outside.to_string())
                    }
                    Err(e) => return Err(e),
                }
            }
            Change::Delete(_) => {
                let now = catalog.clock().now();
                match commit.delete_seen(tile, read, now).await? {
                    DeleteOutcome::Deleted => Outcome::Deleted,
                    DeleteOutcome::Unchanged | DeleteOutcome::Noted => Outcome::Unchanged,
                }
            }
        };
        match outcome {
            Outcome::Moved => summary.moved += 1,
            Outcome::Unchanged => summary.unchanged += 1,
            Outcome::Deleted => summary.deleted += 1,
            Outcome::Unknown => {
                summary.unknown += 1;
                summary.note(format!("line {line}: the volume has no tile {tile:?}"));
            }
            Outcome::Gone => {
                summary.unknown += 1;
                summary.note(format!(
                    "line {line}: tile {tile:?} was deleted; append its record once more, or list it again, and it is back"
                ));
            }
            // Or another process deleted it just now.
            Outcome::Kept => {
                summary.unknown += 1;
                summary.note(format!(
                    "line {line}: the size of tile {tile:?} is not known any more; append its record once more, and it \
                     lies there"
                ));
            }
            Outcome::Refused(why) => {
                summary.refused += 1;
                summary.note(format!("line {line}: {why}"));
            }
        }
    }
    commit.finish().await?;
    Ok(summary)
}

#[cfg(test)]
mod tests;
