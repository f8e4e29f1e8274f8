//! Those who look at the volume are told why it does not grow.

use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::Worker;

use crate::held_up::{HeldUp, Reason};

/// Between looks at the reasons. What passes sooner need not be told.
const LOOKS: Duration = Duration::from_millis(500);

/// Longest attempt to tell: the catalog itself may be what is waited for.
const LONGEST: Duration = Duration::from_secs(5);

/// Paths that are the machine's own matter, and what they are called to others.
pub(super) type Called = Vec<(String, &'static str)>;

/// Keeps what holds up an ingest in the catalog, as long as it does, until dropped. What cannot be told is told later.
pub(super) async fn tell(
    archive: &VisualizationArchive,
    volume: &str,
    worker: &Worker,
    held_up: &HeldUp,
    called: &Called,
) {
    let mut told = Vec::new();
    loop {
        archive.catalog().clock().sleep(LOOKS).await;
        let now = held_up.now();
        if now == told {
            continue;
        }
        let reasons: Vec<_> = now.iter().map(|reason| public(reason, called)).collect();
        let tell = archive.catalog().tell_held_up(volume, worker, &reasons);
        match tokio::time::timeout(LONGEST, tell).await {
            Ok(Ok(())) => told = now,
            Ok(Err(e)) => log::debug!("why nothing goes on could not be told: {e}"),
            Err(_) => log::debug!("why nothing goes on could not be told in time"),
        }
    }
}

fn public(reason: &Reason, called: &Called) -> (String, std::time::SystemTime) {
    let why = { called.iter() }.fold(reason.why.clone(), |why, (path, name)| {
        why.replace(path.as_str(), name)
    });
    (why, reason.since)
}
