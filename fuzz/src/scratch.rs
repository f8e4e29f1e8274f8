//! Folders for readers that want files.

use std::fs;
use std::path::{Path, PathBuf};

/// A folder for one run of a target; gone when it is dropped.
pub struct Scratch(PathBuf);

impl Scratch {
    /// An empty one. Targets run one after the other.
    pub fn new(target: &str) -> Self {
        let name = format!("saccade-fuzz-{}-{target}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        fs::create_dir_all(&folder).expect("a folder for temporary files");
        Self(folder)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file into it, and the folders above.
    pub fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        let folder = path.parent().expect("it lies in a folder");
        fs::create_dir_all(folder).expect("a folder in the folder");
        fs::write(&path, bytes).expect("a temporary file");
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // What is left is for whoever clears temporary files.
        let _ = fs::remove_dir_all(&self.0);
    }
}
