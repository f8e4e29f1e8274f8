//! Images that are replaced while the list that names them changes, too: all their tiles show what is there in the end.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use saccade_archive::acquisition::Record;
use saccade_ingest::watch::{Disk, Entry, Folders, ListConfig, ListWatch, Stamp};

use super::{Scope, roomy, write};

type Act = Box<dyn FnOnce() + Send>;

/// The file system an hour later, when nothing is so young that it is looked at again in any case; something may happen when
/// the list is looked at.
#[derive(Clone)]
struct Later {
    list: PathBuf,
    then: Arc<Mutex<Option<Act>>>,
}

impl Folders for Later {
    fn modified(&self, folder: &Path) -> io::Result<SystemTime> {
        Disk.modified(folder)
    }

    fn list(
        &self,
        folder: &Path,
    ) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        Disk.list(folder)
    }

    fn stamp(&self, file: &Path) -> io::Result<Stamp> {
        if file == self.list
            && let Some(act) = self.then.lock().unwrap().take()
        {
            act();
        }
        Disk.stamp(file)
    }

    fn now(&self) -> SystemTime {
        Disk.now() + Duration::from_secs(3600)
    }
}

/// Which tiles were told of, each time one was.
fn told(scope: &Scope) -> Vec<String> {
    let tiles = scope
        .records()
        .into_iter()
        .filter_map(|record| match record {
            Record::Tile(tile) => Some(tile.tile),
            Record::Transform(_) | Record::Delete(_) => None,
        });
    tiles.collect()
}

fn quiet(watch: &mut ListWatch<Later>) {
    let mut quiet = 0;
    while quiet < 4 {
        let (told, _) = watch.look().unwrap();
        quiet = if told == 0 { quiet + 1 } else { 0 };
    }
}

/// Follows a list of one image until all is told.
fn begun(scope: &Scope) -> (ListWatch<Later>, Later, PathBuf) {
    let list = scope.file("list.txt");
    write(&list, "a.tif 0 0 0\n");
    scope.image("a", 1);
    let config = ListConfig {
        rest: Duration::ZERO,
        drop_after: Duration::ZERO,
        ..roomy(&list)
    };
    let later = Later {
        list: list.clone(),
        then: Arc::default(),
    };
    let open = || ListWatch::open(config.clone(), later.clone(), &scope.path(), &scope.kept());
    let mut watch = open().unwrap();
    // As `Scope::watch`.
    for _ in 0..50 {
        if watch.leads() {
            break;
        }
        std::thread::sleep(Duration::from_millis(10));
        drop(watch);
        watch = open().unwrap();
    }
    quiet(&mut watch);
    assert_eq!(told(scope), ["a"]);
    (watch, later, list)
}

#[test]
fn an_image_that_is_replaced_before_its_second_tile_is_read_is_another_for_the_first() {
    let scope = Arc::new(Scope::new());
    let (mut watch, later, list) = begun(&scope);
    write(&list, "a.tif 0 0 0\na.tif 64 0 1\n");
    let other = scope.clone();
    // After the folders were looked at, and before the list is read.
    *later.then.lock().unwrap() = Some(Box::new(move || other.image("a", 2)));
    quiet(&mut watch);
    let mut told = told(&scope);
    told.sort();
    told.dedup_by(|a, b| a == b && a != "a");
    assert_eq!(told, ["a", "a", "a-2"], "the first tile has the new image");
}

#[test]
fn an_image_that_is_replaced_as_its_list_changes_is_told_of_again() {
    let scope = Scope::new();
    let (mut watch, _, list) = begun(&scope);
    write(&list, "a.tif 5 0 0\n");
    scope.image("a", 2);
    quiet(&mut watch);
    let told = told(&scope);
    assert!(told.len() >= 2, "{told:?}");
}

/// Without a replacement nothing is told twice.
#[test]
fn a_list_that_changes_tells_of_no_image_again() {
    let scope = Scope::new();
    let (mut watch, _, list) = begun(&scope);
    write(&list, "a.tif 5 0 0\na.tif 64 0 1\n");
    quiet(&mut watch);
    assert_eq!(told(&scope), ["a", "a-2"]);
}
