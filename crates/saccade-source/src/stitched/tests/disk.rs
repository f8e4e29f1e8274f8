//! Finished blocks outlive a restart, nothing stale does, and a bad folder costs time only.

use std::path::Path;
use std::sync::Arc;

use glam::{DVec3, UVec3};
use saccade_archive::storage::MemoryStorage;

use super::fixture::{Fixture, difference, read_all, tile};
use super::run;
use crate::stitched::{DiskCache, DiskCacheError, StitchedOptions};

/// Two levels of several blocks each.
async fn wide() -> Fixture {
    let extent = UVec3::new(1100, 90, 3);
    let storage = Arc::new(MemoryStorage::new());
    let mut fixture = Fixture::on(storage, extent, DVec3::new(4.0, 4.0, 30.0)).await;
    for n in 0..6_u32 {
        let corner = (f64::from(n) * 180.0 + 3.0, -4.0);
        let tile = tile((170, 110), n % 3, corner, 1.0, 1.0, n.into());
        fixture.put(&format!("t{n}"), tile).await;
    }
    fixture
}

async fn options(folder: &Path) -> StitchedOptions {
    StitchedOptions {
        disk_cache: Some(DiskCache::open(folder, 0).await.unwrap()),
        ..StitchedOptions::default()
    }
}

#[test]
fn a_folder_of_something_else_is_left_alone() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let (thesis, cache) = (
            folder.path().join("thesis.tex"),
            folder.path().join("cache"),
        );
        std::fs::write(&thesis, "chapter 1").unwrap();
        let refused = DiskCache::open(folder.path(), 0).await;
        assert!(
            matches!(refused, Err(DiskCacheError::Foreign { .. })),
            "{refused:?}"
        );
        let files = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(files, 1, "nothing was written");
        // A cache stays one, whatever somebody puts into it, also one that has no marker yet.
        DiskCache::open(&cache, 0).await.unwrap().close().await;
        std::fs::remove_file(cache.join("saccade-disk-cache")).unwrap();
        DiskCache::open(&cache, 0).await.unwrap().close().await;
        std::fs::write(cache.join("notes"), "mine").unwrap();
        DiskCache::open(&cache, 0).await.unwrap().close().await;
    });
}

async fn fill(fixture: &Fixture, folder: &Path) -> u64 {
    let mut options = options(folder).await;
    let source = fixture.open_with(options.clone()).await;
    let (coverage, most) = difference(&read_all(&source).await, &fixture.expected());
    assert_eq!((coverage, most <= 1), (0, true));
    let statistics = source.statistics();
    assert_eq!(statistics.blocks_from_disk, 0);
    drop(source);
    options.disk_cache.take().unwrap().close().await;
    statistics.blocks_built
}

#[test]
fn a_restart_builds_only_what_changed() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let mut fixture = wide().await;
        let blocks = fill(&fixture, folder.path()).await;
        assert!(blocks > 4, "{blocks}");

        let source = fixture.open_with(options(folder.path()).await).await;
        let (coverage, most) = difference(&read_all(&source).await, &fixture.expected());
        assert_eq!((coverage, most <= 1), (0, true));
        let found = source.statistics();
        assert_eq!((found.blocks_built, found.blocks_from_disk), (0, blocks));
        assert_eq!(found.pyramids_opened, 0);
        drop(source);

        // A tile moves while nobody looks; it is seen in the first block only.
        let moved = tile((170, 110), 0, (11.0, -9.0), -2.0, 1.0, 0).transform;
        fixture.transform("t0", moved).await;
        let source = fixture.open_with(options(folder.path()).await).await;
        let (coverage, most) = difference(&read_all(&source).await, &fixture.expected());
        assert_eq!((coverage, most <= 1), (0, true), "stale voxels");
        let found = source.statistics();
        assert!(
            found.blocks_built > 0 && found.blocks_from_disk > 0,
            "{found:?}"
        );

        // Other rules are another picture.
        let mut blended = options_of_open(&source);
        blended.overlaps = crate::stitched::Overlaps::Blend;
        let other = fixture.open_with(blended).await;
        read_all(&other).await;
        assert_eq!(other.statistics().blocks_from_disk, 0);
    });
}

/// With the cache that is open already.
fn options_of_open(source: &crate::stitched::StitchedSource) -> StitchedOptions {
    let disk_cache = source.inner.disk.as_ref().map(|(disk, _)| disk.clone());
    StitchedOptions {
        disk_cache,
        ..StitchedOptions::default()
    }
}

#[test]
fn an_archive_in_the_place_of_another_shares_nothing_with_it() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let first = wide().await;
        let options = options(folder.path()).await;
        let source = first.open_with(options.clone()).await;
        read_all(&source).await;
        // The same catalog, other pixels of the same names.
        let mut second = wide().await;
        let mut dark = tile((170, 110), 0, (3.0, -4.0), 1.0, 1.0, 0);
        dark.pixels.iter_mut().for_each(|p| *p = 1 + *p / 9);
        second.put("t0", dark).await;
        let archive = saccade_archive::VisualizationArchive::from_parts(
            first.archive.catalog().clone(),
            second.storage.clone(),
        );
        let source = crate::stitched::StitchedSource::open(&archive, "v", options);
        let source = source.await.unwrap();
        read_all(&source).await;
        assert_eq!(source.statistics().blocks_from_disk, 0);
    });
}

#[test]
fn a_damaged_cache_costs_time_only() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let fixture = wide().await;
        let blocks = fill(&fixture, folder.path()).await;
        // One bit in a thousand bytes, all over; the index of blocks included.
        for entry in std::fs::read_dir(folder.path()).unwrap() {
            let path = entry.unwrap().path();
            let mut bytes = std::fs::read(&path).unwrap();
            bytes.iter_mut().step_by(997).for_each(|byte| *byte ^= 4);
            std::fs::write(&path, bytes).unwrap();
        }
        let rebuilt = fill(&fixture, folder.path()).await;
        assert_eq!(rebuilt, blocks);
        // Cut short, and then gone.
        for entry in std::fs::read_dir(folder.path()).unwrap() {
            let file = std::fs::File::options()
                .write(true)
                .open(entry.unwrap().path());
            file.unwrap().set_len(5000).unwrap();
        }
        assert_eq!(fill(&fixture, folder.path()).await, blocks);
        let source = fixture.open_with(options(folder.path()).await).await;
        read_all(&source).await;
        assert_eq!(
            source.statistics().blocks_from_disk,
            blocks,
            "it works again"
        );
        drop(source);
    });
}

#[test]
fn folders_that_cannot_be_used_are_told() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let cache = DiskCache::open(folder.path(), 1 << 30).await.unwrap();
        let taken = DiskCache::open(folder.path(), 1 << 30).await;
        assert!(
            matches!(taken, Err(DiskCacheError::Taken { .. })),
            "{taken:?}"
        );
        // A clone that somebody still holds does not keep the folder.
        let held = cache.clone();
        cache.close().await;
        drop(cache);
        // A smaller one leaves no files of the larger one behind.
        let files = || std::fs::read_dir(folder.path()).unwrap().count();
        let many = files();
        let cache = DiskCache::open(folder.path(), 0).await.unwrap();
        // Besides its parts the lock, and the mark of a cache.
        assert_eq!((many, files()), (16 + 2, 4 + 2));
        held.close().await;
        drop(held);
        let taken = DiskCache::open(folder.path(), 0).await;
        assert!(
            matches!(taken, Err(DiskCacheError::Taken { .. })),
            "{taken:?}"
        );
        drop(cache);
        let file = folder.path().join("lock");
        let open = DiskCache::open(&file, 0).await;
        assert!(matches!(open, Err(DiskCacheError::Open { .. })), "{open:?}");
    });
}

#[test]
fn a_cache_that_cannot_be_opened_names_the_cause_and_leaves_nothing_new() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cache");
        let names = || {
            let entries = std::fs::read_dir(&path).unwrap();
            let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
            names.collect::<std::collections::BTreeSet<_>>()
        };
        let unit = |n: u32| format!("foyer-storage-direct-fs-{n:08}");
        let fails = async || {
            let error = DiskCache::open(&path, 0).await.unwrap_err();
            let cause = std::error::Error::source(&error)
                .expect("a cause")
                .to_string();
            assert!(cause.starts_with("Is a directory"), "{cause}");
        };
        // Two files are made before the third cannot be.
        std::fs::create_dir_all(path.join(unit(2))).unwrap();
        fails().await;
        assert_eq!(names(), [unit(2)].into());
        // What was there before is kept.
        std::fs::remove_dir(path.join(unit(2))).unwrap();
        DiskCache::open(&path, 0).await.unwrap().close().await;
        let all = names();
        assert_eq!(all.len(), 4 + 2);
        std::fs::remove_file(path.join(unit(1))).unwrap();
        std::fs::remove_file(path.join(unit(3))).unwrap();
        std::fs::create_dir_all(path.join(unit(3))).unwrap();
        fails().await;
        let mut left = all.clone();
        left.remove(&unit(1));
        assert_eq!(names(), left);
        // And once it can be opened, all is there.
        std::fs::remove_dir(path.join(unit(3))).unwrap();
        DiskCache::open(&path, 0).await.unwrap().close().await;
        assert_eq!(names(), all);
    });
}

#[test]
fn a_cache_of_other_units_begins_anew() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let fixture = wide().await;
        let blocks = fill(&fixture, folder.path()).await;
        let files = || {
            let entries = std::fs::read_dir(folder.path()).unwrap();
            entries.map(|entry| entry.unwrap().metadata().unwrap().len())
        };
        // Its files are holes but for what is written: they take little space.
        for found in [0, blocks] {
            let cache = DiskCache::open(folder.path(), 22 << 30).await.unwrap();
            assert_eq!(files().filter(|&len| len == 128 << 20).count(), 176);
            assert_eq!(
                files().count(),
                176 + 2,
                "none of the smaller units is left"
            );
            let options = StitchedOptions {
                disk_cache: Some(cache.clone()),
                ..StitchedOptions::default()
            };
            let source = fixture.open_with(options).await;
            let (coverage, most) = difference(&read_all(&source).await, &fixture.expected());
            assert_eq!((coverage, most <= 1), (0, true));
            assert_eq!(source.statistics().blocks_from_disk, found);
            drop(source);
            cache.close().await;
        }
    });
}

/// What several threads keep at the same time is found after a restart, all of it.
#[test]
fn all_that_was_kept_at_once_is_found_again() {
    run(async {
        const THREADS: u32 = 4;
        let folder = tempfile::tempdir().unwrap();
        for round in 0..8_u32 {
            let names = (0..THREADS).map(|thread| {
                let name = move |n: u32| format!("{round} {thread} {n}").into_bytes();
                (0..200).map(name).collect::<Vec<_>>()
            });
            let names: Vec<_> = names.collect();
            // Large enough that no round turns out another's.
            let cache = DiskCache::open(folder.path(), 1 << 30).await.unwrap();
            std::thread::scope(|scope| {
                for names in &names {
                    scope.spawn(|| names.iter().for_each(|name| cache.put(name, name)));
                }
            });
            cache.close().await;
            let cache = DiskCache::open(folder.path(), 1 << 30).await.unwrap();
            for name in names.iter().flatten() {
                let kept = cache.get(name).await;
                assert_eq!(kept.as_deref(), Some(&name[..]), "round {round}");
            }
            assert_eq!(cache.get(b"another").await, None);
            cache.close().await;
        }
    });
}

/// A process that was killed while a unit was being freed leaves none that is free.
#[test]
fn a_cache_without_a_free_unit_is_used_on() {
    run(async {
        let folder = tempfile::tempdir().unwrap();
        let cache = DiskCache::open(folder.path(), 0).await.unwrap();
        cache.put(b"old", b"voxels");
        cache.close().await;
        let unit = |n: u32| {
            folder
                .path()
                .join(format!("foyer-storage-direct-fs-{n:08}"))
        };
        let written = |n: &u32| {
            std::fs::read(unit(*n)).unwrap()[..4096]
                .iter()
                .any(|b| *b != 0)
        };
        let one: Vec<_> = (0..4).filter(written).collect();
        assert_eq!(one.len(), 1, "{one:?}");
        for n in (0..4).filter(|n| *n != one[0]) {
            std::fs::copy(unit(one[0]), unit(n)).unwrap();
        }
        let cache = DiskCache::open(folder.path(), 0).await.unwrap();
        assert_eq!(cache.get(b"old").await.as_deref(), Some(&b"voxels"[..]));
        cache.put(b"new", b"other voxels");
        cache.close().await;
        let cache = DiskCache::open(folder.path(), 0).await.unwrap();
        assert_eq!(
            cache.get(b"new").await.as_deref(),
            Some(&b"other voxels"[..])
        );
        cache.close().await;
    });
}
