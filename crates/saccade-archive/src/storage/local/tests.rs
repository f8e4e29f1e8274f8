//! On the system's disk, and on a simulated one.

use std::fs::{self, File};

use super::super::SimulatedDisk;
use super::*;
use crate::randomness::SeededRandomness;

#[tokio::test]
async fn conforms() {
    let dir = tempfile::tempdir().unwrap();
    let storage = LocalStorage::new(dir.path().join("deep/root")).unwrap();
    super::super::conformance::check(Arc::new(storage)).await;
}

#[tokio::test]
async fn a_folder_in_the_place_of_a_file_is_said_to_be_one() {
    let dir = tempfile::tempdir().unwrap();
    let storage = LocalStorage::new(dir.path()).unwrap();
    fs::create_dir_all(dir.path().join("tiles/a.tif/inside")).unwrap();
    let write = storage.write_durable("tiles/a.tif", Bytes::from_static(b"x"));
    let refused = write.await.unwrap_err();
    assert!(
        matches!(refused, StorageError::Occupied { .. }),
        "{refused}"
    );
    assert!(!refused.is_transient());
    assert!(refused.to_string().contains("tiles/a.tif"), "{refused}");
    assert_eq!(fs::read_dir(dir.path().join(INCOMING)).unwrap().count(), 0);
}

/// Nobody ever writes to the pipe: whoever waited for that would wait for ever.
#[cfg(unix)]
#[tokio::test]
async fn what_is_no_file_is_not_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    let make_pipe = |name: &str| {
        let path = dir.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let made = std::process::Command::new("mkfifo").arg(&path).status();
        assert!(made.unwrap().success());
    };
    make_pipe("tiles/pipe");
    make_pipe(&format!("{INCOMING}/pipe"));
    let storage = LocalStorage::new(dir.path()).unwrap();
    let _socket = std::os::unix::net::UnixListener::bind(dir.path().join("tiles/socket")).unwrap();
    std::os::unix::fs::symlink("/dev/zero", dir.path().join("tiles/zeros")).unwrap();
    for name in ["pipe", "socket", "zeros"] {
        let name = format!("tiles/{name}");
        for range in [None, Some(3..9)] {
            let refused = storage.read(&name, range).await.unwrap_err();
            assert!(matches!(refused, StorageError::NoFile { .. }), "{refused}");
            assert!(!refused.is_transient(), "{refused}");
        }
        storage
            .write_durable(&name, Bytes::from_static(b"abc"))
            .await
            .unwrap();
        assert_eq!(storage.read(&name, None).await.unwrap(), b"abc"[..]);
    }
}

#[tokio::test]
async fn conforms_on_a_simulated_disk() {
    let storage = LocalStorage::on(Arc::new(SimulatedDisk::new()), "deep/root").unwrap();
    super::super::conformance::check(Arc::new(storage)).await;
}

/// Whichever sync fails: nothing that was acknowledged is lost, and the storage says why it stops.
#[tokio::test]
async fn after_a_failed_sync_nothing_more_is_written() {
    let mut stopped = 0;
    for nth in 0..20 {
        let disk = SimulatedDisk::new();
        let storage = LocalStorage::on(Arc::new(disk.clone()), "root").unwrap();
        disk.fail_sync_at(nth);
        let mut acknowledged = Vec::new();
        let mut failed = None;
        for name in ["tiles/a", "tiles/b", "tiles/c/d", "tiles/a"] {
            match storage
                .write_durable(name, Bytes::from_static(b"abc"))
                .await
            {
                Ok(()) => acknowledged.push(name),
                Err(e) => failed = failed.or(Some(e)),
            }
        }
        let Some(error) = failed else {
            assert_eq!(acknowledged.len(), 4);
            continue;
        };
        stopped += 1;
        assert!(matches!(error, StorageError::NotKept { .. }), "{error:?}");
        assert!(!error.is_transient());
        let again = storage.write_durable("e", Bytes::new()).await;
        assert!(
            matches!(again, Err(StorageError::NotKept { .. })),
            "{again:?}"
        );
        for seed in 0..20 {
            let left = disk.after_crash(&mut super::super::Crash::new(seed));
            let left = LocalStorage::on(Arc::new(left), "root").unwrap();
            for name in &acknowledged {
                let read = left.read(name, None).await.unwrap();
                assert_eq!(read, b"abc"[..], "{name}, sync {nth}, seed {seed}");
            }
        }
    }
    assert!(stopped > 5, "only {stopped} syncs failed");
}

/// Its maker died before it was entered durably in the folder above.
#[tokio::test]
async fn folders_that_others_made_are_made_durable() {
    let disk = SimulatedDisk::new();
    let storage = LocalStorage::on(Arc::new(disk.clone()), "root").unwrap();
    disk.create_dir(Path::new("root/tiles")).unwrap();
    disk.create_dir(Path::new("root/tiles/v")).unwrap();
    storage
        .write_durable("tiles/v/a", Bytes::from_static(b"abc"))
        .await
        .unwrap();
    for seed in 0..50 {
        let left = disk.after_crash(&mut super::super::Crash::new(seed));
        let read = left.read(Path::new("root/tiles/v/a"), None).unwrap();
        assert_eq!(read, b"abc"[..]);
    }
}

/// Whoever heard of one, and whoever comes after the power was cut, have the same.
#[tokio::test]
async fn what_is_created_is_one_for_all_whenever_the_power_is_cut() {
    let path = Path::new("root");
    let (mut cuts, mut heard_before_a_cut) = (0, 0);
    for cut in 0.. {
        let disk = SimulatedDisk::new();
        let open = |disk: SimulatedDisk| LocalStorage::on(Arc::new(disk), path).unwrap();
        let [one, other] = [(); 2].map(|()| open(disk.clone()));
        disk.cut_power_at(cut);
        let create =
            |storage: LocalStorage, bytes| async move { storage.create_durable("a", bytes).await };
        let both = futures::join!(
            create(one, Bytes::from_static(b"one's")),
            create(other, Bytes::from_static(b"the other's"))
        );
        let heard: Vec<Bytes> = [both.0, both.1].into_iter().flatten().collect();
        assert!(heard.windows(2).all(|w| w[0] == w[1]), "{heard:?}");
        for seed in 0..100 {
            let left = open(disk.after_crash(&mut super::super::Crash::new(seed)));
            let late = left.create_durable("a", Bytes::from_static(b"late"));
            let there = late.await.unwrap();
            let told = heard.first().unwrap_or(&there);
            assert_eq!(there, told, "cut {cut}, seed {seed}");
            let whole = [&b"one's"[..], b"the other's", b"late"].contains(&&there[..]);
            assert!(whole, "cut {cut}, seed {seed}: {there:?}");
        }
        cuts += 1;
        heard_before_a_cut += u32::from(heard.len() == 1);
        if heard.len() == 2 {
            break;
        }
    }
    assert!(
        cuts > 8 && heard_before_a_cut > 0,
        "{cuts} cuts, {heard_before_a_cut}"
    );
}

/// Its maker died before its name was durable.
#[tokio::test]
async fn what_another_created_is_durable_before_it_is_told() {
    let disk = SimulatedDisk::new();
    let storage = LocalStorage::on(Arc::new(disk.clone()), "root").unwrap();
    let temporary = Path::new("root").join(INCOMING).join("theirs");
    let mut file = disk.create_new(&temporary).unwrap();
    file.write_all(b"theirs").unwrap();
    file.sync().unwrap();
    disk.rename_new(&temporary, Path::new("root/a")).unwrap();
    let created = storage.create_durable("a", Bytes::from_static(b"ours"));
    assert_eq!(created.await.unwrap(), b"theirs"[..]);
    for seed in 0..50 {
        let left = disk.after_crash(&mut super::super::Crash::new(seed));
        let read = left.read(Path::new("root/a"), None).unwrap();
        assert_eq!(read, b"theirs"[..]);
    }
}

#[tokio::test]
async fn abandoned_temporaries_go_and_living_ones_stay() {
    let dir = tempfile::tempdir().unwrap();
    let incoming = dir.path().join(INCOMING);
    fs::create_dir_all(&incoming).unwrap();
    fs::write(incoming.join("1-0"), b"half a til").unwrap();
    let living = File::create(incoming.join("2-0")).unwrap();
    living.lock().unwrap();
    let storage = LocalStorage::new(dir.path()).unwrap();
    assert!(!incoming.join("1-0").exists());
    assert!(incoming.join("2-0").exists());
    assert!(storage.list("").await.unwrap().is_empty());
}

#[tokio::test]
async fn a_failed_write_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let storage = LocalStorage::new(dir.path()).unwrap();
    // A folder stands where the object should go: the rename fails, after the data is written.
    fs::create_dir_all(dir.path().join("tiles/a.tif/x")).unwrap();
    assert!(
        storage
            .write_durable("tiles/a.tif", Bytes::from_static(b"abc"))
            .await
            .is_err()
    );
    assert_eq!(fs::read_dir(dir.path().join(INCOMING)).unwrap().count(), 0);
}

#[tokio::test]
async fn temporaries_of_others_are_neither_touched_nor_in_the_way() {
    let dir = tempfile::tempdir().unwrap();
    let [ours, theirs] = [(); 2].map(|()| Arc::new(SeededRandomness::new(7)));
    let storage = LocalStorage::new(dir.path()).unwrap();
    let storage = storage.with_randomness(ours);
    let incoming = dir.path().join(INCOMING);
    // Whatever the odds: the next names are all taken.
    let write = || storage.write_durable("a", Bytes::from_static(b"ours"));
    write().await.unwrap();
    theirs.next();
    for _ in 0..60 {
        let name = format!("{:016x}", theirs.next());
        fs::write(incoming.join(name), b"theirs").unwrap();
    }
    write().await.unwrap();
    assert_eq!(storage.read("a", None).await.unwrap(), b"ours"[..]);
    for entry in fs::read_dir(&incoming).unwrap() {
        assert_eq!(fs::read(entry.unwrap().path()).unwrap(), b"theirs");
    }
    assert_eq!(fs::read_dir(&incoming).unwrap().count(), 60);
}

#[tokio::test]
async fn a_folder_emptied_by_someone_is_made_anew() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("root");
    let storage = LocalStorage::new(&root).unwrap();
    fs::remove_dir(root.join(INCOMING)).unwrap();
    storage
        .write_durable("tiles/a", Bytes::from_static(b"abc"))
        .await
        .unwrap();
    assert_eq!(storage.list("").await.unwrap(), ["tiles/a"]);
}

/// As where a disk is unmounted: the folder on which it was mounted is in its place.
#[tokio::test]
async fn a_folder_in_the_place_of_the_archive_gets_nothing_and_is_not_believed() {
    let dir = tempfile::tempdir().unwrap();
    let [root, away] = ["root", "away"].map(|name| dir.path().join(name));
    let storage = LocalStorage::new(&root).unwrap();
    let (old, new) = (Bytes::from_static(b"old"), Bytes::from_static(b"new"));
    storage.write_durable("tiles/a", old.clone()).await.unwrap();
    fs::rename(&root, &away).unwrap();
    for impostor in [false, true] {
        if impostor {
            fs::create_dir(&root).unwrap();
        }
        let told = [
            storage.write_durable("tiles/b", new.clone()).await.err(),
            storage.write_durable("c", new.clone()).await.err(),
            storage.read("tiles/a", None).await.err(),
            storage.size("tiles/a").await.err(),
            storage.list("tiles/").await.err(),
            storage.holds_any("").await.err(),
            storage.delete("tiles/a").await.err(),
        ];
        for error in told {
            let error = error.expect("it says so");
            assert!(matches!(error, StorageError::Away { .. }), "{error:?}");
            assert!(error.is_outage() && error.to_string().contains("mounted?"));
            assert!(!error.without_place().contains("root"), "{error}");
        }
        assert_eq!(root.exists(), impostor, "it is not made");
    }
    assert_eq!(fs::read_dir(&root).unwrap().count(), 0);
    fs::remove_dir(&root).unwrap();
    fs::rename(&away, &root).unwrap();
    // Missing now is what was never there.
    let missing = storage.read("tiles/b", None).await;
    assert!(matches!(missing, Err(StorageError::NotFound { .. })));
    storage.write_durable("tiles/b", new).await.unwrap();
    assert_eq!(storage.list("").await.unwrap(), ["tiles/a", "tiles/b"]);
    assert_eq!(storage.read("tiles/a", None).await.unwrap(), old);
}

/// A file system that is mounted again may have another number; the archive's identity is the same.
#[tokio::test]
async fn the_same_archive_is_known_by_its_identity() {
    let dir = tempfile::tempdir().unwrap();
    let [root, away] = ["root", "away"].map(|name| dir.path().join(name));
    let storage = LocalStorage::new(&root).unwrap();
    let identity = |digit: char| format!("{}\n", digit.to_string().repeat(32));
    let written = storage.write_durable(crate::IDENTITY, identity('a').into());
    written.await.unwrap();
    fs::rename(&root, &away).unwrap();
    for (digit, known) in [('b', false), ('a', true)] {
        fs::create_dir_all(&root).unwrap();
        fs::write(root.join(crate::IDENTITY), identity(digit)).unwrap();
        let write = storage.write_durable("a", Bytes::new()).await;
        assert_eq!(write.is_ok(), known, "{digit}: {write:?}");
    }
}

#[tokio::test]
async fn a_folder_that_is_looked_at_stays_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let missing = LocalStorage::as_it_is(dir.path().join("none"));
    assert!(missing.is_err(), "{missing:?}");
    let storage = LocalStorage::as_it_is(dir.path()).unwrap();
    assert!(!storage.holds_any("").await.unwrap());
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[tokio::test]
async fn a_folder_that_is_a_file_cannot_be_opened() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("file"), b"").unwrap();
    let error = LocalStorage::new(dir.path().join("file")).unwrap_err();
    assert!(error.to_string().contains("file/.incoming"), "{error}");
}

#[tokio::test]
async fn what_is_forbidden_is_denied() {
    use std::os::unix::fs::PermissionsExt as _;
    let dir = tempfile::tempdir().unwrap();
    let storage = LocalStorage::new(dir.path()).unwrap();
    storage
        .write_durable("closed/a", Bytes::from_static(b"abc"))
        .await
        .unwrap();
    let closed = dir.path().join("closed");
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o000)).unwrap();
    let read = storage.read("closed/a", None).await;
    let allowed = fs::read_dir(&closed).is_ok();
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o755)).unwrap();
    // The superuser may read everything.
    assert!(
        allowed || matches!(read, Err(StorageError::Denied { .. })),
        "{read:?}"
    );
}

#[test]
fn what_the_system_says_is_sorted() {
    let sorted = |kind: io::ErrorKind| StorageError::new(kind.into(), "n", "p".to_owned());
    assert!(matches!(
        sorted(io::ErrorKind::NotFound),
        StorageError::NotFound { .. }
    ));
    assert!(matches!(
        sorted(io::ErrorKind::StorageFull),
        StorageError::Full { .. }
    ));
    assert!(matches!(
        sorted(io::ErrorKind::QuotaExceeded),
        StorageError::Full { .. }
    ));
    assert!(matches!(
        sorted(io::ErrorKind::PermissionDenied),
        StorageError::Denied { .. }
    ));
    assert!(matches!(
        sorted(io::ErrorKind::ReadOnlyFilesystem),
        StorageError::Denied { .. }
    ));
    assert!(matches!(
        sorted(io::ErrorKind::TimedOut),
        StorageError::Io { .. }
    ));
    // Error number 28 is what a full disk answers.
    let full = StorageError::new(io::Error::from_raw_os_error(28), "n", "p".to_owned());
    assert!(matches!(full, StorageError::Full { .. }) && full.is_transient());
}

#[tokio::test]
async fn names_do_not_leave_the_folder() {
    let dir = tempfile::tempdir().unwrap();
    let storage = LocalStorage::new(dir.path()).unwrap();
    for name in ["../outside", "/etc/hostname", "a/../../outside"] {
        let read = storage.read(name, None).await;
        assert!(
            matches!(read, Err(StorageError::Name { .. })),
            "{name}: {read:?}"
        );
        let write = storage.write_durable(name, Bytes::new()).await;
        assert!(matches!(write, Err(StorageError::Name { .. })), "{name}");
    }
    assert!(!dir.path().parent().unwrap().join("outside").exists());
}
