//! Labels, from a microscope's tiles to what other programs read.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use image::GrayImage;
use serde_json::{Value, json};

use crate::{Running, done, run, saccade, stderr};

/// Size of the volume, of its tiles, and where the second tile begins.
const EXTENT: [u32; 3] = [200, 150, 2];
const TILE: [u32; 2] = [120, 150];
const SECOND: u32 = 80;

/// The label of a tile's pixel: blocks of objects, between them nothing, and a pixel of another here and there.
fn label(tile: usize, x: u32, y: u32) -> u8 {
    let [a, b] = [[10, 200], [60, 250]][tile];
    match (x / 9 + y / 7 * 2) % 3 {
        0 if (x * 7 + y * 5).is_multiple_of(11) => b,
        0 => a,
        1 => b,
        _ => 0,
    }
}

/// Two tiles that overlap, of labels or, as the control, not.
fn archive(folder: &Path, kind: &str) -> String {
    let scope = folder.join("scope");
    fs::create_dir(&scope).unwrap();
    let volume = json!({"name": "cells", "extent": EXTENT, "voxel_nm": [4, 4, 40], "kind": kind});
    fs::write(scope.join("volume.json"), volume.to_string()).unwrap();
    let mut records = String::new();
    for (n, x) in [0, SECOND].into_iter().enumerate() {
        let image = GrayImage::from_fn(TILE[0], TILE[1], |x, y| image::Luma([label(n, x, y)]));
        image.save(scope.join(format!("{n}.png"))).unwrap();
        let record = json!({"record": "tile", "tile": n.to_string(), "file": format!("{n}.png"), "section": 0,
            "size": TILE, "transform": [1, 0, 0, 1, x, 0]});
        records += &format!("{record}\n");
    }
    fs::write(scope.join("tiles.jsonl"), records).unwrap();
    let archive = folder.join("archive").to_str().unwrap().to_owned();
    done([
        "ingest",
        scope.to_str().unwrap(),
        &archive,
        "--once",
        "--lossless",
    ]);
    archive
}

/// What a server answers; nothing where there is nothing.
fn get(url: &str, path: &str) -> Vec<u8> {
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(async {
        let answer = reqwest::get(format!("{}/v/cells/{path}", url.trim_end_matches('/')))
            .await
            .unwrap();
        match answer.status().as_u16() {
            404 => Vec::new(),
            status => {
                assert_eq!(status, 200, "{path}");
                answer.bytes().await.unwrap().to_vec()
            }
        }
    })
}

fn get_json(url: &str, path: &str) -> Value {
    serde_json::from_slice(&get(url, path)).unwrap()
}

/// The first section of each level whose voxels span one, as rows of labels.
fn sections(url: &str) -> Vec<Vec<Vec<u8>>> {
    let volume = get_json(url, "volume.json")["volume"].take();
    let number = |value: &Value| usize::try_from(value.as_u64().unwrap()).unwrap();
    let [width, height] = [0, 1].map(|axis| number(&volume["chunk"][axis]));
    let levels = volume["levels"].as_array().unwrap();
    let flat = levels
        .iter()
        .take_while(|level| level["downsampling"][2] == 1.0);
    let sections = flat.enumerate().map(|(n, level)| {
        let [w, h] = [0, 1].map(|axis| number(&level["extent"][axis]));
        let mut rows = vec![vec![0; w]; h];
        for (cy, cx) in
            (0..h.div_ceil(height)).flat_map(|y| (0..w.div_ceil(width)).map(move |x| (y, x)))
        {
            let chunk = get(url, &format!("zarr/{n}/c/0/0/{cy}/{cx}"));
            for (y, from) in chunk.chunks(width).take(height).enumerate() {
                let Some(row) = rows.get_mut(cy * height + y) else {
                    break;
                };
                let end = w.min((cx + 1) * width);
                row[cx * width..end].copy_from_slice(&from[..end - cx * width]);
            }
        }
        rows
    });
    sections.collect()
}

/// The most frequent of some labels, of several the smallest.
fn mode(labels: &[u8]) -> u8 {
    let votes = |label: u8| labels.iter().filter(|other| **other == label).count();
    let most = labels.iter().map(|label| votes(*label)).max().unwrap();
    { labels.iter() }
        .filter(|label| votes(**label) == most)
        .min()
        .copied()
        .unwrap()
}

#[test]
fn every_level_that_others_read_has_labels_of_the_tiles() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path(), "labels");
    let (_server, url) = Running::start(saccade().args(["serve", &archive, "--port", "0"]));
    let got = sections(&url);
    assert!(
        got.len() >= 4,
        "some levels are coarser than the tiles' pyramids"
    );

    // Of two tiles the one whose centre is nearer; centres of voxels are never as near to both.
    let of = |x: u32, y: u32, by: u32| {
        let tile = usize::from(x * by + by / 2 >= 100);
        let left = [0, SECOND][tile];
        let labels = (0..by * by).map(|n| label(tile, x * by + n % by - left, y * by + n / by));
        mode(&labels.collect::<Vec<_>>())
    };
    for (level, by) in [(0, 1), (1, 2)] {
        for (y, row) in (0..).zip(&got[level]) {
            for (x, voxel) in (0..).zip(row) {
                assert_eq!(*voxel, of(x, y, by), "{x}, {y} of level {level}");
            }
        }
    }
    // Coarser ones than the pyramids have are voted for by voxels of the level that they do have.
    for (y, row) in got[2].iter().enumerate() {
        for (x, voxel) in row.iter().enumerate() {
            let finer =
                (0..4).filter_map(|n| got[1].get(y * 2 + n / 2)?.get(x * 2 + n % 2).copied());
            assert_eq!(
                *voxel,
                mode(&finer.collect::<Vec<_>>()),
                "{x}, {y} of level 2"
            );
        }
    }
    let labels = BTreeSet::from([0, 10, 60, 200, 250]);
    let seen: BTreeSet<u8> = got.iter().flatten().flatten().copied().collect();
    assert_eq!(seen, labels);

    let newer = get_json(&url, "zarr/zarr.json")["attributes"]["ome"].take();
    let older = get_json(&url, "zarr2/.zattrs");
    assert!(
        newer["image-label"].is_object() && newer["multiscales"][0]["type"] == "mode",
        "{newer}"
    );
    assert_eq!(older["image-label"]["version"], "0.4");
    let info = get_json(&url, "precomputed/info");
    assert_eq!(
        (&info["type"], &info["scales"][0]["encoding"]),
        (&json!("segmentation"), &json!("raw"))
    );
    assert_eq!(get_json(&url, "volume.json")["volume"]["kind"], "labels");
}

#[test]
fn the_same_tiles_as_shades_have_values_that_no_object_has() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path(), "intensity");
    let (_server, url) = Running::start(saccade().args(["serve", &archive, "--port", "0"]));
    let coarse = sections(&url).split_off(1);
    let seen: BTreeSet<u8> = coarse.into_iter().flatten().flatten().collect();
    assert!(seen.len() > 20, "{seen:?}");
}

/// An image of labels, 16 by 8 by 4, of which one has an id that fits into no 16 bits.
fn wide_labels(folder: &Path) -> String {
    let image = folder.join("cells.zarr");
    let axis = |name: &str| json!({"name": name, "type": "space", "unit": "nanometer"});
    let scale = json!([{"type": "scale", "scale": [4, 4, 4]}]);
    let group = json!({"zarr_format": 3, "node_type": "group", "attributes": {"ome": {
        "version": "0.5", "image-label": {}, "multiscales": [{"axes": [axis("z"), axis("y"), axis("x")],
            "datasets": [{"path": "0", "coordinateTransformations": scale}]}]}}});
    let array = json!({"zarr_format": 3, "node_type": "array", "shape": [4, 8, 16], "data_type": "uint32",
        "fill_value": 0, "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [4, 8, 16]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]});
    let ids = (0..512_u32).map(|n| if n == 300 { 70_000 } else { n % 7 + 1 });
    let bytes: Vec<u8> = ids.flat_map(u32::to_le_bytes).collect();
    fs::create_dir_all(image.join("0/c/0/0")).unwrap();
    fs::write(image.join("zarr.json"), group.to_string()).unwrap();
    fs::write(image.join("0/zarr.json"), array.to_string()).unwrap();
    fs::write(image.join("0/c/0/0/0"), bytes).unwrap();
    image.to_str().unwrap().to_owned()
}

/// By way of a server as well as from its files; and what is advised then works.
#[test]
fn ids_that_do_not_fit_are_not_exported_without_a_word() {
    let folder = tempfile::tempdir().unwrap();
    let image = wide_labels(folder.path());
    let (_server, url) = Running::start(saccade().args(["serve", &image, "--port", "0"]));
    for (name, place) in [("direct", &image), ("served", &url)] {
        let out = folder.path().join(name);
        let export = |more: &[&str]| {
            let out = out.to_str().unwrap();
            run(["export", place, out].iter().chain(more))
        };
        let refused = export(&[]);
        let said = stderr(&refused);
        assert!(!refused.status.success(), "{name}: {said}");
        assert!(
            said.contains("ids such as 70000") && said.contains("--rename-labels"),
            "{name}: {said}"
        );
        assert!(!out.join(".incoming").exists() && !out.join("zarr.json").exists());
        let allowed = export(&["--rename-labels"]);
        assert!(allowed.status.success(), "{name}: {}", stderr(&allowed));
        assert!(out.join("zarr.json").exists());
    }
}

#[test]
fn whoever_asks_to_mix_labels_is_told_and_gets_labels() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path(), "labels");
    let out = folder
        .path()
        .join("cells.zarr")
        .to_str()
        .unwrap()
        .to_owned();
    let export = |out: &str, more: &[&str]| run(["export", &archive, out].iter().chain(more));
    let mixed = export(&out, &["--interpolation", "linear", "--overlaps", "blend"]);
    let said = stderr(&mixed);
    assert!(mixed.status.success(), "{said}");
    assert!(
        said.contains("\"cells\" holds labels") && said.contains("without interpolation, blending"),
        "{said}"
    );
    let plain = folder
        .path()
        .join("plain.zarr")
        .to_str()
        .unwrap()
        .to_owned();
    let quiet = export(&plain, &["--interpolation", "nearest"]);
    assert!(
        quiet.status.success() && !stderr(&quiet).contains("labels"),
        "{}",
        stderr(&quiet)
    );

    // What was exported is an image of labels, of the same voxels.
    let group = fs::read(Path::new(&out).join("zarr.json")).unwrap();
    let group: Value = serde_json::from_slice(&group).unwrap();
    assert!(
        group["attributes"]["ome"]["image-label"].is_object(),
        "{group}"
    );
    let served = |place: &str| {
        let (_server, url) = Running::start(saccade().args(["serve", place, "--port", "0"]));
        assert_eq!(get_json(&url, "volume.json")["volume"]["kind"], "labels");
        sections(&url)
    };
    let (exported, stitched) = (served(&out), served(&archive));
    assert!(exported.len() > 1);
    for (exported, stitched) in exported.iter().zip(&stitched) {
        assert_eq!(exported, stitched);
    }
}
