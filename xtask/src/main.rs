//! Makes the browser application's files out of its compiled module.
//!
//! `xtask bundle MODULE PAGE OUT` reads the WebAssembly module MODULE, writes the module and its
//! JavaScript bindings into OUT, and copies the files of the folder PAGE (the HTML) beside them.
//! The binding generator is a library here, not an installed program: the lock file holds it to
//! the version of `wasm-bindgen` that the module was compiled with, and any other would refuse.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use wasm_bindgen_cli_support::Bindgen;

fn main() -> Result<()> {
    let arguments: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    match arguments.as_slice() {
        [command, module, page, out] if command.as_os_str() == "bundle" => {
            bundle(module, page, out)
        }
        _ => bail!("usage: xtask bundle MODULE PAGE OUT"),
    }
}

/// Replaces the folder `out` by a new bundle. It is made beside its place and moved in whole, so
/// that a build that embeds `out` never sees half of one.
fn bundle(module: &Path, page: &Path, out: &Path) -> Result<()> {
    let new = out.with_extension("new");
    remove_if_there(&new)?;
    fs::create_dir_all(&new).with_context(|| format!("cannot create {}", new.display()))?;
    Bindgen::new()
        .input_path(module)
        .out_name("saccade_view")
        .web(true)?
        .typescript(false)
        .omit_default_module_path(false)
        .remove_name_section(true)
        .remove_producers_section(true)
        .generate(&new)
        .with_context(|| format!("cannot make the bindings of {}", module.display()))?;
    copy_files(page, &new)?;
    remove_if_there(out)?;
    fs::rename(&new, out).with_context(|| format!("cannot move the bundle to {}", out.display()))
}

fn remove_if_there(folder: &Path) -> Result<()> {
    if folder.exists() {
        fs::remove_dir_all(folder)
            .with_context(|| format!("cannot remove the old {}", folder.display()))?;
    }
    Ok(())
}

/// Copies the files of `from`, which holds no folders.
fn copy_files(from: &Path, to: &Path) -> Result<()> {
    let entries = fs::read_dir(from)
        .with_context(|| format!("cannot read the page in {}", from.display()))?;
    for entry in entries {
        let path = entry?.path();
        let name = path.file_name().context("a folder entry has a name")?;
        fs::copy(&path, to.join(name))
            .with_context(|| format!("cannot copy {}", path.display()))?;
    }
    Ok(())
}
