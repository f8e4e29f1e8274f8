//! The TIFF file: all that describes it first, then the sub-tiles, the coarsest level first.
//!
//! One read of the file's beginning therefore opens it, and for small tiles fetches the coarse
//! levels with it. Each level's sub-tiles lie in Morton order. Blank sub-tiles all point to one
//! stream: they take no space, and tools that know nothing of absent tiles still read the file.

use bytes::Bytes;
use glam::UVec2;
use saccade_core::volume::Dtype;

use super::{PyramidLevel, SUB_TILE_EDGE, SubTileEntry, parse};

pub(super) const NEW_SUBFILE_TYPE: u16 = 254;
pub(super) const IMAGE_WIDTH: u16 = 256;
pub(super) const IMAGE_LENGTH: u16 = 257;
pub(super) const BITS_PER_SAMPLE: u16 = 258;
pub(super) const COMPRESSION: u16 = 259;
pub(super) const PHOTOMETRIC: u16 = 262;
pub(super) const SAMPLES_PER_PIXEL: u16 = 277;
pub(super) const PLANAR_CONFIGURATION: u16 = 284;
pub(super) const SOFTWARE: u16 = 305;
pub(super) const PREDICTOR: u16 = 317;
pub(super) const TILE_WIDTH: u16 = 322;
pub(super) const TILE_LENGTH: u16 = 323;
pub(super) const TILE_OFFSETS: u16 = 324;
pub(super) const TILE_BYTE_COUNTS: u16 = 325;
pub(super) const SUB_IFDS: u16 = 330;
pub(super) const JPEG_TABLES: u16 = 347;
/// Private: bytes from the file's beginning that hold everything but sub-tiles.
pub(super) const INDEX_LEN: u16 = 65_000;
/// Private: min, max, mean of each sub-tile, in the order of the offsets, of the voxels' type.
pub(super) const SUB_TILE_STATS: u16 = 65_001;
/// Private: CRC-32 of each sub-tile's bytes, in the order of the offsets.
pub(super) const SUB_TILE_CHECKSUMS: u16 = 65_002;
/// Private: CRC-32 of the name of the object that the file was made for; 0 if that is not known. The
/// last tag of its directory but one.
pub(super) const NAME_CHECKSUM: u16 = 65_003;
/// Private: CRC-32 of the [`INDEX_LEN`] bytes, this value taken as 0. The last tag of its directory.
pub(super) const INDEX_CHECKSUM: u16 = 65_004;

pub(super) const COMPRESSION_JPEG: u16 = 7;
pub(super) const COMPRESSION_DEFLATE: u16 = 8;
pub(super) const PREDICTOR_HORIZONTAL: u16 = 2;

pub(super) const BYTE: u16 = 1;
pub(super) const ASCII: u16 = 2;
pub(super) const SHORT: u16 = 3;
pub(super) const LONG: u16 = 4;
pub(super) const UNDEFINED: u16 = 7;
pub(super) const LONG8: u16 = 16;

/// Bits of a voxel.
pub(super) fn bits_of(dtype: Dtype) -> u16 {
    if dtype == Dtype::Uint16 { 16 } else { 8 }
}

/// The tag type of statistics.
pub(super) fn stats_kind(dtype: Dtype) -> u16 {
    if dtype == Dtype::Uint16 { SHORT } else { BYTE }
}

/// Sub-tiles of one level in the order of the file, and their bytes one after another.
#[derive(Debug, Default)]
pub(super) struct Coded {
    /// Place in the level, and entry with its offset counted from the first of `bytes`.
    sub_tiles: Vec<(UVec2, SubTileEntry)>,
    /// Checksums of the sub-tiles.
    checksums: Vec<u32>,
    pub(super) bytes: Vec<u8>,
}

impl Coded {
    /// Adds the sub-tile whose bytes, from `begin`, were just appended.
    pub(super) fn push(&mut self, at: UVec2, begin: usize, entry: SubTileEntry) {
        let len = u32::try_from(self.bytes.len() - begin).expect("a sub-tile is small");
        self.checksums.push(crc32fast::hash(&self.bytes[begin..]));
        self.sub_tiles.push((
            at,
            SubTileEntry {
                offset: begin as u64,
                len,
                ..entry
            },
        ));
    }

    /// All of it, in memory of its size; what it was gathered in is kept for what comes next.
    pub(super) fn take(&mut self) -> Self {
        let bytes = self.bytes.as_slice().into();
        self.bytes.clear();
        Self {
            sub_tiles: std::mem::take(&mut self.sub_tiles),
            checksums: std::mem::take(&mut self.checksums),
            bytes,
        }
    }

    pub(super) fn push_blank(&mut self, at: UVec2) {
        self.checksums.push(0);
        self.sub_tiles.push((at, SubTileEntry::BLANK));
    }
}

/// A tag's value, little-endian.
struct Field {
    tag: u16,
    kind: u16,
    value: Vec<u8>,
}

impl Field {
    fn short(tag: u16, value: u16) -> Self {
        Self {
            tag,
            kind: SHORT,
            value: value.to_le_bytes().into(),
        }
    }

    fn long(tag: u16, value: u32) -> Self {
        Self {
            tag,
            kind: LONG,
            value: value.to_le_bytes().into(),
        }
    }

    fn count(&self) -> u64 {
        let size = match self.kind {
            SHORT => 2,
            LONG => 4,
            LONG8 => 8,
            _ => 1,
        };
        self.value.len() as u64 / size
    }
}

/// All that a file is made of.
#[derive(Debug)]
pub(super) struct Parts {
    pub(super) levels: Vec<PyramidLevel>,
    pub(super) dtype: Dtype,
    /// The sub-tiles of each level, in the order they are to have.
    pub(super) coded: Vec<Vec<Coded>>,
    /// The stream that all blank sub-tiles share.
    pub(super) blank: Vec<u8>,
    /// The streams' tables if they are JPEG, else they are deflated.
    pub(super) jpeg_tables: Option<Vec<u8>>,
}

impl Parts {
    /// The file: classic TIFF if offsets of four bytes reach everything, else `BigTIFF`.
    pub(super) fn file(self) -> Bytes {
        let tiles: usize = self.coded.iter().flatten().map(|c| c.sub_tiles.len()).sum();
        // More than the description can take.
        let description = 32 * tiles as u64 + 65_536;
        let big = self.data_len() as u64 + description > u64::from(u32::MAX);
        self.file_of_width(big)
    }

    /// The file, with offsets of eight bytes if `big`. What is in it is let go of at once, so that both together take no more
    /// memory than one.
    pub(super) fn file_of_width(self, big: bool) -> Bytes {
        let writer = Writer { parts: &self, big };
        // Values are of known size: the first pass finds where the data begins, the second says so.
        let begin = writer.describe(0).len();
        let mut file = writer.describe(begin as u64);
        let checksum = crc32fast::hash(&file).to_le_bytes();
        let sealed = parse::last_values(&file).expect("a description that was just written");
        file[sealed.index].copy_from_slice(&checksum);
        file.reserve_exact(self.data_len());
        file.extend_from_slice(&self.blank);
        for part in self.coded.into_iter().rev().flatten() {
            file.extend_from_slice(&part.bytes);
        }
        file.into()
    }

    fn data_len(&self) -> usize {
        self.coded
            .iter()
            .flatten()
            .map(|c| c.bytes.len())
            .sum::<usize>()
            + self.blank.len()
    }
}

struct Writer<'a> {
    parts: &'a Parts,
    big: bool,
}

impl Writer<'_> {
    /// Header, directories and values, if the data begins at `data`.
    fn describe(&self, data: u64) -> Vec<u8> {
        let mut file = b"II".to_vec();
        if self.big {
            file.extend_from_slice(&[43, 0, 8, 0, 0, 0]);
        } else {
            file.extend_from_slice(&[42, 0]);
        }
        let first = if self.big { 16 } else { 8 };
        file.extend(self.offset(first));
        // Directories are written one after another; the first names where the others begin.
        let mut at = data + self.parts.blank.len() as u64;
        let mut begins = vec![0; self.parts.levels.len()];
        for (level, parts) in self.parts.coded.iter().enumerate().rev() {
            begins[level] = at;
            at += parts.iter().map(|p| p.bytes.len() as u64).sum::<u64>();
        }
        let fields =
            |level: usize, sub_ifds: &[u64]| self.fields(level, begins[level], data, sub_ifds);
        let mut sub_ifds = vec![0; self.parts.levels.len() - 1];
        let mut next = first + self.directory_len(&fields(0, &sub_ifds));
        for (level, sub_ifd) in sub_ifds.iter_mut().enumerate() {
            *sub_ifd = next;
            next += self.directory_len(&fields(level + 1, &[]));
        }
        self.directory(&fields(0, &sub_ifds), &mut file);
        for level in 1..self.parts.levels.len() {
            self.directory(&fields(level, &[]), &mut file);
        }
        file
    }

    /// A level's tags, in order. Its data begins at `begin`; the index, and the blank sub-tile's
    /// data, ends and begins at `data`.
    fn fields(&self, level: usize, begin: u64, data: u64, sub_ifds: &[u64]) -> Vec<Field> {
        let PyramidLevel {
            width,
            height,
            sub_tiles,
        } = self.parts.levels[level];
        let tiles = sub_tiles.x as usize * sub_tiles.y as usize;
        let blank_len = u32::try_from(self.parts.blank.len()).expect("a sub-tile is small");
        let mut places = vec![(data, blank_len); tiles];
        let bytes = self.parts.dtype.bytes();
        let mut stats = vec![0; 3 * bytes * tiles];
        let blank = crc32fast::hash(&self.parts.blank).to_le_bytes();
        let mut checksums = blank.repeat(tiles);
        let mut begin = begin;
        for part in &self.parts.coded[level] {
            for ((at, entry), checksum) in part.sub_tiles.iter().zip(&part.checksums) {
                if entry.is_blank() {
                    continue;
                }
                let index = (at.y * sub_tiles.x + at.x) as usize;
                checksums[4 * index..][..4].copy_from_slice(&checksum.to_le_bytes());
                places[index] = (begin + entry.offset, entry.len);
                let values = [entry.min, entry.max, entry.mean];
                let to = stats[3 * bytes * index..].chunks_exact_mut(bytes);
                for (to, value) in to.zip(values) {
                    to.copy_from_slice(&value.to_le_bytes()[..bytes]);
                }
            }
            begin += part.bytes.len() as u64;
        }
        let lens = places
            .iter()
            .flat_map(|(_, len)| len.to_le_bytes())
            .collect();
        let mut fields = vec![
            Field::long(NEW_SUBFILE_TYPE, u32::from(level > 0)),
            Field::long(IMAGE_WIDTH, width),
            Field::long(IMAGE_LENGTH, height),
            Field::short(BITS_PER_SAMPLE, bits_of(self.parts.dtype)),
            Field::short(
                COMPRESSION,
                if self.parts.jpeg_tables.is_some() {
                    COMPRESSION_JPEG
                } else {
                    COMPRESSION_DEFLATE
                },
            ),
            Field::short(PHOTOMETRIC, 1),
            Field::short(SAMPLES_PER_PIXEL, 1),
            Field::short(PLANAR_CONFIGURATION, 1),
        ];
        if level == 0 {
            fields.push(Field {
                tag: SOFTWARE,
                kind: ASCII,
                value: b"saccade\0".into(),
            });
        }
        if self.parts.jpeg_tables.is_none() {
            fields.push(Field::short(PREDICTOR, PREDICTOR_HORIZONTAL));
        }
        fields.extend([
            Field::long(TILE_WIDTH, SUB_TILE_EDGE),
            Field::long(TILE_LENGTH, SUB_TILE_EDGE),
            self.offsets(TILE_OFFSETS, places.iter().map(|&(offset, _)| offset)),
            Field {
                tag: TILE_BYTE_COUNTS,
                kind: LONG,
                value: lens,
            },
        ]);
        if !sub_ifds.is_empty() {
            fields.push(self.offsets(SUB_IFDS, sub_ifds.iter().copied()));
        }
        if let Some(tables) = &self.parts.jpeg_tables {
            fields.push(Field {
                tag: JPEG_TABLES,
                kind: UNDEFINED,
                value: tables.clone(),
            });
        }
        if level == 0 {
            fields.push(self.offsets(INDEX_LEN, [data]));
        }
        fields.push(Field {
            tag: SUB_TILE_STATS,
            kind: stats_kind(self.parts.dtype),
            value: stats,
        });
        fields.push(Field {
            tag: SUB_TILE_CHECKSUMS,
            kind: LONG,
            value: checksums,
        });
        if level == 0 {
            fields.push(Field::long(NAME_CHECKSUM, 0));
            fields.push(Field::long(INDEX_CHECKSUM, 0));
        }
        fields
    }

    fn offsets(&self, tag: u16, offsets: impl IntoIterator<Item = u64>) -> Field {
        let kind = if self.big { LONG8 } else { LONG };
        Field {
            tag,
            kind,
            value: offsets.into_iter().flat_map(|o| self.offset(o)).collect(),
        }
    }

    /// An offset's bytes.
    fn offset(&self, offset: u64) -> impl Iterator<Item = u8> + use<> {
        offset
            .to_le_bytes()
            .into_iter()
            .take(if self.big { 8 } else { 4 })
    }

    /// Bytes of a directory and of the values that do not fit into it.
    fn directory_len(&self, fields: &[Field]) -> u64 {
        let mut file = Vec::new();
        self.directory(fields, &mut file);
        file.len() as u64
    }

    /// Appends a directory, with the values that do not fit into it right after.
    fn directory(&self, fields: &[Field], file: &mut Vec<u8>) {
        let (count_len, entry_len, inline) = if self.big { (8, 20, 8) } else { (2, 12, 4) };
        let next_len = inline;
        let end = file.len() + count_len + entry_len * fields.len() + next_len;
        let mut values = Vec::new();
        file.extend(
            (fields.len() as u64)
                .to_le_bytes()
                .into_iter()
                .take(count_len),
        );
        for field in fields {
            file.extend_from_slice(&field.tag.to_le_bytes());
            file.extend_from_slice(&field.kind.to_le_bytes());
            file.extend(self.offset(field.count()));
            if field.value.len() <= inline {
                file.extend_from_slice(&field.value);
                file.resize(file.len() + inline - field.value.len(), 0);
            } else {
                file.extend(self.offset((end + values.len()) as u64));
                values.extend_from_slice(&field.value);
                // TIFF wants values at even offsets.
                values.resize(values.len().next_multiple_of(2), 0);
            }
        }
        file.extend(self.offset(0));
        file.extend_from_slice(&values);
    }
}
