//! A tile that cannot be read fails the chunks it is seen in, and nothing else.

use std::error::Error;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt;
use glam::{DVec3, UVec2, UVec3};
use saccade_archive::catalog::NewTile;
use saccade_archive::image::GrayImage;
use saccade_archive::pyramid::{Encoding, PyramidIndex, encode, named};
use saccade_core::volume::Dtype;

use super::fixture::{Fixture, chunk_of, tile};
use super::run;
use crate::stitched::{StitchError, StitchedOptions};
use crate::{Chunk, ChunkError, ChunkId, VolumeSource};

/// Two tiles side by side that do not touch, seen in chunks of their own.
async fn two() -> (Fixture, String) {
    let mut fixture = Fixture::new(UVec3::new(256, 64, 3), DVec3::new(4.0, 4.0, 30.0)).await;
    let left = fixture
        .put("left", tile((120, 64), 1, (0.0, 0.0), 0.0, 1.0, 5))
        .await;
    fixture
        .put("right", tile((120, 64), 1, (130.0, 0.0), 0.0, 1.0, 6))
        .await;
    (fixture, left)
}

fn id(x: u32) -> ChunkId {
    ChunkId {
        channel: 0,
        level: 0,
        chunk: UVec3::new(x, 0, 0),
    }
}

/// The error with all its causes, as a user sees it.
fn text(error: &ChunkError) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text = format!("{text}: {error}");
        source = error.source();
    }
    text
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Harm {
    Missing,
    Garbage,
    Cut,
    NoIndex,
    OtherSize,
    /// A bit of its last sub-tile.
    Flipped,
    /// Whole, but made for another tile.
    Mistaken,
}

#[test]
fn a_harmed_tile_fails_alone_and_is_healed_by_another_image() {
    for (harm, transient) in [
        (Harm::Missing, true),
        (Harm::Garbage, false),
        (Harm::Cut, false),
        (Harm::NoIndex, false),
        (Harm::OtherSize, false),
        (Harm::Flipped, false),
        (Harm::Mistaken, false),
    ] {
        run(async {
            let (mut fixture, left) = two().await;
            let whole = fixture.storage.read(&left, None).await.unwrap();
            let harmed = match harm {
                Harm::Missing => None,
                Harm::Garbage => {
                    let mut bytes = whole.to_vec();
                    let middle = bytes.len() * 2 / 3;
                    bytes[middle..].fill(0xff);
                    Some(Bytes::from(bytes))
                }
                Harm::Cut => Some(whole.slice(..whole.len() * 2 / 3)),
                Harm::NoIndex => Some(Bytes::from_static(b"II*\0 this is no pyramid")),
                Harm::OtherSize => {
                    let image = GrayImage::new(64, 50, vec![9; 64 * 50]);
                    Some(encode(&image, &Encoding::Lossless).unwrap())
                }
                Harm::Flipped => {
                    let mut bytes = whole.to_vec();
                    let near_its_end = bytes.len() - 40;
                    bytes[near_its_end] ^= 8;
                    Some(Bytes::from(bytes))
                }
                Harm::Mistaken => Some(named(whole.clone(), "tiles/other-1.tif").unwrap()),
            };
            match harmed {
                None => fixture.storage.delete(&left).await.unwrap(),
                Some(bytes) => fixture.storage.write_durable(&left, bytes).await.unwrap(),
            }
            let source = fixture.open().await;
            assert_eq!(source.damage(), [], "nobody looked");
            let want = fixture.expected();
            for x in [0, 1] {
                let error = source.read(id(x)).await.unwrap_err();
                let told = text(&error);
                assert!(told.contains(&left), "{harm:?}: {told}");
                assert_eq!(error.is_transient(), transient, "{harm:?}: {told}");
                let ChunkError::Failed { source, .. } = error else {
                    panic!("{told}");
                };
                let size = matches!(source.downcast_ref(), Some(StitchError::Size { .. }));
                assert_eq!(size, harm == Harm::OtherSize, "{told}");
                assert_eq!(
                    told.contains("checksum"),
                    harm == Harm::Flipped || harm == Harm::Garbage,
                    "{told}"
                );
                assert_eq!(
                    told.contains("made for another tile"),
                    harm == Harm::Mistaken,
                    "{told}"
                );
            }
            for x in [2, 3] {
                match source.read(id(x)).await.unwrap() {
                    Chunk::Voxels(bytes) => {
                        assert_eq!(bytes, chunk_of(&fixture.volume, &want, id(x)))
                    }
                    Chunk::Empty => panic!("chunk {x} is empty"),
                }
            }

            let damage = source.damage();
            assert_eq!(damage.len(), 1, "{damage:?}");
            assert_eq!((damage[0].section, &damage[0].object), (1, &left));
            let mend = ["append the tile's record", "saccade check"];
            let reason = &damage[0].reason;
            assert!(mend.iter().any(|way| reason.contains(way)), "{reason}");

            let mut changes = source.changes();
            fixture
                .put("left", tile((120, 64), 1, (0.0, 0.0), 0.0, 1.0, 7))
                .await;
            changes.next().await.unwrap();
            let want = chunk_of(&fixture.volume, &fixture.expected(), id(0));
            assert_eq!(
                source.read(id(0)).await.unwrap(),
                Chunk::Voxels(want.into())
            );
            assert_eq!(source.damage(), [], "it was healed");
        });
    }
}

#[test]
fn a_tile_that_could_not_be_read_is_tried_again() {
    run(async {
        let (fixture, left) = two().await;
        let whole = fixture.storage.read(&left, None).await.unwrap();
        fixture.storage.delete(&left).await.unwrap();
        let options = StitchedOptions {
            try_again: Duration::from_millis(30),
            ..StitchedOptions::default()
        };
        let source = fixture.open_with(options).await;
        assert!(source.read(id(0)).await.is_err());
        assert_eq!(source.damage().len(), 1);
        fixture.storage.write_durable(&left, whole).await.unwrap();
        while source.read(id(0)).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        let built = source.statistics().blocks_built;
        assert!(source.read(id(0)).await.is_ok());
        assert_eq!(source.statistics().blocks_built, built, "now it is kept");
        assert_eq!(source.damage(), []);
    });
}

/// It may be on its way; then it is lost, as who asks is told; and if it comes after all, it is seen.
#[test]
fn a_pyramid_that_does_not_come_is_lost() {
    run(async {
        let (fixture, left) = two().await;
        let whole = fixture.storage.read(&left, None).await.unwrap();
        fixture.storage.delete(&left).await.unwrap();
        let options = StitchedOptions {
            try_again: Duration::from_millis(10),
            may_come_for: Duration::from_millis(300),
            ..StitchedOptions::default()
        };
        let source = fixture.open_with(options).await;
        let begin = tokio::time::Instant::now();
        let lost = loop {
            let error = source.read(id(0)).await.unwrap_err();
            let late = begin.elapsed() >= Duration::from_millis(300);
            assert!(error.is_transient() || late, "{}", text(&error));
            if !error.is_transient() {
                break text(&error);
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        };
        assert!(
            lost.contains("missing") && lost.contains("--repair"),
            "{lost}"
        );
        fixture.storage.write_durable(&left, whole).await.unwrap();
        while source.read(id(0)).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(source.damage(), []);
    });
}

#[test]
fn pyramids_of_other_types_are_refused() {
    run(async {
        let (fixture, _) = two().await;
        let mut volume = fixture.volume.clone();
        volume.name = "deep".into();
        volume.dtype = Dtype::Uint16;
        let catalog = fixture.archive.catalog();
        catalog.create_volume(&volume).await.unwrap();
        let tile = catalog.section_tiles("v", 1).await.unwrap().remove(0);
        let new = NewTile {
            name: tile.name,
            section: 1,
            channel: 0,
            size: tile.size,
            transform: tile.transform,
            pyramid: tile.pyramid,
            position: 1,
        };
        catalog.commit_tile("deep", &new).await.unwrap();
        let opened = crate::stitched::StitchedSource::open;
        let source = opened(&fixture.archive, "deep", StitchedOptions::default());
        let source = source.await.unwrap();
        let id = ChunkId {
            channel: 0,
            level: 0,
            chunk: UVec3::ZERO,
        };
        let error = source.read(id).await.unwrap_err();
        let told = error.source().unwrap().to_string();
        assert!(told.contains("of 8 bits, its volume of 16"), "{told}");
    });
}

/// Parts of a tile that can be read say nothing of those that cannot.
#[test]
fn a_tile_is_damaged_until_all_of_it_that_was_looked_at_can_be_read() {
    run(async {
        let mut fixture = Fixture::new(UVec3::new(640, 64, 1), DVec3::new(4.0, 4.0, 30.0)).await;
        let pyramid = fixture
            .put("wide", tile((640, 64), 0, (0.0, 0.0), 0.0, 1.0, 5))
            .await;
        let whole = fixture.storage.read(&pyramid, None).await.unwrap();
        let index = PyramidIndex::open(&*fixture.storage, &pyramid)
            .await
            .unwrap();
        let first = index.reads(0, vec![UVec2::ZERO], 0)[0].range.start;
        let mut harmed = whole.to_vec();
        harmed[usize::try_from(first).unwrap() + 9] ^= 8;
        let write = fixture.storage.write_durable(&pyramid, harmed.into());
        write.await.unwrap();
        let options = StitchedOptions {
            try_again: Duration::ZERO,
            ..StitchedOptions::default()
        };
        let source = fixture.open_with(options).await;
        assert!(source.read(id(0)).await.is_err());
        assert!(source.read(id(9)).await.is_ok());
        let damage = source.damage();
        assert_eq!(damage.len(), 1, "{damage:?}");
        assert_eq!(damage[0].object, pyramid);
    });
}

#[test]
fn a_tile_that_the_catalog_does_not_understand_is_told() {
    run(async {
        let (fixture, _) = two().await;
        let catalog = fixture.archive.catalog();
        let tile = catalog.tile("v", "left").await.unwrap().unwrap();
        let spoilt = NewTile {
            name: tile.name,
            section: 1,
            channel: 0,
            size: tile.size,
            transform: tile.transform,
            pyramid: "../nowhere".to_owned(),
            position: 99,
        };
        catalog.commit_tile("v", &spoilt).await.unwrap();
        let source = fixture.open().await;
        let error = source.read(id(0)).await.unwrap_err();
        assert!(text(&error).contains("\"left\""), "{}", text(&error));
        let damage = source.damage();
        assert_eq!(damage.len(), 1, "{damage:?}");
        assert_eq!((damage[0].section, &*damage[0].object), (1, "left"));
        assert!(
            damage[0].reason.contains("saccade check"),
            "{}",
            damage[0].reason
        );
    });
}
