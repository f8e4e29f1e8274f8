use std::fs::File;
use std::io::{self, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use tokio::sync::Semaphore;

use super::{ObjectError, Objects, Part, is_key};
use crate::maybe_send::BoxFuture;

/// Files that are read at once: a disk is kept busy by fewer, and each takes a thread.
const AT_ONCE: usize = 16;

/// Files below a folder. Links are followed: the folder is its owner's.
#[derive(Clone, Debug)]
pub struct FolderObjects {
    folder: PathBuf,
    reads: Arc<Semaphore>,
}

impl FolderObjects {
    /// Those below `folder`, which is not looked at.
    pub fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
            reads: Arc::new(Semaphore::new(AT_ONCE)),
        }
    }

    async fn part(&self, key: &str, part: Part) -> Result<Option<Bytes>, ObjectError> {
        if !is_key(key) {
            return Err(ObjectError::Key {
                key: key.to_owned(),
                location: self.folder.display().to_string(),
            });
        }
        let path = self.folder.join(key);
        // The semaphore is never closed. A read that nobody waits for any more keeps its place until it ends.
        let place = self.reads.clone().acquire_owned().await.ok();
        let read = tokio::task::spawn_blocking(move || {
            let _place = place;
            read_part(&path, &part)
        });
        match read.await {
            Ok(read) => read,
            Err(ended) => Err(ObjectError::Io {
                source: io::Error::other(ended.to_string()),
                location: self.location(key),
            }),
        }
    }
}

fn read_part(path: &Path, part: &Part) -> Result<Option<Bytes>, ObjectError> {
    let location = || path.display().to_string();
    let failed = |source: io::Error| match source.kind() {
        ErrorKind::PermissionDenied => ObjectError::Denied {
            advice: "check the file's owner and permissions",
            location: location(),
        },
        _ => ObjectError::Io {
            source,
            location: location(),
        },
    };
    let mut file = match File::open(path) {
        Ok(file) => file,
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            return Ok(None);
        }
        Err(error) => return Err(failed(error)),
    };
    let metadata = file.metadata().map_err(failed)?;
    if metadata.is_dir() {
        return Ok(None);
    }
    let length = metadata.len();
    let wanted = match part {
        Part::Whole { most } if length > *most => {
            return Err(ObjectError::TooLong {
                most: *most,
                location: location(),
            });
        }
        Part::Whole { .. } => 0..length,
        Part::Range(range) => range.clone(),
        Part::Last(count) => length.saturating_sub(*count)..length,
    };
    if wanted.start > wanted.end || wanted.end > length {
        return Err(ObjectError::TooShort {
            wanted,
            location: location(),
        });
    }
    if wanted.start > 0 {
        file.seek(SeekFrom::Start(wanted.start)).map_err(failed)?;
    }
    let count = wanted.end - wanted.start;
    // A file that shrinks meanwhile is noticed; one that grows is not read further.
    let mut bytes = Vec::new();
    let space = usize::try_from(count).unwrap_or(usize::MAX);
    if bytes.try_reserve_exact(space).is_err() {
        return Err(failed(ErrorKind::OutOfMemory.into()));
    }
    file.take(count).read_to_end(&mut bytes).map_err(failed)?;
    if bytes.len() as u64 != count {
        return Err(failed(ErrorKind::UnexpectedEof.into()));
    }
    Ok(Some(bytes.into()))
}

impl Objects for FolderObjects {
    fn read<'a>(
        &'a self,
        key: &'a str,
        part: Part,
    ) -> BoxFuture<'a, Result<Option<Bytes>, ObjectError>> {
        Box::pin(self.part(key, part))
    }

    fn location(&self, key: &str) -> String {
        self.folder.join(key).display().to_string()
    }

    fn folders(&self) -> Vec<String> {
        let whole = std::path::absolute(&self.folder).unwrap_or_else(|_| self.folder.clone());
        let names = whole.components().filter_map(|part| match part {
            Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
            _ => None,
        });
        names.collect()
    }

    fn read_cost(&self) -> u64 {
        16 << 10
    }

    fn is_remote(&self) -> bool {
        false
    }
}
