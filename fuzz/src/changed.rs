//! Seeds, and seeds changed at random, for tests that run the fuzz targets.
//!
//! Every run of one seed number is the same. `SACCADE_FUZZ_SEED` chooses it, and a failure names it.

use std::fs;
use std::panic::catch_unwind;
use std::path::Path;

/// Runs a target on its seeds, and on so many that were changed.
///
/// # Panics
///
/// With the input that it does not survive, and where it has no seeds.
pub fn survives(name: &str, target: fn(&[u8]), seeds: &[Vec<u8>], inputs: u32) {
    assert!(!seeds.is_empty(), "{name} has no seeds");
    let survived = |bytes: &[u8], which: String| {
        let survived = catch_unwind(|| target(bytes)).is_ok();
        let bytes = bytes.escape_ascii();
        assert!(survived, "target {name}, {which}: \"{bytes}\"");
    };
    for (n, bytes) in seeds.iter().enumerate() {
        survived(bytes, format!("seed {n} by name"));
    }
    let seed: u64 = std::env::var("SACCADE_FUZZ_SEED").map_or(1, |s| s.parse().expect("a number"));
    let mut random = Random::new(seed);
    for n in 0..inputs {
        let bytes = changed(seeds, &mut random);
        survived(&bytes, format!("SACCADE_FUZZ_SEED={seed}, input {n}"));
    }
}

/// The same numbers for the same seed.
pub struct Random(u64);

impl Random {
    /// Of a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, most: usize) -> usize {
        (self.next() >> 16) as usize % most.max(1)
    }
}

/// Files of a folder, sorted by name, but for scripts.
pub fn files(folder: &Path) -> Vec<Vec<u8>> {
    let Ok(entries) = fs::read_dir(folder) else {
        return Vec::new();
    };
    let mut paths: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    paths.sort();
    paths.retain(|path| path.extension().is_none_or(|e| e != "py"));
    paths.iter().map(|path| fs::read(path).unwrap()).collect()
}

/// A seed with some bytes changed, pieces repeated or cut out, numbers made large, or two joined.
pub fn changed(seeds: &[Vec<u8>], random: &mut Random) -> Vec<u8> {
    let mut bytes = seeds[random.below(seeds.len())].clone();
    for _ in 0..=random.below(6) {
        let at = random.below(bytes.len());
        match random.below(7) {
            0 | 1 if !bytes.is_empty() => bytes[at] = random.next().to_le_bytes()[0],
            2 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
            3 => {
                let end = (at + random.below(16)).min(bytes.len());
                bytes.drain(at..end);
            }
            4 => {
                let end = (at + random.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece);
            }
            5 => {
                let large = [0xff, 0x7f, 0x00, b'9'][random.below(4)];
                let end = (at + 1 + random.below(8)).min(bytes.len());
                bytes[at..end].fill(large);
            }
            _ => {
                let other = &seeds[random.below(seeds.len())];
                bytes.truncate(at);
                bytes.extend_from_slice(&other[random.below(other.len())..]);
            }
        }
    }
    bytes
}
