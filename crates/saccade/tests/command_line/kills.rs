//! `kill -9` at random moments of those who write what ingest takes in, and of those who show what it made.
//!
//! How often is said by `SACCADE_TEST_KILLS`, when by `SACCADE_TEST_SEED`. Each time the program is started again as if nothing had happened; what it
//! has made in the end is what one that nobody disturbed makes. Ingest itself is killed by the tests of its crate.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use saccade_archive::acquisition::{Cursor, Record, RecordReader};

use super::errors::text;
use super::{Running, done, saccade};

pub(super) fn kills() -> u32 {
    let said = std::env::var("SACCADE_TEST_KILLS").ok();
    said.map_or(6, |n| n.parse().expect("SACCADE_TEST_KILLS is a number"))
}

/// The seed of a test, another one with each `SACCADE_TEST_SEED`.
fn drawn(seed: u64) -> u64 {
    let said = std::env::var("SACCADE_TEST_SEED").ok();
    let said = said.map_or(0, |n| n.parse().expect("SACCADE_TEST_SEED is a number"));
    seed ^ u64::wrapping_mul(said, 0x9e37_79b9_7f4a_7c15)
}

/// A small generator, so that a failing run can be repeated.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Runs a program that ends on its own, and kills it before that. It adapts to the machine: kills come while it works.
pub(super) struct Killer {
    random: Random,
    longest: Duration,
    pub(super) kills: u32,
}

impl Killer {
    pub(super) fn new(seed: u64) -> Self {
        Self {
            random: Random(drawn(seed)),
            longest: Duration::from_millis(400),
            kills: 0,
        }
    }

    /// One life; whether it was killed, rather than done before.
    pub(super) fn life(&mut self, arguments: &[&str]) -> bool {
        let mut command = saccade();
        command.args(arguments).stderr(Stdio::null());
        let mut life = Running(command.spawn().unwrap());
        std::thread::sleep(self.longest.mul_f64(self.random.unit()));
        if let Some(status) = life.0.try_wait().unwrap() {
            assert!(status.success(), "it ends on its own: {status}");
            self.longest = self.longest.mul_f64(0.7);
            return false;
        }
        life.0.kill().unwrap();
        let killed = !life.0.wait().unwrap().success();
        self.kills += u32::from(killed);
        self.longest = self.longest.mul_f64(1.05);
        killed
    }

    /// The next ones shall live longer: this one had not begun with its work.
    pub(super) fn was_early(&mut self) {
        self.longest = self.longest.mul_f64(1.5);
    }

    /// Whether there are to be more lives: until as many were ended as there should be, some of them while they worked.
    pub(super) fn goes_on(&self, in_the_middle: u32) -> bool {
        self.kills < kills() || (in_the_middle == 0 && self.kills < 20 * kills())
    }
}

/// Files below a folder, and what is in them.
pub(super) fn tree(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut files, mut open) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(at) = open.pop() {
        let Ok(entries) = fs::read_dir(&at) else {
            continue;
        };
        for entry in entries.map(Result::unwrap) {
            match entry.file_type().unwrap().is_dir() {
                true => open.push(entry.path()),
                false => {
                    let name = entry.path().strip_prefix(folder).unwrap().to_owned();
                    files.insert(name, fs::read(entry.path()).unwrap());
                }
            }
        }
    }
    files
}

/// An exported image: as its files, but of shards the chunks in the order of their index, for they lie there in the order
/// in which they got ready.
pub(super) fn image(mut files: BTreeMap<PathBuf, Vec<u8>>) -> BTreeMap<PathBuf, Vec<u8>> {
    let shape = |value: &serde_json::Value| -> u64 {
        let sides = value.as_array().unwrap().iter();
        sides.map(|side| side.as_u64().unwrap()).product()
    };
    let levels: Vec<PathBuf> = { files.keys() }
        .filter(|name| name.ends_with("zarr.json") && name.components().count() == 2)
        .cloned()
        .collect();
    for description in levels {
        let json: serde_json::Value = serde_json::from_slice(&files[&description]).unwrap();
        let of_shard = shape(&json["chunk_grid"]["configuration"]["chunk_shape"]);
        let sharding = &json["codecs"][0];
        assert_eq!(sharding["name"], "sharding_indexed");
        let chunks = of_shard / shape(&sharding["configuration"]["chunk_shape"]);
        let level = description.parent().unwrap().join("c");
        for (_, shard) in files
            .iter_mut()
            .filter(|(name, _)| name.starts_with(&level))
        {
            // At the end, with a checksum of its own.
            let index = shard.len() - 4 - usize::try_from(16 * chunks).unwrap();
            let places = shard[index..shard.len() - 4].as_chunks::<8>().0;
            let mut sorted = Vec::new();
            for place in places.chunks(2) {
                let [at, len] = [place[0], place[1]].map(u64::from_le_bytes);
                sorted.extend(len.to_le_bytes());
                if at != u64::MAX {
                    let at = usize::try_from(at).unwrap();
                    let len = usize::try_from(len).unwrap();
                    sorted.extend(&shard[at..at + len]);
                }
            }
            *shard = sorted;
        }
    }
    files
}

fn tissue<'a>(out: &'a Path, extent: &'a str) -> Vec<&'a str> {
    let tissue = ["simulate", text(out), "--phantom", "--extent", extent];
    let tiles = [
        "--voxel-nm",
        "16,16,40",
        "--tile",
        "128x128",
        "--rate",
        "max",
    ];
    [&tissue[..], &tiles[..]].concat()
}

#[test]
fn a_killed_simulator_goes_on_and_records_only_whole_images() {
    let folder = tempfile::tempdir().unwrap();
    let [undisturbed, out] = ["undisturbed", "out"].map(|name| folder.path().join(name));
    let extent = "500,400,24";
    done(tissue(&undisturbed, extent));
    let want = tree(&undisturbed);
    let records = |folder: &Path| -> Vec<Record> {
        let lines = RecordReader::new(folder, Cursor::default()).read(usize::MAX);
        let lines = lines.unwrap().into_iter();
        lines.map(|line| line.record.unwrap()).collect()
    };
    let names = |folder: &Path| -> BTreeSet<String> {
        let tile = |record| match record {
            Record::Tile(tile) => Some(tile.file),
            Record::Transform(_) | Record::Delete(_) => None,
        };
        records(folder).into_iter().filter_map(tile).collect()
    };
    let mut killer = Killer::new(0x5acc_0001);
    let (mut before, mut in_the_middle) = (BTreeSet::new(), 0);
    while killer.kills < kills() {
        let killed = killer.life(&tissue(&out, extent));
        let now = names(&out);
        assert!(now.is_superset(&before), "what was recorded stays");
        for file in &now {
            let image = fs::read(out.join(file)).unwrap();
            assert!(image == want[Path::new(file)], "{file} is not whole");
        }
        in_the_middle += usize::from(killed && !now.is_empty());
        before = now;
        if !killed {
            assert_eq!(before, names(&undisturbed));
            fs::remove_dir_all(&out).unwrap();
            before.clear();
        }
    }
    done(tissue(&out, extent));
    assert!(records(&out) == records(&undisturbed), "other records");
    let got = tree(&out);
    assert!(got.keys().eq(want.keys()), "{:?}", got.keys());
    assert!(got == want, "other files");
    assert!(in_the_middle > 0, "no kill came while it worked");
}

#[test]
fn a_killed_export_goes_on_and_is_no_image_before_it_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let [acquisition, archive] = ["acquisition", "archive"].map(|name| folder.path().join(name));
    let [undisturbed, out] = ["undisturbed.zarr", "out.zarr"].map(|name| folder.path().join(name));
    done(tissue(&acquisition, "500,400,48"));
    done(["ingest", text(&acquisition), text(&archive), "--once"]);
    done(["export", text(&archive), text(&undisturbed)]);
    let want = image(tree(&undisturbed));
    assert!(want.len() > 5, "{:?}", want.keys());
    let mut killer = Killer::new(0x5acc_0002);
    let mut in_the_middle = 0;
    while killer.kills < kills() {
        let killed = killer.life(&["export", text(&archive), text(&out)]);
        let half = out.join("export.json").exists();
        in_the_middle += usize::from(killed && half);
        // What makes it an image comes last, and what says that it is not whole goes after that.
        if out.join("zarr.json").exists() {
            let mut got = image(tree(&out));
            got.remove(Path::new("export.json"));
            assert!(got == want, "it says that it is whole");
            fs::remove_dir_all(&out).unwrap();
        } else if half {
            let other = folder.path().join("other");
            let shown = saccade()
                .args(["export", text(&out), text(&other)])
                .output();
            let said = String::from_utf8_lossy(&shown.unwrap().stderr).into_owned();
            assert!(
                said.contains("not whole yet"),
                "half of it is offered: {said}"
            );
            assert!(!other.exists());
        }
    }
    done(["export", text(&archive), text(&out)]);
    let got = image(tree(&out));
    let of = |files: &BTreeMap<PathBuf, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(of(&got), of(&want));
    assert!(got == want, "other voxels");
    assert!(in_the_middle > 0, "no kill came while it worked");
}

/// Its memory on disk is what a kill could leave half of.
#[test]
fn a_killed_server_shows_nothing_half_written() {
    let folder = tempfile::tempdir().unwrap();
    let [acquisition, archive, cache] =
        ["acquisition", "archive", "cache"].map(|name| folder.path().join(name));
    done(tissue(&acquisition, "500,400,48"));
    done(["ingest", text(&acquisition), text(&archive), "--once"]);
    let start = |cached: bool| {
        let mut command = saccade();
        command.args(["serve", text(&archive), "--port", "0"]);
        if cached {
            command.args(["--disk-cache", text(&cache)]);
        }
        Running::start(command.stderr(Stdio::null()))
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let get = |url: &str, chunk: &str| {
        let url = format!("{}/v/phantom/zarr/{chunk}", url.trim_end_matches('/'));
        runtime.block_on(async {
            let answer = reqwest::get(url).await.ok()?;
            let status = answer.status().as_u16();
            // One that breaks off is an error.
            Some((status, answer.bytes().await.ok()?.to_vec()))
        })
    };
    let chunks: Vec<String> = (0..48)
        .map(|n| format!("0/c/0/{}/{}/{}", n % 2, n / 2 % 4, n / 8))
        .collect();
    let want: BTreeMap<_, _> = {
        let (_running, url) = start(false);
        let chunks = chunks.iter();
        let got = chunks.map(|chunk| (chunk, get(&url, chunk).unwrap()));
        got.collect()
    };
    let there = want.values().filter(|(status, _)| *status == 200).count();
    assert!(there > 10, "{there} chunks with voxels");
    let mut random = Random(drawn(0x5acc_0003));
    let (whole, broken) = (AtomicUsize::new(0), AtomicUsize::new(0));
    for _ in 0..kills() {
        let (mut running, url) = start(true);
        let ended = AtomicBool::new(false);
        std::thread::scope(|scope| {
            for reader in 0..3 {
                let (url, ended, chunks, want) = (&url, &ended, &chunks, &want);
                let (get, whole, broken) = (&get, &whole, &broken);
                scope.spawn(move || {
                    for chunk in chunks.iter().cycle().skip(reader * 7) {
                        if ended.load(Ordering::Relaxed) {
                            return;
                        }
                        match get(url, chunk) {
                            // In its own time.
                            Some((503, _)) => {}
                            Some(got) => {
                                assert!(got == want[chunk], "{chunk} is another: {}", got.0);
                                whole.fetch_add(1, Ordering::Relaxed);
                            }
                            None => _ = broken.fetch_add(1, Ordering::Relaxed),
                        }
                    }
                });
            }
            // After some more chunks, on slow machines as on fast ones; or at once.
            let some = Duration::from_secs(60).mul_f64(random.unit()).as_secs();
            let more = whole.load(Ordering::Relaxed) + usize::try_from(some).unwrap();
            for _ in 0..600 {
                if whole.load(Ordering::Relaxed) >= more {
                    break;
                }
                std::thread::sleep(Duration::from_millis(10));
            }
            running.0.kill().unwrap();
            running.0.wait().unwrap();
            ended.store(true, Ordering::Relaxed);
        });
    }
    let whole = whole.into_inner();
    assert!(whole > 0 && broken.into_inner() > 0, "{whole} chunks came");
    let (_running, url) = start(true);
    for (chunk, want) in want {
        assert!(
            get(&url, chunk).unwrap() == want,
            "{chunk} is another after all"
        );
    }
}
