use reqwest::Client;

pub(in crate::remote) fn client() -> Client {
    Client::new()
}
