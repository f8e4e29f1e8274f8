//! What those who look at a volume are told of images that are not there.

use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};

use crate::scope::{Diary, Scope, VOLUME, archive, quick, seen, tile_record};

const SIZE: UVec2 = UVec2::new(37, 29);

/// Waits until what is told of it fits.
async fn until_told(archive: &VisualizationArchive, fits: impl Fn(&[String]) -> bool) {
    let mut whys = Vec::new();
    for _ in 0..1200 {
        let held_up = archive.catalog().held_up(VOLUME).await.unwrap_or_default();
        whys = held_up.into_iter().map(|held_up| held_up.why).collect();
        if fits(&whys) {
            return;
        }
        tokio::time::sleep(Duration::from_millis(25)).await;
    }
    panic!("told is {whys:?}");
}

/// Others come meanwhile, and say nothing of it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn images_that_records_name_are_told_while_they_are_waited_for() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let whole = scope.image("half", SIZE, 2);
    std::fs::write(scope.file("half"), &whole[..whole.len() / 2]).unwrap();
    for name in ["late", "half"] {
        scope.say(&tile_record(name, 0, SIZE));
    }
    scope.tile("there", 1, SIZE, 3);
    let options = IngestOptions {
        once: false,
        patience: 20_000,
        lease: Duration::from_secs(60),
        ..quick()
    };
    let cancel = Cancel::new();
    let working = {
        let (path, archive) = (scope.path().to_owned(), archive.clone());
        let cancel = cancel.clone();
        tokio::spawn(async move { run(&path, &archive, &options, &(), &cancel).await })
    };
    let machine = scope.path().to_str().unwrap();
    until_told(&archive, |whys| match whys {
        [why] => {
            assert!(!why.contains(machine), "{why}");
            why.contains("2 images are waited for") && why.contains("tiles/late.tif (tile late)")
        }
        _ => false,
    })
    .await;
    scope.image("late", SIZE, 1);
    until_told(
        &archive,
        |whys| matches!(whys, [why] if why.contains("an image is waited for: tiles/half.tif")),
    )
    .await;
    std::fs::write(scope.file("half"), &whole).unwrap();
    until_told(&archive, <[String]>::is_empty).await;
    assert_eq!(seen(&archive).await.len(), 3);
    cancel.cancel();
    working.await.unwrap().unwrap();
}

/// They may be anywhere.
#[tokio::test]
async fn reasons_do_not_say_where_on_this_machine_things_lie() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.say(&tile_record("gone", 0, SIZE));
    scope.ingest(&archive).await;
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    let reason = &set_aside[0].reason;
    let machine = scope.path().to_str().unwrap();
    assert!(
        reason.contains("the acquisition's folder/tiles/gone.tif") && !reason.contains(machine),
        "{reason}"
    );
}

/// Names that start anew in each section leave the last one's tiles; who writes them so hears of it, once.
#[tokio::test]
async fn a_name_that_another_section_takes_is_told_once() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    for name in ["a", "b"] {
        scope.tile(name, 3, SIZE, 1);
    }
    let diary = Diary::default();
    let work = async || run(scope.path(), &archive, &quick(), &diary, &Cancel::new()).await;
    // An image that is taken again where it was is none.
    scope.tile("a", 3, SIZE, 2);
    assert_eq!(work().await.unwrap().elsewhere, 0);
    let told = |diary: &Diary| {
        diary
            .notices()
            .into_iter()
            .filter(|n| n.contains("in section 3"))
    };
    assert_eq!(told(&diary).count(), 0);
    for name in ["a", "b"] {
        scope.tile(name, 4, SIZE, 3);
    }
    assert_eq!(work().await.unwrap().elsewhere, 2);
    let said: Vec<_> = told(&diary).collect();
    assert_eq!(said.len(), 1, "{said:?}");
    let parts = ["newest record has it in section 4", "such as \"s4_"];
    assert!(parts.iter().all(|part| said[0].contains(part)), "{said:?}");
    let seen = seen(&archive).await;
    assert!(
        seen.values().all(|tile| tile.section == 4),
        "{:?}",
        seen.keys()
    );
}
