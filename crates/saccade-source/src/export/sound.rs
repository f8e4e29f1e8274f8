//! What is there of an export, as far as shards tell that without being decoded: whether each still has its index, and
//! room for what that says.

use std::collections::{BTreeMap, BTreeSet};

use futures::{StreamExt as _, TryStreamExt as _, stream};
use saccade_archive::storage::{Storage, StorageError};
use serde_json::Value;

use super::plan::Plan;
use super::{ExportError, OURS};

/// Shards that are looked at at a time.
const AT_ONCE: usize = 16;
/// Of a chunk that a shard does not have, in its index.
const NONE: u64 = u64::MAX;

/// Names of the descriptions of levels and of the shards that are as they were written. What is damaged, somebody cut or
/// wrote over, is told, and is as if it were not there.
pub(super) async fn sound(
    storage: &dyn Storage,
    plan: &Plan,
) -> Result<BTreeSet<String>, ExportError> {
    let mut sizes = BTreeMap::new();
    for level in 0..plan.levels.len() {
        let entries = storage.entries(&format!("{level}/")).await?;
        sizes.extend(entries.into_iter().map(|entry| (entry.name, entry.size)));
    }
    let mut sound = BTreeSet::new();
    for level in 0..plan.levels.len() {
        let name = format!("{level}/zarr.json");
        if sizes.contains_key(&name) {
            let said = storage.read(&name, None).await?;
            if without_state(&said) == Some(plan.array(level)) {
                sound.insert(name);
            }
        }
    }
    let shards = plan.shards().filter_map(|shard| {
        let key = shard.key();
        let size = *sizes.get(&key)?;
        let chunks = plan.levels[shard.level].shard / plan.volume.chunk;
        let chunks: u64 = chunks.as_u64vec3().element_product();
        Some(async move {
            let is_sound = has_index(storage, &key, size, chunks).await?;
            Ok::<_, ExportError>((key, is_sound))
        })
    });
    let mut looked_at = stream::iter(shards).buffer_unordered(AT_ONCE);
    while let Some((key, is_sound)) = looked_at.try_next().await? {
        if is_sound {
            sound.insert(key);
        } else {
            log::warn!("{key} of the export is damaged, and is exported again");
        }
    }
    Ok(sound)
}

/// A level's description, but for what is said in it of the export.
fn without_state(said: &[u8]) -> Option<Value> {
    let mut said: Value = serde_json::from_slice(said).ok()?;
    let attributes = said.get_mut("attributes").and_then(Value::as_object_mut);
    if let Some(attributes) = attributes {
        attributes.remove(OURS);
    }
    Some(said)
}

/// Whether a shard ends with an index of so many chunks that its checksum fits, and all of these lie before it.
async fn has_index(
    storage: &dyn Storage,
    key: &str,
    size: u64,
    chunks: u64,
) -> Result<bool, ExportError> {
    let index = 16 * chunks + 4;
    let Some(begin) = size.checked_sub(index) else {
        return Ok(false);
    };
    let bytes = match storage.read(key, Some(begin..size)).await {
        Ok(bytes) => bytes,
        Err(StorageError::NotFound { .. }) => return Ok(false),
        Err(error) => return Err(error.into()),
    };
    let Some((pairs, sum)) = bytes.split_last_chunk::<4>() else {
        return Ok(false);
    };
    let (words, rest) = pairs.as_chunks::<8>();
    let words: Vec<u64> = words.iter().copied().map(u64::from_le_bytes).collect();
    let lies_before = |pair: &[u64]| {
        let end = pair[0].checked_add(pair[1]);
        pair == [NONE, NONE] || end.is_some_and(|end| end <= begin)
    };
    Ok(rest.is_empty()
        && crc32c::crc32c(pairs) == u32::from_le_bytes(*sum)
        && words.chunks_exact(2).all(lies_before))
}

/// A shard of which only the checksum of the index is right: its chunks lie before the index, or it is not sound. The first byte
/// chooses how many chunks it has.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz_shard(bytes: &[u8]) {
    use futures::FutureExt as _;
    use saccade_archive::storage::MemoryStorage;

    let Some((&chunks, bytes)) = bytes.split_first() else {
        return;
    };
    let chunks = u64::from(chunks % 16) + 1;
    let begin = bytes
        .len()
        .saturating_sub(16 * usize::try_from(chunks).expect("a few"));
    let sum = crc32c::crc32c(&bytes[begin..]).to_le_bytes();
    let storage = MemoryStorage::new();
    let is_sound = |shard: Vec<u8>| {
        let size = shard.len() as u64;
        let looked = async {
            storage
                .write_durable("0/c/0", shard.into())
                .await
                .expect("memory");
            has_index(&storage, "0/c/0", size, chunks)
                .await
                .expect("memory")
        };
        looked.now_or_never().expect("memory is not waited for")
    };
    let mut shard = [bytes, &sum].concat();
    if !is_sound(shard.clone()) {
        return;
    }
    assert_eq!((bytes.len() - begin) as u64, 16 * chunks);
    for pair in bytes[begin..].chunks_exact(16) {
        let [offset, len] = [0, 8].map(|at| {
            let word = pair[at..at + 8].try_into().expect("eight bytes");
            u128::from(u64::from_le_bytes(word))
        });
        let is_none = [offset, len] == [NONE.into(); 2];
        assert!(is_none || offset + len <= begin as u128, "{offset} + {len}");
    }
    // One that is cut, or of which a bit of the index fell over, is not.
    assert!(!is_sound(shard[..shard.len() - 1].to_vec()));
    let last = shard.len() - 5;
    shard[last] ^= 1;
    assert!(!is_sound(shard));
}

/// A level's description, as far as it says more than what it was exported of.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz_description(bytes: &[u8]) {
    let Some(said) = without_state(bytes) else {
        return;
    };
    assert!(said.pointer(&format!("/attributes/{OURS}")).is_none());
    let again = serde_json::to_vec(&said).expect("it was JSON");
    assert_eq!(without_state(&again), Some(said.clone()));
    // What it was exported of does not matter, where there is room to say it.
    let mut other = said.clone();
    if let Some(attributes) = other.get_mut("attributes").and_then(Value::as_object_mut) {
        attributes.insert(OURS.to_owned(), 7.into());
        let other = serde_json::to_vec(&other).expect("it was JSON");
        assert_eq!(without_state(&other), Some(said));
    }
}
