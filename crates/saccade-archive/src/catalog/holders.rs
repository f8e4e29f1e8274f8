//! Which programs hold a file of SQLite's, for people who wonder why nothing goes on.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use super::sqlite::{FileId, log_of, shared_memory_of};

/// Times that the system is asked, until it names somebody.
const LOOKS: u32 = 5;

/// Other programs of this machine that have locked the file, or what SQLite keeps beside it, for writing, such as
/// `sqlite3 (process 17)`; none where the system does not tell.
pub(super) fn of(path: &Path) -> Vec<String> {
    let files = [path.to_owned(), log_of(path), shared_memory_of(path)];
    let inodes: Vec<u64> = { files.iter() }
        .filter_map(|file| FileId::of(file).ok())
        .map(|id| id.inode)
        .collect();
    // The system writes the list in pieces, and passes one over where others lock and unlock meanwhile.
    let listed = (0..LOOKS).map(|_| writers(&inodes));
    let holders = { listed }.find(|holders| !holders.is_empty());
    let name = |process: u32| {
        let name = fs::read_to_string(format!("/proc/{process}/comm")).unwrap_or_default();
        match name.trim() {
            "" => format!("process {process}"),
            name => format!("{name} (process {process})"),
        }
    };
    holders.into_iter().flatten().map(name).collect()
}

/// Other processes that have locked one of the files for writing, by what the system says now.
fn writers(inodes: &[u64]) -> BTreeSet<u32> {
    let locks = fs::read_to_string("/proc/locks").unwrap_or_default();
    { locks.lines() }
        .filter_map(writer)
        .filter(|(process, inode)| *process != std::process::id() && inodes.contains(inode))
        .map(|(process, _)| process)
        .collect()
}

/// The process that has a lock for writing, and the number of its file, from a line such as
/// `4: POSIX  ADVISORY  WRITE 17 fe:00:1234 120 120`.
fn writer(line: &str) -> Option<(u32, u64)> {
    let mut words = line.split_whitespace().skip(3);
    if words.next()? != "WRITE" {
        return None;
    }
    let process = words.next()?.parse().ok()?;
    let inode = words.next()?.rsplit(':').next()?.parse().ok()?;
    Some((process, inode))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn locks_are_read_as_the_system_writes_them() {
        for (line, holder) in [
            (
                "4: POSIX  ADVISORY  WRITE 17 fe:00:1234 120 120",
                Some((17, 1234)),
            ),
            ("5: POSIX  ADVISORY  READ 17 fe:00:1234 124 124", None),
            ("4: -> POSIX  ADVISORY  WRITE 18 fe:00:1234 120 120", None),
            ("", None),
            ("6: OFDLCK ADVISORY  WRITE -1 fe:00:9 0 EOF", None),
        ] {
            assert_eq!(writer(line), holder, "{line}");
        }
    }
}
