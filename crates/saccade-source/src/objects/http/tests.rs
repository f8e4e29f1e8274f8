//! What becomes of the answers of a server that does not always do its work.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod refused;
mod replaced;
mod transport;

use std::time::Duration;

use super::super::refusals::NOBODYS;
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

fn s3_of(server: &TestServer) -> S3Objects {
    server.s3(patience())
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
        Fault::SlowHead,
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
        Fault::Stall,
        Fault::Drip,
        Fault::SlowHead,
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

/// What a store asks for counts, and so does what readers can bear.
#[tokio::test]
async fn stores_that_ask_for_a_pause_get_it_up_to_a_bound() {
    let server = TestServer::start(conformance::objects()).await;
    let waited = async |patience: Patience, status: &'static str, way: usize| {
        server.fail_next([Fault::Status(status)]);
        let begun = web_time::SystemTime::now();
        let got = ten(&*server.stores(patience)[way]).await;
        assert_eq!(got.unwrap().as_deref(), Some(&b"234567"[..]), "{status}");
        begun.elapsed().unwrap()
    };
    let long = Patience {
        longest_wait: Duration::from_secs(3),
        ..patience()
    };
    for way in 0..2 {
        for status in ["429 Slow", "503 Slow"] {
            let asked = match status {
                "429 Slow" => "429 Slow\r\nretry-after: 1",
                _ => "503 Slow\r\nretry-after: 1",
            };
            let paused = waited(long, asked, way).await;
            assert!(
                paused >= Duration::from_secs(1),
                "{way} {asked}: {paused:?}"
            );
            let hurried = waited(long, status, way).await;
            assert!(hurried < Duration::from_secs(1), "{way}: {hurried:?}");
        }
        let hour = "503 Slow\r\nretry-after: 3600";
        let bounded = waited(patience(), hour, way).await;
        assert!(bounded < Duration::from_secs(1), "{way}: {bounded:?}");
    }
}

/// What is longer than was told is not collected to the end.
#[tokio::test]
async fn s3_reads_no_more_than_was_announced() {
    let server = TestServer::start(conformance::objects()).await;
    for by in [3, 8 << 20] {
        server.fail_next([Fault::Longer(by)]);
        let got = ten(&s3_of(&server)).await;
        assert_eq!(got.unwrap().as_deref(), Some(&b"234567"[..]));
        server.fail_next([Fault::Longer(by); 3]);
        let named = ten(&s3_of(&server)).await.unwrap_err().to_string();
        assert!(
            named.contains("more than the 6 bytes") && named.contains("a/b/ten"),
            "{named}"
        );
    }
}

#[test]
fn secrets_are_not_shown() {
    let store = HttpObjects::new("https://user:pass@host/a?token=secret").unwrap();
    assert_eq!(store.location("b c/d"), "https://host/a/b%20c/d");
    assert!(store.url("b").as_str().contains("token=secret"));
    assert!(HttpObjects::new("file:///etc/passwd").is_err());
}
