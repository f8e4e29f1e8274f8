//! Giving a file a name that nothing has.

use std::fs;
use std::io;
use std::path::Path;

/// Gives a file another name, unless something has that name.
///
/// Not all systems and file systems can do that in one step (NFS cannot), and not all of them know second names
/// (FAT does not): what one of them lacks the other has.
#[cfg(any(target_os = "linux", target_os = "macos"))]
pub(super) fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    use rustix::io::Errno;
    match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
        Err(Errno::INVAL | Errno::NOSYS | Errno::NOTSUP) => link_and_remove(from, to),
        renamed => Ok(renamed?),
    }
}

#[cfg(not(any(target_os = "linux", target_os = "macos")))]
pub(super) fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    link_and_remove(from, to)
}

fn link_and_remove(from: &Path, to: &Path) -> io::Result<()> {
    fs::hard_link(from, to)?;
    // It has its name. A temporary one that is left over is taken away like those of crashed writers.
    let _ = fs::remove_file(from);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_the_name_keeps_it() {
        for rename in [rename_new, link_and_remove] {
            let dir = tempfile::tempdir().unwrap();
            let [from, to] = ["from", "to"].map(|name| dir.path().join(name));
            fs::write(&from, "first").unwrap();
            rename(&from, &to).unwrap();
            assert!(!from.exists());
            fs::write(&from, "second").unwrap();
            for _ in 0..2 {
                let refused = rename(&from, &to).unwrap_err();
                assert_eq!(refused.kind(), io::ErrorKind::AlreadyExists);
                assert_eq!(fs::read(&to).unwrap(), b"first");
                assert_eq!(fs::read(&from).unwrap(), b"second");
            }
            // A folder has it, too.
            fs::remove_file(&to).unwrap();
            fs::create_dir(&to).unwrap();
            let refused = rename(&from, &to).unwrap_err();
            assert_eq!(refused.kind(), io::ErrorKind::AlreadyExists);
        }
    }
}
