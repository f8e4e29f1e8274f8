//! Resident memory of this process.

use std::fs;

use anyhow::{Context, Result};

/// Forgets the highest so far; what is resident now \[bytes\].
pub(crate) fn reset_peak() -> Result<u64> {
    // Documented in proc(5): 5 resets the peak.
    fs::write("/proc/self/clear_refs", "5").context("peaks of memory need Linux's /proc")?;
    resident()
}

/// What is resident now \[bytes\].
pub(crate) fn resident() -> Result<u64> {
    of("VmRSS")
}

/// The highest since the last reset \[bytes\].
pub(crate) fn peak() -> Result<u64> {
    of("VmHWM")
}

fn of(key: &str) -> Result<u64> {
    let status = fs::read_to_string("/proc/self/status")?;
    parse(&status, key).with_context(|| format!("/proc/self/status has no {key}"))
}

fn parse(status: &str, key: &str) -> Option<u64> {
    let value = status
        .lines()
        .find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    let kib: u64 = value.trim().strip_suffix(" kB")?.parse().ok()?;
    Some(kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kibibytes_become_bytes() {
        let status = "Name:\tx\nVmHWM:\t  12 kB\nVmRSS:\t 7 kB\n";
        assert_eq!(parse(status, "VmHWM"), Some(12 << 10));
        assert_eq!(parse(status, "VmRSS"), Some(7 << 10));
        assert_eq!(parse(status, "Vm"), None);
    }

    #[test]
    fn a_peak_stays_until_it_is_reset() {
        // Much more than the other tests, which run meanwhile, take and give back.
        const TAKEN: usize = 512 << 20;
        let half = TAKEN as u64 / 2;
        let before = reset_peak().unwrap();
        assert!(resident().unwrap() <= peak().unwrap());
        drop(std::hint::black_box(vec![1_u8; TAKEN]));
        assert!(peak().unwrap() >= before + half);
        assert!(reset_peak().unwrap() < before + half);
        assert!(peak().unwrap() < before + half);
    }
}
