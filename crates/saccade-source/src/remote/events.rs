//! Keeps the connection for events.

use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use reqwest::{Client, Url, header};
use saccade_core::voxel_box::VoxelBox;

use super::chunks::Revisions;
use super::event_parser::{Event, EventParser};
use super::{RemoteError, RemoteOptions, joined, refusal, within};
use crate::changes::Changes;
use crate::maybe_send::sleep;
use crate::{Change, ChangeReason};

/// Longest wait that a server is believed \[ms\].
const LONGEST_RETRY_MS: u64 = 60_000;

pub(super) struct Follower {
    pub(super) client: Client,
    pub(super) url: Url,
    pub(super) options: RemoteOptions,
    pub(super) changes: Arc<Changes>,
    pub(super) revisions: Arc<Revisions>,
    pub(super) whole: VoxelBox,
}

/// What is known of the stream of events.
struct Position {
    /// Of the last change that was passed on.
    revision: u64,
    /// The next change is the first of its connection.
    fresh: bool,
    wait: Duration,
}

impl Follower {
    /// Follows for ever, from the change after `revision` on.
    pub(super) async fn run(self, revision: u64) {
        let mut at = Position {
            revision,
            fresh: true,
            wait: self.options.reconnect,
        };
        loop {
            at.fresh = true;
            match self.follow(&mut at).await {
                Ok(()) => log::debug!("the server closed the stream of events; reconnecting"),
                Err(error) => log::warn!("no events: {}; reconnecting", Chained(&error)),
            }
            sleep(at.wait).await;
            at.wait = (at.wait * 2).min(self.options.reconnect_at_most);
        }
    }

    /// Follows one connection to its end.
    async fn follow(&self, at: &mut Position) -> Result<(), RemoteError> {
        let url = joined(&self.url, &["events"]);
        let idle = self.options.events_idle;
        let http = |source: reqwest::Error| RemoteError::Http {
            source: source.without_url(),
            url: url.clone(),
        };
        let request = self.client.get(url.clone());
        let request = request
            .header(header::ACCEPT, "text/event-stream")
            .header(header::CACHE_CONTROL, "no-store")
            .header("last-event-id", at.revision.to_string());
        let answer = within(idle, &url, request.send()).await?.map_err(http)?;
        if !answer.status().is_success() {
            let status = answer.status();
            let reason = within(idle, &url, refusal(answer)).await?.reason();
            return Err(RemoteError::Status {
                status,
                reason,
                url,
            });
        }
        let mut parser = EventParser::default();
        let mut body = answer.bytes_stream();
        while let Some(bytes) = within(idle, &url, body.next()).await? {
            for event in parser.feed(&bytes.map_err(http)?) {
                self.pass_on(&event, at);
            }
            at.wait = match parser.retry_ms() {
                Some(ms) => Duration::from_millis(ms.min(LONGEST_RETRY_MS)),
                None => self.options.reconnect,
            };
        }
        Ok(())
    }

    fn pass_on(&self, event: &Event, at: &mut Position) {
        if event.kind != "change" {
            return;
        }
        let change = match serde_json::from_str::<Change>(&event.data) {
            Ok(change) => self.checked(change, at),
            Err(error) => {
                log::warn!("cannot understand an event ({error}); reading everything anew");
                let id = event.id.as_ref().and_then(|id| id.parse().ok());
                Some(self.missed(id.unwrap_or(at.revision)))
            }
        };
        at.fresh = false;
        if let Some(change) = change {
            at.revision = at.revision.max(change.revision);
            // First the addresses, then the news: a read after it must see the change.
            self.revisions.record(change);
            self.changes.send(change);
        }
    }

    /// The change to pass on: none if it is known, `Missed` if one before it was lost.
    fn checked(&self, change: Change, at: &Position) -> Option<Change> {
        if change.reason == ChangeReason::Missed {
            return Some(self.missed(change.revision));
        }
        // One revision may bring several changes, but not on both sides of a break.
        let known = change.revision < at.revision || at.fresh && change.revision == at.revision;
        if known {
            return None;
        }
        // A server that continued where the last connection ended would go on with the next.
        let lost = at.fresh && change.revision > at.revision.saturating_add(1);
        Some(if lost {
            self.missed(change.revision)
        } else {
            change
        })
    }

    fn missed(&self, revision: u64) -> Change {
        Change {
            revision,
            voxels: self.whole,
            reason: ChangeReason::Missed,
        }
    }
}

/// An error with all its causes.
struct Chained<'a>(&'a dyn std::error::Error);

impl std::fmt::Display for Chained<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.0)?;
        let mut source = self.0.source();
        while let Some(error) = source {
            write!(f, ": {error}")?;
            source = error.source();
        }
        Ok(())
    }
}

/// A stream of events, and the same in pieces: what it tells does not depend on them, revisions only rise, and what was told
/// is not told as anything else when the connection is opened anew.
#[cfg(all(any(test, fuzzing), not(target_family = "wasm")))]
pub(super) fn fuzz(bytes: &[u8], pieces: &[&[u8]], client: &Client) {
    use futures::FutureExt as _;

    const FIRST: u64 = 3;
    let whole = VoxelBox::of_size(glam::UVec3::new(64, 48, 9));
    let told = |pieces: &[&[u8]], connections: usize| {
        let follower = Follower {
            client: client.clone(),
            url: Url::parse("http://localhost/v/a").expect("an address"),
            options: RemoteOptions::default(),
            changes: Changes::new(whole, FIRST),
            revisions: Arc::new(Revisions::new(FIRST)),
            whole,
        };
        let mut changes = follower.changes.stream();
        let mut at = Position {
            revision: FIRST,
            fresh: true,
            wait: Duration::ZERO,
        };
        let (mut told, mut retry) = (Vec::new(), None);
        for _ in 0..connections {
            at.fresh = true;
            let mut parser = EventParser::default();
            for event in pieces.iter().flat_map(|piece| parser.feed(piece)) {
                // What is no text takes three bytes for each of its own.
                assert!(event.data.len() + event.kind.len() <= 3 * bytes.len());
                let before = (at.revision, follower.revisions.of(whole));
                follower.pass_on(&event, &mut at);
                let now = (at.revision, follower.revisions.of(whole));
                assert!(
                    now.0 >= before.0 && now.1 >= before.1,
                    "{before:?}, then {now:?}"
                );
                while let Some(Some(change)) = changes.next().now_or_never() {
                    let newest = follower.revisions.of(change.voxels);
                    let seen = change.voxels.is_empty() || newest >= change.revision;
                    assert!(seen, "a read would get what was before {change:?}");
                    told.push(change);
                }
            }
            retry = parser.retry_ms();
        }
        (told, at.revision, retry)
    };
    let once = told(&[bytes], 1);
    assert_eq!(once, told(pieces, 1), "in pieces");
    assert!({ once.0.iter() }.all(|change| (FIRST..=once.1).contains(&change.revision)));
    let (twice, ..) = told(&[bytes], 2);
    let known = |change: &Change| change.reason == ChangeReason::Missed || once.0.contains(change);
    assert!(twice.iter().all(known), "{twice:?}");
}
