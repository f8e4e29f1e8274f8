use bytes::{Bytes, BytesMut};

use super::{PyramidError, PyramidIndex, SUB_TILE_VOXELS, parse};
use crate::storage::Storage;

/// What was found whole.
#[derive(Clone, Debug)]
pub struct Verified {
    /// The pyramid's index.
    pub index: PyramidIndex,
    /// Whether the file has checksums; older ones have none, and their voxels were only decoded.
    pub checksums: bool,
    /// Whether it was made for an object of another name: see [`named`].
    pub mistaken: bool,
}

/// Notes in a pyramid's bytes the name of the object they are for, so that [`verify`] can tell one
/// tile's from another's.
///
/// # Errors
///
/// [`PyramidError::Broken`] if they are no pyramid's.
pub fn named(file: Bytes, name: &str) -> Result<Bytes, PyramidError> {
    let broken = |reason| PyramidError::Broken {
        reason,
        name: name.to_owned(),
    };
    let len = parse::index_len(&file).map_err(broken)?;
    let len = usize::try_from(len).ok().filter(|len| *len <= file.len());
    let len = len.ok_or_else(|| broken("it ends within its index".to_owned()))?;
    let values = parse::last_values(&file).map_err(broken)?;
    // Nobody else has them, so nothing is copied.
    let mut file = file
        .try_into_mut()
        .unwrap_or_else(|file| BytesMut::from(&*file));
    let own = crc32fast::hash(name.as_bytes()).to_le_bytes();
    file[values.name.clone()].copy_from_slice(&own);
    let checksum = parse::checksum(&file[..len], &values).to_le_bytes();
    file[values.index].copy_from_slice(&checksum);
    Ok(file.freeze())
}

/// Reads a pyramid to its last byte: description and every sub-tile, each held against its checksum
/// and decoded. Runs for a second per gigapixel; call it where that may be.
///
/// # Errors
///
/// [`PyramidError::Broken`] names the first thing that is wrong.
pub fn verify(bytes: &[u8], name: &str) -> Result<Verified, PyramidError> {
    let broken = |reason| PyramidError::Broken {
        reason,
        name: name.to_owned(),
    };
    let index = PyramidIndex::parse(bytes, name)?;
    let len = parse::index_len(bytes).map_err(broken)?;
    let head = usize::try_from(len).ok().and_then(|len| bytes.get(..len));
    let head = head.ok_or_else(|| broken("it ends within its index".to_owned()))?;
    let checksums = index.checksums();
    check_len(&index, len, bytes.len() as u64).map_err(broken)?;
    // Other tools read it for every blank sub-tile.
    let end = index.begin().and_then(|at| usize::try_from(at).ok());
    let blank = bytes.get(head.len()..end.unwrap_or(bytes.len()));
    let blank = crc32fast::hash(blank.unwrap_or_default());
    let mut voxels = vec![0; SUB_TILE_VOXELS * index.dtype().bytes()];
    for (level, size) in index.levels().iter().enumerate() {
        for y in 0..size.sub_tiles.y {
            for x in 0..size.sub_tiles.x {
                let at = y as usize * size.sub_tiles.x as usize + x as usize;
                let is_right = |checksum| {
                    let known = checksums.map(|all| all[level].get(at));
                    known.is_none_or(|known| known == Some(&checksum))
                };
                let what = |wrong| broken(format!("sub-tile {x}, {y} of level {level} {wrong}"));
                let Some(entry) = index.sub_tile(level, x, y).filter(|e| !e.is_blank()) else {
                    if !is_right(blank) {
                        return Err(what("is blank, but what is stored for it is not"));
                    }
                    continue;
                };
                let begin = usize::try_from(entry.offset).unwrap_or(usize::MAX);
                let range = begin..begin.saturating_add(entry.len as usize);
                let coded = bytes.get(range).ok_or_else(|| what("lies past its end"))?;
                if !is_right(crc32fast::hash(coded)) {
                    return Err(what("does not have its checksum"));
                }
                index.decode_sub_tile_into(level, x, y, coded, &mut voxels)?;
            }
        }
    }
    Ok(Verified {
        checksums: checksums.is_some(),
        mistaken: index.is_mistaken(),
        index,
    })
}

/// Looks at a pyramid from outside: its description, with its checksum, and its length. No
/// sub-tile is read.
///
/// # Errors
///
/// [`PyramidError`].
pub async fn verify_quickly(storage: &dyn Storage, name: &str) -> Result<Verified, PyramidError> {
    let broken = |reason| PyramidError::Broken {
        reason,
        name: name.to_owned(),
    };
    let failed = |source| PyramidError::Storage {
        source,
        name: name.to_owned(),
    };
    let (index, mut head, len): (PyramidIndex, Bytes, usize) =
        PyramidIndex::open_with_bytes(storage, name).await?;
    head.truncate(len);
    let size = storage.size(name).await.map_err(failed)?;
    check_len(&index, head.len() as u64, size).map_err(broken)?;
    Ok(Verified {
        checksums: index.checksums().is_some(),
        mistaken: index.is_mistaken(),
        index,
    })
}

/// A file ends with its last sub-tile, or, if all are blank, with what stands for those.
fn check_len(index: &PyramidIndex, index_len: u64, len: u64) -> Result<(), String> {
    let (want, exact) = match index.end() {
        0 => (index_len, false),
        end => (end, true),
    };
    if len < want || (exact && len > want) {
        Err(format!("it has {len} bytes instead of {want}"))
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec2;

    use super::*;
    use crate::image::GrayImage;
    use crate::pyramid::{Encoding, encode, layout};
    use crate::storage::MemoryStorage;

    /// Odd sizes, some sub-tiles blank.
    fn file(encoding: Encoding) -> Vec<u8> {
        let (width, height) = (300, 270);
        let value = |at: u32| match (at % width, at / width) {
            (x, y) if x < 150 && y < 140 => 0,
            (x, y) => u8::try_from((x * 7 + y * 13) % 251).unwrap(),
        };
        let voxels = (0..width * height).map(value).collect();
        let image = GrayImage {
            width,
            height,
            voxels,
        };
        encode(&image, &encoding).unwrap().to_vec()
    }

    #[test]
    fn every_flipped_byte_is_found() {
        for encoding in [Encoding::Lossless, Encoding::Jpeg { quality: 80 }] {
            let whole = file(encoding);
            let verified = verify(&whole, "whole").unwrap();
            assert!(verified.checksums);
            assert!(verified.index.sub_tile(0, 0, 0).unwrap().is_blank());
            let begin = usize::try_from(verified.index.begin().unwrap()).unwrap();
            let all = (0..begin).step_by(7);
            for at in all.chain((begin..whole.len()).step_by(101)) {
                let mut damaged = whole.clone();
                damaged[at] ^= 1 << (at % 8);
                assert!(verify(&damaged, "damaged").is_err(), "byte {at}");
            }
            for len in (0..whole.len()).step_by(397) {
                assert!(verify(&whole[..len], "cut").is_err(), "cut to {len}");
            }
            let longer = [&whole[..], &[0]].concat();
            assert!(verify(&longer, "longer").is_err());
        }
    }

    #[test]
    fn pyramids_know_for_whom_they_are() {
        let nameless = file(Encoding::Lossless);
        assert!(!verify(&nameless, "a").unwrap().mistaken);
        let named = named(nameless.into(), "a").unwrap();
        assert!(!verify(&named, "a").unwrap().mistaken);
        assert!(verify(&named, "b").unwrap().mistaken);
        assert!(super::named(Bytes::from_static(b"II*"), "a").is_err());
    }

    /// It is as long as a tile, and only the name is missing.
    #[test]
    fn what_nobody_else_has_is_named_in_place() {
        let image = GrayImage::new(700, 600, vec![7; 700 * 600]);
        for encoding in [Encoding::Lossless, Encoding::Jpeg { quality: 80 }] {
            let nameless = encode(&image, &encoding).unwrap();
            let place = nameless.as_ptr();
            let one = named(nameless, "a").unwrap();
            assert_eq!(one.as_ptr(), place, "{encoding:?}");
            // What somebody else has is left as it is.
            let other = named(one.clone(), "b").unwrap();
            assert_ne!(other.as_ptr(), place);
            assert!(!verify(&one, "a").unwrap().mistaken);
            assert!(!verify(&other, "b").unwrap().mistaken);
        }
    }

    #[tokio::test]
    async fn a_quick_look_finds_what_is_wrong_with_index_and_length() {
        let whole = file(Encoding::Lossless);
        let storage = MemoryStorage::new();
        let put = async |bytes: Vec<u8>| {
            storage.write_durable("a", bytes.into()).await.unwrap();
            verify_quickly(&storage, "a").await
        };
        let index = put(whole.clone()).await.unwrap().index;
        assert_eq!(index.levels()[0].sub_tiles, UVec2::new(3, 3));
        let end = usize::try_from(index.begin().unwrap()).unwrap();
        for at in (0..end).step_by(11) {
            let mut damaged = whole.clone();
            damaged[at] ^= 0x10;
            // The blank stream lies between.
            let found = put(damaged.clone()).await.is_err();
            assert!(found || verify(&damaged, "a").is_err(), "byte {at}");
        }
        assert!(put(whole[..whole.len() - 1].to_vec()).await.is_err());
    }

    /// As files were before they had checksums: tags that nobody knows stand in their place.
    #[test]
    fn files_without_checksums_are_read() {
        let mut old = file(Encoding::Lossless);
        for tag in [layout::INDEX_CHECKSUM, layout::SUB_TILE_CHECKSUMS] {
            let [low, high] = tag.to_le_bytes();
            let at = old.windows(4).position(|w| w == [low, high, 4, 0]).unwrap();
            old[at + 1] = 0xff;
        }
        assert!(!verify(&old, "old").unwrap().checksums);
    }
}
