//! Tiles that cannot be read, and how often a server says so.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use super::answers::Client;
use super::{Running, archive, saccade};

/// The pyramids of a section, by name.
fn pyramids(archive: &Path, section: u32) -> Vec<PathBuf> {
    let folder = archive.join(format!("tiles/phantom/{section:06}"));
    let files = fs::read_dir(folder).unwrap();
    let mut files: Vec<_> = files.map(|file| file.unwrap().path()).collect();
    files.sort();
    files
}

/// Asks for every chunk of every level; how many are of damaged tiles.
fn ask_for_all(client: &Client) -> usize {
    let numbers = |of: &serde_json::Value| -> Vec<u64> {
        let all = of.as_array().unwrap().iter();
        all.map(|number| number.as_u64().unwrap()).collect()
    };
    let mut failed = 0;
    for level in 0.. {
        let array = client.get(&format!("v/phantom/zarr/{level}/zarr.json"));
        if array.status != 200 {
            assert!(level > 0, "{array:?}");
            break;
        }
        let array = array.json();
        let shape = numbers(&array["shape"]);
        let chunk = numbers(&array["chunk_grid"]["configuration"]["chunk_shape"]);
        let counts = { shape.iter().zip(&chunk) }.map(|(length, of)| length.div_ceil(*of));
        let [_, nz, ny, nx] = counts.collect::<Vec<_>>()[..] else {
            panic!("{array}");
        };
        for n in 0..nx * ny * nz {
            let (x, y, z) = (n % nx, n / nx % ny, n / nx / ny);
            let answer = client.get(&format!("v/phantom/zarr/{level}/c/0/{z}/{y}/{x}"));
            match answer.status {
                424 => failed += 1,
                status => assert!([200, 404].contains(&status), "{answer:?}"),
            }
        }
    }
    failed
}

/// Whatever levels and chunks show it, and however often they are asked for.
#[test]
fn a_damaged_tile_is_warned_of_once() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let place = Path::new(&archive);
    // No pyramid at all; one that lacks its end; one whose every picture is spoilt. Each is in chunks without the others.
    let damaged: Vec<PathBuf> = { [(2, 0), (5, 1), (8, 2)].into_iter() }
        .map(|(section, n)| pyramids(place, section).swap_remove(n))
        .collect();
    fs::write(&damaged[0], "no pyramid").unwrap();
    let whole = fs::read(&damaged[1]).unwrap();
    fs::write(&damaged[1], &whole[..whole.len() / 2]).unwrap();
    let mut spoilt = fs::read(&damaged[2]).unwrap();
    let end = spoilt.len();
    spoilt[end / 8..]
        .iter_mut()
        .step_by(31)
        .for_each(|byte| *byte ^= 0x5a);
    fs::write(&damaged[2], spoilt).unwrap();

    let said = folder.path().join("said.txt");
    let mut command = saccade();
    command.stderr(File::create(&said).unwrap());
    let (server, url) = Running::start(command.args(["serve", &archive, "--port", "0"]));
    let client = Client::of(&url);
    let failed = ask_for_all(&client);
    assert!(failed > damaged.len(), "{failed} chunks show damaged tiles");
    assert_eq!(ask_for_all(&client), failed);
    drop(server);

    let said = fs::read_to_string(said).unwrap();
    for pyramid in &damaged {
        let name = pyramid.file_stem().unwrap().to_str().unwrap();
        let lines: Vec<&str> = said.lines().filter(|line| line.contains(name)).collect();
        assert_eq!(lines.len(), 1, "{name}: {said}");
    }
    let warnings = said.lines().filter(|line| line.contains("warn"));
    assert_eq!(warnings.count(), damaged.len(), "{said}");
}
