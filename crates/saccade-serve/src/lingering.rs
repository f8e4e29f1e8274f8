//! Reads that took too long for one answer go on for a while: whoever asks again finds them done, or waits for the rest. Were they
//! ended with the answer, what takes longer than one answer may wait would begin anew each time and never be there.

use std::collections::HashSet;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use glam::UVec3;

/// Reads that go on at once, of a volume: what nobody asks for again must not keep others waiting.
const MOST: usize = 64;
/// How long they do.
const LONGEST: Duration = Duration::from_mins(3);

/// What is being read.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Lingers {
    /// Level, position \[chunks\], channels.
    Piece(u32, UVec3, Range<u32>),
    Thumbnail,
}

/// The reads of a volume that nobody waits for.
#[derive(Clone)]
pub(crate) struct Lingering {
    reads: Arc<Mutex<HashSet<Lingers>>>,
    longest: Duration,
}

impl Default for Lingering {
    fn default() -> Self {
        Self::for_so_long(LONGEST)
    }
}

impl Lingering {
    fn for_so_long(longest: Duration) -> Self {
        let reads = Arc::default();
        Self { reads, longest }
    }

    /// Lets a read go on, unless one of the same does already, or too many do. Sources read what several ask for at the same time
    /// once.
    pub(crate) fn go_on(&self, what: Lingers, read: impl Future<Output = ()> + Send + 'static) {
        let Some(place) = self.place(what) else {
            return;
        };
        let longest = self.longest;
        tokio::spawn(async move {
            let _ended_or_given_up = tokio::time::timeout(longest, read).await;
            drop(place);
        });
    }

    fn place(&self, what: Lingers) -> Option<Place> {
        let mut reads = self.reads.lock().unwrap_or_else(PoisonError::into_inner);
        let goes_on = reads.len() < MOST && reads.insert(what.clone());
        goes_on.then(|| Place(self.clone(), what))
    }
}

/// One of the places there are, given back when it is dropped.
struct Place(Lingering, Lingers);

impl Drop for Place {
    fn drop(&mut self) {
        let mut reads = self.0.reads.lock().unwrap_or_else(PoisonError::into_inner);
        reads.remove(&self.1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn so_many_go_on_and_for_so_long() {
        let lingering = Lingering::for_so_long(Duration::from_millis(200));
        let piece = |n| Lingers::Piece(0, UVec3::new(n, 0, 0), 0..1);
        let count = || lingering.reads.lock().unwrap().len();
        for n in 0..100 {
            lingering.go_on(piece(n), std::future::pending());
            lingering.go_on(piece(n), std::future::pending());
        }
        assert_eq!(count(), MOST);
        while count() > 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let lasting = Lingering::default();
        lasting.go_on(Lingers::Thumbnail, std::future::ready(()));
        while !lasting.reads.lock().unwrap().is_empty() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
}
