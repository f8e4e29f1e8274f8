//! Every kind of stack against the same rules, and what is no stack.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use glam::{DVec3, UVec2, UVec3};
use saccade_archive::image::{GrayImage, ImageError};
use saccade_core::voxel_box::VoxelBox;
use tempfile::TempDir;
use tiff::encoder::TiffEncoder;
use tiff::encoder::colortype::{Gray8, Gray16};

use super::*;
use crate::simulate::write::write_part;

const EXTENT: UVec3 = UVec3::new(23, 17, 12);

fn values() -> Vec<u8> {
    let value = |n: u32| u8::try_from(n.wrapping_mul(2_654_435_761) >> 24).unwrap();
    (0..EXTENT.element_product()).map(value).collect()
}

fn sections() -> impl Iterator<Item = Vec<u8>> {
    let all = values();
    let size = (EXTENT.x * EXTENT.y) as usize;
    (0..EXTENT.z as usize).map(move |z| all[z * size..][..size].to_vec())
}

fn write_section(path: &Path, size: UVec2, voxels: Vec<u8>) {
    let part = write_part(path, &GrayImage::new(size.x, size.y, voxels)).unwrap();
    fs::rename(part, path).unwrap();
}

/// Named without leading zeros, so that 10 comes before 2 for whoever sorts by letters.
fn folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (n, voxels) in sections().enumerate() {
        write_section(
            &folder.path().join(format!("s{n}.tif")),
            EXTENT.truncate(),
            voxels,
        );
    }
    fs::write(folder.path().join("notes.txt"), "not a section").unwrap();
    fs::write(folder.path().join(".hidden.tif"), "nor this").unwrap();
    folder
}

fn pages(folder: &Path) -> PathBuf {
    let path = folder.join("pages.tif");
    let mut file = File::create(&path).unwrap();
    let mut tiff = TiffEncoder::new(&mut file).unwrap();
    for voxels in sections() {
        tiff.write_image::<Gray8>(EXTENT.x, EXTENT.y, &voxels)
            .unwrap();
    }
    path
}

#[test]
fn folders_of_sections_are_stacks() {
    let folder = folder();
    conformance::check(
        &SectionFolder::open(folder.path()).unwrap(),
        EXTENT,
        &values(),
    );
    conformance::check(&*open(folder.path()).unwrap(), EXTENT, &values());
}

#[test]
fn pages_of_a_tiff_are_stacks() {
    let folder = tempfile::tempdir().unwrap();
    let path = pages(folder.path());
    conformance::check(&TiffPages::open(&path).unwrap(), EXTENT, &values());
    // Also if only the folder is named.
    conformance::check(&*open(folder.path()).unwrap(), EXTENT, &values());
}

#[test]
fn the_phantom_is_a_stack() {
    let nm = DVec3::new(9.0, 7.0, 31.0);
    let stack = PhantomStack::new(3, UVec3::new(61, 139, 2), nm).unwrap();
    let all = VoxelBox::of_size(stack.info().extent);
    let values: Vec<u8> = all
        .iter()
        .map(|v| stack.phantom().value(v.x, v.y, v.z))
        .collect();
    conformance::check(&stack, all.size(), &values);
    assert_eq!(stack.info().voxel_nm_or_assumed(), nm);

    // Any extent, at no cost.
    let large = PhantomStack::new(3, UVec3::new(21_494, 25_790, 1_850), nm).unwrap();
    let corner = large
        .region(1_849, UVec2::new(21_490, 25_789), UVec2::new(4, 1))
        .unwrap();
    assert_eq!(
        corner.voxels[3],
        large.phantom().value(21_493, 25_789, 1_849)
    );
}

#[test]
#[should_panic(expected = "section")]
fn the_rules_notice_a_wrong_voxel() {
    let folder = folder();
    let mut values = values();
    values[4_001] ^= 1;
    conformance::check(
        &SectionFolder::open(folder.path()).unwrap(),
        EXTENT,
        &values,
    );
}

#[test]
fn unknown_voxel_sizes_are_assumed_by_shape() {
    let info = |extent| StackInfo {
        name: "s".to_owned(),
        extent,
        voxel_nm: None,
    };
    let serial = info(UVec3::new(1024, 1024, 20)).voxel_nm_or_assumed();
    assert_eq!(serial.z / serial.x, 10.0);
    assert_eq!(
        info(UVec3::splat(250)).voxel_nm_or_assumed(),
        DVec3::splat(8.0)
    );
}

fn error(opened: Result<Box<dyn Stack>, StackError>) -> StackError {
    match opened {
        Ok(stack) => panic!("this is no stack: {:?}", stack.info()),
        Err(error) => error,
    }
}

#[test]
fn what_is_wrong_is_said_with_the_file() {
    let empty = tempfile::tempdir().unwrap();
    assert!(matches!(
        error(open(empty.path())),
        StackError::Empty { .. }
    ));
    let none = error(open(&empty.path().join("none")));
    assert!(
        matches!(&none, StackError::Read { .. }) && none.to_string().ends_with("none"),
        "{none}"
    );
    fs::write(empty.path().join("a.nii"), "x").unwrap();
    assert!(matches!(
        error(open(&empty.path().join("a.nii"))),
        StackError::Unknown { .. }
    ));

    // A section of another size is found when it is read; the others stay readable.
    let folder = folder();
    write_section(&folder.path().join("s3.tif"), UVec2::new(5, 4), vec![0; 20]);
    let stack = open(folder.path()).unwrap();
    let read = |section| stack.region(section, UVec2::ZERO, UVec2::ONE);
    let size = read(3).unwrap_err();
    assert!(
        matches!(&size, StackError::Size { got, .. } if *got == UVec2::new(5, 4)),
        "{size}"
    );
    assert!(size.to_string().ends_with("s3.tif"), "{size}");
    assert!(read(4).is_ok());

    // 16 bit, in a folder and as pages.
    let deep = folder.path().join("s0.tif");
    let mut file = File::create(&deep).unwrap();
    TiffEncoder::new(&mut file)
        .unwrap()
        .write_image::<Gray16>(2, 2, &[1, 2, 3, 4])
        .unwrap();
    drop(file);
    for opened in [open(folder.path()), open(&deep)] {
        let deep = error(opened);
        let depth = matches!(
            &deep,
            StackError::Image {
                source: ImageError::Depth { bits: 16 },
                ..
            }
        );
        assert!(depth && deep.to_string().ends_with("s0.tif"), "{deep:?}");
    }
    fs::write(folder.path().join("s0.tif"), "no image at all").unwrap();
    assert!(matches!(
        error(open(folder.path())),
        StackError::Image { .. }
    ));
    let pages = error(open(&folder.path().join("s0.tif")));
    assert!(matches!(pages, StackError::Image { .. }), "{pages:?}");
}
