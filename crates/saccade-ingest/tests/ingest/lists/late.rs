//! Images that come after the list that names them.

use std::collections::BTreeMap;
use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::Record;
use saccade_ingest::watch::{Disk, ListWatch};

use super::replayed::spec;
use super::{SIZE, Scope, roomy, shown, write};
use crate::scope::{archive, texture};

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
    write(&list, sections(&["s00/r0", "s01/q"]));
    assert_eq!(told(&scope, &mut watch, 1), [picture(1, "old/q")]);
    drop(watch);
    scope.image("s01/q", 4);
    let mut watch = scope.watch(roomy(&list));
    assert_eq!(told(&scope, &mut watch, 1), [picture(1, "s01/q")]);
}

/// Where the folder that the list names is there, or others of the list in it, an image that is elsewhere is another.
#[test]
fn an_image_whose_folder_is_there_is_late_and_nowhere_else() {
    for below in ["", "pictures/"] {
        let scope = Scope::new();
        let list = scope.file("list.txt");
        let line = |file: &str, z: u32| format!("{below}{file}.tif 0 0 {z}\n");
        scope.image("s00/r0", 1);
        scope.image("s01/r1", 2);
        write(&list, line("s00/r0", 0) + &line("s00/r1", 1));
        let mut watch = scope.watch(roomy(&list));
        assert_eq!(
            told(&scope, &mut watch, 1),
            [picture(0, "s00/r0")],
            "{below}"
        );
        assert_eq!(told(&scope, &mut watch, 0), [], "{below}");
        let missing = watch.missing().unwrap();
        assert!(missing.contains("s00/r1"), "{missing}");
        scope.image("s00/r1", 3);
        assert_eq!(
            told(&scope, &mut watch, 1),
            [picture(1, "s00/r1")],
            "{below}"
        );
    }
}

/// A list that grows may name last what was taken for another image.
#[tokio::test]
async fn what_turns_out_to_be_anothers_is_given_back() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    let archive = archive(&scope.0.path().join("archive")).await;
    let by_section = async || {
        let tiles = shown(&archive).await.into_values();
        tiles
            .map(|(section, _, pixels)| (section, pixels))
            .collect::<BTreeMap<_, _>>()
    };
    let pixels = |seed: u8| texture(SIZE, seed);
    scope.image("s01/r0", 1);
    write(&list, sections(&["s00/r0"]));
    drop(scope.once(roomy(&list), &archive).await);
    assert_eq!(by_section().await, BTreeMap::from([(0, pixels(1))]));

    write(&list, sections(&["s00/r0", "s01/r0"]));
    let watch = scope.once(roomy(&list), &archive).await;
    assert_eq!(by_section().await, BTreeMap::from([(1, pixels(1))]));
    assert!(watch.missing().unwrap().contains("s00/r0"));
    drop(watch);
    let records = scope.records().len();
    drop(scope.once(roomy(&list), &archive).await);
    assert_eq!(scope.records().len(), records, "it is given back once");

    scope.image("s00/r0", 2);
    let watch = scope.once(roomy(&list), &archive).await;
    assert_eq!(watch.missing(), None);
    let both = BTreeMap::from([(0, pixels(2)), (1, pixels(1))]);
    assert_eq!(by_section().await, both);
}

/// However the list writes paths, and also where it cannot tell which of two it is.
#[tokio::test]
async fn what_is_shown_does_not_depend_on_what_was_listed_first() {
    let forms = [
        (["./pictures/s00/r", "./pictures/s01/r"], vec![1]),
        (["pictures//s00/./r", "pictures//s01/./r"], vec![1]),
        (["/m//s00//r", "/m//s01//r"], vec![1]),
        (["/m/s00/raw/r", "/m/s01/raw/r"], vec![]),
        (["pictures/a/r", "pictures/b/r"], vec![]),
    ];
    for ([first, second], sections) in forms {
        let scope = Scope::new();
        let list = scope.file("list.txt");
        scope.image("s01/r", 1);
        let line = |file: &str, z: u32| format!("{file}.tif 0 0 {z}\n");
        let grown = archive(&scope.0.path().join("archive")).await;
        write(&list, line(first, 0));
        drop(scope.once(roomy(&list), &grown).await);
        assert_eq!(shown(&grown).await.len(), 1, "{first}");
        write(&list, line(first, 0) + &line(second, 1));
        drop(scope.once(roomy(&list), &grown).await);
        let seen = async |archive: &VisualizationArchive| {
            let tiles = shown(archive).await.into_values();
            tiles.map(|(section, ..)| section).collect::<Vec<_>>()
        };
        assert_eq!(seen(&grown).await, sections, "{first}");

        std::fs::remove_dir_all(scope.kept()).unwrap();
        let anew = archive(&scope.0.path().join("anew")).await;
        drop(scope.once(roomy(&list), &anew).await);
        assert_eq!(seen(&anew).await, sections, "{first}");
    }
}
