//! The program as people run it.

#![expect(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod answers;
mod catalog_replaced;
mod damaged_tiles;
mod demo;
mod errors;
mod export_power_cuts;
mod failed_sync;
mod failing_volume;
#[cfg(target_os = "linux")]
mod full_disk;
mod images;
mod interrupted;
mod kills;
mod kills_of_changes;
mod labels;
mod list_channels;
mod lists;
mod magnifications;
mod no_effect;
mod no_files;
#[allow(dead_code, reason = "others use more of it")]
#[path = "../../../saccade-archive/tests/support/postgres.rs"]
mod postgres;
mod server_away;
mod store_away;
mod update;
mod whole_way;

use std::ffi::OsStr;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

/// The program, with nothing of the surroundings that could change what it does.
fn saccade() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_saccade"));
    command
        .env_remove("DISPLAY")
        .env_remove("WAYLAND_DISPLAY")
        .env_remove("SACCADE_LOG");
    command.stdin(Stdio::null());
    command
}

fn run<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Output {
    saccade().args(arguments).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Runs what should succeed.
fn done<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Output {
    let output = run(arguments);
    assert!(output.status.success(), "{}", stderr(&output));
    output
}

/// Ends a program that was started, whatever becomes of the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

impl Running {
    /// Starts something that prints an address first.
    fn start(command: &mut Command) -> (Self, String) {
        use std::io::BufRead;
        // For those who go on to ask it.
        saccade_archive::tls::provide();
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let stdout = child.stdout.take().unwrap();
        let running = Self(child);
        let mut url = String::new();
        std::io::BufReader::new(stdout).read_line(&mut url).unwrap();
        assert!(url.starts_with("http://127.0.0.1:"), "{url:?}");
        (running, url.trim().to_owned())
    }
}

/// A small acquisition archive.
fn simulate(folder: &Path, extent: &str) {
    let folder = folder.to_str().unwrap();
    let tissue = [
        "simulate",
        folder,
        "--phantom",
        "--extent",
        extent,
        "--voxel-nm",
        "16,16,40",
    ];
    done(
        tissue
            .into_iter()
            .chain(["--tile", "64x64", "--rate", "max"]),
    );
}

/// A small visualization archive.
fn archive(folder: &Path) -> String {
    simulate(&folder.join("acquisition"), "150,130,12");
    let archive = folder.join("archive").to_str().unwrap().to_owned();
    let acquisition = folder.join("acquisition");
    done([
        "ingest",
        acquisition.to_str().unwrap(),
        &archive,
        "--once",
        "--lossless",
    ]);
    archive
}
