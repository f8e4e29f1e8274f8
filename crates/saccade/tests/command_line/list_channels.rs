//! Lists of images of several channels, through the program alone: each channel shows its own.

use std::fs;
use std::path::Path;

use image::{GrayImage, Luma};
use serde_json::{Value, json};

use super::errors::{assert_failed, text};
use super::update::ended;
use super::{Running, done, run, saccade, stderr};

const WIDTH: u32 = 30;
const HEIGHT: u32 = 30;

fn shade(channel: usize, tile: usize, x: u32, y: u32) -> u8 {
    let shade = [10, 130][channel] + 50 * u8::try_from(tile).unwrap();
    shade + u8::try_from((x + 2 * y) % 9).unwrap()
}

/// Two tiles beside each other, in two channels.
fn pictures(folder: &Path, name: impl Fn(usize, usize) -> String) {
    for (channel, tile) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        let image = GrayImage::from_fn(WIDTH, HEIGHT, |x, y| Luma([shade(channel, tile, x, y)]));
        let path = folder.join(name(channel, tile));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        image.save(path).unwrap();
    }
}

fn get(url: &str, path: &str) -> Vec<u8> {
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    let url = format!("{}/v/scope/{path}", url.trim_end_matches('/'));
    runtime.block_on(async {
        let answer = reqwest::get(url).await.unwrap();
        assert_eq!(answer.status().as_u16(), 200, "{path}");
        answer.bytes().await.unwrap().to_vec()
    })
}

/// Every voxel of both channels is that of its image.
fn are_shown(archive: &Path, names: [&str; 2]) {
    let (_serving, url) = Running::start(saccade().args(["serve", text(archive), "--port", "0"]));
    let volume: Value = serde_json::from_slice(&get(&url, "volume.json")).unwrap();
    let volume = &volume["volume"];
    assert_eq!(volume["channels"], json!(names), "{volume}");
    assert_eq!(volume["levels"][0]["extent"], json!([2 * WIDTH, HEIGHT, 1]));
    let width = usize::try_from(volume["chunk"][0].as_u64().unwrap()).unwrap();
    assert!(width >= 2 * WIDTH as usize, "one chunk holds it");
    for channel in 0..2 {
        let chunk = get(&url, &format!("zarr/0/c/{channel}/0/0/0"));
        for (x, y) in (0..HEIGHT).flat_map(|y| (0..2 * WIDTH).map(move |x| (x, y))) {
            let (tile, inside) = (x / WIDTH, x % WIDTH);
            let want = shade(channel, tile as usize, inside, y);
            assert_eq!(
                chunk[y as usize * width + x as usize],
                want,
                "{channel}: {x}, {y}"
            );
        }
    }
}

#[test]
fn names_of_images_say_the_channel() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    pictures(&scope, |channel, tile| {
        format!("t{tile}_{}.png", ["SE", "BSE"][channel])
    });
    let list = scope.join("TileConfiguration.txt");
    let lines = "dim = 2\nt0_BSE.png; ; (5, 7)\nt0_SE.png; ; (5, 7)\nt1_BSE.png; ; (35, 7)\nt1_SE.png; ; (35, 7)\n";
    fs::write(&list, lines).unwrap();
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--once",
        "--voxel",
        "4",
        "--lossless",
    ];
    let with = |more: &[&str]| run([&ingest[..], more].concat());
    let channels = ["--channels", "SE,BSE"];
    assert_failed(
        &with(&channels),
        1,
        &["does not say", "--channel-in", text(&list)],
    );
    let unfit = with(&["--channel-in", "{channel}/{}.png"]);
    assert_failed(
        &unfit,
        1,
        &["t0_BSE.png", "--channel-in {channel}/{}.png", "1"],
    );
    let wrong = with(&["--channel-in", "{}.png"]);
    assert_failed(
        &wrong,
        2,
        &["where the name of the {channel} is", "{}_{channel}.tif"],
    );
    let twice = with(&["--channel-in", "{}_{channel}.png", "--channels", "SE,SE"]);
    assert_failed(&twice, 1, &["two channels", "\"SE\""]);
    assert!(!archive.join("catalog.sqlite").exists());

    let named = ["--channel-in", "{}_{channel}.png", "--channels", "SE,BSE"];
    done([&ingest[..], &named].concat());
    are_shown(&archive, ["SE", "BSE"]);
    // It goes on as it was begun.
    let other = with(&["--channel-in", "t{}_{channel}.png", "--channels", "SE,BSE"]);
    assert_failed(&other, 1, &["channel-in is {}_{channel}.png there"]);
    let other = with(&["--channel-in", "{}_{channel}.png", "--channels", "BSE,SE"]);
    assert_failed(&other, 1, &["channels is SE,BSE there, BSE,SE now"]);

    // One whose name says none is left out, and told; one of a channel that the volume has not is set aside.
    for more in ["overview.png", "t0_CL.png"] {
        fs::copy(scope.join("t0_SE.png"), scope.join(more)).unwrap();
    }
    fs::write(
        &list,
        format!("{lines}overview.png; ; (5, 7)\nt0_CL.png; ; (5, 7)\n"),
    )
    .unwrap();
    let said = [
        "1 of the 6 images that the list names do not fit --channel-in",
        "overview.png",
        "no such channel",
        "t0_CL.png",
    ];
    ended(&with(&named), 3, &said);
    are_shown(&archive, ["SE", "BSE"]);
}

#[test]
fn tile_specifications_name_an_image_for_each_channel() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    // Of one name in both.
    pictures(&scope, |channel, tile| {
        format!("raw/{}/t{tile}.png", ["PSD95", "DAPI"][channel])
    });
    let image = |name: &str, tile: usize| json!({"0": {"imageUrl": format!("file:/scope/raw/{name}/t{tile}.png")}});
    let spec = |tile: usize| {
        let channel = |name: &str| json!({"name": name, "mipmapLevels": image(name, tile)});
        let x = WIDTH as usize * tile;
        json!({
            "tileId": tile.to_string(), "z": 400.0, "width": WIDTH, "height": HEIGHT,
            "mipmapLevels": image("DAPI", tile),
            "channels": [channel("PSD95"), channel("DAPI")],
            "transforms": {"type": "list", "specList": [
                {"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": format!("1 0 0 1 {x} 9")},
            ]},
        })
    };
    fs::write(
        scope.join("specs.json"),
        json!([spec(0), spec(1)]).to_string(),
    )
    .unwrap();
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--once",
        "--voxel",
        "4",
        "--lossless",
    ];
    let said = stderr(&done(ingest));
    assert!(said.contains("4 tiles taken in"), "{said}");
    are_shown(&archive, ["PSD95", "DAPI"]);
}
