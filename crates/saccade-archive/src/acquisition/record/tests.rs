use std::io::Write as _;

use super::prefix::{HEAD, MAX_LINE};
use super::*;
use crate::acquisition::AcquisitionError;
use glam::DVec2;

fn tile(name: &str) -> Record {
    Record::Tile(TileRecord {
        tile: name.to_owned(),
        file: format!("tiles/{name}.tif"),
        section: 3,
        size: UVec2::new(300, 260),
        transform: SectionFromTile::translation(DVec2::new(10.0, -2.5)),
        channel: None,
    })
}

fn records(lines: &[RecordLine]) -> Vec<Record> {
    lines.iter().map(|l| l.record.clone().unwrap()).collect()
}

#[test]
fn the_text_is_the_documented_one() {
    let json = serde_json::to_string(&tile("a")).unwrap();
    let want = r#"{"record":"tile","tile":"a","file":"tiles/a.tif","section":3,"size":[300,260],"transform":[1.0,0.0,0.0,1.0,10.0,-2.5]}"#;
    assert_eq!(json, want);
    let moved = r#"{"record":"transform","by":"someone","tile":"a","transform":[1,0,0,1,2,3]}"#;
    let Record::Transform(moved) = serde_json::from_str(moved).unwrap() else {
        panic!("not a transform")
    };
    assert_eq!(moved.transform.elements(), [1.0, 0.0, 0.0, 1.0, 2.0, 3.0]);
}

#[test]
fn channels_are_named_or_counted() {
    let channels = ["membranes", "2"].map(str::to_owned);
    let of = |channel: &str| {
        let text = format!(
            r#"{{"tile":"a","file":"a","section":0,"size":[1,1],"transform":[1,0,0,1,0,0]{channel}}}"#
        );
        let record: TileRecord = serde_json::from_str(&text).unwrap();
        let again = serde_json::to_string(&record).unwrap();
        assert_eq!(serde_json::from_str::<TileRecord>(&again).unwrap(), record);
        record.channel_among(&channels)
    };
    assert_eq!(of(""), Some(0));
    assert_eq!(of(r#","channel":1"#), Some(1));
    assert_eq!(of(r#","channel":"membranes""#), Some(0));
    // A number in quotes is a name.
    assert_eq!(of(r#","channel":"2""#), Some(1));
    assert_eq!(of(r#","channel":2"#), None);
    assert_eq!(of(r#","channel":"gold""#), None);
    let deleted = r#"{"record":"delete","tile":"a"}"#;
    let tile = "a".to_owned();
    assert_eq!(
        serde_json::from_str::<Record>(deleted).unwrap(),
        Record::Delete(DeleteRecord { tile })
    );
}

#[test]
fn a_half_line_waits_for_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let mut reader = RecordReader::new(folder.path(), Cursor::default());
    assert_eq!(reader.read(9).unwrap(), [], "no file yet");

    let mut writer = RecordWriter::open(folder.path()).unwrap();
    writer.append(&tile("a")).unwrap();
    let text = serde_json::to_string(&tile("b")).unwrap();
    // Every place at which a writer may be interrupted.
    for cut in 0..text.len() {
        let (head, tail) = text.split_at(cut);
        writer.file.write_all(head.as_bytes()).unwrap();
        let mut reader = RecordReader::new(folder.path(), reader.cursor());
        let before = reader.read(9).unwrap();
        writer.file.write_all(tail.as_bytes()).unwrap();
        writer.file.write_all(b"\n").unwrap();
        let mut all = records(&before);
        all.extend(records(&reader.read(usize::MAX).unwrap()));
        assert_eq!(all.len(), cut + 2, "cut at {cut}");
    }
    let all = reader.read(usize::MAX).unwrap();
    let last = all.last().unwrap();
    assert_eq!(last.next, reader.cursor());
    assert_eq!(last.next.line, text.len() as u64 + 1);
    assert_eq!(reader.remaining(), 0);
}

#[test]
fn what_editors_put_before_text_is_passed_over() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(RecordReader::FILE);
    let good = serde_json::to_string(&tile("a")).unwrap();
    let read = || {
        let mut reader = RecordReader::new(folder.path(), Cursor::default());
        reader.read(99).unwrap()
    };
    std::fs::write(&path, format!("\u{feff}{good}\n{good}\n")).unwrap();
    assert_eq!(records(&read()), [tile("a"), tile("a")]);
    let wide = format!("\u{feff}{good}\n");
    let wide: Vec<_> = wide.encode_utf16().flat_map(u16::to_be_bytes).collect();
    std::fs::write(&path, wide).unwrap();
    let broken = read().remove(0).record.unwrap_err();
    assert!(broken.reason.contains("UTF-16"), "{broken}");
    // Not all of a text that is no number.
    let long = "x".repeat(MAX_LINE / 2);
    let text = good.replace("\"section\":3", &format!("\"section\":\"{long}\""));
    std::fs::write(&path, format!("{text}\n")).unwrap();
    let broken = read().remove(0).record.unwrap_err();
    assert!(broken.reason.len() < 1000, "{}", broken.reason.len());
}

#[test]
fn a_broken_line_is_named_and_passed() {
    let folder = tempfile::tempdir().unwrap();
    let good = serde_json::to_string(&tile("a")).unwrap();
    let singular = good.replace("[1.0,0.0,0.0,1.0,", "[0,0,0,0,");
    let long = "x".repeat(3 * MAX_LINE);
    let text =
        format!("{good}\n\nnonsense\r\n{singular}\n{{\"record\":\"song\"}}\n{long}\n{good}\r\n");
    std::fs::write(folder.path().join(RecordReader::FILE), text).unwrap();
    let lines = RecordReader::new(folder.path(), Cursor::default())
        .read(99)
        .unwrap();
    let said: Vec<_> = lines
        .iter()
        .map(|l| l.record.as_ref().map_err(|b| b.line).err())
        .collect();
    assert_eq!(said, [None, Some(3), Some(4), Some(5), Some(6), None]);
    // What can be told of what it is about, is.
    let about = |n: usize| {
        let broken = lines[n].record.as_ref().unwrap_err();
        (broken.file.as_deref(), broken.tile.as_deref())
    };
    assert_eq!(about(1), (None, None));
    assert_eq!(about(2), (Some("tiles/a.tif"), Some("a")));
    assert_eq!(about(3), (None, None));
    let reason = |n: usize| lines[n].record.as_ref().unwrap_err().reason.clone();
    assert!(reason(2).contains("inverted"), "{}", reason(2));
    assert!(reason(4).contains("bytes"), "{}", reason(4));
}

#[test]
fn a_key_that_is_almost_one_that_counts_sets_its_record_aside() {
    let read = |text: &str| {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(RecordReader::FILE), format!("{text}\n")).unwrap();
        let mut reader = RecordReader::new(folder.path(), Cursor::default());
        reader.read(9).unwrap().remove(0).record
    };
    let good = serde_json::to_string(&tile("a")).unwrap();
    let with = |more: &str| format!("{},{more}}}", good.strip_suffix('}').unwrap());
    for key in ["chanel", "Channel", "channels", "chan_nel", "chnanel"] {
        let broken = read(&with(&format!(r#""{key}":"BSE""#))).unwrap_err();
        assert_eq!((broken.line, broken.tile.as_deref()), (1, Some("a")));
        let told = broken.to_string();
        for part in [&format!("{key:?}"), "is \"channel\" meant?"] {
            assert!(told.contains(part), "{part:?} is not in: {told}");
        }
    }
    // What the microscope says besides is its own, also beside what it is like.
    for own in [
        r#""kV":1.5,"files":2,"sizes":[],"tiles":1,"stage":{"chanel":1},"panel":"chanel""#,
        r#""transforms":[],"sections":4,"records":1"#,
    ] {
        assert_eq!(read(&with(own)), Ok(tile("a")), "{own}");
    }
    let both = read(&with(r#""channel":"BSE","chanel":1"#)).unwrap();
    let Record::Tile(both) = both else {
        panic!("not a tile")
    };
    assert_eq!(both.channel, Some(ChannelRef::Name("BSE".to_owned())));
    let moved = r#"{"record":"transform","tile":"a","transform":[1,0,0,1,2,3],"chanel":1}"#;
    assert!(read(moved).is_ok(), "it has no channel");
    // One that is needed is missed anyway.
    let broken = read(&good.replace("section", "secton")).unwrap_err();
    for part in ["missing field `section`", "is \"section\" meant?"] {
        assert!(broken.reason.contains(part), "{}", broken.reason);
    }
}

#[test]
fn reading_in_pieces_equals_reading_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = RecordWriter::open(folder.path()).unwrap();
    for n in 0..20 {
        writer.append(&tile(&n.to_string())).unwrap();
    }
    let all = RecordReader::new(folder.path(), Cursor::default())
        .read(99)
        .unwrap();
    let mut pieces = Vec::new();
    let mut cursor = Cursor::default();
    while let Some(line) = RecordReader::new(folder.path(), cursor)
        .read(1)
        .unwrap()
        .pop()
    {
        cursor = line.next;
        pieces.push(line);
    }
    assert_eq!(pieces, all);
    assert_eq!(all.len(), 20);
}

#[test]
fn a_writer_that_died_spoils_only_its_line() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join(RecordReader::FILE), r#"{"record":"ti"#).unwrap();
    RecordWriter::open(folder.path())
        .unwrap()
        .append(&tile("b"))
        .unwrap();
    let lines = RecordReader::new(folder.path(), Cursor::default())
        .read(99)
        .unwrap();
    assert!(lines[0].record.is_err());
    assert_eq!(lines[1].record, Ok(tile("b")));
}

#[test]
fn cut_records_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    RecordWriter::open(folder.path())
        .unwrap()
        .append(&tile("b"))
        .unwrap();
    let mut reader = RecordReader::new(
        folder.path(),
        Cursor {
            offset: 9999,
            line: 7,
            seen: None,
        },
    );
    assert!(matches!(
        reader.read(1),
        Err(AcquisitionError::RecordsCut { read: 9999, .. })
    ));
}

#[test]
fn records_that_were_cut_are_told_from_others() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(RecordReader::FILE);
    let text = lines(300, |_| false);
    std::fs::write(&path, &text).unwrap();
    let mut reader = RecordReader::new(folder.path(), Cursor::default());
    reader.read(usize::MAX).unwrap();
    let other = lines(300, |n| n == 0);
    for len in [0, 1, HEAD - 1, HEAD, HEAD + 1, text.len() - 1] {
        std::fs::write(&path, &text[..len]).unwrap();
        let cut = reader.read(1).unwrap_err();
        assert!(
            matches!(cut, AcquisitionError::RecordsCut { .. }),
            "{len}: {cut}"
        );
        std::fs::write(&path, &other[..len]).unwrap();
        let refused = reader.read(1).unwrap_err();
        let known = matches!(refused, AcquisitionError::RecordsReplaced { line: 300, .. });
        assert_eq!(known, len >= HEAD, "{len}: {refused}");
    }
    std::fs::write(&path, &text).unwrap();
    assert_eq!(reader.read(1).unwrap(), []);
}

/// Of `count` lines, all as long as each other; `other` says which tiles are another acquisition's.
fn lines(count: usize, other: impl Fn(usize) -> bool) -> String {
    let line = |n| {
        let name = if other(n) { 'b' } else { 'a' };
        serde_json::to_string(&tile(&format!("{name}{n:05}"))).unwrap() + "\n"
    };
    (0..count).map(line).collect()
}

#[test]
fn other_records_in_the_same_place_are_known() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(RecordReader::FILE);
    for read in [1, 2, 5, 40, 300] {
        std::fs::write(&path, lines(read, |_| false)).unwrap();
        let mut reader = RecordReader::new(folder.path(), Cursor::default());
        assert_eq!(reader.read(usize::MAX).unwrap().len(), read);
        let cursor = reader.cursor();
        let mut later = RecordReader::new(folder.path(), cursor);
        assert_eq!(later.recognize().unwrap(), cursor);
        // As long, and longer; from the first line on, and only from the last one on.
        for (count, from) in [
            (read, 0),
            (read, read - 1),
            (read + 9, 0),
            (read + 9, read - 1),
        ] {
            std::fs::write(&path, lines(count, |n| n >= from)).unwrap();
            for refused in [
                later.read(1).map(drop),
                later.recognize().map(drop),
                reader.read(1).map(drop),
            ] {
                let replaced = matches!(
                    refused,
                    Err(AcquisitionError::RecordsReplaced { line, .. }) if line == read as u64
                );
                assert!(
                    replaced,
                    "{read} read, {count} lines, others from {from}: {refused:?}"
                );
            }
            assert_eq!(later.cursor(), cursor, "nothing was read");
        }
        // The same, and more of them.
        std::fs::write(&path, lines(read + 3, |_| false)).unwrap();
        assert_eq!(later.read(9).unwrap().len(), 3);
    }
}

#[test]
fn a_cursor_of_an_earlier_version_learns_what_was_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(RecordReader::FILE);
    let nothing = RecordReader::new(folder.path(), Cursor::default()).recognize();
    assert_eq!(nothing.unwrap(), Cursor::default(), "no file yet");
    std::fs::write(&path, lines(60, |_| false)).unwrap();
    let mut reader = RecordReader::new(folder.path(), Cursor::default());
    assert_eq!(reader.recognize().unwrap(), Cursor::default());
    let read = reader.read(50).unwrap();
    let old = Cursor {
        seen: None,
        ..reader.cursor()
    };
    let learned = RecordReader::new(folder.path(), old).recognize().unwrap();
    assert_eq!(learned, reader.cursor());
    // It is of the place, not of who read how much at once.
    let mut again = RecordReader::new(folder.path(), read[20].next);
    assert_eq!(again.read(29).unwrap().last().unwrap().next, learned);
}
