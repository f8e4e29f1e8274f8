//! Copies the browser bundle, where there is one, to where the embedding macro looks for it.

use std::path::{Path, PathBuf};
use std::{env, fs, io};

/// Names the folder of the browser bundle. Without it the crate builds with none.
const BUNDLE: &str = "SACCADE_WEB_DIR";

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed={BUNDLE}");
    let out = env::var_os("OUT_DIR").map(PathBuf::from);
    let embedded = out
        .ok_or_else(|| io::Error::other("OUT_DIR is not set"))?
        .join("web");
    if embedded.exists() {
        fs::remove_dir_all(&embedded)?;
    }
    fs::create_dir_all(&embedded)?;
    let Some(bundle) = env::var_os(BUNDLE).map(PathBuf::from) else {
        return Ok(());
    };
    println!("cargo::rerun-if-changed={}", bundle.display());
    if bundle.is_dir() {
        copy(&bundle, &embedded)
    } else {
        Ok(())
    }
}

fn copy(from: &Path, to: &Path) -> io::Result<()> {
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            fs::create_dir_all(&target)?;
            copy(&entry.path(), &target)?;
        } else {
            println!("cargo::rerun-if-changed={}", entry.path().display());
            fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}
