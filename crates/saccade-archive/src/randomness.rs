//! Numbers that nobody can foresee: the machine's, or those of a seed.

pub mod conformance;

use std::fmt::Debug;
use std::hash::{BuildHasher, DefaultHasher, Hasher, RandomState};
use std::sync::atomic::{AtomicU64, Ordering};

/// Where identities come from, names that must be nobody else's, and the keys of hashes.
pub trait Randomness: Debug + Send + Sync {
    /// The next number.
    fn next(&self) -> u64;
}

/// The machine's.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemRandomness;

impl Randomness for SystemRandomness {
    #[expect(
        clippy::disallowed_methods,
        reason = "the one place that asks the machine"
    )]
    fn next(&self) -> u64 {
        RandomState::new().build_hasher().finish()
    }
}

/// The same numbers for the same seed, for tests.
#[derive(Debug)]
pub struct SeededRandomness(AtomicU64);

impl SeededRandomness {
    /// The numbers of a seed.
    pub fn new(seed: u64) -> Self {
        Self(AtomicU64::new(seed))
    }
}

impl Randomness for SeededRandomness {
    /// By splitmix64, of which each seed goes through all numbers.
    fn next(&self) -> u64 {
        const STEP: u64 = 0x9e37_79b9_7f4a_7c15;
        let state = self.0.fetch_add(STEP, Ordering::Relaxed);
        let mixed = state.wrapping_add(STEP);
        let mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }
}

/// Makes hashes of names that may be chosen by strangers: by a key, so that nobody finds two of one hash.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Keyed(u64);

impl Keyed {
    pub(crate) fn new(randomness: &dyn Randomness) -> Self {
        Self(randomness.next())
    }
}

impl BuildHasher for Keyed {
    type Hasher = DefaultHasher;

    fn build_hasher(&self) -> DefaultHasher {
        let mut hasher = DefaultHasher::new();
        hasher.write_u64(self.0);
        hasher
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_says_all_numbers_and_the_machine_says_others_each_time() {
        let of = |seed| {
            let randomness = SeededRandomness::new(seed);
            [(); 4].map(|()| randomness.next())
        };
        assert_eq!(of(7), of(7));
        assert_ne!(of(7), of(8));
        // As published with the generator.
        assert_eq!(of(1_234_567)[0], 6_457_827_717_110_365_317);
        assert_ne!(SystemRandomness.next(), SystemRandomness.next());
        let keyed = |seed| Keyed::new(&SeededRandomness::new(seed)).hash_one("a name");
        assert_eq!(keyed(1), keyed(1));
        assert_ne!(keyed(1), keyed(2));
    }
}
