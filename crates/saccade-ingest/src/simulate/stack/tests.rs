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

/// Entries of a page's directory, and its pixels.
type Page<'a> = (&'a [(u16, u32)], &'a [u8]);

/// A TIFF of one directory per page, written by hand: each is its tags, as short numbers, and its data.
fn pages_by_hand(pages: &[Page<'_>]) -> Vec<u8> {
    let mut file = b"II\x2a\0\0\0\0\0".to_vec();
    let mut link = 4;
    for (tags, data) in pages {
        let at = u32::try_from(file.len()).unwrap();
        file.extend(*data);
        let len = u32::try_from(data.len()).unwrap();
        let mut tags = tags.to_vec();
        tags.extend([(273, at), (279, len)]);
        tags.sort_unstable();
        let directory = u32::try_from(file.len()).unwrap();
        file[link..link + 4].copy_from_slice(&directory.to_le_bytes());
        file.extend(u16::try_from(tags.len()).unwrap().to_le_bytes());
        for (tag, value) in tags {
            file.extend(tag.to_le_bytes());
            file.extend([4, 0, 1, 0, 0, 0]);
            file.extend(value.to_le_bytes());
        }
        link = file.len();
        file.extend([0; 4]);
    }
    file
}

/// Tags of an uncompressed page.
fn plain(width: u32, height: u32, bits: u32) -> Vec<(u16, u32)> {
    let tags = [width, height, bits, 1, 1, 1, height];
    [256, 257, 258, 259, 262, 277, 278]
        .into_iter()
        .zip(tags)
        .collect()
}

/// What is odd in a page is as in a file of its own: few bits, white that is zero, equal channels.
#[test]
fn odd_pages_are_sections_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odd.tif");
    let with = |bits, tag, value| {
        let mut tags = plain(4, 1, bits);
        tags.retain(|(known, _)| *known != tag);
        tags.push((tag, value));
        tags
    };
    let (bits, white) = (plain(4, 1, 1), with(8, 262, 0));
    let mut rgb = with(8, 277, 3);
    rgb.retain(|(tag, _)| *tag != 262);
    rgb.push((262, 2));
    let file = pages_by_hand(&[
        (&plain(4, 1, 8), &[1, 2, 3, 4]),
        (&bits, &[0b1010_0000]),
        (&white, &[255, 254, 0, 1]),
        (&rgb, &[7, 7, 7, 8, 8, 8, 9, 9, 9, 0, 0, 0]),
    ]);
    fs::write(&path, file).unwrap();
    let stack = TiffPages::open(&path).unwrap();
    let want = [1, 2, 3, 4, 255, 0, 255, 0, 0, 1, 255, 254, 7, 8, 9, 0];
    conformance::check(&stack, UVec3::new(4, 1, 4), &want);

    // Whatever is wrong with a later page is noticed before anything is decoded, and where it is.
    let good = plain(4, 1, 8);
    let refused = |page: &[(u16, u32)]| {
        let file = pages_by_hand(&[(&good, &[1, 2, 3, 4]), (page, &[1, 2, 3, 4])]);
        fs::write(&path, file).unwrap();
        TiffPages::open(&path).unwrap_err()
    };
    let deep = refused(&plain(2, 1, 16));
    let depth = matches!(
        deep,
        StackError::Page {
            source: ImageError::Depth { bits: 16, .. },
            page: 2,
            ..
        }
    );
    assert!(depth && deep.to_string().contains("page 2"), "{deep}");
    let other = refused(&plain(2, 2, 8));
    assert!(matches!(other, StackError::Size { .. }), "{other}");
    let mut cut = plain(4, 1, 8);
    cut.push((266, 2));
    let reversed = refused(&cut);
    assert!(matches!(reversed, StackError::Page { .. }), "{reversed}");
}

/// The pages of a file that claims gigapixels are refused before memory is set aside for them. Measured in a
/// process of its own: other tests need memory too.
#[test]
#[cfg(target_os = "linux")]
fn pages_that_are_bombs_are_refused() {
    const NAME: &str = "simulate::stack::tests::pages_that_are_bombs_are_refused";
    const BOMB: &str = "SACCADE_TEST_BOMB";
    const CEILING: u64 = 64 << 20;
    let resident = |key: &str| {
        let status = fs::read_to_string("/proc/self/status").unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let kib = line.unwrap().trim_matches([':', ' ', '\t']);
        kib.trim_end_matches(" kB").parse::<u64>().unwrap() << 10
    };
    let took = |work: &mut dyn FnMut()| {
        fs::write("/proc/self/clear_refs", "5").unwrap();
        let before = resident("VmRSS");
        work();
        resident("VmHWM").saturating_sub(before)
    };
    if let Some(bomb) = std::env::var_os(BOMB) {
        let control = took(&mut || {
            drop(std::hint::black_box(vec![
                1_u8;
                2 * usize::try_from(CEILING)
                    .unwrap()
            ]))
        });
        assert!(control > CEILING, "the measure sees {control} bytes");
        let took = took(&mut || {
            let refused = match TiffPages::open(Path::new(&bomb)) {
                Err(refused) => refused,
                // What a page says of itself may be possible, and its data not.
                Ok(stack) => stack
                    .region(1, UVec2::ZERO, UVec2::ONE)
                    .expect_err("it is no image"),
            };
            assert!(
                matches!(refused, StackError::Image { .. } | StackError::Page { .. }),
                "{refused}"
            );
        });
        assert!(took < CEILING, "took {took} bytes to refuse");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bomb.tif");
    let good = plain(4, 1, 8);
    let pixels: (&[(u16, u32)], &[u8]) = (&good, &[1, 2, 3, 4]);
    let deflated = |edge| {
        let mut tags = plain(edge, edge, 8);
        tags[3].1 = 8;
        tags
    };
    for edge in [1 << 14, 1 << 16, 1 << 20] {
        for tags in [plain(edge, edge, 8), plain(edge, edge, 16), deflated(edge)] {
            let bomb: (&[(u16, u32)], &[u8]) = (&tags, &[7; 64]);
            for pages in [[bomb, pixels], [pixels, bomb]] {
                fs::write(&path, pages_by_hand(&pages)).unwrap();
                let child = std::process::Command::new(std::env::current_exe().unwrap())
                    .args([NAME, "--exact"])
                    .env(BOMB, &path)
                    .output()
                    .unwrap();
                let said = String::from_utf8_lossy(&child.stdout);
                assert!(child.status.success(), "{edge}, {tags:?}: {said}");
                assert!(said.contains("1 passed"), "{said}");
            }
        }
    }
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
                source: ImageError::Depth {
                    bits: 16,
                    volume: 8
                },
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

/// An OME-Zarr 0.4 written by hand: chunks of 5 x 6 x 7, uncompressed, one of them left out.
fn zarr(folder: &Path, channels: bool, sixteen: bool) {
    let (chunk, size) = ([5, 6, 7], [EXTENT.z, EXTENT.y, EXTENT.x]);
    let axis = |name| format!(r#"{{"name":"{name}","type":"space","unit":"micrometer"}}"#);
    let mut axes = ["z", "y", "x"].map(axis).to_vec();
    let (mut shape, mut chunks, mut scale) =
        (size.to_vec(), chunk.to_vec(), vec![0.04, 0.005, 0.004]);
    if channels {
        axes.insert(0, r#"{"name":"c","type":"channel"}"#.to_owned());
        shape.insert(0, 2);
        chunks.insert(0, 1);
        scale.insert(0, 1.0);
    }
    let axes = axes.join(",");
    let attributes = format!(
        r#"{{"multiscales":[{{"version":"0.4","axes":[{axes}],"datasets":[{{"path":"0",
            "coordinateTransformations":[{{"type":"scale","scale":{scale:?}}}]}}]}}]}}"#
    );
    let dtype = if sixteen { "<u2" } else { "|u1" };
    let array = format!(
        r#"{{"zarr_format":2,"shape":{shape:?},"chunks":{chunks:?},"dtype":"{dtype}","fill_value":0,
            "order":"C","filters":null,"compressor":null,"dimension_separator":"/"}}"#
    );
    fs::create_dir_all(folder.join("0")).unwrap();
    fs::write(folder.join(".zattrs"), attributes).unwrap();
    fs::write(folder.join(".zgroup"), r#"{"zarr_format":2}"#).unwrap();
    fs::write(folder.join("0/.zarray"), array).unwrap();
    let values = values();
    let count = |n: usize| size[n].div_ceil(chunk[n]);
    for at in VoxelBox::of_size(UVec3::new(count(2), count(1), count(0))).iter() {
        if at == UVec3::ONE {
            continue;
        }
        let mut bytes = Vec::new();
        for inside in VoxelBox::of_size(UVec3::new(chunk[2], chunk[1], chunk[0])).iter() {
            let v = at * UVec3::new(chunk[2], chunk[1], chunk[0]) + inside;
            let index = ((v.z * EXTENT.y + v.y) * EXTENT.x + v.x) as usize;
            let value = if v.cmplt(EXTENT).all() {
                values[index]
            } else {
                99
            };
            bytes.push(value);
            if sixteen {
                bytes.push(1);
            }
        }
        let channel = if channels { "0/0/" } else { "0/" };
        let path = folder.join(format!("{channel}{}/{}/{}", at.z, at.y, at.x));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
}

/// The values, with 0 where [`zarr`] leaves out a chunk.
fn zarr_values() -> Vec<u8> {
    let mut values = values();
    let missing = VoxelBox::new(UVec3::new(7, 6, 5), UVec3::new(14, 12, 10));
    for (value, at) in values.iter_mut().zip(VoxelBox::of_size(EXTENT).iter()) {
        if missing.contains(at) {
            *value = 0;
        }
    }
    values
}

#[test]
fn ome_zarrs_are_stacks() {
    for channels in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        zarr(folder.path(), channels, false);
        conformance::check(&*open(folder.path()).unwrap(), EXTENT, &zarr_values());
        let info = open(folder.path()).unwrap().info().clone();
        let nm = info.voxel_nm.unwrap();
        assert!(
            (nm - DVec3::new(4.0, 5.0, 40.0)).abs().max_element() < 1e-9,
            "{nm}"
        );
    }
}

#[test]
fn sixteen_bit_zarrs_need_a_window() {
    let folder = tempfile::tempdir().unwrap();
    zarr(folder.path(), false, true);
    let refused = error(open(folder.path()));
    let depth = matches!(
        &refused,
        StackError::Image {
            source: ImageError::Depth {
                bits: 16,
                volume: 8
            },
            ..
        }
    );
    assert!(depth, "{refused}");
    // Stored are 256 + value, and 0.
    let window = Window {
        low: 256,
        high: 256 + 254,
    };
    let stack = ZarrStack::open(folder.path(), Some(window)).unwrap();
    let raised: Vec<u8> = zarr_values().iter().map(|v| v.saturating_add(1)).collect();
    conformance::check(&stack, EXTENT, &raised);
    assert_eq!(
        [0, 256, 510, u16::MAX].map(|v| window.apply(v)),
        [1, 1, 255, 255]
    );

    fs::write(folder.path().join(".zattrs"), "{}").unwrap();
    assert!(matches!(
        error(open(folder.path())),
        StackError::Zarr { .. }
    ));
}

#[test]
fn zarrs_of_other_writers_are_stacks() {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let shared = std::env::var_os("SACCADE_SHARED")
        .map_or(beside, PathBuf::from)
        .join("data");
    let source = shared.join("fib25-medulla/training_sample2/grayscale_maps");
    if !source.is_dir() {
        let is_named = std::env::var_os("SACCADE_SHARED").is_some();
        assert!(
            !is_named,
            "SACCADE_SHARED is set, but {} is not there",
            source.display()
        );
        let text = format!("skipped: {} is not there\n", source.display());
        std::io::Write::write_all(&mut std::io::stderr(), text.as_bytes()).unwrap();
        return;
    }
    // Both hold the same part of the same stack.
    let source = SectionFolder::open(&source).unwrap();
    let extent = UVec3::new(140, 135, 130);
    let mut values = Vec::new();
    for section in 60..190 {
        values.extend(
            source
                .region(section, UVec2::new(40, 50), extent.truncate())
                .unwrap()
                .voxels
                .into_vec(),
        );
    }
    for name in ["omezarr04_zyx_u8", "omezarr05_zyx_u8_sharded"] {
        let stack = open(&shared.join("derived-refwriters/dev").join(name)).unwrap();
        conformance::check(&*stack, extent, &values);
        assert_eq!(stack.info().voxel_nm, Some(DVec3::splat(10.0)));
    }
}
