//! A sync of the catalog fails, once: the volume stops rather than pretends, and nothing is lost.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::{done, run, saccade, simulate, stderr};

/// A library that makes a sync fail.
fn shim(folder: &Path) -> PathBuf {
    let library = folder.join("failed_sync.so");
    let source = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/command_line/failed_sync.c"
    );
    let mut compile = Command::new("cc");
    compile.args(["-shared", "-fPIC", source, "-ldl", "-o"]);
    let compiled = compile.arg(&library).status().unwrap();
    assert!(compiled.success());
    library
}

#[cfg(target_os = "linux")]
#[test]
fn the_volume_stops_and_goes_on_whole() {
    let folder = tempfile::tempdir().unwrap();
    let shim = shim(folder.path());
    let acquisition = folder.path().join("acquisition");
    simulate(&acquisition, "150,130,12");
    let count = folder.path().join("count");
    let ingest = |archive: &Path, file: &str, number: u32| {
        std::fs::write(&count, "").unwrap();
        let mut command = saccade();
        command.arg("ingest").args([&acquisition, archive]);
        command.args(["--once", "--lossless"]);
        command.env("LD_PRELOAD", &shim);
        command.env("FAILED_SYNC_FILE", file);
        command.env("FAILED_SYNC_NUMBER", number.to_string());
        command.env("FAILED_SYNC_COUNT", &count);
        command.output().unwrap()
    };
    let synced = || u32::try_from(std::fs::metadata(&count).unwrap().len()).unwrap();
    for file in ["/catalog.sqlite-wal", "/catalog.sqlite"] {
        let archive = folder.path().join("never");
        let never = ingest(&archive, file, 0);
        assert!(never.status.success(), "{}", stderr(&never));
        std::fs::remove_dir_all(archive).unwrap();
        let syncs = synced();
        assert!(syncs > 2, "{syncs} syncs of {file}");
        // The last one of the file comes with closing, when all is acknowledged and stays in the log.
        for number in [1, 2, syncs / 2, syncs - 2] {
            let archive = folder.path().join(format!("archive{number}"));
            let mut number = number.max(1);
            let least = number.saturating_sub(6).max(1);
            let stopped = loop {
                let stopped = ingest(&archive, file, number);
                // Of a run that had less to sync than the first one, it may be the last.
                let is_last = synced() <= number;
                if !stopped.status.success() || !is_last || number == least {
                    break stopped;
                }
                std::fs::remove_dir_all(&archive).unwrap();
                number = number.saturating_sub(2).max(least);
            };
            let told = stderr(&stopped);
            let place = format!("{file}, sync {number} of {syncs}: {told}");
            assert_eq!(stopped.status.code(), Some(1), "{place}");
            assert!(told.contains("could not be made durable"), "{place}");
            assert!(told.contains("start again"), "{place}");
            let again = ingest(&archive, file, 0);
            assert!(again.status.success(), "{place}, then {}", stderr(&again));
            let text = archive.to_str().unwrap();
            let checked = run(["check", text]);
            assert!(
                checked.status.success(),
                "{place}, then {}",
                stderr(&checked)
            );
            done([
                "export",
                text,
                folder.path().join("image").to_str().unwrap(),
            ]);
            std::fs::remove_dir_all(folder.path().join("image")).unwrap();
            std::fs::remove_dir_all(archive).unwrap();
        }
    }
}
