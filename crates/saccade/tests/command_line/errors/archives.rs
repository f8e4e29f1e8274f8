//! Archives and volumes that are not there, or whose parts do not belong together.

use std::path::Path;

use super::{assert_failed, text};
use crate::{archive, done, run, stderr};

#[test]
fn a_volume_without_tiles() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    std::fs::create_dir(&acquisition).unwrap();
    let info = r#"{"name":"later","extent":[50,40,9],"voxel_nm":[4,4,40]}"#;
    std::fs::write(acquisition.join("volume.json"), info).unwrap();
    let archive = folder.path().join("archive");
    let ingested = run(["ingest", text(&acquisition), text(&archive), "--once"]);
    assert!(ingested.status.success(), "{}", stderr(&ingested));
    let picture = folder.path().join("picture.png");
    let output = run([
        "render",
        text(&archive),
        "-o",
        text(&picture),
        "--size",
        "16x16",
    ]);
    let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
    if !required && stderr(&output).contains("no GPU adapter") {
        return;
    }
    assert!(output.status.success(), "{}", stderr(&output));
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        said.contains("nothing was acquired yet") && !said.contains("complete"),
        "{said}"
    );
}

#[test]
fn volumes_that_are_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let render = |place: &str, more: &[&str]| {
        let fixed = ["render", place, "-o", text(&picture)];
        run(fixed.iter().chain(more))
    };
    let unknown = render(&archive, &["--volume", "mitochondria"]);
    assert_failed(
        &unknown,
        1,
        &["mitochondria", "the volumes are: phantom", &archive],
    );
    let nobody = render("http://127.0.0.1:9", &[]);
    assert_failed(&nobody, 1, &["http://127.0.0.1:9", "is the server running"]);
    let odd = render(&archive, &["--transfer", "{\"window\": 3}"]);
    assert_failed(&odd, 1, &["no transfer function", "--transfer"]);
    let missing = render(&archive, &["--transfer", "nowhere.json"]);
    assert_failed(
        &missing,
        1,
        &["cannot read the transfer function", "nowhere.json"],
    );
    assert!(!picture.exists());
}

/// Values that make no sense are told as such, also where they begin as options do.
#[test]
fn values_below_zero_are_values() {
    let render = ["render", "nowhere", "-o", "never.png"];
    for (option, value, word) in [
        ("--slab", "-1", "nanometres"),
        ("--gpu-memory", "-1", "MiB"),
        ("--host-memory", "-3", "MiB"),
        ("--timeout", "-1", "seconds from 0 on"),
        ("--timeout", "nan", "seconds from 0 on"),
        ("--channels", "-1", "channel"),
        ("--detail", "-1", "detail"),
        ("-o", "", "name the file"),
    ] {
        let given = [option, value];
        let output = match option {
            "-o" => run(["render", "nowhere"].iter().chain(&given)),
            "--slab" => run(render.iter().chain(&["--slice", "z=1"]).chain(&given)),
            _ => run(render.iter().chain(&given)),
        };
        assert_failed(&output, 2, &[word]);
        let said = stderr(&output);
        assert!(!said.contains("unexpected argument"), "{said}");
    }
    assert!(!Path::new("never.png").exists());
}

/// A catalog and the pyramids of another archive; a cache on disk where other things are.
#[test]
fn what_does_not_belong_together() {
    let folder = tempfile::tempdir().unwrap();
    let (one, other) = (folder.path().join("one"), folder.path().join("other"));
    let (one, other) = (archive(&one), archive(&other));
    let catalog = format!("{one}/catalog.sqlite");
    let acquisition = folder.path().join("one/acquisition");
    let strangers = ["not of one archive", &catalog, &other];
    for arguments in [
        &["serve", &other, "--port", "0"][..],
        &["render", &other, "-o", "never.png"],
        &["ingest", text(&acquisition), &other, "--once"],
        &["check", &other],
    ] {
        let output = run(arguments.iter().chain(&["--catalog", &catalog]));
        assert_failed(&output, 1, &strangers);
    }

    let gone = folder.path().join("gone");
    for arguments in [
        &["serve", text(&gone), "--port", "0"][..],
        &["check", text(&gone)],
    ] {
        let output = run(arguments.iter().chain(&["--catalog", &catalog]));
        assert_failed(&output, 1, &["no such folder", text(&gone), &catalog]);
        assert!(!gone.exists(), "no folder is left behind");
    }

    let thesis = folder.path().join("thesis");
    std::fs::create_dir(&thesis).unwrap();
    std::fs::write(thesis.join("thesis.tex"), "chapter 1").unwrap();
    let within = format!("{one}/cache");
    let caches: [(&str, &[&str]); 4] = [
        (text(&thesis), &["other things", "thesis"]),
        (&within, &["neither in the archive's folder", "cache"]),
        (text(folder.path()), &["neither in the archive's folder"]),
        (&one, &["neither in the archive's folder"]),
    ];
    for (cache, parts) in caches {
        let output = run(["serve", &one, "--port", "0", "--disk-cache", cache]);
        assert_failed(&output, 1, parts);
    }
    assert_eq!(std::fs::read_dir(&thesis).unwrap().count(), 1);
    assert!(!Path::new(&within).exists());
    for (size, part) in [
        ("0", "at least"),
        ("1.5 potatoes", "MB, GB or TB"),
        ("1.2.3", "1.5"),
    ] {
        let sized = ["serve", "a", "--disk-cache", "b", "--disk-cache-size", size];
        assert_failed(&run(sized), 2, &[part]);
    }
}

/// Pyramids whose catalog is another, or was lost.
#[test]
fn pyramids_of_which_the_catalog_knows_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let one = archive(folder.path());
    let acquisition = folder.path().join("acquisition");
    let ingest = ["ingest", text(&acquisition), &one, "--once"];
    let own = Path::new(&one).join("catalog.sqlite");
    let copy = folder.path().join("copy");
    std::fs::copy(&own, &copy).unwrap();
    let pyramids = || {
        let listed = std::fs::read_dir(Path::new(&one).join("tiles")).unwrap();
        listed.count()
    };
    let before = pyramids();

    let fresh = folder.path().join("fresh.sqlite");
    let output = run(ingest
        .iter()
        .chain(&["--catalog", text(&fresh), "--volume", "second"]));
    let way_out = [
        "another catalog's",
        "Name that one",
        "put a copy of it back",
        "ingest",
        &one,
    ];
    assert_failed(&output, 1, &way_out);
    assert!(stderr(&output).contains(text(&fresh)));
    assert!(!fresh.exists(), "no catalog is left behind");
    assert_eq!(pyramids(), before, "nothing is taken in");

    // More is taken in, and then the catalog is lost.
    let records = acquisition.join("tiles.jsonl");
    let said = std::fs::read_to_string(&records).unwrap();
    let again = said.lines().next().unwrap();
    let more = again.replace("\"tile\":\"", "\"tile\":\"later-");
    std::fs::write(&records, format!("{said}{more}\n")).unwrap();
    assert!(stderr(&done(ingest)).contains("1 tiles taken in"));
    std::fs::remove_file(&own).unwrap();
    for lost in [
        &["serve", &one, "--port", "0"][..],
        &["render", &one, "-o", "never.png"],
        &["check", &one],
        &ingest,
    ] {
        assert_failed(&run(lost), 1, &way_out);
    }
    // A copy knows less, and what is missing is taken in again.
    std::fs::copy(&copy, &own).unwrap();
    assert!(stderr(&done(ingest)).contains("1 tiles taken in"));
    let whole = stderr(&done(["check", &one]));
    assert!(whole.contains("all whole"), "{whole}");

    // Cut short while it was copied, say.
    let identity = Path::new(&one).join("identity");
    let said = std::fs::read_to_string(&identity).unwrap();
    for damaged in ["", &said[..7]] {
        std::fs::write(&identity, damaged).unwrap();
        let told = stderr(&done(["check", &one]));
        assert!(
            told.contains("\"identity\"") && told.contains("damaged"),
            "{told}"
        );
        done(ingest);
        assert_eq!(std::fs::read_to_string(&identity).unwrap(), said);
    }
}
