//! Lists that somebody is still writing when they are read for the first time.

use std::fs;
use std::path::Path;
use std::time::Duration;

use saccade_archive::acquisition::AcquisitionInfo;
use saccade_ingest::watch::{Disk, ListConfig, ListError, ListWatch, Until, follow};
use saccade_ingest::{Cancel, HeldUp};

use super::{Scope, config, roomy, write};

/// Waits until the watch tells that it waits for something, or gives up after a minute.
fn until_it_waits(held_up: &HeldUp) -> String {
    for _ in 0..2400 {
        if let Some(reason) = held_up.now().first() {
            return reason.why.clone();
        }
        std::thread::sleep(Duration::from_millis(25));
    }
    panic!("it waits for nothing");
}

/// Whoever writes a list as long as it may, so to say.
fn patient(list: &Path) -> ListConfig {
    ListConfig {
        drop_after: Duration::from_secs(600),
        ..roomy(list)
    }
}

/// Follows until it is known what the volume is.
fn begin(scope: &Scope, config: ListConfig, held_up: &HeldUp) -> Begins {
    let mut watch = scope.watch(config).telling(held_up.clone());
    std::thread::spawn(move || {
        follow(&mut watch, Until::Known, false, &Cancel::new())?;
        Ok(watch)
    })
}

type Begins = std::thread::JoinHandle<Result<ListWatch<Disk>, ListError>>;

/// It may have looked whole before, as far as it was written.
#[test]
fn a_first_list_that_ends_in_the_midst_of_a_line_is_waited_for() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    scope.image("a", 1);
    fs::write(&list, "a.tif 0 0 0\nb.tif 5").unwrap();
    let held_up = HeldUp::default();
    let begins = begin(&scope, patient(&list), &held_up);
    let why = until_it_waits(&held_up);
    assert!(why.contains("line 2"), "{why}");
    write(&list, "a.tif 0 0 0\nb.tif 50 0 0\n");
    assert!(begins.join().unwrap().unwrap().is_known());

    // Who waits for the end, or has waited long enough, is told.
    let scope = Scope::new();
    let list = scope.file("list.txt");
    scope.image("a", 1);
    fs::write(&list, "a.tif 0 0 0\nb.tif 5").unwrap();
    let mut watch = scope.watch(patient(&list));
    let once = follow(&mut watch, Until::End, true, &Cancel::new());
    assert!(matches!(once, Err(ListError::List { .. })), "{once:?}");
    drop(watch);
    let mut watch = scope.watch(config(&list));
    let rested = follow(&mut watch, Until::Known, false, &Cancel::new());
    assert!(matches!(rested, Err(ListError::List { .. })), "{rested:?}");
}

/// A place that is cut looks like another place, and would decide for ever how large the volume is.
#[test]
fn a_last_number_that_nothing_ends_is_not_believed_before_it_rests() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    scope.image("a", 1);
    scope.image("b", 2);
    let open = |list: &Path| ListConfig {
        drop_after: Duration::from_secs(600),
        ..config(list)
    };
    fs::write(&list, "a.tif 0 0 0\nb.tif 200 0 10").unwrap();
    let held_up = HeldUp::default();
    let begins = begin(&scope, open(&list), &held_up);
    let why = until_it_waits(&held_up);
    assert!(why.contains("line 2") && why.contains("600 s"), "{why}");
    fs::write(&list, "a.tif 0 0 0\nb.tif 200 0 100\n").unwrap();
    assert!(begins.join().unwrap().unwrap().is_known());
    assert_eq!(held_up.now(), []);
    let depth = |scope: &Scope| AcquisitionInfo::read(&scope.kept()).unwrap().extent.z;
    assert_eq!(depth(&scope), 101);

    // One that rests is whole, and so is one that is said to be.
    for (drop_after, once) in [(1, false), (600, true)] {
        let scope = Scope::new();
        let list = scope.file("list.txt");
        scope.image("a", 1);
        fs::write(&list, "a.tif 0 0 10").unwrap();
        let config = ListConfig {
            drop_after: Duration::from_secs(drop_after),
            ..config(&list)
        };
        let mut watch = scope.watch(config);
        follow(&mut watch, Until::Known, once, &Cancel::new()).unwrap();
        assert!(watch.is_known());
        assert_eq!(depth(&scope), 1);
    }
}
