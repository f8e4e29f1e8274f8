//! An object that takes the place of another while that is read.

use std::fs;
use std::time::SystemTime;

use super::*;

/// A shard whose index is of one file and whose chunks are of another is no shard.
#[tokio::test]
async fn parts_are_of_one_object_as_far_as_the_server_tells() {
    let server = TestServer::start(conformance::objects()).await;
    for n in 0..2 {
        let fresh = || server.stores(patience())[n].clone();
        tags_tell(&server, &*fresh(), &*fresh()).await;
    }
    // Where no tag tells of bytes, the time does; S3 always has tags.
    let store = server.stores(patience())[0].clone();
    let times = [
        "W/\"a\"\r\nlast-modified: Sun, 29 Nov 2026 10:00:00 GMT",
        "W/\"a\"\r\nlast-modified: Sun, 29 Nov 2026 10:00:01 GMT",
    ];
    for (time, same) in [(times[0], true), (times[0], true), (times[1], false)] {
        *server.tag.lock().unwrap() = Some(time);
        let read = store.read("c/long", Part::Range(0..4)).await;
        assert_eq!(read.is_ok(), same, "{read:?}");
    }
}

async fn tags_tell(server: &TestServer, store: &dyn Objects, fresh: &dyn Objects) {
    let tagged = |tag| *server.tag.lock().unwrap() = tag;
    tagged(Some("\"one\""));
    store.read("a/b/ten", Part::Last(3)).await.unwrap();
    ten(store).await.unwrap();
    tagged(Some("\"two\""));
    let error = ten(store).await.unwrap_err();
    let named = error.to_string();
    assert!(matches!(error, ObjectError::Replaced { .. }) && !error.is_transient());
    assert!(
        named.contains("a/b/ten") && named.contains("open the image again"),
        "{named}"
    );
    let others = store.read("c/long", Part::Range(0..4)).await;
    assert!(others.is_ok(), "tags are each object's own: {others:?}");
    let whole = store.read("a/b/ten", Part::Whole { most: 10 }).await;
    assert!(whole.is_ok(), "all of it is of one object: {whole:?}");
    ten(fresh).await.unwrap();
    for nothing_told in [None, Some("W/\"three\"")] {
        tagged(nothing_told);
        assert!(ten(store).await.is_ok(), "{nothing_told:?}");
    }
}

/// Nor is what lies in a folder another by itself.
#[tokio::test]
async fn files_are_told_apart_by_when_and_where_they_were_written() {
    let root = tempfile::tempdir().unwrap();
    let file = root.path().join("shard");
    let write = |text: &str| fs::write(&file, text).unwrap();
    let at = |seconds: u64| {
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
        let file = fs::File::options().write(true).open(&file).unwrap();
        file.set_modified(time).unwrap();
    };
    let part = async |store: &FolderObjects| store.read("shard", Part::Range(2..8)).await;
    let replaces: [(&str, &dyn Fn()); 4] = [
        ("nothing", &|| {}),
        ("written over, of the same length", &|| {
            write("9876543210");
            at(2000);
        }),
        ("longer, of the same time", &|| {
            write("01234567890");
            at(1000);
        }),
        ("another file, of the same time and length", &|| {
            let other = root.path().join("other");
            fs::write(&other, "9876543210").unwrap();
            fs::rename(&other, &file).unwrap();
            at(1000);
        }),
    ];
    for (what, replace) in replaces {
        write("0123456789");
        at(1000);
        let store = FolderObjects::new(root.path());
        let copy = store.clone();
        store.read("shard", Part::Last(3)).await.unwrap();
        assert_eq!(part(&copy).await.unwrap().as_deref(), Some(&b"234567"[..]));
        fs::write(root.path().join("neighbour"), what).unwrap();
        replace();
        let got = part(&copy).await;
        if what == "nothing" {
            assert_eq!(got.unwrap().as_deref(), Some(&b"234567"[..]));
            continue;
        }
        let error = got.unwrap_err();
        let named = error.to_string();
        assert!(
            matches!(error, ObjectError::Replaced { .. }) && !error.is_transient(),
            "{what}: {named}"
        );
        assert!(
            named.contains("shard") && named.contains("open the image again"),
            "{named}"
        );
        let whole = store.read("shard", Part::Whole { most: 20 }).await;
        assert!(whole.is_ok(), "all of it is of one file: {whole:?}");
        assert!(
            part(&FolderObjects::new(root.path())).await.is_ok(),
            "{what}"
        );
    }
}
