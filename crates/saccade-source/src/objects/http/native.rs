use reqwest::redirect::{Attempt, Policy};
use reqwest::{Client, RequestBuilder, header};

use super::chain;
use crate::objects::error::Failure;

/// The last bytes can be asked for as such.
pub(super) const SUFFIXES: bool = true;

/// What is encoded arrives as it was sent.
pub(super) const DECODES: bool = false;

/// Follows a server to another place of its own, not to others.
pub(super) fn client() -> Client {
    saccade_archive::tls::provide();
    let own = |attempt: Attempt<'_>| {
        let first = attempt.previous().first();
        let same = first.is_some_and(|first| {
            first.host() == attempt.url().host()
                && (first.port_or_known_default() == attempt.url().port_or_known_default()
                    || (first.scheme() == "http" && attempt.url().scheme() == "https"))
        });
        if same && attempt.previous().len() < 5 {
            attempt.follow()
        } else {
            attempt.stop()
        }
    };
    let client = Client::builder().redirect(Policy::custom(own));
    client.build().unwrap_or_default()
}

/// Asks for the bytes as they are.
pub(super) fn unencoded(request: RequestBuilder) -> RequestBuilder {
    request.header(header::ACCEPT_ENCODING, "identity")
}

/// What it means that no answer came.
pub(super) async fn unanswered(error: reqwest::Error, _: &str, _: bool) -> Failure {
    Failure::again(chain(&error.without_url()))
}
