use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::SystemTime;

use bytes::Bytes;
use tokio::sync::Semaphore;

use super::same::Marks;
use super::{ObjectError, Objects, Part, is_key};
use crate::maybe_send::BoxFuture;

/// Files that are read at once: a disk is kept busy by fewer, and each takes a thread.
const AT_ONCE: usize = 16;

const FOLDER: &str = "there is a folder, or something else that is no file, in its place";
const LEADS_OUT: &str = "it is a link, or lies behind one, that leads out of the image's folder, where nothing is read; copy what it \
     leads to in its place";
const LEADS_NOWHERE: &str = "it is a link to something that is not there";

/// Files below a folder. Links are followed as long as they stay in it: whoever made an image that was copied from somewhere does
/// not choose which files of this computer are shown. The folder itself may be a link.
#[derive(Clone, Debug)]
pub struct FolderObjects {
    folder: PathBuf,
    /// Where that is without links, once it was there.
    real: Arc<OnceLock<PathBuf>>,
    /// Of files that were read in parts.
    marks: Arc<Marks<Mark>>,
    reads: Arc<Semaphore>,
}

impl FolderObjects {
    /// Those below `folder`, which is not looked at.
    pub fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
            real: Arc::default(),
            marks: Arc::default(),
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
        let (folder, real, path) = (
            self.folder.clone(),
            self.real.clone(),
            self.folder.join(key),
        );
        let (marks, name) = (self.marks.clone(), key.to_owned());
        // The semaphore is never closed. A read that nobody waits for any more keeps its place until it ends.
        let place = self.reads.clone().acquire_owned().await.ok();
        let read = tokio::task::spawn_blocking(move || {
            let _place = place;
            let Some(path) = inside(&folder, &real, &path)? else {
                return Ok(None);
            };
            let Some((bytes, mark)) = read_part(&path, &part)? else {
                return Ok(None);
            };
            let location = || path.display().to_string();
            marks.check(&name, &part, Some(mark), location)?;
            Ok(Some(bytes))
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

fn failed(source: io::Error, path: &Path) -> ObjectError {
    let location = path.display().to_string();
    match source.kind() {
        ErrorKind::PermissionDenied => ObjectError::Denied {
            advice: "check the file's owner and permissions",
            location,
        },
        _ => ObjectError::Io { source, location },
    }
}

fn is_missing(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
}

/// Where a file below a folder is without links; `None` if there is none. `real` is what was found of the folder.
fn inside(
    folder: &Path,
    real: &OnceLock<PathBuf>,
    path: &Path,
) -> Result<Option<PathBuf>, ObjectError> {
    let refused = |what| {
        Err(ObjectError::NoFile {
            what,
            location: path.display().to_string(),
        })
    };
    let found = match fs::canonicalize(path) {
        Ok(found) => found,
        Err(error) if is_missing(&error) => {
            let is_link = fs::symlink_metadata(path).is_ok_and(|found| found.is_symlink());
            return match is_link {
                true => refused(LEADS_NOWHERE),
                false => Ok(None),
            };
        }
        Err(error) => return Err(failed(error, path)),
    };
    let folder = match real.get() {
        Some(real) => real,
        None => {
            let found = fs::canonicalize(folder).map_err(|error| failed(error, folder))?;
            real.get_or_init(|| found)
        }
    };
    if !found.starts_with(folder) {
        return refused(LEADS_OUT);
    }
    // Before it is opened: that of a pipe waits for a writer.
    match fs::metadata(&found) {
        Ok(metadata) if !metadata.is_file() => refused(FOLDER),
        Ok(_) => Ok(Some(found)),
        Err(error) if is_missing(&error) => Ok(None),
        Err(error) => Err(failed(error, path)),
    }
}

/// What tells a file from one that took its place, or that was written anew.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Mark {
    written: Option<SystemTime>,
    length: u64,
    /// Device and number.
    #[cfg(unix)]
    inode: (u64, u64),
}

impl Mark {
    fn of(file: &File) -> io::Result<Self> {
        let found = file.metadata()?;
        Ok(Self {
            written: found.modified().ok(),
            length: found.len(),
            #[cfg(unix)]
            inode: {
                use std::os::unix::fs::MetadataExt as _;
                (found.dev(), found.ino())
            },
        })
    }
}

fn read_part(path: &Path, part: &Part) -> Result<Option<(Bytes, Mark)>, ObjectError> {
    let location = || path.display().to_string();
    let failed = |source: io::Error| failed(source, path);
    let mut file = match File::open(path) {
        Ok(file) => file,
        Err(error) if is_missing(&error) => return Ok(None),
        Err(error) => return Err(failed(error)),
    };
    let mark = Mark::of(&file).map_err(failed)?;
    let length = mark.length;
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
    let mut wanted = file.take(count);
    wanted.read_to_end(&mut bytes).map_err(failed)?;
    if bytes.len() as u64 != count {
        return Err(failed(ErrorKind::UnexpectedEof.into()));
    }
    // One that is written while it is read is neither what it was nor what it will be.
    if !matches!(part, Part::Whole { .. }) && Mark::of(wanted.get_ref()).map_err(failed)? != mark {
        return Err(ObjectError::Replaced {
            location: location(),
        });
    }
    Ok(Some((bytes.into(), mark)))
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

    fn replacements(&self, key: &str) -> u64 {
        self.marks.replacements(key)
    }

    fn read_cost(&self) -> u64 {
        16 << 10
    }

    fn is_remote(&self) -> bool {
        false
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[expect(clippy::unwrap_used, reason = "a helper of tests")]
    fn read(objects: &FolderObjects, key: &str) -> Result<Option<Bytes>, ObjectError> {
        let runtime = tokio::runtime::Builder::new_current_thread().build();
        let read = objects.read(key, Part::Whole { most: 100 });
        { runtime }.unwrap().block_on(read)
    }

    #[test]
    fn links_are_followed_as_long_as_they_stay_inside() {
        let root = tempfile::tempdir().unwrap();
        let (image, link) = (root.path().join("image"), root.path().join("link"));
        fs::create_dir_all(image.join("0/c")).unwrap();
        fs::create_dir(root.path().join("image-secret")).unwrap();
        fs::write(root.path().join("image-secret/file"), "secret").unwrap();
        fs::write(image.join("0/c/0"), "chunk").unwrap();
        symlink("0", image.join("0/c/1")).unwrap();
        symlink(image.join("0"), image.join("1")).unwrap();
        symlink(&image, &link).unwrap();
        let out = [
            ("0/c/2", root.path().join("image-secret/file")),
            ("0/c/3", "../../../image-secret/file".into()),
            ("2", root.path().join("image-secret")),
        ];
        for (name, target) in &out {
            symlink(target, image.join(name)).unwrap();
        }
        symlink("2/file", image.join("3")).unwrap();
        // A folder may be named by a link, and by way of one.
        for folder in [&image, &link, &root.path().join("link/../image")] {
            let objects = FolderObjects::new(folder);
            for inside in ["0/c/0", "0/c/1", "1/c/1"] {
                let got = read(&objects, inside).unwrap();
                assert_eq!(got.as_deref(), Some(&b"chunk"[..]), "{inside}");
            }
            for outside in ["0/c/2", "0/c/3", "2/file", "3", "1/c/3"] {
                let error = read(&objects, outside).unwrap_err();
                let named = error.to_string();
                assert!(
                    named.contains("leads out") && named.contains(outside),
                    "{named}"
                );
                assert!(!error.is_transient() && !error.without_place().contains("secret"));
            }
            assert!(matches!(read(&objects, "2/none"), Ok(None)));
        }
    }

    #[test]
    fn what_is_no_file_is_not_taken_for_missing() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir_all(root.path().join("c/0")).unwrap();
        symlink("nowhere", root.path().join("c/1")).unwrap();
        let objects = FolderObjects::new(root.path());
        for (key, says) in [("c/0", "a folder"), ("c/1", "not there")] {
            let named = read(&objects, key).unwrap_err().to_string();
            assert!(named.contains(says) && named.contains(key), "{named}");
        }
        for missing in ["c/2", "d/0", "c/0/0"] {
            assert!(matches!(read(&objects, missing), Ok(None)), "{missing}");
        }
    }
}
