//! Replay on small made-up acquisitions, and on a real one where it is at hand.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec2, UVec2, UVec3};
use saccade_archive::acquisition::{Cursor, RecordReader};
use saccade_archive::image::{GrayImage, decode_file};
use saccade_core::transform::{SectionFromTile, TilePoint};
use tempfile::TempDir;

use super::*;
use crate::simulate::clock::PretendClock;
use crate::simulate::write::write_part;

/// Writes an image in which every tile differs.
fn image(path: &Path, size: UVec2, seed: u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let count = usize::try_from(size.x * size.y).unwrap();
    let voxels = (0..count)
        .map(|n| u8::try_from(n % 200).unwrap() + seed)
        .collect();
    let part = write_part(path, &GrayImage::new(size.x, size.y, voxels)).unwrap();
    fs::rename(part, path).unwrap();
}

/// Two sections of two tiles of 30 x 20; sections count from 4, the solution's frame is far away.
fn acquisition() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = |file: &str| folder.path().join(file);
    for (n, name) in (0..).zip(["a", "b", "c", "d"]) {
        image(&at(&format!("pictures/{name}.tif")), UVec2::new(30, 20), n);
    }
    fs::write(at("README.txt"), "Four tiles\nfrom 2026\n").unwrap();
    fs::write(
        at("list.txt"),
        "x/c.tif 0 0 5\nx/a.tif -3 0 4\nx/b.tif 22 0 4\nx/d.tif 24 1 5\n",
    )
    .unwrap();
    let patch = |file: &str, matrix: &str| {
        format!(
            r#"<t2_patch width="30" height="20" transform="matrix({matrix})" file_path="/far/{file}.tif"/>"#
        )
    };
    let project = |a: &str, b: &str, c: &str, d: &str| {
        format!(
            r#"<trakem2><t2_layer z="0">{}{}</t2_layer><t2_layer z="1">{}{}</t2_layer></trakem2>"#,
            patch("a", a),
            patch("b", b),
            patch("c", c),
            patch("d", d)
        )
    };
    // The first says what the stage says, moved; the second is incomplete; the third refines.
    let same = project(
        "1,0,0,1,97,50",
        "1,0,0,1,122,50",
        "1,0,0,1,100,50",
        "1,0,0,1,124,51",
    );
    fs::write(at("a_same.xml"), same).unwrap();
    fs::write(
        at("b_part.xml"),
        format!(
            r#"<trakem2><t2_layer z="0">{}</t2_layer></trakem2>"#,
            patch("a", "1,1,0,1,0,0")
        ),
    )
    .unwrap();
    let refined = project(
        "1,0,0,1,97,50",
        "1,0,0,1,123,52",
        "1,0,0,1,100,50",
        "1,0.01,-0.01,1,124,51",
    );
    fs::write(at("c_refined.xml"), refined).unwrap();
    folder
}

fn found(path: &Path) -> Acquisition {
    match detect(path).unwrap() {
        Input::Acquisition(acquisition) => acquisition,
        other => panic!("{other:?}"),
    }
}

fn records(folder: &Path) -> Vec<Record> {
    let lines = RecordReader::new(folder, Cursor::default())
        .read(usize::MAX)
        .unwrap();
    lines.into_iter().map(|line| line.record.unwrap()).collect()
}

#[test]
fn lists_and_solutions_are_found_and_share_a_frame() {
    let folder = acquisition();
    let acquisition = found(folder.path());
    assert_eq!(acquisition.list, folder.path().join("list.txt"));
    assert_eq!(
        acquisition.solution,
        Some(folder.path().join("c_refined.xml"))
    );
    let order: Vec<_> = acquisition
        .tiles
        .iter()
        .map(|t| (t.name.as_str(), t.section))
        .collect();
    assert_eq!(order, [("a", 0), ("b", 0), ("c", 1), ("d", 1)]);

    let corner = |transform: SectionFromTile| transform.apply(TilePoint(DVec2::ZERO)).0;
    let origin = corner(acquisition.tiles[0].stage);
    let near = |transform: SectionFromTile, want: DVec2| {
        let at = corner(transform) - origin;
        assert!(
            (at - want).abs().max_element() < 0.5,
            "{at} is not near {want}"
        );
    };
    // In the frame of `a` on the stage: the median offset, about (100, 50), is gone.
    near(acquisition.tiles[1].stage, DVec2::new(25.0, 0.0));
    near(acquisition.tiles[0].aligned.unwrap(), DVec2::new(0.0, 0.0));
    near(acquisition.tiles[1].aligned.unwrap(), DVec2::new(26.0, 2.0));
    for tile in &acquisition.tiles {
        for transform in [tile.stage, tile.aligned.unwrap()] {
            let (low, high) = transform.bounds(tile.size.as_dvec2());
            assert!(low.0.min_element() >= 0.0);
            assert!(high.0.cmple(acquisition.extent.truncate().as_dvec2()).all());
        }
    }
    assert_eq!(acquisition.extent.z, 2);
    assert!(
        acquisition.extent.x <= 59,
        "no larger than needed: {}",
        acquisition.extent
    );
}

/// Two tiles of 30 x 20 in a folder of pictures.
fn two_pictures() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (n, name) in (0..).zip(["a", "b"]) {
        let path = folder.path().join(format!("pictures/{name}.tif"));
        image(&path, UVec2::new(30, 20), n);
    }
    folder
}

/// Images of 16 bits make a volume of 16 bits; those of 8 among them are said to be there.
#[test]
fn a_replay_has_the_depth_of_its_images() {
    use saccade_archive::acquisition::AcquisitionInfo;
    use saccade_core::volume::Dtype;
    use tiff::encoder::{TiffEncoder, colortype};
    let folder = two_pictures();
    let deepen = |name: &str| {
        let path = folder.path().join(format!("pictures/{name}.tif"));
        let mut encoder = TiffEncoder::new(fs::File::create(path).unwrap()).unwrap();
        let voxels = vec![5000; 600];
        encoder
            .write_image::<colortype::Gray16>(30, 20, &voxels)
            .unwrap();
    };
    fs::write(
        folder.path().join("list.txt"),
        "a.tif 0 0 0\nb.tif 25 0 0\n",
    )
    .unwrap();
    for (deep, dtype, said) in [
        (None, Dtype::Uint8, "2 tiles of 8 bits in"),
        (
            Some("a"),
            Dtype::Uint16,
            "2 tiles of 16 bits (1 of 8, which",
        ),
        (Some("b"), Dtype::Uint16, "2 tiles of 16 bits in"),
    ] {
        if let Some(name) = deep {
            deepen(name);
        }
        let input = detect(folder.path()).unwrap();
        assert!(input.describe().contains(said), "{}", input.describe());
        let out = tempfile::tempdir().unwrap();
        let config = ReplayConfig {
            rate_mpixel_s: None,
            solution_after: Duration::ZERO,
            ..ReplayConfig::default()
        };
        let (clock, cancel) = (PretendClock::default(), Cancel::new());
        let acquisition = found(folder.path());
        run(&config, &acquisition, out.path(), &clock, &cancel, &()).unwrap();
        assert_eq!(AcquisitionInfo::read(out.path()).unwrap().dtype, dtype);
    }
}

/// From the corner of tile 0 to that of tile 1: on the stage, and in the solution.
fn steps(acquisition: &Acquisition) -> (DVec2, Option<DVec2>) {
    let corner = |transform: SectionFromTile| transform.apply(TilePoint(DVec2::ZERO)).0;
    let [a, b] = &acquisition.tiles[..] else {
        panic!("two tiles")
    };
    let solved = b.aligned.zip(a.aligned);
    let solved = solved.map(|(b, a)| corner(b) - corner(a));
    (corner(b.stage) - corner(a.stage), solved)
}

#[test]
fn tile_configurations_come_with_what_was_registered() {
    let folder = two_pictures();
    let at = |file: &str| folder.path().join(file);
    let tiles = |x: f64, y: f64| format!("dim = 2\na.tif; ; (0, 0)\nb.tif; ; ({x}, {y})\n");
    fs::write(at("TileConfiguration.txt"), tiles(27.0, 0.0)).unwrap();
    let stage = found(folder.path());
    assert_eq!(steps(&stage), (DVec2::new(27.0, 0.0), None));

    fs::write(at("TileConfiguration.registered.txt"), tiles(25.5, 1.25)).unwrap();
    let solved = found(folder.path());
    assert!(solved.list.ends_with("TileConfiguration.txt"));
    let registered = solved.solution.as_ref().unwrap();
    assert!(registered.ends_with("TileConfiguration.registered.txt"));
    let want = (DVec2::new(27.0, 0.0), Some(DVec2::new(25.5, 1.25)));
    assert_eq!(steps(&solved), want);

    // Without the stage's, the registered one is a list like any other.
    fs::remove_file(at("TileConfiguration.txt")).unwrap();
    let alone = found(folder.path());
    assert_eq!(steps(&alone), (DVec2::new(25.5, 1.25), None));
}

#[test]
fn tile_specs_hold_stage_and_solution() {
    let folder = two_pictures();
    let spec = |name: &str, stage: [f64; 2], affine: &str| {
        format!(
            r#"{{"tileId": "{name}.1", "z": 1015.0, "width": 30.0, "height": 20.0,
                 "layout": {{"stageX": {}, "stageY": {}}},
                 "mipmapLevels": {{"0": {{"imageUrl": "file:/elsewhere/{name}.tif"}}}},
                 "transforms": {{"type": "list", "specList": [{{
                     "className": "mpicbg.trakem2.transform.AffineModel2D",
                     "dataString": "{affine}"}}]}}}}"#,
            stage[0], stage[1]
        )
    };
    let write_at = |stages: [[f64; 2]; 2], b: &str| {
        let specs = [spec("a", stages[0], "1 0 0 1 0 0"), spec("b", stages[1], b)];
        fs::write(
            folder.path().join("specs.json"),
            format!("[{}]", specs.join(",")),
        )
        .unwrap();
    };
    let write = |b: &str| write_at([[1000.0, 500.0], [1027.0, 500.0]], b);
    fs::write(folder.path().join("other.json"), r#"{"microscope": 7}"#).unwrap();
    write("1 0.01 -0.01 1 26 2");
    let acquisition = found(folder.path());
    assert!(acquisition.list.ends_with("specs.json"));
    assert_eq!(acquisition.extent.z, 1, "sections count from the first");
    let want = (DVec2::new(27.0, 0.0), Some(DVec2::new(26.0, 2.0)));
    assert_eq!(steps(&acquisition), want);
    let turned = acquisition.tiles[1].aligned.unwrap().elements();
    assert_eq!(turned[..4], [1.0, 0.01, -0.01, 1.0]);

    // A solution that says what the stage says is none.
    write("1 0 0 1 27 0");
    assert_eq!(found(folder.path()).solution, None);

    // A stage that counts nanometers, or goes elsewhere, says nothing of where pixels lie.
    for (x, y) in [(1_108_000.0, 500_000.0), (1_000_000.0, 499_900.0)] {
        write_at([[1_000_000.0, 500_000.0], [x, y]], "1 0 0 1 26 2");
        let acquisition = found(folder.path());
        assert_eq!(acquisition.extent, UVec3::new(56, 22, 1));
        assert_eq!(steps(&acquisition).0, DVec2::new(26.0, 2.0));
    }
}

#[test]
fn a_replay_goes_on_where_it_was_and_ends_with_the_solution() {
    let input = acquisition();
    let acquisition = found(input.path());
    let folder = tempfile::tempdir().unwrap();
    let clock = PretendClock::default();
    let config = ReplayConfig {
        rate_mpixel_s: Some(0.0012),
        ..ReplayConfig::default()
    };

    struct Stop(Cancel);
    impl Progress for Stop {
        fn update(&self, state: &State) {
            if state.tiles == 2 {
                self.0.cancel();
            }
        }
        fn notice(&self, _: &str) {}
    }
    let stop = Stop(Cancel::new());
    let first = run(&config, &acquisition, folder.path(), &clock, &stop.0, &stop).unwrap();
    assert_eq!((first.tiles, first.complete), (2, false));
    let second = run(
        &config,
        &acquisition,
        folder.path(),
        &clock,
        &Cancel::new(),
        &(),
    )
    .unwrap();
    assert_eq!(
        (second.tiles, second.corrections, second.complete),
        (2, 4, true)
    );
    // Half a second per tile, one of which was begun twice, and the wait for the solution.
    let took = clock.monotonic().as_secs_f64();
    assert!((4.0..4.6).contains(&took), "{took} s");

    let info = AcquisitionInfo::read(folder.path()).unwrap();
    assert_eq!(info.extent, acquisition.extent);
    let records = records(folder.path());
    assert_eq!(records.len(), 8);
    for (record, tile) in records.iter().zip(&acquisition.tiles) {
        let Record::Tile(record) = record else {
            panic!("tiles come first: {record:?}")
        };
        assert_eq!((&record.tile, record.section), (&tile.name, tile.section));
        assert_eq!(record.transform, tile.stage);
        let copied = decode_file(&folder.path().join(&record.file)).unwrap();
        assert!(
            copied == decode_file(&tile.image).unwrap(),
            "{}",
            record.file
        );
        assert_eq!(UVec2::new(copied.width, copied.height), record.size);
    }
    assert!(matches!(&records[4], Record::Transform(moved) if moved.tile == "a"));

    let again = run(
        &config,
        &acquisition,
        folder.path(),
        &clock,
        &Cancel::new(),
        &(),
    )
    .unwrap();
    assert_eq!(
        (again.tiles, again.corrections, again.complete),
        (0, 0, true)
    );

    // Another acquisition, though of the same size, does not go on here; the same one, elsewhere, does.
    check(&config, &acquisition, folder.path()).unwrap();
    let mut other = acquisition.clone();
    other.tiles[1].stage = other.tiles[1].stage.shifted(DVec2::X);
    let refused = check(&config, &other, folder.path()).unwrap_err();
    let said = std::error::Error::source(&refused).unwrap().to_string();
    assert!(said.contains("input is acquisition "), "{said}");
    let moved = tempfile::tempdir().unwrap();
    let mut elsewhere = acquisition.clone();
    for tile in &mut elsewhere.tiles {
        let image = moved.path().join(tile.image.file_name().unwrap());
        fs::copy(&tile.image, &image).unwrap();
        tile.image = image;
    }
    check(&config, &elsewhere, folder.path()).unwrap();
    let name = Some("no/name".to_owned());
    let named = ReplayConfig { name, ..config };
    assert!(check(&named, &acquisition, folder.path()).is_err());
}

#[test]
fn what_cannot_be_used_is_said() {
    let folder = acquisition();
    fs::remove_file(folder.path().join("pictures/b.tif")).unwrap();
    let error = detect(folder.path()).unwrap_err();
    assert!(
        matches!(&error, ReplayError::MissingImages { missing: 1, tiles: 4, first, .. } if first == "x/b.tif"),
        "{error}"
    );

    let empty = tempfile::tempdir().unwrap();
    assert!(matches!(
        detect(empty.path()),
        Err(ReplayError::Stack { .. })
    ));
    assert!(matches!(
        detect(&empty.path().join("none")),
        Err(ReplayError::Stack { .. })
    ));
    fs::write(empty.path().join(AcquisitionInfo::FILE), "{}").unwrap();
    assert!(matches!(
        detect(empty.path()),
        Err(ReplayError::AlreadyArchive { .. })
    ));
}

/// A folder with a list is an acquisition, whatever is wrong with the list: never a stack of its images.
#[test]
fn a_list_that_makes_no_sense_is_no_stack() {
    let plain = "a.tif 0 0 0\nb.tif 25 0 0\n";
    let fiji = "dim = 2\na.tif; ; (0, 0)\nb.tif; ; (25, 0)\n";
    let stage = r#""layout": {"stageX": 0, "stageY": 0}"#;
    let spec = |name: &str, width: &str| {
        format!(
            r#"{{"tileId": "{name}", "z": 0, "width": {width}, "height": 20, {stage},
                "mipmapLevels": {{"0": {{"imageUrl": "{name}.tif"}}}}, "transforms": {{"specList": []}}}}"#
        )
    };
    let specs = format!("[{}, {}]", spec("a", "30"), spec("b", "-30"));
    let broken: [(&str, String, &str); 12] = [
        ("list.txt", plain.replace("25", "x"), "line 2: x is \"x\""),
        (
            "list.txt",
            plain.replace("25", "nan"),
            "line 2: x is \"nan\"",
        ),
        (
            "list.txt",
            plain.replace("a.tif 0 0 0", "a.tif 0 0"),
            "line 1: ",
        ),
        (
            "list.txt",
            plain.replace("0\nb", "0.5\nb"),
            "line 1: z is \"0.5\"",
        ),
        ("list.txt", format!("# stage\n{plain}the end\n"), "line 4: "),
        (
            "list.txt",
            "a.tif nan 0 0\n".to_owned(),
            "line 1: x is \"nan\"",
        ),
        (
            "TileConfiguration.txt",
            fiji.replace("25", "nan"),
            "line 3: ",
        ),
        ("tiles.txt", fiji.replace("(25", "(2 5"), "line 3: "),
        (
            "TileConfiguration.txt",
            fiji.replace("dim = 2\n", ""),
            "line 1: ",
        ),
        ("TileConfiguration.txt", String::new(), "line 1: "),
        (
            "TileConfiguration.registered.txt",
            fiji.replace("25", "nan"),
            "line 3: ",
        ),
        ("specs.json", specs, "tile \"b\": width is -30"),
    ];
    for (file, text, said) in broken {
        let folder = two_pictures();
        if file.contains("registered") {
            fs::write(folder.path().join("TileConfiguration.txt"), fiji).unwrap();
        }
        let path = folder.path().join(file);
        fs::write(&path, &text).unwrap();
        let error = detect(folder.path()).unwrap_err();
        let ReplayError::Acquisition { source } = &error else {
            panic!("{text}: {error:?}")
        };
        let told = source.to_string();
        assert!(told.starts_with(said), "{text}: {told}");
        assert!(told.ends_with(&path.display().to_string()), "{told}");
    }
    // Lists of images that are elsewhere.
    for (file, text) in [
        ("list.txt", plain.replace(".tif", "2.tif")),
        ("TileConfiguration.txt", fiji.replace(".tif", "2.tif")),
        ("what.txt", fiji.replace(".tif", ".raw")),
    ] {
        let folder = two_pictures();
        fs::write(folder.path().join(file), text).unwrap();
        let error = detect(folder.path()).unwrap_err();
        let missing = matches!(error, ReplayError::MissingImages { missing: 2, .. });
        assert!(missing, "{file}: {error:?}");
    }
    // Prose about the images, and tables of something else.
    for text in [
        "a.tif is the first section, b.tif the second\n",
        "threshold 3 4 5\nsigma 1 1 x\n",
        "x y z\n1 2 3\n",
        "a.tif\nb.tif\n",
    ] {
        let folder = two_pictures();
        fs::write(folder.path().join("notes.txt"), text).unwrap();
        let found = detect(folder.path()).unwrap();
        assert!(matches!(found, Input::Stack { .. }), "{text}: {found:?}");
    }
}

#[test]
fn a_project_without_its_list_is_no_stack() {
    let folder = acquisition();
    fs::remove_file(folder.path().join("list.txt")).unwrap();
    let error = detect(folder.path()).unwrap_err();
    let told = error.to_string();
    assert!(
        matches!(error, ReplayError::NoList { images: 4, .. }),
        "{error:?}"
    );
    assert!(
        told.contains("file x y z") && told.contains("a_same.xml"),
        "{told}"
    );

    // One that cannot be read is not passed over, with a list or without.
    let folder = acquisition();
    let project = folder.path().join("c_refined.xml");
    let text = fs::read_to_string(&project).unwrap();
    fs::write(&project, text.replace("0.01", "nought")).unwrap();
    for _ in 0..2 {
        let error = detect(folder.path()).unwrap_err();
        let ReplayError::Acquisition { source } = &error else {
            panic!("{error:?}")
        };
        let told = source.to_string();
        assert!(
            told.contains("nought") && told.contains("c_refined.xml"),
            "{told}"
        );
        fs::write(folder.path().join("list.txt"), "").unwrap();
        fs::remove_file(folder.path().join("a_same.xml")).unwrap_or_default();
        fs::remove_file(folder.path().join("b_part.xml")).unwrap_or_default();
    }
    // Other XML is no project.
    let folder = two_pictures();
    fs::write(folder.path().join("microscope.xml"), "<scope>").unwrap();
    assert!(matches!(
        detect(folder.path()).unwrap(),
        Input::Stack { .. }
    ));
}

#[test]
fn of_several_folders_the_raw_images_are_the_stack() {
    let folder = tempfile::tempdir().unwrap();
    for (name, sections) in [("labels", 4), ("other", 3), ("raw", 2)] {
        for n in 0..sections {
            image(
                &folder.path().join(name).join(format!("{n}.tif")),
                UVec2::new(9, 7),
                n,
            );
        }
    }
    let inner = folder.path().join("cortex 7");
    fs::create_dir(&inner).unwrap();
    for name in ["labels", "other", "raw"] {
        fs::rename(folder.path().join(name), inner.join(name)).unwrap();
    }
    let Input::Stack { stack, path, name } = detect(&inner).unwrap() else {
        panic!("it is a stack")
    };
    assert_eq!(name, "cortex-7", "as the user calls it, not as its inside");
    assert_eq!(path, inner.join("raw"));
    assert_eq!(stack.info().extent, UVec3::new(9, 7, 2));
    fs::remove_dir_all(inner.join("raw")).unwrap();
    let Input::Stack { path, .. } = detect(&inner).unwrap() else {
        panic!("it is a stack")
    };
    assert_eq!(path, inner.join("other"));
}

/// Real data beside the workspace, or a message that it is missing.
fn shared(folder: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let shared = std::env::var_os("SACCADE_SHARED").map_or(beside, PathBuf::from);
    let path = shared.join("data").join(folder);
    if path.is_dir() {
        return Some(path);
    }
    let is_named = std::env::var_os("SACCADE_SHARED").is_some();
    assert!(
        !is_named,
        "SACCADE_SHARED is set, but {} is not there",
        path.display()
    );
    let text = format!("skipped: {} is not there\n", path.display());
    io::Write::write_all(&mut io::stderr(), text.as_bytes()).unwrap();
    None
}

#[test]
fn real_stacks_are_found() {
    for (folder, inside, extent) in [
        (
            "fib25-medulla",
            "training_sample2/grayscale_maps",
            UVec3::splat(250),
        ),
        ("vnc-sstem/stack1", "raw", UVec3::new(1024, 1024, 20)),
    ] {
        let Some(folder) = shared(folder) else { return };
        let Input::Stack { stack, path, name } = detect(&folder).unwrap() else {
            panic!("{} is a stack", folder.display())
        };
        let leaf = folder.file_name().unwrap().to_str().unwrap();
        assert_eq!(name, leaf, "as the user calls it");
        assert_eq!(path, folder.join(inside));
        assert_eq!(stack.info().extent, extent);
        let last = stack
            .region(extent.z - 1, UVec2::ZERO, extent.truncate())
            .unwrap();
        let mean =
            last.voxels.iter().map(|v| f64::from(*v)).sum::<f64>() / last.voxels.len() as f64;
        assert!(
            (60.0..200.0).contains(&mean),
            "{mean} is no mean of an EM image"
        );
    }
}

#[test]
fn a_real_acquisition_is_replayed() {
    let Some(folder) = shared("at-tutorial-tiles") else {
        return;
    };
    let acquisition = found(&folder);
    assert!(
        acquisition.list.ends_with("DEMO_post_mongo/rick0.txt"),
        "{:?}",
        acquisition.list
    );
    let solution = acquisition.solution.clone().unwrap();
    assert!(
        solution.ends_with("temp0_final/stack/Affine.xml"),
        "{solution:?}"
    );
    assert_eq!((acquisition.tiles.len(), acquisition.extent.z), (42, 3));

    // A refinement, not a jump: the solution stays near the stage, though not at it.
    let mut moves: Vec<f64> = acquisition
        .tiles
        .iter()
        .map(|tile| {
            let middle = TilePoint(tile.size.as_dvec2() / 2.0);
            (tile.aligned.unwrap().apply(middle).0 - tile.stage.apply(middle).0).length()
        })
        .collect();
    moves.sort_by(f64::total_cmp);
    assert!(
        moves[21] < 300.0,
        "half of the tiles move by less than {}",
        moves[21]
    );
    assert!(moves[41] > 1.0, "something moves");

    let archive = tempfile::tempdir().unwrap();
    let config = ReplayConfig::default();
    let clock = PretendClock::default();
    let summary = run(
        &config,
        &acquisition,
        archive.path(),
        &clock,
        &Cancel::new(),
        &(),
    )
    .unwrap();
    assert_eq!(
        (summary.tiles, summary.corrections, summary.complete),
        (42, 42, true)
    );
    assert_eq!(records(archive.path()).len(), 84);
    let took = clock.monotonic().as_secs_f64();
    let want = summary.pixels as f64 / 10e6 + 2.0;
    assert!((took - want).abs() < 1e-3, "{took} s instead of {want} s");
}
