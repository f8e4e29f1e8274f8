//! Folders whose tiles a list names, through the program alone.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::time::Duration;

use image::{GrayImage, Luma};

use super::answers::Client;
use super::errors::{assert_failed, text};
use super::server_away::{Program, says};
use super::update::ended;
use super::{Running, done, run, saccade, stderr};

fn picture(folder: &Path, name: &str, shade: u8) {
    let image = GrayImage::from_fn(40, 30, |x, y| {
        Luma([shade + u8::try_from((x + y) % 9).unwrap()])
    });
    image.save(folder.join(name)).unwrap();
}

#[test]
fn a_folder_with_a_list_is_taken_in() {
    let folder = tempfile::tempdir().unwrap();
    let scope = folder.path().join("cortex");
    let archive = folder.path().join("archive");
    std::fs::create_dir(&scope).unwrap();
    let list = scope.join("TileConfiguration.txt");
    std::fs::write(&list, "dim = 2\na.png; ; (100, 100)\nb.png; ; (135, 100)\n").unwrap();
    let ingest = ["ingest", text(&scope), text(&archive), "--once"];
    let sized = [&ingest[..], &["--voxel", "4,4,40"]].concat();

    // What a list cannot say is asked for, before anything is made.
    assert_failed(
        &run(ingest),
        1,
        &["how large a voxel is", "--voxel", text(&list)],
    );
    assert!(!archive.exists());
    let none = run(&sized);
    assert_failed(&none, 1, &["none of the 2 images", "a.png", "--extent"]);

    picture(&scope, "a.png", 10);
    let half = run(&sized);
    let said = [
        "1 tiles taken in",
        "1 of the 2 images",
        "b.png",
        "started again",
    ];
    ended(&half, 3, &said);
    picture(&scope, "b.png", 90);
    let whole = done(&sized);
    assert!(
        stderr(&whole).contains("1 tiles taken in"),
        "{}",
        stderr(&whole)
    );
    let again = done(&sized);
    assert!(
        stderr(&again).contains("0 tiles taken in"),
        "{}",
        stderr(&again)
    );

    // It is known by its first options and its list.
    let other = [&sized[..], &["--first", "3"]].concat();
    assert_failed(
        &run(other),
        1,
        &["first is 0 there, 3 now", "--volume NAME"],
    );
    std::fs::copy(&list, scope.join("TileConfiguration0.txt")).unwrap();
    done(&sized);
    let second = scope.join("TileConfiguration0.txt");
    let other = [&sized[..], &["--list", text(&second)]].concat();
    assert_failed(&run(other), 1, &["list is TileConfiguration.txt there"]);
    let pattern = [
        &sized[..],
        &[
            "--pattern",
            "{section}.png",
            "--extent",
            "9,9,9",
            "--pitch",
            "9,9",
        ],
    ];
    assert_failed(
        &run(pattern.concat()),
        1,
        &["pattern is not set there", "list is"],
    );

    // The tiles can be moved by others, too.
    let moves = folder.path().join("moves.jsonl");
    let line = r#"{"record": "transform", "tile": "b", "transform": [1, 0, 0, 1, 33, 0]}"#;
    std::fs::write(&moves, line).unwrap();
    let moved = done(["update", text(&archive), text(&moves)]);
    assert!(stderr(&moved).contains("1 moved"), "{}", stderr(&moved));
    done(&sized);
    let again = done(["update", text(&archive), text(&moves)]);
    assert!(
        stderr(&again).contains("0 moved, 1 unchanged"),
        "{}",
        stderr(&again)
    );
}

#[test]
fn options_of_lists_are_for_lists() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    let archive = folder.path().join("archive");
    super::simulate(&acquisition, "150,130,12");
    let ingest = ["ingest", text(&acquisition), text(&archive), "--once"];
    for (option, value) in [("--extent", "9,9,9"), ("--first", "3"), ("--bits", "8")] {
        let refused = run([&ingest[..], &[option, value]].concat());
        assert_failed(&refused, 1, &["has records", option, "leave it out"]);
    }
    let scope = folder.path().join("scope");
    std::fs::create_dir(&scope).unwrap();
    picture(&scope, "a.png", 10);
    let list = scope.join("list.txt");
    std::fs::write(&list, "a.png 1 2\n").unwrap();
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--once",
        "--voxel",
        "4",
    ];
    let named = |list: &str| run([&ingest[..], &["--list", list]].concat());
    assert_failed(
        &named(text(&list)),
        1,
        &["list", "line 1", "a.png 1 2", text(&list)],
    );
    assert_failed(&named("nowhere.txt"), 1, &["not there", "nowhere.txt"]);
    let alone = run([
        "ingest",
        text(&scope),
        text(&archive),
        "--list",
        text(&list),
    ]);
    assert_failed(&alone, 2, &["--voxel"]);
    let far = "tiles lie within";
    let listed = run([&ingest[..], &["--list", text(&list), "--origin", "1e12,3"]].concat());
    assert_failed(&listed, 2, &[far]);
    assert!(!archive.join("catalog.sqlite").exists());
}

#[test]
fn what_a_list_cannot_say_or_change_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive, empty] =
        ["scope", "archive", "empty"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    std::fs::create_dir(&empty).unwrap();
    picture(&scope, "a.png", 10);
    std::fs::write(scope.join("list.txt"), "\u{feff}a.png 0 0 0\n").unwrap();
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--once",
        "--voxel",
        "4",
    ];
    let channels = run([&ingest[..], &["--channels", "SE,BSE"]].concat());
    let ways = [
        "does not say of which of the channels",
        "--channel-in",
        "leave --channels out",
    ];
    assert_failed(&channels, 1, &ways);
    let nothing = ["ingest", text(&empty), text(&archive), "--origin", "3,4"];
    assert_failed(
        &run(nothing),
        1,
        &["--origin is for folders with a list", "--list", "--pattern"],
    );
    assert!(!archive.join("catalog.sqlite").exists());

    // What is there is not both.
    done(ingest);
    let lossless = run([&ingest[..], &["--lossless"]].concat());
    assert_failed(
        &lossless,
        1,
        &[
            "stored as JPEG",
            "--lossless would not change them",
            "--volume NAME",
        ],
    );
    done([&ingest[..], &["--quality", "70"]].concat());
    let second = [
        "ingest",
        text(&scope),
        text(&archive),
        "--once",
        "--voxel",
        "4",
        "--volume",
        "second",
    ];
    done([&second[..], &["--lossless"]].concat());
    let quality = run([&second[..], &["--quality", "70"]].concat());
    assert_failed(
        &quality,
        1,
        &["stored losslessly", "--quality", "--volume NAME"],
    );
}

/// A second such folder would be the same volume.
#[test]
fn a_folder_whose_name_can_name_no_volume_is_told() {
    for (name, is_told) in [
        ("Gewebe \u{e4}", true),
        ("volume", false),
        ("cortex", false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let scope = folder.path().join(name);
        let archive = folder.path().join("archive");
        std::fs::create_dir(&scope).unwrap();
        std::fs::write(scope.join("tiles.txt"), "a.png 0 0 0\n").unwrap();
        picture(&scope, "a.png", 10);
        let ingest = ["ingest", text(&scope), text(&archive), "--once"];
        let taken = done([&ingest[..], &["--voxel", "4,4,40"]].concat());
        let said = stderr(&taken);
        let told = "the volume is called \"volume\"";
        assert_eq!(said.contains(told), is_told, "{name}: {said}");
        assert_eq!(said.contains("--volume gives it another"), is_told);
    }
}

/// One who corrects a list sees which line counts, once.
#[test]
fn lines_that_name_an_image_again_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    picture(&scope, "a.png", 10);
    let list = scope.join("list.txt");
    std::fs::write(&list, "a.png 0 0 0\na.png 3 0 0\na.png 3 0 0\n").unwrap();
    let ingest = ["ingest", text(&scope), text(&archive), "--once"];
    let done = done([&ingest[..], &["--voxel", "4"]].concat());
    let said = stderr(&done);
    assert!(said.contains("1 tiles taken in"), "{said}");
    for words in [
        "line 2 puts \"a.png\" elsewhere than line 1",
        "line 3 repeats line 2",
    ] {
        assert_eq!(said.matches(words).count(), 1, "{said}");
    }
}

/// Somebody starts both at once.
#[test]
fn a_list_that_is_being_written_at_the_start_is_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    for name in ["a.png", "b.png"] {
        picture(&scope, name, 10);
    }
    let list = scope.join("list.json");
    let spec = |tile: &str, x: u32| {
        serde_json::json!({
            "tileId": tile, "z": 3, "width": 40, "height": 30,
            "mipmapLevels": {"0": {"imageUrl": format!("{tile}.png")}},
            "transforms": {"type": "list", "specList": [
                {"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": format!("1 0 0 1 {x} 0")},
            ]},
        })
    };
    let specs = serde_json::json!([spec("a", 0), spec("b", 35)]).to_string();
    std::fs::write(&list, &specs[..70]).unwrap();
    let ingest = ["ingest", text(&scope), text(&archive), "--voxel", "4"];
    let ingest = [&ingest[..], &["--list", text(&list)]].concat();
    assert_failed(&run([&ingest[..], &["--once"]].concat()), 1, &["list.json"]);
    let following = Program::start_with(&ingest, &[]);
    let said = says(&following.stderr, "is read again in case it is not whole");
    assert!(said.contains(text(&list)), "{said}");
    std::fs::write(&list, &specs).unwrap();
    says(&following.stderr, "the places are those of");
    drop(following);

    // Who writes it may pause: it is waited for as long as what looks like half of one is elsewhere.
    let written = |ago: u64| {
        std::fs::write(&list, &specs[..70]).unwrap();
        let file = std::fs::File::options().write(true).open(&list).unwrap();
        let at = std::time::SystemTime::now() - Duration::from_secs(ago);
        file.set_modified(at).unwrap();
    };
    let fresh = folder.path().join("fresh");
    let ingest_anew = ["ingest", text(&scope), text(&fresh), "--voxel", "4"];
    let ingest_anew = [&ingest_anew[..], &["--list", text(&list)]].concat();
    written(8);
    let following = Program::start_with(&ingest_anew, &[]);
    says(&following.stderr, "until it has not changed for 30 s");
    std::fs::write(&list, &specs).unwrap();
    says(&following.stderr, "the places are those of");
    drop(following);
    let _what_it_had_made = std::fs::remove_dir_all(&fresh);
    written(8);
    let hasty = [&ingest_anew[..], &["--drop-after", "5"]].concat();
    assert_failed(&run(hasty), 1, &["list.json"]);

    // What rests makes no sense to anybody.
    std::fs::write(&list, &specs[..70]).unwrap();
    let long_ago = std::time::SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000);
    let file = std::fs::File::options().write(true).open(&list).unwrap();
    file.set_modified(long_ago).unwrap();
    let _what_it_had_made = std::fs::remove_dir_all(&archive);
    assert_failed(&run(ingest), 1, &["list.json"]);
}

/// Of a slip in it is told at once, and of the next one, too.
#[test]
fn a_description_with_a_slip_is_told_until_it_is_mended() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    picture(&scope, "a.png", 10);
    let tile = r#"{"record":"tile","tile":"a","file":"a.png","section":0,"size":[40,30],"transform":[1,0,0,1,0,0]}"#;
    std::fs::write(scope.join("tiles.jsonl"), format!("{tile}\n")).unwrap();
    let description = scope.join("volume.json");
    let write = |text: &str| std::fs::write(&description, text).unwrap();
    write(r#"{"name":"cortex","extent":[100,100,5],"voxel_nm":[4,4,40}"#);
    let ingest = ["ingest", text(&scope), text(&archive)];
    let once = run([&ingest[..], &["--once"]].concat());
    assert_failed(&once, 1, &["cannot understand", "volume.json", "column 57"]);
    let following = Program::start_with(&ingest, &[]);
    let said = says(&following.stderr, "is read again");
    for part in [text(&description), "it should hold", "column 57", "30 s"] {
        assert!(said.contains(part), "{said}");
    }
    write(r#"{"name":"cortex","extend":[100,100,5],"voxel_nm":[4,4,40]}"#);
    let said = says(&following.stderr, "is read again");
    assert!(said.contains("extend"), "{said}");
    // What can be read, but is no volume.
    for (impossible, why) in [
        (
            r#"{"name":"cortex","extent":[100,100,5],"voxel_nm":[0,4,40]}"#,
            "not positive",
        ),
        (
            r#"{"name":"cortex","extent":[100,0,5],"voxel_nm":[4,4,40]}"#,
            "at least 1 voxel",
        ),
        (
            r#"{"name":"../x","extent":[100,100,5],"voxel_nm":[4,4,40]}"#,
            "cannot name a volume",
        ),
    ] {
        write(impossible);
        let said = says(&following.stderr, "is read again");
        assert!(said.contains(why) && said.contains("volume.json"), "{said}");
    }
    write(r#"{"name":"cortex","extent":[100,100,5],"voxel_nm":[4,4,40]}"#);
    says(&following.stderr, "1 of 1 tiles");
}

/// What it leads to may be whole or not.
#[cfg(unix)]
#[test]
fn a_link_that_leads_out_is_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive, other] =
        ["scope", "archive", "other.json"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    std::fs::write(&other, "{}").unwrap();
    std::os::unix::fs::symlink(&other, scope.join("volume.json")).unwrap();
    let refused = run(["ingest", text(&scope), text(&archive)]);
    assert_failed(&refused, 1, &["leads out", "volume.json"]);
    let said = stderr(&refused);
    assert!(!said.contains("is read again"), "{said}");
}

/// It may be about others of such names, or be saved too early.
#[test]
fn a_project_of_some_of_the_tiles_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    for name in ["a.png", "b.png", "c.png"] {
        picture(&scope, name, 10);
    }
    let list = scope.join("list.txt");
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--once",
        "--voxel",
        "4",
    ];
    let project = |names: &[&str]| {
        let patch = |(n, name): (usize, &&str)| {
            format!(
                r#"<t2_patch width="40" height="30" transform="matrix(1,0.01,0,1,{},5)" file_path="{name}.png"/>"#,
                n * 36
            )
        };
        let patches: String = names.iter().enumerate().map(patch).collect();
        let text = format!(r#"<trakem2><t2_layer z="0">{patches}</t2_layer></trakem2>"#);
        std::fs::write(scope.join("project.xml"), text).unwrap();
    };
    std::fs::write(&list, "a.png 0 0 0\nb.png 35 0 0\nc.png 70 0 0\n").unwrap();
    project(&["a", "b", "x"]);
    let said = stderr(&done(ingest));
    let told = [
        "knows 2 of the 3 tiles, and is not used",
        "\"c\"",
        "project.xml",
    ];
    for words in told {
        assert_eq!(said.matches(words).count(), 1, "{said}");
    }
    project(&["a", "b", "c"]);
    let said = stderr(&done(ingest));
    assert!(
        !said.contains("is not used") && said.contains("3 moved"),
        "{said}"
    );
    // Which file's places count is told then, and whenever it begins.
    for said in [said, stderr(&done(ingest))] {
        let told = said
            .lines()
            .filter(|line| line.contains("registration has put them"));
        let told: Vec<_> = told.collect();
        assert!(
            matches!(told[..], [line] if line.ends_with("project.xml")),
            "{said}"
        );
    }
}

/// A replay does not wait for whoever could say which one is meant.
#[test]
fn which_of_several_images_is_replayed_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, out] = ["scope", "out"].map(|name| folder.path().join(name));
    for name in ["one/a.png", "two/a.png", "b.png"] {
        std::fs::create_dir_all(scope.join(name).parent().unwrap()).unwrap();
        picture(&scope, name, 10);
    }
    let list = scope.join("list.txt");
    let replay = [
        "simulate",
        text(&out),
        "--input",
        text(&scope),
        "--rate",
        "max",
    ];
    std::fs::write(&list, "two/a.png 0 0 0\nb.png 35 0 0\n").unwrap();
    assert!(!stderr(&done(replay)).contains("several folders"));
    std::fs::remove_dir_all(&out).unwrap();
    std::fs::write(&list, "a.png 0 0 0\nb.png 35 0 0\n").unwrap();
    let said = stderr(&done(replay));
    let told = [
        "the names of 1 images",
        "several folders",
        "one/a.png",
        "two/a.png",
        "list.txt",
    ];
    for words in told {
        assert!(said.contains(words), "{said}");
    }
}

/// Those who look from elsewhere are told what it waits for, as long as it does.
#[test]
fn what_a_list_waits_for_is_in_its_status() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir_all(scope.join("one")).unwrap();
    std::fs::create_dir_all(scope.join("two")).unwrap();
    for name in ["one/a.png", "two/a.png", "b.png"] {
        picture(&scope, name, 10);
    }
    let list = scope.join("list.txt");
    std::fs::write(&list, "a.png 0 0 0\nb.png 35 0 0\n").unwrap();
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--voxel",
        "4",
        "--extent",
        "99,99,9",
    ];
    let ingest = Program::start_with(&ingest, &[]);
    let said = says(&ingest.stderr, "in several folders");
    assert!(
        said.contains("one/a.png") && said.contains("two/a.png"),
        "{said}"
    );
    while !archive.join("catalog.sqlite").exists() {
        std::thread::sleep(Duration::from_millis(20));
    }
    let (_serving, url) = Running::start(saccade().args(["serve", text(&archive), "--port", "0"]));
    let client = Client::of(&url);
    let until = |fits: &dyn Fn(&[serde_json::Value]) -> bool| {
        let fits = |held_up: &serde_json::Value| held_up.as_array().is_some_and(|all| fits(all));
        let answer = client.until("v/scope/status.json", |answer| {
            fits(&answer.json()["held_up"])
        });
        answer.json()["held_up"].as_array().cloned().unwrap()
    };
    let reason = until(&|held_up| !held_up.is_empty()).remove(0);
    let why = reason["why"].as_str().unwrap();
    assert!(
        why.contains("one/a.png") && why.contains("two/a.png"),
        "{why}"
    );
    assert!(
        !why.contains(text(&scope)),
        "where it lies is nobody's matter: {why}"
    );
    assert!(reason["since"].as_u64().unwrap() > 1_700_000_000);
    std::fs::write(&list, "two/a.png 0 0 0\nb.png 35 0 0\n").unwrap();
    until(&|held_up| held_up.is_empty());
}

/// As one that is followed while it goes away.
#[test]
fn what_was_followed_before_is_waited_for_when_it_is_away_at_the_start() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, away, archive] = ["scope", "away", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    picture(&scope, "a.png", 10);
    let list = scope.join("list.txt");
    std::fs::write(&list, "a.png 0 0 0\n").unwrap();
    let ingest = [
        "ingest",
        text(&scope),
        text(&archive),
        "--voxel",
        "4",
        "--extent",
        "99,99,9",
    ];
    std::fs::rename(&scope, &away).unwrap();
    assert_failed(&run(ingest), 1, &["cannot read", text(&scope)]);
    std::fs::rename(&away, &scope).unwrap();
    done([&ingest[..], &["--once"]].concat());

    let (_serving, url) = Running::start(saccade().args(["serve", text(&archive), "--port", "0"]));
    let client = Client::of(&url);
    let until = |is_so: &dyn Fn(&serde_json::Value) -> bool| {
        client.until("v/scope/status.json", |answer| is_so(&answer.json()));
    };
    let waits_for = |status: &serde_json::Value, what: &str| {
        let why = status["held_up"][0]["why"].as_str().unwrap_or_default();
        why.contains(what) && !why.contains(text(folder.path()))
    };
    std::fs::rename(&scope, &away).unwrap();
    let following = Program::start_with(&ingest, &[]);
    says(&following.stderr, "is waited for");
    until(&|status| waits_for(status, "the folder that was followed before is not there"));
    picture(&away, "b.png", 20);
    std::fs::write(away.join("list.txt"), "a.png 0 0 0\nb.png 35 0 0\n").unwrap();
    std::fs::rename(&away, &scope).unwrap();
    says(&following.stderr, "is there again");
    until(&|status| status["tiles"] == 2 && status["held_up"].as_array().unwrap().is_empty());
    drop(following);

    // The list alone, of which the option says where it should be; who waits for the end is told.
    let aside = scope.join("aside");
    std::fs::rename(&list, &aside).unwrap();
    let named = [&ingest[..], &["--list", text(&list)]].concat();
    assert_failed(
        &run([&named[..], &["--once"]].concat()),
        1,
        &["the list of tiles is not there"],
    );
    let following = Program::start_with(&named, &[]);
    says(&following.stderr, "is waited for");
    until(&|status| {
        waits_for(
            status,
            "the list of its tiles that was followed before is not there",
        )
    });
    std::fs::write(&aside, "a.png 0 0 0\n").unwrap();
    std::fs::rename(&aside, &list).unwrap();
    says(&following.stderr, "is there again");
    drop(following);
}

/// Followed, until it is told to end; a list that grows is taken in meanwhile.
#[test]
fn a_list_that_grows_is_followed() {
    let folder = tempfile::tempdir().unwrap();
    let scope = folder.path().join("cortex");
    let archive = folder.path().join("archive");
    std::fs::create_dir(&scope).unwrap();
    let list = scope.join("list.txt");
    std::fs::write(&list, "a.png 0 0 0\n").unwrap();
    picture(&scope, "a.png", 10);
    let options = ["--voxel", "4,4,40", "--extent", "200,100,4", "--lossless"];
    let ingest = ["ingest", text(&scope), text(&archive)];
    let mut following = saccade();
    following.args(ingest).args(options).stderr(Stdio::piped());
    let mut following = Running(following.spawn().unwrap());
    let (send, said) = channel();
    let stderr_of = BufReader::new(following.0.stderr.take().unwrap());
    std::thread::spawn(move || {
        for line in stderr_of.lines().map_while(Result::ok) {
            if send.send(line).is_err() {
                return;
            }
        }
    });
    let tiles = |want: usize| {
        for _ in 0..400 {
            let catalog = archive.join("catalog.sqlite");
            let check = catalog.exists().then(|| run(["check", text(&archive)]));
            if check.is_some_and(|check| stderr(&check).contains(&format!("{want} tiles"))) {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("{want} tiles do not come");
    };
    tiles(1);
    std::fs::write(&list, "a.png 0 0 0\nb.png 35 0 0\nc.png 0 0 1\n").unwrap();
    picture(&scope, "b.png", 20);
    picture(&scope, "c.png", 30);
    tiles(3);
    std::fs::write(&list, "a.png 0 0 0\nc.png 0 0 1\n").unwrap();
    tiles(2);
    // What it knows no more is told, and ends nothing.
    std::fs::write(&list, "a.png 0 0\n").unwrap();
    says(&said, "line 1");
    std::fs::write(&list, "a.png 0 0 0\nc.png 0 0 1\n").unwrap();
    says(&said, "can be read again");
    let id = following.0.id().to_string();
    let told = Command::new("kill").args(["-TERM", &id]).status();
    assert!(told.unwrap().success());
    assert!(following.0.wait().unwrap().success());
}

/// How large it is cannot be mended later.
#[test]
fn a_size_that_a_growing_list_decides_is_told_with_the_way_out() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    std::fs::create_dir(&scope).unwrap();
    for name in ["a.png", "b.png"] {
        picture(&scope, name, 10);
    }
    let list = scope.join("list.txt");
    std::fs::write(&list, "a.png 0 0 0\n").unwrap();
    let ingest = ["ingest", text(&scope), text(&archive), "--once"];
    let ingest = [&ingest[..], &["--voxel", "4"]].concat();
    let said = stderr(&done(&ingest));
    for words in [
        "the 1 tiles that are listed so far decide",
        "40 x 30 x 1 voxels",
        "--volume NAME",
        "--extent and --origin",
    ] {
        assert_eq!(said.matches(words).count(), 1, "{said}");
    }
    std::fs::write(&list, "a.png 0 0 0\nb.png 0 0 1\n").unwrap();
    let grown = run(&ingest);
    ended(
        &grown,
        3,
        &["wholly outside", "--volume NAME", "--extent", "--origin"],
    );
    assert!(!stderr(&grown).contains("so far decide"), "it is known");

    let out = [
        "--volume", "other", "--extent", "90,90,9", "--origin", "0,0",
    ];
    let said = stderr(&done([&ingest[..], &out].concat()));
    assert!(
        said.contains("2 tiles taken in") && !said.contains("so far decide"),
        "{said}"
    );
}
