//! What an export, or a picture, is asked for and cannot be.

use super::{assert_failed, text};
use crate::{archive, done, run, stderr};

#[test]
fn what_an_export_finds_in_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let out = folder.path().join("out.zarr");
    let export = |more: &[&str]| run(["export", &archive, text(&out)].iter().chain(more));
    assert!(export(&[]).status.success());
    assert!(stderr(&done(["export", &archive, text(&out)])).contains("nothing to do"));
    let taken = export(&["--channels", "0", "--compression", "0"]);
    assert_failed(&taken, 1, &["something already", text(&out)]);
    // What was taken away is exported again.
    let shard = out.join("0/c/0/0/0/0");
    let bytes = std::fs::read(&shard).unwrap();
    std::fs::remove_file(&shard).unwrap();
    let mended = stderr(&done(["export", &archive, text(&out)]));
    assert!(mended.contains("were there already"), "{mended}");
    assert_eq!(std::fs::read(&shard).unwrap().len(), bytes.len());
    // Whoever is refused leaves nothing behind, whose folder it may be.
    let others = folder.path().join("others");
    std::fs::create_dir(&others).unwrap();
    std::fs::write(others.join("letter.txt"), "hello").unwrap();
    let taken = run(["export", &archive, text(&others)]);
    assert_failed(&taken, 1, &["something already", text(&others)]);
    let nowhere = folder.path().join("nowhere");
    let outside = run(["export", &archive, text(&nowhere), "--finest", "99"]);
    assert_failed(&outside, 1, &["no level 99"]);
    assert_eq!(std::fs::read_dir(&others).unwrap().count(), 1);
    assert!(!nowhere.exists() && !out.join(".incoming").exists());
    let cut = folder.path().join("cut.zarr");
    let told = stderr(&done([
        "export",
        &archive,
        text(&cut),
        "--region",
        "0,0,0,100,100,9999",
    ]));
    assert!(
        told.contains("reaches beyond the volume, and is cut at 100,100,12"),
        "{told}"
    );

    // As an export that was killed leaves it.
    std::fs::remove_file(out.join("zarr.json")).unwrap();
    let begun = r#"{"export": {"volume": "phantom", "channels": [0, 1]}, "revision": 1}"#;
    std::fs::write(out.join("export.json"), begun).unwrap();
    let other = export(&[]);
    assert_failed(
        &other,
        1,
        &["another export", "channels 0,1 there, 0 now", text(&out)],
    );
    assert!(stderr(&other).len() < 600, "{}", stderr(&other));
    let half = run(["render", text(&out), "-o", "never.png"]);
    assert_failed(
        &half,
        1,
        &[
            "export to this folder was begun",
            "repeat the command",
            text(&out),
        ],
    );
}

#[test]
fn what_is_asked_for_outside_the_volume() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let render = |more: &[&str]| {
        run(["render", &archive, "-o", text(&picture)]
            .iter()
            .chain(more))
    };
    for (more, parts) in [
        (&["--slice", "z=9999"][..], &["z=9999", "from 0 to 11"][..]),
        (&["--clip", "150,0,0,160,9,9"], &["along x", "150", "160"]),
        (
            &["--slice", "z=3", "--clip", "0,0,5,9,9,9"],
            &["along z", "from 5 to 9", "from 3.5 to 3.5"],
        ),
    ] {
        assert_failed(&render(more), 1, parts);
    }
    for (transfer, part) in [
        (
            r#""window": [0.5, 0.5], "opacity": [], "opacity_length_nm": 9"#,
            "window",
        ),
        (
            r#""window": [0, 1], "opacity": [], "opacity_length_nm": 0"#,
            "above 0",
        ),
        (
            r#""window": [0, 1], "opacity": [{"value": 0.9, "opacity": 1}, {"value": 0.1, "opacity": 0}],
               "opacity_length_nm": 9"#,
            "order of their values",
        ),
    ] {
        let json = format!(r#"{{"polarity": "dark", "color_map": "bone", {transfer}}}"#);
        assert_failed(&render(&["--transfer", &json]), 1, &[part]);
    }
    assert_failed(&render(&["--iso", "2"]), 2, &["0 to 1"]);
    for more in [
        &["--iso", "1:0.5"][..],
        &["--transfer", "1:auto"],
        &["--channels", "1"],
    ] {
        assert_failed(&render(more), 1, &["there is no channel 1", "has 1"]);
    }
    let five = ["--cut", "x=1"].repeat(5);
    assert_failed(&render(&five), 1, &["4 planes", "--cut fewer times"]);
    assert!(!picture.exists());
}
