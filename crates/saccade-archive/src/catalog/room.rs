//! Whether the disk of the catalog's own file is full, for who sees that nothing is written and is told nothing.

use std::path::Path;

use super::{Catalog, CatalogLocation};

/// Less than a small change of a catalog takes \[bytes\].
const LEAST: u64 = 256 << 10;

impl Catalog {
    /// What holds up all who write to the catalog, if no space is left for it: they cannot note it there, nor that they live, nor
    /// even that they have begun. `None` where there is space, and with PostgreSQL, whose server has its own way to say so.
    pub fn held_up_for_space(&self) -> Option<String> {
        let CatalogLocation::File(file) = self.location() else {
            return None;
        };
        free(file).filter(|free| *free < LEAST).map(|_| {
            format!(
                "no space is left for the catalog, and nothing is taken in; free some, and it goes on: {}",
                file.display()
            )
        })
    }
}

/// Bytes that this process could write beside a file, if the system says so; none where nobody can write anything.
fn free(file: &Path) -> Option<u64> {
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty());
    let disk = rustix::fs::statvfs(folder.unwrap_or(Path::new("."))).ok()?;
    if disk.f_flag.contains(rustix::fs::StatVfsMountFlags::RDONLY) {
        return None;
    }
    // Some is kept for the system's own user.
    let blocks = if rustix::process::geteuid().is_root() {
        disk.f_bfree
    } else {
        disk.f_bavail
    };
    Some(blocks.saturating_mul(disk.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn where_there_is_space_nobody_is_held_up_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("catalog.sqlite");
        let catalog = Catalog::create(&file).await.unwrap();
        assert!(free(&file).unwrap() >= LEAST);
        assert_eq!(catalog.held_up_for_space(), None);
        assert_eq!(free(&folder.path().join("gone/catalog.sqlite")), None);
    }
}
