//! Power cuts while a list is followed, whose records are on a simulated disk, which may lose any part of what was not
//! synced: whatever is left, the next process makes of it what the list says, and what was synced stays.
//!
//! `SACCADE_CRASH_SEED=SEED` repeats a run.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::path::Path;

use saccade_archive::acquisition::{Cursor, Record, RecordReader};
use saccade_archive::storage::{Crash, Disk as _, SimulatedDisk};
use saccade_ingest::watch::{Disk, ListConfig, ListWatch};

use super::{Scope, roomy, write};
use crate::crashes::seed;

/// States looked at of each of the two times that records are written.
const STATES: u64 = 500;

/// What the records say of each tile in the end: its image, section and place.
type Said = BTreeMap<String, (String, u32, [f64; 6])>;

fn said(kept: &Path) -> Said {
    let mut said = Said::new();
    let lines = RecordReader::new(kept, Cursor::default()).read(usize::MAX);
    // A line of which a part was lost is none.
    for record in lines
        .unwrap()
        .into_iter()
        .filter_map(|line| line.record.ok())
    {
        match record {
            Record::Tile(tile) => {
                let place = (tile.file, tile.section, tile.transform.elements());
                said.insert(tile.tile, place);
            }
            Record::Transform(moved) => {
                if let Some(tile) = said.get_mut(&moved.tile) {
                    tile.2 = moved.transform.elements();
                }
            }
            Record::Delete(gone) => _ = said.remove(&gone.tile),
        }
    }
    said
}

/// Follows the list until nothing more is told.
fn tell(scope: &Scope, kept: &Path) {
    let config = ListConfig {
        rest: std::time::Duration::ZERO,
        drop_after: std::time::Duration::ZERO,
        ..roomy(&scope.file("list.txt"))
    };
    let mut watch = ListWatch::open(config, Disk, &scope.path(), kept).unwrap();
    let mut quiet = 0;
    while quiet < 3 {
        let (told, _) = watch.look().unwrap();
        quiet = if told == 0 { quiet + 1 } else { 0 };
    }
}

/// What a power cut leaves of a file of which so much is synced, and that many lines more are written.
fn left(synced: &[u8], more: &[&[u8]], crash: &mut Crash) -> Vec<u8> {
    let disk = SimulatedDisk::new();
    let file = Path::new("tiles.jsonl");
    let mut open = disk.create_new(file).unwrap();
    open.write_all(synced).unwrap();
    open.sync().unwrap();
    disk.sync_dir(Path::new("")).unwrap();
    for line in more {
        open.write_all(line).unwrap();
    }
    let left = disk.after_crash(crash).read(file, None).unwrap();
    left.to_vec()
}

#[test]
fn whatever_is_left_of_the_records_they_say_in_the_end_what_the_list_says() {
    let seed = seed();
    let line =
        format!("\nsimulated power cuts of records, SACCADE_CRASH_SEED={seed} repeats them\n");
    std::io::stderr().write_all(line.as_bytes()).unwrap();
    let scope = Scope::new();
    let names = ["a", "b", "c", "d", "e", "f"];
    for (seed, name) in (0..).zip(names) {
        scope.image(name, seed);
    }
    let list = scope.file("list.txt");
    let lists = [
        "a.tif 0 0 0\nb.tif 50 0 0\nc.tif 0 50 0\nd.tif 50 50 1\n",
        "a.tif 0 7 0\nb.tif 50 0 0\nd.tif 50 50 2\ne.tif 9 9 1\nf.tif 60 0 0\n",
    ];
    let file = |kept: &Path| kept.join(RecordReader::FILE);
    let mut whole = vec![Vec::new()];
    for text in lists {
        write(&list, text);
        tell(&scope, &scope.kept());
        whole.push(fs::read(file(&scope.kept())).unwrap());
    }
    let want = said(&scope.kept());
    assert_eq!(want.keys().collect::<Vec<_>>(), ["a", "b", "d", "e", "f"]);
    let stamps = fs::read(scope.kept().join("stamps")).unwrap();
    let (mut shorter, mut broken) = (0, 0);
    for (stage, (synced, all)) in whole.iter().zip(&whole[1..]).enumerate() {
        let lines: Vec<&[u8]> = all[synced.len()..]
            .split_inclusive(|b| *b == b'\n')
            .collect();
        assert!(lines.len() > 3, "{} records", lines.len());
        for state in 0..STATES {
            let chance = seed.wrapping_mul(1_000_003) + 2 * state + stage as u64;
            let below = |n: usize| usize::try_from((chance >> 3) % n as u64).unwrap();
            let written = &lines[..=below(lines.len())];
            let kept = tempfile::tempdir().unwrap();
            let kept = kept.path();
            for name in ["volume.json", "watched.json"] {
                fs::copy(scope.kept().join(name), kept.join(name)).unwrap();
            }
            let left = left(synced, written, &mut Crash::new(chance));
            assert!(left.starts_with(synced), "what was synced stays");
            fs::write(file(kept), &left).unwrap();
            fs::write(kept.join("stamps"), &stamps[..below(stamps.len() + 1)]).unwrap();
            let before = RecordReader::new(kept, Cursor::default()).read(99).unwrap();
            broken += before.iter().filter(|line| line.record.is_err()).count();
            shorter += usize::from(left.len() < all.len());
            tell(&scope, kept);
            let again = format!("state {state} of list {stage}; SACCADE_CRASH_SEED={seed}");
            assert!(fs::read(file(kept)).unwrap().starts_with(synced), "{again}");
            assert_eq!(said(kept), want, "{again}");
        }
    }
    assert!(
        shorter > 100 && broken > 0,
        "{shorter} cut, {broken} broken"
    );
}
