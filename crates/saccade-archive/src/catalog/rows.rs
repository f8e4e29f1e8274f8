//! Rows as values.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use glam::{UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::voxel_box::VoxelBox;
use sqlx::sqlite::SqliteRow;
use sqlx::{Error, Row};

use super::{
    CatalogChange, ChangeReason, Quarantined, Retired, Tile, TileId, VolumeEntry, Waiting,
};
use crate::acquisition::Cursor;

/// SQLite's integers are signed. Revisions and positions never come near the sign.
pub(super) fn signed(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

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

pub(super) fn unsigned(row: &SqliteRow, column: &str) -> Result<u64, Error> {
    let value: i64 = row.try_get(column)?;
    u64::try_from(value).map_err(|e| decode(column, e))
}

fn small(row: &SqliteRow, column: &str) -> Result<u32, Error> {
    let value: i64 = row.try_get(column)?;
    u32::try_from(value).map_err(|e| decode(column, e))
}

fn time(row: &SqliteRow, column: &str) -> Result<SystemTime, Error> {
    Ok(UNIX_EPOCH + Duration::from_millis(unsigned(row, column)?))
}

pub(super) fn transform(row: &SqliteRow) -> Result<SectionFromTile, Error> {
    let mut elements = [0.0; 6];
    for (element, column) in elements.iter_mut().zip(["a", "b", "c", "d", "tx", "ty"]) {
        *element = row.try_get(column)?;
    }
    SectionFromTile::new(elements).map_err(|e| decode("a", e))
}

pub(super) fn size(row: &SqliteRow) -> Result<UVec2, Error> {
    Ok(UVec2::new(small(row, "width")?, small(row, "height")?))
}

pub(super) fn section(row: &SqliteRow) -> Result<u32, Error> {
    small(row, "section")
}

pub(super) fn volume_entry(row: &SqliteRow) -> Result<VolumeEntry, Error> {
    let description: &str = row.try_get("description")?;
    Ok(VolumeEntry {
        volume: serde_json::from_str(description).map_err(|e| decode("description", e))?,
        revision: unsigned(row, "revision")?,
        tiles: unsigned(row, "tiles")?,
    })
}

pub(super) fn tile(row: &SqliteRow) -> Result<Tile, Error> {
    Ok(Tile {
        id: TileId(row.try_get("id")?),
        name: row.try_get("name")?,
        section: section(row)?,
        channel: small(row, "channel")?,
        size: size(row)?,
        transform: transform(row)?,
        pyramid: row.try_get("pyramid")?,
        revision: unsigned(row, "revision")?,
    })
}

pub(super) fn reason(reason: ChangeReason) -> &'static str {
    match reason {
        ChangeReason::Tile => "tile",
        ChangeReason::Transform => "transform",
        ChangeReason::Deleted => "deleted",
    }
}

pub(super) fn change(row: &SqliteRow) -> Result<CatalogChange, Error> {
    let section = section(row)?;
    let min = UVec3::new(small(row, "x0")?, small(row, "y0")?, section);
    let max = UVec3::new(
        small(row, "x1")?,
        small(row, "y1")?,
        section.saturating_add(1),
    );
    Ok(CatalogChange {
        revision: unsigned(row, "revision")?,
        tile: TileId(row.try_get("tile")?),
        section,
        voxels: VoxelBox::new(min, max),
        reason: match row.try_get("reason")? {
            "tile" => ChangeReason::Tile,
            "deleted" => ChangeReason::Deleted,
            _ => ChangeReason::Transform,
        },
    })
}

pub(super) fn quarantined(row: &SqliteRow) -> Result<Quarantined, Error> {
    let bytes: Option<i64> = row.try_get("bytes")?;
    Ok(Quarantined {
        file: row.try_get("file")?,
        tile: row.try_get("tile")?,
        reason: row.try_get("reason")?,
        bytes: bytes.map(i64::unsigned_abs),
        at: time(row, "at")?,
    })
}

pub(super) fn cursor(row: &SqliteRow) -> Result<Cursor, Error> {
    Ok(Cursor {
        offset: unsigned(row, "byte")?,
        line: unsigned(row, "line")?,
    })
}

pub(super) fn waiting(row: &SqliteRow) -> Result<Waiting, Error> {
    let record: &str = row.try_get("record")?;
    Ok(Waiting {
        position: unsigned(row, "position")?,
        record: serde_json::from_str(record).map_err(|e| decode("record", e))?,
        reason: row.try_get("reason")?,
    })
}

pub(super) fn retired(row: &SqliteRow) -> Result<Retired, Error> {
    Ok(Retired {
        pyramid: row.try_get("pyramid")?,
        at: time(row, "at")?,
    })
}
