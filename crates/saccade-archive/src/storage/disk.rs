//! What a folder's storage asks of a file system, so that a simulated one can take its place.

use std::ffi::OsString;
use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::ops::Range;
use std::path::Path;
use std::time::SystemTime;

use bytes::Bytes;

pub mod conformance;
mod folder_id;
mod regular;
mod rename_new;
mod simulated;

pub use folder_id::FolderId;
pub(crate) use regular::{open_regular, read_regular};
use rename_new::rename_new;
pub use simulated::{Crash, SimulatedDisk};

/// A file system, in steps that a power cut can come between. All block.
///
/// Nothing survives a power cut for sure but what was synced: a file's content by
/// [`OpenFile::sync`], a folder's entries by [`sync_dir`](Self::sync_dir).
pub trait Disk: Send + Sync + fmt::Debug {
    /// Makes a file for writing.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::AlreadyExists`] if there is one; what the system says.
    fn create_new(&self, path: &Path) -> io::Result<Box<dyn OpenFile>>;

    /// Gives a file another name, in place of what has that name.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Gives a file another name, unless something has that name.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::AlreadyExists`] if something has; what the system says.
    fn rename_new(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Removes a file.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn remove_file(&self, path: &Path) -> io::Result<()>;

    /// Removes a file that nobody has locked.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn remove_if_unlocked(&self, path: &Path) -> io::Result<()>;

    /// Makes a folder in one that exists.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn create_dir(&self, path: &Path) -> io::Result<()>;

    /// Makes a folder's entries durable: names of files and folders in it.
    ///
    /// # Errors
    ///
    /// What the system says. What was not durable before may then be lost, and another call that
    /// succeeds does not change that.
    fn sync_dir(&self, path: &Path) -> io::Result<()>;

    /// What is at a path.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::NotFound`] if nothing is; what the system says.
    fn metadata(&self, path: &Path) -> io::Result<Metadata>;

    /// Which folder is at a path, by which it is told from another that takes its place; `None` where folders
    /// cannot be told apart.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::NotFound`] if nothing is; what the system says.
    fn folder_id(&self, path: &Path) -> io::Result<Option<FolderId>> {
        self.metadata(path).map(|_| None)
    }

    /// What a folder holds, in any order.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn read_dir(&self, path: &Path) -> io::Result<Vec<DirEntry>>;

    /// A file's bytes, or those of `range` that exist.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::NotSeekable`] if it is a named pipe, a socket or a device; what the system says.
    fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Bytes>;
}

/// A file that is being written.
pub trait OpenFile: Send {
    /// Keeps [`Disk::remove_if_unlocked`] off, also of other processes, until this is dropped. Where
    /// there are no locks, nothing happens.
    fn lock(&mut self);

    /// Appends bytes.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Makes the file's content durable, though not its name.
    ///
    /// # Errors
    ///
    /// What the system says. What was written before may then be lost, and another call that
    /// succeeds does not change that.
    fn sync(&mut self) -> io::Result<()>;
}

/// What is at a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metadata {
    /// Whether it is a folder.
    pub is_dir: bool,
    /// A file's size \[bytes\].
    pub len: u64,
    /// When it last changed, if the system knows.
    pub modified: Option<SystemTime>,
}

/// One name in a folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DirEntry {
    /// The name, without the folder's.
    pub name: OsString,
    /// Whether it names a folder.
    pub is_dir: bool,
}

/// Writes a file into a folder that exists, whole: whenever the power is cut, the path has what it had before, or this; once
/// it returns, this.
///
/// # Errors
///
/// What the system says.
pub fn write_whole(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> io::Result<()> {
    use io::ErrorKind::{InvalidInput, NotFound, Unsupported};
    // Its own: another may be about to write the same.
    let mut part = path.as_os_str().to_owned();
    part.push(format!(".{}.part", std::process::id()));
    let part = Path::new(&part);
    // Of one who died.
    match disk.remove_file(part) {
        Err(e) if e.kind() != NotFound => return Err(e),
        Ok(()) | Err(_) => {}
    }
    let write = || {
        let mut file = disk.create_new(part)?;
        file.write_all(bytes)?;
        file.sync()?;
        drop(file);
        disk.rename(part, path)
    };
    write().inspect_err(|_| {
        // Without this a full disk would stay full; a failure here changes nothing.
        let _ = disk.remove_file(part);
    })?;
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    match disk.sync_dir(folder.unwrap_or(Path::new("."))) {
        // Some shares know no such thing.
        Err(e) if matches!(e.kind(), InvalidInput | Unsupported) => Ok(()),
        synced => synced,
    }
}

/// The operating system's file systems.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemDisk;

impl OpenFile for File {
    fn lock(&mut self) {
        let _ = self.try_lock();
    }

    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        io::Write::write_all(self, bytes)?;
        self.flush()
    }

    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

impl Disk for SystemDisk {
    fn create_new(&self, path: &Path) -> io::Result<Box<dyn OpenFile>> {
        Ok(Box::new(File::create_new(path)?))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn rename_new(&self, from: &Path, to: &Path) -> io::Result<()> {
        rename_new(from, to)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_if_unlocked(&self, path: &Path) -> io::Result<()> {
        let file = open_regular(path)?;
        if file.try_lock().is_ok() {
            fs::remove_file(path)?;
        }
        Ok(())
    }

    fn create_dir(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }

    fn metadata(&self, path: &Path) -> io::Result<Metadata> {
        let metadata = fs::metadata(path)?;
        Ok(Metadata {
            is_dir: metadata.is_dir(),
            len: metadata.len(),
            modified: metadata.modified().ok(),
        })
    }

    fn folder_id(&self, path: &Path) -> io::Result<Option<FolderId>> {
        Ok(FolderId::of(&fs::metadata(path)?))
    }

    fn read_dir(&self, path: &Path) -> io::Result<Vec<DirEntry>> {
        let entry = |entry: io::Result<fs::DirEntry>| {
            let entry = entry?;
            Ok(DirEntry {
                name: entry.file_name(),
                is_dir: entry.file_type()?.is_dir(),
            })
        };
        fs::read_dir(path)?.map(entry).collect()
    }

    fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Bytes> {
        let mut file = open_regular(path)?;
        let cut = super::memory::cut(range, file.metadata()?.len());
        let len = cut.end - cut.start;
        file.seek(SeekFrom::Start(cut.start))?;
        let mut bytes = Vec::new();
        bytes
            .try_reserve_exact(usize::try_from(len).unwrap_or(usize::MAX))
            .map_err(|_| io::ErrorKind::OutOfMemory)?;
        file.take(len).read_to_end(&mut bytes)?;
        Ok(bytes.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_a_power_cut_a_file_is_the_old_one_or_the_new_one() {
        let path = Path::new("kept/volume.json");
        let (old, new) = (vec![1; 700], vec![2; 1900]);
        let (mut olds, mut news, mut cuts) = (0, 0, 0);
        for cut in 0.. {
            let disk = SimulatedDisk::new();
            disk.create_dir(Path::new("kept")).unwrap();
            disk.sync_dir(Path::new("")).unwrap();
            write_whole(&disk, path, &old).unwrap();
            disk.cut_power_at(cut);
            let written = write_whole(&disk, path, &new);
            for seed in 0..200 {
                let left = disk.after_crash(&mut Crash::new(seed));
                let read = left.read(path, None).unwrap();
                assert!(read == old || read == new, "{} bytes", read.len());
                assert!(written.is_err() || read == new, "it was acknowledged");
                (olds, news) = (olds + u32::from(read == old), news + u32::from(read == new));
                // What is left in its way is no obstacle.
                write_whole(&left, path, &old).unwrap();
                assert_eq!(left.read(path, None).unwrap(), old);
            }
            cuts += 1;
            if written.is_ok() {
                break;
            }
        }
        assert!(
            cuts > 4 && olds > 0 && news > 200,
            "{cuts} cuts, {olds}, {news}"
        );
    }
}
