//! Watching a folder of ten million files: what a look costs, and how soon a new file is found.
//!
//! The files are hard links to one empty file a section, since only names and times are asked for; they are made once and kept.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use saccade_ingest::watch::{Disk, Next, Pattern, Scanner, WatchConfig};

use super::index::{cache_folder, resident};
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::Random;
use crate::settings::Settings;
use crate::volumes::Scale;

pub(crate) const IDS: &[&str] = &[
    "watch.round_ms",
    "watch.found_s",
    "watch.first_round_s",
    "watch.bytes_per_file",
];

/// Files of a section.
const FILES: u32 = 500;
const COLUMNS: u32 = 25;
const PATTERN: &str = "s{section}/r{row}_c{column}.tif";
/// Rounds through folders in which nothing is new.
const ROUNDS: usize = 21;
/// Files that come in afterwards.
const NEW: usize = 7;

pub(crate) fn measure(settings: &Settings) -> Result<Vec<Row>> {
    let sections = match settings.scale {
        Some(Scale::Small) => 2_000,
        _ => 20_000,
    };
    let root = folder(sections)?;
    let files = u64::from(sections * FILES);
    let before = resident()?;
    let pattern: Pattern = PATTERN.parse().context("the pattern of the row")?;
    let mut scanner = Scanner::new(Disk, &root, pattern);

    let first = Stopwatch::start();
    let (mut found, mut longest) = (0_u64, Duration::ZERO);
    loop {
        let look = Stopwatch::start();
        let (new, next) = scanner.look(WatchConfig::BUDGET)?;
        longest = longest.max(look.elapsed());
        found += new.len() as u64;
        if next != Next::More {
            break;
        }
    }
    let first_round = first.elapsed();
    ensure!(found == files, "{found} of {files} files are found");
    let bytes = (resident()? - before) as f64 / files as f64;

    // Until nothing has changed so lately that it is looked at again.
    while scanner.look(WatchConfig::BUDGET)?.1 != Next::Rest {}
    let mut rounds = Vec::new();
    for _ in 0..ROUNDS {
        let round = Stopwatch::start();
        loop {
            let (new, next) = scanner.look(WatchConfig::BUDGET)?;
            ensure!(new.is_empty(), "nothing is new, but {new:?}");
            if next == Next::Rest {
                break;
            }
        }
        rounds.push(round.elapsed().as_secs_f64() * 1e3);
    }

    let mut random = Random(88_172_645_463_325_252);
    let mut seconds = Vec::new();
    for n in 0..NEW {
        let file = name(random.below(sections), FILES + u32::try_from(n)?);
        fs::write(root.join(&file), b"")?;
        let begun = Stopwatch::start();
        let found = look_for(&mut scanner, &file);
        seconds.push(begun.elapsed().as_secs_f64());
        fs::remove_file(root.join(&file))?;
        found?;
    }

    let rows = [
        Row::new(IDS[0], "ms", rounds).setting(
            "round",
            format!(
                "each folder is asked once, by looks of at most {} questions; nothing is new",
                WatchConfig::BUDGET
            ),
        ),
        Row::new(IDS[1], "s", seconds)
            .setting("from", "a file is there in a random section")
            .setting("looks", "one after the other, without a pause"),
        Row::new(IDS[2], "s", vec![first_round.as_secs_f64()]).setting(
            "longest look",
            format!("{:.0} ms", longest.as_secs_f64() * 1e3),
        ),
        Row::new(IDS[3], "bytes", vec![bytes])
            .setting("counted", "what the process grows by in the first round"),
    ];
    let folder = format!(
        "{files} files in {sections} folders on a local disk, what is known of them in the system's cache"
    );
    Ok(rows.map(|row| row.setting("folder", folder.clone())).into())
}

/// Looks until a file is found.
fn look_for(scanner: &mut Scanner<Disk>, file: &str) -> Result<()> {
    let begun = Stopwatch::start();
    while begun.elapsed() < Duration::from_secs(60) {
        let (new, _) = scanner.look(WatchConfig::BUDGET)?;
        if new.iter().any(|found| found.file == file) {
            return Ok(());
        }
    }
    bail!("{file} is not found in a minute")
}

fn name(section: u32, n: u32) -> String {
    let (row, column) = (n / COLUMNS, n % COLUMNS);
    format!("s{section:05}/r{row:03}_c{column:03}.tif")
}

/// The folder, made where it is not there.
fn folder(sections: u32) -> Result<PathBuf> {
    let folder = cache_folder()?.join(format!("bench/watched-{sections}-1"));
    if folder.is_dir() {
        return Ok(folder);
    }
    let unfinished = folder.with_extension("unfinished");
    let _ = fs::remove_dir_all(&unfinished);
    for section in 0..sections {
        let first = unfinished.join(name(section, 0));
        fs::create_dir_all(first.parent().context("a section has a folder")?)?;
        fs::write(&first, b"")?;
        for n in 1..FILES {
            fs::hard_link(&first, unfinished.join(name(section, n)))?;
        }
    }
    // What is old is not looked at again, as with folders that were written by and by.
    std::thread::sleep(Duration::from_secs(35));
    fs::rename(&unfinished, &folder)?;
    Ok(folder)
}
