//! Volumes of other kinds than one channel of 8-bit shades, and tiles that go away again.

use std::fs;
use std::io::Cursor;

use glam::UVec2;
use saccade_archive::acquisition::{ChannelRef, DeleteRecord, Record};
use saccade_archive::pyramid::{Encoding, PyramidIndex};
use saccade_core::volume::{Dtype, VoxelKind};
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};
use tiff::encoder::{TiffEncoder, colortype};

use crate::scope::{
    Diary, EXTENT, Scope, VOLUME, archive, at, info, move_record, orphans, quick, seen, texture,
    tile_record,
};

const SIZE: UVec2 = UVec2::new(200, 150);

fn in_channel(name: &str, channel: ChannelRef) -> Record {
    let Record::Tile(mut record) = tile_record(name, 0, SIZE) else {
        panic!("a tile")
    };
    record.channel = Some(channel);
    Record::Tile(record)
}

#[tokio::test]
async fn tiles_go_to_their_channel() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let mut info = info(EXTENT);
    info.channels = ["SE", "BSE"].map(str::to_owned).to_vec();
    info.write(scope.path()).unwrap();
    for (n, name) in (0..).zip(["a", "b", "c", "d"]) {
        scope.image(name, SIZE, n);
    }
    scope.say(&tile_record("a", 0, SIZE));
    scope.say(&in_channel("b", ChannelRef::Name("BSE".to_owned())));
    scope.say(&in_channel("c", ChannelRef::Index(1)));
    scope.say(&in_channel("d", ChannelRef::Name("gold".to_owned())));
    let summary = scope.ingest(&archive).await;
    assert_eq!((summary.tiles, summary.quarantined), (3, 1));
    let tiles = archive.catalog().section_tiles(VOLUME, 0).await.unwrap();
    let mut channels: Vec<_> = tiles.iter().map(|t| (&*t.name, t.channel)).collect();
    channels.sort_unstable();
    assert_eq!(channels, [("a", 0), ("b", 1), ("c", 1)]);
    let quarantined = archive.catalog().quarantined(VOLUME).await.unwrap();
    let reason = &quarantined[0].reason;
    assert!(reason.contains("\"SE\", \"BSE\""), "{reason}");
}

#[tokio::test]
async fn sixteen_bits_arrive_as_they_left() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let mut info = info(EXTENT);
    info.dtype = Dtype::Uint16;
    info.write(scope.path()).unwrap();
    let values: Vec<u16> = (0..SIZE.x * SIZE.y)
        .map(|i| u16::try_from(i * 2 + 1).unwrap())
        .collect();
    let mut file = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file).unwrap();
    encoder
        .write_image::<colortype::Gray16>(SIZE.x, SIZE.y, &values)
        .unwrap();
    fs::write(scope.file("deep"), file.into_inner()).unwrap();
    scope.say(&tile_record("deep", 0, SIZE));
    scope.tile("flat", 1, SIZE, 7);
    fs::write(scope.file("other"), "GIF89a and so on").unwrap();
    scope.say(&tile_record("other", 2, SIZE));

    // JPEG, as far as that goes: it is said that it does not.
    let options = IngestOptions {
        encoding: Encoding::Jpeg { quality: 85 },
        ..quick()
    };
    let diary = Diary::default();
    let summary = run(scope.path(), &archive, &options, &diary, &Cancel::new()).await;
    assert_eq!(summary.unwrap().tiles, 2);
    let notices = diary.notices();
    assert!(notices[0].contains("JPEG holds 8 bits"), "{notices:?}");
    assert_eq!(
        archive.catalog().volume(VOLUME).await.unwrap().dtype,
        Dtype::Uint16
    );
    let advice = "convert it to a 16-bit grey TIFF or PNG";
    assert!(notices.iter().any(|n| n.contains(advice)), "{notices:?}");

    let storage = archive.storage().as_ref();
    let flat: Vec<u16> = texture(SIZE, 7)
        .iter()
        .map(|&v| u16::from(v) * 257)
        .collect();
    for (name, want) in [("deep", values), ("flat", flat)] {
        let pyramid = &seen(&archive).await[name].pyramid;
        let index = PyramidIndex::open(storage, pyramid).await.unwrap();
        assert_eq!(index.dtype(), Dtype::Uint16);
        let voxels = index.read_sub_tile(storage, 0, 1, 1).await.unwrap();
        // The first of its rows.
        let row = voxels
            .chunks_exact(2)
            .map(|v| u16::from_le_bytes([v[0], v[1]]));
        let begin = (128 * SIZE.x + 128) as usize;
        assert!(
            row.take(72).eq(want[begin..begin + 72].iter().copied()),
            "{name}"
        );
    }
}

#[tokio::test]
async fn labels_are_never_averaged() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let mut info = info(EXTENT);
    info.kind = VoxelKind::Labels;
    info.write(scope.path()).unwrap();
    // Of every four pixels, three have one label: an average would have neither.
    let labels: Vec<u8> = (0..SIZE.x * SIZE.y)
        .map(|i| if i % 2 + i / SIZE.x % 2 == 2 { 200 } else { 10 })
        .collect();
    fs::write(scope.file("a"), crate::scope::tiff8(SIZE, &labels)).unwrap();
    scope.say(&tile_record("a", 0, SIZE));
    let diary = Diary::default();
    let options = IngestOptions {
        encoding: Encoding::Jpeg { quality: 85 },
        ..quick()
    };
    run(scope.path(), &archive, &options, &diary, &Cancel::new())
        .await
        .unwrap();
    assert!(
        diary.notices()[0].contains("labels"),
        "{:?}",
        diary.notices()
    );
    let storage = archive.storage().as_ref();
    let pyramid = &seen(&archive).await["a"].pyramid;
    let index = PyramidIndex::open(storage, pyramid).await.unwrap();
    let coarse = index.read_sub_tile(storage, 1, 0, 0).await.unwrap();
    assert_eq!(coarse, [10; 128 * 128]);
}

#[tokio::test]
async fn deleted_tiles_are_gone_until_they_are_imaged_again() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let delete = |tile: &str| {
        let tile = tile.to_owned();
        Record::Delete(DeleteRecord { tile })
    };
    for (n, name) in (0..).zip(["a", "b", "c"]) {
        scope.tile(name, 0, SIZE, n);
    }
    scope.say(&delete("a"));
    scope.say(&delete("b"));
    scope.say(&delete("never"));
    scope.tile("b", 1, SIZE, 9);
    scope.say(&move_record("a", at(3.0, 3.0)));
    let summary = scope.ingest(&archive).await;
    assert_eq!(
        (summary.tiles, summary.deleted, summary.quarantined),
        (4, 2, 0)
    );
    let tiles = seen(&archive).await;
    assert_eq!(tiles.keys().collect::<Vec<_>>(), ["b", "c"]);
    assert_eq!(tiles["b"].section, 1);
    assert!(orphans(&archive).await.is_empty());

    scope.say(&delete("c"));
    assert_eq!(scope.ingest(&archive).await.deleted, 1);
    assert_eq!(seen(&archive).await.len(), 1);
}
