//! What every file system has to answer that is watched, the real one and those of tests alike.

use super::*;

/// Asks one of an empty folder, to which `add` adds files, or folders, by their paths below it.
pub(super) fn conforms<F: Folders>(folders: &F, root: &Path, mut add: impl FnMut(&str, bool)) {
    let entries = |folder: &str| {
        let listed = folders.list(&root.join(folder)).unwrap();
        let mut listed: Vec<_> = listed
            .map(|entry| entry.map(|entry| (entry.name, entry.folder)).unwrap())
            .collect();
        listed.sort();
        listed
    };
    let file = |name: &str| (name.to_owned(), false);
    let folder = |name: &str| (name.to_owned(), true);
    assert_eq!(entries(""), []);

    let before = folders.modified(root).unwrap();
    add("b.tif", false);
    add("a.tif", false);
    assert_eq!(entries(""), [file("a.tif"), file("b.tif")]);
    assert!(folders.modified(root).unwrap() >= before);
    add("s1", true);
    assert_eq!(entries("s1"), []);
    let before = folders.modified(&root.join("s1")).unwrap();
    add("s1/c d.tif", false);
    assert_eq!(entries("s1"), [file("c d.tif")]);
    assert!(folders.modified(&root.join("s1")).unwrap() >= before);
    assert_eq!(entries(""), [file("a.tif"), file("b.tif"), folder("s1")]);

    // What nobody touches looks the same, and is not of the future.
    for name in ["a.tif", "s1/c d.tif"] {
        let looks = [(); 2].map(|()| folders.stamp(&root.join(name)).unwrap());
        assert_eq!(looks[0], looks[1], "{name}");
        assert!(looks[0].modified <= folders.now(), "{name}");
    }
    for none in ["none", "s1/none", "none/a.tif"] {
        let path = root.join(none);
        assert!(folders.modified(&path).is_err(), "{none}");
        assert!(folders.list(&path).is_err(), "{none}");
        assert!(folders.stamp(&path).is_err(), "{none}");
    }
    assert!(folders.list(&root.join("a.tif")).is_err(), "it is a file");
}

#[test]
fn the_disk_conforms() {
    let root = tempfile::tempdir().unwrap();
    let add = |path: &str, is_folder: bool| {
        let path = root.path().join(path);
        match is_folder {
            true => fs::create_dir(path).unwrap(),
            false => fs::write(path, "image").unwrap(),
        }
    };
    conforms(&Disk, root.path(), add);
}
