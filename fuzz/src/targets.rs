//! One function per parser of foreign bytes. Each may refuse; none may panic, or take much time or memory.

use std::fs::{self, OpenOptions};
use std::io::Write as _;
use std::path::Path;

use glam::UVec2;
use saccade_archive::acquisition::{
    AcquisitionError, AcquisitionInfo, Cursor, Record, RecordReader, tile_configuration, tile_list,
    tile_specs, trakem2,
};
use saccade_archive::image::{self, Image, Pages, Wanted};
use saccade_archive::pyramid::{self, Encoding, PyramidIndex};
use saccade_archive::{ArchiveLocation, CatalogLocation, StorageLocation, read_identity};
use saccade_core::volume::Dtype;

use super::pieces::pieces;
use super::scratch::Scratch;

/// A parser.
pub type Target = fn(&[u8]);

/// All of them, by name.
pub const TARGETS: [(&str, Target); 15] = [
    ("description", description),
    ("records", records),
    ("record_file", record_file),
    ("tile_specs", tile_specs),
    ("tile_configuration", tile_configuration),
    ("tile_list", tile_list),
    ("trakem2", trakem2),
    ("image", image),
    ("image_of_size", image_of_size),
    ("tiff_pages", tiff_pages),
    ("pyramid", pyramid),
    ("round_trip", round_trip),
    ("percent_encoding", percent_encoding),
    ("identity", identity),
    ("archive_location", archive_location),
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

/// `tiles.jsonl` while it grows: read piece by piece, by readers that end and others that go on, it holds the records of the
/// whole. The first byte chooses the pieces.
fn record_file(bytes: &[u8]) {
    let Some((&choice, bytes)) = bytes.split_first() else {
        return;
    };
    let scratch = Scratch::new("records");
    let folder = scratch.path();
    let path = scratch.write(RecordReader::FILE, bytes);
    let mut whole = RecordReader::new(folder, Cursor::default());
    let lines = whole.read(usize::MAX).expect("a file is read");
    let end = whole.cursor();
    let is_end = |b: &u8| *b == b'\n';
    assert_eq!(
        end.offset as usize,
        bytes.iter().rposition(is_end).map_or(0, |n| n + 1)
    );
    assert_eq!(end.line, bytes.iter().filter(|b| is_end(b)).count() as u64);
    let mut before = Cursor::default();
    for line in &lines {
        let (from, to) = (line.offset as usize, line.next.offset as usize);
        assert!(before.offset <= line.offset && from < to && to <= bytes.len());
        assert!(before.line < line.next.line, "{before:?} {line:?}");
        let text = bytes[from..to].strip_suffix(b"\n").expect("whole lines");
        let text = match from {
            0 => text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text),
            _ => text,
        };
        assert!(!text.contains(&b'\n') && !text.iter().all(u8::is_ascii_whitespace));
        match (&line.record, Record::parse(text)) {
            (Ok(one), Ok(other)) => assert_eq!(*one, other),
            (Err(broken), Err(_)) => {
                assert_eq!(broken.line, line.next.line);
                // Whatever the line is.
                assert!(
                    broken.reason.len() < 4096,
                    "{} bytes of reason",
                    broken.reason.len()
                );
            }
            (one, other) => panic!("{one:?} of a file, {other:?} of a line"),
        }
        before = line.next;
    }

    fs::write(&path, b"").expect("a temporary file");
    let mut reader = RecordReader::new(folder, Cursor::default());
    let mut found = Vec::new();
    for piece in pieces(choice, bytes) {
        let appended = OpenOptions::new().append(true).open(&path);
        let appended = appended.and_then(|mut file| file.write_all(piece));
        appended.expect("a temporary file");
        loop {
            let some = reader
                .read(1 + usize::from(choice) % 5)
                .expect("it only grows");
            if some.is_empty() {
                break;
            }
            found.extend(some);
        }
        assert!(reader.is_between_lines().expect("it is there"));
        reader = RecordReader::new(folder, reader.cursor());
    }
    assert_eq!((&found, reader.cursor()), (&lines, end));

    let Some(resumed) = lines.get(usize::from(choice) % lines.len().max(1)) else {
        return;
    };
    let rest = whole.at(resumed.next).read(usize::MAX).expect("it goes on");
    assert!(
        lines.ends_with(&rest)
            && rest
                .first()
                .is_none_or(|line| line.offset >= resumed.next.offset)
    );
    assert_eq!(
        rest.len(),
        lines
            .iter()
            .filter(|line| line.offset >= resumed.next.offset)
            .count()
    );
    // A cursor that knows only where it is learns what lies before it.
    let mut blind = whole.at(Cursor {
        seen: None,
        ..resumed.next
    });
    assert_eq!(blind.recognize().expect("it is there"), resumed.next);
    // Others in their place are no records that were read, and neither are fewer.
    let offset = resumed.next.offset as usize;
    let mut others = bytes.to_vec();
    others[offset - 1] ^= 1;
    fs::write(&path, &others).expect("a temporary file");
    let replaced = whole.at(resumed.next).read(1);
    assert!(
        matches!(replaced, Err(AcquisitionError::RecordsReplaced { .. })),
        "{replaced:?}"
    );
    fs::write(&path, &bytes[..offset - 1]).expect("a temporary file");
    let cut = whole.at(resumed.next).read(1);
    assert!(
        matches!(cut, Err(AcquisitionError::RecordsCut { .. })),
        "{cut:?}"
    );
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

/// A TIFF file of several pages: what is said of a page is what it is, in whatever order they are asked for.
fn tiff_pages(bytes: &[u8]) {
    // As of single images.
    if bytes.len() > 1 << 14 {
        return;
    }
    let scratch = Scratch::new("pages");
    let path = scratch.write("stack.tif", bytes);
    let Ok(mut pages) = Pages::open(&path) else {
        return;
    };
    // Each begins somewhere else.
    assert!((1..=bytes.len()).contains(&(pages.count() as usize)));
    let some = pages.count().min(6);
    let looked: Vec<_> = (0..some)
        .map(|page| pages.check(page, Wanted::GRAY_16))
        .collect();
    let decoded: Vec<_> = (0..some)
        .map(|page| pages.decode(page, Wanted::GRAY_16))
        .collect();
    for page in (0..some).rev() {
        let n = page as usize;
        match (&looked[n], &decoded[n]) {
            (Ok([width, height]), Ok(Image::Uint16(image))) => {
                assert_eq!((*width, *height), (image.width, image.height));
                let again = pages.decode(page, Wanted::GRAY_16);
                assert_eq!(again.expect("once more"), Image::Uint16(image.clone()));
            }
            (Err(_), Ok(_)) => panic!("page {page} is refused, and decoded"),
            (_, Ok(other)) => panic!("{other:?} instead of 16 bits"),
            (_, Err(_)) => assert!(pages.decode(page, Wanted::GRAY_16).is_err()),
        }
    }
    let beyond = pages.check(pages.count(), Wanted::GRAY_16);
    assert!(beyond.is_err(), "there is no such page");
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

/// Names that lists may have taken from URLs.
fn percent_encoding(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    if let Some(decoded) = tile_list::decoded(text) {
        assert!(
            decoded.len() < text.len() && text.contains('%'),
            "{decoded:?}"
        );
        let slashes = |text: &str| text.matches(['/', '\\']).count();
        assert!(slashes(&decoded) == slashes(text) && !decoded.contains('\0'));
    }
    // What is encoded letter by letter is decoded.
    let encoded: String = text.bytes().map(|b| format!("%{b:02x}")).collect();
    let plain = !text.is_empty() && !text.contains(['/', '\\', '\0']);
    assert_eq!(
        tile_list::decoded(&encoded).as_deref(),
        plain.then_some(text)
    );
}

/// The object that says to which catalog a storage belongs.
fn identity(bytes: &[u8]) {
    if let Some(identity) = read_identity(bytes) {
        assert_eq!(identity.len(), 32);
        let line = format!("{identity}\n");
        assert_eq!(read_identity(line.as_bytes()), Some(identity));
        // One that is cut is none.
        assert_eq!(read_identity(&line.as_bytes()[..31]), None);
    }
}

/// Where an archive and its catalog are: two lines.
fn archive_location(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let (storage, catalog) = text.split_once('\n').unwrap_or((text, ""));
    let catalog: Option<CatalogLocation> = catalog.parse().ok();
    // Whatever is in a password: nothing of it is shown.
    let secret = CatalogLocation::parse(&format!("postgres://me:hush{text}hush@host/db"));
    assert!(
        !secret.to_string().contains("hush") || text.contains("hush"),
        "{secret}"
    );
    let Ok(storage) = storage.parse::<StorageLocation>() else {
        return;
    };
    assert_eq!(storage.to_string().parse(), Ok(storage.clone()));
    if let StorageLocation::Bucket(bucket) = &storage {
        let parts: Vec<&str> = bucket.prefix().split('/').collect();
        assert!(
            bucket.prefix().is_empty()
                || parts.iter().all(|part| !matches!(*part, "" | "." | ".."))
        );
        assert!(!bucket.bucket().is_empty() && !bucket.bucket().contains('/'));
    }
    let is_folder = matches!(storage, StorageLocation::Folder(_));
    let archive = ArchiveLocation::new(storage, catalog.clone());
    assert_eq!(archive.is_ok(), is_folder || catalog.is_some());
}
