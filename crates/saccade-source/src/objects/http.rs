//! Objects below an address, by HTTP: the same code natively and in browsers.

mod answer;
#[cfg(not(target_family = "wasm"))]
#[path = "http/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "http/wasm.rs"]
mod platform;
#[cfg(all(test, not(target_family = "wasm")))]
mod tests;

use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use reqwest::header::HeaderMap;
use reqwest::{Client, StatusCode, Url, header};
use tokio::sync::Semaphore;

use super::error::Failure;
use super::refusals::{EXPIRED, Found, Refusal, Refusals};
use super::same::{Marks, strong};
use super::{LocationError, ObjectError, Objects, Part, Patience, is_key};
use crate::maybe_send::BoxFuture;

/// Requests under way at once; more wait here, first come, first served.
const REQUESTS: usize = 24;

const ADVICE: &str = "the server wants credentials, or does not allow this object to be read";

/// Objects below an address.
///
/// # Answers
///
/// 404 and 410 (gone) both mean that there is no such object. 403 is taken to mean so as well where the store answers so for
/// whatever it does not have, as S3 does to those who may not list: with a 403 it is asked for an object that nobody can
/// have, and for the newest one that was read before, so that a login that ran out is not taken for a hole. It is an error once the store
/// has answered 404 or 410 for anything, for an object that could be read before, and wherever nobody guesses
/// ([`Objects::stop_guessing`]). 401 is always an error.
/// 429, 5xx, broken connections, cut and stalled answers are asked for again, see [`Patience`]. A server that ignores
/// ranges is put up with, and told of.
///
/// Parts of an object belong together: where the server tags what it sends (`ETag`) and a part has another tag than the one before,
/// the object was replaced in between, which is told once ([`Objects::replacements`]). Browsers show tags only where the server exposes them.
///
/// Natively, redirections to other hosts are not followed: whoever runs a store cannot make this computer ask others.
///
/// # In browsers
///
/// A page reads from another host only what that host lets it (CORS); what it does not let through looks like no
/// answer at all. The error tells the two apart, and says which headers the server should send. An object's
/// end is asked for by its length, since browsers ask for permission before they ask for "the last bytes".
#[derive(Debug)]
pub struct HttpObjects {
    client: Client,
    base: Url,
    patience: Patience,
    /// Whether the ends of objects can be asked for without knowing their lengths.
    suffixes: bool,
    /// Whether any answer could be read so far.
    heard: AtomicBool,
    /// Tags of objects that were read in parts.
    tags: Marks<String>,
    /// Times and lengths, of those without a tag.
    times: Marks<String>,
    requests: Semaphore,
    refusals: Refusals,
}

impl HttpObjects {
    /// Those below `base`. Its query, if it has one, goes with every request. Sends nothing yet.
    ///
    /// # Errors
    ///
    /// [`LocationError`] if that is no address of HTTP.
    pub fn new(base: &str) -> Result<Self, LocationError> {
        Self::with_patience(base, Patience::default())
    }

    /// Like [`Self::new`], with other patience.
    ///
    /// # Errors
    ///
    /// As [`Self::new`].
    pub fn with_patience(base: &str, patience: Patience) -> Result<Self, LocationError> {
        let wrong = || LocationError::new(base, "it is no address such as https://host/image.zarr");
        let mut url = Url::parse(base).map_err(|_| wrong())?;
        if !matches!(url.scheme(), "http" | "https") || !url.has_host() {
            return Err(wrong());
        }
        url.set_fragment(None);
        Ok(Self {
            client: platform::client(),
            base: url,
            patience,
            suffixes: platform::SUFFIXES,
            heard: AtomicBool::new(false),
            tags: Marks::default(),
            times: Marks::default(),
            requests: Semaphore::new(REQUESTS),
            refusals: Refusals::default(),
        })
    }

    fn url(&self, key: &str) -> Url {
        let mut url = self.base.clone();
        if let Ok(mut path) = url.path_segments_mut() {
            path.pop_if_empty().extend(key.split('/'));
        }
        url
    }

    async fn part(&self, key: &str, part: Part) -> Result<Option<Bytes>, ObjectError> {
        if !is_key(key) {
            return Err(ObjectError::Key {
                key: key.to_owned(),
                location: shown(&self.base),
            });
        }
        if let Part::Range(range) = &part
            && range.is_empty()
        {
            return Ok(Some(Bytes::new()));
        }
        let url = self.url(key);
        let part = match part {
            Part::Last(count) if !self.suffixes => match self.length(key, &url).await? {
                Some(Some(0)) => return Ok(Some(Bytes::new())),
                Some(Some(length)) => Part::Range(length.saturating_sub(count)..length),
                Some(None) => part,
                None => return Ok(None),
            },
            part => part,
        };
        let found = self.ask(key, &part).await?;
        let other = |key: String| -> BoxFuture<'_, _> {
            Box::pin(async move { self.ask(&key, &Part::Range(0..1)).await })
        };
        let location = shown(&url);
        let settled = self.refusals.settle(key, found, &location, other);
        let advice = match settled.await? {
            Ok(bytes) => return Ok(Some(bytes)),
            Err(Refusal::Missing) => return Ok(None),
            Err(Refusal::Denied) => ADVICE,
            Err(Refusal::Unclear) => return Err(ObjectError::Unclear { location }),
            Err(Refusal::Expired) => EXPIRED,
        };
        Err(ObjectError::Denied { advice, location })
    }

    async fn ask(&self, key: &str, part: &Part) -> Result<Found, ObjectError> {
        let url = self.url(key);
        self.patience
            .attempts(self, key, || self.attempt(key, &url, part))
            .await
    }

    /// The length of an object, if its server tells; `None` if there is no such object.
    async fn length(&self, key: &str, url: &Url) -> Result<Option<Option<u64>>, ObjectError> {
        let ask = || async {
            let _permit = self.requests.acquire().await.ok();
            let answer = self.send(self.client.head(url.clone()), url).await?;
            Ok(match answer.status() {
                StatusCode::OK => {
                    let encoded = answer.headers().contains_key(header::CONTENT_ENCODING);
                    let length = answer.headers().get(header::CONTENT_LENGTH);
                    let length = length.and_then(|length| length.to_str().ok()?.parse().ok());
                    Some(length.filter(|_| !encoded))
                }
                StatusCode::NOT_FOUND | StatusCode::GONE => None,
                status if is_passing(status) => return Err(again(&answer)),
                // Not every server knows this question.
                _ => Some(None),
            })
        };
        self.patience.attempts(self, key, ask).await
    }

    async fn send(
        &self,
        request: reqwest::RequestBuilder,
        url: &Url,
    ) -> Result<reqwest::Response, Failure> {
        let heard = &self.heard;
        match self.patience.idle(request.send()).await? {
            Ok(answer) => {
                heard.store(true, Ordering::Relaxed);
                Ok(answer)
            }
            Err(error) => {
                let shown = shown(url);
                let why = platform::unanswered(error, &shown, heard.load(Ordering::Relaxed));
                // A browser finds that out by another request.
                Err(self.patience.idle(why).await.unwrap_or_else(|late| late))
            }
        }
    }

    /// Whether a part is of the same object as the parts before, as far as tags tell; without any, as far as its time
    /// and length do.
    fn is_the_same(&self, key: &str, part: &Part, of: &HeaderMap) -> Result<(), Failure> {
        let text = |name| of.get(name).and_then(|value| value.to_str().ok());
        let location = || self.location(key);
        let checked = match text(header::ETAG).and_then(strong) {
            Some(tag) => self.tags.check(key, part, Some(tag), location),
            None => {
                let length = text(header::CONTENT_RANGE).and_then(|range| range.rsplit('/').next());
                let told = [text(header::LAST_MODIFIED), length].map(Option::unwrap_or_default);
                let mark = (told != ["", ""]).then(|| told.join(" "));
                self.times.check(key, part, mark, location)
            }
        };
        checked.map_err(Failure::Final)
    }

    async fn attempt(&self, key: &str, url: &Url, part: &Part) -> Result<Found, Failure> {
        // The semaphore is never closed.
        let _permit = self.requests.acquire().await.ok();
        let mut request = platform::unencoded(self.client.get(url.clone()));
        match part {
            Part::Whole { .. } => {}
            Part::Range(range) => {
                let last = range.end - 1;
                request = request.header(header::RANGE, format!("bytes={}-{last}", range.start));
            }
            Part::Last(count) => {
                request = request.header(header::RANGE, format!("bytes=-{count}"));
            }
        }
        let answer = self.send(request, url).await?;
        let status = answer.status();
        match status {
            StatusCode::OK | StatusCode::PARTIAL_CONTENT => {
                let headers = answer.headers().clone();
                let bytes = answer::read(answer, part, self.patience, &shown(url)).await?;
                // What marks an answer that cannot be used marks nothing.
                self.is_the_same(key, part, &headers)?;
                Ok(Found::Object(bytes))
            }
            StatusCode::NOT_FOUND | StatusCode::GONE => Ok(Found::Nothing),
            StatusCode::FORBIDDEN => Ok(Found::Forbidden),
            StatusCode::UNAUTHORIZED => Ok(Found::Unknown),
            StatusCode::RANGE_NOT_SATISFIABLE => match part {
                Part::Range(range) => Err(Failure::Final(ObjectError::TooShort {
                    wanted: range.clone(),
                    location: shown(url),
                })),
                // The end of an empty object.
                _ => Ok(Found::Object(Bytes::new())),
            },
            _ if is_passing(status) => Err(again(&answer)),
            _ if status.is_redirection() => {
                let to = answer.headers().get(header::LOCATION);
                let to = to.and_then(|to| to.to_str().ok()).unwrap_or("nowhere");
                Err(Failure::Final(ObjectError::Answer {
                    answer: format!(
                        "{status} to {to}, which is not followed; give that address if you trust it"
                    ),
                    location: shown(url),
                }))
            }
            _ => Err(Failure::Final(ObjectError::Answer {
                answer: status.to_string(),
                location: shown(url),
            })),
        }
    }
}

impl Objects for HttpObjects {
    fn read<'a>(
        &'a self,
        key: &'a str,
        part: Part,
    ) -> BoxFuture<'a, Result<Option<Bytes>, ObjectError>> {
        Box::pin(self.part(key, part))
    }

    fn location(&self, key: &str) -> String {
        shown(&self.url(key))
    }

    fn folders(&self) -> Vec<String> {
        let parts = self.base.path_segments().into_iter().flatten();
        let parts = parts.filter(|part| !part.is_empty());
        parts.map(str::to_owned).collect()
    }

    fn denied(&self) -> Option<&'static str> {
        self.refusals.all_refused().then_some(ADVICE)
    }

    fn stop_guessing(&self) {
        self.refusals.stop_guessing();
    }

    fn replacements(&self, key: &str) -> u64 {
        self.tags.replacements(key) + self.times.replacements(key)
    }

    fn read_cost(&self) -> u64 {
        256 << 10
    }
}

/// Who sends requests: natively, redirections to other hosts are not followed; a browser has rules of its own.
pub(crate) fn client() -> Client {
    platform::client()
}

/// Whether the same question may be answered better later.
pub(crate) fn is_passing(status: StatusCode) -> bool {
    matches!(
        status,
        StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS
    ) || (status.is_server_error() && status != StatusCode::NOT_IMPLEMENTED)
}

fn again(answer: &reqwest::Response) -> Failure {
    let wait = answer.headers().get(header::RETRY_AFTER);
    let wait = wait.and_then(|wait| wait.to_str().ok()?.trim().parse().ok());
    Failure::Again {
        reason: format!("the server answers {}", answer.status()),
        wait: wait.map(std::time::Duration::from_secs),
    }
}

/// An address without what may be secret: its password, its query.
fn shown(url: &Url) -> String {
    let mut url = url.clone();
    url.set_query(None);
    // Fails for addresses that have no user anyway.
    let _ = url.set_password(None).and_then(|()| url.set_username(""));
    url.into()
}

/// An error with all its causes, in one line.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += ": ";
        text += &error.to_string();
        cause = error.source();
    }
    text
}
