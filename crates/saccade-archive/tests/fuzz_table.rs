//! The table of parsers and fuzz targets in `fuzz/README.md` is true: it has every target, every target has seeds, and what looks like
//! a parser has a target, or a reason why not.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// What parsers of bytes and texts have in their sources.
const MARKS: [&str; 8] = [
    "serde_json::from_slice",
    "serde_json::from_str",
    "impl FromStr for",
    "fn parse(",
    "fn from_bytes(",
    "fn read_from(",
    "roxmltree::",
    "try_get_u32",
];
/// Targets that have seeds elsewhere, or are made them by their test.
const SEEDS_ELSEWHERE: [&str; 3] = ["image", "image_of_size", "pyramid"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn names(folder: &Path) -> Vec<PathBuf> {
    let mut names: Vec<_> = { fs::read_dir(folder).unwrap() }
        .map(|entry| entry.unwrap().path())
        .collect();
    names.sort();
    names
}

fn sources(folder: &Path, into: &mut Vec<PathBuf>) {
    for path in names(folder) {
        if path.is_dir() {
            sources(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

/// Targets, found as `./dev fuzz` finds them: lines that begin with `("name",`.
fn targets() -> BTreeSet<String> {
    let mut files = Vec::new();
    sources(&root().join("fuzz/src"), &mut files);
    let crates = names(&root().join("crates"));
    files.extend({ crates.iter() }.map(|folder| folder.join("src/fuzz_targets.rs")));
    let texts = files
        .iter()
        .filter_map(|file| fs::read_to_string(file).ok());
    let named = |text: String| -> Vec<String> {
        let of_line = |line: &str| {
            Some(
                line.strip_prefix("    (\"")?
                    .split_once("\",")?
                    .0
                    .to_owned(),
            )
        };
        text.lines().filter_map(of_line).collect()
    };
    texts.flat_map(named).collect()
}

/// What stands between backticks.
fn quoted(text: &str) -> impl Iterator<Item = String> {
    text.split('`').skip(1).step_by(2).map(str::to_owned)
}

/// Rows of the tables under a heading, as cells.
fn rows(heading: &str) -> Vec<Vec<String>> {
    let text = fs::read_to_string(root().join("fuzz/README.md")).unwrap();
    let (_, below) = text.split_once(heading).unwrap();
    let below = below.split("\n## ").next().unwrap();
    let rows = below.lines().filter(|line| line.starts_with("| `"));
    let cells = |line: &str| {
        line.trim_matches('|')
            .split('|')
            .map(str::to_owned)
            .collect()
    };
    rows.map(cells).collect()
}

/// What is in the lists but not there, and what is there but in no list.
fn untrue(listed: &BTreeSet<String>, there: &BTreeSet<String>) -> (Vec<String>, Vec<String>) {
    let only = |a: &BTreeSet<String>, b: &BTreeSet<String>| a.difference(b).cloned().collect();
    (only(listed, there), only(there, listed))
}

#[test]
fn every_target_is_in_the_table_and_has_seeds() {
    let targets = targets();
    assert!(targets.len() > 50, "{targets:?}");
    let table = rows("## Parsers and targets");
    let listed: BTreeSet<String> = table.iter().flat_map(|row| quoted(&row[0])).collect();
    assert_eq!(
        untrue(&listed, &targets),
        (vec![], vec![]),
        "in the table, of the targets"
    );
    let folders = names(&root().join("fuzz/seeds"));
    let seeds = folders.iter().filter(|folder| !names(folder).is_empty());
    let seeds = seeds.map(|folder| folder.file_name().unwrap().to_str().unwrap().to_owned());
    let seeds: BTreeSet<String> = seeds.chain(SEEDS_ELSEWHERE.map(str::to_owned)).collect();
    assert_eq!(
        untrue(&seeds, &targets),
        (vec![], vec![]),
        "seeds, of the targets"
    );
    // A target that is forgotten in a list would be told.
    let mut fewer = targets.clone();
    fewer.pop_first();
    assert_ne!(untrue(&fewer, &targets), (vec![], vec![]));
}

#[test]
fn what_looks_like_a_parser_has_a_target_or_a_reason() {
    let with = rows("## Parsers and targets");
    let without = rows("## Without a target");
    let with = with.iter().flat_map(|row| quoted(&row[2]));
    let listed: BTreeSet<String> = with
        .chain(without.iter().flat_map(|row| quoted(&row[0])))
        .collect();
    let crates = root().join("crates");
    for file in &listed {
        assert!(crates.join(file).is_file(), "there is no {file}");
    }
    let mut files = Vec::new();
    for folder in names(&crates) {
        sources(&folder.join("src"), &mut files);
    }
    let mut marked = BTreeSet::new();
    for file in files {
        let name = file
            .strip_prefix(&crates)
            .unwrap()
            .to_str()
            .unwrap()
            .to_owned();
        let text = fs::read_to_string(&file).unwrap();
        let code = text.split("#[cfg(test)]\nmod tests").next().unwrap();
        let is_test = name.contains("tests") || name.contains("fuzz_targets");
        if !is_test && MARKS.iter().any(|mark| code.contains(mark)) {
            marked.insert(name);
        }
    }
    assert!(marked.len() > 20, "{marked:?}");
    let (_, forgotten) = untrue(&listed, &marked);
    assert_eq!(forgotten, [""; 0], "not in fuzz/README.md");
}
