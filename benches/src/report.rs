//! Rows and how they are shown.

use std::fmt;

use anyhow::Result;
use serde::Serialize;
use serde_json::{Map, Value};

use crate::machine::Machine;

/// One figure.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Row {
    id: &'static str,
    /// Median of `runs`.
    value: f64,
    unit: &'static str,
    runs: Vec<f64>,
    peer: Option<Peer>,
    settings: Map<String, Value>,
    /// Filled in by the report.
    machine: Option<Machine>,
}

/// The same figure of another system, as published.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Peer {
    pub(crate) value: f64,
    /// Who, on what, and what differs.
    pub(crate) what: &'static str,
}

impl Row {
    /// A row of at least one run.
    pub(crate) fn new(id: &'static str, unit: &'static str, runs: Vec<f64>) -> Self {
        Self {
            id,
            value: median(&runs),
            unit,
            runs,
            peer: None,
            settings: Map::new(),
            machine: None,
        }
    }

    /// Median of its runs.
    pub(crate) fn value(&self) -> f64 {
        self.value
    }

    /// With these runs instead.
    pub(crate) fn with_runs(self, runs: Vec<f64>) -> Self {
        let value = median(&runs);
        Self {
            value,
            runs,
            ..self
        }
    }

    pub(crate) fn peer(mut self, value: f64, what: &'static str) -> Self {
        self.peer = Some(Peer { value, what });
        self
    }

    pub(crate) fn setting(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.settings.insert(name.to_owned(), value.into());
        self
    }
}

/// Middle of the sorted values; of an even number the mean of the two in the middle.
fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let (low, high) = (sorted.len().saturating_sub(1) / 2, sorted.len() / 2);
    match (sorted.get(low), sorted.get(high)) {
        (Some(a), Some(b)) => (a + b) / 2.0,
        _ => f64::NAN,
    }
}

/// All rows of one invocation.
pub(crate) struct Report {
    machine: Machine,
    rows: Vec<Row>,
}

impl Report {
    pub(crate) fn new(machine: Machine) -> Self {
        Self {
            machine,
            rows: Vec::new(),
        }
    }

    pub(crate) fn add(&mut self, rows: Vec<Row>) {
        let machine = Some(self.machine.clone());
        self.rows.extend(rows.into_iter().map(|row| Row {
            machine: machine.clone(),
            ..row
        }));
    }

    /// A list of rows.
    pub(crate) fn json(&self) -> Result<String> {
        Ok(serde_json::to_string_pretty(&self.rows)? + "\n")
    }
}

/// Markdown, so that it can be kept in the documentation.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}\n", self.machine)?;
        writeln!(
            f,
            "| id | value | unit | runs | peer |\n|---|---|---|---|---|"
        )?;
        for row in &self.rows {
            let runs: Vec<String> = row.runs.iter().map(|v| figure(*v)).collect();
            let peer = row.peer.as_ref().map_or(String::new(), |p| {
                format!("{} ({})", figure(p.value), p.what)
            });
            let Row { id, unit, .. } = row;
            writeln!(
                f,
                "| `{id}` | {} | {unit} | {} | {peer} |",
                figure(row.value),
                runs.join(", ")
            )?;
        }
        for row in &self.rows {
            write!(f, "\n`{}`:", row.id)?;
            for (at, (name, value)) in row.settings.iter().enumerate() {
                let value = value
                    .as_str()
                    .map_or_else(|| value.to_string(), str::to_owned);
                write!(f, "{} {name} {value}", if at == 0 { "" } else { "," })?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

/// Three significant digits.
fn figure(value: f64) -> String {
    let digits = if value.abs() >= 100.0 {
        0
    } else if value.abs() >= 10.0 {
        1
    } else {
        2
    };
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians() {
        assert!((median(&[3.0, 1.0, 2.0]) - 2.0).abs() < 1e-12);
        assert!((median(&[4.0, 1.0, 2.0, 3.0]) - 2.5).abs() < 1e-12);
        assert!(median(&[]).is_nan());
    }

    #[test]
    fn figures_have_three_digits() {
        assert_eq!(
            [figure(1234.5), figure(45.67), figure(0.519)],
            ["1234", "45.7", "0.52"]
        );
    }
}
