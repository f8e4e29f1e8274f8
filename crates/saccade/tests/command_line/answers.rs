//! What a server answers, now and after a while.

use std::time::{Duration, SystemTime};

use serde_json::Value;
use tokio::runtime::Runtime;

/// How long something is waited for that is to come about.
const PATIENCE: Duration = Duration::from_secs(30);

/// Somebody who asks a server.
pub(super) struct Client {
    runtime: Runtime,
    /// Of the server, with a slash at its end.
    url: String,
}

/// An answer.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) status: u16,
    /// Whether it says when to ask again.
    pub(super) retry: bool,
    pub(super) text: String,
}

impl Answer {
    /// As JSON; null where it is none.
    pub(super) fn json(&self) -> Value {
        serde_json::from_str(&self.text).unwrap_or_default()
    }
}

impl Client {
    pub(super) fn of(url: &str) -> Self {
        Self {
            runtime: Runtime::new().unwrap(),
            url: url.to_owned(),
        }
    }

    pub(super) fn get(&self, path: &str) -> Answer {
        let url = format!("{}{path}", self.url);
        self.runtime.block_on(async {
            let answer = reqwest::get(url).await.unwrap();
            Answer {
                status: answer.status().as_u16(),
                retry: answer.headers().contains_key("retry-after"),
                text: answer.text().await.unwrap(),
            }
        })
    }

    /// Asks until the answer is as it should be.
    pub(super) fn until(&self, path: &str, is_so: impl Fn(&Answer) -> bool) -> Answer {
        let end = SystemTime::now() + PATIENCE;
        loop {
            let answer = self.get(path);
            if is_so(&answer) {
                return answer;
            }
            assert!(
                SystemTime::now() < end,
                "{path} does not become what it should: {answer:?}"
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}
