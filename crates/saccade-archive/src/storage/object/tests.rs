//! A server on loopback that answers as told, and what becomes of its answers. A real S3 server is asked by [`server`],
//! and in `tests/s3`.

use std::sync::atomic::{AtomicUsize, Ordering};

use object_store::memory::InMemory;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::*;

mod server;

#[tokio::test]
async fn conforms() {
    for prefix in ["", "deep/prefix"] {
        let store = Arc::new(InMemory::new());
        let storage = ObjectStorage::of(store, prefix, "memory".to_owned());
        super::super::conformance::check(Arc::new(storage)).await;
    }
}

#[tokio::test]
async fn prefixes_keep_apart() {
    let store: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
    let storage = |prefix| ObjectStorage::of(store.clone(), prefix, "memory".to_owned());
    let (a, b, all) = (storage("a"), storage("a2"), storage(""));
    a.write_durable("x", Bytes::from_static(b"a"))
        .await
        .unwrap();
    b.write_durable("x", Bytes::from_static(b"b"))
        .await
        .unwrap();
    assert_eq!(a.list("").await.unwrap(), ["x"]);
    assert_eq!(all.list("").await.unwrap(), ["a/x", "a2/x"]);
    a.delete("x").await.unwrap();
    assert_eq!(b.read("x", None).await.unwrap(), b"b"[..]);
}

/// Answers each request with the next of `answers`, the last one for ever. Returns its address and
/// how many it has answered.
async fn server(answers: Vec<&'static str>) -> (String, Arc<AtomicUsize>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let answered = Arc::new(AtomicUsize::new(0));
    let count = answered.clone();
    tokio::spawn(async move {
        loop {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut head = Vec::new();
            while !head.windows(4).any(|w| w == b"\r\n\r\n") {
                let mut some = [0; 4096];
                match stream.read(&mut some).await {
                    Ok(n) if n > 0 => head.extend_from_slice(&some[..n]),
                    _ => break,
                }
            }
            let nth = count.fetch_add(1, Ordering::SeqCst);
            let answer = answers[nth.min(answers.len() - 1)];
            let _ = stream.write_all(answer.as_bytes()).await;
        }
    });
    (url, answered)
}

fn storage(url: &str, more: &[(&str, &str)]) -> ObjectStorage {
    let settings = [
        ("AWS_ENDPOINT_URL", url),
        ("AWS_ACCESS_KEY_ID", "id"),
        ("AWS_SECRET_ACCESS_KEY", "secret"),
    ];
    let settings = settings.iter().chain(more);
    let settings = settings.map(|(name, value)| (name.to_string(), value.to_string()));
    ObjectStorage::with_settings(&"s3://bucket/pre".parse().unwrap(), settings, 3).unwrap()
}

const FORBIDDEN: &str = "HTTP/1.1 403 Forbidden\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const BUSY: &str = "HTTP/1.1 503 Slow Down\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const MANY: &str =
    "HTTP/1.1 429 Too Many Requests\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const NO_KEY: &str = "HTTP/1.1 404 Not Found\r\ncontent-length: 35\r\nconnection: close\r\n\r\n<Error><Code>NoSuchKey</Code></Error>";
const BROKEN_NO_KEY: &str =
    "HTTP/1.1 404 Not Found\r\ncontent-length: 35\r\nconnection: close\r\n\r\n<Error><Code>NoS";
const NO_BUCKET: &str = "HTTP/1.1 404 Not Found\r\ncontent-length: 38\r\nconnection: close\r\n\r\n<Error><Code>NoSuchBucket</Code></Error>";
const ELSEWHERE: &str = "HTTP/1.1 301 Moved\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const FULL: &str =
    "HTTP/1.1 507 Insufficient Storage\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const WRITTEN: &str =
    "HTTP/1.1 200 OK\r\netag: \"a\"\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const REST: &str = "HTTP/1.1 206 Partial Content\r\netag: \"a\"\r\nlast-modified: Sun, 22 Nov 2026 12:00:00 GMT\r\ncontent-range: bytes 2-2/3\r\ncontent-length: 1\r\nconnection: close\r\n\r\nc";
const SHORT: &str = "HTTP/1.1 200 OK\r\netag: \"a\"\r\nlast-modified: Sun, 22 Nov 2026 12:00:00 GMT\r\ncontent-length: 3\r\nconnection: close\r\n\r\nab";

const REST_OF_ANOTHER: &str = "HTTP/1.1 206 Partial Content\r\netag: \"b\"\r\nlast-modified: Sun, 22 Nov 2026 12:00:01 GMT\r\ncontent-range: bytes 2-2/3\r\ncontent-length: 1\r\nconnection: close\r\n\r\nz";
const ANOTHER: &str = "HTTP/1.1 200 OK\r\netag: \"b\"\r\nlast-modified: Sun, 22 Nov 2026 12:00:01 GMT\r\ncontent-length: 3\r\nconnection: close\r\n\r\nxyz";
const EXISTS: &str =
    "HTTP/1.1 412 Precondition Failed\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const CONFLICT: &str = "HTTP/1.1 409 Conflict\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const NOT_IMPLEMENTED: &str =
    "HTTP/1.1 501 Not Implemented\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const ABC: &str = "HTTP/1.1 200 OK\r\netag: \"a\"\r\nlast-modified: Sun, 22 Nov 2026 12:00:00 GMT\r\ncontent-length: 3\r\nconnection: close\r\n\r\nabc";

const LIST: &str = concat!(
    "HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n<ListBucketResult><IsTruncated>false</IsTruncated>",
    "<Contents><Key>pre/x</Key><Size>3</Size><LastModified>2026-11-22T12:00:00.000Z</LastModified><ETag>\"a\"</ETag></Contents>",
    "<Contents><Key>pre/y</Key><Size>4</Size><LastModified>2026-11-22T12:00:00.000Z</LastModified><ETag>\"b\"</ETag></Contents>",
    "</ListBucketResult>"
);
const BROKEN_LIST: &str =
    "HTTP/1.1 200 OK\r\ncontent-length: 900\r\nconnection: close\r\n\r\n<ListBucketResult><IsTrunc";

#[tokio::test]
async fn what_is_refused_is_not_asked_again_and_says_how_to_mend_it() {
    for (answer, advice) in [
        (FORBIDDEN, "AWS_SECRET_ACCESS_KEY"),
        (NO_BUCKET, "no such bucket"),
        (ELSEWHERE, "AWS_REGION"),
    ] {
        let (url, asked) = server(vec![answer]).await;
        let storage = storage(&url, &[]);
        let error = storage.read("a", None).await.unwrap_err();
        assert!(matches!(error, StorageError::Refused { .. }), "{error:?}");
        assert!(
            !error.is_transient() && error.to_string().contains(advice),
            "{error}"
        );
        assert!(error.to_string().contains("s3://bucket/pre/a"), "{error}");
        assert_eq!(asked.load(Ordering::SeqCst), 1);
        let written = storage.write_durable("a", Bytes::from_static(b"abc")).await;
        assert!(
            matches!(written, Err(StorageError::Refused { .. })),
            "{written:?}"
        );
    }
    let (url, asked) = server(vec![NO_KEY]).await;
    let read = storage(&url, &[]).read("a", None).await;
    assert!(
        matches!(read, Err(StorageError::NotFound { .. })),
        "{read:?}"
    );
    assert_eq!(asked.load(Ordering::SeqCst), 1);
    let (url, _) = server(vec![FULL]).await;
    let written = storage(&url, &[]).write_durable("a", Bytes::new()).await;
    assert!(
        matches!(written, Err(StorageError::Full { .. })),
        "{written:?}"
    );
}

#[tokio::test]
async fn what_passes_is_asked_again() {
    let (url, asked) = server(vec![BUSY, "", SHORT, REST]).await;
    assert_eq!(
        storage(&url, &[]).read("a", None).await.unwrap(),
        b"abc"[..]
    );
    assert_eq!(asked.load(Ordering::SeqCst), 4);
    let (url, asked) = server(vec![BUSY, "", WRITTEN]).await;
    let storage = storage(&url, &[]);
    storage
        .write_durable("a", Bytes::from_static(b"abc"))
        .await
        .unwrap();
    assert_eq!(asked.load(Ordering::SeqCst), 3);
}

/// Why an object is not read may break off as well as the object.
#[tokio::test]
async fn refusals_that_break_off_are_asked_for_again() {
    let (url, asked) = server(vec![BUSY, BROKEN_NO_KEY, BROKEN_NO_KEY, NO_KEY]).await;
    let read = storage(&url, &[]).read("a", None).await;
    assert!(
        matches!(read, Err(StorageError::NotFound { .. })),
        "{read:?}"
    );
    assert_eq!(asked.load(Ordering::SeqCst), 4);
    let (url, asked) = server(vec![BROKEN_NO_KEY]).await;
    let error = storage(&url, &[]).read("a", None).await.unwrap_err();
    assert!(error.is_outage(), "{error:?}");
    assert_eq!(asked.load(Ordering::SeqCst), 4, "no more often than others");
    // Nobody answers at all: the client has asked often enough.
    let (url, asked) = server(vec![""]).await;
    let error = storage(&url, &[]).read("a", None).await.unwrap_err();
    assert!(error.is_outage(), "{error:?}");
    assert_eq!(asked.load(Ordering::SeqCst), 4, "by the client alone");
}

/// What has taken the place of what was being read is read from its beginning.
#[tokio::test]
async fn what_changes_while_it_is_read_is_read_anew() {
    let (url, asked) = server(vec![SHORT, REST_OF_ANOTHER, ANOTHER]).await;
    let read = storage(&url, &[]).read("a", None).await.unwrap();
    assert_eq!(read, b"xyz"[..]);
    assert_eq!(asked.load(Ordering::SeqCst), 3);
}

/// A listing that breaks off in its midst is whole in the end, or an outage; never a part of it.
#[tokio::test]
async fn listings_that_break_off_are_begun_again() {
    let (url, asked) = server(vec![BROKEN_LIST, BROKEN_LIST, LIST]).await;
    let listed = storage(&url, &[]).list("").await.unwrap();
    assert_eq!(listed, ["x", "y"]);
    assert_eq!(asked.load(Ordering::SeqCst), 3);
    let (url, _) = server(vec![BROKEN_LIST, LIST]).await;
    storage(&url, &[]).check().await.unwrap();
    let (url, asked) = server(vec![BROKEN_LIST]).await;
    let error = storage(&url, &[]).list("").await.unwrap_err();
    assert!(error.is_outage(), "{error:?}");
    assert!(asked.load(Ordering::SeqCst) >= 3);
    let (url, asked) = server(vec![FORBIDDEN]).await;
    let error = storage(&url, &[]).list("").await.unwrap_err();
    assert!(matches!(error, StorageError::Refused { .. }), "{error:?}");
    assert_eq!(asked.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn what_does_not_pass_is_an_outage() {
    for answer in [BUSY, MANY, ""] {
        let (url, asked) = server(vec![answer]).await;
        let error = storage(&url, &[])
            .write_durable("a", Bytes::new())
            .await
            .unwrap_err();
        assert!(
            matches!(error, StorageError::Unavailable { .. }),
            "{answer}: {error:?}"
        );
        assert!(error.is_outage() && error.is_transient());
        assert!(asked.load(Ordering::SeqCst) >= 4, "{answer}");
    }
}

/// Whatever happens on the way: what is there in the end is what counts.
#[tokio::test]
async fn what_is_created_is_what_is_there() {
    for answers in [
        vec![WRITTEN, ABC],
        vec![EXISTS, ABC],
        // Another's write comes to nothing, or is deleted at once.
        vec![CONFLICT, NO_KEY, WRITTEN, ABC],
        // The answer is lost, and it is done again.
        vec!["", EXISTS, ABC],
        vec![BUSY, WRITTEN, SHORT, REST],
        // A store that knows no conditions is asked whether it is there, as often as the client asks again.
        vec![
            NOT_IMPLEMENTED,
            NOT_IMPLEMENTED,
            NOT_IMPLEMENTED,
            NOT_IMPLEMENTED,
            NO_KEY,
            WRITTEN,
            ABC,
        ],
        vec![
            NOT_IMPLEMENTED,
            NOT_IMPLEMENTED,
            NOT_IMPLEMENTED,
            NOT_IMPLEMENTED,
            ABC,
            ABC,
        ],
    ] {
        let (url, asked) = server(answers.clone()).await;
        let storage = storage(&url, &[]);
        let own = Bytes::from_static(b"own");
        let there = storage.create_durable("a", own).await.unwrap();
        assert_eq!(there, b"abc"[..], "{answers:?}");
        assert_eq!(asked.load(Ordering::SeqCst), answers.len(), "{answers:?}");
    }
    let (url, _) = server(vec![FORBIDDEN]).await;
    let refused = storage(&url, &[]).create_durable("a", Bytes::new()).await;
    assert!(
        matches!(refused, Err(StorageError::Refused { .. })),
        "{refused:?}"
    );
}

/// Nobody listens there, and nobody chose who encrypts: neither is a panic.
#[tokio::test]
async fn encrypted_connections_need_no_preparation() {
    let closed = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("https://{}", closed.local_addr().unwrap());
    drop(closed);
    let storage = storage(&url, &[]);
    let asked = tokio::time::timeout(Duration::from_millis(300), storage.check()).await;
    assert!(!matches!(asked, Ok(Ok(()))), "{asked:?}");
}

#[test]
fn plain_http_is_for_endpoints_that_say_so() {
    let settings = [("AWS_ENDPOINT_URL", "http://localhost:1")];
    let settings = settings.map(|(n, v)| (n.to_owned(), v.to_owned()));
    let location = "s3://bucket".parse().unwrap();
    assert!(ObjectStorage::with_settings(&location, settings, 0).is_ok());
    let half = [("AWS_ACCESS_KEY_ID".to_owned(), "id".to_owned())];
    let error = ObjectStorage::with_settings(&location, half, 0).unwrap_err();
    assert!(matches!(error, StorageError::Refused { .. }), "{error:?}");
}
