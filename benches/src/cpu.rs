//! Processor time of this process.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result};

/// Clock ticks per second in `/proc`; a constant of Linux's interface.
const TICKS_PER_SECOND: u64 = 100;

/// Processor time, user and system, of all threads so far.
pub(crate) fn time() -> Result<Duration> {
    let stat = fs::read_to_string("/proc/self/stat").context("processor time needs /proc")?;
    in_time(parse(&stat, OURS))
}

/// The same of all programs that this process started and that have ended.
pub(crate) fn of_children() -> Result<Duration> {
    let stat = fs::read_to_string("/proc/self/stat").context("processor time needs /proc")?;
    in_time(parse(&stat, CHILDREN))
}

/// The same of the thread that asks, to the scheduler's ticks.
pub(crate) fn of_thread() -> Result<Duration> {
    let stat = fs::read_to_string("/proc/thread-self/schedstat")
        .context("a thread's processor time needs /proc")?;
    nanoseconds(&stat)
}

/// The same of all threads that run now, which is finer than [`time`].
pub(crate) fn of_threads() -> Result<Duration> {
    let mut sum = Duration::ZERO;
    for thread in fs::read_dir("/proc/self/task").context("processor time needs /proc")? {
        // One that ends meanwhile counts no more.
        if let Ok(stat) = fs::read_to_string(thread?.path().join("schedstat")) {
            sum += nanoseconds(&stat)?;
        }
    }
    Ok(sum)
}

fn nanoseconds(stat: &str) -> Result<Duration> {
    let spent = stat.split_whitespace().next();
    let spent = spent.and_then(|n| n.parse().ok());
    let spent = spent.context("a thread's schedstat has an unknown form")?;
    Ok(Duration::from_nanos(spent))
}

fn in_time(ticks: Option<u64>) -> Result<Duration> {
    let ticks = ticks.context("/proc/self/stat has an unknown form")?;
    Ok(Duration::from_millis(ticks * 1000 / TICKS_PER_SECOND))
}

/// Fields between the command's name and the times of the process, and those of its children.
const OURS: usize = 11;
const CHILDREN: usize = 13;

/// Sum of a time of the user's and one of the system's, after `skip` fields. They are counted from behind the command's name, which
/// may hold spaces.
fn parse(stat: &str, skip: usize) -> Option<u64> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut fields = fields.split_whitespace().skip(skip);
    let user: u64 = fields.next()?.parse().ok()?;
    let system: u64 = fields.next()?.parse().ok()?;
    Some(user + system)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_sleeps_spends_nothing() {
        let before = of_thread().unwrap();
        std::thread::sleep(Duration::from_millis(60));
        let asleep = of_thread().unwrap() - before;
        assert!(asleep < Duration::from_millis(30), "{asleep:?}");
        let mut sum = 0_u64;
        while of_thread().unwrap() - before < asleep + Duration::from_millis(20) {
            sum = std::hint::black_box(sum + 1);
        }
    }

    #[test]
    fn other_threads_count() {
        let before = of_threads().unwrap();
        let (stop, stopped) = std::sync::mpsc::channel::<()>();
        let busy = std::thread::spawn(move || {
            let mut sum = 0_u64;
            while stopped.try_recv().is_err() {
                sum = std::hint::black_box(sum + 1);
            }
            sum
        });
        while of_threads().unwrap() < before + Duration::from_millis(30) {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(of_thread().unwrap() < Duration::from_secs(5));
        stop.send(()).unwrap();
        busy.join().unwrap();
    }

    #[test]
    fn user_and_system_are_added_whatever_the_command_is_called() {
        let stat = "12 (a ) b) R 1 2 3 4 5 6 7 8 9 10 70 7 0 0 20 0 3 0 99";
        assert_eq!(parse(stat, OURS), Some(77));
        assert_eq!(parse(stat, CHILDREN), Some(0));
        assert_eq!(parse("12 (a) R 1 2", OURS), None);
    }
}
