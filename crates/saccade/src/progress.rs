//! Progress on a terminal as a bar, elsewhere as a line now and then.

use std::io::IsTerminal;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use saccade_ingest::{Progress, State};

use crate::report::say;

/// Between lines where there is no terminal.
const LINES: Duration = Duration::from_secs(2);

/// Shows how far some work on tiles is.
pub(crate) struct Shown {
    label: &'static str,
    bar: Option<ProgressBar>,
    /// Tiles there will be, if that is known.
    total: Option<u64>,
    so_far: Mutex<SoFar>,
}

#[derive(Default)]
struct SoFar {
    /// What earlier runs did.
    before: State,
    /// What was told last, with what was before, and when a line was written last.
    last: Option<(Instant, State)>,
}

impl Shown {
    /// Work called `label`, on `total` tiles if that is known.
    pub(crate) fn new(label: &'static str, total: Option<u64>) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template(
                "{prefix} {wide_bar:.cyan/dim} {pos}/{len} tiles {msg}",
            );
            let bar = ProgressBar::new(total.unwrap_or(0));
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.set_prefix(label);
            bar
        });
        Self {
            label,
            bar,
            total,
            so_far: Mutex::default(),
        }
    }

    /// The next run counts from 0 again; here, it goes on.
    pub(crate) fn next_run(&self) {
        let mut so_far = self.so_far();
        if let Some((_, last)) = so_far.last {
            so_far.before = last;
        }
    }

    /// Takes the bar away, and says for good how far the work came.
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        if let Some((_, state)) = self.so_far().last.take() {
            self.line(&state);
        }
    }

    fn so_far(&self) -> MutexGuard<'_, SoFar> {
        self.so_far.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn line(&self, state: &State) {
        say(&format!(
            "{}: {} tiles {}",
            self.label,
            state.tiles,
            facts(state)
        ));
    }
}

impl Progress for Shown {
    fn update(&self, state: &State) {
        let mut so_far = self.so_far();
        let before = so_far.before;
        let state = State {
            tiles: before.tiles + state.tiles,
            pixels: before.pixels + state.pixels,
            quarantined: before.quarantined + state.quarantined,
            ..*state
        };
        if let Some(bar) = &self.bar {
            let known = state.tiles + state.queued + state.waiting;
            bar.set_length(self.total.unwrap_or(0).max(known));
            bar.set_position(state.tiles);
            bar.set_message(facts(&state));
        }
        let now = now();
        let moved = |last: &State| {
            (last.tiles, last.queued, last.waiting) != (state.tiles, state.queued, state.waiting)
        };
        let (written, news) = match &so_far.last {
            Some((at, last)) => (*at, now - *at >= LINES && moved(last)),
            None => (now, true),
        };
        if self.bar.is_none() && news {
            self.line(&state);
        }
        so_far.last = Some((if news { now } else { written }, state));
    }

    fn notice(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say(text)),
            None => say(text),
        }
    }
}

fn facts(state: &State) -> String {
    let mut facts = format!("{:.1} Mpixel/s, queue {}", state.mpixel_per_s, state.queued);
    if state.waiting > 0 {
        facts.push_str(&format!(", {} unfinished", state.waiting));
    }
    if state.quarantined > 0 {
        facts.push_str(&format!(", {} set aside", state.quarantined));
    }
    facts
}

#[expect(clippy::disallowed_methods, reason = "the command line is native only")]
fn now() -> Instant {
    Instant::now()
}
