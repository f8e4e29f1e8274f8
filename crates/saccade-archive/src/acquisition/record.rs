//! Records: what the microscope says of its tiles, one JSON object per line.

mod prefix;
mod reader;
#[cfg(test)]
mod tests;
mod writer;

use glam::UVec2;
use saccade_core::transform::SectionFromTile;
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::key;
use super::text::{cut, is_utf16};
pub use reader::{Cursor, RecordLine, RecordReader};
pub use writer::RecordWriter;

/// Keys of tiles' records, and first of them the one that may be left out.
const KEYS: [&str; 7] = [
    "channel",
    "record",
    "tile",
    "file",
    "section",
    "size",
    "transform",
];

/// One line of `tiles.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "record", rename_all = "lowercase")]
pub enum Record {
    /// A tile was acquired, for the first time or again.
    Tile(TileRecord),
    /// A tile lies elsewhere than said before. May come before its tile.
    Transform(TransformRecord),
    /// A tile is no more. One of the same name that comes later is another.
    Delete(DeleteRecord),
}

/// Which channel of the volume a tile shows: its place in the list, or its name in it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ChannelRef {
    /// Place in the list, from 0.
    Index(u32),
    /// Name.
    Name(String),
}

/// A tile was acquired.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileRecord {
    /// The tile's name, unique in the volume. The same name again replaces the tile.
    pub tile: String,
    /// The image, relative to the archive's folder.
    pub file: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where the stage says it lies: to level-0 voxels from pixels.
    pub transform: SectionFromTile,
    /// The channel; the volume's first if it is not said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<ChannelRef>,
}

impl TileRecord {
    /// The place of its channel among the volume's; `None` if there is no such channel.
    pub fn channel_among(&self, channels: &[String]) -> Option<u32> {
        let index = match &self.channel {
            None => Some(0),
            Some(ChannelRef::Index(index)) => usize::try_from(*index).ok(),
            Some(ChannelRef::Name(name)) => channels.iter().position(|c| c == name),
        };
        let index = index.filter(|&index| index < channels.len())?;
        u32::try_from(index).ok()
    }
}

/// A tile is no more.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeleteRecord {
    /// The tile's name.
    pub tile: String,
}

/// A tile's transform changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransformRecord {
    /// The tile's name.
    pub tile: String,
    /// To level-0 voxels from pixels.
    pub transform: SectionFromTile,
}

/// A line that is no record.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} of {} is no record: {reason}", RecordReader::FILE)]
pub struct BrokenRecord {
    /// Line, from 1.
    pub line: u64,
    /// The image that it names, as far as it can be told.
    pub file: Option<String>,
    /// The tile that it names, as far as it can be told.
    pub tile: Option<String>,
    /// What is wrong with it.
    pub reason: String,
}

impl BrokenRecord {
    fn of(text: &[u8], line: u64, reason: String) -> Self {
        /// Of whatever else it says.
        #[derive(Deserialize)]
        struct Named {
            #[serde(default)]
            file: Value,
            #[serde(default)]
            tile: Value,
        }
        let (file, tile) = match serde_json::from_slice(text) {
            Ok(Named { file, tile }) => (file, tile),
            Err(_) => (Value::Null, Value::Null),
        };
        let name = |value: Value| match value {
            Value::String(name) if !name.trim().is_empty() => Some(name),
            _ => None,
        };
        Self {
            line,
            file: name(file),
            tile: name(tile),
            reason,
        }
    }
}

impl Record {
    /// The longest line that is a record \[bytes\].
    pub const LONGEST: usize = prefix::MAX_LINE;

    /// Most voxels that a pixel may span along an axis, and most pixels that a voxel may.
    pub const LARGEST_PIXEL: f64 = 512.0;

    /// Whether a transform can be meant: a tile's pixels are about as large as an overview's, or a fine region's, could be. Others
    /// are not followed.
    pub fn is_sensible(transform: SectionFromTile) -> bool {
        let sensible = 1.0 / Self::LARGEST_PIXEL..=Self::LARGEST_PIXEL;
        let [a, b, c, d, ..] = transform.elements();
        sensible.contains(&a.hypot(b)) && sensible.contains(&c.hypot(d))
    }

    /// A line without its end, or what is wrong with it.
    ///
    /// # Errors
    ///
    /// The reason, in words.
    pub fn parse(line: &[u8]) -> Result<Self, String> {
        if line.len() >= Self::LONGEST {
            let most = Self::LONGEST;
            return Err(format!("it has {} bytes, more than {most}", line.len()));
        }
        parse(line)
    }
}

/// A record, or what is wrong with it.
fn parse(text: &[u8]) -> Result<Record, String> {
    match serde_json::from_slice(text) {
        // A key that is needed is missed; this one would be the volume's first channel without a word.
        Ok(Record::Tile(tile)) if tile.channel.is_none() => match hint(text, &KEYS[..1]) {
            Some(hint) => Err(hint),
            None => Ok(Record::Tile(tile)),
        },
        Ok(record) => Ok(record),
        // What the parser says of it is meant for programmers.
        Err(_) if is_other_value(text) => Err(
            "it is no object; a record is one, such as {\"record\": \"delete\", \"tile\": ..}"
                .to_owned(),
        ),
        Err(_) if is_utf16(text) => Err("it is UTF-16; write it as UTF-8".to_owned()),
        Err(error) => Err(match hint(text, &KEYS) {
            Some(hint) => format!("{}; {hint}", cut(&error.to_string())),
            None => cut(&error.to_string()),
        }),
    }
}

/// Whether a text is JSON, but no object.
fn is_other_value(text: &[u8]) -> bool {
    !text.trim_ascii_start().starts_with(b"{") && serde_json::from_slice::<IgnoredAny>(text).is_ok()
}

/// A key that is almost one of these, as it is told.
fn hint(text: &[u8], known: &[&'static str]) -> Option<String> {
    let (key, meant) = key::misspelt(text, known)?;
    Some(format!(
        "{key:?} means nothing in a record; is {meant:?} meant? A key of the microscope's own needs a name that \
         is less like it"
    ))
}
