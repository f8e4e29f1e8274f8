//! Better places than the list's own, that come later.

use std::fs;

use glam::DVec2;
use saccade_ingest::Cancel;
use saccade_ingest::replay::{Input, detect};
use saccade_ingest::watch::{ListConfig, ListError, Until, follow};

use super::{Scope, config, roomy, write};
use crate::scope::{archive, seen};

/// Registration that comes later moves what is there, as far as it refines the list, whose frame stays.
#[tokio::test]
async fn a_solution_that_comes_later_moves_tiles() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let tiles = |far: f64, b: f64| {
        let b = far + b;
        format!(
            "dim = 2\na.tif; ; ({far}, 0)\nb.tif; ; ({b}, 0)\nc.tif; ; ({}, 0)\n",
            far + 90.0
        )
    };
    for (seed, name) in (0..).zip(["a", "b", "c"]) {
        scope.image(name, seed);
    }
    let places = || async {
        let tiles = seen(&archive).await;
        tiles
            .values()
            .map(|tile| tile.transform[4])
            .collect::<Vec<_>>()
    };
    write(&list, tiles(0.0, 45.0));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 45.0, 90.0]);
    write(&registered, tiles(1000.0, 46.5));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 46.5, 90.0]);
    write(&registered, tiles(1000.0, 44.0));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 44.0, 90.0]);
    let records = scope.records();
    assert_eq!(records.len(), 5, "{records:?}");
    // Without it, it is not known where they lie.
    fs::remove_file(&registered).unwrap();
    let mut watch = scope.watch(config(&list));
    let error = follow(&mut watch, Until::End, true, &Cancel::new()).unwrap_err();
    assert!(matches!(error, ListError::List { .. }), "{error}");
    assert_eq!(scope.records(), records);
}

/// Fiji begins wherever the first tile is: what counts is how its places differ from the list's.
#[tokio::test]
async fn registration_that_begins_elsewhere_is_the_same() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let tiles = |at: [f64; 2], places: &[f64]| {
        let [x, y] = at;
        let names = ["a", "b", "c", "d"].iter().zip(places);
        let lines = names.map(|(name, place)| format!("{name}.tif; ; ({}, {y})\n", x + place));
        format!("dim = 2\n{}", lines.collect::<String>())
    };
    for (seed, name) in (0..).zip(["a", "b", "c", "d"]) {
        scope.image(name, seed);
    }
    let places = || async {
        let tiles = seen(&archive).await;
        let places = tiles.values().map(|tile| tile.transform[4..].to_vec());
        places.collect::<Vec<_>>()
    };
    // The list's own corner of the volume stays, whatever registration counts from.
    let config = || ListConfig {
        origin: Some(DVec2::new(5.0, 2.0)),
        ..roomy(&list)
    };
    write(&list, tiles([100.0, 50.0], &[0.0, 45.0, 90.0]));
    write(&registered, tiles([1000.0, 1000.0], &[0.0, 46.5, 90.0]));
    let want = vec![vec![95.0, 48.0], vec![141.5, 48.0], vec![185.0, 48.0]];
    scope.once(config(), &archive).await;
    assert_eq!(places().await, want);
    let told = scope.records().len();
    for corner in [[0.0, 0.0], [-700.25, 3e4], [1000.0, 1000.0]] {
        write(&registered, tiles(corner, &[0.0, 46.5, 90.0]));
        scope.once(config(), &archive).await;
        assert_eq!(places().await, want, "{corner:?}");
    }
    assert_eq!(scope.records().len(), told, "nothing moved");

    // Others, from elsewhere; and the same while somebody follows.
    write(&registered, tiles([0.0, 0.0], &[0.0, 44.0, 90.0]));
    scope.once(config(), &archive).await;
    let other = vec![vec![95.0, 48.0], vec![139.0, 48.0], vec![185.0, 48.0]];
    assert_eq!(places().await, other);
    // One that only knows more moves nothing that is there.
    write(&list, tiles([100.0, 50.0], &[0.0, 45.0, 90.0, 135.0]));
    write(&registered, tiles([0.0, 0.0], &[0.0, 44.0, 90.0, 139.0]));
    scope.once(config(), &archive).await;
    let all = places().await;
    assert_eq!((&all[..3], &all[3][..]), (&other[..], &[234.0, 48.0][..]));
}

/// Neither by itself nor by what it says of tiles that lay where the list has them so far.
#[tokio::test]
async fn registration_that_knows_more_tiles_moves_no_others() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let names = ["a", "b", "c", "d", "e"];
    for (seed, name) in (0..).zip(names) {
        scope.image(name, seed);
    }
    let tiles = |places: &[[f64; 2]]| {
        let lines = { names.iter().zip(places) }
            .map(|(name, [x, y])| format!("{name}.tif; ; ({x}, {y})\n"));
        format!("dim = 2\n{}", lines.collect::<String>())
    };
    let stage = [60.0, 90.0, 120.0, 150.0, 180.0].map(|x| [x, 60.0]);
    write(&list, tiles(&stage));
    let solved = [
        [1060.0, 66.0],
        [1092.0, 67.0],
        [1119.0, 64.0],
        [1155.0, 70.0],
        [1190.0, 90.0],
    ];
    let config = || ListConfig {
        origin: Some(DVec2::ZERO),
        ..roomy(&list)
    };
    let mut before: Vec<Vec<f64>> = Vec::new();
    for known in 3..=5 {
        write(&registered, tiles(&solved[..known]));
        scope.once(config(), &archive).await;
        let tiles = seen(&archive).await;
        let places: Vec<_> = tiles
            .values()
            .map(|tile| tile.transform[4..].to_vec())
            .collect();
        // Those that are known lie to each other as registration says.
        for (place, at) in places.iter().zip(&solved[..known]) {
            assert_eq!(
                [place[0] - places[0][0], place[1] - places[0][1]],
                [at[0] - 1060.0, at[1] - 66.0]
            );
        }
        assert!(
            before.is_empty() || before[..known - 1] == places[..known - 1],
            "{known}"
        );
        assert_eq!(
            places[known..],
            { stage[known..].iter() }
                .map(|at| at.to_vec())
                .collect::<Vec<_>>()
        );
        before = places;
    }
    // Elsewhere, they are placed anew, wherever it counts from.
    let other = solved.map(|[x, y]| [x - 500.0, if x > 1100.0 { y + 9.0 } else { y }]);
    write(&registered, tiles(&other));
    scope.once(config(), &archive).await;
    let tiles = seen(&archive).await;
    let places: Vec<_> = tiles
        .values()
        .map(|tile| tile.transform[4..].to_vec())
        .collect();
    assert!(
        places[0] != before[0] && (places[0][0] - 60.0).abs() < 20.0,
        "{places:?}"
    );
}

/// Fiji may have been given some of the tiles only, or leave out what it cannot place.
#[tokio::test]
async fn registration_of_some_tiles_moves_those() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let names = ["a", "b", "c", "d"];
    for (seed, name) in (0..).zip(names) {
        scope.image(name, seed);
    }
    let tiles = |places: &[(&str, f64)]| {
        let lines = places
            .iter()
            .map(|(name, x)| format!("{name}.tif; ; ({x}, 0)\n"));
        format!("dim = 2\n{}", lines.collect::<String>())
    };
    let plain = [("a", 0.0), ("b", 45.0), ("c", 90.0), ("d", 135.0)];
    write(&list, tiles(&plain));
    write(
        &registered,
        tiles(&[("a", 1000.0), ("b", 1046.5), ("c", 1090.0)]),
    );
    scope.once(config(&list), &archive).await;
    let places = || async {
        let tiles = seen(&archive).await;
        tiles
            .values()
            .map(|tile| tile.transform[4])
            .collect::<Vec<_>>()
    };
    assert_eq!(places().await, [0.0, 46.5, 90.0, 135.0]);
    // One that knows another besides.
    let all = [("a", 1000.0), ("b", 1046.5), ("c", 1090.0), ("d", 1133.0)];
    write(&registered, tiles(&all));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 46.5, 90.0, 133.0]);
    // It is the same in a replay.
    write(&registered, tiles(&all[..2]));
    let Input::Acquisition(replayed) = detect(&scope.path()).unwrap() else {
        panic!("a list")
    };
    let solved: Vec<_> = replayed.tiles.iter().map(|t| t.aligned.is_some()).collect();
    assert_eq!(solved, [true, true, false, false]);
    let said = Input::Acquisition(replayed).describe();
    assert!(said.contains("2 of which are later moved by"), "{said}");
}

/// As microscopes write them that give each tile, or each channel, a folder.
#[tokio::test]
async fn images_of_one_name_are_told_apart_by_their_folders() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let files = ["u/r", "v/r", "only", "other"];
    for (seed, name) in (0..).zip(files) {
        scope.image(name, seed);
    }
    let tiles = |lines: &[(&str, f64)]| {
        let lines = lines
            .iter()
            .map(|(file, x)| format!("{file}; ; ({x}, 0)\n"));
        format!("dim = 2\n{}", lines.collect::<String>())
    };
    let full = files.map(|name| format!("pictures/{name}.tif"));
    let [u, v, only, other] = full.each_ref().map(String::as_str);
    let places = async || {
        let tiles = seen(&archive).await;
        let places = tiles.values().map(|tile| tile.transform[4]);
        places.collect::<Vec<_>>()
    };
    write(
        &list,
        tiles(&[(u, 0.0), (v, 45.0), (only, 90.0), (other, 135.0)]),
    );
    let far = [(u, 500.0), (v, 546.5), ("only.tif", 590.0), (other, 635.0)];
    write(&registered, tiles(&far));
    scope.once(config(&list), &archive).await;
    let names: Vec<_> = seen(&archive).await.into_keys().collect();
    assert_eq!(names, ["only", "other", "pictures_v_r", "r"]);
    assert_eq!(places().await, [90.0, 135.0, 46.5, 0.0]);
    // It is the same in a replay.
    let aligned = || {
        let Input::Acquisition(replayed) = detect(&scope.path()).unwrap() else {
            panic!("a list")
        };
        let aligned = replayed
            .tiles
            .into_iter()
            .map(|tile| tile.aligned.is_some());
        aligned.collect::<Vec<_>>()
    };
    assert_eq!(aligned(), [true; 4]);
    // A name alone says nothing of two.
    let rest = [(only, 591.0), (other, 640.0)];
    write(
        &registered,
        tiles(&[[("r.tif", 500.0)].as_slice(), &rest].concat()),
    );
    assert_eq!(aligned(), [false, false, true, true]);
    // Two of that name say nothing of one that is neither.
    write(
        &list,
        tiles(&[("r.tif", 0.0), (only, 90.0), (other, 135.0)]),
    );
    let two = [("x/r.tif", 3.0), ("y/r.tif", 9.0)];
    let elsewhere = [("x/r.tif", 3.0)];
    write(&registered, tiles(&[two.as_slice(), &rest].concat()));
    assert_eq!(aligned(), [false, true, true]);
    // One in a folder that the list does not say may be it, one in another folder is not.
    write(&registered, tiles(&[elsewhere.as_slice(), &rest].concat()));
    assert_eq!(aligned(), [true; 3]);
    write(&list, tiles(&[(u, 0.0), (only, 90.0), (other, 135.0)]));
    assert_eq!(aligned(), [false, true, true]);
}
