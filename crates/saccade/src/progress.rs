//! Progress on a terminal as a bar, elsewhere as a line now and then.

use std::io::IsTerminal;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use saccade_ingest::{Progress, State};

use crate::report::say;

/// Between lines where there is no terminal.
const LINES: Duration = Duration::from_secs(2);

/// Between looks whether a line is due: a single tile may take long.
const LOOKS: Duration = Duration::from_millis(200);

/// Shows how far some work on tiles is.
pub(crate) struct Shown(Arc<Inner>);

struct Inner {
    label: &'static str,
    bar: Option<ProgressBar>,
    so_far: Mutex<SoFar>,
}

struct SoFar {
    /// Tiles there will be, if that is known.
    total: Option<u64>,
    /// What earlier runs did.
    before: State,
    /// What was told last, with what was before.
    state: Option<State>,
    /// Why it does not go on.
    held_up: Option<String>,
    lines: Lines,
    /// Why it did not go on when the last line was written.
    told: Option<String>,
}

/// When to write a line: at once, then every [`LINES`] while there is something to do, or news. What holds all up
/// is told once, until it is something else.
#[derive(Default)]
struct Lines {
    last: Option<(Instant, State)>,
}

impl Lines {
    /// Whether to write one now; if so, it counts as written.
    fn due(&mut self, now: Instant, state: &State, busy: bool) -> bool {
        let counts = |state: &State| (state.tiles, state.queued, state.waiting, state.quarantined);
        let due = match &self.last {
            None => true,
            Some((at, last)) => now - *at >= LINES && (busy || counts(last) != counts(state)),
        };
        if due {
            self.last = Some((now, *state));
        }
        due
    }
}

impl Shown {
    /// Work called `label`, on `total` tiles if that is known. Within a runtime: it keeps an eye on
    /// the clock.
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
        let so_far = Mutex::new(SoFar {
            total,
            before: State::default(),
            state: None,
            held_up: None,
            lines: Lines::default(),
            told: None,
        });
        let inner = Arc::new(Inner { label, bar, so_far });
        if inner.bar.is_none() {
            tokio::spawn(keep_telling(Arc::downgrade(&inner)));
        }
        Self(inner)
    }

    /// The next run counts from 0 again; here, it goes on.
    pub(crate) fn next_run(&self) {
        let mut so_far = self.0.so_far();
        if let Some(state) = so_far.state {
            so_far.before = state;
        }
    }

    /// Takes the bar away, and says for good how far the work came.
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.0.bar {
            bar.finish_and_clear();
        }
        let mut so_far = self.0.so_far();
        if let Some(state) = so_far.state.take() {
            self.0.line(&state, &so_far);
        }
    }
}

/// Writes lines as long as somebody works.
async fn keep_telling(inner: Weak<Inner>) {
    loop {
        tokio::time::sleep(LOOKS).await;
        let Some(inner) = inner.upgrade() else {
            return;
        };
        inner.look();
    }
}

impl Inner {
    fn so_far(&self) -> MutexGuard<'_, SoFar> {
        self.so_far.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes a line if one is due.
    fn look(&self) {
        let mut so_far = self.so_far();
        let (Some(state), None) = (so_far.state, &self.bar) else {
            return;
        };
        let busy = match so_far.held_up {
            Some(_) => so_far.held_up != so_far.told,
            None => state.tiles + state.quarantined < known(&state, so_far.total),
        };
        if so_far.lines.due(now(), &state, busy) {
            so_far.told = so_far.held_up.clone();
            self.line(&state, &so_far);
        }
    }

    fn line(&self, state: &State, so_far: &SoFar) {
        let why = so_far.held_up.as_deref();
        say(&line(self.label, state, so_far.total, why));
    }
}

impl Progress for Shown {
    fn update(&self, state: &State) {
        let mut so_far = self.0.so_far();
        let before = so_far.before;
        let state = State {
            tiles: before.tiles + state.tiles,
            pixels: before.pixels + state.pixels,
            quarantined: before.quarantined + state.quarantined,
            ..*state
        };
        if let Some(bar) = &self.0.bar {
            bar.set_length(known(&state, so_far.total));
            bar.set_position(state.tiles);
            bar.set_message(facts(&state, so_far.held_up.as_deref()));
        }
        so_far.state = Some(state);
        drop(so_far);
        self.0.look();
    }

    fn held_up(&self, why: Option<&str>) {
        let mut so_far = self.0.so_far();
        so_far.held_up = why.map(str::to_owned);
        // Nothing is told while nothing is done.
        let state = *so_far.state.get_or_insert_default();
        if let Some(bar) = &self.0.bar {
            bar.set_message(facts(&state, why));
        }
        drop(so_far);
        self.0.look();
    }

    fn notice(&self, text: &str) {
        match &self.0.bar {
            Some(bar) => bar.suspend(|| say(text)),
            None => say(text),
        }
    }
}

/// Tiles there will be, as far as anybody knows.
fn known(state: &State, total: Option<u64>) -> u64 {
    let seen = state.tiles + state.queued + state.waiting + state.quarantined;
    total.unwrap_or(0).max(seen)
}

fn line(label: &str, state: &State, total: Option<u64>, held_up: Option<&str>) -> String {
    let (tiles, known) = (state.tiles, known(state, total));
    format!(
        "{label}: {tiles} of {known} tiles, {}",
        facts(state, held_up)
    )
}

fn facts(state: &State, held_up: Option<&str>) -> String {
    let mut facts = format!("{:.1} Mpixel/s, queue {}", state.mpixel_per_s, state.queued);
    if state.waiting > 0 {
        facts.push_str(&format!(", {} unfinished", state.waiting));
    }
    if state.quarantined > 0 {
        facts.push_str(&format!(", {} set aside", state.quarantined));
    }
    if let Some(why) = held_up {
        facts.push_str(&format!("; waits: {why}"));
    }
    facts
}

#[expect(clippy::disallowed_methods, reason = "the command line is native only")]
fn now() -> Instant {
    Instant::now()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(tiles: u64, queued: u64) -> State {
        State {
            tiles,
            queued,
            mpixel_per_s: 2.5,
            ..State::default()
        }
    }

    #[test]
    fn a_line_comes_at_once_and_then_at_least_every_two_seconds() {
        let begin = now();
        // One tile takes a minute, and nobody hears of it.
        let (mut lines, mut written) = (Lines::default(), Vec::new());
        for ms in (0..60_000).step_by(200) {
            let at = begin + Duration::from_millis(ms);
            if lines.due(at, &state(0, 1), true) {
                written.push(ms);
            }
        }
        assert_eq!(written.first(), Some(&0));
        assert!(written.windows(2).all(|pair| pair[1] - pair[0] == 2000));
        assert_eq!(written.len(), 30);

        // Nothing to do: silence, until there is news.
        let at = |s| begin + Duration::from_secs(s);
        assert!(!lines.due(at(900), &state(0, 1), false));
        assert!(lines.due(at(901), &state(1, 0), false));
        assert!(!lines.due(at(902), &state(2, 0), true), "not yet again");
    }

    #[test]
    fn lines_name_the_total() {
        let said = line("demo", &state(12, 5), Some(340), None);
        assert_eq!(said, "demo: 12 of 340 tiles, 2.5 Mpixel/s, queue 5");
        let said = line("ingest", &state(12, 5), None, None);
        assert!(said.starts_with("ingest: 12 of 17 tiles"), "{said}");
        let said = line("ingest", &state(12, 5), None, Some("no space is left"));
        assert!(said.ends_with("queue 5; waits: no space is left"), "{said}");
    }
}
