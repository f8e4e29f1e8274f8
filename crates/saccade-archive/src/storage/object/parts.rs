//! Writing a long object in parts, which the store puts together in the end.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{
    Error, GetOptions, GetRange, MultipartUpload, ObjectStore, ObjectStoreExt as _,
    PutMultipartOptions, Result,
};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::clock::{Clock as _, SystemClock};

use super::sort::{is_transport, lost_upload};

/// Length of a part \[bytes\]. At 280 kB/s one takes as long as a request may.
const PART: usize = 8 << 20;
/// Parts of one object on their way.
const PARTS: usize = 4;
/// How often an upload is aborted at most, and the pause in between.
const ABORTS: u32 = 5;
const PAUSE: Duration = Duration::from_millis(200);
/// How often an object is sent at most whose upload broke off, or is unknown to the store.
const UPLOADS: u32 = 3;

/// Writes long objects. What comes to nothing is aborted, so that no parts stay in the store.
#[derive(Debug)]
pub(super) struct Uploads {
    /// How many are begun or aborted for whom nobody may wait any more.
    given_up: watch::Sender<usize>,
}

impl Uploads {
    pub(super) fn new() -> Self {
        Self {
            given_up: watch::Sender::new(0),
        }
    }

    /// Writes an object.
    pub(super) async fn write(
        &self,
        store: &Arc<dyn ObjectStore>,
        path: &Path,
        bytes: &Bytes,
    ) -> Result<()> {
        for _ in 1..UPLOADS {
            match self.write_once(store, path, bytes).await {
                // Someone aborts uploads that are under way, or an answer that tells of it was cut short.
                Err(e) if lost_upload(&e) || is_transport(&e) => {}
                done => return done,
            }
        }
        self.write_once(store, path, bytes).await
    }

    async fn write_once(
        &self,
        store: &Arc<dyn ObjectStore>,
        path: &Path,
        bytes: &Bytes,
    ) -> Result<()> {
        let mut upload = self.begin(store, path).await?;
        match upload.finish(bytes).await {
            Ok(()) => {}
            // The answer may have been lost. Who asks again is told then that there is no such upload.
            Err(Unfinished::Complete(_)) if holds(&**store, path, bytes).await => {}
            Err(Unfinished::Complete(e) | Unfinished::Parts(e)) => {
                upload.abort().await;
                return Err(e);
            }
        }
        upload.0 = None;
        Ok(())
    }

    /// Begins an upload. The store's answer is waited for even if nobody wants it any more: without its number nothing could be
    /// aborted, and the store may have begun it.
    async fn begin(&self, store: &Arc<dyn ObjectStore>, path: &Path) -> Result<Pending> {
        let (store, path, given_up) = (store.clone(), path.clone(), self.given_up.clone());
        let counted = Counted::new(&given_up);
        let begun = tokio::spawn(async move {
            let options = PutMultipartOptions::default();
            let upload = store.put_multipart_opts(&path, options).await?;
            // If nobody waits for it, it is dropped in this order.
            Ok((Pending(Some(Upload::new(upload, &path)), given_up), counted))
        });
        let begun = begun.await.map_err(|source| Error::JoinError { source })?;
        begun.map(|(upload, _counted)| upload)
    }

    /// Returns once nothing is being aborted any more for which nobody waits.
    pub(super) async fn settled(&self) {
        // The sender lives as long as this does.
        let _ = { self.given_up.subscribe() }.wait_for(|n| *n == 0).await;
    }
}

/// An upload that is aborted when it is dropped: who waited for it gave up.
struct Pending(Option<Upload>, watch::Sender<usize>);

/// One more, until dropped.
struct Counted(watch::Sender<usize>);

impl Counted {
    fn new(all: &watch::Sender<usize>) -> Self {
        all.send_modify(|n| *n += 1);
        Self(all.clone())
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.send_modify(|n| *n -= 1);
    }
}

struct Upload {
    upload: Box<dyn MultipartUpload>,
    /// Its parts that are on their way.
    parts: JoinSet<Result<()>>,
    path: Path,
}

/// What could not be done.
enum Unfinished {
    /// Sending a part.
    Parts(Error),
    /// Putting them together, as far as one hears of it.
    Complete(Error),
}

impl Pending {
    async fn finish(&mut self, bytes: &Bytes) -> Result<(), Unfinished> {
        match &mut self.0 {
            Some(upload) => upload.finish(bytes).await,
            None => Ok(()),
        }
    }

    async fn abort(&mut self) {
        if let Some(upload) = &mut self.0 {
            upload.abort().await;
        }
        self.0 = None;
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        let (Some(mut upload), Ok(runtime)) = (self.0.take(), Handle::try_current()) else {
            return;
        };
        let counted = Counted::new(&self.1);
        runtime.spawn(async move {
            upload.abort().await;
            drop(counted);
        });
    }
}

impl Upload {
    fn new(upload: Box<dyn MultipartUpload>, path: &Path) -> Self {
        Self {
            upload,
            parts: JoinSet::new(),
            path: path.clone(),
        }
    }

    async fn finish(&mut self, bytes: &Bytes) -> Result<(), Unfinished> {
        for begin in (0..bytes.len()).step_by(PART) {
            if self.parts.len() >= PARTS {
                self.arrived().await.map_err(Unfinished::Parts)?;
            }
            let part = bytes.slice(begin..bytes.len().min(begin + PART));
            self.parts.spawn(self.upload.put_part(part.into()));
        }
        while !self.parts.is_empty() {
            self.arrived().await.map_err(Unfinished::Parts)?;
        }
        let completed = self.upload.complete().await;
        completed.map(|_| ()).map_err(Unfinished::Complete)
    }

    /// Waits for one part.
    async fn arrived(&mut self) -> Result<()> {
        match self.parts.join_next().await {
            None => Ok(()),
            Some(Ok(arrived)) => arrived,
            Some(Err(source)) => Err(Error::JoinError { source }),
        }
    }

    async fn abort(&mut self) {
        // One that arrives later would stay.
        self.parts.shutdown().await;
        for turn in 1..=ABORTS {
            match self.upload.abort().await {
                // What the store was about to take in may be in its way.
                Err(e) if !lost_upload(&e) && turn < ABORTS => {
                    log::debug!("an upload is not aborted yet: {e}");
                    SystemClock.sleep(PAUSE).await;
                }
                Err(e) if !lost_upload(&e) => {
                    let path = &self.path;
                    log::warn!("parts of {path} may be left in the object store, unseen: {e}");
                }
                _ => return,
            }
        }
    }
}

/// Whether the object is there already.
async fn holds(store: &dyn ObjectStore, path: &Path, bytes: &Bytes) -> bool {
    let length = bytes.len() as u64;
    let there = store.head(path).await;
    if there.map_or(true, |there| there.size != length) {
        return false;
    }
    for begin in (0..bytes.len()).step_by(PART) {
        let end = bytes.len().min(begin + PART);
        let options = GetOptions {
            range: Some(GetRange::Bounded(begin as u64..end as u64)),
            ..GetOptions::default()
        };
        let part = async { store.get_opts(path, options).await?.bytes().await };
        if part.await.map_or(true, |part| part != bytes[begin..end]) {
            return false;
        }
    }
    true
}
