//! How much clients may take of a server.

use std::time::Duration;

/// Bounds on what clients may take, so that none of them can take everything.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Connections at once, where the system allows as many open files. When one more comes, one
    /// that is not being answered goes: first those that never asked anything, then the one that
    /// has been silent longest.
    pub connections: usize,
    /// Requests being answered at once. Others are told to ask again.
    pub requests: usize,
    /// Streams of changes at once. When one more comes, the client with the most gives one up, if it has at least two more than
    /// who comes; otherwise who comes is told to ask again. A client is an address, and in version 6 a network (/64).
    pub streams: usize,
    /// Longest time until the whole head of a request is there, counted from the connection's start
    /// or from the answer before.
    pub head: Duration,
    /// Time in which a client takes [`Self::PACE_BYTES`] of an answer, while one waits for it.
    pub pace: Duration,
}

impl Limits {
    /// The usual ones.
    pub const DEFAULT: Self = Self {
        connections: 16_384,
        requests: 512,
        streams: 1024,
        head: Duration::from_secs(30),
        pace: Duration::from_secs(10),
    };

    /// What a client must take of an answer in the time [`Self::pace`], if there is as much.
    pub const PACE_BYTES: usize = 16 * 1024;

    /// The same, with connections that leave files of the process to other uses.
    pub(super) fn within_open_files(self) -> Self {
        Self {
            connections: self.connections.min(for_connections(open_files())).max(1),
            ..self
        }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// How many of so many files connections may take: some hundreds are left for a cache on disk and for pyramids, unless
/// connections would get less than a quarter.
fn for_connections(files: usize) -> usize {
    /// Files of the largest cache on disk, and of reads under way.
    const OTHERS: usize = 600;
    (files / 4 * 3)
        .min(files.saturating_sub(OTHERS))
        .max(files / 4)
}

/// How many files this process may have open, by what Linux says; elsewhere the smallest usual number.
fn open_files() -> usize {
    const SMALLEST: usize = 256;
    let limits = std::fs::read_to_string("/proc/self/limits");
    limits
        .ok()
        .as_deref()
        .and_then(soft_limit)
        .unwrap_or(SMALLEST)
}

fn soft_limit(limits: &str) -> Option<usize> {
    let line = limits
        .lines()
        .find_map(|l| l.strip_prefix("Max open files"))?;
    match line.split_whitespace().next()? {
        "unlimited" => Some(usize::MAX),
        number => number.parse().ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_system_s_limit_is_read() {
        let table = "Limit                     Soft Limit           Hard Limit           Units\n\
                     Max processes             unlimited            unlimited            processes\n\
                     Max open files            1024                 4096                 files\n";
        assert_eq!(soft_limit(table), Some(1024));
        assert_eq!(
            soft_limit(&table.replace("1024", "unlimited")),
            Some(usize::MAX)
        );
        assert_eq!(soft_limit("nothing of the kind"), None);
    }

    #[test]
    fn files_are_left_for_a_cache_on_disk() {
        for (files, connections) in [
            (256, 64),
            (1024, 424),
            (4096, 3072),
            (usize::MAX, usize::MAX / 4 * 3),
        ] {
            assert_eq!(for_connections(files), connections, "{files}");
        }
    }

    #[test]
    fn files_are_left_for_others() {
        let most = |connections| {
            Limits {
                connections,
                ..Limits::DEFAULT
            }
            .within_open_files()
        };
        assert!(most(usize::MAX).connections < open_files());
        assert_eq!(most(1).connections, 1);
    }
}
