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
        let lost = at.fresh && change.revision > at.revision + 1;
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
