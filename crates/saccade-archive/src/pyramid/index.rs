use std::ops::Range;
use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use glam::UVec2;
use saccade_core::volume::Dtype;

use super::parse::{self, Description};
use super::{PyramidError, PyramidLevel, SUB_TILE_VOXELS, SubTileEntry, codec};
use crate::storage::Storage;

/// The first read: whole for tiles of up to 12,000 x 12,000 pixels.
const FIRST_READ: u64 = 192 << 10;

/// No coalesced read is longer, single sub-tiles aside.
const MAX_READ: u64 = 8 << 20;

/// One read that fetches several sub-tiles.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubTileRead {
    /// What to read of the file.
    pub range: Range<u64>,
    /// Sub-tiles it fetches, and where each is in the bytes read.
    pub sub_tiles: Vec<(UVec2, Range<usize>)>,
}

/// A pyramid's index: where its sub-tiles are, and the ranges of their values.
///
/// Cheap to clone. Takes 28 bytes per sub-tile.
#[derive(Clone, Debug)]
pub struct PyramidIndex {
    name: Arc<str>,
    levels: Arc<[PyramidLevel]>,
    /// Row by row, for each level.
    entries: Arc<[Vec<SubTileEntry>]>,
    /// In the same order; `None` for a file from before there were any.
    checksums: Option<Arc<[Vec<u32>]>>,
    mistaken: bool,
    jpeg_tables: Option<Arc<[u8]>>,
    dtype: Dtype,
}

impl PyramidIndex {
    /// Reads the index with one or two range reads.
    ///
    /// # Errors
    ///
    /// [`PyramidError::Storage`] and [`PyramidError::Broken`].
    pub async fn open(storage: &dyn Storage, name: &str) -> Result<Self, PyramidError> {
        Ok(Self::open_with_beginning(storage, name).await?.0)
    }

    /// The same, with all that was read: the file's first bytes, in which coarse levels follow the index.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub async fn open_with_beginning(
        storage: &dyn Storage,
        name: &str,
    ) -> Result<(Self, Bytes), PyramidError> {
        let (index, bytes, _) = Self::open_with_bytes(storage, name).await?;
        Ok((index, bytes))
    }

    /// The same, with how many of the bytes hold the index.
    pub(super) async fn open_with_bytes(
        storage: &dyn Storage,
        name: &str,
    ) -> Result<(Self, Bytes, usize), PyramidError> {
        let read = async |range| {
            let failed = |source| PyramidError::Storage {
                source,
                name: name.to_owned(),
            };
            storage.read(name, Some(range)).await.map_err(failed)
        };
        let broken = |reason| PyramidError::Broken {
            reason,
            name: name.to_owned(),
        };
        let mut bytes = read(0..FIRST_READ).await?;
        let len = parse::index_len(&bytes).map_err(broken)?;
        let begin = bytes.len() as u64;
        if len > begin && begin == FIRST_READ {
            let mut whole = BytesMut::from(&*bytes);
            whole.extend_from_slice(&read(begin..len).await?);
            bytes = whole.freeze();
        }
        if (bytes.len() as u64) < len {
            return Err(broken(format!("it ends within its index of {len} bytes")));
        }
        let len = usize::try_from(len).unwrap_or(usize::MAX);
        Ok((Self::parse(&bytes, name)?, bytes, len))
    }

    /// Reads the index from bytes that begin a file and hold all of its index.
    ///
    /// # Errors
    ///
    /// [`PyramidError::Broken`].
    pub fn parse(bytes: &[u8], name: &str) -> Result<Self, PyramidError> {
        let described = parse::index_len(bytes).and_then(|len| {
            let index = usize::try_from(len).ok().and_then(|len| bytes.get(..len));
            let index = index.ok_or("it ends within its index")?;
            let described = parse::describe(index)?;
            let checksums = parse::checksums(index, described.levels.len())?;
            let made_for = parse::name_checksum(index);
            Ok((described, checksums, made_for))
        });
        let (described, checksums, made_for) =
            described.map_err(|reason| PyramidError::Broken {
                reason,
                name: name.to_owned(),
            })?;
        let Description {
            levels,
            jpeg_tables,
            dtype,
        } = described;
        let (levels, entries): (Vec<_>, Vec<_>) = levels.into_iter().unzip();
        Ok(Self {
            name: name.into(),
            levels: levels.into(),
            entries: entries.into(),
            checksums: checksums.map(Into::into),
            mistaken: made_for.is_some_and(|own| own != crc32fast::hash(name.as_bytes())),
            jpeg_tables: jpeg_tables.map(Into::into),
            dtype,
        })
    }

    /// The object the index was read from.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether it says that it was made for an object of another name: that of another tile.
    pub fn is_mistaken(&self) -> bool {
        self.mistaken
    }

    /// Checksums of the sub-tiles of each level, row by row; `None` for a file from before there were any.
    pub(super) fn checksums(&self) -> Option<&[Vec<u32>]> {
        self.checksums.as_deref()
    }

    /// Whether its voxels are those of the image, rather than JPEG's.
    pub fn is_lossless(&self) -> bool {
        self.jpeg_tables.is_none()
    }

    /// Type of the voxels.
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Bytes of a decoded sub-tile: [`SUB_TILE_VOXELS`] of the voxels' type.
    pub fn sub_tile_bytes(&self) -> usize {
        SUB_TILE_VOXELS * self.dtype.bytes()
    }

    /// Sizes of the levels, the finest first; at least one.
    pub fn levels(&self) -> &[PyramidLevel] {
        &self.levels
    }

    /// Where the last sub-tile ends: no whole file is shorter \[bytes\].
    pub fn end(&self) -> u64 {
        let ends = self
            .entries
            .iter()
            .flatten()
            .map(|e| e.offset + u64::from(e.len));
        ends.max().unwrap_or(0)
    }

    /// Where the first sub-tile begins; `None` if all are blank.
    pub(super) fn begin(&self) -> Option<u64> {
        let entries = self.entries.iter().flatten().filter(|e| !e.is_blank());
        entries.map(|e| e.offset).min()
    }

    /// Memory that the index takes \[bytes\].
    pub fn memory(&self) -> usize {
        let entries: usize = self.entries.iter().map(Vec::len).sum();
        size_of::<Self>()
            + entries * (size_of::<SubTileEntry>() + size_of::<u32>())
            + self.levels.len() * (size_of::<PyramidLevel>() + size_of::<Vec<()>>())
            + self.jpeg_tables.as_ref().map_or(0, |tables| tables.len())
            + self.name.len()
    }

    /// The entry of the sub-tile in column x, row y; `None` for no such sub-tile.
    pub fn sub_tile(&self, level: usize, x: u32, y: u32) -> Option<SubTileEntry> {
        let size = self.levels.get(level)?.sub_tiles;
        let exists = x < size.x && y < size.y;
        exists.then(|| self.entries[level][y as usize * size.x as usize + x as usize])
    }

    /// The reads that fetch these sub-tiles of a level.
    ///
    /// Neighbours in the file are read together, also across gaps of up to `gap` bytes, which
    /// suits storages where a further read costs more than as many bytes. Blank sub-tiles, and
    /// those that do not exist, are left out; none is fetched twice.
    pub fn reads(
        &self,
        level: usize,
        sub_tiles: impl IntoIterator<Item = UVec2>,
        gap: u64,
    ) -> Vec<SubTileRead> {
        let mut wanted: Vec<(u64, u64, UVec2)> = sub_tiles
            .into_iter()
            .filter_map(|at| {
                let entry = self.sub_tile(level, at.x, at.y).filter(|e| !e.is_blank())?;
                Some((entry.offset, u64::from(entry.len), at))
            })
            .collect();
        wanted.sort_unstable_by_key(|&(offset, _, at)| (offset, at.y, at.x));
        wanted.dedup();
        let mut reads: Vec<SubTileRead> = Vec::new();
        for (offset, len, at) in wanted {
            let end = offset + len;
            let read = match reads.last_mut() {
                Some(read)
                    if offset <= read.range.end.saturating_add(gap)
                        && end - read.range.start <= MAX_READ =>
                {
                    read.range.end = read.range.end.max(end);
                    read
                }
                _ => reads.push_mut(SubTileRead {
                    range: offset..end,
                    sub_tiles: Vec::new(),
                }),
            };
            let index = |at: u64| usize::try_from(at - read.range.start).expect("reads are short");
            let within = index(offset)..index(end);
            read.sub_tiles.push((at, within));
        }
        reads
    }

    /// Decodes a sub-tile from the bytes its entry names to [`SUB_TILE_VOXELS`] values, x fastest, as
    /// little-endian bytes of [`PyramidIndex::dtype`], if they have their checksum. The bytes of a blank one do not matter.
    ///
    /// # Errors
    ///
    /// [`PyramidError::Broken`] and [`PyramidError::OutOfRange`].
    pub fn decode_sub_tile(
        &self,
        level: usize,
        x: u32,
        y: u32,
        bytes: &[u8],
    ) -> Result<Vec<u8>, PyramidError> {
        let mut voxels = vec![0; self.sub_tile_bytes()];
        self.decode_sub_tile_into(level, x, y, bytes, &mut voxels)?;
        Ok(voxels)
    }

    /// The same into a place of the caller's, of [`PyramidIndex::sub_tile_bytes`].
    ///
    /// # Errors
    ///
    /// [`PyramidError::Broken`], after which `to` may hold anything, and
    /// [`PyramidError::OutOfRange`].
    ///
    /// # Panics
    ///
    /// If `to` has another length.
    pub fn decode_sub_tile_into(
        &self,
        level: usize,
        x: u32,
        y: u32,
        bytes: &[u8],
        to: &mut [u8],
    ) -> Result<(), PyramidError> {
        let len = self.sub_tile_bytes();
        assert_eq!(to.len(), len, "a decoded sub-tile has {len} bytes");
        let Some(entry) = self.sub_tile(level, x, y) else {
            return Err(PyramidError::OutOfRange {
                level,
                x,
                y,
                name: self.name.to_string(),
            });
        };
        if entry.is_blank() {
            to.fill(0);
            return Ok(());
        }
        let at = y as usize * self.levels[level].sub_tiles.x as usize + x as usize;
        let known = { self.checksums.as_ref() }.map(|all| all[level].get(at));
        // A bit that changed on a disk may decode to something else without a word.
        let decoded = if known.is_some_and(|known| known != Some(&crc32fast::hash(bytes))) {
            Err("it does not have its checksum".to_owned())
        } else {
            match &self.jpeg_tables {
                Some(tables) => codec::decode_jpeg(tables, bytes, to),
                None => codec::decode_lossless(self.dtype, bytes, to),
            }
        };
        decoded.map_err(|reason| PyramidError::Broken {
            reason: format!("sub-tile {x}, {y} of level {level}: {reason}"),
            name: self.name.to_string(),
        })?;
        // JPEG overshoots at edges. Nothing may lie outside the bounds that others cull by.
        // What is lossless lies outside only if the file is damaged.
        let SubTileEntry { min, max, .. } = entry;
        if self.dtype == Dtype::Uint16 {
            for voxel in to.as_chunks_mut::<2>().0 {
                *voxel = u16::from_le_bytes(*voxel).clamp(min, max).to_le_bytes();
            }
        } else {
            let byte = |v: u16| u8::try_from(v).unwrap_or(u8::MAX);
            let (min, max) = (byte(min), byte(max));
            for voxel in to {
                *voxel = (*voxel).clamp(min, max);
            }
        }
        Ok(())
    }

    /// Reads and decodes one sub-tile.
    ///
    /// # Errors
    ///
    /// [`PyramidError`].
    pub async fn read_sub_tile(
        &self,
        storage: &dyn Storage,
        level: usize,
        x: u32,
        y: u32,
    ) -> Result<Vec<u8>, PyramidError> {
        let bytes = match self.sub_tile(level, x, y).filter(|entry| !entry.is_blank()) {
            None => Bytes::new(),
            Some(SubTileEntry { offset, len, .. }) => {
                let read = storage
                    .read(&self.name, Some(offset..offset + u64::from(len)))
                    .await;
                let name = self.name.to_string();
                read.map_err(|source| PyramidError::Storage { source, name })?
            }
        };
        self.decode_sub_tile(level, x, y, &bytes)
    }
}
