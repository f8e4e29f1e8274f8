//! Which images are of labels, and what becomes of their ids.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde_json::json;

use super::written::{read_all, version_3};
use super::*;

#[test]
fn an_image_that_says_so_is_of_labels() {
    for version in [Version::V2, Version::V3] {
        for dtype in ["uint8", "uint16"] {
            let folder = tempfile::tempdir().unwrap();
            write_image(folder.path(), "zyx", dtype, version);
            assert!(!open(folder.path()).unwrap().volume().kind.is_labels());
            let mut labels = attributes("zyx", 2);
            labels["image-label"] = json!({"version": "0.4"});
            write_attributes(folder.path(), version, &labels);
            let kind = open(folder.path()).unwrap().volume().kind;
            assert!(kind.is_labels(), "{dtype}");
        }
    }
}

#[test]
fn an_image_is_of_labels_by_its_place() {
    let root = tempfile::tempdir().unwrap();
    for (place, dtype, omero, is_labels) in [
        ("em.zarr/labels/cells", "uint16", false, true),
        ("em.ome.zarr/labels/original/0", "uint8", false, true),
        ("em/labels/cells", "int16", false, true),
        // Fractions name nothing, and what has colours is an image.
        ("em.zarr/labels/likely", "float64", false, false),
        ("em.zarr/labels/image", "uint16", true, false),
        // Folders that are called so by chance.
        ("labels/em.zarr", "uint16", false, false),
        ("labels/of/em", "uint16", false, false),
        ("em.zarr/labelled/cells", "uint16", false, false),
    ] {
        let folder = root.path().join(place);
        if dtype == "float64" {
            written::write(&folder, dtype, &version_3(dtype, [4, 33, 40], &plain()));
        } else {
            write_image(&folder, "zyx", dtype, Version::V3);
            let mut said = attributes("zyx", 2);
            if !omero {
                said.as_object_mut().unwrap().remove("omero");
            }
            write_attributes(&folder, Version::V3, &said);
        }
        let source = open(&folder).unwrap();
        assert_eq!(source.volume().kind.is_labels(), is_labels, "{place}");
        let told = source
            .notes()
            .iter()
            .any(|note| note.contains("folder labels"));
        assert_eq!(told, is_labels, "{place}: {:?}", source.notes());
    }
}

fn plain() -> Value {
    json!([{"name": "bytes", "configuration": {"endian": "little"}}])
}

fn said_to_be_labels(folder: &Path) {
    let file = folder.join("zarr.json");
    let mut group: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    group["attributes"]["ome"]["image-label"] = json!({});
    fs::write(&file, group.to_string()).unwrap();
}

/// Things whose ids are wider than 16 bit stay apart, wherever the large ids are.
#[test]
fn wide_ids_are_not_merged() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("things.zarr");
    let metadata = version_3("uint64", [4, 33, 40], &plain());
    written::write(&folder, "uint64", &metadata);
    said_to_be_labels(&folder);
    let source = open(&folder).unwrap();
    assert!(source.volume().kind.is_labels());
    assert_eq!(source.renamed_label(), None, "nothing was read yet");
    let shown = read_all(&runtime(), &source);
    let ids = stored_ids(&folder);
    assert_eq!(shown.len(), ids.len());
    let mut numbers: BTreeMap<u64, u16> = BTreeMap::new();
    for (&id, &number) in ids.iter().zip(&shown) {
        let first = *numbers.entry(id).or_insert(number);
        assert_eq!(first, number, "{id} is shown as one number");
        if let Ok(narrow) = u16::try_from(id) {
            assert_eq!(number, narrow, "what fits stays");
        }
    }
    let renamed = source.renamed_label().unwrap();
    assert!(renamed > 65_535 && numbers.contains_key(&u64::try_from(renamed).unwrap()));
    let wide: Vec<u16> = { numbers.iter() }
        .filter(|(id, _)| **id > 65_535)
        .map(|(_, number)| *number)
        .collect();
    let mut different = wide.clone();
    different.sort_unstable();
    different.dedup();
    assert!(wide.len() > 5000, "{} wide ids", wide.len());
    // Of n things over 65535 numbers n²/131070 share one by chance.
    let by_chance = wide.len() * wide.len() / 131_070;
    assert!(
        wide.len() - different.len() <= 2 * by_chance,
        "{} of {}",
        different.len(),
        wide.len()
    );
    assert!(source.notes().iter().any(|note| note.contains("may share")));
}

/// Ids of the one level as they were written, from the bytes of its chunks, in the order of its voxels.
fn stored_ids(folder: &Path) -> Vec<u64> {
    let chunk = [4_usize, 33, 40];
    let metadata: Value =
        serde_json::from_slice(&fs::read(folder.join("0/zarr.json")).unwrap()).unwrap();
    let shape: Vec<usize> = serde_json::from_value(metadata["shape"].clone()).unwrap();
    let mut chunks: BTreeMap<[usize; 3], Vec<u8>> = BTreeMap::new();
    let mut ids = vec![0; shape.iter().product()];
    for (n, id) in ids.iter_mut().enumerate() {
        let at = [
            n / shape[2] / shape[1],
            n / shape[2] % shape[1],
            n % shape[2],
        ];
        let [z, y, x] = [0, 1, 2].map(|axis| at[axis] / chunk[axis]);
        let [iz, iy, ix] = [0, 1, 2].map(|axis| at[axis] % chunk[axis]);
        let file = folder.join(format!("0/c/{z}/{y}/{x}"));
        let bytes = { chunks.entry([z, y, x]) }.or_insert_with(|| fs::read(file).unwrap());
        let begin = ((iz * chunk[1] + iy) * chunk[2] + ix) * 8;
        *id = u64::from_le_bytes(bytes[begin..begin + 8].try_into().unwrap());
    }
    ids
}

/// Ids of a signed type are what they are, and 0 is nothing; shades of such a type are moved up.
#[test]
fn signed_ids_are_not_moved() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("things.zarr");
    let metadata = version_3("int32", [4, 33, 40], &plain());
    let want = written::write(&folder, "int32", &metadata);
    said_to_be_labels(&folder);
    let source = open(&folder).unwrap();
    assert!(read_all(&runtime(), &source) == want);
    write_image(&folder, "zyx", "int16", Version::V3);
    let moved = read_all(&runtime(), &open(&folder).unwrap());
    said_to_be_labels(&folder);
    let kept = read_all(&runtime(), &open(&folder).unwrap());
    assert!(
        moved
            .iter()
            .zip(&kept)
            .all(|(moved, kept)| moved ^ 0x8000 == *kept)
    );
}

/// Has z the fastest axis in each chunk, instead of x.
fn turn(array: &Path, width: usize) {
    let file = array.join("zarr.json");
    let mut metadata: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    let turn = json!({"name": "transpose", "configuration": {"order": [1, 2, 0]}});
    metadata["codecs"].as_array_mut().unwrap().insert(0, turn);
    fs::write(&file, metadata.to_string()).unwrap();
    let grid = VoxelBox::of_size(UVec3::new(2, 2, 4));
    for UVec3 { x, y, z } in grid.iter() {
        let file = array.join(format!("c/{z}/{y}/{x}"));
        let bytes = fs::read(&file).unwrap();
        let turned = (0..33 * 40 * 4).flat_map(|n| {
            let (yx, z) = (n / 4, n % 4);
            let from = (z * 33 * 40 + yx) * width;
            &bytes[from..from + width]
        });
        fs::write(&file, turned.copied().collect::<Vec<u8>>()).unwrap();
    }
}

/// A negative id is another number in a volume, whatever its type; what chunks have beyond the image is none of its ids.
#[test]
fn negative_ids_are_told_and_padding_is_not() {
    for (dtype, width) in [("int16", 2), ("int32", 4)] {
        for turned in [false, true] {
            let root = tempfile::tempdir().unwrap();
            let folder = root.path().join("things.zarr");
            let mut metadata = version_3(dtype, [4, 33, 40], &plain());
            metadata["fill_value"] = json!(-1);
            let want = written::write(&folder, dtype, &metadata);
            if turned {
                turn(&folder.join("0"), width);
            }
            said_to_be_labels(&folder);
            let read = || {
                let source = open(&folder).unwrap();
                (read_all(&runtime(), &source), source.renamed_label())
            };
            assert!(
                read() == (want, None),
                "{dtype}: all that is negative is padding"
            );
            let file = folder.join("0/c/3/1/1");
            let mut bytes = fs::read(&file).unwrap();
            bytes[..width].copy_from_slice(&(-3_i32).to_le_bytes()[..width]);
            fs::write(&file, bytes).unwrap();
            assert_eq!(read().1, Some(-3), "{dtype}");
            // What is not stored has the id that the array says.
            fs::remove_file(&file).unwrap();
            assert_eq!(read().1, Some(-1), "{dtype}");
        }
    }
}
