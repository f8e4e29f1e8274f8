//! What of a folder with a list is not taken in, or not any more otherwise than it was begun.

use std::fs;
use std::path::Path;

use glam::{DVec2, DVec3, UVec3};
use saccade_core::volume::Dtype;
use saccade_ingest::replay::find_list;
use saccade_ingest::watch::{
    Disk, ListConfig, ListError, ListWatch, Until, WatchError, follow, kept_list,
};
use saccade_ingest::{Cancel, HeldUp};

use super::{SIZE, Scope, config, roomy, write};
use crate::scope::{archive, pixels, seen, texture, tiff8};

/// Who has one image at first is told as much as who lacks one later.
#[test]
fn why_no_image_at_all_is_there_is_told() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let refusal = || {
        let mut watch = scope.watch(config(&list));
        follow(&mut watch, Until::End, true, &Cancel::new()).unwrap_err()
    };
    write(&list, "none.tif 0 0 0\nu/a.tif 0 0 0\n");
    let told = refusal().to_string();
    assert!(told.contains("such as \"none.tif\", is there"), "{told}");
    scope.image("a", 1);
    fs::create_dir(scope.file("u")).unwrap();
    let refused = refusal();
    let why = r#"such as "u/a.tif" ("pictures/a.tif" is not in the folder that the list names)"#;
    assert!(matches!(refused, ListError::NoImages { .. }), "{refused:?}");
    assert!(refused.to_string().contains(why), "{refused}");
    // It may be there by another spelling; what is no image is none.
    for (file, listed) in [
        ("deep/B.TIF", "b.tif"),
        ("Deep/c.jpeg", "/scope/deep/c.tif"),
    ] {
        write(&list, format!("{listed} 0 0 0\n"));
        let at = scope.file(file);
        fs::create_dir_all(at.parent().unwrap()).unwrap();
        fs::write(at.with_extension("txt"), "").unwrap();
        let told = refusal().to_string();
        assert!(!told.contains("is called so"), "{told}");
        fs::write(at, "").unwrap();
        let told = refusal().to_string();
        let why = format!("({file:?} is called so but for its end or the case of letters");
        assert!(told.contains(&why), "{told}");
        // That of another folder is another one.
        write(
            &list,
            format!(
                "{} 0 0 0\n",
                listed
                    .replace("deep/", "other/")
                    .replace("b.tif", "other/b.tif")
            ),
        );
        let told = refusal().to_string();
        assert!(!told.contains("is called so"), "{told}");
    }
}

/// Of what is nothing to read, nothing is opened, and the rest is taken in.
#[cfg(unix)]
#[tokio::test]
async fn what_is_no_file_is_missing() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let names = ["a", "b", "c", "d", "e", "f"];
    let lines = names.map(|name| format!("far/{name}.tif 0 0 0\n"));
    write(&list, lines.concat());
    scope.image("a", 1);
    let link = |to: &Path, name: &str| std::os::unix::fs::symlink(to, scope.file(name)).unwrap();
    link(&scope.file("nowhere.tif"), "pictures/b.tif");
    for pipe in ["pictures/c.tif", "piped.txt", "piped.xml", "early/f.tif"] {
        let path = scope.file(pipe);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let made = std::process::Command::new("mkfifo").arg(&path).status();
        assert!(made.unwrap().success());
    }
    link(Path::new("/dev/zero"), "pictures/d.tif");
    // Of two that have its name, the one that is a file.
    scope.image("f", 6);
    assert_eq!(find_list(&scope.path()).unwrap().as_ref(), Some(&list));
    let watch = scope.once(roomy(&list), &archive).await;
    let missing = watch.missing().unwrap();
    drop(watch);
    let said = [
        "3 of the 6 images that the list names cannot be read",
        r#""pictures/b.tif" is a link to nothing"#,
        r#""pictures/c.tif" is no regular file"#,
        r#""pictures/d.tif" is no regular file"#,
        "1 of the 6 images that the list names are not found below",
        r#"such as "far/e.tif""#,
    ];
    for said in said {
        assert!(missing.contains(said), "{missing}");
    }
    let taken: Vec<_> = seen(&archive).await.into_keys().collect();
    assert_eq!(taken, ["a", "f"]);

    // A link may lead to something later, while its folder stays as it is.
    let mut watch = scope.watch(roomy(&list));
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    fs::write(scope.file("nowhere.tif"), tiff8(SIZE, &texture(SIZE, 2))).unwrap();
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    let missing = watch.missing().unwrap();
    assert!(missing.contains("2 of the 6 images"), "{missing}");
    assert!(!missing.contains("b.tif"), "{missing}");
}

/// Who sees an image of that name in the folder is told why it does not count.
#[tokio::test]
async fn what_is_not_taken_is_named_with_the_reason() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.image("r", 1);
    scope.image("NONE", 1);
    write(&list, "s0/r.tif 0 0 0\ns1/r.tif 0 0 1\nnone.tif 0 0 0\n");
    let watch = scope.once(roomy(&list), &archive).await;
    let missing = watch.missing().unwrap();
    let reason = r#"("pictures/r.tif" fits other images of the list as well; name it with its folders there)"#;
    assert!(
        missing.contains(&format!(r#""s0/r.tif" {reason}"#)),
        "{missing}"
    );
    assert!(
        missing.contains(&format!(r#""s1/r.tif" {reason}"#)),
        "{missing}"
    );
    let nearly =
        r#""none.tif" ("pictures/NONE.tif" is called so but for its end or the case of letters;"#;
    assert!(missing.contains(nearly), "{missing}");
    assert!(seen(&archive).await.is_empty());
}

/// A slip in a number binds nobody.
#[tokio::test]
async fn sections_that_no_volume_holds_are_refused_before_anything_is_kept() {
    let scope = Scope::new();
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.image("a", 1);
    scope.image("b", 2);
    let kinds = [
        ("list.txt", "a.tif 0 0 Z\nb.tif 40 0 Y\n", 2),
        (
            "TileConfiguration.txt",
            "dim = 3\na.tif; ; (0, 0, Z)\nb.tif; ; (40, 0, Y)\n",
            3,
        ),
    ];
    for (name, text, line) in kinds {
        let list = scope.file(name);
        let text = text.replace('Z', "7");
        write(&list, text.replace('Y', "2000000000"));
        let mut watch = scope.watch(config(&list));
        let refused = follow(&mut watch, Until::End, true, &Cancel::new()).unwrap_err();
        assert!(
            matches!(refused, ListError::Sections { first: 7, .. }),
            "{refused}"
        );
        let refused = refused.to_string();
        let line = format!("line {line}: ");
        let limit = saccade_core::volume::MAX_EXTENT.to_string();
        for said in [&line, "b.tif", "2000000000", &limit, name] {
            assert!(refused.contains(said), "{refused}");
        }
        drop(watch);
        assert!(!scope.kept().join("volume.json").exists());
        assert!(!scope.kept().join("watched.json").exists());
        fs::remove_file(list).unwrap();
    }
    let list = scope.file("list.txt");
    write(&list, "a.tif 0 0 7\nb.tif 40 0 8\n");
    scope.once(config(&list), &archive).await;
    assert_eq!(seen(&archive).await.len(), 2);
}

#[tokio::test]
async fn it_goes_on_as_it_was_begun_or_not_at_all() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    write(&list, "a.tif 100 50 3\nb.tif 140 50 3\n");
    scope.image("a", 1);
    let watch = scope.once(config(&list), &archive).await;
    let missing = watch.missing().unwrap();
    assert!(
        missing.contains("1 of the 2 images") && missing.contains("b.tif"),
        "{missing}"
    );
    drop(watch);
    assert_eq!(
        kept_list(&scope.path(), &scope.kept()),
        Some(list.canonicalize().unwrap())
    );

    // What is listed later lies in the frame that was settled at first.
    scope.image("b", 2);
    scope.image("c", 3);
    write(&list, "a.tif 100 50 3\nb.tif 140 50 3\nc.tif 120 70 3\n");
    let watch = scope.once(config(&list), &archive).await;
    assert_eq!(watch.missing(), None);
    drop(watch);
    let places: Vec<_> = seen(&archive)
        .await
        .values()
        .map(|t| t.transform[4..].to_vec())
        .collect();
    assert_eq!(places, [[0.0, 0.0], [40.0, 0.0], [20.0, 20.0]]);
    let told = scope.records().len();
    // What is said to be as it was settled is so.
    let same = ListConfig {
        origin: Some(DVec2::new(100.0, 50.0)),
        first: Some(3),
        extent: Some(UVec3::new(100, 50, 1)),
        dtype: Some(Dtype::Uint8),
        ..config(&list)
    };
    drop(scope.once(same, &archive).await);
    assert_eq!(scope.records().len(), told, "nothing is told again");

    let other = scope.file("other.txt");
    fs::copy(&list, &other).unwrap();
    for (config, differs) in [
        (
            ListConfig {
                voxel_nm: DVec3::ONE,
                ..config(&list)
            },
            "voxel-nm is 4 x 4 x 40 there",
        ),
        (
            ListConfig {
                scale: 2.0,
                ..config(&list)
            },
            "pixel is 1.0 there, 2.0 now",
        ),
        (
            ListConfig {
                first: Some(2),
                ..config(&list)
            },
            "first is 3 there, 2 now",
        ),
        (
            ListConfig {
                origin: Some(DVec2::ZERO),
                ..config(&list)
            },
            "origin is 100.0 x 50.0 there",
        ),
        (
            ListConfig {
                dtype: Some(Dtype::Uint16),
                ..config(&list)
            },
            "8 bits there, 16 bits now",
        ),
        (roomy(&list), "extent is 100 x 50 x 1 there"),
        (config(&other), "list is list.txt there, other.txt now"),
    ] {
        let refused = ListWatch::open(config, Disk, &scope.path(), &scope.kept());
        let Err(ListError::Watch(WatchError::Other { differences, .. })) = refused.map(|_| ())
        else {
            panic!("{differs}")
        };
        assert!(differences.contains(differs), "{differences}");
    }
    assert!(scope.watch(config(&list)).leads());
}

/// Which of two files is meant, only a list that names their folders can say.
#[tokio::test]
async fn a_name_that_is_in_two_folders_is_not_guessed() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    for (seed, name) in (1..).zip(["one/a", "two/a", "one/b"]) {
        scope.image(name, seed);
    }
    write(&list, "a.tif 0 0 0\nb.tif 50 0 0\n");
    let held_up = HeldUp::default();
    let mut watch = scope.watch(roomy(&list)).telling(held_up.clone());
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    let missing = watch.missing().unwrap();
    for said in [
        "1 of the 2 images",
        "\"a.tif\"",
        "pictures/one/a.tif",
        "pictures/two/a.tif",
        "folders",
    ] {
        assert!(missing.contains(said), "{missing}");
    }
    let why = held_up.now();
    assert!(
        why.len() == 1 && why[0].why.contains("pictures/two/a.tif"),
        "{why:?}"
    );
    assert_eq!(scope.records().len(), 1);

    // Either the list or the folder may be mended.
    write(&list, "two/a.tif 0 0 0\nb.tif 50 0 0\n");
    std::thread::sleep(std::time::Duration::from_millis(100));
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    assert_eq!((watch.missing(), held_up.now()), (None, vec![]));
    drop(watch);
    scope.once(roomy(&list), &archive).await;
    assert_eq!(pixels(&seen(&archive).await["a"]).await, texture(SIZE, 2));

    let mut watch = scope.watch(roomy(&list));
    scope.image("one/c", 4);
    scope.image("two/c", 5);
    write(&list, "two/a.tif 0 0 0\nb.tif 50 0 0\nc.tif 0 50 0\n");
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    assert!(watch.missing().unwrap().contains("one/c.tif"));
    fs::remove_file(scope.file("pictures/one/c.tif")).unwrap();
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    assert_eq!(watch.missing(), None);
    assert_eq!(scope.records().len(), 3);
}

/// Whoever writes the folder would show what is another's.
#[cfg(unix)]
#[tokio::test]
async fn a_list_is_not_found_behind_a_link_that_leads_out() {
    use std::os::unix::fs::symlink;
    let scope = Scope::new();
    scope.image("a", 1);
    let elsewhere = scope.0.path().join("elsewhere.txt");
    write(&elsewhere, "a.tif 0 0 0\n");
    let list = scope.file("list.txt");
    symlink(&elsewhere, &list).unwrap();
    let refused = find_list(&scope.path()).unwrap_err();
    let refused = std::error::Error::source(&refused).unwrap().to_string();
    assert!(
        refused.contains("leads out") && refused.contains("list.txt"),
        "{refused}"
    );
    // Another is not held up by it, and one that stays inside is followed.
    write(&scope.file("pictures/deep.txt"), "a.tif 0 0 0\n");
    let deep = scope.file("pictures/deep.txt");
    assert_eq!(find_list(&scope.path()).unwrap().as_ref(), Some(&deep));
    fs::remove_file(&list).unwrap();
    symlink(&deep, &list).unwrap();
    assert_eq!(find_list(&scope.path()).unwrap().as_ref(), Some(&list));
    // Nor is registration that lies elsewhere.
    let own = scope.file("own.txt");
    write(&own, "dim = 2\na.tif; ; (0, 0)\n");
    symlink(&elsewhere, scope.file("own.registered.txt")).unwrap();
    let mut watch = scope.watch(config(&own));
    let refused = follow(&mut watch, Until::End, true, &Cancel::new()).unwrap_err();
    let refused = format!("{:?}", std::error::Error::source(&refused));
    assert!(refused.contains("LeadsOut"), "{refused}");
}
