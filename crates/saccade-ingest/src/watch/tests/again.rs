//! Files that are told of again, since they are others than they were.

use super::*;

/// Looks for so long, as often as it would.
fn look_for(watch: &mut Watch<Disk>, seconds: f64) {
    let end = SystemTime::now() + Duration::from_secs_f64(seconds);
    while SystemTime::now() < end {
        looks(watch);
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Copying programs set a file's space aside, and fill it.
#[test]
fn a_file_that_is_filled_after_it_was_told_of_is_told_of_again() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    let path = scope.join("s1/r1_c1_a.tif");
    image(&path, 32, 1);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    look_for(&mut watch, 0.5);
    assert_eq!(told(&kept).len(), 1);
    let bytes = fs::read(&path).unwrap();
    for n in 0..4 {
        // In place: its folder does not change.
        let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
        std::os::unix::fs::FileExt::write_all_at(&file, &[n], bytes.len() as u64 - 1).unwrap();
        look_for(&mut watch, 0.6);
    }
    look_for(&mut watch, 2.5);
    // Not for each of its parts.
    assert_eq!(told(&kept).len(), 2);
    look_for(&mut watch, 1.5);
    drop(watch);
    look_for(
        &mut Watch::open(config(), Disk, &scope, &kept).unwrap(),
        1.5,
    );
    assert_eq!(told(&kept).len(), 2, "once is enough");
}

/// With the length and the time of the old one, as copying programs keep them: while it is watched, and while nobody
/// does.
#[test]
fn a_file_that_is_renamed_over_another_is_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    let path = scope.join("s1/r1_c1_a.tif");
    let long_ago = SystemTime::now() - Duration::from_secs(3600);
    let replace = |value| {
        image(&path, 32, value);
        let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
        file.set_modified(long_ago).unwrap();
    };
    replace(1);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    look_for(&mut watch, 0.5);
    replace(2);
    look_for(&mut watch, 3.0);
    assert_eq!(told(&kept).len(), 2);
    drop(watch);
    replace(3);
    // Links and permissions are another matter.
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
    fs::hard_link(&path, folder.path().join("link")).unwrap();
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
    // As a process left it that died when it had told and not kept what the file looked like.
    let kept_stamps = fs::read(kept.join("stamps")).unwrap();
    fs::write(kept.join("stamps"), &kept_stamps[..kept_stamps.len() - 16]).unwrap();
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
    // As an earlier version left it: times alone count, and nothing comes again.
    fs::remove_file(kept.join("stamps")).unwrap();
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
}
