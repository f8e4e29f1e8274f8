//! What an export, or a picture, is asked for and cannot be.

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _};

use super::{assert_failed, text};
use crate::{archive, done, run, stderr};

/// Does to a catalog what no program should.
fn meddle(archive: &str, statement: &str) {
    let options = SqliteConnectOptions::new().filename(format!("{archive}/catalog.sqlite"));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.unwrap().block_on(async {
        let mut catalog = options.foreign_keys(false).connect().await.unwrap();
        let statement = sqlx::query(AssertSqlSafe(statement.to_owned()));
        let done = statement.execute(&mut catalog).await.unwrap();
        assert!(done.rows_affected() > 0, "nothing was changed");
        catalog.close().await.unwrap();
    });
}

/// Whoever looks for the tiles of a place does not find these.
#[test]
fn tiles_that_cannot_be_are_not_left_out_of_an_export() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let out = folder.path().join("out.zarr");
    let part = ["--region", "0,0,0,64,64,2"];
    for (set, part_of_reason) in [
        ("section = -3", "section -3 of a volume with 12"),
        ("section = 12", "section 12 of a volume with 12"),
        ("channel = 1", "channel 1 of a volume with 1"),
        ("channel = -1", "channel -1"),
        ("width = 0", "no pixels"),
        ("height = -64", "no pixels"),
        ("deleted = 1", "called deleted"),
    ] {
        let kept = std::fs::read(format!("{archive}/catalog.sqlite")).unwrap();
        meddle(
            &archive,
            &format!("UPDATE tiles SET {set} WHERE id = (SELECT max(id) FROM tiles)"),
        );
        for more in [&[][..], &part] {
            let refused = run(["export", &archive, text(&out)].iter().chain(more));
            let advice = [
                "cannot be understood",
                part_of_reason,
                "saccade check --repair",
            ];
            assert_failed(&refused, 1, &advice);
        }
        assert!(!out.exists(), "{set}");
        std::fs::write(format!("{archive}/catalog.sqlite"), kept).unwrap();
    }
    meddle(&archive, "DELETE FROM sections WHERE section = 4");
    let refused = run(["export", &archive, text(&out)]);
    assert_failed(&refused, 1, &["section 4 is said to have no tiles"]);
    // As it says.
    done(["check", &archive, "--repair"]);
    done(["export", &archive, text(&out)]);
}

/// The advice for tiles of a volume that the catalog lacks.
#[test]
fn a_volume_that_the_catalog_lost_comes_back_with_ingest() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    meddle(&archive, "DELETE FROM volumes");
    let acquisition = folder.path().join("acquisition");
    done([
        "ingest",
        text(&acquisition),
        &archive,
        "--once",
        "--lossless",
    ]);
    let whole = stderr(&done([
        "check",
        &archive,
        "--repair",
        "--acquisition",
        text(&acquisition),
    ]));
    assert!(!whole.contains("lost"), "{whole}");
    let whole = stderr(&done([
        "check",
        &archive,
        "--acquisition",
        text(&acquisition),
    ]));
    assert!(whole.contains("all whole"), "{whole}");
}

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
