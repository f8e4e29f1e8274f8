//! Strong entity tags and the conditions that clients put on them.

use axum::http::header::{CONTENT_ENCODING, ETAG, IF_MATCH, IF_NONE_MATCH};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};

/// What the tag of a compressed answer ends with: the same state, other bytes.
const COMPRESSED: &str = "-gzip";

/// Names the state of a resource: equal tags, equal bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Tag(String);

impl Tag {
    /// From text without quotes: letters, digits, dashes.
    pub(crate) fn new(state: &str) -> Self {
        debug_assert!(
            state
                .bytes()
                .all(|b| b.is_ascii_alphanumeric() || b == b'-')
        );
        Self(state.to_owned())
    }

    pub(crate) fn header(&self) -> HeaderValue {
        quoted(&self.0)
    }

    /// The answer to conditions that make a body needless: 304 or 412.
    pub(crate) fn precondition(&self, headers: &HeaderMap) -> Option<Response> {
        // Weak tags are of what is as good, which is not enough to go on with.
        let strong = |item: &str| !item.starts_with("W/");
        if headers.contains_key(IF_MATCH) && self.named_in(headers, IF_MATCH, strong).is_none() {
            return Some(StatusCode::PRECONDITION_FAILED.into_response());
        }
        // The client's own spelling goes back: it says which encoding it holds.
        let held = self.named_in(headers, IF_NONE_MATCH, |_| true)?;
        let tag = if held == "*" {
            self.header()
        } else {
            quoted(held)
        };
        Some((StatusCode::NOT_MODIFIED, [(ETAG, tag)]).into_response())
    }

    /// Whether a header value, as in `If-Range`, names this state without encoding.
    pub(crate) fn is(&self, value: &HeaderValue) -> bool {
        *value == self.header()
    }

    /// The item of a list header, of those that count, that names this state, without quotes, or `*`.
    fn named_in<'h>(
        &self,
        headers: &'h HeaderMap,
        header: HeaderName,
        counts: impl Fn(&str) -> bool,
    ) -> Option<&'h str> {
        let lines = headers
            .get_all(header)
            .iter()
            .filter_map(|line| line.to_str().ok());
        let items = lines.flat_map(|line| line.split(',')).map(str::trim);
        let items = items.filter(|item| counts(item));
        let opaque = items.map(|item| item.strip_prefix("W/").unwrap_or(item).trim_matches('"'));
        opaque
            .into_iter()
            .find(|item| *item == "*" || item.strip_suffix(COMPRESSED).unwrap_or(item) == self.0)
    }
}

fn quoted(state: &str) -> HeaderValue {
    HeaderValue::from_str(&format!("\"{state}\"")).unwrap_or(HeaderValue::from_static("\"\""))
}

/// Marks the tags of answers that were compressed on their way out.
pub(crate) async fn mark_encoding(mut response: Response) -> Response {
    let headers = response.headers_mut();
    if headers.contains_key(CONTENT_ENCODING)
        && let Some(tag) = headers.get(ETAG).and_then(|tag| tag.to_str().ok())
    {
        let marked = quoted(&format!("{}{COMPRESSED}", tag.trim_matches('"')));
        headers.insert(ETAG, marked);
    }
    response
}

/// Conditions on a state: values of `If-Match` and of `If-None-Match`, two lines.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    let mut lines = bytes.splitn(2, |b| *b == b'\n');
    let mut value = || HeaderValue::from_bytes(lines.next()?).ok();
    let (wanted, held) = (value(), value());
    let tag = Tag::new("0123-4");
    let of = |value: &HeaderValue, part: &str| value.to_str().is_ok_and(|text| text.contains(part));
    let names = |value: &HeaderValue| of(value, "0123-4") || of(value, "*");
    let mut headers = HeaderMap::new();
    if let Some(held) = &held {
        headers.insert(IF_NONE_MATCH, held.clone());
        match tag.precondition(&headers) {
            Some(answer) => {
                assert_eq!(answer.status(), StatusCode::NOT_MODIFIED);
                assert!(names(held), "{held:?}");
                let said = &answer.headers()[ETAG];
                assert!(
                    *said == tag.header() || *said == quoted("0123-4-gzip"),
                    "{said:?}"
                );
            }
            None => assert!(*held != tag.header() && *held != quoted("0123-4-gzip") && held != "*"),
        }
    }
    if let Some(wanted) = &wanted {
        headers = HeaderMap::from_iter([(IF_MATCH, wanted.clone())]);
        match tag.precondition(&headers) {
            Some(answer) => {
                assert_eq!(answer.status(), StatusCode::PRECONDITION_FAILED);
                assert!(*wanted != tag.header() && wanted != "*");
            }
            None => assert!(names(wanted), "{wanted:?}"),
        }
        assert_eq!(tag.is(wanted), *wanted == tag.header());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(header: HeaderName, value: &str) -> Option<StatusCode> {
        let headers = HeaderMap::from_iter([(header, HeaderValue::from_str(value).unwrap())]);
        Tag::new("a-7")
            .precondition(&headers)
            .map(|response| response.status())
    }

    #[test]
    fn held_states_are_not_sent_again() {
        for held in [
            "\"a-7\"",
            "\"x\", \"a-7\"",
            "W/\"a-7\"",
            "*",
            "\"a-7-gzip\"",
        ] {
            assert_eq!(
                answer(IF_NONE_MATCH, held),
                Some(StatusCode::NOT_MODIFIED),
                "{held}"
            );
        }
        for other in ["\"a-8\"", "\"a\"", "", "\"a-7-gzip-gzip\""] {
            assert_eq!(answer(IF_NONE_MATCH, other), None, "{other}");
        }
    }

    #[test]
    fn demanded_states_must_be_there() {
        assert_eq!(
            answer(IF_MATCH, "\"a-8\""),
            Some(StatusCode::PRECONDITION_FAILED)
        );
        assert_eq!(
            answer(IF_MATCH, "W/\"a-7\""),
            Some(StatusCode::PRECONDITION_FAILED)
        );
        assert_eq!(answer(IF_MATCH, "\"a-7\""), None);
        assert_eq!(answer(IF_MATCH, "W/\"a-7\", \"a-7-gzip\""), None);
        assert_eq!(answer(IF_MATCH, "*"), None);
    }
}
