//! One function per parser of foreign bytes that this crate keeps to itself, or offers. `./dev fuzz` runs them for long, the
//! tests on seeds that are changed at random. Each may refuse; none may panic, or take much time or memory.

use std::io::BufReader;

use glam::UVec2;
use saccade_archive::acquisition::Record;

use crate::simulate::settings::Settings;
use crate::simulate::stack::{self, Stack, TiffPages, Window, ZarrStack};
use crate::update::{self, Change};

#[cfg(test)]
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/changed.rs"]
mod changed;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/scratch.rs"]
pub(crate) mod scratch;

use scratch::Scratch;

/// A parser.
pub type Target = fn(&[u8]);

/// All of them, by name.
pub const TARGETS: &[(&str, Target)] = &[
    ("update", changes),
    #[cfg(unix)]
    ("pattern", names::pattern),
    #[cfg(unix)]
    ("channel_in", names::channel_in),
    #[cfg(unix)]
    ("stamps", crate::watch::fuzz_stamps),
    ("tiff_stack", tiff_stack),
    ("zarr_stack", zarr_stack),
    ("simulation", simulation),
];

/// A file for `saccade update`: all of it or nothing, however it is read. The first byte says in what pieces.
fn changes(bytes: &[u8]) {
    let Some((&piece, bytes)) = bytes.split_first() else {
        return;
    };
    let pieces = BufReader::with_capacity(usize::from(piece) + 1, bytes);
    let in_pieces = update::read(pieces, "changes");
    let lines = match (update::read(bytes, "changes"), in_pieces) {
        (Ok(lines), Ok(others)) => {
            assert_eq!(lines, others);
            lines
        }
        (Err(error), Err(other)) => {
            assert_eq!(error.to_string(), other.to_string());
            assert!(error.to_string().len() < 1 << 14, "a message is to be read");
            return;
        }
        (one, other) => panic!("{one:?}, and in pieces {other:?}"),
    };
    let all = bytes.split(|b| *b == b'\n').count() as u64;
    assert!(lines.is_sorted_by(|a, b| a.line < b.line));
    assert!(lines.iter().all(|line| (1..=all).contains(&line.line)));
    // Written by somebody else, it says the same.
    let mut text = Vec::new();
    for line in &lines {
        let record = match line.change.clone() {
            Change::Transform(record) => {
                assert!(Record::is_sensible(record.transform));
                Record::Transform(record)
            }
            Change::Delete(record) => Record::Delete(record),
        };
        serde_json::to_writer(&mut text, &record).expect("a record becomes JSON");
        text.push(b'\n');
    }
    let again = update::read(&*text, "changes").expect("what was written is read");
    let said = |lines: &[update::Line]| -> Vec<Change> {
        lines.iter().map(|line| line.change.clone()).collect()
    };
    assert_eq!(said(&again), said(&lines));
}

#[cfg(unix)]
mod names {
    use crate::watch::{Pattern, Place};

    /// A pattern, and paths that it may fit: lines. What fits is told by the same parts one after the other, and nothing that
    /// fits has a reason why it does not.
    pub(super) fn pattern(bytes: &[u8]) {
        let Ok(text) = std::str::from_utf8(bytes) else {
            return;
        };
        let mut lines = text.lines();
        let Ok(pattern) = lines.next().unwrap_or_default().parse::<Pattern>() else {
            return;
        };
        assert_eq!(pattern.to_string().parse(), Ok(pattern.clone()));
        for path in lines.take(16) {
            let mut names: Vec<&str> = path.split('/').collect();
            let file = names.pop().unwrap_or_default();
            let mut place = Some(Place::default());
            for (depth, name) in names.iter().enumerate() {
                place = place.and_then(|known| pattern.folder(depth, name, &known));
                // What can hardly be anything else is one.
                let alone = pattern.folder(depth, name, &Place::default());
                assert!(alone.is_some() || !pattern.is_a_folder(depth, name));
            }
            let place = place.filter(|_| names.len() == pattern.depth());
            let place = place.and_then(|known| pattern.file(file, &known));
            let mismatch = pattern.mismatch(path, false);
            assert_eq!(
                place.is_none(),
                mismatch.is_some(),
                "{pattern} {path:?}: {mismatch:?}"
            );
            if let Some(place) = place {
                let channel = place.channel.as_deref();
                assert!(channel.is_none_or(|name| !name.is_empty() && path.contains(name)));
                let name = place.name();
                assert!(name.starts_with(&format!(
                    "s{}_r{}_c{}",
                    place.section, place.row, place.column
                )));
            }
        }
    }

    /// A pattern of names that say the channel, and such names: lines.
    pub(super) fn channel_in(bytes: &[u8]) {
        let Ok(text) = std::str::from_utf8(bytes) else {
            return;
        };
        let mut lines = text.lines();
        let Ok(pattern) = Pattern::of_channels(lines.next().unwrap_or_default()) else {
            return;
        };
        assert_eq!(
            Pattern::of_channels(&pattern.to_string()),
            Ok(pattern.clone())
        );
        for path in lines.take(16) {
            match pattern.channel(path) {
                Ok(channel) => {
                    assert!(!channel.is_empty() && path.contains(&channel));
                    // The folders above do not matter.
                    assert_eq!(pattern.channel(&format!("somewhere/{path}")), Ok(channel));
                }
                Err(why) => assert!(!why.is_empty(), "{pattern} {path:?}"),
            }
        }
    }
}

/// A multi-page TIFF as a stack.
fn tiff_stack(bytes: &[u8]) {
    if bytes.len() > 1 << 14 {
        return;
    }
    let scratch = Scratch::new("tiff");
    let path = scratch.write("stack.tif", bytes);
    if let Ok(stack) = TiffPages::open(&path) {
        look_into(&stack);
    }
}

/// An OME-Zarr as a stack: its group, its array and a chunk, with a record separator (0x1e) between them.
fn zarr_stack(bytes: &[u8]) {
    // What the library panics of is caught there, and told as an error; libFuzzer ends with any panic unless it is asked not to.
    #[cfg(fuzzing)]
    {
        static QUIET: std::sync::Once = std::sync::Once::new();
        QUIET.call_once(|| drop(std::panic::take_hook()));
    }
    let mut parts = bytes.splitn(3, |b| *b == 0x1e);
    let mut part = || parts.next().unwrap_or_default();
    let (group, array, chunk) = (part(), part(), part());
    let scratch = Scratch::new("zarr");
    // Of version 3 only.
    let is_3 = array.windows(9).any(|part| part == b"node_type");
    let names = match is_3 {
        true => ["zarr.json", "0/zarr.json", "0/c/0/0/0"],
        false => [".zattrs", "0/.zarray", "0/0.0.0"],
    };
    let root = scratch.path().join("image");
    for (name, bytes) in names.iter().zip([group, array, chunk]) {
        scratch.write(&format!("image/{name}"), bytes);
    }
    assert!(stack::is_zarr(&root));
    for window in [
        None,
        Some(Window {
            low: 10,
            high: 1000,
        }),
    ] {
        if let Ok(stack) = ZarrStack::open(&root, window) {
            look_into(&stack);
        }
    }
}

/// The corners of the first and of the last section are as they are within more, or cannot be read.
fn look_into(stack: &dyn Stack) {
    let extent = stack.info().extent;
    assert!(extent.min_element() > 0);
    let nm = stack.info().voxel_nm_or_assumed();
    assert!(nm.is_finite() && nm.min_element() > 0.0);
    let flat = extent.truncate();
    for section in [0, extent.z - 1] {
        let size = flat.min(UVec2::splat(9));
        for min in [UVec2::ZERO, flat - size] {
            let Ok(image) = stack.region(section, min, size) else {
                continue;
            };
            assert_eq!((image.width, image.height), (size.x, size.y));
            assert_eq!(
                image.voxels.len() as u64,
                u64::from(size.x) * u64::from(size.y)
            );
            let one = stack.region(section, min + size - 1, UVec2::ONE);
            assert_eq!(
                one.expect("it was read").voxels[..],
                image.voxels[image.voxels.len() - 1..]
            );
        }
    }
    let outside = stack.region(extent.z, UVec2::ZERO, UVec2::ONE);
    assert!(matches!(outside, Err(stack::StackError::Outside { .. })));
}

/// `simulation.json`, and what is kept of a watched folder in the same way.
fn simulation(bytes: &[u8]) {
    let scratch = Scratch::new("simulation");
    scratch.write(Settings::FILE, bytes);
    let Ok(Some(settings)) = Settings::read(scratch.path()) else {
        return;
    };
    for name in ["input", "list", "pattern", "pitch", "origin", "first"] {
        let [text, number, pair] = [
            settings.text(name).is_some(),
            settings.number(name).is_some(),
            settings.pair(name).is_some(),
        ];
        assert!(u8::from(text) + u8::from(number) + u8::from(pair) <= 1);
    }
    settings.write(scratch.path()).expect("it is written");
    let again = Settings::read(scratch.path())
        .expect("it is there")
        .expect("it was written");
    assert_eq!(settings.differences(&again), Vec::<String>::new());
    let none = Settings::of_replay("x");
    assert_eq!(
        none.differences(&settings).len(),
        settings.differences(&none).len()
    );
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::changed::{files, survives};
    use super::*;

    #[test]
    fn parsers_survive_foreign_bytes() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        for &(name, target) in TARGETS {
            let mut seeds = files(&root.join("fuzz/seeds").join(name));
            // Those that write their input into files for each take a while.
            let inputs = match name {
                "tiff_stack" => {
                    seeds.extend(files(&root.join("fuzz/seeds/tiff_pages")));
                    500
                }
                "zarr_stack" | "simulation" => 500,
                _ => 2_000,
            };
            survives(name, target, &seeds, inputs);
        }
    }
}
