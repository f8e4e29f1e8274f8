//! Every kind of list shows what its replay shows.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::tile_specs;
use saccade_core::volume::Dtype;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};
use saccade_ingest::replay::{self, Input, ReplayConfig, detect, find_list};
use saccade_ingest::simulate::clock::SystemClock;
use saccade_ingest::watch::{Disk, ListWatch, Until, follow};

use super::{SIZE, Scope, VOXEL, config, write};
use crate::scope::{VOLUME, archive, pixels, quick, seen, tiff16};

/// Takes a folder in by its list, and by a replay: both show the same. How many tiles there are.
pub(super) async fn is_as_replayed(folder: &Path) -> usize {
    let beside = tempfile::tempdir().unwrap();
    let Input::Acquisition(acquisition) = detect(folder).unwrap() else {
        panic!("{} holds no list", folder.display())
    };
    let replayed = ReplayConfig {
        name: Some(VOLUME.to_owned()),
        voxel_nm: VOXEL,
        rate_mpixel_s: None,
        solution_after: Duration::ZERO,
    };
    let (cancel, clock) = (Cancel::new(), SystemClock);
    let second = beside.path().join("replayed");
    replay::run(&replayed, &acquisition, &second, &clock, &cancel, &()).unwrap();
    let want = archive(&beside.path().join("want")).await;
    run(&second, &want, &quick(), &(), &cancel).await.unwrap();

    let list = find_list(folder).unwrap().unwrap();
    assert_eq!(list, acquisition.list);
    let kept = beside.path().join("kept");
    let mut watch = ListWatch::open(config(&list), Disk, folder, &kept).unwrap();
    follow(&mut watch, Until::End, true, &cancel).unwrap();
    assert_eq!(watch.missing(), None);
    let got = archive(&beside.path().join("got")).await;
    let options = IngestOptions {
        linked: Some(watch.folder().to_owned()),
        ..quick()
    };
    run(&kept, &got, &options, &(), &cancel).await.unwrap();

    let volume = |archive: &VisualizationArchive| archive.catalog().clone();
    assert_eq!(
        volume(&got).volume(VOLUME).await.unwrap(),
        volume(&want).volume(VOLUME).await.unwrap()
    );
    let (got, want) = (seen(&got).await, seen(&want).await);
    assert!(got.keys().eq(want.keys()));
    for (name, want) in &want {
        let got = &got[name];
        assert_eq!((got.section, got.size), (want.section, want.size), "{name}");
        let apart = got.transform.iter().zip(want.transform);
        let apart = apart.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(
            apart < 1e-9,
            "{name}: {:?}, {:?}",
            got.transform,
            want.transform
        );
        let depth = acquisition.dtype;
        if depth == Dtype::Uint8 {
            assert_eq!(pixels(got).await, pixels(want).await, "{name}");
        }
    }
    want.len()
}

fn patch(file: &str, matrix: &str) -> String {
    format!(
        r#"<t2_patch width="60" height="50" transform="matrix({matrix})" file_path="/far/{file}.tif"/>"#
    )
}

fn project(layers: &[&[(&str, &str)]]) -> String {
    let layers = layers.iter().enumerate().map(|(z, patches)| {
        let patches: String = patches
            .iter()
            .map(|(file, matrix)| patch(file, matrix))
            .collect();
        format!(r#"<t2_layer z="{z}">{patches}</t2_layer>"#)
    });
    format!("<trakem2>{}</trakem2>", layers.collect::<String>())
}

pub(super) fn spec(file: &str, z: u32, stage: [f64; 2], affine: &str) -> String {
    let [x, y] = stage;
    format!(
        r#"{{"tileId": "{file}.{z}", "z": {z}, "width": 60, "height": 50,
            "layout": {{"stageX": {x}, "stageY": {y}}},
            "mipmapLevels": {{"0": {{"imageUrl": "file:///scope/{file}.tif"}}}},
            "transforms": {{"type": "list", "specList": [
                {{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "{affine}"}}]}}}}"#
    )
}

#[tokio::test]
async fn each_kind_of_list_shows_what_its_replay_shows() {
    let names = ["a", "b", "c", "d"];
    let scope = || {
        let scope = Scope::new();
        for (seed, name) in (0..).zip(names) {
            scope.image(name, seed);
        }
        scope
    };
    let plain = "x/a.tif -13.5 7 4\nx/b.tif 40 0 4\nx/c.tif 0 0 5\nx/d.tif 44 1 6\n";

    let with_list = scope();
    write(&with_list.file("list.txt"), plain);
    assert_eq!(is_as_replayed(&with_list.path()).await, 4);

    let with_project = scope();
    write(&with_project.file("list.txt"), plain);
    let refined = project(&[
        &[("a", "1,0,0,1,97,50"), ("b", "1,0.02,0,1,150.5,41")],
        &[("c", "1,0,0.01,1,100,50")],
        &[("d", "0.9,0.01,-0.01,1,144,51")],
    ]);
    write(&with_project.file("work/affine.xml"), refined);
    assert_eq!(is_as_replayed(&with_project.path()).await, 4);

    let of_fiji = scope();
    let tiles = |x: f64| {
        format!(
            "dim = 2\na.tif; ; ({x}, 0)\nb.tif; ; (41.25, -2)\nc.tif; ; (3, 44)\nd.tif; ; (47, 45)\n"
        )
    };
    write(&of_fiji.file("pictures/TileConfiguration.txt"), tiles(0.0));
    assert_eq!(is_as_replayed(&of_fiji.path()).await, 4);
    write(
        &of_fiji.file("pictures/TileConfiguration.registered.txt"),
        tiles(1.75),
    );
    assert_eq!(is_as_replayed(&of_fiji.path()).await, 4);

    let of_render = scope();
    let specs = [
        spec("a", 7, [0.0, 0.0], "1 0.01 -0.01 1 1000 2000"),
        spec("b", 7, [45.0, 0.0], "1 0 0 1 1046 2001"),
        spec("c", 8, [0.0, 1.0], "1 0 0 0.98 1000 2000"),
        spec("d", 8, [45.0, 2.0], "1 0 0 1 1044 1999"),
    ];
    write(
        &of_render.file("specs.json"),
        format!("[{}]", specs.join(",")),
    );
    assert_eq!(is_as_replayed(&of_render.path()).await, 4);

    let deep = scope();
    write(&deep.file("list.txt"), plain);
    write(&deep.file("pictures/c.tif"), tiff16(SIZE));
    assert_eq!(is_as_replayed(&deep.path()).await, 4);
}

/// Real ones, where they are at hand.
#[tokio::test]
#[expect(clippy::print_stderr, reason = "a skipped test says so")]
async fn real_lists_show_what_their_replays_show() {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let shared = std::env::var_os("SACCADE_SHARED").map_or(beside, PathBuf::from);
    let (tutorial, montage) = (
        shared.join("data/at-tutorial-tiles"),
        shared.join("data/asap-em-montage-json"),
    );
    if !tutorial.is_dir() || !montage.is_dir() {
        eprintln!(
            "skipped: no {}; set SACCADE_SHARED",
            shared.join("data").display()
        );
        return;
    }
    assert_eq!(is_as_replayed(&tutorial).await, 42);

    // The specifications came without their images: others, that are smaller, stand for them.
    let scope = Scope::new();
    let specs = montage.join("em_montage_qc_post_tilespecs.json");
    fs::copy(&specs, scope.file("specs.json")).unwrap();
    for (seed, tile) in (0..).zip(tile_specs::read(&specs).unwrap()) {
        scope.image(tile.name(), seed);
    }
    assert_eq!(is_as_replayed(&scope.path()).await, 46);

    // The same tiles as a list of Fiji's, and by a project alone.
    let scope = Scope::new();
    let list = fs::read_to_string(tutorial.join("DEMO_post_mongo/rick0.txt")).unwrap();
    let mut fiji = "dim = 3\n".to_owned();
    for (seed, line) in (0..).zip(list.lines().filter(|line| !line.trim().is_empty())) {
        let words: Vec<_> = line.split_whitespace().collect();
        let [file, x, y, z] = words[..] else {
            panic!("{line}")
        };
        fiji.push_str(&format!("{file}; ; ({x}, {y}, {z})\n"));
        scope.image(Path::new(file).file_stem().unwrap().to_str().unwrap(), seed);
    }
    write(&scope.file("TileConfiguration.txt"), fiji);
    assert_eq!(is_as_replayed(&scope.path()).await, 42);
    fs::remove_file(scope.file("TileConfiguration.txt")).unwrap();
    let affine = tutorial.join("temp0_final/stack/Affine.xml");
    fs::copy(affine, scope.file("Affine.xml")).unwrap();
    let project = find_list(&scope.path()).unwrap().unwrap();
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.once(config(&project), &archive).await;
    assert_eq!(seen(&archive).await.len(), 42);
}
