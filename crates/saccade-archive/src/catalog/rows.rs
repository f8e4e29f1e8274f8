//! Rows as values.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use glam::{UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{MAX_EXTENT, Volume};
use saccade_core::voxel_box::VoxelBox;
use sqlx::Error;

use super::database::Row;
use super::{
    CatalogChange, ChangeReason, Claim, HeldUp, Naming, Origin, Quarantined, Retired, SpoiltTile,
    Statistics, Tile, TileId, VolumeEntry, Waiting,
};
use crate::acquisition::Cursor;
use crate::storage::check_name;

pub(super) fn millis(time: SystemTime) -> i64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_millis()).unwrap_or(i64::MAX)
}

fn decode(column: &str, source: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Error {
    Error::ColumnDecode {
        index: column.to_owned(),
        source: source.into(),
    }
}

pub(super) fn unsigned(row: &Row, column: &str) -> Result<u64, Error> {
    let value: i64 = row.get(column)?;
    u64::try_from(value).map_err(|e| decode(column, e))
}

/// A text, and of one that is none what can be read of it.
pub(super) fn legible(row: &Row, column: &str) -> String {
    let bytes = row.text(column).unwrap_or_default();
    String::from_utf8_lossy(&bytes).into_owned()
}

/// The name of a pyramid, which the storage can have.
pub(super) fn pyramid(row: &Row) -> Result<String, Error> {
    let name: String = row.get("pyramid")?;
    match check_name(&name) {
        Ok(()) => Ok(name),
        Err(e) => Err(decode("pyramid", e)),
    }
}

fn small(row: &Row, column: &str) -> Result<u32, Error> {
    let value: i64 = row.get(column)?;
    u32::try_from(value).map_err(|e| decode(column, e))
}

pub(super) fn time(row: &Row, column: &str) -> Result<SystemTime, Error> {
    Ok(UNIX_EPOCH + Duration::from_millis(unsigned(row, column)?))
}

pub(super) fn transform(row: &Row) -> Result<SectionFromTile, Error> {
    let mut elements = [0.0; 6];
    for (element, column) in elements.iter_mut().zip(["a", "b", "c", "d", "tx", "ty"]) {
        *element = row.get(column)?;
    }
    SectionFromTile::new(elements).map_err(|e| decode("a to ty", e))
}

pub(super) fn size(row: &Row) -> Result<UVec2, Error> {
    Ok(UVec2::new(small(row, "width")?, small(row, "height")?))
}

pub(super) fn section(row: &Row) -> Result<u32, Error> {
    small(row, "section")
}

pub(super) fn volume_entry(row: &Row) -> Result<VolumeEntry, Error> {
    let description: String = row.get("description")?;
    let volume: Volume =
        serde_json::from_str(&description).map_err(|e| decode("description", e))?;
    if let Some(reason) = impossible(&volume, &row.get::<String>("name")?) {
        return Err(decode("description", reason));
    }
    Ok(VolumeEntry {
        volume,
        revision: unsigned(row, "revision")?,
        // A count that cannot be keeps nobody from a volume: a check counts anew.
        tiles: unsigned(row, "tiles").unwrap_or(0),
    })
}

/// Voxels of a chunk, at most: no answer holds more. Ours have 2^17.
const MOST_OF_A_CHUNK: u128 = 1 << 29;

fn voxels_of(size: UVec3) -> u128 {
    size.to_array().into_iter().map(u128::from).product()
}

/// What of a volume cannot be so, and others rely on.
fn impossible(volume: &Volume, name: &str) -> Option<String> {
    let sizes = volume.levels.iter().map(|level| level.extent);
    let mut sizes = sizes.chain([volume.chunk]);
    let wrong = match () {
        () if volume.name != name => return Some(format!("it is of a volume {:?}", volume.name)),
        () if volume.levels.is_empty() => "it has no levels",
        () if volume.channels.is_empty() => "it has no channels",
        () if volume.extent().max_element() > MAX_EXTENT => "it is larger than a volume can be",
        () if sizes.any(|size| size.min_element() == 0) => "a level or its chunks have no voxels",
        () if voxels_of(volume.chunk) > MOST_OF_A_CHUNK => {
            "its chunks have more voxels than can be held"
        }
        () => return None,
    };
    Some(wrong.to_owned())
}

/// What is wrong with a value, in brief.
pub(super) fn reason_of(error: Error) -> String {
    match error {
        Error::ColumnDecode { index, source } => format!("{index}: {source}"),
        other => other.to_string(),
    }
}

pub(super) fn tile_or_spoilt(row: &Row) -> Result<Result<Tile, SpoiltTile>, Error> {
    let error = match tile(row) {
        Ok(tile) => return Ok(Ok(tile)),
        Err(error) => error,
    };
    let own = pyramid(row);
    let with = |pyramid: &str, transform| {
        tile_with(row, pyramid.to_owned(), transform)
            .ok()
            .map(Box::new)
    };
    let but_for_pyramid = { transform(row).ok() }.and_then(|at| with("none", at));
    Ok(Err(SpoiltTile {
        id: TileId(row.get("id")?),
        name: row.get("name").map_err(|_| legible(row, "name")),
        section: section(row).ok(),
        // Put anywhere, it is one: then only where it lies cannot be.
        but_for_place: { own.as_ref().ok() }.and_then(|own| with(own, SectionFromTile::IDENTITY)),
        pyramid: own.map_err(|_| legible(row, "pyramid")),
        position: unsigned(row, "position").ok(),
        reason: reason_of(error),
        but_for_pyramid,
    }))
}

/// The same, where it also has to be understood which records it is of.
pub(super) fn tile_whose_records_are_known(row: &Row) -> Result<Result<Tile, SpoiltTile>, Error> {
    let of = ["position", "transform_position"];
    let known = of
        .into_iter()
        .try_for_each(|at| unsigned(row, at).map(drop));
    match (tile_or_spoilt(row)?, known) {
        (Ok(tile), Err(error)) => Ok(Err(SpoiltTile {
            id: tile.id,
            name: Ok(tile.name),
            section: Some(tile.section),
            pyramid: Ok(tile.pyramid),
            position: unsigned(row, "position").ok(),
            reason: reason_of(error),
            but_for_place: None,
            but_for_pyramid: None,
        })),
        (tile, _) => Ok(tile),
    }
}

/// What a row says of its tile, whatever it says of its pyramid.
pub(super) fn tile_but_for_pyramid(row: &Row) -> Option<Tile> {
    tile_with(row, legible(row, "pyramid"), transform(row).ok()?).ok()
}

fn tile(row: &Row) -> Result<Tile, Error> {
    tile_with(row, pyramid(row)?, transform(row)?)
}

fn tile_with(row: &Row, pyramid: String, transform: SectionFromTile) -> Result<Tile, Error> {
    Ok(Tile {
        id: TileId(row.get("id")?),
        name: row.get("name")?,
        section: section(row)?,
        channel: small(row, "channel")?,
        size: size(row)?,
        transform,
        pyramid,
        revision: unsigned(row, "revision")?,
        position: unsigned(row, "position").unwrap_or_default(),
    })
}

pub(super) fn reason(reason: ChangeReason) -> &'static str {
    match reason {
        ChangeReason::Tile => "tile",
        ChangeReason::Transform => "transform",
        ChangeReason::Deleted => "deleted",
    }
}

pub(super) fn change(row: &Row) -> Result<CatalogChange, Error> {
    let section = section(row)?;
    let min = UVec3::new(small(row, "x0")?, small(row, "y0")?, section);
    let max = UVec3::new(
        small(row, "x1")?,
        small(row, "y1")?,
        section.saturating_add(1),
    );
    Ok(CatalogChange {
        revision: unsigned(row, "revision")?,
        tile: TileId(row.get("tile")?),
        section,
        voxels: VoxelBox::new(min, max),
        reason: match row.get::<String>("reason")?.as_str() {
            "tile" => ChangeReason::Tile,
            "deleted" => ChangeReason::Deleted,
            _ => ChangeReason::Transform,
        },
    })
}

pub(super) fn quarantined(row: &Row) -> Result<Quarantined, Error> {
    let bytes: Option<i64> = row.get("bytes")?;
    Ok(Quarantined {
        // For people to read: what can be read of it.
        file: legible(row, "file"),
        tile: row
            .get("tile")
            .unwrap_or_else(|_| Some(legible(row, "tile"))),
        reason: legible(row, "reason"),
        bytes: bytes.map(i64::unsigned_abs),
        at: time(row, "at").unwrap_or(UNIX_EPOCH),
        // Of no number SQLite makes 0, which is a record's place.
        awaited: { row.get::<Option<i64>>("awaited").ok().flatten() }
            .and_then(|at| u64::try_from(at).ok()),
    })
}

pub(super) fn cursor(row: &Row) -> Result<Cursor, Error> {
    Ok(Cursor {
        offset: unsigned(row, "byte")?,
        line: unsigned(row, "line")?,
        seen: row.get::<Option<i64>>("seen")?.map(i64::cast_unsigned),
    })
}

pub(super) fn waiting(row: &Row) -> Result<Waiting, Error> {
    let record: String = row.get("record")?;
    Ok(Waiting {
        position: unsigned(row, "position")?,
        record: serde_json::from_str(&record).map_err(|e| decode("record", e))?,
        reason: row.get("reason")?,
    })
}

pub(super) fn retired(row: &Row) -> Result<Retired, Error> {
    Ok(Retired {
        pyramid: legible(row, "pyramid"),
        at: time(row, "at").unwrap_or(UNIX_EPOCH),
    })
}

pub(super) fn claim(row: &Row) -> Result<Claim, Error> {
    let parked: i64 = row.get("parked")?;
    Ok(Claim {
        waiting: waiting(row)?,
        deaths: small(row, "attempts")?,
        parked: parked != 0,
    })
}

pub(super) fn naming(row: &Row) -> Result<Naming, Error> {
    let volume = row.get("volume")?;
    Ok(Naming {
        row: row.get("id")?,
        tile: legible(row, "name"),
        pyramid: legible(row, "pyramid"),
        volume,
        has_volume: row.get::<i64>("found")? == volume,
    })
}

pub(super) fn origin(row: &Row) -> Result<Origin, Error> {
    Ok(Origin {
        tile: legible(row, "name"),
        // One that cannot be is no record's.
        position: unsigned(row, "position").unwrap_or(u64::MAX),
        transform_position: unsigned(row, "transform_position").unwrap_or(u64::MAX),
    })
}

pub(super) fn held_up(row: &Row) -> Result<HeldUp, Error> {
    Ok(HeldUp {
        worker: legible(row, "name"),
        why: legible(row, "why"),
        since: time(row, "since").unwrap_or(UNIX_EPOCH),
    })
}

pub(super) fn statistics(row: &Row) -> Result<Statistics, Error> {
    Ok(Statistics {
        revision: unsigned(row, "revision")?,
        tiles: unsigned(row, "tiles")?,
        sections: unsigned(row, "sections")?,
        quarantined: unsigned(row, "quarantined")?,
        waiting: unsigned(row, "waiting")?,
        queued: unsigned(row, "queued")?,
        early: unsigned(row, "early")?,
    })
}
