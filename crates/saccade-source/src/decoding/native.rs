use std::sync::LazyLock;

use bytes::Bytes;
use tokio::sync::Semaphore;

use super::Decoding;
use crate::codecs::Damage;

/// As many decode at once as there are processors: more would only fill memory.
static PROCESSORS: LazyLock<Semaphore> =
    LazyLock::new(|| Semaphore::new(std::thread::available_parallelism().map_or(2, usize::from)));

/// Decodes on a thread for that.
pub(crate) async fn decode(decoding: Decoding, bytes: Bytes) -> Result<Bytes, Damage> {
    // The semaphore is never closed.
    let permit = PROCESSORS.acquire().await.ok();
    let done = tokio::task::spawn_blocking(move || {
        let _permit = permit;
        decoding.run(bytes)
    });
    // It panicked, or the program ends.
    done.await
        .unwrap_or_else(|_| Err("decoding it was interrupted".to_owned()))
}
