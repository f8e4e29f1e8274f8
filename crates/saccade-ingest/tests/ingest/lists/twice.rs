//! Lists that name an image more than once.

use std::collections::BTreeMap;

use saccade_archive::acquisition::Record;
use saccade_ingest::replay::{Input, detect};

use super::{Scope, roomy, write};
use crate::scope::{archive, seen};

fn spec(id: &str, file: &str, affine: &str) -> String {
    format!(
        r#"{{"tileId": "{id}", "z": 0, "width": 60, "height": 50,
            "mipmapLevels": {{"0": {{"imageUrl": "file:///scope/{file}.tif"}}}},
            "transforms": {{"type": "list", "specList": [
                {{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "{affine}"}}]}}}}"#
    )
}

/// Whoever corrects a list by hand, or appends to it, means one tile.
#[tokio::test]
async fn an_image_is_one_tile_of_its_section_where_its_last_line_has_it() {
    let plain = |far: f64| {
        format!("a.tif 0 0 0\nb.tif 50 0 0\na.tif {far} 3 0\nb.tif 50 0 0\na.tif 0 0 1\n")
    };
    let fiji = |far: f64| {
        format!(
            "dim = 3\na.tif; ; (0, 0, 0)\nb.tif; ; (50, 0, 0)\na.tif; ; ({far}, 3, 0)\nb.tif; ; (50, 0, 0)\n\
             a.tif; ; (0, 0, 1)\n"
        )
    };
    let kinds: [(&str, &dyn Fn(f64) -> String); 2] =
        [("list.txt", &plain), ("TileConfiguration.txt", &fiji)];
    for (name, text) in kinds {
        let scope = Scope::new();
        let list = scope.file(name);
        let archive = archive(&scope.0.path().join("archive")).await;
        scope.image("a", 1);
        scope.image("b", 2);
        let places = || async {
            let tiles = seen(&archive).await.into_iter();
            let place = |(name, tile): (String, crate::scope::Seen)| {
                (name, (tile.section, tile.transform[4], tile.transform[5]))
            };
            tiles.map(place).collect::<BTreeMap<_, _>>()
        };
        let want = |far| {
            // Another section may be filled with the same image.
            let tiles = [
                ("a", (0, far, 3.0)),
                ("a-2", (1, 0.0, 0.0)),
                ("b", (0, 50.0, 0.0)),
            ];
            BTreeMap::from(tiles.map(|(name, place)| (name.to_owned(), place)))
        };
        write(&list, text(7.0));
        scope.once(roomy(&list), &archive).await;
        assert_eq!(places().await, want(7.0), "{name}");
        let told = scope.records().len();
        assert_eq!(told, 3, "{name}");
        // One that is corrected once more moves, and no more.
        write(&list, text(9.5));
        scope.once(roomy(&list), &archive).await;
        assert_eq!(places().await, want(9.5), "{name}");
        let more = scope.records().split_off(told);
        assert!(
            matches!(&more[..], [Record::Transform(moved)] if moved.tile == "a"),
            "{name}: {more:?}"
        );
        // It is the same in a replay.
        let Input::Acquisition(replayed) = detect(&scope.path()).unwrap() else {
            panic!("a list")
        };
        let places = replayed.tiles.iter().map(|tile| tile.stage.elements()[4]);
        assert_eq!(places.collect::<Vec<_>>(), [9.5, 50.0, 0.0], "{name}");
    }
}

/// Of Render's tiles each has an id; several may show one image, such as halves that are corrected apart.
#[tokio::test]
async fn an_id_is_one_tile_and_an_image_may_be_several() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    let archive = archive(&scope.0.path().join("archive")).await;
    for (seed, name) in (0..).zip(["a", "b"]) {
        scope.image(name, seed);
    }
    let specs = |last: &str| {
        let specs = [
            spec("left", "a", "1 0 0 1 0 0"),
            spec("right", "a", "1 0.01 0 1 30 0"),
            spec("b", "b", "1 0 0 1 99 9"),
            spec("b", "b", last),
        ];
        format!("[{}]", specs.join(","))
    };
    let tiles = || async {
        let tiles = seen(&archive).await.into_iter();
        let tiles = tiles.map(|(name, tile)| (name, tile.transform));
        tiles.collect::<BTreeMap<_, _>>()
    };
    write(&list, specs("1 0 0 1 60 0"));
    scope.once(roomy(&list), &archive).await;
    let all = tiles().await;
    assert_eq!(all.len(), 3, "{all:?}");
    // Registration counts for each of them; all are moved by as much.
    let [left, right, b] = ["a", "scope_a", "b"].map(|name| all[name]);
    assert_eq!(left[..4], [1.0, 0.0, 0.0, 1.0]);
    assert_eq!(right[..4], [1.0, 0.01, 0.0, 1.0]);
    for (tile, step) in [(right, 30.0), (b, 60.0)] {
        assert!((tile[4] - left[4] - step).abs() < 1e-9, "{all:?}");
    }
    let told = scope.records().len();
    write(&list, specs("1 0 0 1 61 0"));
    scope.once(roomy(&list), &archive).await;
    let more = scope.records().split_off(told);
    assert!(
        more.iter()
            .all(|record| matches!(record, Record::Transform(_))),
        "{more:?}"
    );
    let all = tiles().await;
    assert!((all["b"][4] - all["a"][4] - 61.0).abs() < 1e-9, "{all:?}");
}

/// What a tile is called says nothing of another's image.
#[tokio::test]
async fn an_id_may_be_what_the_image_of_another_tile_is_called() {
    for shear in [0.0, 0.01] {
        let scope = Scope::new();
        let list = scope.file("specs.json");
        let archive = archive(&scope.0.path().join("archive")).await;
        scope.image("a", 1);
        scope.image("b", 2);
        for x in [0.0, 192.0] {
            let want = [
                ("a", [1.0, 0.0, 0.0, 1.0, x, 0.0]),
                ("scope_a", [1.0, shear, 0.0, 1.0, x + 64.0, 0.0]),
                ("b", [1.0, 0.0, 0.0, 1.0, x + 128.0, 0.0]),
            ];
            let specs = { [("b", "a"), ("2", "a"), ("3", "b")].iter().zip(want) }.map(
                |((id, file), (_, transform))| {
                    spec(id, file, &transform.map(|e| e.to_string()).join(" "))
                },
            );
            write(&list, format!("[{}]", specs.collect::<Vec<_>>().join(",")));
            scope.once(roomy(&list), &archive).await;
            let there = seen(&archive).await;
            assert_eq!(there.len(), 3);
            for (name, transform) in want {
                let there = there[name].transform;
                let is_near = |(a, b): (f64, f64)| (a - b).abs() < 1e-9;
                assert!(
                    there.into_iter().zip(transform).all(is_near),
                    "{name} with a shear of {shear} from {x} on: {there:?}"
                );
            }
        }
    }
}
