//! Sources in trouble, servers in trouble.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::future::WeakShared;
use futures::{FutureExt, StreamExt};
use glam::UVec3;
use reqwest::StatusCode;
use saccade_archive::catalog::{CatalogError, CatalogLocation};
use saccade_core::volume::Volume;
use saccade_serve::{Options, ServeError, Server, Status, StatusError, StatusSource, Volumes};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::stitched::StitchError;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, Damage, VolumeSource};
use serde_json::Value;

use super::{CHUNK, header, run, serve, serve_source, volume};

/// What becomes of a read; `None`: it never ends.
type Trouble = fn(ChunkId) -> Option<ChunkError>;

/// Answers every read the same way.
struct Troubled {
    volume: Arc<Volume>,
    trouble: Trouble,
}

impl VolumeSource for Troubled {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        match (self.trouble)(id) {
            Some(error) => Box::pin(async { Err(error) }),
            None => Box::pin(std::future::pending()),
        }
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        futures::stream::pending().boxed()
    }

    fn damage(&self) -> Vec<Damage> {
        let damage = |n| Damage {
            section: n,
            object: format!("tiles/{n}"),
            reason: "it is missing".to_owned(),
        };
        (0..123).map(damage).collect()
    }
}

/// Where the server keeps its things, which is nobody's business.
const SECRET: &str = "/srv/secret/catalog.sqlite";

fn full() -> CatalogError {
    CatalogError::ReadOnly {
        location: CatalogLocation::File(SECRET.into()),
    }
}

/// A catalog that cannot be used.
struct NoStatus;

impl StatusSource for NoStatus {
    fn status(&self) -> BoxFuture<'_, Result<Status, StatusError>> {
        Box::pin(async {
            Err(StatusError {
                source: Arc::new(full()),
                volume: "em".to_owned(),
                transient: true,
            })
        })
    }
}

/// What is wrong is said to who asks, and not where.
#[test]
fn failures_name_their_cause_and_no_place() {
    run(async {
        saccade_archive::tls::provide();
        let source = Arc::new(Troubled {
            volume: Arc::new(volume()),
            trouble: |id| {
                let source = StitchError::Catalog { source: full() };
                Some(ChunkError::Failed {
                    id,
                    transient: false,
                    source: Arc::new(source),
                })
            },
        });
        let (volumes, server) = (Volumes::new(), Server::bind(([127, 0, 0, 1], 0).into()));
        volumes.publish(source.clone(), Some(Arc::new(NoStatus)));
        let server = server.await.unwrap();
        let url = server.url();
        let running = server.run(volumes.clone(), Options::DEFAULT, std::future::pending());
        let running = tokio::spawn(running);
        let get = async |path: &str| {
            let response = reqwest::get(format!("{url}v/em/{path}")).await.unwrap();
            let status = response.status();
            let text = response.text().await.unwrap();
            assert!(!text.contains("secret"), "{text}");
            (status, serde_json::from_str::<Value>(&text).unwrap())
        };
        for (path, expected) in [
            ("status.json", StatusCode::SERVICE_UNAVAILABLE),
            ("zarr/0/c/0/0/0/0", StatusCode::FAILED_DEPENDENCY),
        ] {
            let (status, refusal) = get(path).await;
            assert_eq!(status, expected);
            let cause = refusal["cause"].as_str().unwrap();
            assert!(
                cause.contains("may only be read: check the permissions"),
                "{cause}"
            );
        }
        // Damage is counted, and the first of it listed.
        volumes.publish(source, None);
        let (_, status) = get("status.json").await;
        assert_eq!(status["damaged"], 123);
        let listed = status["damaged_tiles"].as_array().unwrap();
        assert_eq!(listed.len(), 100);
        assert_eq!(listed[7]["object"], "tiles/7");
        running.abort();
    });
}

/// A source whose reads never end.
pub(super) fn never() -> Arc<dyn VolumeSource> {
    Arc::new(Troubled {
        volume: Arc::new(volume()),
        trouble: |_| None,
    })
}

fn failed(id: ChunkId, transient: bool) -> Option<ChunkError> {
    let source = Arc::new(std::io::Error::other("disk on fire"));
    Some(ChunkError::Failed {
        id,
        transient,
        source,
    })
}

#[test]
fn trouble_says_whether_to_ask_again() {
    fn late(id: ChunkId) -> Option<ChunkError> {
        Some(ChunkError::NotReady {
            id,
            retry_after: Duration::from_millis(2500),
        })
    }
    let cases: [(Trouble, _, _); 4] = [
        (late, StatusCode::SERVICE_UNAVAILABLE, Some("3")),
        (
            |id| failed(id, true),
            StatusCode::SERVICE_UNAVAILABLE,
            Some("1"),
        ),
        (|_| None, StatusCode::SERVICE_UNAVAILABLE, Some("1")),
        (|id| failed(id, false), StatusCode::FAILED_DEPENDENCY, None),
    ];
    run(async move {
        for (trouble, status, retry) in cases {
            let source = Arc::new(Troubled {
                volume: Arc::new(volume()),
                trouble,
            });
            let options = Options {
                patience: Duration::from_millis(20),
                ..Options::DEFAULT
            };
            let (url, _stop, _) = serve_source(source, options).await;
            let response = reqwest::get(format!("{url}v/em/zarr/0/c/0/0/0/0"))
                .await
                .unwrap();
            assert_eq!(response.status(), status);
            assert_eq!(header(response.headers(), "retry-after"), retry);
            let refusal: Value = serde_json::from_slice(&response.bytes().await.unwrap()).unwrap();
            assert!(refusal["error"].is_string());
            if trouble(ChunkId {
                channel: 0,
                level: 0,
                chunk: UVec3::ZERO,
            })
            .is_none()
            {
                let cause = refusal["cause"].as_str().unwrap();
                assert!(
                    cause.contains("level 0 chunk [0, 0, 0]") && cause.contains("0.02 s"),
                    "{cause}"
                );
            }
        }
    });
}

/// A source that reads once for all who ask at the same time, takes its time, and keeps what was read to the end.
struct Slow {
    volume: Arc<Volume>,
    takes: Duration,
    begun: AtomicUsize,
    ended: Arc<AtomicBool>,
    reading: Mutex<Option<WeakShared<BoxFuture<'static, Chunk>>>>,
}

impl VolumeSource for Slow {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, _: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        let bytes = vec![7; CHUNK.element_product() as usize];
        let chunk = Chunk::Voxels(bytes.into());
        if self.ended.load(Ordering::SeqCst) {
            return Box::pin(async { Ok(chunk) });
        }
        let mut reading = self.reading.lock().unwrap();
        let under_way = reading.as_ref().and_then(WeakShared::upgrade);
        let read = under_way.unwrap_or_else(|| {
            self.begun.fetch_add(1, Ordering::SeqCst);
            let (takes, ended) = (self.takes, self.ended.clone());
            let read: BoxFuture<'static, Chunk> = Box::pin(async move {
                tokio::time::sleep(takes).await;
                ended.store(true, Ordering::SeqCst);
                chunk
            });
            let read = read.shared();
            *reading = read.downgrade();
            read
        });
        Box::pin(read.map(Ok))
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        futures::stream::pending().boxed()
    }
}

#[test]
fn what_takes_longer_than_an_answer_may_is_there_in_the_end() {
    run(async {
        for path in ["zarr/0/c/0/1/1/1", "thumbnail.png"] {
            let source = Arc::new(Slow {
                volume: Arc::new(volume()),
                takes: Duration::from_millis(1500),
                begun: AtomicUsize::new(0),
                ended: Arc::default(),
                reading: Mutex::new(None),
            });
            let options = Options {
                patience: Duration::from_millis(300),
                ..Options::DEFAULT
            };
            let (url, _stop, _) = serve_source(source.clone(), options).await;
            let mut late = 0;
            let answer = loop {
                let answer = reqwest::get(format!("{url}v/em/{path}")).await.unwrap();
                if answer.status() != StatusCode::SERVICE_UNAVAILABLE {
                    break answer;
                }
                late += 1;
                assert!(late < 60, "{path} is never there");
                tokio::time::sleep(Duration::from_millis(50)).await;
            };
            assert_eq!(answer.status(), StatusCode::OK, "{path}");
            assert!(late >= 2, "{path} was not late");
            let begun = source.begun.load(Ordering::SeqCst);
            assert_eq!(begun, 1, "{path} was begun anew");
        }
    });
}

#[test]
fn a_port_in_use_is_named_with_the_way_out() {
    run(async {
        let first = Server::bind("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let error = Server::bind(first.address()).await.unwrap_err();
        assert!(matches!(error, ServeError::PortInUse { address } if address == first.address()));
        let message = error.to_string();
        let port = first.address().port().to_string();
        assert!(
            message.contains(&port) && message.contains("--port 0"),
            "{message}"
        );
    });
}

#[test]
fn the_server_stops_when_told() {
    run(async {
        let mut served = serve(Options::DEFAULT).await;
        assert_eq!(served.get("volumes.json").await.status(), StatusCode::OK);
        served.stop.take().unwrap().send(()).unwrap();
        served.running.await.unwrap().unwrap();
        let refused = served.client.get(&served.url).send().await;
        assert!(refused.is_err());
    });
}
