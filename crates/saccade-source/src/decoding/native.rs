use std::panic::{AssertUnwindSafe, catch_unwind};

use bytes::Bytes;

use super::Decoding;
use crate::codecs::Damage;
use crate::processors::on_a_processor;

/// Decodes on a thread for that. There are as many as processors: more would only fill memory, and each keeps what
/// its decoders need.
pub(crate) async fn decode(decoding: Decoding, bytes: Bytes) -> Result<Bytes, Damage> {
    on_a_processor(move || {
        // Bytes that somebody else wrote end nothing but their own chunk, also where a decoder has a bug.
        let done = catch_unwind(AssertUnwindSafe(|| decoding.run(bytes)));
        done.unwrap_or_else(|_| Err("decoding it was interrupted".to_owned()))
    })
    .await
}
