//! The one place that tells what went wrong.

use std::io::Write;
use std::process::ExitCode;

use log::{LevelFilter, Log, Metadata, Record};

/// Prints an error and its causes, once each.
pub(crate) fn failed(error: &anyhow::Error) -> ExitCode {
    let mut lines: Vec<String> = Vec::new();
    for cause in error.chain().map(ToString::to_string) {
        // Some libraries repeat their cause in their own message.
        if !lines.iter().any(|line| line.contains(&cause)) {
            lines.push(cause);
        }
    }
    say(&format!("error: {}", lines.join("\n  because: ")));
    ExitCode::FAILURE
}

/// Writes a line to standard error. Where nobody reads it, nothing is lost.
pub(crate) fn say(line: &str) {
    drop(writeln!(std::io::stderr(), "{line}"));
}

/// Writes a line of results to standard output.
pub(crate) fn tell(line: &str) {
    drop(writeln!(std::io::stdout(), "{line}"));
}

/// Shows the warnings of our crates. `SACCADE_LOG=debug`, or another level, shows those of all.
pub(crate) fn log_to_stderr() {
    let asked = std::env::var("SACCADE_LOG")
        .ok()
        .and_then(|level| level.parse().ok());
    log::set_max_level(asked.unwrap_or(LevelFilter::Warn));
    let logger = Box::new(StandardError {
        all: asked.is_some(),
    });
    // Fails only if there is a logger already: then that one speaks.
    drop(log::set_boxed_logger(logger));
}

struct StandardError {
    /// Whether others than our crates are heard: drivers complain of much that is harmless.
    all: bool,
}

impl Log for StandardError {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        self.all || metadata.target().starts_with("saccade")
    }

    fn log(&self, record: &Record<'_>) {
        if self.enabled(record.metadata()) {
            let level = record.level().as_str().to_lowercase();
            say(&format!("{level}: {}", record.args()));
        }
    }

    fn flush(&self) {}
}
