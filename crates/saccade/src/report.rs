//! The one place that tells what went wrong.

use std::io::Write;
use std::process::ExitCode;

use log::{LevelFilter, Log, Metadata, Record};

/// Prints an error and its causes, once each.
pub(crate) fn failed(error: &anyhow::Error) -> ExitCode {
    let mut lines: Vec<String> = Vec::new();
    for cause in error.chain().map(|cause| in_words(&cause.to_string())) {
        // Some libraries repeat their cause in their own message.
        if !lines.iter().any(|line| line.contains(&cause)) {
            lines.push(cause);
        }
    }
    say(&format!("error: {}", lines.join("\n  because: ")));
    ExitCode::FAILURE
}

/// The same, without the XML in which object stores say what is wrong.
fn in_words(cause: &str) -> String {
    let Some((before, xml)) = cause.split_once("<Error>") else {
        return cause.to_owned();
    };
    let before = before
        .rsplit_once("<?xml")
        .map_or(before, |(before, _)| before);
    let text = |tag: &str| {
        let (_, rest) = xml.split_once(&format!("<{tag}>"))?;
        Some(rest.split_once("</")?.0.trim())
    };
    let said: Vec<&str> = [text("Code"), text("Message")]
        .into_iter()
        .flatten()
        .collect();
    match said.is_empty() {
        true => cause.to_owned(),
        false => format!("{}{}", before, said.join(": ")),
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stores_say_in_xml_is_told_in_words() {
        for (cause, told) in [
            (
                "404 Not Found: <?xml version=\"1.0\"?>\n<Error><Code>NoSuchBucket</Code><Message>There is none</Message></Error>",
                "404 Not Found: NoSuchBucket: There is none",
            ),
            (
                "403: <Error><Code>AccessDenied</Code></Error>",
                "403: AccessDenied",
            ),
            ("no <Error> of theirs", "no <Error> of theirs"),
            ("plain", "plain"),
        ] {
            assert_eq!(in_words(cause), told);
        }
    }
}
