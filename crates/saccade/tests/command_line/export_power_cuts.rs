//! Power cuts while a volume is exported to a simulated disk, which may lose any part of what was not synced: what says that
//! it is whole is, and the export goes on with what is left.
//!
//! `SACCADE_CRASH_SEED=SEED` repeats a run.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::path::PathBuf;
use std::pin::pin;
use std::sync::Arc;

use futures::FutureExt as _;
use futures::future::{Either, select};
use saccade_archive::VisualizationArchive;
use saccade_archive::storage::{Crash, LocalStorage, MemoryStorage, SimulatedDisk, Storage};
use saccade_source::VolumeSource;
use saccade_source::export::{ExportOptions, UNFINISHED, export};
use saccade_source::stitched::{StitchedOptions, StitchedSource};

use super::archive;
use super::kills::image;

/// Exports that are lived through from the first power cut to their end.
const HISTORIES: u64 = 12;
/// States looked at after each power cut.
const STATES: u64 = 25;
const ROOT: &str = "image";

async fn files(storage: &dyn Storage) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for name in storage.list("").await.unwrap() {
        let bytes = storage.read(&name, None).await.unwrap();
        files.insert(PathBuf::from(name), bytes.to_vec());
    }
    files
}

fn on(disk: &SimulatedDisk) -> LocalStorage {
    LocalStorage::on(Arc::new(disk.clone()), ROOT).unwrap()
}

#[test]
fn what_says_that_it_is_whole_is_whole_after_any_power_cut() {
    let asked = std::env::var("SACCADE_CRASH_SEED").ok();
    let asked = asked.map(|text| text.split(':').next().unwrap().parse().unwrap());
    let seed = asked.unwrap_or_else(|| RandomState::new().hash_one(0) % 1_000_000_000);
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(async {
        let archive = VisualizationArchive::open(std::path::Path::new(&archive))
            .await
            .unwrap();
        let options = StitchedOptions::default();
        let source = StitchedSource::open(&archive, "phantom", options)
            .await
            .unwrap();
        let source: Arc<dyn VolumeSource> = Arc::new(source);
        let options = ExportOptions::default();
        let undisturbed = MemoryStorage::new();
        export(&source, &undisturbed, &options, &|_| {})
            .await
            .unwrap();
        let want = image(files(&undisturbed).await);
        let (mut cuts, mut whole) = (0, 0);
        for history in 0..HISTORIES {
            let mut chance = seed.wrapping_mul(1_000_003).wrapping_add(history);
            let mut disk = SimulatedDisk::new();
            for life in 0.. {
                chance = chance
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1);
                disk.cut_power_at((chance >> 33) % if life < 5 { 40 } else { 1000 });
                let work = async {
                    let storage = LocalStorage::on(Arc::new(disk.clone()), ROOT).ok()?;
                    export(&source, &storage, &options, &|_| {}).await.ok()
                };
                // It may also end in the instant in which the power goes.
                let ended = match select(pin!(disk.power_is_off()), pin!(work)).await {
                    Either::Left(_) => false,
                    Either::Right((_, off)) => off.now_or_never().is_none(),
                };
                if ended {
                    disk.cut_power_at(1 << 40);
                    let got = image(files(&on(&disk)).await);
                    assert!(got == want, "history {history}; SACCADE_CRASH_SEED={seed}");
                }
                // The power may also go once it is done.
                cuts += u64::from(!ended);
                let mut next = None;
                for state in 0..STATES {
                    let left = disk.after_crash(&mut Crash::new(chance.wrapping_add(state)));
                    let there = files(&on(&left)).await;
                    let is = |name: &str| there.contains_key(std::path::Path::new(name));
                    if is("zarr.json") && !is(UNFINISHED) {
                        whole += 1;
                        let which = format!("life {life} of {history}, state {state}");
                        assert!(image(there) == want, "{which}; SACCADE_CRASH_SEED={seed}");
                    }
                    next = Some(left);
                }
                if ended {
                    break;
                }
                disk = next.expect("some states");
            }
        }
        assert!(cuts >= 2 * HISTORIES, "{cuts} power cuts");
        assert!(whole > 0, "none said that it is whole");
        let line =
            format!("{cuts} power cuts of exports, {whole} states that say that they are whole\n");
        std::io::Write::write_all(&mut std::io::stderr(), line.as_bytes()).unwrap();
    });
}
