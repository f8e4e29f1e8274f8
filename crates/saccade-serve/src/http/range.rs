//! Single byte ranges.

use std::ops::Range;

use axum::http::HeaderMap;
use axum::http::header::{IF_RANGE, RANGE};

use super::Tag;

/// What part of a body a request wants.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Requested {
    /// All of it: no range, one in other units, several, or one that holds for another state.
    Whole,
    /// These bytes, at least one.
    Part(Range<usize>),
    /// Bytes that do not exist.
    Outside,
}

/// What part of a body of `len` bytes in the state `tag` is wanted.
pub(crate) fn requested(headers: &HeaderMap, len: usize, tag: Option<&Tag>) -> Requested {
    let range = headers.get(RANGE).and_then(|range| range.to_str().ok());
    let Some(range) = range.and_then(|range| range.strip_prefix("bytes=")) else {
        return Requested::Whole;
    };
    let holds = |state| tag.is_some_and(|tag| tag.is(state));
    if headers.get(IF_RANGE).is_some_and(|state| !holds(state)) {
        return Requested::Whole;
    }
    let Some((first, last)) = range.trim().split_once('-') else {
        return Requested::Whole;
    };
    let bytes = match (first.parse::<usize>(), last.parse::<usize>()) {
        (Ok(first), Ok(last)) if first <= last => first..last.saturating_add(1).min(len),
        (Ok(first), Err(_)) if last.is_empty() => first..len,
        (Err(_), Ok(count)) if first.is_empty() => len.saturating_sub(count)..len,
        _ => return Requested::Whole,
    };
    if bytes.is_empty() {
        Requested::Outside
    } else {
        Requested::Part(bytes)
    }
}

/// A range of a body, and the state for which it holds: two lines.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    use axum::http::HeaderValue;

    let mut lines = bytes.splitn(2, |b| *b == b'\n');
    let mut value = || HeaderValue::from_bytes(lines.next()?).ok();
    let (Some(range), state) = (value(), value()) else {
        return;
    };
    let tag = Tag::new("0123-4");
    for len in [0, 1, 10, usize::MAX] {
        let mut headers = HeaderMap::new();
        headers.insert(RANGE, range.clone());
        let plain = requested(&headers, len, Some(&tag));
        if let Requested::Part(part) = &plain {
            assert!(
                part.start < part.end && part.end <= len,
                "{part:?} of {len}"
            );
            // Said in its own words, it is the same.
            let said = format!("bytes={}-{}", part.start, part.end - 1);
            headers.insert(RANGE, HeaderValue::from_str(&said).expect("digits"));
            assert_eq!(requested(&headers, len, Some(&tag)), plain);
            headers.insert(RANGE, range.clone());
        }
        if let Some(state) = &state {
            headers.insert(IF_RANGE, state.clone());
            let conditional = requested(&headers, len, Some(&tag));
            let is_so = *state == tag.header();
            assert_eq!(conditional, if is_so { plain } else { Requested::Whole });
            assert_eq!(requested(&headers, len, None), Requested::Whole);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn of(range: &'static str) -> Requested {
        let headers = HeaderMap::from_iter([(RANGE, HeaderValue::from_static(range))]);
        requested(&headers, 10, None)
    }

    #[test]
    fn ranges_are_read_as_the_standard_says() {
        assert_eq!(of("bytes=0-3"), Requested::Part(0..4));
        assert_eq!(of("bytes=8-99"), Requested::Part(8..10));
        assert_eq!(of("bytes=8-"), Requested::Part(8..10));
        assert_eq!(of("bytes=-3"), Requested::Part(7..10));
        assert_eq!(of("bytes=-99"), Requested::Part(0..10));
        for outside in ["bytes=10-", "bytes=10-12", "bytes=-0"] {
            assert_eq!(of(outside), Requested::Outside, "{outside}");
        }
        for whole in [
            "bytes=3-1",
            "bytes=0-1,4-5",
            "lines=0-1",
            "bytes=a-b",
            "bytes=-",
            "bytes=",
        ] {
            assert_eq!(of(whole), Requested::Whole, "{whole}");
        }
    }

    #[test]
    fn a_range_of_another_state_is_ignored() {
        let with = |state: &'static str| {
            let range = (RANGE, HeaderValue::from_static("bytes=0-0"));
            HeaderMap::from_iter([range, (IF_RANGE, HeaderValue::from_static(state))])
        };
        let tag = Tag::new("now");
        assert_eq!(
            requested(&with("\"now\""), 10, Some(&tag)),
            Requested::Part(0..1)
        );
        assert_eq!(
            requested(&with("\"then\""), 10, Some(&tag)),
            Requested::Whole
        );
        assert_eq!(requested(&with("\"now\""), 10, None), Requested::Whole);
    }
}
