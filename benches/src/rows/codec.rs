//! The codec of sub-tiles, beside those that need no C compiler: which one to build on.
//!
//! Sub-tiles as the archive cuts them, each a JPEG stream of its own, one thread, processor time.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use image::ImageFormat;
use jpeg_encoder::{ColorType, Encoder};
use saccade_archive::pyramid::{Encoding, SUB_TILE_EDGE};
use saccade_ingest::ingest::IngestOptions;
use turbojpeg::{Compressor, Decompressor, Image, PixelFormat, Subsamp};

use crate::cpu;
use crate::report::Row;
use crate::scene::tissue;

pub(crate) const IDS: &[&str] = &["codec.encode.vs_jpeg_encoder", "codec.decode.vs_zune_jpeg"];

const EDGE: usize = SUB_TILE_EDGE as usize;
/// Edge of what the sub-tiles are cut out of \[pixels\].
const IMAGE: u32 = 1024;
const RUNS: usize = 5;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let Encoding::Jpeg { quality } = IngestOptions::default().encoding else {
        anyhow::bail!("tiles are not stored as JPEG by default");
    };
    let sub_tiles = sub_tiles()?;
    let mut compressor = Compressor::new()?;
    compressor.set_quality(quality.into())?;
    compressor.set_subsamp(Subsamp::Gray)?;
    let mut decompressor = Decompressor::new()?;
    let mut stream = vec![0; 4 * EDGE * EDGE];
    let streams: Vec<Vec<u8>> = { sub_tiles.iter() }
        .map(|voxels| compressor.compress_to_vec(of(voxels.as_slice())))
        .collect::<Result<_, _>>()?;

    let (mut encoding, mut decoding) = (Vec::new(), Vec::new());
    let (mut ours, mut theirs) = (0, 0);
    let mut voxels = vec![0; EDGE * EDGE];
    let mut speeds = [const { Vec::new() }; 4];
    for _ in 0..RUNS {
        let mut take = |n: usize, seconds: f64| {
            let mpix = sub_tiles.len() as f64 * (EDGE * EDGE) as f64 / 1e6;
            speeds[n].push(mpix / seconds);
            seconds
        };
        let turbo = processor_time(|| {
            ours = 0;
            for voxels in &sub_tiles {
                ours += compressor.compress_to_slice(of(voxels.as_slice()), &mut stream)?;
            }
            Ok(())
        })?;
        let rust = processor_time(|| {
            theirs = 0;
            for voxels in &sub_tiles {
                let mut stream = Vec::with_capacity(EDGE * EDGE);
                let edge = u16::try_from(EDGE)?;
                Encoder::new(&mut stream, quality).encode(voxels, edge, edge, ColorType::Luma)?;
                theirs += stream.len();
            }
            Ok(())
        })?;
        encoding.push(take(1, rust) / take(0, turbo));
        let turbo = processor_time(|| {
            for stream in &streams {
                let header = decompressor.read_header(stream)?;
                ensure!(
                    (header.width, header.height) == (EDGE, EDGE),
                    "another size"
                );
                decompressor.decompress(stream, of(voxels.as_mut_slice()))?;
            }
            Ok(())
        })?;
        let rust = processor_time(|| {
            for stream in &streams {
                let image = image::load_from_memory_with_format(stream, ImageFormat::Jpeg)?;
                let image = image.as_luma8().context("not grey")?;
                ensure!(
                    image.dimensions() == (SUB_TILE_EDGE, SUB_TILE_EDGE),
                    "another size"
                );
            }
            Ok(())
        })?;
        decoding.push(take(3, rust) / take(2, turbo));
    }
    let [turbo_encodes, rust_encodes, turbo_decodes, rust_decodes] =
        speeds.map(|runs| format!("{:.0}", Row::new("", "", runs).value()));
    let described = |row: Row, speeds: String| {
        row.setting(
            "sub-tiles",
            format!(
                "{} of {EDGE}x{EDGE}, tissue with noise, quality {quality}",
                sub_tiles.len()
            ),
        )
        .setting("Mpixel per core and second", speeds)
    };
    Ok(vec![
        described(
            Row::new(IDS[0], "times as fast", encoding),
            format!("{turbo_encodes} of libjpeg-turbo, {rust_encodes} of jpeg-encoder with SIMD"),
        )
        .setting("bytes", format!("{} and {theirs}", ours)),
        described(
            Row::new(IDS[1], "times as fast", decoding),
            format!("{turbo_decodes} of libjpeg-turbo, {rust_decodes} of zune-jpeg"),
        ),
    ])
}

fn sub_tiles() -> Result<Vec<Vec<u8>>> {
    let image = tissue(IMAGE, 0)?;
    let (pitch, along) = (IMAGE as usize, IMAGE as usize / EDGE);
    let cut = |at: usize| {
        let corner = at / along * EDGE * pitch + at % along * EDGE;
        let rows = image[corner..].chunks(pitch).take(EDGE);
        rows.flat_map(|row| &row[..EDGE]).copied().collect()
    };
    Ok((0..along * along).map(cut).collect())
}

fn of<T>(pixels: T) -> Image<T> {
    Image {
        pixels,
        width: EDGE,
        pitch: EDGE,
        height: EDGE,
        format: PixelFormat::GRAY,
    }
}

/// Seconds of processor time that a piece of work takes, done often enough to tell.
fn processor_time(mut work: impl FnMut() -> Result<()>) -> Result<f64> {
    let start = cpu::time()?;
    let mut times = 0;
    loop {
        work()?;
        times += 1;
        let took = cpu::time()? - start;
        if took >= Duration::from_millis(300) {
            return Ok(took.as_secs_f64() / f64::from(times));
        }
    }
}
