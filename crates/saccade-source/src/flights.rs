//! What is read once for all who want it at the same time, and kept while there is room.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::FutureExt as _;
use futures::future::{Shared, WeakShared, join_all};
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use web_time::Instant;

use crate::maybe_send::{BoxFuture, MaybeSend, MaybeSync};

/// A value that knows its size.
pub(crate) trait Weighed {
    /// What it takes \[bytes\].
    fn bytes(&self) -> u64;

    /// Whether it says that there is nothing, which may come yet.
    fn is_missing(&self) -> bool {
        false
    }
}

/// A value that is kept.
#[derive(Clone, Debug)]
struct Kept<V> {
    value: V,
    /// Since when, if it is missing.
    missing: Option<Instant>,
}

#[derive(Clone, Debug)]
struct ByBytes;

impl<K, V: Weighed> Weighter<K, Kept<V>> for ByBytes {
    fn weight(&self, _: &K, kept: &Kept<V>) -> u64 {
        // What the cache itself needs for one.
        kept.value.bytes() + 64
    }
}

/// What several keys' common work ends in.
type Outcomes<K, V, E> = Vec<(K, Result<V, E>)>;
/// Work for several keys.
pub(crate) type Work<K, V, E> = BoxFuture<'static, Outcomes<K, V, E>>;
type Group<K, V, E> = BoxFuture<'static, Arc<Outcomes<K, V, E>>>;

struct Flight<K, V, E> {
    number: u64,
    group: WeakShared<Group<K, V, E>>,
}

struct Flying<K, V, E> {
    next: u64,
    by_key: HashMap<K, Flight<K, V, E>>,
}

/// Values by key, each made once for all who ask while it is made, and kept within a number of bytes.
///
/// Work goes on while anybody waits for any of its keys, and is dropped with the last. What is missing is kept for a time.
pub(crate) struct Flights<K, V, E> {
    cache: Cache<K, Kept<V>, ByBytes>,
    missing_for: Duration,
    flying: Mutex<Flying<K, V, E>>,
}

impl<K, V, E> Flights<K, V, E>
where
    K: Copy + Eq + Hash + MaybeSend + MaybeSync + 'static,
    V: Clone + Weighed + MaybeSend + MaybeSync + 'static,
    E: Clone + MaybeSend + MaybeSync + 'static,
{
    /// Keeps values of up to `bytes`, of about `each` bytes each, and what is missing for so long.
    pub(crate) fn new(bytes: u64, each: u64, missing_for: Duration) -> Arc<Self> {
        let count = usize::try_from(bytes / each.max(1)).unwrap_or(usize::MAX);
        Arc::new(Self {
            cache: Cache::with_weighter(count.clamp(16, 1 << 16), bytes, ByBytes),
            missing_for,
            flying: Mutex::new(Flying {
                next: 0,
                by_key: HashMap::new(),
            }),
        })
    }

    /// Values of keys, which differ, in their order. Of those that nobody has or makes, `start` makes groups that
    /// are worked on together; together they have each of these keys once, and end in an outcome for each.
    pub(crate) async fn get(
        self: &Arc<Self>,
        keys: &[K],
        start: impl FnOnce(Vec<K>) -> Vec<(Vec<K>, Work<K, V, E>)>,
    ) -> Vec<Option<Result<V, E>>> {
        let mut found: Vec<_> = keys.iter().map(|key| self.cached(key).map(Ok)).collect();
        if found.iter().all(Option::is_some) {
            return found;
        }
        let waits = self.join_or_start(keys, &mut found, start);
        let landed = join_all(waits).await;
        let mut outcomes = HashMap::new();
        for (key, outcome) in landed.iter().flat_map(|group| group.iter()) {
            outcomes.insert(key, outcome);
        }
        for (key, found) in keys.iter().zip(&mut found) {
            if found.is_none() {
                *found = outcomes.get(key).map(|outcome| (*outcome).clone());
            }
        }
        found
    }

    fn join_or_start(
        self: &Arc<Self>,
        keys: &[K],
        found: &mut [Option<Result<V, E>>],
        start: impl FnOnce(Vec<K>) -> Vec<(Vec<K>, Work<K, V, E>)>,
    ) -> Vec<Shared<Group<K, V, E>>> {
        let (mut numbers, mut waits, mut missing) = (Vec::new(), Vec::new(), Vec::new());
        let mut flying = self.flying();
        for (key, found) in keys.iter().zip(found) {
            // Again: a flight may have landed meanwhile.
            if found.is_none() {
                *found = self.cached(key).map(Ok);
            }
            if found.is_some() {
                continue;
            }
            let flight = flying.by_key.get(key);
            match flight.and_then(|flight| Some((flight.number, flight.group.upgrade()?))) {
                // A clone that is dropped here is not the last one.
                Some((number, _)) if numbers.contains(&number) => {}
                Some((number, group)) => {
                    numbers.push(number);
                    waits.push(group);
                }
                None => missing.push(*key),
            }
        }
        for (keys, work) in start(missing) {
            let number = flying.next;
            flying.next += 1;
            let landing = Landing {
                flights: self.clone(),
                number,
                keys: keys.clone(),
            };
            let group: Group<K, V, E> = Box::pin(async move {
                let done = work.await;
                landing.keep(&done);
                drop(landing);
                Arc::new(done)
            });
            let group = group.shared();
            for key in keys {
                let group = group.downgrade().expect("it has not been polled");
                flying.by_key.insert(key, Flight { number, group });
            }
            waits.push(group);
        }
        waits
    }

    fn cached(&self, key: &K) -> Option<V> {
        let kept = self.cache.get(key)?;
        let is_old = |since: Instant| since.elapsed() >= self.missing_for;
        { !kept.missing.is_some_and(is_old) }.then_some(kept.value)
    }

    /// Whoever asks from here on for such a key gets a value whose making has begun later.
    pub(crate) fn forget(&self, is: impl Fn(&K) -> bool) {
        let mut flying = self.flying();
        // Who waits already still gets what is made, which is not kept.
        flying.by_key.retain(|key, _| !is(key));
        self.cache.retain(|key, _| !is(key));
    }

    /// Keys that are worked on.
    #[cfg(test)]
    pub(crate) fn in_work(&self) -> usize {
        self.flying().by_key.len()
    }

    /// Bytes that are kept.
    #[cfg(test)]
    pub(crate) fn kept(&self) -> u64 {
        self.cache.weight()
    }
}

impl<K, V, E> Flights<K, V, E> {
    fn flying(&self) -> MutexGuard<'_, Flying<K, V, E>> {
        self.flying.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Takes a group off the list when it ends or is dropped.
struct Landing<K: Eq + Hash, V, E> {
    flights: Arc<Flights<K, V, E>>,
    number: u64,
    keys: Vec<K>,
}

impl<K, V, E> Landing<K, V, E>
where
    K: Copy + Eq + Hash,
    V: Clone + Weighed,
{
    /// Keeps what was made, but for what was forgotten meanwhile.
    fn keep(&self, done: &Outcomes<K, V, E>) {
        let flying = self.flights.flying();
        let made = done
            .iter()
            .filter_map(|(key, made)| Some((key, made.as_ref().ok()?)));
        for (key, value) in made {
            let flight = flying.by_key.get(key);
            if flight.is_some_and(|flight| flight.number == self.number) {
                #[expect(clippy::disallowed_methods, reason = "web_time's, which browsers have")]
                let missing = value.is_missing().then(Instant::now);
                let value = value.clone();
                self.flights.cache.insert(*key, Kept { value, missing });
            }
        }
    }
}

impl<K: Eq + Hash, V, E> Drop for Landing<K, V, E> {
    fn drop(&mut self) {
        let mut flying = self.flights.flying();
        for key in &self.keys {
            if flying
                .by_key
                .get(key)
                .is_some_and(|flight| flight.number == self.number)
            {
                flying.by_key.remove(key);
            }
        }
    }
}

#[cfg(all(test, not(target_family = "wasm")))]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::sync::{Semaphore, oneshot};

    use super::*;

    const LONG: Duration = Duration::from_secs(1000);

    impl Weighed for u64 {
        fn bytes(&self) -> u64 {
            1000
        }

        fn is_missing(&self) -> bool {
            *self >= 1000
        }
    }

    type Numbers = Arc<Flights<u32, u64, String>>;

    fn each(keys: Vec<u32>, count: &Arc<AtomicUsize>) -> Vec<(Vec<u32>, Work<u32, u64, String>)> {
        gated(keys, count, &Arc::new(Semaphore::new(1000)))
    }

    /// Works that go on when there are permits; odd keys fail.
    fn gated(
        keys: Vec<u32>,
        count: &Arc<AtomicUsize>,
        gate: &Arc<Semaphore>,
    ) -> Vec<(Vec<u32>, Work<u32, u64, String>)> {
        let one = |key: u32| {
            let (count, gate) = (count.clone(), gate.clone());
            let work: Work<u32, u64, String> = Box::pin(async move {
                count.fetch_add(1, Ordering::SeqCst);
                let _permit = gate.acquire().await;
                let odd = key % 2 == 1;
                vec![(
                    key,
                    if odd {
                        Err(key.to_string())
                    } else {
                        Ok(u64::from(key))
                    },
                )]
            });
            (vec![key], work)
        };
        keys.into_iter().map(one).collect()
    }

    #[tokio::test]
    async fn each_value_is_made_once_and_errors_are_not_kept() {
        let numbers: Numbers = Flights::new(1 << 20, 1000, LONG);
        let (made, gate) = (Arc::new(AtomicUsize::new(0)), Arc::new(Semaphore::new(0)));
        let readers = (0..8).map(|_| numbers.get(&[4, 5, 6], |keys| gated(keys, &made, &gate)));
        let mut readers = Box::pin(join_all(readers));
        assert!(futures::poll!(&mut readers).is_pending());
        gate.add_permits(1000);
        for got in readers.await {
            assert_eq!(got, [Some(Ok(4)), Some(Err("5".to_owned())), Some(Ok(6))]);
        }
        assert_eq!(made.load(Ordering::SeqCst), 3);
        assert_eq!(numbers.in_work(), 0);
        numbers.get(&[4, 5, 6], |keys| each(keys, &made)).await;
        assert_eq!(
            made.load(Ordering::SeqCst),
            4,
            "only what failed is made again"
        );
    }

    #[tokio::test]
    async fn work_ends_with_its_last_reader() {
        let numbers: Numbers = Flights::new(1 << 20, 1000, LONG);
        let (end, ended) = oneshot::channel::<()>();
        let work = |keys: Vec<u32>| -> Vec<(Vec<u32>, Work<u32, u64, String>)> {
            let never = Box::pin(async move {
                let _dropped_with_the_work = end;
                std::future::pending().await
            });
            vec![(keys, never)]
        };
        let mut first = Box::pin(numbers.get(&[1, 2], work));
        let mut second = Box::pin(numbers.get(&[2], |keys| {
            assert_eq!(keys, [0; 0], "somebody works on it");
            Vec::new()
        }));
        assert!(
            futures::poll!(&mut first).is_pending() && futures::poll!(&mut second).is_pending()
        );
        drop(first);
        assert_eq!(numbers.in_work(), 2, "the second still waits");
        drop(second);
        assert!(ended.await.is_err(), "the work is gone");
        assert_eq!(numbers.in_work(), 0);
        let made = Arc::new(AtomicUsize::new(0));
        let again = numbers.get(&[2], |keys| each(keys, &made)).await;
        assert_eq!(again, [Some(Ok(2))]);
    }

    #[tokio::test]
    async fn what_is_missing_is_kept_for_a_time() {
        for (kept_for, want) in [(LONG, 2), (Duration::ZERO, 3)] {
            let numbers: Numbers = Flights::new(1 << 20, 1000, kept_for);
            let made = Arc::new(AtomicUsize::new(0));
            for _ in 0..2 {
                let got = numbers.get(&[2, 1000], |keys| each(keys, &made)).await;
                assert_eq!(got, [Some(Ok(2)), Some(Ok(1000))]);
            }
            assert_eq!(made.load(Ordering::SeqCst), want, "{kept_for:?}");
        }
    }

    /// Else what was read before a change would be kept after it.
    #[tokio::test]
    async fn what_is_forgotten_while_it_is_made_is_not_kept() {
        let numbers: Numbers = Flights::new(1 << 20, 1000, LONG);
        let (made, gate) = (Arc::new(AtomicUsize::new(0)), Arc::new(Semaphore::new(0)));
        numbers.get(&[8], |keys| each(keys, &made)).await;
        let mut early = Box::pin(numbers.get(&[2, 4], |keys| gated(keys, &made, &gate)));
        assert!(futures::poll!(&mut early).is_pending());
        numbers.forget(|key| *key != 4);
        gate.add_permits(1000);
        assert_eq!(early.await, [Some(Ok(2)), Some(Ok(4))]);
        let before = made.load(Ordering::SeqCst);
        numbers.get(&[2, 4, 8], |keys| each(keys, &made)).await;
        assert_eq!(made.load(Ordering::SeqCst), before + 2, "4 is kept");
    }

    #[tokio::test]
    async fn no_more_is_kept_than_there_is_room_for() {
        let numbers: Numbers = Flights::new(20_000, 1000, LONG);
        let made = Arc::new(AtomicUsize::new(0));
        for key in 0..200 {
            numbers.get(&[key * 2], |keys| each(keys, &made)).await;
            assert!(
                numbers.kept() <= 20_000,
                "{} bytes are kept",
                numbers.kept()
            );
        }
        assert!(numbers.kept() > 10_000, "little is kept");
    }
}
