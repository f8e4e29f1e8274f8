//! How the numbers of a chunk become bytes, and back.

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use crate::codecs::{Codec, Damage};

/// What was done with the numbers of a chunk.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Packing {
    /// In the order in which they were applied.
    codecs: Vec<Codec>,
    /// Of all numbers \[bytes\].
    bytes: usize,
}

impl Packing {
    pub(crate) fn new(codecs: Vec<Codec>, bytes: usize) -> Self {
        Self { codecs, bytes }
    }

    /// Longest that an encoded chunk can sensibly be \[bytes\].
    pub(super) fn most(&self) -> u64 {
        let decoded = self.bytes as u64;
        decoded + decoded / 8 + (64 << 10)
    }

    /// Numbers as they are stored, from the bytes of a chunk.
    pub(crate) fn unpack(&self, mut bytes: Bytes) -> Result<Bytes, Damage> {
        let want = self.bytes;
        for (n, codec) in self.codecs.iter().enumerate().rev() {
            let most = match n {
                0 => want,
                _ => usize::try_from(self.most()).unwrap_or(usize::MAX),
            };
            bytes = codec.decode(bytes, most)?;
        }
        if bytes.len() == want {
            Ok(bytes)
        } else {
            Err(format!(
                "it has {} bytes of voxels instead of {want}",
                bytes.len()
            ))
        }
    }
}
