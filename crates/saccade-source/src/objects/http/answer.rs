//! The body of an answer, as far as it is the part that was asked for.

use std::ops::Range;

use bytes::Bytes;
use futures::StreamExt as _;
use reqwest::{Response, StatusCode, header};

use super::chain;
use super::platform::DECODES;
use crate::objects::error::Failure;
use crate::objects::retry::Pace;
use crate::objects::transport::{BEGINNING, begins_a_page, names_a_page, page, plain};
use crate::objects::{ObjectError, Part, Patience};

/// Longest object that is read in whole because its server ignores ranges \[bytes\]. Of one, no more is kept than was asked for.
const LONGEST_WHOLE: u64 = 256 << 20;
/// Bytes that are kept beyond the end of an object before they are dropped together.
const DROPPED_AT_ONCE: usize = 64 << 10;

/// Reads it, and no more of it than the part.
pub(super) async fn read(
    answer: Response,
    part: &Part,
    patience: Patience,
    location: &str,
) -> Result<Bytes, Failure> {
    let text = |name| answer.headers().get(name)?.to_str().ok().map(str::to_owned);
    let names_a_page = text(header::CONTENT_TYPE).is_some_and(|media| names_a_page(&media));
    let encoding = text(header::CONTENT_ENCODING).filter(|_| !DECODES);
    let mut beginning = Vec::new();
    let bytes = read_part(answer, part, patience, location, &mut beginning).await;
    match &bytes {
        Err(Failure::Again { .. }) => return bytes,
        // Where it was not even begun, its size alone was wrong.
        Err(Failure::Final(_)) if names_a_page && beginning.is_empty() => {
            return Err(page(location));
        }
        _ if names_a_page && begins_a_page(&beginning) => return Err(page(location)),
        _ => {}
    }
    plain(bytes?, encoding.as_deref(), part, location)
}

/// The same, whatever it is that came, and how that began, where it is known.
async fn read_part(
    answer: Response,
    part: &Part,
    patience: Patience,
    location: &str,
    beginning: &mut Vec<u8>,
) -> Result<Bytes, Failure> {
    let partial = answer.status() == StatusCode::PARTIAL_CONTENT;
    let range = content_range(&answer);
    // Bytes that may come, and those that must.
    let (most, must) = match (part, partial) {
        (Part::Whole { most }, false) => (*most, None),
        (Part::Whole { .. }, true) => return Err(Failure::again("a part was sent for the whole")),
        (Part::Range(wanted), true) => {
            // Browsers hide this header unless the server exposes it.
            if let Some((start, end, length)) = range {
                if length.is_some_and(|length| wanted.end > length) {
                    return Err(Failure::Final(ObjectError::TooShort {
                        wanted: wanted.clone(),
                        location: location.to_owned(),
                    }));
                }
                if (start, end) != (wanted.start, wanted.end) {
                    return Err(Failure::again(format!(
                        "bytes {start} to {end} were sent for {} to {}",
                        wanted.start, wanted.end
                    )));
                }
            }
            let count = wanted.end - wanted.start;
            (count, Some(count))
        }
        (Part::Last(count), true) => {
            let sent = range.map(|(start, end, _)| end - start);
            if let Some((_, end, Some(length))) = range
                && (end != length || sent.is_some_and(|sent| sent != length.min(*count)))
            {
                return Err(Failure::again("another part was sent than the end"));
            }
            (*count, sent)
        }
        (Part::Range(wanted), false) => {
            ignores_ranges(location);
            if answer
                .content_length()
                .is_some_and(|length| length < wanted.end)
            {
                return Err(Failure::Final(ObjectError::TooShort {
                    wanted: wanted.clone(),
                    location: location.to_owned(),
                }));
            }
            if wanted.end > LONGEST_WHOLE {
                return Err(Failure::Final(ObjectError::Answer {
                    answer: "all of a very long object instead of a part".to_owned(),
                    location: location.to_owned(),
                }));
            }
            (wanted.end, None)
        }
        (Part::Last(_), false) => {
            ignores_ranges(location);
            (LONGEST_WHOLE, None)
        }
    };
    let encoded = answer.headers().contains_key(header::CONTENT_ENCODING);
    let told = answer.content_length().filter(|_| !(encoded && DECODES));
    let cut_by_us = matches!(part, Part::Range(_)) && !partial;
    let too_long = || {
        Failure::Final(ObjectError::TooLong {
            most,
            location: location.to_owned(),
        })
    };
    if let (Some(told), Some(must)) = (told, must)
        && told != must
    {
        return Err(Failure::again(format!(
            "{told} bytes were announced instead of {must}"
        )));
    }
    if told.is_some_and(|told| told > most) && !cut_by_us {
        return Err(too_long());
    }
    let mut kept = Kept::new(part, partial);
    let mut body = answer.bytes_stream();
    let pace = Pace::new(patience.idle, patience.slowest);
    while let Some(more) = patience.idle(body.next()).await? {
        let more = more.map_err(|error| Failure::again(chain(&error.without_url())))?;
        if !partial && beginning.len() < BEGINNING {
            beginning.extend_from_slice(&more[..more.len().min(BEGINNING)]);
        }
        kept.add(&more);
        if cut_by_us && kept.come >= most {
            break;
        }
        if kept.come > most {
            return Err(too_long());
        }
        pace.check(kept.come)?;
    }
    let count = kept.come;
    let expected = must.or(told.filter(|_| !cut_by_us));
    if expected.is_some_and(|expected| expected != count) {
        let expected = expected.unwrap_or_default();
        return Err(Failure::again(format!(
            "{count} bytes came instead of {expected}"
        )));
    }
    kept.part().map_err(|wanted| {
        Failure::Final(ObjectError::TooShort {
            wanted,
            location: location.to_owned(),
        })
    })
}

/// Of what comes, what was asked for: where a server ignores ranges, that is a small part of it.
struct Kept {
    /// Those bytes of the object, if it is the object that comes.
    wanted: Option<Range<u64>>,
    /// So many bytes at the end, if it is the object that comes.
    last: Option<usize>,
    bytes: Vec<u8>,
    /// Bytes that have come, kept or not.
    come: u64,
}

impl Kept {
    fn new(part: &Part, partial: bool) -> Self {
        let (wanted, last) = match part {
            Part::Range(wanted) if !partial => (Some(wanted.clone()), None),
            Part::Last(count) if !partial => {
                (None, Some(usize::try_from(*count).unwrap_or(usize::MAX)))
            }
            _ => (None, None),
        };
        Self {
            wanted,
            last,
            bytes: Vec::new(),
            come: 0,
        }
    }

    fn add(&mut self, more: &[u8]) {
        let length = more.len() as u64;
        let more = match &self.wanted {
            Some(wanted) => {
                let at = |edge: u64| edge.saturating_sub(self.come).min(length);
                let at = |edge| usize::try_from(at(edge)).unwrap_or(more.len());
                &more[at(wanted.start)..at(wanted.end)]
            }
            None => more,
        };
        self.bytes.extend_from_slice(more);
        self.come += length;
        if let Some(last) = self.last {
            let needless = self.bytes.len().saturating_sub(last);
            if needless > last.max(DROPPED_AT_ONCE) {
                self.bytes.drain(..needless);
            }
        }
    }

    /// The part, or what it should have been where less came.
    fn part(mut self) -> Result<Bytes, Range<u64>> {
        if let Some(wanted) = self.wanted.filter(|wanted| wanted.end > self.come) {
            return Err(wanted);
        }
        if let Some(last) = self.last {
            let needless = self.bytes.len().saturating_sub(last);
            self.bytes.drain(..needless);
        }
        Ok(self.bytes.into())
    }
}

/// First byte, the one behind the last, and the object's length if it is told.
fn content_range(answer: &Response) -> Option<(u64, u64, Option<u64>)> {
    let text = answer.headers().get(header::CONTENT_RANGE)?.to_str().ok()?;
    parse_range(text)
}

fn parse_range(text: &str) -> Option<(u64, u64, Option<u64>)> {
    let (range, length) = text.trim().strip_prefix("bytes ")?.split_once('/')?;
    let (first, last) = range.split_once('-')?;
    let (first, last): (u64, u64) = (first.trim().parse().ok()?, last.trim().parse().ok()?);
    let end = last.checked_add(1).filter(|end| *end > first)?;
    Some((first, end, length.trim().parse().ok()))
}

fn ignores_ranges(location: &str) {
    use std::sync::atomic::{AtomicBool, Ordering};
    static TOLD: AtomicBool = AtomicBool::new(false);
    if !TOLD.swap(true, Ordering::Relaxed) {
        log::warn!(
            "the server sends whole objects where parts were asked for, which is slow: {location}"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// However much comes, and however it is cut.
    #[test]
    fn of_a_whole_object_no_more_is_kept_than_was_asked_for() {
        let object: Vec<u8> = (0..1_000_000_u32).flat_map(u32::to_le_bytes).collect();
        let length = object.len() as u64;
        let parts = [
            Part::Last(1000),
            Part::Last(1),
            Part::Range(0..1000),
            Part::Range(length / 2 + 3..length / 2 + 2003),
            Part::Range(length - 5..length),
        ];
        for (part, piece) in parts.iter().flat_map(|part| [(part, 7000), (part, 999)]) {
            let mut kept = Kept::new(part, false);
            let mut most = 0;
            for more in object.chunks(piece) {
                kept.add(more);
                most = most.max(kept.bytes.capacity());
            }
            assert!(most < 300_000, "{part:?}: {most} bytes were held");
            let bounds = match part {
                Part::Range(range) => range.clone(),
                Part::Last(count) => length - count..length,
                Part::Whole { .. } => 0..length,
            };
            let at = |edge: u64| usize::try_from(edge).unwrap();
            let got = kept.part().unwrap();
            assert!(
                got == object[at(bounds.start)..at(bounds.end)],
                "{part:?} in pieces of {piece}"
            );
        }
        // What is a part by itself, or wanted as a whole, is kept as it comes.
        for (part, partial) in [
            (Part::Whole { most: length }, false),
            (Part::Range(4..9), true),
            (Part::Last(9), true),
        ] {
            let mut kept = Kept::new(&part, partial);
            kept.add(&object);
            assert!(kept.part().unwrap() == object, "{part:?}");
        }
        for (part, short) in [(Part::Range(2..8), true), (Part::Last(8), false)] {
            let mut kept = Kept::new(&part, false);
            kept.add(&object[..7]);
            assert_eq!(kept.part().is_err(), short, "{part:?}");
        }
    }

    #[test]
    fn ranges_are_read_or_nothing() {
        assert_eq!(parse_range("bytes 2-5/10"), Some((2, 6, Some(10))));
        assert_eq!(parse_range("bytes 2-5/*"), Some((2, 6, None)));
        for bad in [
            "",
            "bytes */10",
            "bytes 5-2/10",
            "2-5/10",
            "bytes 0-18446744073709551615/1",
        ] {
            assert_eq!(parse_range(bad), None, "{bad}");
        }
    }
}
