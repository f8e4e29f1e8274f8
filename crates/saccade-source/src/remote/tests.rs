#![allow(clippy::cast_possible_truncation, reason = "test volumes are small")]
#![expect(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

mod server;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use futures::StreamExt;
use glam::{DVec3, UVec3};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::{RemoteError, RemoteOptions, RemoteSource, volumes_with};
use crate::conformance::{check_changes, check_changes_after, check_missed, check_reading};
use crate::memory::ArraySource;
use crate::objects::Patience;
use crate::test_server::TestServer;
use crate::{ChangeReason, Chunk, ChunkError, ChunkId, SourceError, VolumeSource};
use server::{Fault, Server, until};

const FIRST: ChunkId = ChunkId {
    channel: 0,
    level: 0,
    chunk: UVec3::ZERO,
};

fn array() -> ArraySource {
    let extent = UVec3::new(45, 33, 9);
    let mut volume = Volume::new("v 1", extent, DVec3::new(4.0, 4.0, 9.0)).unwrap();
    volume.chunk = UVec3::new(16, 16, 4);
    // The right third was not acquired.
    let values = VoxelBox::of_size(extent).iter().map(|v| match v.x {
        30.. => 0,
        x => ((x * 7 + v.y * 31 + v.z * 101) % 255 + 1) as u8,
    });
    ArraySource::new(volume, values.collect()).unwrap()
}

fn options() -> RemoteOptions {
    RemoteOptions {
        reconnect: Duration::from_millis(5),
        reconnect_at_most: Duration::from_millis(50),
        ..RemoteOptions::default()
    }
}

async fn start() -> (Arc<Server>, RemoteSource) {
    let server = Server::start(array()).await;
    let remote = RemoteSource::open_with(&server.base, "v 1", options()).await;
    (server, remote.unwrap())
}

/// Runs a test with a limit, so that a lost answer fails instead of hanging.
fn run(test: impl Future<Output = ()>) {
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime = runtime.worker_threads(2).enable_all().build().unwrap();
    let limited = async { tokio::time::timeout(Duration::from_secs(30), test).await };
    runtime.block_on(limited).expect("the test ends in time");
}

/// A chunk as the array has it, in full.
fn truth(array: &ArraySource, id: ChunkId) -> Vec<u8> {
    match pollster::block_on(array.read(id)).unwrap() {
        Chunk::Voxels(bytes) => bytes.to_vec(),
        Chunk::Empty => vec![0; 16 * 16 * 4],
    }
}

#[test]
fn conforms() {
    run(async {
        let (server, remote) = start().await;
        check_reading(&remote, |id| truth(&server.source, id), 0)
            .await
            .unwrap();
    });
}

#[test]
fn changes_arrive_across_broken_connections() {
    run(async {
        let (server, remote) = start().await;
        let mut n = 0;
        let change = async || {
            n += 1;
            if n % 2 == 0 {
                server.cut_events();
            }
            let min = UVec3::new(n, 3, 1);
            server.set(VoxelBox::new(min, min + 7), n as u8 * 20)
        };
        let oracle = |id| truth(&server.source, id);
        check_changes(&remote, 6, change, oracle, 0).await.unwrap();
        // Two ways of asking for the same: where it left off, not from the start.
        let resumed = server
            .requests("/events")
            .into_iter()
            .filter_map(|(_, last)| last);
        assert!(resumed.max() >= Some(2), "{:?}", server.requests("/events"));
    });
}

/// Also where the server is in trouble for a moment, which is no reason to read everything anew.
#[test]
fn what_has_changed_since_a_revision_is_asked_for() {
    run(async {
        let (server, remote) = start().await;
        let mut n = 0;
        let change = async || {
            n += 5;
            let min = UVec3::new(n, 3, 1);
            server.set(VoxelBox::new(min, min + 7), n as u8)
        };
        let trouble = [
            Fault::Status("503 Service Unavailable"),
            Fault::Status("500 Oops"),
        ];
        server.faults.lock().unwrap().extend(trouble);
        check_changes_after(&remote, change).await.unwrap();
        assert!(server.requests("/changes/").len() > 6);
        // A server that has no such thing is not asked for ever.
        let lasts = [Fault::Status("404 Not Found"); 5];
        server.faults.lock().unwrap().extend(lasts);
        assert_eq!(remote.changes_after(0).await, None);
        assert!(server.faults.lock().unwrap().is_empty());
        let refused = Fault::Status("400 Bad Request");
        server.faults.lock().unwrap().push_back(refused);
        assert_eq!(remote.changes_after(0).await, None);
    });
}

#[test]
fn chunks_that_changed_have_new_addresses() {
    run(async {
        let (server, remote) = start().await;
        let mut changes = remote.changes();
        remote.read(FIRST).await.unwrap();
        let far = ChunkId {
            chunk: UVec3::new(0, 2, 2),
            ..FIRST
        };
        server.set(VoxelBox::of_size(UVec3::splat(4)), 9);
        assert_eq!(changes.next().await.unwrap().revision, 1);
        remote.read(FIRST).await.unwrap();
        remote.read(far).await.unwrap();
        let asked: Vec<_> = server
            .requests("/zarr/")
            .into_iter()
            .map(|(t, _)| t)
            .collect();
        let base = "/sub/v/v%201/zarr/0/c/0";
        let want = ["0/0/0?r=0", "0/0/0?r=1", "2/2/0?r=0"].map(|end| format!("{base}/{end}"));
        assert_eq!(asked, want);
    });
}

#[test]
fn what_was_forgotten_is_missed() {
    run(async {
        let (server, remote) = start().await;
        let one = VoxelBox::of_size(UVec3::splat(2));
        until(|| !server.requests("/events").is_empty()).await;
        let cause = async || {
            server.cut_events();
            server.set(one, 5);
            server.set(one, 6);
            server.forget();
        };
        let change = async || server.set(one, 7);
        check_missed(&remote, cause, change).await.unwrap();
    });
}

#[test]
fn nonsense_in_events_is_missed_and_skipped() {
    run(async {
        let (server, remote) = start().await;
        let mut changes = remote.changes();
        server.send("event: weather\nid: 1\ndata: rain\n\n".into());
        server.send("event: change\nid: 2\ndata: {\"revision\":\n\n".into());
        let missed = changes.next().await.unwrap();
        assert_eq!((missed.revision, missed.reason), (2, ChangeReason::Missed));
        assert_eq!(missed.voxels, VoxelBox::of_size(remote.volume().extent()));
    });
}

#[test]
fn failures_are_told_apart_and_pass() {
    run(async {
        let (server, remote) = start().await;
        let whole = Chunk::Voxels(truth(&server.source, FIRST).into());
        for (fault, transient) in [
            (Fault::Reset, true),
            (Fault::Cut, true),
            (Fault::Longer(-1), true),
            (Fault::Longer(1), false),
            (Fault::Endless, false),
            (Fault::Status("500 Internal Server Error"), true),
            (Fault::Status("504 Gateway Timeout"), true),
            (Fault::Status("403 Forbidden"), false),
            // Of a volume that is not there: nothing acquired is told otherwise.
            (Fault::Status("404 Not Found"), true),
        ] {
            // Connections that were open before may break unasked; one fault for each attempt.
            server.faults.lock().unwrap().extend([fault, fault, fault]);
            let error = remote.read(FIRST).await.unwrap_err();
            assert!(
                matches!(error, ChunkError::Failed { .. }),
                "{fault:?}: {error:?}"
            );
            assert_eq!(error.is_transient(), transient, "{fault:?}: {error:?}");
            server.faults.lock().unwrap().clear();
            assert_eq!(remote.read(FIRST).await.unwrap(), whole, "after {fault:?}");
        }
        server.faults.lock().unwrap().push_back(Fault::Drip);
        assert_eq!(
            remote.read(FIRST).await.unwrap(),
            whole,
            "slow is not wrong"
        );
    });
}

/// What is never silent for long, and would take minutes.
#[test]
fn a_chunk_that_trickles_in_is_given_up() {
    run(async {
        let server = Server::start(array()).await;
        let options = RemoteOptions {
            idle: Duration::from_millis(200),
            slowest: 10_000,
            ..options()
        };
        let remote = RemoteSource::open_with(&server.base, "v 1", options).await;
        let remote = remote.unwrap();
        server.faults.lock().unwrap().push_back(Fault::Trickle);
        let failed = tokio::time::timeout(Duration::from_secs(10), remote.read(FIRST)).await;
        let error = failed.expect("it ends").unwrap_err();
        assert!(error.is_transient(), "{error}");
        let ChunkError::Failed { id, source, .. } = &error else {
            panic!("{error:?}")
        };
        assert_eq!(*id, FIRST);
        let named = source.to_string();
        assert!(
            named.contains("of 1024 bytes came in time") && named.contains("zarr/0/c/0/0/0/0"),
            "{named}"
        );
        let whole = Chunk::Voxels(truth(&server.source, FIRST).into());
        assert_eq!(remote.read(FIRST).await.unwrap(), whole);
    });
}

#[test]
fn waits_as_long_as_it_is_told() {
    run(async {
        let (server, remote) = start().await;
        for (status, seconds) in [
            ("503 Service Unavailable\r\nretry-after: 7", 7),
            ("429 Too Many Requests\r\nretry-after: 3", 3),
            ("503 Service Unavailable", 1),
            ("503 Service Unavailable\r\nretry-after: tomorrow", 1),
            ("503 Service Unavailable\r\nretry-after: 999999999", 60),
        ] {
            server
                .faults
                .lock()
                .unwrap()
                .push_back(Fault::Status(status));
            match remote.read(FIRST).await {
                Err(ChunkError::NotReady { retry_after, .. }) => {
                    assert_eq!(retry_after, Duration::from_secs(seconds), "{status}");
                }
                other => panic!("{status}: {other:?}"),
            }
        }
    });
}

/// A server that is busy is one thing, one that cannot do its work another.
#[test]
fn what_a_server_says_is_wrong_is_passed_on() {
    const AWAY: &str = r#"{"error": "not read", "cause": "the catalog's server does not answer"}"#;
    run(async {
        let (server, remote) = start().await;
        let refuse = |status, body| {
            let mut faults = server.faults.lock().unwrap();
            faults.push_back(Fault::Refusal(status, body));
        };
        refuse("503 Service Unavailable\r\nretry-after: 7", AWAY);
        let error = remote.read(FIRST).await.unwrap_err();
        assert!(error.is_transient(), "{error}");
        assert_eq!(error.retry_after(), Some(Duration::from_secs(7)));
        let told = error.to_string();
        assert!(
            told.ends_with("the catalog's server does not answer"),
            "{told}"
        );

        refuse(
            "503 Service Unavailable",
            r#"{"error": "the server is busy"}"#,
        );
        let error = remote.read(FIRST).await.unwrap_err();
        assert!(matches!(error, ChunkError::NotReady { .. }), "{error}");

        refuse("500 Internal Server Error", AWAY);
        let ChunkError::Failed { source, .. } = remote.read(FIRST).await.unwrap_err() else {
            panic!("a failure")
        };
        let told = source.to_string();
        assert!(
            told.contains("500") && told.contains("server does not answer"),
            "{told}"
        );
    });
}

#[test]
fn silence_fails_after_a_while() {
    run(async {
        let server = Server::start(array()).await;
        let idle = Duration::from_millis(80);
        let options = RemoteOptions { idle, ..options() };
        let remote = RemoteSource::open_with(&server.base, "v 1", options)
            .await
            .unwrap();
        server.faults.lock().unwrap().push_back(Fault::Stall);
        let error = remote.read(FIRST).await.unwrap_err();
        let ChunkError::Failed {
            source,
            transient: true,
            ..
        } = error
        else {
            panic!("{error:?}");
        };
        let idle = source.downcast_ref();
        assert!(matches!(idle, Some(RemoteError::Idle { .. })), "{source:?}");
    });
}

#[test]
fn dropping_a_read_hangs_up() {
    run(async {
        let (server, remote) = start().await;
        server.faults.lock().unwrap().push_back(Fault::Stall);
        let read = remote.read(FIRST);
        let asked = until(|| !server.requests("/zarr/").is_empty());
        // The answer stalls, so the request for it is what ends first.
        let first = futures::future::select(read, Box::pin(asked)).await;
        assert!(matches!(first, futures::future::Either::Right(_)));
        assert_eq!(server.gone.load(Ordering::SeqCst), 0);
        drop(first);
        until(|| server.gone.load(Ordering::SeqCst) == 1).await;
        assert!(remote.read(FIRST).await.is_ok());
    });
}

#[test]
fn streams_end_with_the_source() {
    run(async {
        let (_server, remote) = start().await;
        let mut changes = remote.changes();
        drop(remote);
        assert_eq!(changes.next().await, None);
    });
}

#[test]
fn what_cannot_be_opened_says_why() {
    run(async {
        let server = Server::start(array()).await;
        let open = async |base: &str, name: &str| match RemoteSource::open(base, name).await {
            Ok(_) => panic!("opened {name:?} of {base}"),
            Err(error) => error,
        };
        match open(&server.base, "x").await {
            SourceError::NoVolume { name, known } => {
                assert_eq!((name.as_str(), known.join(", ").as_str()), ("x", "v 1, w"));
            }
            other => panic!("{other:?}"),
        }
        for description in [
            "nonsense",
            r#"{"volume":{"name":"v"},"revision":0}"#,
            r#"{"volume":{"name":"v","dtype":"uint8","channels":["c"],"voxel_nm":[1,1,1],"levels":[],"chunk":[1,1,1]},"revision":0}"#,
            r#"{"volume":{"name":"v","dtype":"uint8","channels":["c"],"voxel_nm":[1,1,1],"levels":[{"extent":[4,4,4],"downsampling":[1,1,1]}],"chunk":[4294967295,4294967295,4294967295]},"revision":0}"#,
        ] {
            *server.description.lock().unwrap() = Some(description.into());
            let error = open(&server.base, "v 1").await;
            let SourceError::Open { source, .. } = &error else {
                panic!("{error:?}");
            };
            let answer = source.downcast_ref();
            assert!(
                matches!(answer, Some(RemoteError::Answer { .. })),
                "{source:?}"
            );
        }
        for base in ["", "localhost", "file:///tmp", "http://"] {
            let error = open(base, "v 1").await;
            assert!(
                matches!(error, SourceError::Open { .. }),
                "{base}: {error:?}"
            );
        }
    });
}

/// A connection that breaks, and what stalls, say nothing of what is there.
#[test]
fn volumes_are_asked_for_with_patience() {
    run(async {
        let list = r#"{"volumes": [{"name": "v"}]}"#;
        let server = TestServer::start([("volumes.json".to_owned(), list.into())]).await;
        let patience = Patience {
            attempts: 3,
            first_wait: Duration::from_millis(5),
            longest_wait: Duration::from_millis(50),
            idle: Duration::from_millis(400),
            slowest: 10_000,
        };
        use crate::test_server::Fault;
        for fault in [
            Fault::Reset,
            Fault::Stall,
            Fault::Cut,
            Fault::Status("503 Slow Down"),
        ] {
            server.fail_next([fault, fault]);
            let volumes = volumes_with(&server.url, patience).await;
            assert_eq!(volumes.unwrap(), ["v"], "{fault:?}");
        }
        // Others who are named are not asked.
        let other = TestServer::start([("volumes.json".to_owned(), list.into())]).await;
        let to = format!("302 Found\r\nlocation: {}/volumes.json", other.url);
        let before = server.asked("volumes.json");
        for status in [to.leak(), "404 Not Found"] {
            server.fail_next([Fault::Status(status)]);
            let error = volumes_with(&server.url, patience).await.unwrap_err();
            let named = std::error::Error::source(&error).unwrap().to_string();
            assert!(named.contains(&status[..3]), "{named}");
        }
        assert_eq!(server.asked("volumes.json"), before + 2, "once each");
        assert_eq!(other.asked(""), 0);
    });
}
