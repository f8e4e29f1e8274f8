//! The body of an answer, as far as it is the part that was asked for.

use bytes::{Bytes, BytesMut};
use futures::StreamExt as _;
use reqwest::{Response, StatusCode, header};
use web_time::Instant;

use super::chain;
use crate::objects::error::Failure;
use crate::objects::{ObjectError, Part, Patience, part_of};

/// Longest object that is read in whole because its server ignores ranges \[bytes\].
const LONGEST_WHOLE: u64 = 256 << 20;

/// Reads it, and no more of it than the part.
pub(super) async fn read(
    answer: Response,
    part: &Part,
    patience: Patience,
    location: &str,
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
    // Browsers decode what is encoded, but tell its encoded length.
    let told = answer
        .content_length()
        .filter(|_| !(encoded && cfg!(target_family = "wasm")));
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
    let mut bytes = BytesMut::new();
    let mut body = answer.bytes_stream();
    #[expect(clippy::disallowed_methods, reason = "web_time's, which browsers have")]
    let begun = Instant::now();
    while let Some(more) = patience.idle(body.next()).await? {
        let more = more.map_err(|error| Failure::again(chain(&error.without_url())))?;
        bytes.extend_from_slice(&more);
        if bytes.len() as u64 > most {
            if cut_by_us {
                break;
            }
            return Err(too_long());
        }
        let seconds = begun.elapsed().saturating_sub(patience.idle).as_secs_f64();
        let least = seconds * f64::from(patience.slowest);
        if (bytes.len() as f64) < least {
            let count = bytes.len();
            return Err(Failure::again(format!(
                "no more than {count} bytes came in time"
            )));
        }
    }
    let count = bytes.len() as u64;
    let expected = must.or(told.filter(|_| !cut_by_us));
    if expected.is_some_and(|expected| expected != count) {
        let expected = expected.unwrap_or_default();
        return Err(Failure::again(format!(
            "{count} bytes came instead of {expected}"
        )));
    }
    let bytes = bytes.freeze();
    if partial {
        Ok(bytes)
    } else {
        part_of(&bytes, part, || location.to_owned()).map_err(Failure::Final)
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
    use super::parse_range;

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
