//! Bad input: each kind is told apart, named with its file, and stops nothing.

use std::fs;
use std::time::Duration;

use glam::UVec2;
use saccade_archive::acquisition::{Record, RecordReader, TileRecord};
use saccade_archive::catalog::Quarantined;
use saccade_core::transform::SectionFromTile;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};

use crate::scope::{
    Diary, EXTENT, Scope, VOLUME, archive, at, move_record, orphans, pixels, quick, seen, texture,
    tiff_rgb, tiff8, tiff16, tile_record,
};

const SIZE: UVec2 = UVec2::new(140, 130);

/// Ingests a bad record between two good ones, and returns what is said of it.
async fn refused(bad: impl FnOnce(&Scope)) -> Quarantined {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.tile("before", 0, SIZE, 1);
    bad(&scope);
    scope.tile("after", 0, SIZE, 2);
    let diary = Diary::default();
    let summary = run(scope.path(), &archive, &quick(), &diary, &Cancel::new())
        .await
        .unwrap();
    assert_eq!((summary.tiles, summary.quarantined), (2, 1));
    let tiles = seen(&archive).await;
    assert_eq!(tiles.keys().collect::<Vec<_>>(), ["after", "before"]);
    assert!(orphans(&archive).await.is_empty());
    let mut quarantined = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(quarantined.len(), 1, "{quarantined:?}");
    let notices = diary.notices();
    assert!(
        notices.iter().any(|n| n.contains(&quarantined[0].reason)),
        "{notices:?}"
    );
    assert_eq!(diary.states().last().unwrap().quarantined, 1);
    assert_eq!(diary.states().last().unwrap().waiting, 0);

    // Not again by the next process.
    assert_eq!(scope.ingest(&archive).await.quarantined, 0);
    assert_eq!(
        archive.catalog().quarantined(VOLUME).await.unwrap(),
        quarantined
    );
    quarantined.remove(0)
}

/// Which of the two records is looked at last is chance.
#[tokio::test]
async fn an_image_that_is_shown_is_not_set_aside_for_an_older_record() {
    for round in 0..8 {
        let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
        let archive = archive(folder.path()).await;
        // Found before it was whole, of a size that nobody knew.
        fs::write(scope.file("a"), "").unwrap();
        scope.say(&tile_record("a", 0, UVec2::ONE));
        let options = IngestOptions {
            once: false,
            patience: 2000,
            ..quick()
        };
        let cancel = Cancel::new();
        let take_in = run(scope.path(), &archive, &options, &(), &cancel);
        let mend = async {
            let waits = async || {
                archive
                    .catalog()
                    .queued(VOLUME)
                    .await
                    .is_ok_and(|q| q.1 == 1)
            };
            until(waits).await;
            fs::write(scope.file("part"), tiff8(SIZE, &texture(SIZE, 1))).unwrap();
            scope.say(&tile_record("a", 0, SIZE));
            fs::rename(scope.file("part"), scope.file("a")).unwrap();
            until(async || archive.catalog().queued(VOLUME).await.unwrap() == (0, 0)).await;
            until(async || !seen(&archive).await.is_empty()).await;
            cancel.cancel();
        };
        futures::join!(async { take_in.await.unwrap() }, mend);
        let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
        assert!(set_aside.is_empty(), "{round}: {set_aside:?}");
        assert!(orphans(&archive).await.is_empty());
    }
}

async fn until(is_so: impl AsyncFn() -> bool) {
    for _ in 0..2000 {
        if is_so().await {
            return;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("it does not come");
}

fn says(what: &Quarantined, words: &[&str]) {
    for word in words {
        assert!(
            what.reason.contains(word),
            "{:?} does not say {word:?}",
            what.reason
        );
    }
}

#[tokio::test]
async fn a_16_bit_tile() {
    let bytes = tiff16(SIZE);
    let len = bytes.len() as u64;
    let what = refused(|scope| {
        fs::write(scope.file("deep"), bytes).unwrap();
        scope.say(&tile_record("deep", 0, SIZE));
    })
    .await;
    assert_eq!(
        (what.file.as_str(), what.tile.as_deref()),
        ("tiles/deep.tif", Some("deep"))
    );
    assert_eq!(what.bytes, Some(len));
    says(&what, &["16", "8"]);
}

/// What a link shows is not the microscope's, and none of it is told.
#[tokio::test]
async fn a_link_out_of_the_archive() {
    let elsewhere = tempfile::tempdir().unwrap();
    let secret = elsewhere.path().join("secret");
    for whole in [true, false] {
        let image = tiff8(SIZE, &texture(SIZE, 3));
        let bytes = if whole { &image[..] } else { b"root:x:0:0" };
        fs::write(&secret, bytes).unwrap();
        for folder in [false, true] {
            let what = refused(|scope| {
                let Record::Tile(mut record) = tile_record("link", 0, SIZE) else {
                    panic!("a tile")
                };
                if folder {
                    std::os::unix::fs::symlink(elsewhere.path(), scope.path().join("deep"))
                        .unwrap();
                    record.file = "deep/secret".to_owned();
                } else {
                    std::os::unix::fs::symlink(&secret, scope.file("link")).unwrap();
                }
                scope.say(&Record::Tile(record));
            })
            .await;
            assert_eq!((what.tile.as_deref(), what.bytes), (Some("link"), None));
            says(&what, &["link", "leads out", "put the image itself there"]);
        }
    }
}

#[tokio::test]
async fn a_coloured_tile() {
    let what = refused(|scope| {
        fs::write(scope.file("red"), tiff_rgb(SIZE, [200, 30, 30])).unwrap();
        scope.say(&tile_record("red", 0, SIZE));
    })
    .await;
    assert_eq!(what.tile.as_deref(), Some("red"));
    says(
        &what,
        &["in colour", "[200, 30, 30]", "pixel 0, 0", "convert"],
    );
}

#[tokio::test]
async fn a_tile_without_pixels() {
    for size in [UVec2::ZERO, UVec2::new(140, 0)] {
        let what = refused(|scope| {
            scope.image("flat", SIZE, 3);
            scope.say(&tile_record("flat", 0, size));
        })
        .await;
        assert_eq!(what.tile.as_deref(), Some("flat"));
        says(&what, &["size must be at least 1 x 1 pixels"]);
    }
}

#[tokio::test]
async fn a_damaged_file() {
    let what = refused(|scope| {
        fs::write(scope.file("bad"), vec![b'x'; 5000]).unwrap();
        scope.say(&tile_record("bad", 0, SIZE));
    })
    .await;
    assert_eq!(what.file, "tiles/bad.tif");
    assert_eq!(what.bytes, Some(5000));
}

#[tokio::test]
async fn a_file_that_stays_half() {
    let what = refused(|scope| {
        let whole = scope.image("half", SIZE, 3);
        fs::write(scope.file("half"), &whole[..whole.len() / 2]).unwrap();
        scope.say(&tile_record("half", 0, SIZE));
    })
    .await;
    says(
        &what,
        &["complete", "has not changed", "append its record again"],
    );
}

/// A record that makes no sense is told by its image, where it names one.
#[tokio::test]
async fn a_record_that_makes_no_sense() {
    let what = refused(|scope| {
        let line =
            "{\"record\":\"tile\",\"tile\":\"odd\",\"file\":\"tiles/odd.tif\",\"section\":-1}\n";
        let path = scope.path().join(RecordReader::FILE);
        let text = fs::read_to_string(&path).unwrap() + line;
        fs::write(path, text).unwrap();
    })
    .await;
    assert_eq!(
        (&*what.file, what.tile.as_deref()),
        ("tiles/odd.tif", Some("odd"))
    );
    says(&what, &["line 2 of tiles.jsonl", "append the record again"]);
}

/// So small a file, and so many pixels: the reason says what is too much.
#[tokio::test]
async fn a_bomb() {
    let header = |width: u32, height: u32| {
        let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
        let mut chunk = |name: &[u8], body: &[u8]| {
            file.extend(u32::try_from(body.len()).unwrap().to_be_bytes());
            let named = [name, body].concat();
            file.extend(&named);
            file.extend(crc32fast::hash(&named).to_be_bytes());
        };
        let size = [width.to_be_bytes(), height.to_be_bytes()].concat();
        chunk(b"IHDR", &[&size[..], &[8, 0, 0, 0, 0]].concat());
        chunk(b"IDAT", &[0x78, 0x01, 0x03, 0x00, 0x00, 0x00, 0x00, 0x01]);
        chunk(b"IEND", &[]);
        file
    };
    for (size, words) in [
        (
            UVec2::splat(60_000),
            &["3600000000 values", "PNG packs at most 2048"],
        ),
        (
            UVec2::splat(90_000),
            &["90000 x 90000 pixels", "at most 4294967296"],
        ),
        (
            UVec2::new(600_000, 1),
            &["600000 x 1 pixels", "1 to 524288"],
        ),
    ] {
        let what = refused(|scope| {
            fs::write(scope.file("bomb"), header(size.x, size.y)).unwrap();
            scope.say(&tile_record("bomb", 0, size));
        })
        .await;
        says(&what, words);
    }
}

#[tokio::test]
async fn an_empty_file() {
    let what = refused(|scope| {
        fs::write(scope.file("empty"), "").unwrap();
        scope.say(&tile_record("empty", 0, SIZE));
    })
    .await;
    assert_eq!(what.bytes, Some(0));
    says(&what, &["has not changed"]);
}

/// Decoding it would never end.
#[cfg(unix)]
#[tokio::test]
async fn a_device_in_place_of_an_image() {
    let what = refused(|scope| {
        std::os::unix::fs::symlink("/dev/zero", scope.file("device")).unwrap();
        scope.say(&tile_record("device", 0, SIZE));
    })
    .await;
    says(&what, &["leads out", "append the record again"]);
}

#[tokio::test]
async fn a_file_that_never_comes() {
    let what = refused(|scope| scope.say(&tile_record("ghost", 0, SIZE))).await;
    assert_eq!((what.file.as_str(), what.bytes), ("tiles/ghost.tif", None));
    says(
        &what,
        &["exists", "did not come within", "append its record again"],
    );
    assert!(!what.reason.contains("has not changed"), "{}", what.reason);
}

/// However long after its record was set aside, as long as this run goes on.
#[tokio::test]
async fn a_file_that_comes_late_is_taken_in() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.say(&tile_record("late", 0, SIZE));
    let options = IngestOptions {
        once: false,
        ..quick()
    };
    let (diary, cancel) = (Diary::default(), Cancel::new());
    let ingest = run(scope.path(), &archive, &options, &diary, &cancel);
    let catalog = archive.catalog();
    let other = async {
        let set_aside = async || match catalog.quarantined(VOLUME).await {
            Ok(set_aside) => set_aside.len(),
            // Before the volume is made.
            Err(_) => 0,
        };
        while set_aside().await == 0 {
            tokio::time::sleep(options.poll).await;
        }
        assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, 0);
        tokio::time::sleep(options.poll * 20).await;
        scope.image("late", SIZE, 7);
        while catalog.entry(VOLUME).await.unwrap().tiles == 0 {
            tokio::time::sleep(options.poll).await;
        }
        assert_eq!(set_aside().await, 0);
        cancel.cancel();
    };
    let both = async { tokio::join!(ingest, other) };
    let both = tokio::time::timeout(Duration::from_secs(60), both).await;
    let summary = both.expect("it is taken in").0.unwrap();
    assert_eq!((summary.tiles, summary.quarantined), (1, 0));
    assert_eq!(
        pixels(&seen(&archive).await["late"]).await,
        texture(SIZE, 7)
    );
}

/// Also where it comes while nobody looks, whoever looks then.
#[tokio::test]
async fn a_file_that_comes_between_two_runs_is_taken_in_by_the_next() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    for late in ["first", "second", "never"] {
        scope.say(&tile_record(late, 0, SIZE));
    }
    scope.tile("there", 0, SIZE, 3);
    let again = async |once: bool, tiles: u64| {
        let options = IngestOptions { once, ..quick() };
        let cancel = Cancel::new();
        let ingest = run(scope.path(), &archive, &options, &(), &cancel);
        let ends = async {
            while !once && archive.catalog().entry(VOLUME).await.unwrap().tiles < tiles {
                tokio::time::sleep(options.poll).await;
            }
            if !once {
                cancel.cancel();
            }
        };
        let both = async { tokio::join!(ingest, ends) };
        let both = tokio::time::timeout(Duration::from_secs(60), both).await;
        both.expect("it is taken in").0.unwrap();
        let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
        (
            archive.catalog().entry(VOLUME).await.unwrap().tiles,
            set_aside.len(),
        )
    };
    assert_eq!(again(true, 1).await, (1, 3));
    scope.image("first", SIZE, 1);
    assert_eq!(again(true, 2).await, (2, 2));
    scope.image("second", SIZE, 2);
    assert_eq!(again(false, 3).await, (3, 1));
    assert_eq!(again(true, 3).await, (3, 1));
    let seen = seen(&archive).await;
    for (name, seed) in [("first", 1), ("second", 2), ("there", 3)] {
        assert_eq!(pixels(&seen[name]).await, texture(SIZE, seed), "{name}");
    }
}

#[tokio::test]
async fn a_kind_of_image_that_is_not_known() {
    let what = refused(|scope| {
        fs::write(
            scope.file("bitmap"),
            b"BM and so on, for long enough to be an image of some kind",
        )
        .unwrap();
        scope.say(&tile_record("bitmap", 0, SIZE));
    })
    .await;
    says(
        &what,
        &["convert it to an 8-bit grey TIFF or PNG, and append the record again"],
    );
}

#[tokio::test]
async fn a_tile_outside_the_volume() {
    let what = refused(|scope| scope.tile("low", EXTENT.z, SIZE, 3)).await;
    says(&what, &["outside", "section 20", "extent"]);
    let what = refused(|scope| {
        scope.image("far", SIZE, 3);
        let Record::Tile(mut record) = tile_record("far", 0, SIZE) else {
            unreachable!()
        };
        record.transform = at(-140.0, 0.0);
        scope.say(&Record::Tile(record));
    })
    .await;
    says(&what, &["outside", "-140"]);
}

#[tokio::test]
async fn a_tile_without_a_name_or_of_an_absurd_scale() {
    let what = refused(|scope| scope.tile(" ", 0, SIZE, 3)).await;
    says(&what, &["no name"]);
    for scale in [1000.0, 1e-4] {
        let what = refused(|scope| {
            scope.image("vast", SIZE, 3);
            let Record::Tile(mut record) = tile_record("vast", 0, SIZE) else {
                unreachable!()
            };
            let elements = [scale, 0.0, 0.0, scale, 0.0, 0.0];
            record.transform = SectionFromTile::new(elements).unwrap();
            scope.say(&Record::Tile(record));
        })
        .await;
        says(&what, &["512 voxels", "check the transform"]);
    }
}

#[tokio::test]
async fn a_record_of_another_size() {
    let what = refused(|scope| {
        scope.image("small", SIZE, 3);
        scope.say(&tile_record("small", 0, SIZE + UVec2::X));
    })
    .await;
    says(&what, &["140 x 130", "141 x 130"]);
}

#[tokio::test]
async fn a_path_out_of_the_archive() {
    for file in ["../secret.tif", "/etc/passwd"] {
        let what = refused(|scope| {
            let (file, tile) = (file.to_owned(), "thief".to_owned());
            let record = TileRecord {
                tile,
                file,
                section: 0,
                size: SIZE,
                transform: at(0.0, 0.0),
                channel: None,
            };
            scope.say(&Record::Tile(record));
        })
        .await;
        assert_eq!(what.file, file);
        says(&what, &["outside the acquisition archive"]);
    }
}

#[tokio::test]
async fn a_line_that_is_no_record() {
    let what = refused(|scope| {
        let path = scope.path().join(RecordReader::FILE);
        let mut text = fs::read(&path).unwrap();
        text.extend(b"{\"record\":\"tile\",\"tile\":7}\n");
        fs::write(path, text).unwrap();
    })
    .await;
    assert_eq!(
        (what.file.as_str(), what.tile.as_deref()),
        (RecordReader::FILE, None)
    );
    says(&what, &["line 2"]);
}

#[tokio::test]
async fn a_transform_out_of_the_volume() {
    let what = refused(|scope| scope.say(&move_record("before", at(5000.0, 0.0)))).await;
    assert_eq!(what.tile.as_deref(), Some("before"));
    says(&what, &["outside", "stays where it is"]);
}

#[tokio::test]
async fn a_transform_of_an_absurd_scale() {
    let small = SectionFromTile::new([1e-9, 0.0, 0.0, 1.0, 0.0, 0.0]).unwrap();
    let what = refused(|scope| scope.say(&move_record("before", small))).await;
    assert_eq!(what.tile.as_deref(), Some("before"));
    says(
        &what,
        &[
            "smaller than a 512th",
            "stays where it is",
            "append the record again",
        ],
    );
}

#[tokio::test]
async fn a_mended_tile_leaves_quarantine() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    fs::write(scope.file("a"), tiff16(SIZE)).unwrap();
    scope.say(&tile_record("a", 0, SIZE));
    assert_eq!(scope.ingest(&archive).await.quarantined, 1);
    // As the message advises: mend the file, say it again.
    scope.tile("a", 0, SIZE, 5);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
    assert!(
        archive
            .catalog()
            .quarantined(VOLUME)
            .await
            .unwrap()
            .is_empty()
    );
    assert_eq!(pixels(&seen(&archive).await["a"]).await, texture(SIZE, 5));
}

/// By the same run: what is told is what is set aside now.
#[tokio::test]
async fn a_tile_that_is_mended_meanwhile_is_not_counted_as_set_aside() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    for name in ["bad", "worse"] {
        fs::write(scope.file(name), tiff16(SIZE)).unwrap();
    }
    scope.say(&tile_record("worse", 0, SIZE));
    let Record::Tile(bad) = tile_record("bad", 0, SIZE) else {
        unreachable!()
    };
    let tile = "a".to_owned();
    scope.say(&Record::Tile(TileRecord { tile, ..bad }));
    scope.tile("a", 0, SIZE, 5);
    let diary = Diary::default();
    let options = IngestOptions {
        workers: 1,
        ..quick()
    };
    let done = run(scope.path(), &archive, &options, &diary, &Cancel::new()).await;
    let done = done.unwrap();
    assert_eq!((done.tiles, done.quarantined), (1, 1));
    let states = diary.states();
    assert_eq!(states.last().unwrap().quarantined, 1);
    assert!(states.iter().any(|state| state.quarantined == 2));
}
