//! Images that come after the list that names them.

use std::time::Duration;

use saccade_archive::acquisition::Record;
use saccade_ingest::watch::{Disk, ListWatch};

use super::replayed::spec;
use super::{Scope, roomy, write};

/// Lists images of sections 0, 1, 2 and so on.
fn sections(files: &[&str]) -> String {
    let spec = |(n, file): (u32, &&str)| spec(file, n, [0.0, 0.0], "1 0 0 1 0 0");
    let specs: Vec<_> = (0..).zip(files).map(spec).collect();
    format!("[{}]", specs.join(","))
}

/// Looks until so many tiles were told of, or a while; the section and the image of each.
fn told(scope: &Scope, watch: &mut ListWatch<Disk>, least: u64) -> Vec<(u32, String)> {
    let before = scope.records().len();
    let mut told = 0;
    for _ in 0..if least > 0 { 600 } else { 40 } {
        told += watch.look().unwrap().0;
        if least > 0 && told >= least {
            break;
        }
        std::thread::sleep(Duration::from_millis(25));
    }
    let records = scope.records().into_iter().skip(before);
    let mut tiles: Vec<_> = records
        .map(|record| match record {
            Record::Tile(tile) => (tile.section, tile.file),
            other => panic!("{other:?}"),
        })
        .collect();
    tiles.sort();
    tiles
}

fn picture(section: u32, file: &str) -> (u32, String) {
    (section, format!("files/pictures/{file}.tif"))
}

/// Each section has a folder, in which images are called alike.
#[test]
fn a_section_whose_image_is_late_shows_no_other_sections() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    scope.image("s00/r0", 1);
    write(&list, sections(&["s00/r0", "s01/r0", "s02/r0"]));
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 1), [picture(0, "s00/r0")]);
    assert_eq!(told(&scope, &mut watch, 0), []);
    let missing = watch.missing().unwrap();
    assert!(missing.contains("2 of the 3 images"), "{missing}");
    scope.image("s02/r0", 2);
    assert_eq!(told(&scope, &mut watch, 1), [picture(2, "s02/r0")]);
    scope.image("s01/r0", 3);
    assert_eq!(told(&scope, &mut watch, 1), [picture(1, "s01/r0")]);
    // Nor after a restart.
    drop(watch);
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 0), []);
}

/// One image of a name is taken wherever it lies, until there is one where the list has it.
#[test]
fn an_image_where_the_list_has_it_takes_the_place_of_a_stray_one() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    scope.image("old/r0", 1);
    write(&list, sections(&["s00/r0"]));
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 1), [picture(0, "old/r0")]);
    scope.image("s00/r0", 2);
    assert_eq!(told(&scope, &mut watch, 1), [picture(0, "s00/r0")]);
    assert_eq!(told(&scope, &mut watch, 0), []);
    // Also where it comes while nobody looks.
    scope.image("old/q", 3);
    write(&list, sections(&["s00/r0", "s00/q"]));
    assert_eq!(told(&scope, &mut watch, 1), [picture(1, "old/q")]);
    drop(watch);
    scope.image("s00/q", 4);
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 1), [picture(1, "s00/q")]);
}
