use std::collections::VecDeque;
use std::time::Duration;

/// How far some work on tiles is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct State {
    /// Tiles done since the work began.
    pub tiles: u64,
    /// Their pixels.
    pub pixels: u64,
    /// Tiles or records still to do; estimated where counting would mean reading everything.
    pub queued: u64,
    /// Tiles whose file is not whole yet.
    pub waiting: u64,
    /// Files and records put in quarantine since the work began, without those that were mended since.
    pub quarantined: u64,
    /// Pixels per second, over the last seconds \[Mpixel/s\].
    pub mpixel_per_s: f64,
}

/// Hears of progress. Must not block; called from the task that works.
pub trait Progress: Send + Sync {
    /// The work is that far.
    fn update(&self, state: &State);

    /// Something a person should know: a file in quarantine, a full disk.
    fn notice(&self, text: &str);

    /// Why the work does not go on, for as long as it does not: told again with each failure, and `None` once it
    /// goes on.
    fn held_up(&self, _why: Option<&str>) {}
}

/// Tells nobody.
impl Progress for () {
    fn update(&self, _: &State) {}
    fn notice(&self, _: &str) {}
}

/// Measures a rate over a sliding window. It is told how late it is, by a
/// [`Clock`](saccade_archive::clock::Clock)'s monotonic time.
#[derive(Debug)]
pub struct Meter {
    window: Duration,
    begin: Duration,
    /// When how many pixels were done in all.
    marks: VecDeque<(Duration, u64)>,
    pixels: u64,
}

impl Meter {
    /// Measures over the last ten seconds, from `begin` on.
    pub fn new(begin: Duration) -> Self {
        let marks = VecDeque::from([(begin, 0)]);
        Self {
            window: Duration::from_secs(10),
            begin,
            marks,
            pixels: 0,
        }
    }

    /// Pixels were done just now.
    pub fn add(&mut self, now: Duration, pixels: u64) {
        self.pixels += pixels;
        self.marks.push_back((now, self.pixels));
        // The last mark before the window stays: the window's first interval begins there.
        while self
            .marks
            .get(1)
            .is_some_and(|(at, _)| now.saturating_sub(*at) > self.window)
        {
            self.marks.pop_front();
        }
    }

    /// Pixels done since the meter exists.
    pub fn pixels(&self) -> u64 {
        self.pixels
    }

    /// Time since the meter exists.
    pub fn elapsed(&self, now: Duration) -> Duration {
        now.saturating_sub(self.begin)
    }

    /// The rate \[Mpixel/s\]; falls to 0 when nothing happens.
    pub fn mpixel_per_s(&self, now: Duration) -> f64 {
        let (since, before) = self.marks.front().copied().unwrap_or((self.begin, 0));
        let seconds = now.saturating_sub(since).as_secs_f64();
        if seconds > 0.0 {
            (self.pixels - before) as f64 / 1e6 / seconds
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_that_of_the_last_seconds() {
        let at = |second: u64| Duration::from_secs(1000 + second);
        let mut meter = Meter::new(at(0));
        assert_eq!(meter.mpixel_per_s(at(0)), 0.0);
        for second in 1..=60 {
            meter.add(at(second), 8_000_000);
        }
        let rate = meter.mpixel_per_s(at(60));
        assert!((rate - 8.0).abs() < 0.01, "{rate}");
        for second in 61..=120 {
            meter.add(at(second), 2_000_000);
        }
        let rate = meter.mpixel_per_s(at(120));
        assert!((rate - 2.0).abs() < 0.01, "{rate}");
        assert!(
            meter.mpixel_per_s(at(1120)) < 0.1,
            "nothing happened for long"
        );
        assert_eq!(meter.pixels(), 600_000_000);
    }
}
