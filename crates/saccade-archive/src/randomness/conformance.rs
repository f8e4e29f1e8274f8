//! What every [`Randomness`] must do.

use std::collections::BTreeSet;

use super::Randomness;

/// Numbers that are looked at.
const NUMBERS: u32 = 2_000;

/// Checks numbers as far as numbers show that: none comes twice, and each bit is set half of the time, also where the one before was.
///
/// # Panics
///
/// If the randomness breaks its contract: this is a test.
pub fn check(randomness: &dyn Randomness) {
    let numbers: Vec<u64> = (0..NUMBERS).map(|_| randomness.next()).collect();
    let different: BTreeSet<&u64> = numbers.iter().collect();
    assert_eq!(different.len(), numbers.len(), "a number came twice");
    // Nine standard deviations of a fair coin.
    let half = NUMBERS / 2 - 200..=NUMBERS / 2 + 200;
    let changed = numbers.windows(2).map(|pair| pair[0] ^ pair[1]);
    for (what, all) in [("set", numbers.clone()), ("another", changed.collect())] {
        for bit in 0..u64::BITS {
            let ones = all.iter().map(|number| (number >> bit & 1) as u32);
            let ones = ones.sum::<u32>();
            assert!(
                half.contains(&ones),
                "bit {bit} is {what} {ones} times of {NUMBERS}"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::super::{SeededRandomness, SystemRandomness};
    use super::*;

    #[test]
    fn the_machines_and_a_seeds_conform() {
        check(&SystemRandomness);
        for seed in [0, 1, u64::MAX] {
            check(&SeededRandomness::new(seed));
        }
    }

    /// Counts, by steps of its own.
    #[derive(Debug)]
    struct Counted(AtomicU64, u64);

    impl Randomness for Counted {
        fn next(&self) -> u64 {
            self.0.fetch_add(self.1, Ordering::Relaxed)
        }
    }

    #[test]
    fn what_can_be_foreseen_is_noticed() {
        for step in [0, 1, 0x0101_0101_0101_0101, 1 << 63] {
            let counted = AssertUnwindSafe(Counted(AtomicU64::new(7), step));
            assert!(catch_unwind(|| check(&*counted)).is_err(), "{step}");
        }
    }
}
