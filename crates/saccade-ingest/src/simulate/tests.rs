//! The simulator against what it promises.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::sync::Mutex;
use std::time::{Duration, SystemTime};

use futures::future::BoxFuture;
use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::acquisition::{AcquisitionInfo, Cursor, RecordReader};
use saccade_core::transform::{SectionFromTile, SectionPoint, TilePoint};
use tempfile::TempDir;
use tiff::decoder::{Decoder, DecodingResult};

use super::clock::{PretendClock, SystemClock};
use super::stack::{PhantomStack, StackInfo};
use super::*;

const EXTENT: UVec3 = UVec3::new(190, 171, 3);

fn stack() -> PhantomStack {
    PhantomStack::new(7, EXTENT, DVec3::new(8.0, 8.0, 40.0)).unwrap()
}

/// Small, shaken and turned as far as the overlap allows, as fast as possible.
fn config() -> SimulateConfig {
    SimulateConfig {
        tile: UVec2::new(75, 64),
        overlap: 0.15,
        rotation_deg: 3.0,
        rate_mpixel_s: None,
        ..SimulateConfig::default()
    }
}

fn acquire(config: &SimulateConfig) -> (TempDir, SimulateSummary) {
    let folder = tempfile::tempdir().unwrap();
    let summary = run(
        config,
        &stack(),
        folder.path(),
        &SystemClock,
        &Cancel::new(),
        &(),
    );
    (folder, summary.unwrap())
}

fn records(folder: &Path) -> Vec<Record> {
    let lines = RecordReader::new(folder, Cursor::default())
        .read(usize::MAX)
        .unwrap();
    lines.into_iter().map(|line| line.record.unwrap()).collect()
}

fn tiles(folder: &Path) -> Vec<TileRecord> {
    let tile = |record| match record {
        Record::Tile(tile) => Some(tile),
        Record::Transform(_) | Record::Delete(_) => None,
    };
    records(folder).into_iter().filter_map(tile).collect()
}

fn pixels(folder: &Path, tile: &TileRecord) -> Vec<u8> {
    let mut file = Decoder::new(File::open(folder.join(&tile.file)).unwrap()).unwrap();
    assert_eq!(file.dimensions().unwrap(), (tile.size.x, tile.size.y));
    let DecodingResult::U8(pixels) = file.read_image().unwrap() else {
        panic!("{} is not 8 bit", tile.file)
    };
    pixels
}

/// Every file of a folder, by name.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for folder in [folder.to_owned(), folder.join("tiles")] {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_file() {
                files.insert(
                    path.file_name().unwrap().to_str().unwrap().to_owned(),
                    fs::read(path).unwrap(),
                );
            }
        }
    }
    files
}

/// The stack's value between voxels, in double precision, voxel by voxel.
fn brute_force(stack: &PhantomStack, section: u32, at: DVec2) -> f64 {
    let last = (EXTENT.truncate() - 1).as_dvec2();
    let mut value = 0.0;
    let sample = at - 0.5;
    for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
        let voxel = sample.floor() + DVec2::new(dx, dy);
        let near = 1.0 - (sample - voxel).abs();
        let voxel = voxel.clamp(DVec2::ZERO, last).as_uvec2();
        value += near.x * near.y * f64::from(stack.phantom().value(voxel.x, voxel.y, section));
    }
    value
}

/// The largest difference between a tile and the stack seen through a transform.
fn worst(stack: &PhantomStack, tile: &TileRecord, got: &[u8], truth: SectionFromTile) -> f64 {
    let mut worst: f64 = 0.0;
    for (n, &got) in (0_u32..).zip(got).filter(|(n, _)| n % 7 == 0) {
        let pixel = UVec2::new(n % tile.size.x, n / tile.size.x);
        let at = truth.apply(TilePoint(pixel.as_dvec2() + 0.5)).0;
        let want = brute_force(stack, tile.section, at);
        worst = worst.max((want - f64::from(got)).abs());
    }
    worst
}

#[test]
fn tiles_show_the_stack_through_their_transform() {
    let (folder, summary) = acquire(&config());
    let stack = stack();
    let tiles = tiles(folder.path());
    assert_eq!(
        (summary.tiles, summary.complete),
        (tiles.len() as u64, true)
    );
    assert_eq!(
        summary.tiles,
        Plan::new(&config(), stack.info()).unwrap().tile_count()
    );
    // Of each section a corner, whose tile reaches over the edge, and a tile from within.
    for tile in tiles.iter().step_by(4) {
        let got = pixels(folder.path(), tile);
        let off = worst(&stack, tile, &got, tile.transform);
        assert!(off <= 0.51, "{} is off by {off}", tile.tile);
        // The comparison notices a quarter of a pixel.
        let moved = worst(
            &stack,
            tile,
            &got,
            tile.transform.shifted(DVec2::new(0.25, 0.0)),
        );
        assert!(moved > 5.0, "{} moved is off by {moved} only", tile.tile);
    }
}

fn info(extent: UVec3) -> StackInfo {
    StackInfo {
        name: "s".to_owned(),
        extent,
        voxel_nm: None,
    }
}

/// The first voxel of a section that no tile covers.
fn uncovered(tiles: &[PlannedTile], extent: UVec3) -> Option<UVec2> {
    let tiles: Vec<_> = tiles
        .iter()
        .map(|t| (t.truth.tile_from_section(), t.size.as_dvec2()))
        .collect();
    let covered = |voxel: UVec2| {
        let at = SectionPoint(voxel.as_dvec2() + 0.5);
        tiles.iter().any(|(map, size)| {
            let at = map.apply(at).0;
            at.cmpge(DVec2::ZERO).all() && at.cmplt(*size).all()
        })
    };
    let rows = (0..extent.y).flat_map(|y| (0..extent.x).map(move |x| UVec2::new(x, y)));
    rows.into_iter().find(|voxel| !covered(*voxel))
}

#[test]
fn tiles_cover_every_voxel_however_they_are_shaken() {
    for (extent, tile, overlap) in [
        (UVec3::new(190, 171, 5), UVec2::new(75, 64), 0.15),
        (UVec3::new(250, 250, 3), UVec2::splat(128), 0.10),
        (UVec3::new(301, 97, 3), UVec2::new(64, 129), 0.06),
        (UVec3::new(33, 1, 2), UVec2::splat(32), 0.02),
        (UVec3::new(20, 20, 2), UVec2::splat(64), 0.5),
    ] {
        for wild in [1.0, 1000.0] {
            let config = SimulateConfig {
                tile,
                overlap,
                jitter_px: 10.0 * wild,
                rotation_deg: 2.0 * wild,
                ..config()
            };
            let plan = Plan::new(&config, &info(extent)).unwrap();
            for section in 0..extent.z {
                let mut tiles = plan.tiles(section);
                assert_eq!(
                    uncovered(&tiles, extent),
                    None,
                    "{extent} in {tile}, {overlap}"
                );
                if tiles.len() > 1 {
                    tiles.swap_remove(tiles.len() / 2);
                    assert!(
                        uncovered(&tiles, extent).is_some(),
                        "a missing tile is noticed"
                    );
                }
            }
        }
    }
}

#[test]
fn tiles_are_shaken_as_asked() {
    let extent = UVec3::new(100_000, 100_000, 2);
    let config = SimulateConfig {
        tile: UVec2::splat(4096),
        ..SimulateConfig::default()
    };
    let plan = Plan::new(&config, &info(extent)).unwrap();
    let (mut shifts, mut turns) = (Vec::new(), Vec::new());
    for tile in (0..2).flat_map(|z| plan.tiles(z)) {
        let [a, b, ..] = tile.truth.elements();
        turns.push(b.atan2(a).to_degrees());
        let centre = tile.truth.apply(TilePoint(DVec2::splat(2048.0))).0;
        let step = 4096.0 * 0.9;
        let low = 0.5 * (extent.truncate().as_dvec2() - step * plan.grid().as_dvec2());
        let shift = centre - low - (tile.cell.as_dvec2() + 0.5) * step;
        shifts.extend(shift.to_array());
    }
    let sigma =
        |values: &[f64]| (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt();
    assert!(
        (sigma(&shifts) - 24.0).abs() < 2.0,
        "shifts spread by {}",
        sigma(&shifts)
    );
    assert!(
        (sigma(&turns) - 0.5).abs() < 0.05,
        "turns spread by {}",
        sigma(&turns)
    );

    let wild = SimulateConfig {
        rotation_deg: 500.0,
        overlap: 0.4,
        ..config
    };
    let turned = |t: &PlannedTile| t.truth.elements()[1].asin().to_degrees().abs();
    let tiles = Plan::new(&wild, &info(extent)).unwrap().tiles(0);
    let most = tiles.iter().map(turned).fold(0.0, f64::max);
    assert!((4.99..=5.001).contains(&most), "{most}");
}

#[test]
fn archives_depend_on_the_settings_alone() {
    let quiet = contents(acquire(&config()).0.path());
    assert_eq!(
        quiet.len() as u64,
        // Beside the tiles: the description, the settings, the records.
        3 + Plan::new(&config(), stack().info()).unwrap().tile_count()
    );

    let paced = SimulateConfig {
        rate_mpixel_s: Some(0.5),
        ..config()
    };
    let folder = tempfile::tempdir().unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let clock = PretendClock::default();
    let summary = one_thread
        .install(|| run(&paced, &stack(), folder.path(), &clock, &Cancel::new(), &()))
        .unwrap();
    assert!(
        contents(folder.path()) == quiet,
        "rate and threads change nothing"
    );

    let took = clock.monotonic().as_secs_f64();
    let want = summary.pixels as f64 / 0.5e6;
    assert!(
        (took - want).abs() < 1e-3,
        "{} pixels took {took} s, not {want} s",
        summary.pixels
    );

    let other = contents(
        acquire(&SimulateConfig {
            seed: 2,
            ..config()
        })
        .0
        .path(),
    );
    assert_eq!(
        other.keys().collect::<Vec<_>>(),
        quiet.keys().collect::<Vec<_>>()
    );
    assert!(other != quiet, "another seed is another acquisition");
}

/// A clock on which every wait for the pace can be looked into.
struct Watched<'a> {
    inner: PretendClock,
    at_sleep: Box<dyn Fn() + Send + Sync + 'a>,
}

impl std::fmt::Debug for Watched<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.inner.fmt(f)
    }
}

impl Clock for Watched<'_> {
    fn now(&self) -> SystemTime {
        self.inner.now()
    }
    fn monotonic(&self) -> Duration {
        self.inner.monotonic()
    }
    fn sleep(&self, duration: Duration) -> BoxFuture<'_, ()> {
        self.inner.sleep(duration)
    }
    fn block(&self, duration: Duration) {
        (self.at_sleep)();
        self.inner.block(duration);
    }
}

#[test]
fn a_tile_is_whole_before_its_record() {
    let folder = tempfile::tempdir().unwrap();
    let seen = Mutex::new(BTreeSet::new());
    let look = || {
        let known = tiles(folder.path());
        for tile in &known {
            pixels(folder.path(), tile);
        }
        let named: BTreeSet<_> = known.iter().map(|t| format!("{}.tif", t.tile)).collect();
        for name in contents(folder.path())
            .keys()
            .filter(|n| n.ends_with(".tif"))
        {
            assert!(named.contains(name), "{name} is there without its record");
        }
        seen.lock().unwrap().insert(known.len());
    };
    let clock = Watched {
        inner: PretendClock::default(),
        at_sleep: Box::new(look),
    };
    let config = SimulateConfig {
        rate_mpixel_s: Some(1.0),
        ..config()
    };
    let summary = run(
        &config,
        &stack(),
        folder.path(),
        &clock,
        &Cancel::new(),
        &(),
    )
    .unwrap();
    drop(clock);
    let seen = seen.into_inner().unwrap();
    assert_eq!(
        seen.len() as u64,
        summary.tiles,
        "each tile appeared on its own: {seen:?}"
    );
}

/// Cancels after some tiles.
struct CancelAfter(u64, Cancel);

impl Progress for CancelAfter {
    fn update(&self, state: &State) {
        if state.tiles >= self.0 {
            self.1.cancel();
        }
    }
    fn notice(&self, _: &str) {}
}

#[test]
fn interrupted_acquisitions_go_on() {
    let config = SimulateConfig {
        corrections: Corrections::AfterSection,
        stage_error_px: 3.0,
        shuffle: true,
        ..config()
    };
    let undisturbed = acquire(&config).0;
    let folder = tempfile::tempdir().unwrap();
    let mut complete = false;
    for rounds in 0..100 {
        let cancel = Cancel::new();
        let progress = CancelAfter(4, cancel.clone());
        let summary = run(
            &config,
            &stack(),
            folder.path(),
            &PretendClock::default(),
            &cancel,
            &progress,
        );
        let summary = summary.unwrap();
        assert!(
            contents(folder.path())
                .keys()
                .all(|name| !name.ends_with(".part"))
        );
        complete = summary.complete;
        if complete {
            assert!(rounds >= 3, "it was interrupted");
            break;
        }
    }
    assert!(complete);
    let sorted = |folder: &Path| {
        let mut records: Vec<_> = records(folder)
            .iter()
            .map(|r| serde_json::to_string(r).unwrap())
            .collect();
        records.sort();
        records
    };
    assert_eq!(sorted(folder.path()), sorted(undisturbed.path()));
    let images = |folder: &Path| {
        let mut files = contents(folder);
        files.remove(RecordReader::FILE);
        files
    };
    assert!(images(folder.path()) == images(undisturbed.path()));
}

#[test]
fn corrections_tell_the_truth_when_asked_to() {
    let sections = |folder: &Path| {
        // Sections in the order of the records; corrections as None.
        let tag = |record: &Record| match record {
            Record::Tile(tile) => Some(tile.section),
            Record::Transform(_) | Record::Delete(_) => None,
        };
        let mut order: Vec<_> = records(folder).iter().map(tag).collect();
        order.dedup();
        order
    };
    for (corrections, want) in [
        (Corrections::Never, vec![Some(0), Some(1), Some(2)]),
        (Corrections::AtEnd, vec![Some(0), Some(1), Some(2), None]),
        (
            Corrections::AfterSection,
            vec![Some(0), None, Some(1), None, Some(2), None],
        ),
    ] {
        let config = SimulateConfig {
            corrections,
            stage_error_px: 4.0,
            ..config()
        };
        let (folder, summary) = acquire(&config);
        assert_eq!(sections(folder.path()), want);
        let plan = Plan::new(&config, stack().info()).unwrap();
        let truth: BTreeMap<_, _> = (0..3)
            .flat_map(|z| plan.tiles(z))
            .map(|t| (t.name, t.truth))
            .collect();
        for record in records(folder.path()) {
            match record {
                Record::Tile(tile) => {
                    let off = tile.transform.elements()[4] - truth[&tile.tile].elements()[4];
                    assert!(off != 0.0 && off.abs() <= 12.0, "the stage is off by {off}");
                }
                Record::Transform(moved) => {
                    // Text keeps all but the last bit of a number.
                    let want = truth[&moved.tile].elements();
                    let pairs = moved.transform.elements().into_iter().zip(want);
                    let off = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(off < 1e-9, "{} is off by {off}", moved.tile);
                }
                Record::Delete(deleted) => panic!("{} is deleted", deleted.tile),
            }
        }
        let sent = if corrections == Corrections::Never {
            0
        } else {
            summary.tiles
        };
        assert_eq!(summary.corrections, sent);
    }
}

/// An archive goes on only with what made it.
#[test]
fn other_settings_do_not_go_on() {
    let (folder, _) = acquire(&config());
    let path = folder.path();
    let before = contents(path);
    let attempt = |config: &SimulateConfig, stack: &dyn Stack| {
        let clock = PretendClock::default();
        let checked = check(config, stack, path).map_err(|error| error.to_string());
        let ran = run(config, stack, path, &clock, &Cancel::new(), &());
        let ran = ran.map(|_| ()).map_err(|error| error.to_string());
        assert_eq!(checked, ran, "the check says what would happen");
        ran
    };
    let say = |config: SimulateConfig| attempt(&config, &stack()).unwrap_err();
    let with = config;
    for (config, words) in [
        (
            SimulateConfig { seed: 2, ..with() },
            "seed is 1 there, 2 now",
        ),
        (
            SimulateConfig {
                overlap: 0.2,
                ..with()
            },
            "overlap is 0.15 there, 0.2 now",
        ),
        (
            SimulateConfig {
                jitter_px: 3.5,
                ..with()
            },
            "jitter is 24.0 there, 3.5 now",
        ),
        (
            SimulateConfig {
                rotation_deg: 0.0,
                ..with()
            },
            "rotation is 3.0 there, 0.0 now",
        ),
        (
            SimulateConfig {
                stage_error_px: 2.0,
                ..with()
            },
            "stage-error is 0.0 there, 2.0 now",
        ),
        (
            SimulateConfig {
                shuffle: true,
                ..with()
            },
            "shuffle is false there, true now",
        ),
        (
            SimulateConfig {
                tile: UVec2::splat(64),
                ..with()
            },
            "tile is 75 x 64 there, 64 x 64 now",
        ),
        (
            SimulateConfig {
                name: Some("w".into()),
                ..with()
            },
            "name is phantom there, w now",
        ),
        (
            SimulateConfig {
                voxel_nm: Some(DVec3::splat(5.0)),
                ..with()
            },
            "voxel-nm is 8 x 8 x 40 there, 5 x 5 x 5 now",
        ),
    ] {
        let said = say(config);
        assert!(said.contains(words), "{words:?} is not in: {said}");
        assert_eq!(said.matches(" there, ").count(), 1, "{said}");
    }
    let larger = PhantomStack::new(7, EXTENT + 1, DVec3::new(8.0, 8.0, 40.0)).unwrap();
    let said = attempt(&config(), &larger).unwrap_err();
    assert!(
        said.contains("extent is 190 x 171 x 3 there, 191 x 172 x 4 now"),
        "{said}"
    );

    let allowed = SimulateConfig {
        rate_mpixel_s: Some(1.0),
        corrections: Corrections::AtEnd,
        ..config()
    };
    check(&allowed, &stack(), path).unwrap();
    assert!(
        contents(path) == before,
        "refused runs and checks write nothing"
    );

    // A microscope's archive, and one whose description somebody broke.
    fs::remove_file(path.join(Settings::FILE)).unwrap();
    assert!(say(config()).contains("was not simulated"));
    fs::remove_file(path.join(AcquisitionInfo::FILE)).unwrap();
    assert!(
        say(config()).contains("was not simulated"),
        "its records are there"
    );
    fs::write(path.join(AcquisitionInfo::FILE), "{}").unwrap();
    let broken = check(&config(), &stack(), path).unwrap_err();
    assert!(matches!(broken, SimulateError::Archive { .. }), "{broken}");
    assert_eq!(fs::read(path.join(AcquisitionInfo::FILE)).unwrap(), b"{}");
}

#[test]
fn bad_settings_and_folders_are_refused() {
    let beyond = UVec3::new(u32::MAX, 40, u32::MAX);
    let huge = PhantomStack::new(1, beyond, DVec3::ONE).unwrap();
    let refused = Plan::new(&SimulateConfig::default(), huge.info()).unwrap_err();
    assert!(refused.to_string().contains("2,097,152"), "{refused}");

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let attempt = |config: &SimulateConfig, path: &Path| {
        run(
            config,
            &stack(),
            path,
            &PretendClock::default(),
            &Cancel::new(),
            &(),
        )
        .unwrap_err()
    };
    for bad in [
        SimulateConfig {
            tile: UVec2::new(8, 64),
            ..config()
        },
        SimulateConfig {
            overlap: 0.0,
            ..config()
        },
        SimulateConfig {
            jitter_px: f64::NAN,
            ..config()
        },
        SimulateConfig {
            rotation_deg: -1.0,
            ..config()
        },
        SimulateConfig {
            rate_mpixel_s: Some(0.0),
            ..config()
        },
        SimulateConfig {
            voxel_nm: Some(DVec3::ZERO),
            ..config()
        },
    ] {
        assert!(
            matches!(attempt(&bad, path), SimulateError::Setting { .. }),
            "{bad:?}"
        );
    }
    assert_eq!(
        fs::read_dir(path).unwrap().count(),
        0,
        "nothing was written"
    );

    AcquisitionInfo::new("other", UVec3::ONE, DVec3::ONE)
        .write(path)
        .unwrap();
    let refused = attempt(&config(), path);
    assert!(
        matches!(&refused, SimulateError::NotSimulated { .. }),
        "{refused}"
    );
    assert!(refused.to_string().ends_with(&path.display().to_string()));

    let name = Some("a b".to_owned());
    let named = attempt(&SimulateConfig { name, ..config() }, path);
    assert!(matches!(named, SimulateError::Name(_)), "{named}");

    let file = path.join("file");
    fs::write(&file, "").unwrap();
    assert!(matches!(
        attempt(&config(), &file.join("x")),
        SimulateError::Archive { .. }
    ));
}
