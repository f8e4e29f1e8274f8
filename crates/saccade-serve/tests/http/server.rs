//! Sources in trouble, servers in trouble.

use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use reqwest::StatusCode;
use saccade_core::volume::Volume;
use saccade_serve::{Options, ServeError, Server};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::{Change, Chunk, ChunkError, ChunkId, VolumeSource};
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
        (
            |id| failed(id, false),
            StatusCode::INTERNAL_SERVER_ERROR,
            None,
        ),
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
