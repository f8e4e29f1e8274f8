//! Text that other programs wrote: how it is encoded, and how much of it is quoted.

use std::borrow::Cow;
use std::path::Path;

use super::AcquisitionError;

/// What some editors put before UTF-8.
const MARK: &[u8] = b"\xef\xbb\xbf";

/// Characters of a text that a message quotes.
const QUOTED: usize = 80;

/// Which half of UTF-16's units comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Order {
    Low,
    High,
}

/// Whether a text is UTF-16: by its mark or, without one, by the empty halves of its first letters.
fn utf16(bytes: &[u8]) -> Option<Order> {
    match bytes {
        [0xff, 0xfe, ..] => Some(Order::Low),
        [0xfe, 0xff, ..] => Some(Order::High),
        [a, 0, b, 0, ..] if *a != 0 && *b != 0 => Some(Order::Low),
        [0, a, 0, b, ..] if *a != 0 && *b != 0 => Some(Order::High),
        _ => None,
    }
}

/// Whether a text is UTF-16, which is not read.
pub(super) fn is_utf16(bytes: &[u8]) -> bool {
    utf16(bytes).is_some()
}

/// UTF-8 without its mark.
pub(super) fn unmarked(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(MARK).unwrap_or(bytes)
}

/// A file's content without a mark.
///
/// # Errors
///
/// [`AcquisitionError::Utf16`].
pub(super) fn content<'a>(bytes: &'a [u8], path: &Path) -> Result<&'a [u8], AcquisitionError> {
    match is_utf16(bytes) {
        true => Err(AcquisitionError::Utf16 {
            path: path.to_owned(),
        }),
        false => Ok(unmarked(bytes)),
    }
}

/// What a text says, whatever its encoding: to find out what it is meant to be.
pub fn readable(bytes: &[u8]) -> Cow<'_, str> {
    let Some(order) = utf16(bytes) else {
        return String::from_utf8_lossy(unmarked(bytes));
    };
    let unit = |pair: &[u8; 2]| match order {
        Order::Low => u16::from_le_bytes(*pair),
        Order::High => u16::from_be_bytes(*pair),
    };
    let units = bytes.as_chunks().0.iter().map(unit);
    let letters = char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER));
    letters.filter(|c| *c != '\u{feff}').collect()
}

/// A text in quotation marks, cut where nobody would read it to its end.
pub(super) fn quoted(text: &str) -> String {
    match text.char_indices().nth(QUOTED) {
        Some((end, _)) => format!("{:?}... ({} bytes)", &text[..end], text.len()),
        None => format!("{text:?}"),
    }
}

/// A reason that may quote a text whole, cut likewise.
pub(super) fn cut(reason: &str) -> String {
    const MOST: usize = 4 * QUOTED;
    match reason.char_indices().nth(MOST) {
        Some((end, _)) => format!("{}... ({} bytes)", &reason[..end], reason.len()),
        None => reason.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_meant_can_be_told_in_either_encoding() {
        let text = "dim = 2\nµ.tif; ; (0, 1)\n";
        let low = |mark: &[u8]| {
            [
                mark,
                &text
                    .encode_utf16()
                    .flat_map(u16::to_le_bytes)
                    .collect::<Vec<_>>(),
            ]
            .concat()
        };
        let high = |mark: &[u8]| {
            [
                mark,
                &text
                    .encode_utf16()
                    .flat_map(u16::to_be_bytes)
                    .collect::<Vec<_>>(),
            ]
            .concat()
        };
        let plain = |mark: &[u8]| [mark, text.as_bytes()].concat();
        for (bytes, wide) in [
            (plain(b""), false),
            (plain(MARK), false),
            (low(b"\xff\xfe"), true),
            (low(b""), true),
            (high(b"\xfe\xff"), true),
            (high(b""), true),
        ] {
            assert_eq!(readable(&bytes), text);
            assert_eq!(is_utf16(&bytes), wide);
            let content = content(&bytes, Path::new("list.txt"));
            match wide {
                true => assert!(matches!(content, Err(AcquisitionError::Utf16 { .. }))),
                false => assert_eq!(content.unwrap(), text.as_bytes()),
            }
        }
        for short in ["", "a", "ab", "\0", "\0\0\0\0"] {
            assert_eq!(readable(short.as_bytes()), short);
        }
    }

    #[test]
    fn long_texts_are_cut() {
        assert_eq!(quoted("a \"b\""), r#""a \"b\"""#);
        let long = "µ".repeat(1 << 20);
        for said in [quoted(&long), cut(&long)] {
            assert!(
                said.len() < 1000 && said.ends_with("(2097152 bytes)"),
                "{said}"
            );
        }
        assert_eq!(cut("short"), "short");
    }
}
