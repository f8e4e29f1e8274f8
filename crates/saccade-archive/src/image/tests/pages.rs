//! Pages of a file are images like others.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use ::tiff::encoder::colortype::{Gray8, Gray16};
use ::tiff::encoder::{Compression, DeflateLevel, TiffEncoder};
use glam::UVec2;

use super::super::{Image, ImageError, Pages, Wanted};
use super::{gray_png, raw_tiff, texture};

/// Pages of different sizes and bits, packed in different ways.
fn written(path: &Path) {
    let mut file = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file).unwrap();
    for (page, packed) in (0..).zip([
        Compression::Uncompressed,
        Compression::Lzw,
        Compression::Deflate(DeflateLevel::Fast),
        Compression::Packbits,
    ]) {
        let image = texture(40 + page, 30);
        encoder = encoder.with_compression(packed);
        encoder
            .write_image::<Gray8>(image.width, image.height, &image.voxels)
            .unwrap();
    }
    encoder
        .write_image::<Gray16>(3, 2, &[0, 1, 256, 257, 40_000, 65_535])
        .unwrap();
    fs::write(path, file.into_inner()).unwrap();
}

#[test]
fn pages_come_back_in_any_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pages.tif");
    written(&path);
    let mut pages = Pages::open(&path).unwrap();
    assert_eq!(pages.count(), 5);
    for page in [3, 0, 2, 2, 1, 3] {
        let want = texture(40 + page, 30);
        assert_eq!(pages.check(page, Wanted::GRAY_8).unwrap(), [40 + page, 30]);
        let image = pages.decode(page, Wanted::GRAY_8).unwrap();
        assert_eq!(image, Image::Uint8(want), "page {page}");
    }
    let deep = pages.decode(4, Wanted::GRAY_16).unwrap();
    let Image::Uint16(deep) = deep else {
        panic!("{deep:?}")
    };
    assert_eq!(deep.voxels, [0, 1, 256, 257, 40_000, 65_535]);
    for refused in [
        pages.check(4, Wanted::GRAY_8).map(|_| ()),
        pages.decode(4, Wanted::GRAY_8).map(|_| ()),
    ] {
        let depth = matches!(refused, Err(ImageError::Depth { bits: 16, .. }));
        assert!(depth, "{refused:?}");
    }
    // Another size than is known, before anything is decoded.
    let wanted = Wanted {
        size: Some(UVec2::new(40, 30)),
        ..Wanted::GRAY_8
    };
    assert!(pages.check(0, wanted).is_ok());
    let other = pages.check(1, wanted);
    assert!(
        matches!(other, Err(ImageError::Size { width: 41, .. })),
        "{other:?}"
    );
    assert!(pages.check(5, Wanted::GRAY_8).is_err());
}

#[test]
fn files_that_have_no_pages_or_no_end_of_them_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pages.tif");
    fs::write(&path, gray_png(&texture(4, 4))).unwrap();
    let png = Pages::open(&path);
    assert!(
        matches!(png, Err(ImageError::Unsupported { .. })),
        "{png:?}"
    );

    // The last four bytes say where the next page begins: at the first one.
    let mut file = raw_tiff([2, 1], 8, &[(262, 1)], &[1, 2]);
    fs::write(&path, &file).unwrap();
    assert_eq!(Pages::open(&path).unwrap().count(), 1);
    let end = file.len() - 4;
    file[end..].copy_from_slice(&10_u32.to_le_bytes());
    fs::write(&path, &file).unwrap();
    let round = Pages::open(&path);
    assert!(matches!(round, Err(ImageError::Broken { .. })), "{round:?}");

    // A page that is still to be written.
    let len = u32::try_from(file.len()).unwrap();
    file[end..].copy_from_slice(&len.to_le_bytes());
    fs::write(&path, &file).unwrap();
    let unwritten = Pages::open(&path);
    assert!(
        matches!(unwritten, Err(ImageError::Incomplete { .. })),
        "{unwritten:?}"
    );
}
