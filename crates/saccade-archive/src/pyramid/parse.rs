//! A pyramid's description, read from bytes that may hold anything.

use std::ops::Range;

use saccade_core::volume::Dtype;

use super::layout::{
    BITS_PER_SAMPLE, BYTE, COMPRESSION, COMPRESSION_DEFLATE, COMPRESSION_JPEG, IMAGE_LENGTH,
    IMAGE_WIDTH, INDEX_CHECKSUM, INDEX_LEN, JPEG_TABLES, LONG, LONG8, NAME_CHECKSUM, PREDICTOR,
    PREDICTOR_HORIZONTAL, SHORT, SUB_IFDS, SUB_TILE_CHECKSUMS, SUB_TILE_STATS, TILE_BYTE_COUNTS,
    TILE_LENGTH, TILE_OFFSETS, TILE_WIDTH, UNDEFINED, bits_of, stats_kind,
};
use super::{PyramidLevel, SUB_TILE_EDGE, SubTileEntry, levels_of};
use crate::image::MAX_EDGE;

/// No sub-tile is longer: four times its voxels.
const MAX_SUB_TILE_LEN: u32 = 4 * SUB_TILE_EDGE * SUB_TILE_EDGE;
/// Files do not end past this, so that sums of offsets and lengths do not overflow.
const MAX_OFFSET: u64 = 1 << 62;

/// What is wrong with a file.
pub(super) type Reason = String;

/// A file's description.
#[derive(Debug)]
pub(super) struct Description {
    /// Size and entries of each level, row by row.
    pub(super) levels: Vec<(PyramidLevel, Vec<SubTileEntry>)>,
    /// Tables of the JPEG streams; `None`: deflate.
    pub(super) jpeg_tables: Option<Vec<u8>>,
    pub(super) dtype: Dtype,
}

/// Bytes from a file's beginning that hold its description, by its first bytes.
pub(super) fn index_len(bytes: &[u8]) -> Result<u64, Reason> {
    let file = File::new(bytes)?;
    let first = file.directory(file.first)?;
    let len = first
        .one(INDEX_LEN)
        .map_err(|_| "it was not written by Saccade".to_owned())?;
    if len > MAX_OFFSET {
        Err("its index has no end".to_owned())
    } else {
        Ok(len)
    }
}

/// Reads the description that `bytes` hold whole.
pub(super) fn describe(bytes: &[u8]) -> Result<Description, Reason> {
    let file = File::new(bytes)?;
    let first = file.directory(file.first)?;
    let size = |d: &Directory<'_>| Ok::<_, Reason>((d.one(IMAGE_WIDTH)?, d.one(IMAGE_LENGTH)?));
    let (width, height) = size(&first)?;
    let edge = |len: u64| {
        u32::try_from(len)
            .ok()
            .filter(|len| (1..=MAX_EDGE).contains(len))
    };
    let (Some(width), Some(height)) = (edge(width), edge(height)) else {
        return Err(format!("its size is {width} x {height}"));
    };
    let dtype = match first.one(BITS_PER_SAMPLE)? {
        8 => Dtype::Uint8,
        16 => Dtype::Uint16,
        bits => return Err(format!("it has {bits} bits per sample")),
    };
    let jpeg_tables = match first.one(COMPRESSION)? {
        c if c == u64::from(COMPRESSION_JPEG) && dtype == Dtype::Uint8 => {
            Some(first.bytes(JPEG_TABLES, UNDEFINED)?.to_vec())
        }
        c if c == u64::from(COMPRESSION_DEFLATE) => None,
        c => return Err(format!("it has compression {c}")),
    };
    let sizes = levels_of(width, height);
    let sub_ifds = if sizes.len() > 1 {
        first.offsets(SUB_IFDS)?
    } else {
        Vec::new()
    };
    if sub_ifds.len() + 1 != sizes.len() {
        return Err(format!(
            "it has {} levels instead of {}",
            sub_ifds.len() + 1,
            sizes.len()
        ));
    }
    let mut levels = Vec::with_capacity(sizes.len());
    for (k, level) in sizes.into_iter().enumerate() {
        let directory = match k.checked_sub(1) {
            None => file.directory(file.first)?,
            Some(k) => file.directory(sub_ifds[k])?,
        };
        if size(&directory)? != (level.width.into(), level.height.into()) {
            return Err(format!("level {k} has the wrong size"));
        }
        let same = [
            (TILE_WIDTH, u64::from(SUB_TILE_EDGE)),
            (TILE_LENGTH, u64::from(SUB_TILE_EDGE)),
            (BITS_PER_SAMPLE, u64::from(bits_of(dtype))),
            (COMPRESSION, first.one(COMPRESSION)?),
        ];
        let predictor = jpeg_tables
            .is_none()
            .then_some((PREDICTOR, PREDICTOR_HORIZONTAL.into()));
        for (tag, want) in same.into_iter().chain(predictor) {
            let got = directory.one(tag)?;
            if got != want {
                return Err(format!(
                    "level {k} has {got} instead of {want} for tag {tag}"
                ));
            }
        }
        let entries = entries(&directory, level, dtype).map_err(|e| format!("level {k}: {e}"))?;
        levels.push((level, entries));
    }
    Ok(Description {
        levels,
        jpeg_tables,
        dtype,
    })
}

/// Checksums of the sub-tiles of each level, row by row, after the index that names them was held
/// against its own; `None` for a file from before there were any.
pub(super) fn checksums(bytes: &[u8], levels: usize) -> Result<Option<Vec<Vec<u32>>>, Reason> {
    let file = File::new(bytes)?;
    let first = file.directory(file.first)?;
    let tags = [INDEX_CHECKSUM, SUB_TILE_CHECKSUMS];
    let known = tags.map(|tag| first.fields.iter().any(|field| field.tag == tag));
    if known == [false; 2] {
        return Ok(None);
    }
    let want = first.one(INDEX_CHECKSUM)?;
    if u64::from(checksum(bytes, &last_values(bytes)?)) != want {
        return Err("its index does not have its checksum".to_owned());
    }
    let sub_ifds = if levels > 1 {
        first.offsets(SUB_IFDS)?
    } else {
        Vec::new()
    };
    let others = sub_ifds.into_iter().map(|at| file.directory(at));
    let directories = std::iter::once(Ok(first)).chain(others);
    let checksums = directories.map(|directory| {
        let checksums = directory?.bytes(SUB_TILE_CHECKSUMS, LONG)?;
        let checksums = checksums.as_chunks::<4>().0.iter();
        Ok(checksums.map(|c| u32::from_le_bytes(*c)).collect())
    });
    Ok(Some(checksums.collect::<Result<_, Reason>>()?))
}

/// Where the values of a description's last tags are.
pub(super) struct LastValues {
    /// Of `NAME_CHECKSUM`.
    pub(super) name: Range<usize>,
    /// Of `INDEX_CHECKSUM`.
    pub(super) index: Range<usize>,
}

pub(super) fn last_values(bytes: &[u8]) -> Result<LastValues, Reason> {
    let file = File::new(bytes)?;
    let (count_len, entry_len, value_at) = if file.big { (8, 20, 12) } else { (2, 12, 8) };
    let entries = file.number(file.first, count_len)?;
    let value = |back: u64| {
        let entry = entries
            .checked_sub(back)
            .ok_or("a directory is too short")?;
        let at = file.first + count_len as u64 + entry_len * entry + value_at;
        file.slice(at, 4)?;
        let at = usize::try_from(at).map_err(|_| "its index has no end")?;
        Ok::<_, Reason>(at..at + 4)
    };
    Ok(LastValues {
        name: value(2)?,
        index: value(1)?,
    })
}

/// The checksum of a description.
pub(super) fn checksum(index: &[u8], values: &LastValues) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&index[..values.index.start]);
    hasher.update(&[0; 4]);
    hasher.update(&index[values.index.end..]);
    hasher.finalize()
}

/// Checksum of the name of the object that a file was made for.
pub(super) fn name_checksum(bytes: &[u8]) -> Option<u32> {
    let file = File::new(bytes).ok()?;
    let value = file.directory(file.first).ok()?.one(NAME_CHECKSUM).ok()?;
    u32::try_from(value).ok().filter(|value| *value != 0)
}

fn entries(
    directory: &Directory<'_>,
    level: PyramidLevel,
    dtype: Dtype,
) -> Result<Vec<SubTileEntry>, Reason> {
    let offsets = directory.offsets(TILE_OFFSETS)?;
    let lens = directory.bytes(TILE_BYTE_COUNTS, LONG)?.as_chunks::<4>().0;
    let stats = directory.bytes(SUB_TILE_STATS, stats_kind(dtype))?;
    let stats = stats.chunks_exact(3 * dtype.bytes());
    let count = level.sub_tiles.x as usize * level.sub_tiles.y as usize;
    if [offsets.len(), lens.len(), stats.len()] != [count; 3] {
        return Err(format!("it describes other than {count} sub-tiles"));
    }
    let places = offsets
        .into_iter()
        .zip(lens.iter().map(|len| u32::from_le_bytes(*len)));
    places
        .zip(stats)
        .map(|((offset, len), stats)| {
            let value = |n: usize| match dtype {
                Dtype::Uint16 => short(&stats[2 * n..]),
                _ => stats[n].into(),
            };
            let (min, max, mean) = (value(0), value(1), value(2));
            let entry = SubTileEntry {
                offset,
                len,
                min,
                max,
                mean,
            };
            if entry.is_blank() && min == 0 && mean == 0 {
                Ok(SubTileEntry::BLANK)
            } else if min > mean || mean > max {
                Err(format!(
                    "a sub-tile has values of {min} to {max} with mean {mean}"
                ))
            } else if len == 0 || len > MAX_SUB_TILE_LEN || offset > MAX_OFFSET {
                Err(format!("a sub-tile has {len} bytes at {offset}"))
            } else {
                Ok(entry)
            }
        })
        .collect()
}

/// A TIFF file's beginning. Only little-endian files are written, so only those are read.
struct File<'a> {
    bytes: &'a [u8],
    big: bool,
    first: u64,
}

impl<'a> File<'a> {
    fn new(bytes: &'a [u8]) -> Result<Self, Reason> {
        let (big, at) = match bytes {
            [b'I', b'I', 42, 0, ..] => (false, 4),
            [b'I', b'I', 43, 0, 8, 0, 0, 0, ..] => (true, 8),
            _ => return Err("it is not a little-endian TIFF file".to_owned()),
        };
        let mut file = Self {
            bytes,
            big,
            first: 0,
        };
        file.first = file.number(at, file.width())?;
        Ok(file)
    }

    /// Bytes of an offset.
    fn width(&self) -> usize {
        if self.big { 8 } else { 4 }
    }

    fn slice(&self, at: u64, len: u64) -> Result<&'a [u8], Reason> {
        let range = || {
            let begin = usize::try_from(at).ok()?;
            Some(begin..begin.checked_add(usize::try_from(len).ok()?)?)
        };
        let slice = range().and_then(|range| self.bytes.get(range));
        slice.ok_or_else(|| format!("its index ends before byte {}", at.saturating_add(len)))
    }

    fn number(&self, at: u64, width: usize) -> Result<u64, Reason> {
        Ok(number(self.slice(at, width as u64)?))
    }

    fn directory(&self, at: u64) -> Result<Directory<'a>, Reason> {
        let (count_len, entry_len): (usize, usize) = if self.big { (8, 20) } else { (2, 12) };
        let count = self.number(at, count_len)?;
        // More entries than tags there are: refused before they are multiplied.
        if count > 1 << 16 {
            return Err(format!("a directory has {count} entries"));
        }
        let mut fields = Vec::new();
        let begin = at + count_len as u64;
        for entry in self
            .slice(begin, count * entry_len as u64)?
            .chunks_exact(entry_len)
        {
            let (head, value) = entry.split_at(4 + self.width());
            let (tag, kind) = (short(&head[..2]), short(&head[2..4]));
            let size = match kind {
                BYTE | UNDEFINED => 1,
                SHORT => 2,
                LONG => 4,
                LONG8 => 8,
                // What is not read may be anything.
                _ => continue,
            };
            let len = number(&head[4..])
                .checked_mul(size)
                .ok_or("a value is too long")?;
            let value = match value.get(..usize::try_from(len).unwrap_or(usize::MAX)) {
                Some(value) => Ok(value),
                None => self.slice(number(value), len),
            };
            fields.push(Field { tag, kind, value });
        }
        Ok(Directory { fields })
    }
}

fn short(bytes: &[u8]) -> u16 {
    u16::from_le_bytes([bytes[0], bytes[1]])
}

/// Up to eight bytes as a number.
fn number(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |n, &b| n << 8 | u64::from(b))
}

struct Directory<'a> {
    fields: Vec<Field<'a>>,
}

struct Field<'a> {
    tag: u16,
    kind: u16,
    /// An error if the value lies past the bytes at hand: none for a tag that nobody asks for.
    value: Result<&'a [u8], Reason>,
}

impl<'a> Directory<'a> {
    fn field(&self, tag: u16) -> Result<(u16, &'a [u8]), Reason> {
        let field = self.fields.iter().find(|f| f.tag == tag);
        let field = field.ok_or_else(|| format!("tag {tag} is missing"))?;
        Ok((field.kind, field.value.clone()?))
    }

    fn bytes(&self, tag: u16, want: u16) -> Result<&'a [u8], Reason> {
        let (kind, value) = self.field(tag)?;
        if kind == want {
            Ok(value)
        } else {
            Err(format!("tag {tag} has type {kind}"))
        }
    }

    /// The one number of a tag.
    fn one(&self, tag: u16) -> Result<u64, Reason> {
        match self.field(tag)? {
            (SHORT, value @ [_, _]) | (LONG, value @ [_, _, _, _]) => Ok(number(value)),
            (LONG8, value) if value.len() == 8 => Ok(number(value)),
            _ => Err(format!("tag {tag} is not one number")),
        }
    }

    fn offsets(&self, tag: u16) -> Result<Vec<u64>, Reason> {
        let (kind, value) = self.field(tag)?;
        let width = match kind {
            LONG => 4,
            LONG8 => 8,
            _ => return Err(format!("tag {tag} has type {kind}")),
        };
        Ok(value.chunks_exact(width).map(number).collect())
    }
}
