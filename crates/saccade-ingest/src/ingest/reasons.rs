//! Those who look at the volume are told why it does not grow.

use std::path::Path;
use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::Worker;

use crate::held_up::{HeldUp, Reason};

/// Between looks at the reasons. What passes sooner need not be told.
const LOOKS: Duration = Duration::from_millis(500);

/// Longest attempt to tell: the catalog itself may be what is waited for.
const LONGEST: Duration = Duration::from_secs(5);

/// Paths that are the machine's own matter, and what they are called to others.
#[derive(Debug, Default)]
pub(super) struct Called(Vec<(String, &'static str)>);

impl Called {
    /// Calls a path, and what lies below it, or an address by a name. A path that is not told from the root on says nothing
    /// of the machine.
    pub(super) fn call(&mut self, path: &str, name: &'static str) {
        let path = path.trim_end_matches('/');
        // Below the root lies everything.
        if !path.is_empty() && (Path::new(path).is_absolute() || path.contains("://")) {
            self.0.push((path.to_owned(), name));
        }
    }

    /// The same text without those paths.
    pub(super) fn told(&self, text: &str) -> String {
        let replaced = |text: String, (path, name): &(String, &'static str)| {
            let mut parts = text.split(path.as_str());
            let mut told = parts.next().unwrap_or_default().to_owned();
            for part in parts {
                // The beginning of a longer name is another path.
                let ends = !part.starts_with(|c: char| c.is_alphanumeric() || "-_".contains(c));
                told.push_str(if ends { name } else { path });
                told.push_str(part);
            }
            told
        };
        self.0.iter().fold(text.to_owned(), replaced)
    }
}

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
    (called.told(&reason.why), reason.since)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_the_machine_are_called_otherwise() {
        let mut called = Called::default();
        for (path, name) in [
            ("/disk/arch/catalog.sqlite", "the catalog"),
            ("postgres://lab/db", "the database"),
            ("/disk/a", "the acquisition's folder"),
            ("/disk/arch/", "the archive's folder"),
            // Neither is of use to anybody who looks for where something lies.
            ("a", "wrong"),
            ("/", "wrong"),
        ] {
            called.call(path, name);
        }
        for (text, told) in [
            (
                "cannot read /disk/a/im/a.tif: gone",
                "cannot read the acquisition's folder/im/a.tif: gone",
            ),
            (
                "no space: /disk/arch/tiles/v, /disk/arch/catalog.sqlite",
                "no space: the archive's folder/tiles/v, the catalog",
            ),
            (
                "is it mounted? /disk/arch",
                "is it mounted? the archive's folder",
            ),
            (
                "/disk/arch/catalog.sqlite-wal",
                "the archive's folder/catalog.sqlite-wal",
            ),
            ("ask postgres://lab/db: away", "ask the database: away"),
            ("/disk/a2/x and /disk/a-b", "/disk/a2/x and /disk/a-b"),
        ] {
            assert_eq!(called.told(text), told);
        }
    }
}
