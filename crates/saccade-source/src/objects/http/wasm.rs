use reqwest::Client;

/// The browser's own, with its own rules.
pub(super) fn client() -> Client {
    Client::new()
}
