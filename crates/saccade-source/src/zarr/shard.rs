//! Where the chunks of a shard are.

use std::ops::Range;

use bytes::Bytes;

use super::array::Sharding;
use crate::codecs::{Codec, Damage};
use crate::flights::Weighed;

/// A shard's index: offset and length of each chunk, 2^64 - 1 twice for none.
#[derive(Clone, Debug)]
pub(super) struct Index {
    bytes: Bytes,
    big_endian: bool,
}

impl Weighed for Index {
    fn bytes(&self) -> u64 {
        self.bytes.len() as u64
    }
}

impl Index {
    /// Of the bytes that a shard has at its beginning or end.
    pub(super) fn read(bytes: Bytes, sharding: &Sharding) -> Result<Self, Damage> {
        if bytes.len() as u64 != sharding.index_bytes() {
            let (got, want) = (bytes.len(), sharding.index_bytes());
            return Err(format!("its index has {got} bytes, not {want}"));
        }
        let bytes = if sharding.index_checked {
            Codec::Crc32c.decode(bytes, usize::MAX)
        } else {
            Ok(bytes)
        };
        Ok(Self {
            bytes: bytes.map_err(|damage| format!("its index: {damage}"))?,
            big_endian: sharding.index_big_endian,
        })
    }

    /// Bytes of a chunk within the shard; `None` if it is not stored.
    pub(super) fn chunk(&self, number: u64, most: u64) -> Result<Option<Range<u64>>, Damage> {
        let at = usize::try_from(number).map_or(usize::MAX, |number| number.saturating_mul(16));
        let entry: Option<&[u8; 16]> = self.bytes.get(at..).and_then(|rest| rest.first_chunk());
        let [offset, length] = *entry.ok_or("its index is too short")?.as_chunks::<8>().0 else {
            return Err("its index is too short".to_owned());
        };
        let [offset, length] = [offset, length].map(|number| match self.big_endian {
            true => u64::from_be_bytes(number),
            false => u64::from_le_bytes(number),
        });
        if (offset, length) == (u64::MAX, u64::MAX) {
            return Ok(None);
        }
        if length > most {
            return Err(format!(
                "its index says {length} bytes, and it can need {most} at most"
            ));
        }
        let end = offset.checked_add(length);
        let end =
            end.ok_or_else(|| format!("its index says byte {offset}, where no file reaches"))?;
        Ok(Some(offset..end))
    }
}
