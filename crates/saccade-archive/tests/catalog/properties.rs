//! Properties of whole streams of records.

use std::collections::BTreeSet;

use glam::UVec3;
use proptest::prelude::*;

use crate::place::Place;
use crate::suite::{Said, all_changes, commit_one, commit_stream, covered, model, said, tiles};

/// Cases where the catalog is a file, and where each needs a new database.
const CASES: u32 = 48;
const DATABASE_CASES: u32 = 6;

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        failure_persistence: None,
        ..Default::default()
    }
}

fn block_on<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap()
        .block_on(work)
}

/// Whenever the files get whole, the volume ends up the same, as the records' order says.
async fn late_files_change_nothing(
    stream: &[Said],
    places: [Place; 2],
) -> Result<(), TestCaseError> {
    for (in_time, place) in [true, false].into_iter().zip(places) {
        let catalog = place.catalog().await;
        let revision = commit_stream(&catalog, stream, in_time).await;
        let seen = tiles(&catalog).await;
        prop_assert_eq!(&seen, &model(stream), "in time: {}", in_time);
        prop_assert_eq!(catalog.entry("v").await.unwrap().tiles, seen.len() as u64);
        prop_assert_eq!(catalog.waiting("v").await.unwrap(), []);
        let changes = all_changes(&catalog).await;
        let revisions: Vec<_> = changes.iter().map(|c| c.revision).collect();
        prop_assert_eq!(revisions, (1..=revision).collect::<Vec<_>>());
        catalog.close().await;
    }
    Ok(())
}

/// Whoever draws the boxes of the changes anew sees everything that happened.
async fn changes_cover_what_changed(stream: &[Said], place: Place) -> Result<(), TestCaseError> {
    let catalog = place.catalog().await;
    let mut before = BTreeSet::new();
    let mut revision = 0;
    for (position, said) in stream.iter().enumerate() {
        let mut commit = catalog.begin("v").await.unwrap();
        commit_one(&mut commit, said, position, true).await;
        let next = commit.finish().await.unwrap();
        let changes = catalog.changes_after("v", revision).await.unwrap();
        let after = covered(&model(&stream[..=position]));
        for (voxel, _) in before.symmetric_difference(&after) {
            let voxel = UVec3::from_array(*voxel);
            let told = changes.iter().any(|c| c.voxels.contains(voxel));
            prop_assert!(told, "{} changed unheard by {:?}", voxel, said);
        }
        (before, revision) = (after, next);
    }
    catalog.close().await;
    Ok(())
}

fn stream() -> impl Strategy<Value = Vec<Said>> {
    prop::collection::vec(said(), 1..14)
}

mod on_sqlite {
    use super::*;

    proptest! {
        #![proptest_config(config(CASES))]

        #[test]
        fn late_files_change_nothing(stream in stream()) {
            block_on(super::late_files_change_nothing(&stream, [Place::file(), Place::file()]))?;
        }

        #[test]
        fn changes_cover_what_changed(stream in stream()) {
            block_on(super::changes_cover_what_changed(&stream, Place::file()))?;
        }
    }
}

mod on_postgres {
    use super::*;

    proptest! {
        #![proptest_config(config(DATABASE_CASES))]

        #[test]
        fn late_files_change_nothing(stream in stream()) {
            block_on(async {
                let (a, b) = (Place::database().await, Place::database().await);
                match a.zip(b) {
                    Some((a, b)) => super::late_files_change_nothing(&stream, [a, b]).await,
                    None => Ok(()),
                }
            })?;
        }

        #[test]
        fn changes_cover_what_changed(stream in stream()) {
            block_on(async {
                match Place::database().await {
                    Some(place) => super::changes_cover_what_changed(&stream, place).await,
                    None => Ok(()),
                }
            })?;
        }
    }
}
