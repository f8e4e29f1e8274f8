//! What came instead of an object: a page for people, or the object compressed on its way though nobody asked for that.

use bytes::Bytes;

use super::error::Failure;
use super::{ObjectError, Part};
use crate::codecs::Codec;

/// What a page is called in messages.
const PAGE: &str = "a web page (HTML), perhaps one to log in by";
/// Bytes by which a page is known.
pub(super) const BEGINNING: usize = 256;
/// How gzip begins.
const GZIP: [u8; 3] = [0x1f, 0x8b, 8];

/// Whether a media type is that of pages.
pub(super) fn names_a_page(media: &str) -> bool {
    let media = media.split(';').next().unwrap_or_default().trim();
    media.eq_ignore_ascii_case("text/html") || media.eq_ignore_ascii_case("application/xhtml+xml")
}

/// Whether bytes are how a page begins: servers call much a page that is none.
pub(super) fn begins_a_page(bytes: &[u8]) -> bool {
    let text = bytes.strip_prefix("\u{feff}".as_bytes()).unwrap_or(bytes);
    let text = text.trim_ascii_start();
    [
        "<!doctype html",
        "<html",
        "<?xml",
        "<!--",
        "<head",
        "<script",
    ]
    .iter()
    .any(|tag| {
        let begins = text.get(..tag.len());
        begins.is_some_and(|begins| begins.eq_ignore_ascii_case(tag.as_bytes()))
    })
}

/// The error where a page came.
pub(super) fn page(location: &str) -> Failure {
    Failure::Final(ObjectError::Answer {
        answer: PAGE.to_owned(),
        location: location.to_owned(),
    })
}

/// The compression that a `Content-Encoding` names. Some stores keep other words in it, which say nothing of the bytes.
fn compression(encoding: &str) -> Option<&str> {
    const KNOWN: [&str; 8] = [
        "gzip",
        "x-gzip",
        "deflate",
        "br",
        "zstd",
        "compress",
        "x-compress",
        "dcb",
    ];
    let mut named = encoding.split(',').map(str::trim);
    named.find(|name| KNOWN.iter().any(|known| name.eq_ignore_ascii_case(known)))
}

/// The object, of bytes that came with that `Content-Encoding`. Whole ones are decompressed where they are gzip, to no more than
/// they may have.
pub(super) fn plain(
    bytes: Bytes,
    encoding: Option<&str>,
    part: &Part,
    location: &str,
) -> Result<Bytes, Failure> {
    let Some(name) = encoding.and_then(compression) else {
        return Ok(bytes);
    };
    let refused = |answer: String| {
        Failure::Final(ObjectError::Answer {
            answer,
            location: location.to_owned(),
        })
    };
    let is_gzip = name.to_ascii_lowercase().ends_with("gzip");
    match part {
        // Empty, or said to be what it is not.
        Part::Whole { .. } if is_gzip && !bytes.starts_with(&GZIP) => Ok(bytes),
        Part::Whole { most } if is_gzip => {
            let most = usize::try_from(*most).unwrap_or(usize::MAX);
            Codec::Gzip.decode(bytes, most).map_err(|damage| {
                // What is cut is seen by its length; this came so.
                refused(format!("compressed in transport, and {damage}"))
            })
        }
        Part::Whole { .. } => Err(refused(format!(
            "compressed in transport (Content-Encoding: {name}), which was not asked for; the server must send the object as it is"
        ))),
        // Of which bytes these are a part nobody can tell.
        Part::Range(_) | Part::Last(_) => Err(refused(format!(
            "a part of something compressed in transport (Content-Encoding: {name}), which was not asked for; the server must send \
             the object as it is"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    #[test]
    fn pages_are_known_by_how_they_begin() {
        for page in [
            "<!DOCTYPE html><title>Log in</title>",
            "\u{feff}\r\n  <html lang=\"en\">",
            "<!-- moved --><html>",
        ] {
            assert!(begins_a_page(page.as_bytes()), "{page}");
        }
        for other in ["", "{\"zarr_format\": 3}", "<", "\0<html", "<htm"] {
            assert!(!begins_a_page(other.as_bytes()), "{other}");
        }
        assert!(names_a_page("Text/HTML; charset=utf-8") && !names_a_page("application/json"));
    }

    fn zipped(bytes: &[u8]) -> Bytes {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap().into()
    }

    #[test]
    fn what_is_compressed_unasked_is_decoded_within_bounds_or_refused() {
        let whole = Part::Whole { most: 100 };
        let told = |bytes: &[u8], encoding: &str, part: &Part| {
            let plain = plain(Bytes::copy_from_slice(bytes), Some(encoding), part, "here");
            plain.map_err(|failure| match failure {
                Failure::Final(error) => error.to_string(),
                Failure::Again { reason, .. } => panic!("asked again: {reason}"),
            })
        };
        let good = told(&zipped(b"voxels"), "gzip", &whole);
        assert_eq!(good.as_deref(), Ok(&b"voxels"[..]));
        for (bytes, encoding) in [
            (&b"voxels"[..], "GZIP"),
            (&zipped(b"voxels"), "aws-chunked"),
            (b"", "x-gzip"),
        ] {
            assert_eq!(
                told(bytes, encoding, &whole).as_deref(),
                Ok(bytes),
                "{encoding}"
            );
        }
        let bomb = told(&zipped(&[0; 101]), "gzip", &whole).unwrap_err();
        assert!(bomb.contains("more than the 100 bytes"), "{bomb}");
        let cut = told(&zipped(b"voxels")[..12], "gzip", &whole).unwrap_err();
        assert!(cut.contains("does not decompress"), "{cut}");
        for (encoding, part) in [
            ("br", whole),
            ("aws-chunked, zstd", Part::Whole { most: 9 }),
            ("gzip", Part::Range(0..3)),
            ("deflate", Part::Last(3)),
        ] {
            let refused = told(b"abc", encoding, &part).unwrap_err();
            assert!(
                refused.contains("not asked for") && refused.ends_with("here"),
                "{refused}"
            );
        }
    }
}
