use std::fs::{self, File};
use std::path::Path;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;

use super::*;
use crate::acquisition::{Record, RecordReader, RecordWriter, TileRecord};
use crate::catalog::NewTile;
use crate::image::GrayImage;
use crate::pyramid::{Encoding, encode};

mod audit;
mod called;
mod doubled;
mod meanwhile;
mod meddled;
mod rows;
mod set_aside;
mod unsound;

const VOLUME: &str = "v";
const TILES: u32 = 6;

/// An archive with tiles of two sizes, and the records that they were made of.
struct Fixture {
    folder: tempfile::TempDir,
    acquisition: tempfile::TempDir,
    archive: VisualizationArchive,
    names: Vec<String>,
}

impl Fixture {
    async fn new() -> Self {
        let (folder, acquisition) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let archive = VisualizationArchive::create(folder.path()).await.unwrap();
        let volume = Volume::new(VOLUME, UVec3::new(900, 900, 8), DVec3::ONE).unwrap();
        archive.catalog().create_volume(&volume).await.unwrap();
        let mut names = Vec::new();
        for n in 0..TILES {
            let size = UVec2::new(200 + 10 * (n % 2), 150);
            let file = format!("t{n}.tif");
            File::create(acquisition.path().join(&file)).unwrap();
            let record = TileRecord {
                tile: format!("t{n}"),
                file,
                section: n / 2,
                size,
                transform: SectionFromTile::translation(DVec2::splat(3.0)),
                channel: None,
            };
            let list = acquisition.path().join(RecordReader::FILE);
            let position = fs::metadata(&list).map_or(0, |m| m.len());
            let mut writer = RecordWriter::open(acquisition.path()).unwrap();
            writer.append(&Record::Tile(record.clone())).unwrap();
            let object = format!("tiles/v/{:06}/t{n}-{position:x}.tif", record.section);
            let value = |at: u32| u8::try_from((at * 7 + at / 13 + n * 31) % 251).unwrap() + 1;
            let image = GrayImage {
                width: size.x,
                height: size.y,
                voxels: (0..size.x * size.y).map(value).collect(),
            };
            let bytes = encode(&image, &Encoding::Lossless).unwrap();
            let bytes = pyramid::named(bytes, &object).unwrap();
            let written = archive.storage().write_durable(&object, bytes).await;
            written.unwrap();
            let tile = NewTile {
                name: record.tile,
                section: record.section,
                channel: 0,
                size,
                transform: record.transform,
                pyramid: object.clone(),
                position,
            };
            archive.catalog().commit_tile(VOLUME, &tile).await.unwrap();
            names.push(object);
        }
        let read = Cursor {
            offset: fs::metadata(acquisition.path().join(RecordReader::FILE))
                .unwrap()
                .len(),
            line: u64::from(TILES),
            seen: None,
        };
        let mut commit = archive.catalog().begin(VOLUME).await.unwrap();
        commit.cursor(read).await.unwrap();
        commit.finish().await.unwrap();
        Self {
            folder,
            acquisition,
            archive,
            names,
        }
    }

    fn path(&self, n: usize) -> PathBuf {
        self.folder.path().join(&self.names[n])
    }

    /// Does what no program should to the catalog.
    async fn meddle(&self, statements: &[&str]) {
        let file = self.folder.path().join("catalog.sqlite");
        let meddle = sqlx::SqlitePool::connect(file.to_str().unwrap()).await;
        let meddle = meddle.unwrap();
        for statement in statements {
            let statement = sqlx::AssertSqlSafe((*statement).to_owned());
            sqlx::query(statement).execute(&meddle).await.unwrap();
        }
        meddle.close().await;
    }

    async fn check(&self, quick: bool) -> CheckReport {
        let options = CheckOptions {
            quick,
            safe_age: Duration::ZERO,
            ..CheckOptions::default()
        };
        check(&self.archive, &options, &|_, _| {}).await.unwrap()
    }
}

/// Kinds and tiles of what was found.
fn found(report: &CheckReport) -> Vec<(FindingKind, &str)> {
    let all = report.findings.iter().map(|finding| {
        let name = finding.tile.as_deref().or(finding.object.as_deref());
        (finding.kind, name.unwrap_or_default())
    });
    all.collect()
}

#[tokio::test]
async fn a_whole_archive_is_whole() {
    let fixture = Fixture::new().await;
    for quick in [true, false] {
        let report = fixture.check(quick).await;
        assert_eq!(report.findings, []);
        assert_eq!((report.tiles, report.damage()), (TILES.into(), 0));
        assert_eq!(report.without_checksums, 0);
        assert_eq!((report.queued, report.set_aside), (0, 0));
        let sizes = (0..6).map(|n| fs::metadata(fixture.path(n)).unwrap().len());
        assert_eq!(report.bytes, sizes.sum::<u64>());
    }
}

#[tokio::test]
async fn every_damage_is_found_and_named() {
    type Damage = fn(&Fixture);
    /// What, how, whether a quick look finds it, and as what.
    type Case<'a> = (&'a str, Damage, bool, &'a [(FindingKind, &'a str)]);
    fn change(path: &Path, change: impl FnOnce(&mut Vec<u8>)) {
        let mut bytes = fs::read(path).unwrap();
        change(&mut bytes);
        fs::write(path, bytes).unwrap();
    }
    let kinds: [Case<'_>; 11] = [
        (
            "a folder",
            |f| {
                fs::remove_file(f.path(3)).unwrap();
                fs::create_dir(f.path(3)).unwrap();
            },
            true,
            &[(FindingKind::Damaged, "t3")],
        ),
        (
            "gone",
            |f| fs::remove_file(f.path(2)).unwrap(),
            true,
            &[(FindingKind::Missing, "t2")],
        ),
        (
            "cut",
            |f| change(&f.path(1), |b| b.truncate(b.len() - 1)),
            true,
            &[(FindingKind::Damaged, "t1")],
        ),
        (
            "emptied",
            |f| change(&f.path(1), Vec::clear),
            true,
            &[(FindingKind::Damaged, "t1")],
        ),
        (
            "grown",
            |f| change(&f.path(1), |b| b.push(0)),
            true,
            &[(FindingKind::Damaged, "t1")],
        ),
        (
            "a bit of its last sub-tile",
            |f| {
                change(&f.path(5), |b| {
                    let at = b.len() - 9;
                    b[at] ^= 4;
                });
            },
            false,
            &[(FindingKind::Damaged, "t5")],
        ),
        (
            "a bit of its description",
            |f| change(&f.path(5), |b| b[150] ^= 1),
            true,
            &[(FindingKind::Damaged, "t5")],
        ),
        (
            "overwritten",
            |f| change(&f.path(0), |b| b.fill(0)),
            true,
            &[(FindingKind::Damaged, "t0")],
        ),
        (
            "swapped",
            |f| {
                let (a, b) = (fs::read(f.path(0)).unwrap(), fs::read(f.path(1)).unwrap());
                fs::write(f.path(0), b).unwrap();
                fs::write(f.path(1), a).unwrap();
            },
            true,
            &[(FindingKind::Mistaken, "t0"), (FindingKind::Mistaken, "t1")],
        ),
        (
            "swapped with one of its size",
            |f| {
                let (a, b) = (fs::read(f.path(0)).unwrap(), fs::read(f.path(2)).unwrap());
                fs::write(f.path(0), b).unwrap();
                fs::write(f.path(2), a).unwrap();
            },
            true,
            &[(FindingKind::Mistaken, "t0"), (FindingKind::Mistaken, "t2")],
        ),
        (
            "one that nobody names",
            |f| fs::write(f.folder.path().join("tiles/v/000000/stray-7.tif"), "stray").unwrap(),
            true,
            &[(FindingKind::Orphan, "tiles/v/000000/stray-7.tif")],
        ),
    ];
    for (what, damage, quickly, want) in kinds {
        let fixture = Fixture::new().await;
        damage(&fixture);
        let report = fixture.check(false).await;
        assert_eq!(found(&report), want, "{what}");
        let lost = want.iter().filter(|(kind, _)| kind.is_damage()).count();
        assert_eq!(report.damage(), lost, "{what}");
        let quick = fixture.check(true).await;
        assert_eq!(
            found(&quick),
            if quickly { want } else { &[] },
            "{what}, quickly"
        );
    }
}

#[tokio::test]
async fn young_objects_may_be_about_to_be_entered() {
    let fixture = Fixture::new().await;
    fs::write(fixture.folder.path().join("tiles/v/young.tif"), "young").unwrap();
    let options = CheckOptions {
        repair: true,
        ..CheckOptions::default()
    };
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    assert_eq!((report.young, report.findings.len()), (1, 0));
    assert!(fixture.folder.path().join("tiles/v/young.tif").exists());
}

#[tokio::test]
async fn repairs_touch_nothing_that_is_whole() {
    let fixture = Fixture::new().await;
    let stray = fixture.folder.path().join("tiles/v/000000/stray-7.tif");
    fs::write(&stray, "stray").unwrap();
    fs::write(fixture.path(1), "damaged").unwrap();
    fs::remove_file(fixture.path(4)).unwrap();
    // The image of the second is gone, too.
    fs::remove_file(fixture.acquisition.path().join("t4.tif")).unwrap();
    let whole: Vec<_> = [0, 2, 3, 5]
        .map(|n| fs::read(fixture.path(n)).unwrap())
        .into();
    let options = CheckOptions {
        repair: true,
        acquisition: Some(fixture.acquisition.path().to_owned()),
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    let repairs: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
    assert_eq!(
        repairs,
        [
            (FindingKind::Damaged, Some(Repair::Queued)),
            (FindingKind::Missing, Some(Repair::Quarantined)),
            (FindingKind::Orphan, Some(Repair::Deleted)),
        ]
    );
    assert_eq!(report.damage(), 1, "what is in quarantine is not mended");
    assert!(!stray.exists());
    let after: Vec<_> = [0, 2, 3, 5]
        .map(|n| fs::read(fixture.path(n)).unwrap())
        .into();
    assert_eq!(after, whole);
    let waiting = fixture.archive.catalog().waiting(VOLUME).await.unwrap();
    assert_eq!(waiting.len(), 1);
    assert_eq!(waiting[0].record.tile, "t1");
    let set_aside = fixture.archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(set_aside[0].tile.as_deref(), Some("t4"));
    assert_eq!((report.queued, report.set_aside), (1, 1));
    assert_eq!(
        fixture.archive.catalog().entry(VOLUME).await.unwrap().tiles,
        6
    );
}

/// What a later catalog names is not deleted with an older copy of it, and what is somebody's own not at all.
#[tokio::test]
async fn what_this_catalog_cannot_know_is_never_deleted() {
    let fixture = Fixture::new().await;
    let tiles = fixture.folder.path().join("tiles");
    let put = |name: &str| {
        let path = tiles.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "something").unwrap();
        path
    };
    let later = ["v/000000/t9-ffff.tif", "v/000003/t9-again2-fffff.tif"].map(put);
    let foreign = [
        "v/notes.txt",
        "v/000000/notes-7.txt",
        "v/x/t-7.tif",
        "other/000000/t0-0.tif",
        "t0-0.tif",
    ]
    .map(put);
    let options = CheckOptions {
        repair: true,
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    let told = |words: &str| {
        report
            .findings
            .iter()
            .filter(|f| f.reason.contains(words))
            .count()
    };
    assert_eq!(
        (told("older copy"), told("no pyramid of this")),
        (later.len(), foreign.len())
    );
    assert_eq!(report.findings.len(), later.len() + foreign.len());
    assert!(report.findings.iter().all(|f| f.repair.is_none()));
    assert!(later.iter().chain(&foreign).all(|path| path.exists()));
}

#[tokio::test]
async fn a_folder_in_the_place_of_a_pyramid_is_told_and_the_others_are_repaired() {
    let fixture = Fixture::new().await;
    for folder in [0, 3] {
        fs::remove_file(fixture.path(folder)).unwrap();
        fs::create_dir(fixture.path(folder)).unwrap();
    }
    fs::write(fixture.path(4), "damaged").unwrap();
    let options = CheckOptions {
        repair: true,
        acquisition: Some(fixture.acquisition.path().to_owned()),
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    let repairs = async || {
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        assert_eq!(report.tiles, u64::from(TILES));
        let told = |f: &Finding| f.reason.contains("take it away");
        let findings = report.findings.iter();
        let repairs = findings.map(|f| (f.tile.clone().unwrap(), f.repair, told(f)));
        (repairs.collect::<Vec<_>>(), report.damage())
    };
    let of = |n: u32, repair, told| (format!("t{n}"), repair, told);
    let queued = Some(Repair::Queued);
    let want = vec![of(0, None, true), of(3, None, true), of(4, queued, false)];
    assert_eq!(repairs().await, (want, 2));
    assert!(fixture.path(0).is_dir() && fixture.path(3).is_dir());
    // Once it is away, the tile is given back to ingest.
    fs::remove_dir(fixture.path(3)).unwrap();
    let want = vec![
        of(0, None, true),
        of(3, queued, false),
        of(4, queued, false),
    ];
    assert_eq!(repairs().await, (want, 1));
    let waiting = fixture.archive.catalog().waiting(VOLUME).await.unwrap();
    let waiting: Vec<_> = waiting.into_iter().map(|w| w.record.tile).collect();
    assert_eq!(waiting, ["t3", "t4"]);
}

/// A volume of a bare folder has its records beside the archive: whoever repairs it need not know of them.
#[tokio::test]
async fn what_is_kept_of_a_bare_folder_is_found() {
    for (kept, expected) in [(VOLUME, Repair::Queued), ("other", Repair::Quarantined)] {
        let mut fixture = Fixture::new().await;
        let watched = tempfile::tempdir().unwrap();
        let folder = watched.path().join(kept);
        fs::rename(fixture.acquisition.path(), &folder).unwrap();
        fixture.acquisition = tempfile::tempdir().unwrap();
        fixture
            .archive
            .storage()
            .delete(&fixture.names[3])
            .await
            .unwrap();
        let options = CheckOptions {
            repair: true,
            // The bare folder, as a user names it.
            acquisition: Some(fixture.acquisition.path().to_owned()),
            watched: Some(watched.path().to_owned()),
            ..CheckOptions::default()
        };
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let found: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
        assert_eq!(found, [(FindingKind::Missing, Some(expected))]);
    }
}
