//! An overview and details of one section, from a microscope's records to what other programs read.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::time::Duration;

use image::GrayImage;
use serde_json::{Value, json};

use crate::{Running, done, saccade};

const EXTENT: [u32; 3] = [512, 512, 3];
/// Level-0 voxels along a pixel of the overview.
const COARSE: u32 = 8;
/// Where the two details begin, which overlap, and their edge and values.
const DETAILS: [[u32; 2]; 2] = [[40, 60], [120, 60]];
const EDGE: u32 = 100;
const VALUES: [u8; 2] = [200, 250];

/// What an overview shows is brighter to the right and below, which no interpolation changes but at its edge.
fn overview() -> GrayImage {
    let edge = EXTENT[0] / COARSE;
    GrayImage::from_fn(edge, edge, |x, y| {
        image::Luma([u8::try_from(10 + x + y).unwrap()])
    })
}

/// A voxel of level 0 where an overview and some of the details are.
fn expected(overview: bool, details: [bool; 2], x: u32, y: u32) -> u8 {
    let is_in = |n: usize| {
        let [left, top] = DETAILS[n];
        details[n] && (left..left + EDGE).contains(&x) && (top..top + EDGE).contains(&y)
    };
    // Of two the one whose middle is nearer.
    let nearer = (DETAILS[0][0] + DETAILS[1][0] + EDGE) / 2;
    match (is_in(0), is_in(1)) {
        (true, true) => VALUES[usize::from(x >= nearer)],
        (true, false) => VALUES[0],
        (false, true) => VALUES[1],
        (false, false) if overview => {
            // Between the middles of pixels, in parts of them.
            let last = EXTENT[0] / COARSE - 1;
            let parts = |v: u32| (2 * v + 1).saturating_sub(COARSE).min(2 * COARSE * last);
            u8::try_from(10 + (parts(x) + parts(y) + COARSE) / (2 * COARSE)).unwrap()
        }
        (false, false) => 0,
    }
}

struct Scope {
    folder: String,
    archive: String,
}

impl Scope {
    fn new(folder: &Path) -> Self {
        let [scope, archive] =
            ["scope", "archive"].map(|name| folder.join(name).to_str().unwrap().to_owned());
        fs::create_dir(&scope).unwrap();
        let volume = json!({"name": "both", "extent": EXTENT, "voxel_nm": [4, 4, 40]});
        fs::write(format!("{scope}/volume.json"), volume.to_string()).unwrap();
        fs::write(format!("{scope}/tiles.jsonl"), "").unwrap();
        overview().save(format!("{scope}/overview.png")).unwrap();
        for (n, value) in VALUES.into_iter().enumerate() {
            let image = GrayImage::from_pixel(EDGE, EDGE, image::Luma([value]));
            image.save(format!("{scope}/detail{n}.png")).unwrap();
        }
        Self {
            folder: scope,
            archive,
        }
    }

    /// Appends records, and has them taken in.
    fn tell(&self, records: &[Value]) {
        let file = format!("{}/tiles.jsonl", self.folder);
        let mut file = fs::OpenOptions::new().append(true).open(file).unwrap();
        for record in records {
            writeln!(file, "{record}").unwrap();
        }
        drop(file);
        done([
            "ingest",
            &self.folder,
            &self.archive,
            "--once",
            "--lossless",
        ]);
    }
}

fn overview_record(section: u32) -> Value {
    let edge = EXTENT[0] / COARSE;
    json!({"record": "tile", "tile": format!("s{section}_overview"), "file": "overview.png",
        "section": section, "size": [edge, edge], "transform": [COARSE, 0, 0, COARSE, 0, 0]})
}

fn detail_record(section: u32, n: usize) -> Value {
    let [x, y] = DETAILS[n];
    json!({"record": "tile", "tile": format!("s{section}_detail{n}"), "file": format!("detail{n}.png"),
        "section": section, "size": [EDGE, EDGE], "transform": [1, 0, 0, 1, x, y]})
}

/// What a server answers; nothing where there is nothing.
fn get(url: &str, path: &str) -> Vec<u8> {
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(async {
        let url = format!("{}/v/both/{path}", url.trim_end_matches('/'));
        let answer = reqwest::get(url).await.unwrap();
        match answer.status().as_u16() {
            404 => Vec::new(),
            status => {
                assert_eq!(status, 200, "{path}");
                answer.bytes().await.unwrap().to_vec()
            }
        }
    })
}

/// A section at level 0, row by row.
fn section(url: &str, z: u32) -> Vec<u8> {
    let volume: Value = serde_json::from_slice(&get(url, "volume.json")).unwrap();
    let chunk = [0, 1, 2].map(|axis| {
        let edge = volume["volume"]["chunk"][axis].as_u64().unwrap();
        u32::try_from(edge).unwrap()
    });
    let mut values = vec![0; (EXTENT[0] * EXTENT[1]) as usize];
    for cy in 0..EXTENT[1].div_ceil(chunk[1]) {
        for cx in 0..EXTENT[0].div_ceil(chunk[0]) {
            let got = get(url, &format!("zarr/0/c/0/{}/{cy}/{cx}", z / chunk[2]));
            let mut planes = got.chunks((chunk[0] * chunk[1]) as usize);
            let Some(plane) = planes.nth((z % chunk[2]) as usize) else {
                continue;
            };
            for (row, y) in plane
                .chunks(chunk[0] as usize)
                .zip(cy * chunk[1]..EXTENT[1])
            {
                for (value, x) in row.iter().zip(cx * chunk[0]..EXTENT[0]) {
                    values[(y * EXTENT[0] + x) as usize] = *value;
                }
            }
        }
    }
    values
}

/// Waits until a section is of an overview and details, in every voxel.
fn comes_to_be(url: &str, z: u32, overview: bool, details: [bool; 2]) {
    let mut looks = 0;
    let at = || (0..EXTENT[1]).flat_map(|y| (0..EXTENT[0]).map(move |x| (x, y)));
    loop {
        let got = section(url, z);
        let mut wrong = at().zip(got).filter(|((x, y), got)| {
            let want = expected(overview, details, *x, *y);
            got.abs_diff(want) > 1 || (*got == 0) != (want == 0)
        });
        let Some(((x, y), got)) = wrong.next() else {
            return;
        };
        looks += 1;
        assert!(
            looks < 400,
            "section {z}: {got} at {x}, {y}, and {} more",
            wrong.count()
        );
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Whichever came first, and when the details go.
#[test]
fn details_are_seen_where_they_are_and_the_overview_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let scope = Scope::new(folder.path());
    // The details first in section 0, the overview in section 1.
    scope.tell(&[detail_record(0, 0), detail_record(0, 1), overview_record(1)]);
    let (_server, url) = Running::start(saccade().args(["serve", &scope.archive, "--port", "0"]));
    comes_to_be(&url, 0, false, [true, true]);
    comes_to_be(&url, 1, true, [false, false]);
    scope.tell(&[overview_record(0), detail_record(1, 1)]);
    comes_to_be(&url, 0, true, [true, true]);
    comes_to_be(&url, 1, true, [false, true]);
    scope.tell(&[
        json!({"record": "delete", "tile": "s0_detail0"}),
        json!({"record": "delete", "tile": "s1_overview"}),
    ]);
    comes_to_be(&url, 0, true, [false, true]);
    comes_to_be(&url, 1, false, [false, true]);
    assert!(section(&url, 2).iter().all(|value| *value == 0));
}
