//! `kill -9` at random moments of those who change an archive that is there: registration, and repair.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::{Catalog, Tile};
use serde_json::json;

use super::errors::text;
use super::kills::{Killer, image, tree};
use super::{done, simulate, stderr};

/// What the archive's catalog says.
fn asked<T>(archive: &Path, question: impl AsyncFnOnce(&Catalog) -> T) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(async {
        let archive = VisualizationArchive::open(archive).await.unwrap();
        let answer = question(archive.catalog()).await;
        archive.catalog().close().await;
        answer
    })
}

fn tiles(archive: &Path) -> Vec<Tile> {
    asked(archive, async |catalog| {
        let mut tiles = Vec::new();
        for section in catalog.sections_of_tiles("phantom").await.unwrap() {
            tiles.extend(catalog.section_tiles("phantom", section).await.unwrap());
        }
        tiles
    })
}

/// How many tiles wait for ingest.
fn given_back(archive: &Path) -> u64 {
    asked(archive, async |catalog| {
        let statistics = catalog.statistics("phantom").await.unwrap();
        statistics.waiting + statistics.queued
    })
}

/// Where its first pixel lies.
fn place(tile: &Tile) -> DVec2 {
    let [.., x, y] = tile.transform.elements();
    DVec2::new(x, y)
}

/// Voxels of all levels, without the descriptions, which say the revision.
pub(super) fn exported(archive: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let out = archive.with_extension("zarr");
    done(["export", text(archive), text(&out)]);
    let mut files = image(tree(&out));
    fs::remove_dir_all(out).unwrap();
    files.retain(|file, _| {
        file.components()
            .nth(1)
            .is_some_and(|part| part.as_os_str() == "c")
    });
    assert!(
        files.keys().any(|file| !file.starts_with("0")),
        "no coarse levels"
    );
    assert!(!files.is_empty(), "no voxels are exported");
    files
}

/// How far tiles are moved \[voxels\]: none out of the volume.
const AWAY: f64 = -20.0;

/// What is said of one section becomes so at once, and what was left out is made up for by saying it again.
#[test]
fn a_killed_update_leaves_each_section_as_it_was_or_as_it_is_to_be() {
    let folder = tempfile::tempdir().unwrap();
    let [acquisition, archive] = ["acquisition", "archive"].map(|name| folder.path().join(name));
    // More tiles a section than share a transaction.
    simulate(&acquisition, "1100,1100,4");
    done(["ingest", text(&acquisition), text(&archive), "--once"]);
    let before = tiles(&archive);
    assert!(before.len() > 1000, "{} tiles", before.len());
    let files = [0.0, AWAY].map(|by| {
        let line = |tile: &Tile| {
            let DVec2 { x, y } = place(tile) + by;
            json!({ "record": "transform", "tile": tile.name, "transform": [1, 0, 0, 1, x, y] })
        };
        let lines: Vec<_> = before.iter().map(|tile| line(tile).to_string()).collect();
        let file = folder.path().join(format!("{by}.jsonl"));
        fs::write(&file, lines.join("\n")).unwrap();
        file
    });
    let places: BTreeMap<_, _> = { before.iter() }
        .map(|tile| (tile.name.clone(), place(tile)))
        .collect();
    // The sections whose tiles lie where they were, and those where they are by now.
    let sections = || {
        let mut by_section: BTreeMap<u32, BTreeSet<bool>> = BTreeMap::new();
        for tile in tiles(&archive) {
            let by = place(&tile) - places[&tile.name];
            let is = |moved| by.abs_diff_eq(DVec2::splat(moved), 1e-6);
            assert!(is(0.0) || is(AWAY), "{by}");
            by_section
                .entry(tile.section)
                .or_default()
                .insert(by.x < AWAY / 2.0);
        }
        assert!(
            by_section.values().all(|moved| moved.len() == 1),
            "half a section: {by_section:?}"
        );
        let moved = by_section
            .values()
            .filter(|moved| moved.contains(&true))
            .count();
        [by_section.len() - moved, moved]
    };
    let mut killer = Killer::new(0x5acc_0004);
    let (mut to, mut some) = (1, 0);
    while killer.goes_on(some) {
        let killed = killer.life(&["update", text(&archive), text(&files[to])]);
        let counts = sections();
        some += u32::from(counts.iter().all(|count| *count > 0));
        if killed && counts[to] == 0 {
            killer.was_early();
        }
        if counts[1 - to] == 0 {
            to = 1 - to;
        }
    }
    assert!(some > 0, "no kill came between two sections");
    done(["update", text(&archive), text(&files[1])]);
    assert_eq!(sections()[0], 0);
    let whole = stderr(&done(["check", text(&archive)]));
    assert!(whole.contains("all whole"), "{whole}");
}

/// However often it is killed, in the end it has mended all, and nothing that was whole is gone.
#[test]
fn a_killed_repair_makes_nothing_worse_and_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let [acquisition, archive] = ["acquisition", "archive"].map(|name| folder.path().join(name));
    simulate(&acquisition, "300,260,16");
    let ingest = [
        "ingest",
        text(&acquisition),
        text(&archive),
        "--once",
        "--lossless",
    ];
    done(ingest);
    let want = exported(&archive);
    let pyramids = || -> Vec<_> {
        let names = tree(&archive.join("tiles")).into_keys();
        let pyramids = names.filter(|name| name.extension().is_some_and(|end| end == "tif"));
        pyramids
            .map(|name| archive.join("tiles").join(name))
            .collect()
    };
    let damage = || {
        let whole = pyramids();
        for (n, pyramid) in whole.iter().enumerate() {
            match n % 5 {
                0 => fs::remove_file(pyramid).unwrap(),
                1 => {
                    let bytes = fs::read(pyramid).unwrap();
                    fs::write(pyramid, &bytes[..bytes.len() / 2]).unwrap();
                }
                2 => fs::write(pyramid.with_extension("stray"), "nothing").unwrap(),
                _ => {}
            }
        }
        let (kept, gone): (Vec<_>, Vec<_>) =
            { whole.into_iter().enumerate() }.partition(|(n, _)| n % 5 > 1);
        let kept: Vec<_> = kept.into_iter().map(|(_, pyramid)| pyramid).collect();
        (kept, gone.len() as u64)
    };
    let repair = [
        "check",
        text(&archive),
        "--repair",
        "--acquisition",
        text(&acquisition),
    ];
    let (mut kept, mut damaged) = damage();
    let mut killer = Killer::new(0x5acc_0005);
    let mut in_the_midst = 0;
    while killer.goes_on(in_the_midst) {
        let before = given_back(&archive);
        let killed = killer.life(&repair);
        let now = given_back(&archive);
        if killed && now == before {
            killer.was_early();
        }
        // Of those that it has to give back to ingest some were, and others were not.
        in_the_midst += u32::from(killed && now > before && now < damaged);
        let all = pyramids();
        assert!(
            kept.iter().all(|pyramid| all.contains(pyramid)),
            "a pyramid that was whole is gone"
        );
        if !killed {
            done(ingest);
            assert!(exported(&archive) == want, "other voxels");
            (kept, damaged) = damage();
        }
    }
    assert!(in_the_midst > 0, "no kill came in the midst of a repair");
    done(repair);
    done(ingest);
    let whole = stderr(&done([
        "check",
        text(&archive),
        "--acquisition",
        text(&acquisition),
    ]));
    assert!(whole.contains("all whole"), "{whole}");
    assert!(exported(&archive) == want, "other voxels");
}
