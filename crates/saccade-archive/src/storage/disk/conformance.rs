//! What every [`Disk`] must do while the power is on. What storage does after a power cut is tested with a simulated one, which is
//! of use only as far as it is like the system's.

use std::collections::BTreeMap;
use std::io::{self, ErrorKind};
use std::path::Path;

use super::{Disk, Metadata};

/// Checks a disk in an empty folder of it, and leaves things there.
///
/// # Panics
///
/// If the disk breaks its contract: this is a test.
pub fn check(disk: &dyn Disk, folder: &Path) {
    assert_eq!(names(disk, folder), [], "begin with an empty folder");
    files_hold_what_is_appended(disk, folder);
    names_are_given_once(disk, folder);
    renamed_files_take_the_place_of_others(disk, folder);
    new_names_are_given_once(disk, folder);
    open_files_outlive_their_names(disk, folder);
    locked_files_stay(disk, folder);
    folders_hold_what_is_in_them(disk, folder);
    what_is_not_there_is_not_found(disk, folder);
    files_are_no_folders(disk, folder);
}

fn names(disk: &dyn Disk, folder: &Path) -> Vec<(String, bool)> {
    let entries = disk.read_dir(folder).expect("a folder is listed");
    let entry = |entry: super::DirEntry| {
        let name = entry.name.into_string().expect("a name of ours");
        (name, entry.is_dir)
    };
    let sorted: BTreeMap<String, bool> = entries.into_iter().map(entry).collect();
    sorted.into_iter().collect()
}

fn write(disk: &dyn Disk, path: &Path, bytes: &[u8]) {
    let mut file = disk.create_new(path).expect("a file is made");
    file.write_all(bytes).expect("it is written");
    file.sync().expect("it is synced");
}

fn read(disk: &dyn Disk, path: &Path) -> Vec<u8> {
    disk.read(path, None).expect("a file is read").to_vec()
}

fn kind<T>(done: io::Result<T>) -> Option<ErrorKind> {
    done.err().map(|error| error.kind())
}

fn files_hold_what_is_appended(disk: &dyn Disk, folder: &Path) {
    let path = folder.join("appended");
    let mut file = disk.create_new(&path).expect("a file is made");
    assert_eq!(read(disk, &path), b"");
    file.write_all(b"0123").expect("it is written");
    assert_eq!(read(disk, &path), b"0123", "seen before it is synced");
    file.sync().expect("it is synced");
    file.write_all(b"").expect("nothing is written");
    file.write_all(b"456789").expect("more is written");
    drop(file);
    assert_eq!(read(disk, &path), b"0123456789");
    let Metadata { is_dir, len, .. } = disk.metadata(&path).expect("it is there");
    assert_eq!((is_dir, len), (false, 10));
    for (range, want) in [
        (0..4, &b"0123"[..]),
        (3..5, b"34"),
        (8..99, b"89"),
        (10..12, b""),
        (u64::MAX - 1..u64::MAX, b""),
        (4..4, b""),
    ] {
        let part = disk.read(&path, Some(range.clone()));
        assert_eq!(part.expect("a part is read"), want, "{range:?}");
    }
}

fn names_are_given_once(disk: &dyn Disk, folder: &Path) {
    let (file, dir) = (folder.join("once"), folder.join("once.d"));
    write(disk, &file, b"first");
    disk.create_dir(&dir).expect("a folder is made");
    for there in [&file, &dir] {
        let again = kind(disk.create_new(there));
        assert_eq!(again, Some(ErrorKind::AlreadyExists));
        let again = kind(disk.create_dir(there));
        assert_eq!(again, Some(ErrorKind::AlreadyExists));
    }
    assert_eq!(read(disk, &file), b"first", "it is as it was");
    disk.remove_file(&file).expect("it is removed");
    write(disk, &file, b"second");
    assert_eq!(read(disk, &file), b"second");
}

fn renamed_files_take_the_place_of_others(disk: &dyn Disk, folder: &Path) {
    let [from, to, dir] = ["from", "to", "into"].map(|name| folder.join(name));
    disk.create_dir(&dir).expect("a folder is made");
    write(disk, &from, b"new");
    write(disk, &to, b"old, and longer");
    disk.rename(&from, &to).expect("it is renamed");
    assert_eq!(read(disk, &to), b"new");
    assert_eq!(kind(disk.read(&from, None)), Some(ErrorKind::NotFound));
    // Onto itself: nothing happens.
    disk.rename(&to, &to).expect("it is called so");
    assert_eq!(read(disk, &to), b"new");
    let below = dir.join("below");
    disk.rename(&to, &below).expect("into another folder");
    assert_eq!(read(disk, &below), b"new");
    assert_eq!(kind(disk.metadata(&to)), Some(ErrorKind::NotFound));
    // Onto a folder: neither changes.
    assert!(disk.rename(&below, &dir).is_err());
    assert_eq!(read(disk, &below), b"new");
    // A folder keeps what is in it.
    let moved = folder.join("moved");
    disk.rename(&dir, &moved).expect("a folder is renamed");
    assert_eq!(read(disk, &moved.join("below")), b"new");
    assert_eq!(names(disk, &moved), [("below".to_owned(), false)]);
    assert_eq!(kind(disk.rename(&dir, &to)), Some(ErrorKind::NotFound));
}

fn new_names_are_given_once(disk: &dyn Disk, folder: &Path) {
    let [from, to, dir] = ["new.from", "new.to", "new.d"].map(|name| folder.join(name));
    write(disk, &from, b"first");
    disk.rename_new(&from, &to).expect("nothing has that name");
    assert_eq!(read(disk, &to), b"first");
    assert_eq!(kind(disk.read(&from, None)), Some(ErrorKind::NotFound));
    write(disk, &from, b"second");
    disk.create_dir(&dir).expect("a folder is made");
    for there in [&to, &dir] {
        let again = kind(disk.rename_new(&from, there));
        assert_eq!(again, Some(ErrorKind::AlreadyExists));
        assert_eq!(read(disk, &from), b"second", "it is as it was");
    }
    assert_eq!(read(disk, &to), b"first", "it is as it was");
}

fn open_files_outlive_their_names(disk: &dyn Disk, folder: &Path) {
    let [path, other] = ["open", "open.other"].map(|name| folder.join(name));
    let mut file = disk.create_new(&path).expect("a file is made");
    file.write_all(b"1").expect("it is written");
    disk.rename(&path, &other).expect("it is renamed");
    file.write_all(b"2").expect("it is still written");
    assert_eq!(read(disk, &other), b"12");
    disk.remove_file(&other).expect("it is removed");
    file.write_all(b"3").expect("also without a name");
    file.sync().expect("also without a name");
    write(disk, &path, b"another");
    file.write_all(b"4").expect("also beside another");
    drop(file);
    assert_eq!(read(disk, &path), b"another");
    assert_eq!(kind(disk.read(&other, None)), Some(ErrorKind::NotFound));
}

fn locked_files_stay(disk: &dyn Disk, folder: &Path) {
    let path = folder.join("locked");
    let mut file = disk.create_new(&path).expect("a file is made");
    file.lock();
    disk.remove_if_unlocked(&path).expect("it is left alone");
    file.write_all(b"x").expect("it is written");
    assert_eq!(read(disk, &path), b"x", "somebody has it");
    drop(file);
    disk.remove_if_unlocked(&path).expect("it is removed");
    assert_eq!(kind(disk.metadata(&path)), Some(ErrorKind::NotFound));
    let again = kind(disk.remove_if_unlocked(&path));
    assert_eq!(again, Some(ErrorKind::NotFound));
}

fn folders_hold_what_is_in_them(disk: &dyn Disk, folder: &Path) {
    let outer = folder.join("outer");
    let inner = outer.join("inner");
    disk.create_dir(&outer).expect("a folder is made");
    disk.create_dir(&inner).expect("another in it");
    write(disk, &outer.join("b"), b"b");
    write(disk, &inner.join("a"), b"a");
    let listed = names(disk, &outer);
    assert_eq!(
        listed,
        [("b".to_owned(), false), ("inner".to_owned(), true)]
    );
    assert_eq!(names(disk, &inner), [("a".to_owned(), false)]);
    assert!(disk.metadata(&outer).expect("it is there").is_dir);
    for synced in [&inner, &outer] {
        disk.sync_dir(synced).expect("a folder is synced");
    }
    let id = |path: &Path| disk.folder_id(path).expect("it is there");
    assert_eq!(id(&outer), id(&outer), "a folder stays the same");
    assert!(id(&outer).is_none() || id(&outer) != id(&inner));
    let before = id(&inner);
    let moved = outer.join("moved");
    disk.rename(&inner, &moved).expect("a folder is renamed");
    assert_eq!(id(&moved), before, "also by another name");
}

fn what_is_not_there_is_not_found(disk: &dyn Disk, folder: &Path) {
    let (none, below) = (folder.join("none"), folder.join("none/below"));
    for path in [&none, &below] {
        let asked = [
            kind(disk.read(path, None)),
            kind(disk.metadata(path)),
            kind(disk.folder_id(path)),
            kind(disk.read_dir(path)),
            kind(disk.sync_dir(path)),
            kind(disk.remove_file(path)),
            kind(disk.remove_if_unlocked(path)),
            kind(disk.rename(path, &folder.join("to"))),
        ];
        assert_eq!(asked, [Some(ErrorKind::NotFound); 8], "{}", path.display());
    }
    let made = [kind(disk.create_new(&below)), kind(disk.create_dir(&below))];
    assert_eq!(made, [Some(ErrorKind::NotFound); 2], "folders are not made");
    assert_eq!(kind(disk.metadata(&none)), Some(ErrorKind::NotFound));
}

fn files_are_no_folders(disk: &dyn Disk, folder: &Path) {
    let (file, dir) = (folder.join("file"), folder.join("dir"));
    write(disk, &file, b"file");
    disk.create_dir(&dir).expect("a folder is made");
    let below = file.join("below");
    let asked = [
        kind(disk.read_dir(&file)),
        kind(disk.create_new(&below)),
        kind(disk.create_dir(&below)),
        kind(disk.metadata(&below)),
        kind(disk.read(&below, None)),
        kind(disk.rename(&file, &below)),
    ];
    assert_eq!(asked, [Some(ErrorKind::NotADirectory); 6]);
    assert!(disk.read(&dir, None).is_err(), "a folder has no bytes");
    assert!(disk.remove_file(&dir).is_err(), "a folder is no file");
    assert!(disk.metadata(&dir).is_ok_and(|there| there.is_dir));
    assert_eq!(read(disk, &file), b"file");
}

#[cfg(test)]
mod tests {
    use std::ops::Range;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use bytes::Bytes;

    use super::super::{Crash, DirEntry, FolderId, OpenFile, SimulatedDisk, SystemDisk};
    use super::*;

    #[test]
    fn the_systems_disk_conforms() {
        let folder = tempfile::tempdir().unwrap();
        check(&SystemDisk, folder.path());
    }

    #[test]
    fn the_simulated_disk_conforms() {
        let disk = SimulatedDisk::new();
        disk.create_dir(Path::new("folder")).unwrap();
        check(&disk, Path::new("folder"));
        // What is left after a power cut is a disk, too.
        let left = SimulatedDisk::new().after_crash(&mut Crash::new(1));
        check(&left, Path::new(""));
    }

    /// What is wrong with a [`Wrong`] disk.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    enum Fault {
        CreatesOver,
        MakesFolders,
        RenameLeaves,
        RenameLosesItself,
        RenameNewReplaces,
        RemovesLocked,
        IgnoresRanges,
        ListsFilesAsFolders,
        SyncsAbsent,
        FoldersAlike,
        FilesAreFolders,
    }

    #[derive(Debug)]
    struct Wrong {
        disk: SimulatedDisk,
        fault: Fault,
    }

    impl Wrong {
        fn has(&self, fault: Fault) -> bool {
            self.fault == fault
        }
    }

    impl Disk for Wrong {
        fn create_new(&self, path: &Path) -> io::Result<Box<dyn OpenFile>> {
            if self.has(Fault::CreatesOver) {
                let _ = self.disk.remove_file(path);
            }
            if self.has(Fault::MakesFolders)
                && let Some(folder) = path.parent()
            {
                let _ = self.disk.create_dir(folder);
            }
            self.disk.create_new(path)
        }

        fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
            if from == to {
                return match self.has(Fault::RenameLosesItself) {
                    true => self.disk.remove_file(from),
                    false => self.disk.rename(from, to),
                };
            }
            let bytes = self.disk.read(from, None);
            self.disk.rename(from, to)?;
            if self.has(Fault::RenameLeaves)
                && let Ok(bytes) = bytes
            {
                write(&self.disk, from, &bytes);
            }
            Ok(())
        }

        fn rename_new(&self, from: &Path, to: &Path) -> io::Result<()> {
            match self.has(Fault::RenameNewReplaces) {
                true => self.disk.rename(from, to),
                false => self.disk.rename_new(from, to),
            }
        }

        fn remove_file(&self, path: &Path) -> io::Result<()> {
            self.disk.remove_file(path)
        }

        fn remove_if_unlocked(&self, path: &Path) -> io::Result<()> {
            match self.has(Fault::RemovesLocked) {
                true => self.disk.remove_file(path),
                false => self.disk.remove_if_unlocked(path),
            }
        }

        fn create_dir(&self, path: &Path) -> io::Result<()> {
            self.disk.create_dir(path)
        }

        fn sync_dir(&self, path: &Path) -> io::Result<()> {
            match self.has(Fault::SyncsAbsent) {
                true => Ok(()),
                false => self.disk.sync_dir(path),
            }
        }

        fn metadata(&self, path: &Path) -> io::Result<Metadata> {
            self.disk.metadata(path)
        }

        fn folder_id(&self, path: &Path) -> io::Result<Option<FolderId>> {
            let id = self.disk.folder_id(path)?;
            let one = FolderId {
                device: 0,
                number: 1,
            };
            Ok(id.map(|id| {
                if self.has(Fault::FoldersAlike) {
                    one
                } else {
                    id
                }
            }))
        }

        fn read_dir(&self, path: &Path) -> io::Result<Vec<DirEntry>> {
            match self.disk.read_dir(path) {
                Err(_) if self.has(Fault::FilesAreFolders) && self.disk.metadata(path).is_ok() => {
                    Ok(Vec::new())
                }
                Ok(mut entries) if self.has(Fault::ListsFilesAsFolders) => {
                    entries.iter_mut().for_each(|entry| entry.is_dir = true);
                    Ok(entries)
                }
                entries => entries,
            }
        }

        fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Bytes> {
            let range = range.filter(|_| !self.has(Fault::IgnoresRanges));
            self.disk.read(path, range)
        }
    }

    #[test]
    fn disks_that_are_wrong_are_noticed() {
        for fault in [
            Fault::CreatesOver,
            Fault::MakesFolders,
            Fault::RenameLeaves,
            Fault::RenameLosesItself,
            Fault::RenameNewReplaces,
            Fault::RemovesLocked,
            Fault::IgnoresRanges,
            Fault::ListsFilesAsFolders,
            Fault::SyncsAbsent,
            Fault::FoldersAlike,
            Fault::FilesAreFolders,
        ] {
            let disk = SimulatedDisk::new();
            let wrong = AssertUnwindSafe(Wrong { disk, fault });
            let checked = catch_unwind(|| check(&*wrong, Path::new("")));
            assert!(checked.is_err(), "{fault:?} is not noticed");
        }
    }
}
