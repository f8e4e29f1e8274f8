//! Sources in trouble, servers in trouble.

use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use glam::UVec3;
use reqwest::StatusCode;
use saccade_archive::catalog::{CatalogError, CatalogLocation};
use saccade_core::volume::Volume;
use saccade_serve::{Options, ServeError, Server, Status, StatusError, StatusSource, Volumes};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::stitched::StitchError;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, Damage, VolumeSource};
use serde_json::Value;

use super::{header, run, serve, serve_source, volume};

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
