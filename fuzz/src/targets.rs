//! One function per parser of foreign bytes. Each may refuse; none may panic, or take much time or memory.

use std::path::Path;

use glam::UVec2;
use saccade_archive::acquisition::{
    AcquisitionInfo, Record, tile_configuration, tile_list, tile_specs, trakem2,
};
use saccade_archive::image::{self, Image, Wanted};
use saccade_archive::pyramid::{self, Encoding, PyramidIndex};
use saccade_core::volume::Dtype;

/// A parser.
pub type Target = fn(&[u8]);

/// All of them, by name.
pub const TARGETS: [(&str, Target); 10] = [
    ("description", description),
    ("records", records),
    ("tile_specs", tile_specs),
    ("tile_configuration", tile_configuration),
    ("tile_list", tile_list),
    ("trakem2", trakem2),
    ("image", image),
    ("image_of_size", image_of_size),
    ("pyramid", pyramid),
    ("round_trip", round_trip),
];

fn somewhere() -> &'static Path {
    Path::new("somewhere")
}

/// `volume.json`: what is understood is written and understood alike.
fn description(bytes: &[u8]) {
    let Ok(info) = serde_json::from_slice::<AcquisitionInfo>(bytes) else {
        return;
    };
    let text = serde_json::to_vec(&info).expect("a description becomes JSON");
    if info.voxel_nm.is_finite() {
        let again = serde_json::from_slice::<AcquisitionInfo>(&text);
        assert!(again.is_ok_and(|again| again.channels == info.channels));
    }
    if let Ok(volume) = info.volume() {
        assert!(!volume.channels.is_empty() && !volume.levels.is_empty());
    }
}

/// Lines of `tiles.jsonl`.
fn records(bytes: &[u8]) {
    for line in bytes.split(|&b| b == b'\n') {
        let Ok(record) = serde_json::from_slice::<Record>(line) else {
            continue;
        };
        let text = serde_json::to_vec(&record).expect("a record becomes JSON");
        let again: Record = serde_json::from_slice(&text).expect("what was written is read");
        if let (Record::Tile(a), Record::Tile(b)) = (&record, &again) {
            let channels = ["a".to_owned(), "b".to_owned()];
            assert_eq!(a.channel_among(&channels), b.channel_among(&channels));
            assert!(
                a.transform.bounds(a.size.as_dvec2()).0.0.is_finite()
                    || !far(a.transform.elements())
            );
        }
    }
}

/// Whether numbers are so large that products of them may not be finite.
fn far(elements: [f64; 6]) -> bool {
    elements.iter().any(|e| e.abs() > 1e150)
}

fn tile_specs(bytes: &[u8]) {
    if let Ok(tiles) = tile_specs::parse(bytes, somewhere()) {
        assert!(tiles.iter().all(|t| t.size.min_element() > 0));
    }
}

fn tile_configuration(bytes: &[u8]) {
    if let Ok(tiles) = tile_configuration::parse(bytes, somewhere()) {
        assert!(tiles.iter().all(|t| t.corner.is_finite()));
    }
}

fn tile_list(bytes: &[u8]) {
    if let Ok(tiles) = tile_list::parse(bytes, somewhere()) {
        assert!(tiles.iter().all(|t| t.corner.is_finite()));
    }
}

fn trakem2(bytes: &[u8]) {
    if let Ok(patches) = trakem2::parse(bytes, somewhere()) {
        assert!(patches.iter().all(|p| p.size.min_element() > 0));
    }
}

/// An image of any size, as whatever it is wanted.
fn image(bytes: &[u8]) {
    // What few bytes may fill is allowed to take seconds; not here.
    if bytes.len() > 1 << 14 {
        return;
    }
    for labels in [false, true] {
        for dtype in [Dtype::Uint8, Dtype::Uint16] {
            let wanted = Wanted {
                dtype,
                labels,
                size: None,
            };
            if let Ok(image) = image::decode_as(bytes, wanted) {
                let right = match &image {
                    Image::Uint8(i) => i.voxels.len() as u64 == pixels(i.width, i.height),
                    Image::Uint16(i) => i.voxels.len() as u64 == pixels(i.width, i.height),
                };
                assert!(right);
            }
        }
    }
}

fn pixels(width: u32, height: u32) -> u64 {
    u64::from(width) * u64::from(height)
}

/// An image of the size that its record says: no other comes out.
fn image_of_size(bytes: &[u8]) {
    let size = UVec2::new(53, 37);
    let wanted = Wanted {
        size: Some(size),
        ..Wanted::GRAY_16
    };
    if let Ok(Image::Uint16(image)) = image::decode_as(bytes, wanted) {
        assert_eq!((image.width, image.height), (53, 37));
    }
}

/// A pyramid's index, and all sub-tiles that it speaks of.
fn pyramid(bytes: &[u8]) {
    let Ok(index) = PyramidIndex::parse(bytes, "somewhere") else {
        return;
    };
    let mut decoded = 0;
    for (k, level) in index.levels().iter().enumerate() {
        for y in 0..level.sub_tiles.y {
            for x in 0..level.sub_tiles.x {
                let entry = index.sub_tile(k, x, y).expect("it is in the level");
                let (Ok(begin), Ok(len)) =
                    (usize::try_from(entry.offset), usize::try_from(entry.len))
                else {
                    continue;
                };
                let stream = bytes.get(begin..).and_then(|b| b.get(..len)).unwrap_or(&[]);
                decoded += 1;
                if decoded > 64 {
                    return;
                }
                if let Ok(voxels) = index.decode_sub_tile(k, x, y, stream) {
                    assert_eq!(voxels.len(), index.sub_tile_bytes());
                    let value =
                        |v: &[u8]| v.iter().rev().fold(0, |n: u16, &b| n << 8 | u16::from(b));
                    let bounds = entry.min..=entry.max;
                    let mut values = voxels.chunks_exact(index.dtype().bytes()).map(value);
                    assert!(values.all(|v| bounds.contains(&v)));
                }
            }
        }
    }
    assert!(index.end() >= 1 || index.memory() > 0);
}

/// Any small image comes back from its pyramid.
fn round_trip(bytes: &[u8]) {
    let [width, height, rest @ ..] = bytes else {
        return;
    };
    let (width, height) = (u32::from(*width) + 1, u32::from(*height) + 1);
    let value = |n: usize| {
        u16::from_le_bytes(
            [n, n + 1].map(|n| rest.get(n % rest.len().max(1)).copied().unwrap_or(0)),
        )
    };
    let voxels = (0..width as usize * height as usize).map(value).collect();
    let image = image::Gray::new(width, height, voxels);
    let files = [
        pyramid::encode(&image, &Encoding::Lossless),
        pyramid::encode_labels(&image),
    ];
    for file in files {
        let file = file.expect("a small image has a pyramid");
        assert_eq!(
            image::decode_as(&file, Wanted::GRAY_16).expect("it is a TIFF"),
            Image::Uint16(image.clone())
        );
    }
}
