//! Folders that lie elsewhere than they did.

use super::*;

const FILES: [&str; 3] = ["s3/r2_c1_b.tif", "s3/r2_c2_b.tif", "s4/r1_c1_a.tif"];

/// Images that were written so many seconds ago.
fn fill(folder: &Path, ago: u64) {
    for file in FILES {
        let path = folder.join(file);
        image(&path, 40, 9);
        set_age(&path, ago);
    }
}

fn set_age(path: &Path, ago: u64) {
    let written = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000 - ago);
    let file = fs::File::options().write(true).open(path).unwrap();
    file.set_modified(written).unwrap();
}

fn open(folder: &Path, kept: &Path, moved: bool) -> Result<Watch<Disk>, WatchError> {
    let config = WatchConfig {
        budget: 99,
        moved,
        ..config()
    };
    Watch::open(config, Disk, folder, kept)
}

#[test]
fn a_folder_that_moved_is_gone_on_with_and_another_of_its_name_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).join("scan");
    let kept = folder.path().join("kept");
    fill(&at("first"), 500);
    looks(&mut open(&at("first"), &kept, false).unwrap());
    assert_eq!(told(&kept).len(), 3);

    // While it is there, another is refused in any case.
    fill(&at("another"), 100);
    let refused = open(&at("another"), &kept, true).err().unwrap();
    assert!(matches!(refused, WatchError::Other { .. }), "{refused}");

    // Copied with its times, and one is imaged again.
    fill(&at("copy"), 500);
    fs::remove_dir_all(folder.path().join("first")).unwrap();
    let mut watch = open(&at("copy"), &kept, false).unwrap();
    looks(&mut watch);
    assert_eq!(told(&kept).len(), 3);
    set_age(&at("copy").join(FILES[1]), 400);
    drop(watch);
    looks(&mut open(&at("copy"), &kept, false).unwrap());
    let tiles = told(&kept);
    assert_eq!(tiles.len(), 4);
    assert!(tiles[3].file.ends_with(FILES[1]));
    // It moves once more, with one that is imaged again on the way.
    fs::create_dir(folder.path().join("away")).unwrap();
    fs::rename(at("copy"), at("away")).unwrap();
    set_age(&at("away").join(FILES[2]), 300);
    looks(&mut open(&at("away"), &kept, false).unwrap());
    let tiles = told(&kept);
    assert_eq!(tiles.len(), 5);
    assert!(tiles[4].file.ends_with(FILES[2]));

    fs::remove_dir_all(folder.path().join("away")).unwrap();
    let refused = open(&at("another"), &kept, false).err().unwrap();
    let said = refused.to_string();
    for word in [
        "of 3 images",
        "3 are here, 0 of them",
        "away/scan",
        "another/scan",
        "--volume",
        "--moved",
    ] {
        assert!(said.contains(word), "{said}");
    }
    // Refused, it is not followed, however often it is tried; nor is one in which nothing is yet.
    assert!(open(&at("another"), &kept, false).is_err());
    fs::create_dir_all(at("empty")).unwrap();
    let refused = open(&at("empty"), &kept, false).err().unwrap();
    assert!(matches!(refused, WatchError::Another { found: 0, .. }));
    assert_eq!(told(&kept).len(), 5);
    // One image of it, such as a blank one, does not make another the same.
    set_age(&at("another").join(FILES[0]), 500);
    let refused = open(&at("another"), &kept, false).err().unwrap();
    assert!(matches!(refused, WatchError::Another { same: 1, .. }));
    looks(&mut open(&at("another"), &kept, true).unwrap());
}

/// However a folder moved, what takes an image's place in it later is told, though it has its size and time.
#[test]
fn what_is_replaced_after_a_folder_moved_is_told() {
    // Of other times, of the same, and renamed as it is.
    for (ago, is_copy) in [(400, true), (500, true), (500, false)] {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let kept = at("kept");
        let replace = |value: u8| {
            let (path, new) = (at("second").join(FILES[1]), at("second").join("new"));
            image(&new, 40, value);
            set_age(&new, ago);
            fs::rename(new, path).unwrap();
        };
        fill(&at("first"), 500);
        looks(&mut open(&at("first"), &kept, false).unwrap());
        if is_copy {
            fill(&at("second"), ago);
            fs::remove_dir_all(at("first")).unwrap();
        } else {
            fs::rename(at("first"), at("second")).unwrap();
        }
        looks(&mut open(&at("second"), &kept, ago != 500).unwrap());
        assert_eq!(told(&kept).len(), 3, "{ago} {is_copy}");
        // Nobody looks meanwhile; the second one is of what was told twice.
        for n in 1..=2 {
            replace(70 + n);
            for _ in 0..2 {
                looks(&mut open(&at("second"), &kept, false).unwrap());
                let tiles = told(&kept);
                assert_eq!(tiles.len(), 3 + usize::from(n), "{ago} {is_copy}");
                assert!(tiles.last().unwrap().file.ends_with(FILES[1]));
            }
        }
        // Moved again, with that one of which more was told than of the others.
        fs::rename(at("second"), at("third")).unwrap();
        looks(&mut open(&at("third"), &kept, true).unwrap());
        fs::rename(at("third"), at("second")).unwrap();
        looks(&mut open(&at("second"), &kept, false).unwrap());
        assert_eq!(told(&kept).len(), 5, "{ago} {is_copy}");
        replace(99);
        looks(&mut open(&at("second"), &kept, false).unwrap());
        assert_eq!(told(&kept).len(), 6, "{ago} {is_copy}");
    }
}

/// Renamed with its folder, a file is what it was, and one that took another's place is not, though it has its size and time.
#[test]
fn what_was_replaced_before_a_folder_moved_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fill(&at("first"), 500);
    looks(&mut open(&at("first"), &at("kept"), false).unwrap());
    image(&at("first").join(FILES[1]), 40, 77);
    set_age(&at("first").join(FILES[1]), 500);
    fs::rename(at("first"), at("second")).unwrap();
    looks(&mut open(&at("second"), &at("kept"), false).unwrap());
    let tiles = told(&at("kept"));
    assert_eq!(tiles.len(), 4);
    assert!(tiles[3].file.ends_with(FILES[1]));
    // What is left in the old place leads to it.
    fs::rename(at("second"), at("third")).unwrap();
    std::os::unix::fs::symlink(at("third"), at("second")).unwrap();
    for place in ["second", "third"] {
        looks(&mut open(&at(place), &at("kept"), false).unwrap());
        assert_eq!(told(&at("kept")).len(), 4);
    }
}

/// Who waits for a folder to come back would not see what is in the place to which it has moved.
#[test]
fn two_places_are_not_followed_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fill(&at("first"), 500);
    let mut first = open(&at("first"), &at("kept"), false).unwrap();
    looks(&mut first);
    fs::rename(at("first"), at("second")).unwrap();
    let refused = open(&at("second"), &at("kept"), false).err().unwrap();
    assert!(matches!(refused, WatchError::Led { .. }), "{refused}");
    assert!(refused.to_string().contains("end that one first"));
    drop(first);
    open(&at("second"), &at("kept"), false).unwrap();
}
