//! The formats in which a volume can be read, as pure functions of its description.
//!
//! A format is a hierarchy of objects with text keys. [`Format::entry`] says what an object is; the
//! voxels of those that hold some come from [`crate::pieces`].

mod precomputed;
mod zarr2;
mod zarr3;

use std::ops::Range;

use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use serde_json::Value;

/// A format that clients of other makers read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    /// OME-Zarr 0.5: Zarr 3.
    Zarr3,
    /// OME-Zarr 0.4: Zarr 2.
    Zarr2,
    /// Neuroglancer precomputed.
    Precomputed,
}

/// What a key names.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Entry {
    /// A JSON document.
    Metadata(Value),
    /// Voxels.
    Piece(Piece),
}

/// The voxels of one object: those of one chunk of a level.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Piece {
    /// Level.
    pub(crate) level: u32,
    /// Position \[chunks of the level\].
    pub(crate) chunk: UVec3,
    /// Channels, one after the other.
    pub(crate) channels: Range<u32>,
    /// What of the chunk there is \[voxels of the level, relative to its first\]: all of it, or what
    /// lies inside the volume.
    pub(crate) voxels: VoxelBox,
}

/// There is no such key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Unknown {
    /// What there is instead.
    pub(crate) known: Vec<String>,
}

impl Format {
    pub(crate) const ALL: [Self; 3] = [Self::Zarr3, Self::Zarr2, Self::Precomputed];

    /// Its folder in addresses.
    pub(crate) fn folder(self) -> &'static str {
        match self {
            Self::Zarr3 => "zarr",
            Self::Zarr2 => "zarr2",
            Self::Precomputed => "precomputed",
        }
    }

    /// The object that describes the whole volume.
    pub(crate) fn root(self) -> &'static str {
        match self {
            Self::Zarr3 => "zarr.json",
            Self::Zarr2 => ".zattrs",
            Self::Precomputed => "info",
        }
    }

    /// What a key names. Keys have one spelling.
    ///
    /// # Errors
    ///
    /// [`Unknown`] for any other text, and for levels and chunks that the volume does not have.
    pub(crate) fn entry(self, volume: &Volume, key: &str) -> Result<Entry, Unknown> {
        match self {
            Self::Zarr3 => zarr3::entry(volume, key),
            Self::Zarr2 => zarr2::entry(volume, key),
            Self::Precomputed => precomputed::entry(volume, key),
        }
    }
}

/// One channel of a chunk, padded to its full size, or [`Unknown`] with how many there are.
fn padded(volume: &Volume, level: u32, [c, z, y, x]: [u32; 4]) -> Result<Entry, Unknown> {
    let chunk = UVec3::new(x, y, z);
    let channels = u32::try_from(volume.channels.len()).unwrap_or(u32::MAX);
    if c >= channels || !has_chunk(volume, level, chunk) {
        let counts = |(level, _)| {
            let chunks = volume.chunks(level);
            let UVec3 { x, y, z } = chunks;
            format!("level {level}: {channels} x {z} x {y} x {x} chunks of channel, z, y, x")
        };
        let known = volume.levels.iter().enumerate().map(counts).collect();
        return Err(Unknown { known });
    }
    Ok(Entry::Piece(Piece {
        level,
        chunk,
        channels: c..c + 1,
        voxels: VoxelBox::of_size(volume.chunk),
    }))
}

fn has_chunk(volume: &Volume, level: u32, chunk: UVec3) -> bool {
    level_index(volume, level).is_some_and(|level| chunk.cmplt(volume.chunks(level)).all())
}

fn level_index(volume: &Volume, level: u32) -> Option<usize> {
    let index = usize::try_from(level).ok()?;
    (index < volume.levels.len()).then_some(index)
}

/// Keys of every level, by a pattern in which `L` stands for the level.
fn per_level(volume: &Volume, pattern: &str) -> Unknown {
    let levels = 0..volume.levels.len();
    let known = levels.map(|level| pattern.replace('L', &level.to_string()));
    Unknown {
        known: known.collect(),
    }
}

fn only(keys: &[&str]) -> Unknown {
    Unknown {
        known: keys.iter().map(ToString::to_string).collect(),
    }
}

/// A whole number in its only spelling.
fn number(text: &str) -> Option<u32> {
    let plain = text.bytes().all(|b| b.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    plain.then(|| text.parse().ok())?
}

/// Names of objects: each names one thing, which lies in the volume, and there is no other name for it.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    let Ok(key) = std::str::from_utf8(bytes) else {
        return;
    };
    let size = UVec3::new(1000, 900, 50);
    let plain = Volume::new("em", size, glam::DVec3::new(4.0, 4.0, 40.0)).expect("a volume");
    let moved = Volume {
        chunk: UVec3::new(64, 48, 32),
        channels: vec!["a".to_owned(), "b".to_owned()],
        origin_nm: glam::DVec3::new(-4000.0, 0.0, 1e9),
        ..plain.clone()
    };
    for (volume, format) in [&plain, &moved]
        .into_iter()
        .flat_map(|v| Format::ALL.map(|f| (v, f)))
    {
        match format.entry(volume, key) {
            Err(Unknown { known }) => assert!(!known.is_empty(), "what there is instead is told"),
            Ok(Entry::Metadata(value)) => assert!(value.is_object()),
            Ok(Entry::Piece(piece)) => {
                let level = level_index(volume, piece.level).expect("it has the level");
                assert!(has_chunk(volume, piece.level, piece.chunk));
                assert!(
                    piece.channels.end as usize <= volume.channels.len()
                        && !piece.channels.is_empty()
                );
                let voxels = piece.voxels;
                assert!(!voxels.is_empty() && voxels.max.cmple(volume.chunk).all());
                let UVec3 { x, y, z } = piece.chunk;
                let c = piece.channels.start;
                let only = match format {
                    Format::Zarr3 => format!("{level}/c/{c}/{z}/{y}/{x}"),
                    Format::Zarr2 => format!("{level}/{c}/{z}/{y}/{x}"),
                    Format::Precomputed => continue,
                };
                assert_eq!(key, only);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    pub(super) fn volume() -> Volume {
        let mut volume =
            Volume::new("em", UVec3::new(1000, 900, 50), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        volume.chunk = UVec3::new(64, 48, 32);
        volume
    }

    #[test]
    fn numbers_have_one_spelling() {
        assert_eq!(number("0"), Some(0));
        assert_eq!(number("4294967295"), Some(u32::MAX));
        for other in [
            "",
            "00",
            "01",
            "+1",
            "-1",
            " 1",
            "1.",
            "4294967296",
            "x",
            "\u{0661}",
        ] {
            assert_eq!(number(other), None, "{other:?}");
        }
    }

    #[test]
    fn every_format_describes_itself_and_refuses_the_rest() {
        for format in Format::ALL {
            let root = format.entry(&volume(), format.root()).unwrap();
            assert!(matches!(root, Entry::Metadata(_)), "{format:?}");
            let garbage = [
                "",
                "/",
                "0",
                "..",
                "../zarr.json",
                "0//",
                "0/c",
                "info/",
                "//info",
            ];
            for key in garbage {
                let unknown = format.entry(&volume(), key).unwrap_err();
                assert!(!unknown.known.is_empty(), "{format:?} {key:?}");
            }
        }
    }
}
