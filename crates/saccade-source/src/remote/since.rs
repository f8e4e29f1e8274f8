//! What has changed since a revision, by HTTP.

use serde::Deserialize;

use super::{RemoteSource, get_json, joined};
use crate::Change;
use crate::maybe_send::sleep;

/// Attempts to learn it: who does not learn it has to read everything anew.
const ATTEMPTS: u32 = 5;

#[derive(Deserialize)]
pub(super) struct ChangesJson {
    pub(super) changes: Option<Vec<Change>>,
}

impl RemoteSource {
    pub(super) async fn since(&self, revision: u64) -> Option<Vec<Change>> {
        let url = joined(&self.url, &["changes", &revision.to_string()]);
        let mut wait = self.options.reconnect;
        let mut attempts = 0;
        loop {
            attempts += 1;
            let answer = get_json::<ChangesJson>(&self.client, url.clone(), self.options);
            match answer.await {
                Ok(answer) => return answer.changes,
                Err(error) if error.is_transient() && attempts < ATTEMPTS => {
                    log::debug!("what has changed is asked for again: {error}");
                }
                Err(error) => {
                    log::info!("what has changed cannot be told: {error}");
                    return None;
                }
            }
            sleep(wait).await;
            wait = (wait * 2).min(self.options.reconnect_at_most);
        }
    }
}
