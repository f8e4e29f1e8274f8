//! What becomes of the answers of a server that does not always do its work.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use super::super::{FolderObjects, MemoryObjects, S3Objects, conformance};
use super::*;
use crate::test_server::{Fault, TestServer};

fn patience() -> Patience {
    Patience {
        attempts: 3,
        first_wait: Duration::from_millis(5),
        longest_wait: Duration::from_millis(50),
        idle: Duration::from_millis(400),
        slowest: 10_000,
    }
}

fn of(server: &TestServer) -> HttpObjects {
    HttpObjects::with_patience(&server.url, patience()).unwrap()
}

/// The same objects by S3's requests, which differ in paths only.
fn s3_of(server: &TestServer) -> S3Objects {
    let endpoint = server.url.trim_end_matches("/sub").to_owned();
    let settings = [
        ("AWS_ENDPOINT_URL".to_owned(), endpoint),
        ("AWS_REGION".to_owned(), "us-east-1".to_owned()),
    ];
    S3Objects::with_settings(&"s3://sub".parse().unwrap(), settings, patience()).unwrap()
}

#[tokio::test]
async fn all_stores_conform() {
    let memory: MemoryObjects = conformance::objects().into_iter().collect();
    conformance::check(&memory).await;
    let folder = tempfile::tempdir().unwrap();
    for (key, bytes) in conformance::objects() {
        let path = folder.path().join(key);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    conformance::check(&FolderObjects::new(folder.path())).await;
    let server = TestServer::start(conformance::objects()).await;
    conformance::check(&of(&server)).await;
}

/// A server that ignores ranges is slow, not wrong.
#[tokio::test]
async fn ignored_ranges_conform() {
    let server = TestServer::start(conformance::objects()).await;
    server.fail_always("", Fault::Whole);
    conformance::check(&of(&server)).await;
}

/// As browsers do, to whom "the last bytes" are a question that needs permission.
#[tokio::test]
async fn ends_that_are_asked_for_by_length_conform() {
    let by_length = |server: &TestServer| HttpObjects {
        suffixes: false,
        ..of(server)
    };
    let server = TestServer::start(conformance::objects()).await;
    conformance::check(&by_length(&server)).await;
    let log = server.log.lock().unwrap().clone();
    let of_an_end = |range: &str| range.starts_with('-');
    let ranges: Vec<_> = log.into_iter().filter_map(|(_, range)| range).collect();
    assert!(
        !ranges.is_empty() && !ranges.iter().any(|range| of_an_end(range)),
        "{ranges:?}"
    );
    // What does not know the question is asked the other one, and what passes is asked again.
    server.fail_next([
        Fault::Status("405 Method Not Allowed"),
        Fault::Status("503 Slow Down"),
    ]);
    let end = by_length(&server).read("a/b/ten", Part::Last(3)).await;
    assert_eq!(end.unwrap().as_deref(), Some(&b"789"[..]));
    server.fail_next([Fault::Status("503 Slow Down")]);
    let end = by_length(&server).read("a/b/ten", Part::Last(3)).await;
    assert_eq!(end.unwrap().as_deref(), Some(&b"789"[..]));
}

async fn ten(store: &dyn Objects) -> Result<Option<Bytes>, ObjectError> {
    store.read("a/b/ten", Part::Range(2..8)).await
}

#[tokio::test]
async fn what_passes_is_waited_for() {
    let server = TestServer::start(conformance::objects()).await;
    let faults = [
        Fault::Status("429 Too Many Requests"),
        Fault::Status("500 Oops"),
        Fault::Status("502 Bad Gateway"),
        Fault::Status("503 Slow Down\r\nretry-after: 0"),
        Fault::Status("504 Late"),
        Fault::Reset,
        Fault::Cut,
        Fault::Stall,
        Fault::Drip,
        Fault::Longer(-2),
        Fault::Longer(3),
        Fault::WrongLength,
        Fault::OtherPart,
    ];
    for fault in faults {
        server.fail_next([fault, fault]);
        let got = ten(&of(&server)).await;
        assert_eq!(got.unwrap().as_deref(), Some(&b"234567"[..]), "{fault:?}");
        // Three times in a row are too often: the message says what, and where.
        server.fail_next([fault; 3]);
        let error = ten(&of(&server)).await.unwrap_err();
        let named = error.to_string();
        assert!(error.is_transient(), "{fault:?}: {named}");
        assert!(
            named.contains("3 attempts") && named.contains("a/b/ten"),
            "{named}"
        );
        assert!(
            server.next.lock().unwrap().is_empty(),
            "{fault:?} was not asked again"
        );
    }
}

#[tokio::test]
async fn what_does_not_pass_is_told_at_once() {
    let server = TestServer::start(conformance::objects()).await;
    for (fault, says) in [
        (Fault::Status("400 Bad Request"), "400"),
        (Fault::Status("501 Not Implemented"), "501"),
        (
            Fault::Status("302 Found\r\nlocation: http://127.0.0.1:1/inside"),
            "http://127.0.0.1:1/inside",
        ),
        (Fault::Endless, "more than"),
    ] {
        let before = server.asked("ten");
        server.fail_next([fault]);
        let error = ten(&of(&server)).await.unwrap_err();
        let named = error.to_string();
        assert!(
            !error.is_transient() && named.contains(says) && named.contains("a/b/ten"),
            "{named}"
        );
        assert_eq!(server.asked("ten"), before + 1, "{fault:?} was asked again");
    }
}

#[tokio::test]
async fn forbidden_is_missing_only_where_all_that_is_missing_is_forbidden() {
    let server = TestServer::start(conformance::objects()).await;
    server.fail_always("ten", Fault::Status("403 Forbidden"));
    for store in [&of(&server) as &dyn Objects, &s3_of(&server)] {
        let error = ten(store).await.unwrap_err();
        let named = error.to_string();
        assert!(
            named.contains("access is denied") && named.contains("ten"),
            "{named}"
        );
    }
    *server.missing.lock().unwrap() = "403 Forbidden";
    for store in [&of(&server) as &dyn Objects, &s3_of(&server)] {
        let before = server.asked(NOBODYS);
        for key in ["none", "a/none", "a/b/ten"] {
            let got = store.read(key, Part::Last(3)).await;
            assert!(matches!(got, Ok(None)), "{key}: {got:?}");
        }
        assert_eq!(server.asked(NOBODYS), before + 1, "it is asked once");
        assert!(store.denied().is_some(), "all was forbidden so far");
        let whole = store.read(".zattrs", Part::Whole { most: 9 }).await;
        assert_eq!(whole.unwrap().as_deref(), Some(&b"{}"[..]));
        assert_eq!(store.denied(), None, "something may be read");
    }
}

#[tokio::test]
async fn requests_are_limited_and_end_with_their_readers() {
    let server = TestServer::start(conformance::objects()).await;
    *server.latency.lock().unwrap() = Duration::from_millis(30);
    let store = of(&server);
    let reads = (0..4 * REQUESTS).map(|_| ten(&store));
    let reads = futures::future::join_all(reads).await;
    assert!(reads.iter().all(Result::is_ok));
    let busiest = server.busiest.load(Ordering::SeqCst);
    assert!((2..=REQUESTS).contains(&busiest), "{busiest} at once");

    *server.latency.lock().unwrap() = Duration::ZERO;
    server.fail_next([Fault::Stall]);
    let given_up = tokio::time::timeout(Duration::from_millis(100), ten(&store)).await;
    assert!(given_up.is_err(), "it stalls");
    for _ in 0..200 {
        if server.gone.load(Ordering::SeqCst) == 1 {
            return;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("the connection is still open");
}

/// A shard whose index is of one file and whose chunks are of another is no shard.
#[tokio::test]
async fn parts_are_of_one_object_as_far_as_the_server_tells() {
    let server = TestServer::start(conformance::objects()).await;
    let store = of(&server);
    let tagged = |tag| *server.tag.lock().unwrap() = tag;
    tagged(Some("\"one\""));
    store.read("a/b/ten", Part::Last(3)).await.unwrap();
    ten(&store).await.unwrap();
    tagged(Some("\"two\""));
    let error = ten(&store).await.unwrap_err();
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
    ten(&of(&server)).await.unwrap();
    for nothing_told in [None, Some("W/\"three\"")] {
        tagged(nothing_told);
        assert!(ten(&store).await.is_ok(), "{nothing_told:?}");
    }
}

#[tokio::test]
async fn s3_waits_for_what_passes() {
    let named = ("c/416/ten".to_owned(), Bytes::from_static(b"0123456789"));
    let objects = conformance::objects().into_iter().chain([named]);
    let server = TestServer::start(objects).await;
    for fault in [
        Fault::Status("503 Slow Down"),
        Fault::Status("500 Oops"),
        Fault::Reset,
        Fault::Cut,
    ] {
        // A number in an address is no answer.
        for key in ["a/b/ten", "c/416/ten"] {
            server.fail_next([fault, fault]);
            let got = s3_of(&server).read(key, Part::Range(2..8)).await;
            assert_eq!(got.unwrap().as_deref(), Some(&b"234567"[..]), "{fault:?}");
        }
    }
    let beyond = s3_of(&server).read("a/b/ten", Part::Range(5..11)).await;
    assert!(matches!(beyond, Err(ObjectError::TooShort { .. })));
}

#[test]
fn secrets_are_not_shown() {
    let store = HttpObjects::new("https://user:pass@host/a?token=secret").unwrap();
    assert_eq!(store.location("b c/d"), "https://host/a/b%20c/d");
    assert!(store.url("b").as_str().contains("token=secret"));
    assert!(HttpObjects::new("file:///etc/passwd").is_err());
}
