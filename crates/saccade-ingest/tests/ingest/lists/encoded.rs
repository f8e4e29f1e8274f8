//! Lists whose images are named as in URLs, as `pathlib` writes them.

use std::time::Duration;

use saccade_archive::acquisition::Record;
use saccade_ingest::watch::{Disk, ListWatch};

use super::replayed::{is_as_replayed, spec};
use super::{Scope, roomy, write};

/// Lists images with other numbers of the stage each.
fn specs(files: &[&str]) -> String {
    let spec = |(n, file): (u32, &&str)| {
        let x = f64::from(n) * 50.0;
        spec(file, 0, [x, 0.0], &format!("1 0 0 1 {x} 0"))
    };
    let specs: Vec<_> = (0..).zip(files).map(spec).collect();
    format!("[{}]", specs.join(","))
}

/// Looks until something was told, or long enough for all that there is; the images that were told of.
fn told(scope: &Scope, watch: &mut ListWatch<Disk>, least: u64) -> Vec<String> {
    let before = scope.records().len();
    let mut told = 0;
    for _ in 0..if least > 0 { 600 } else { 20 } {
        told += watch.look().unwrap().0;
        if least > 0 && told >= least {
            break;
        }
        std::thread::sleep(Duration::from_millis(25));
    }
    let tiles = scope.records().into_iter().skip(before);
    let mut files: Vec<_> = tiles
        .map(|record| match record {
            Record::Tile(tile) => tile.file,
            other => panic!("{other:?}"),
        })
        .collect();
    files.sort();
    files
}

#[tokio::test]
async fn urls_show_what_their_replay_shows() {
    let scope = Scope::new();
    for (seed, name) in (0..).zip(["a b/t#1", "ü", "50%", "both 1", "both%201"]) {
        scope.image(name, seed);
    }
    write(
        &scope.file("specs.json"),
        specs(&["a%20b/t%231", "%C3%BC", "50%25", "both%201"]),
    );
    assert_eq!(is_as_replayed(&scope.path()).await, 4);
}

#[test]
fn an_image_that_comes_late_is_that_of_a_url() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    scope.image("first", 1);
    write(&list, specs(&["first", "a%20b/t%231", "two%202"]));
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 1), ["files/pictures/first.tif"]);
    let missing = watch.missing().unwrap();
    assert!(missing.contains("2 of the 3 images"), "{missing}");

    scope.image("a b/t#1", 2);
    assert_eq!(told(&scope, &mut watch, 1), ["files/pictures/a b/t#1.tif"]);
    // Of both, the one that is called as it is written.
    scope.image("two 2", 3);
    scope.image("deep/two%202", 4);
    let two = "files/pictures/deep/two%202.tif";
    assert_eq!(told(&scope, &mut watch, 1), [two]);
    assert_eq!(watch.missing(), None);

    // One is imaged again; what is not is told of no more, by a later process neither.
    scope.image("a b/t#1", 5);
    let again = told(&scope, &mut watch, 1);
    assert_eq!(again, ["files/pictures/a b/t#1.tif"]);
    drop(watch);
    let mut watch = scope.watch(roomy(&list));
    assert!(watch.leads());
    assert!(told(&scope, &mut watch, 0).is_empty());
    scope.image("a b/t#1", 6);
    let again = told(&scope, &mut watch, 1);
    assert_eq!(again, ["files/pictures/a b/t#1.tif"]);
}

/// What encodes a slash, or leads out of the folder, is no image of it.
#[test]
fn an_encoded_way_out_of_the_folder_leads_nowhere() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    scope.image("first", 1);
    write(&scope.0.path().join("outside.tif"), "none of it");
    let out = [
        "%2e%2e/outside",
        "%2e%2e%2foutside",
        "pictures%2Ffirst",
        "outside%00",
    ];
    write(&list, specs(&[&["first"], &out[..]].concat()));
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 1), ["files/pictures/first.tif"]);
    assert!(told(&scope, &mut watch, 0).is_empty());
    let missing = watch.missing().unwrap();
    assert!(missing.contains("4 of the 5 images"), "{missing}");
}
