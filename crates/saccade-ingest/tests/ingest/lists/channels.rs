//! Lists of images of several channels.

use std::collections::BTreeMap;

use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{AcquisitionInfo, ChannelRef, Record};
use saccade_ingest::Cancel;
use saccade_ingest::replay::{Input, detect};
use saccade_ingest::watch::{ListConfig, Pattern, Until, follow};

use super::{SIZE, Scope, config, roomy, write};
use crate::scope::{VOLUME, archive, seen};

async fn channels(archive: &VisualizationArchive) -> BTreeMap<String, u32> {
    let mut all = BTreeMap::new();
    for z in archive.catalog().sections(VOLUME).await.unwrap() {
        let tiles = archive.catalog().section_tiles(VOLUME, z).await.unwrap();
        all.extend(tiles.into_iter().map(|tile| (tile.name, tile.channel)));
    }
    all
}

fn of(tiles: &[(&str, u32)]) -> BTreeMap<String, u32> {
    let tiles = tiles.iter();
    tiles
        .map(|(name, channel)| ((*name).to_owned(), *channel))
        .collect()
}

/// A specification with an image for each channel.
fn spec(id: &str, channels: &[&str]) -> String {
    let image = |file: String| {
        format!(r#""mipmapLevels": {{"0": {{"imageUrl": "file:/far/{file}.tif"}}}}"#)
    };
    let named = |name: &&str| format!(r#"{{"name": "{name}", {}}}"#, image(format!("{id}_{name}")));
    let channels: Vec<_> = channels.iter().map(named).collect();
    format!(
        r#"{{"tileId": "{id}", "z": 0, "width": {}, "height": {}, {}, "channels": [{}],
            "transforms": {{"type": "list", "specList": [
                {{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "1 0.01 0 1 3 0"}}]}}}}"#,
        SIZE.x,
        SIZE.y,
        image(id.to_owned()),
        channels.join(",")
    )
}

/// Which channels there are is what the list names at first, in its order, unless it is said.
#[tokio::test]
async fn names_say_the_channel_and_the_order_of_the_list_theirs() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let by_name = || ListConfig {
        channel_in: Some(Pattern::of_channels("{}_{channel}.tif").unwrap()),
        ..roomy(&list)
    };
    for (seed, name) in (1..).zip(["a_SE", "a_BSE", "b_SE", "b_BSE", "c_CL", "c"]) {
        scope.image(name, seed);
    }
    let archive = archive(&scope.0.path().join("archive")).await;
    // Of a later section, but first in the list.
    let lines = "a_SE.tif 0 0 1\nb_BSE.tif 0 0 0\nb_SE.tif 0 0 0\n";
    write(&list, lines);
    scope.once(by_name(), &archive).await;
    let info = AcquisitionInfo::read(&scope.kept()).unwrap();
    assert_eq!(info.channels, ["SE", "BSE"]);
    let first = [("a_SE", 0), ("b_BSE", 1), ("b_SE", 0)];
    assert_eq!(channels(&archive).await, of(&first));

    // One of another channel is set aside, one that says none left out; the rest goes on.
    write(
        &list,
        format!("{lines}a_BSE.tif 0 0 1\nc_CL.tif 0 0 1\nc.tif 0 0 1\n"),
    );
    let watch = scope.once(by_name(), &archive).await;
    let missing = watch.missing().unwrap();
    drop(watch);
    for said in [
        "1 of the 6 images",
        "c.tif",
        "--channel-in {}_{channel}.tif",
        "\"_\"",
    ] {
        assert!(missing.contains(said), "{missing}");
    }
    let all = [&first[..], &[("a_BSE", 1)]].concat();
    assert_eq!(channels(&archive).await, of(&all));
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(set_aside.len(), 1);
    assert!(
        set_aside[0].reason.contains("no such channel"),
        "{set_aside:?}"
    );
    let told = scope.records().len();
    drop(scope.once(by_name(), &archive).await);
    assert_eq!(scope.records().len(), told, "nothing is told again");
    // A list of which no name fits takes nothing out.
    write(&list, "c.tif 0 0 1\n");
    let mut watch = scope.watch(by_name());
    let refused = follow(&mut watch, Until::End, true, &Cancel::new());
    let refused = refused.unwrap_err().to_string();
    assert!(
        refused.contains("no image that the list names fits"),
        "{refused}"
    );
    assert_eq!(scope.records().len(), told);
}

/// Channels' images are called alike, each in a folder of its own.
#[tokio::test]
async fn an_image_that_is_late_shows_no_other_channel() {
    for before in ["", "pictures/", "/far/"] {
        let scope = Scope::new();
        let list = scope.file("list.txt");
        for (seed, name) in (1..).zip(["BSE/r0", "BSE/r1", "SE/r0"]) {
            scope.image(name, seed);
        }
        let line = |file: &str, z: u32| format!("{before}{file}.tif 0 0 {z}\n");
        let se = line("SE/r0", 0) + &line("SE/r1", 1);
        write(&list, &se);
        let config = || ListConfig {
            channel_in: Some(Pattern::of_channels("{channel}/{}.tif").unwrap()),
            channels: Some(vec!["SE".to_owned(), "BSE".to_owned()]),
            ..roomy(&list)
        };
        let archive = archive(&scope.0.path().join("archive")).await;
        let watch = scope.once(config(), &archive).await;
        assert_eq!(channels(&archive).await, of(&[("r0", 0)]), "{before}");
        assert!(watch.missing().unwrap().contains("SE/r1"));
        drop(watch);
        write(&list, se + &line("BSE/r0", 0) + &line("BSE/r1", 1));
        drop(scope.once(config(), &archive).await);
        assert_eq!(channels(&archive).await.len(), 3, "{before}");
        scope.image("SE/r1", 4);
        drop(scope.once(config(), &archive).await);
        let all = channels(&archive).await;
        let per_channel = [0, 1].map(|c| all.values().filter(|of| **of == c).count());
        assert_eq!(per_channel, [2, 2], "{before}");
    }
}

/// Names that say another channel are none of it, also where nothing else tells.
#[tokio::test]
async fn an_image_of_another_channel_is_not_taken_wherever_it_lies() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    scope.image("BSE/r0", 1);
    write(&list, "/far/SE/r0.tif 0 0 0\n/far/BSE/q.tif 0 0 0\n");
    scope.image("x/q", 2);
    let config = ListConfig {
        channel_in: Some(Pattern::of_channels("{channel}/{}.tif").unwrap()),
        channels: Some(vec!["SE".to_owned(), "BSE".to_owned(), "x".to_owned()]),
        ..roomy(&list)
    };
    let mut watch = scope.watch(config);
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    let missing = watch.missing().unwrap();
    assert!(missing.contains("2 of the 2 images"), "{missing}");
    assert!(scope.records().is_empty());
}

/// Where a list names images as parts of URLs, so it does channels.
#[tokio::test]
async fn channels_are_named_as_they_are_meant() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    for (seed, name) in (1..).zip(["in SE/a", "in SE/b", "BSE %/a"]) {
        scope.image(name, seed);
    }
    write(
        &list,
        "/far/in%20SE/a.tif 0 0 0\n/far/in SE/b.tif 50 0 0\n/far/BSE%20%25/a.tif 0 0 0\n",
    );
    let config = ListConfig {
        channel_in: Some(Pattern::of_channels("{channel}/{}.tif").unwrap()),
        ..roomy(&list)
    };
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.once(config, &archive).await;
    let info = AcquisitionInfo::read(&scope.kept()).unwrap();
    assert_eq!(info.channels, ["in SE", "BSE %"]);
    assert_eq!(channels(&archive).await.len(), 3);
}

/// Fiji registers one channel, and the others were imaged at the same places.
#[tokio::test]
async fn what_registration_does_not_know_goes_with_the_channel_that_it_knows() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let by_name = || ListConfig {
        channel_in: Some(Pattern::of_channels("{}_{channel}.tif").unwrap()),
        ..roomy(&list)
    };
    let lines = |places: &[(&str, f64, f64)]| {
        let line = |(name, x, y): &(&str, f64, f64)| format!("{name}.tif; ; ({x}, {y})\n");
        format!("dim = 2\n{}", places.iter().map(line).collect::<String>())
    };
    for (seed, name) in (1..).zip(["a_SE", "b_SE", "c_SE", "a_BSE", "b_BSE", "c_BSE"]) {
        scope.image(name, seed);
    }
    let archive = archive(&scope.0.path().join("archive")).await;
    let all = [
        ("a_SE", 0.0, 0.0),
        ("a_BSE", 0.0, 0.0),
        ("b_SE", 50.0, 0.0),
        ("b_BSE", 50.0, 0.0),
        ("c_SE", 100.0, 0.0),
        // One that was not imaged with the others.
        ("c_BSE", 101.0, 0.0),
    ];
    write(&list, lines(&all));
    scope.once(by_name(), &archive).await;
    let se = [
        ("a_SE", 700.0, 9.0),
        ("b_SE", 753.0, 11.0),
        ("c_SE", 800.0, 9.0),
    ];
    write(&registered, lines(&se));
    scope.once(by_name(), &archive).await;
    let tiles = seen(&archive).await.into_iter();
    let places = tiles.map(|(name, tile)| (name, [tile.transform[4], tile.transform[5]]));
    let want = [
        ("a_BSE", [0.0, 0.0]),
        ("a_SE", [0.0, 0.0]),
        ("b_BSE", [53.0, 2.0]),
        ("b_SE", [53.0, 2.0]),
        ("c_BSE", [101.0, 0.0]),
        ("c_SE", [100.0, 0.0]),
    ];
    let want = want.map(|(name, place)| (name.to_owned(), place));
    assert_eq!(places.collect::<Vec<_>>(), want);
}

/// Render's tiles name an image for each channel; a replay shows the same.
#[tokio::test]
async fn specifications_name_channels() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    for (seed, name) in (1..).zip(["a", "a_PSD95", "a_DAPI", "b", "b_PSD95", "b_DAPI"]) {
        scope.image(name, seed);
    }
    let archive = archive(&scope.0.path().join("archive")).await;
    let specs = |b: &[&str]| format!("[{},{}]", spec("a", &["PSD95", "DAPI"]), spec("b", b));
    write(&list, specs(&["PSD95", "DAPI"]));
    scope.once(config(&list), &archive).await;
    let all = [("a_DAPI", 1), ("a_PSD95", 0), ("b_DAPI", 1), ("b_PSD95", 0)];
    assert_eq!(channels(&archive).await, of(&all));
    // Registration counts for each of them.
    let records = scope.records();
    for record in &records {
        let Record::Tile(tile) = record else {
            panic!("{record:?}")
        };
        assert_eq!(tile.transform.elements()[..4], [1.0, 0.01, 0.0, 1.0]);
    }
    let Input::Acquisition(replayed) = detect(&scope.path()).unwrap() else {
        panic!("a list")
    };
    assert_eq!(replayed.channels, ["PSD95", "DAPI"]);
    let tiles = replayed
        .tiles
        .iter()
        .map(|tile| (tile.name.clone(), tile.channel.clone().unwrap()));
    let names = ["PSD95", "DAPI"];
    let want = of(&all)
        .into_iter()
        .map(|(name, n)| (name, names[n as usize].to_owned()));
    assert_eq!(
        tiles.collect::<BTreeMap<_, _>>(),
        want.collect::<BTreeMap<_, _>>()
    );
    assert!(replayed.tiles.iter().all(|tile| tile.aligned.is_some()));
}

/// What an earlier version began, which knew no channels, shows what it showed.
#[tokio::test]
async fn a_volume_that_was_begun_without_channels_goes_on_so() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    for (seed, name) in (1..).zip(["a", "a_PSD95", "a_DAPI", "b", "b_PSD95", "b_DAPI"]) {
        scope.image(name, seed);
    }
    let archive = archive(&scope.0.path().join("archive")).await;
    write(&list, format!("[{},{}]", spec("a", &[]), spec("b", &[])));
    scope.once(config(&list), &archive).await;
    assert_eq!(channels(&archive).await, of(&[("a", 0), ("b", 0)]));
    let told = scope.records();
    let named = ["PSD95", "DAPI"];
    write(
        &list,
        format!("[{},{}]", spec("a", &named), spec("b", &named)),
    );
    scope.once(config(&list), &archive).await;
    assert_eq!(scope.records(), told);
}

/// A channel that was spelt wrong in the list, and is mended, moves the image there.
#[tokio::test]
async fn an_image_that_is_of_another_channel_goes_there() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    for (seed, name) in (1..).zip(["a_SE", "a_BSE", "x"]) {
        scope.image(name, seed);
    }
    let swapped = |first: &str, second: &str| {
        let text = spec("a", &["SE", "BSE"])
            .replace("a_SE.tif", "one")
            .replace("a_BSE.tif", "two");
        format!("[{}]", text.replace("one", first).replace("two", second))
    };
    let archive = archive(&scope.0.path().join("archive")).await;
    write(&list, swapped("a_SE.tif", "a_BSE.tif"));
    scope.once(roomy(&list), &archive).await;
    assert_eq!(channels(&archive).await, of(&[("a_SE", 0), ("a_BSE", 1)]));
    write(&list, swapped("a_BSE.tif", "a_SE.tif"));
    scope.once(roomy(&list), &archive).await;
    assert_eq!(channels(&archive).await, of(&[("a_SE", 1), ("a_BSE", 0)]));
    let last = scope.records().pop().unwrap();
    let Record::Tile(last) = last else {
        panic!("{last:?}")
    };
    assert!(matches!(last.channel, Some(ChannelRef::Name(_))));
}
