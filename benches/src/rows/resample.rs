//! The arithmetic of stitching alone, beside OpenCV's.
//!
//! The same work: one image, an affine map, bilinear interpolation, 8 bit, one thread. Both are timed by their own processor
//! time, turn by turn, and both pictures compared with what exact arithmetic makes of the map.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use glam::{DVec2, UVec2};
use saccade_source::stitched::{Interpolation, Patch};
use serde::Deserialize;

use crate::cpu;
use crate::report::Row;
use crate::scene::tissue;

pub(crate) const IDS: &[&str] = &[
    "resample.vs_warpaffine",
    "resample.translation.vs_warpaffine",
    "resample.mpix_per_core_s",
    "resample.translation.mpix_per_core_s",
];

/// Prints seconds of processor time per picture, and how far pictures are from the exact one, by degrees.
const SCRIPT: &str = include_str!("warp_affine.py");
/// Edge of the image and of what is drawn of it \[pixels\].
const IMAGE: u32 = 2048;
const PICTURE: u32 = 1200;
const RUNS: usize = 7;
/// Shown in the settings beside the two that the rows are about.
const DEGREES: [f64; 6] = [2.0, 0.0, 0.5, 5.0, 15.0, 30.0];

pub(crate) fn measure() -> Result<Vec<Row>> {
    let image = tissue(IMAGE, 0)?;
    let patch = Patch::of_image(&image, UVec2::splat(IMAGE));
    let folder = tempfile::tempdir()?;
    fs::write(folder.path().join("image"), &image)?;
    for (n, degrees) in DEGREES.iter().enumerate() {
        let mut picture = vec![0; (PICTURE * PICTURE) as usize];
        draw_once(&patch, *degrees, &mut picture);
        fs::write(folder.path().join(n.to_string()), &picture)?;
    }
    let (mut off, mut their_off) = (Vec::new(), Vec::new());
    let mut ratios = vec![Vec::new(); DEGREES.len()];
    let mut ours = vec![Vec::new(); DEGREES.len()];
    let mut version = String::new();
    for _ in 0..RUNS {
        let peer = warp_affine(folder.path())?;
        for (n, (degrees, theirs)) in DEGREES.iter().zip(&peer.seconds).enumerate() {
            let seconds = draw(&patch, *degrees)?;
            ratios[n].push(theirs / seconds);
            ours[n].push(f64::from(PICTURE).powi(2) / 1e6 / seconds);
        }
        (version, off, their_off) = (peer.version, peer.off, peer.their_off);
    }
    let farthest = off.iter().copied().fold(0.0, f64::max);
    ensure!(farthest <= 1.0, "a pixel is {farthest} grey levels off");
    let by_angle = |values: &[f64]| {
        let each = DEGREES
            .iter()
            .zip(values)
            .map(|(degrees, off)| format!("{degrees} degrees: {off:.2}"));
        each.collect::<Vec<_>>().join(", ")
    };
    let all = |values: &[Vec<f64>]| {
        let each = DEGREES.iter().zip(values).map(|(degrees, runs)| {
            let row = Row::new("", "", runs.clone());
            format!("{degrees} degrees: {:.2}", row.value())
        });
        each.collect::<Vec<_>>().join(", ")
    };
    let rows = [
        Row::new(IDS[0], "times as fast", ratios[0].clone()).setting("by angle", all(&ratios)),
        Row::new(IDS[1], "times as fast", ratios[1].clone()),
        Row::new(IDS[2], "Mpixel per core and second", ours[0].clone())
            .setting("by angle", all(&ours)),
        Row::new(IDS[3], "Mpixel per core and second", ours[1].clone()),
    ];
    let described = (0..).zip(rows).map(|(n, row)| {
        let map = match n % 2 {
            0 => "turned by 2 degrees and shifted by part of a pixel",
            _ => "shifted by part of a pixel",
        };
        row.setting("map", map)
            .setting(
                "picture",
                format!("{PICTURE}x{PICTURE} of {IMAGE}x{IMAGE}, tissue with noise, bilinear"),
            )
            .setting("peer", format!("OpenCV {version}, warpAffine, one thread"))
            .setting("grey levels off the exact picture, at most", by_angle(&off))
            .setting("the peer's", by_angle(&their_off))
    });
    Ok(described.collect())
}

/// To pixels of the image, from those of the picture, about the middle of both.
fn first_and_steps(degrees: f64) -> (DVec2, DVec2, DVec2) {
    let along = DVec2::from_angle(degrees.to_radians());
    let down = along.perp();
    let middle = DVec2::splat(f64::from(IMAGE) / 2.0) + DVec2::new(0.37, 0.21);
    (
        middle - (along + down) * f64::from(PICTURE) / 2.0,
        along,
        down,
    )
}

fn draw_once(patch: &Patch, degrees: f64, picture: &mut [u8]) {
    let (first, along, down) = first_and_steps(degrees);
    for (y, row) in (0..).zip(picture.chunks_exact_mut(PICTURE as usize)) {
        patch.sample(
            Interpolation::Linear,
            first + down * f64::from(y) + 0.5,
            along,
            row,
        );
    }
}

/// Seconds of processor time per picture.
fn draw(patch: &Patch, degrees: f64) -> Result<f64> {
    let mut picture = vec![0; (PICTURE * PICTURE) as usize];
    let start = cpu::time()?;
    let mut pictures = 0;
    loop {
        draw_once(patch, degrees, &mut picture);
        pictures += 1;
        let took = cpu::time()? - start;
        if took >= Duration::from_millis(300) {
            return Ok(took.as_secs_f64() / f64::from(pictures));
        }
    }
}

#[derive(Deserialize)]
struct Peer {
    version: String,
    seconds: Vec<f64>,
    /// Farthest any pixel of our picture is from the exact one \[grey levels\].
    off: Vec<f64>,
    their_off: Vec<f64>,
}

/// Lets OpenCV draw the `image` of a folder, and compares with our pictures, which are called by their number.
fn warp_affine(folder: &Path) -> Result<Peer> {
    let python = std::env::var("SACCADE_BENCH_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let degrees = DEGREES.map(|degrees| {
        let (first, along, down) = first_and_steps(degrees);
        format!(
            "{} {} {} {} {} {}",
            along.x, down.x, first.x, along.y, down.y, first.y
        )
    });
    let ran = Command::new(&python)
        .args(["-c", SCRIPT, &IMAGE.to_string(), &PICTURE.to_string()])
        .arg(folder)
        .args(degrees)
        .output()
        .with_context(|| format!("cannot run {python}; `./dev bench` sets it up"))?;
    if !ran.status.success() {
        bail!(
            "OpenCV did not run; `./dev bench` installs it: {}",
            String::from_utf8_lossy(&ran.stderr)
        );
    }
    let peer: Peer =
        serde_json::from_slice(&ran.stdout).context("OpenCV's script said nonsense")?;
    ensure!(
        [&peer.seconds, &peer.off, &peer.their_off].map(Vec::len) == [DEGREES.len(); 3],
        "OpenCV's script left maps out"
    );
    Ok(peer)
}
