//! Whether a file is whole, before anything is decoded: only that tells "wait" from "broken".

use super::ImageError;

/// What a file's first bytes say it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Tiff,
    Png,
    Jpeg,
}

pub(super) const PNG_SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";

pub(super) fn incomplete(reason: impl Into<String>) -> ImageError {
    ImageError::Incomplete {
        reason: reason.into(),
    }
}

pub(super) fn broken(reason: impl ToString) -> ImageError {
    ImageError::Broken {
        reason: reason.to_string(),
    }
}

/// Bytes of a file's beginning that are enough to tell.
pub(super) const HEAD: u64 = 16;

/// The kind of a file.
pub(super) fn kind(bytes: &[u8]) -> Result<Kind, ImageError> {
    let known: [(&[u8], Kind); 6] = [
        (b"II\x2a\0", Kind::Tiff),
        (b"MM\0\x2a", Kind::Tiff),
        (b"II\x2b\0", Kind::Tiff),
        (b"MM\0\x2b", Kind::Tiff),
        (&PNG_SIGNATURE, Kind::Png),
        (b"\xff\xd8\xff", Kind::Jpeg),
    ];
    let begin = &bytes[..bytes.len().min(8)];
    if let Some((_, kind)) = known.iter().find(|(magic, _)| begin.starts_with(magic)) {
        return Ok(*kind);
    }
    // A file system shows zeros for space that was set aside but not yet written.
    let written = begin.len() - begin.iter().rev().take_while(|&&b| b == 0).count();
    if known
        .iter()
        .any(|(magic, _)| magic.starts_with(&begin[..written]))
    {
        return Err(incomplete("its beginning has not been written"));
    }
    Err(ImageError::Unsupported {
        what: other_kind(bytes).to_owned(),
    })
}

/// What a file is that is no image of ours. None of its bytes are told: messages go to whoever may look at the
/// volume, and the file may be one that was never meant for them.
fn other_kind(bytes: &[u8]) -> &'static str {
    let known: [(&[u8], &str); 12] = [
        (b"GIF8", "a GIF"),
        (b"BM", "a BMP"),
        (b"RIFF", "a WebP, or sound or film"),
        (b"\0\0\0\x0cjP  ", "a JPEG 2000"),
        (b"\x89HDF", "an HDF5 file"),
        (b"SIMPLE  ", "a FITS file"),
        (b"PK\x03\x04", "a ZIP archive"),
        (b"\x1f\x8b", "a file packed with gzip"),
        (
            b"\xd0\xcf\x11\xe0",
            "a microscope's or an office's compound file",
        ),
        (b"ZISRAW", "a CZI"),
        (b"%PDF", "a PDF"),
        (b"8BPS", "a Photoshop file"),
    ];
    if let Some((_, kind)) = known.iter().find(|(magic, _)| bytes.starts_with(magic)) {
        return kind;
    }
    let begin = &bytes[..bytes.len().min(16)];
    if begin
        .iter()
        .all(|&b| b.is_ascii_graphic() || b.is_ascii_whitespace())
    {
        "text"
    } else {
        "of no format that is known here"
    }
}

/// Checks that a PNG file's chunks go on to its last.
pub(super) fn check_png(bytes: &[u8]) -> Result<(), ImageError> {
    let mut rest = &bytes[PNG_SIGNATURE.len()..];
    loop {
        let Some((head, after)) = rest.split_first_chunk::<8>() else {
            return Err(incomplete("it ends before its last chunk"));
        };
        let &[a, b, c, d, ref name @ ..] = head;
        if head == &[0; 8] {
            return Err(incomplete("a part of it has not been written"));
        }
        if !name.iter().all(u8::is_ascii_alphabetic) || a > 0x7f {
            return Err(broken("a chunk has no name"));
        }
        let len = u64::from(u32::from_be_bytes([a, b, c, d])) + 4;
        let len = usize::try_from(len).unwrap_or(usize::MAX);
        let Some(next) = after.get(len..) else {
            return Err(incomplete("it ends within a chunk"));
        };
        if name == b"IEND" {
            return Ok(());
        }
        rest = next;
    }
}

/// Checks that a JPEG file's segments go on to its end marker; the bits of a sample.
pub(super) fn check_jpeg(bytes: &[u8]) -> Result<u32, ImageError> {
    let ends = || incomplete("it ends before its end marker");
    let mut bits = None;
    let mut at = 2;
    loop {
        // Between segments, and within entropy-coded data: on to the next marker.
        let found = bytes.get(at..).and_then(|rest| {
            rest.windows(2)
                .position(|w| w[0] == 0xff && !matches!(w[1], 0x00 | 0xff | 0xd0..=0xd7))
        });
        at += found.ok_or_else(ends)? + 2;
        match bytes[at - 1] {
            0xd9 => return bits.ok_or_else(|| broken("it has no frame")),
            0x01 | 0xd8 => {}
            marker => {
                // A frame's header begins with the bits of its samples; these three begin no frame.
                if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
                    bits = bytes.get(at + 2).copied().map(u32::from);
                }
                let Some(len) = bytes.get(at..).and_then(|rest| rest.first_chunk::<2>()) else {
                    return Err(ends());
                };
                let len = usize::from(u16::from_be_bytes(*len));
                if len < 2 {
                    return Err(broken("a segment has no length"));
                }
                at += len;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_told_by_their_first_bytes() {
        for (bytes, want) in [
            (&b"II\x2a\0rest"[..], Some(Kind::Tiff)),
            (b"MM\0\x2arest", Some(Kind::Tiff)),
            (b"II\x2b\0\x08\0\0\0", Some(Kind::Tiff)),
            (b"\x89PNG\r\n\x1a\nrest", Some(Kind::Png)),
            (b"\xff\xd8\xff\xe0", Some(Kind::Jpeg)),
            (b"GIF89a..", None),
            (b"II\0\0....", None),
        ] {
            assert_eq!(kind(bytes).ok(), want, "{bytes:?}");
        }
        for unwritten in [
            &b""[..],
            b"I",
            b"II",
            b"II\x2a",
            b"\x89PNG",
            b"\xff",
            b"\0\0\0\0\0\0\0\0",
        ] {
            let kind = kind(unwritten);
            assert!(
                matches!(kind, Err(ImageError::Incomplete { .. })),
                "{unwritten:?}: {kind:?}"
            );
        }
        assert!(matches!(
            kind(b"GIF89a"),
            Err(ImageError::Unsupported { .. })
        ));
        // Messages tell what it seems to be, and nothing that is in it.
        for (bytes, what) in [
            (&b"GIF89a"[..], "a GIF"),
            (b"root:x:0:0:root", "text"),
            (b"\x7fELF\x02\x01\x01\0", "no format that is known"),
        ] {
            let told = kind(bytes).unwrap_err().to_string();
            assert!(told.contains(what), "{told}");
            let inside = [
                String::from_utf8_lossy(&bytes[..4]).into_owned(),
                format!("{:02x?}", &bytes[..2]),
            ];
            assert!(
                what == "a GIF" || !inside.iter().any(|inside| told.contains(inside)),
                "{told}"
            );
        }
    }
}
