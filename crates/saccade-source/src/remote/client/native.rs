use reqwest::Client;

pub(in crate::remote) fn client() -> Client {
    saccade_archive::tls::provide();
    Client::new()
}
