//! What has changed since somebody was here last.

use std::time::Duration;

use futures::StreamExt;
use glam::{DVec3, UVec3};
use saccade_core::voxel_box::VoxelBox;

use super::fixture::{Fixture, difference, read_all, tile};
use super::run;
use crate::{ChangeReason, VolumeSource};

async fn three_tiles() -> Fixture {
    let extent = UVec3::new(300, 100, 5);
    let mut fixture = Fixture::new(extent, DVec3::new(4.0, 4.0, 30.0)).await;
    for (n, section) in (0_u32..).zip([0, 0, 2]) {
        let corner = (f64::from(n) * 90.0 - 5.0, -8.0);
        let tile = tile((80, 130), section, corner, 2.0, 1.0, u64::from(section) + 7);
        fixture.put(&format!("t{n}"), tile).await;
    }
    fixture
}

/// Whatever is another now lies in what is told, and not everything is told.
#[test]
fn what_changed_while_nobody_looked_is_told() {
    run(async {
        let mut fixture = three_tiles().await;
        let source = fixture.open().await;
        let (since, before) = (source.revision(), read_all(&source).await);
        assert_eq!(source.changes_after(since).await, Some(Vec::new()));
        drop(source);
        let new = tile((60, 50), 4, (10.0, 5.0), 30.0, 1.0, 99);
        fixture.put("new", new).await;
        let moved = tile((80, 130), 0, (75.0, 3.0), 4.0, 1.0, 0).transform;
        fixture.transform("t1", moved).await;
        fixture.delete("t2").await;

        let source = fixture.open().await;
        let after = read_all(&source).await;
        let told = source.changes_after(since).await.unwrap();
        assert_eq!(
            told.last().map(|change| change.revision),
            Some(source.revision())
        );
        for (n, (before, after)) in before.iter().zip(&after).enumerate() {
            let level = fixture.volume.levels[n];
            let all = VoxelBox::of_size(level.extent).iter();
            let (mut inside, mut outside, mut untouched) = (0, 0, 0);
            for ((at, before), after) in all.zip(before).zip(after) {
                let touched = |voxels| level.box_from_voxels(voxels).contains(at);
                match told.iter().any(|change| touched(change.voxels)) {
                    true => inside += u32::from(before != after),
                    false => {
                        untouched += 1;
                        outside += u32::from(before != after);
                    }
                }
            }
            assert!(inside > 0 && outside == 0, "level {n}: {inside} {outside}");
            assert!(n > 0 || untouched > 10_000, "{untouched} did not change");
        }
    });
}

#[test]
fn what_is_no_longer_kept_is_not_told() {
    run(async {
        let mut fixture = three_tiles().await;
        let source = fixture.open().await;
        let since = source.revision();
        let catalog = fixture.archive.catalog().clone().with_changes_kept(2);
        for n in 0..6 {
            let tile = tile((60, 50), 4, (10.0 * f64::from(n), 5.0), 0.0, 1.0, 99);
            fixture.put("again", tile).await;
        }
        let now = catalog.revision("v").await.unwrap();
        assert_eq!(source.changes_after(since).await, None);
        assert_eq!(source.changes_after(now + 1).await, None);
        let last = source.changes_after(now - 1).await.unwrap();
        assert_eq!(last.len(), 1);
        assert_eq!(source.changes_after(now).await, Some(Vec::new()));
    });
}

/// Revisions that are told never go back, though those of the other catalog do.
#[test]
fn another_catalog_in_the_place_of_the_open_one_is_shown_and_followed() {
    run(async {
        let mut fixture = three_tiles().await;
        let extent = fixture.volume.extent();
        let storage = fixture.storage.clone();
        let mut other = Fixture::on(storage, extent, DVec3::new(4.0, 4.0, 30.0)).await;
        let elsewhere = tile((80, 130), 1, (20.0, -3.0), 5.0, 1.0, 77);
        other.put("other", elsewhere).await;

        let source = fixture.open().await;
        let (first, before) = (source.revision(), read_all(&source).await);
        assert_eq!(first, 3);
        let mut changes = source.changes();
        fixture.take_catalog_of(&other).await;
        let next = tokio::time::timeout(Duration::from_secs(20), changes.next());
        let change = next.await.expect("it is noticed").unwrap();
        let whole = VoxelBox::of_size(extent);
        assert_eq!(
            (change.reason, change.voxels),
            (ChangeReason::Missed, whole)
        );
        assert!(change.revision > first && source.revision() == change.revision);
        let now = read_all(&source).await;
        let (coverage, most) = difference(&now, &fixture.expected());
        assert!(coverage == 0 && most <= 1, "{coverage} {most}");
        assert_ne!(now, before);
        assert_eq!(
            source.changes_after(first).await,
            None,
            "of another catalog"
        );
        assert_eq!(
            source.changes_after(change.revision).await,
            Some(Vec::new())
        );

        // Whoever opens it now writes to it.
        let catalog = fixture.archive.catalog().location().clone();
        let writing = saccade_archive::catalog::Catalog::open(catalog)
            .await
            .unwrap();
        writing.delete_tile("v", "other", 9).await.unwrap();
        let next = tokio::time::timeout(Duration::from_secs(20), changes.next());
        let deleted = next.await.expect("it is followed").unwrap();
        assert_eq!(deleted.reason, ChangeReason::Deleted);
        assert_eq!(deleted.revision, change.revision + 1);
        assert_eq!(
            source.changes_after(change.revision).await.unwrap(),
            [deleted]
        );
        fixture.tiles.clear();
        let (coverage, most) = difference(&read_all(&source).await, &fixture.expected());
        assert_eq!((coverage, most), (0, 0), "nothing is there any more");
    });
}
