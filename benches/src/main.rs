//! Measures Saccade: one row per figure, as a table and as JSON.
//!
//! A row has an id that never changes its meaning, the median of its runs, the figure of a peer
//! where one is published, the settings and the machine. The rows use the product's own crates
//! as any program would; nothing in them exists for the benchmark.
#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a program that reports to its terminal"
)]

mod baselines;
mod bricks;
mod clock;
mod cpu;
mod dense;
mod machine;
mod memory;
mod plot;
mod report;
mod rows;
mod scene;
mod settings;
mod shader;
mod volumes;

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Parser;

use crate::report::Report;
use crate::settings::Settings;
use crate::volumes::Scale;

/// Measure Saccade.
#[derive(Parser)]
struct Arguments {
    /// Also write the rows to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the plots of the papers' figures into this folder.
    #[arg(long, value_name = "FOLDER")]
    plots: Option<PathBuf>,
    /// Size of the volumes and pictures of the papers' tables and figures. Without, as published where a GPU draws, and
    /// small where a processor does.
    #[arg(long, value_enum)]
    scale: Option<Scale>,
    /// An image for the rows of `render.image.`: a folder or address of OME-Zarr or precomputed voxels, 8 or 16 bit.
    #[arg(long, value_name = "PLACE")]
    image: Option<String>,
    /// Rows to measure, by id, or by the beginning of ids up to a dot; all when none is named.
    #[arg(value_name = "ID")]
    ids: Vec<String>,
}

fn main() -> Result<()> {
    if let Some(done) = rows::worker().or_else(rows::attack) {
        return done;
    }
    let arguments = Arguments::parse();
    let wanted = wanted(&arguments.ids)?;
    let settings = Settings {
        ids: arguments.ids,
        plots: arguments.plots,
        scale: arguments.scale,
        image: arguments.image,
    };
    let mut report = Report::new(machine::Machine::here());
    for group in wanted {
        eprintln!("measuring {} ...", group.ids.join(", "));
        let rows =
            (group.measure)(&settings).with_context(|| format!("measuring {}", group.ids[0]))?;
        report.add(rows);
        if let Some(file) = &arguments.json {
            fs::write(file, report.json()?)
                .with_context(|| format!("cannot write {}", file.display()))?;
        }
    }
    println!("{report}");
    Ok(())
}

/// The groups with at least one of the rows asked for.
fn wanted(ids: &[String]) -> Result<Vec<&'static rows::Group>> {
    let known: Vec<&str> = rows::GROUPS.iter().flat_map(|g| g.ids).copied().collect();
    let unknown = |wanted: &&String| !known.iter().any(|id| settings::names(wanted, id));
    if let Some(unknown) = ids.iter().find(unknown) {
        bail!(
            "there is no row {unknown:?}; the rows are {}",
            known.join(", ")
        );
    }
    let all = ids.is_empty();
    let groups = rows::GROUPS.iter();
    Ok(groups
        .filter(|g| {
            all || g
                .ids
                .iter()
                .any(|id| ids.iter().any(|w| settings::names(w, id)))
        })
        .collect())
}
