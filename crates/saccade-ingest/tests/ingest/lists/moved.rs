//! Images of a list that lie elsewhere than they did.

use std::time::{Duration, SystemTime};

use saccade_ingest::watch::{Disk, ListConfig, ListError, ListWatch, WatchError};

use super::*;

const LIST: &str = "a.tif 0 0 0\nb.tif 50 0 0\n";

/// The list's images, written so many seconds ago.
fn fill(folder: &Path, seed: u8, ago: u64) {
    for name in ["a", "b"] {
        let path = folder.join(format!("pictures/{name}.tif"));
        write(&path, tiff8(SIZE, &texture(SIZE, seed)));
        let written = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000 - ago);
        let file = fs::File::options().write(true).open(&path).unwrap();
        file.set_modified(written).unwrap();
    }
}

#[tokio::test]
async fn the_images_of_a_folder_that_moved_are_known_and_those_of_another_refused() {
    let scope = Scope::new();
    let archive = archive(&scope.0.path().join("archive")).await;
    let list = scope.0.path().join("list.txt");
    write(&list, LIST);
    fill(&scope.path(), 1, 500);
    scope.once(roomy(&list), &archive).await;
    assert_eq!(scope.records().len(), 2);
    let before = seen(&archive).await;

    let away = scope.0.path().join("away");
    fs::rename(scope.path(), &away).unwrap();
    let open = |folder: &Path, moved: bool| {
        let config = ListConfig {
            moved,
            ..roomy(&list)
        };
        ListWatch::open(config, Disk, folder, &scope.kept())
    };
    let mut watch = open(&away, false).unwrap();
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    assert_eq!(scope.records().len(), 2);
    drop(watch);

    fs::remove_dir_all(&away).unwrap();
    fill(&scope.path(), 2, 100);
    for _ in 0..2 {
        let refused = open(&scope.path(), false).err().unwrap();
        assert!(
            matches!(
                refused,
                ListError::Watch(WatchError::Another {
                    found: 2,
                    same: 0,
                    ..
                })
            ),
            "{refused}"
        );
    }
    assert_eq!(scope.records().len(), 2);
    assert!(seen(&archive).await.keys().eq(before.keys()));
    let take_in = |moved: bool| {
        let mut watch = open(&scope.path(), moved).unwrap();
        follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
        scope.records().len()
    };
    assert_eq!(take_in(true), 2);
    // What comes into the place of one of them later is told, of its size and time though it is.
    for n in 1..=2 {
        fill(&scope.0.path().join("new"), 2 + n, 100);
        let new = scope.0.path().join("new/pictures/a.tif");
        fs::rename(new, scope.path().join("pictures/a.tif")).unwrap();
        for _ in 0..2 {
            assert_eq!(take_in(false), 2 + usize::from(n));
        }
    }
}
