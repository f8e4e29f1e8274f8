//! A real server on a real socket, asked by a client that shares no code with it.

#![expect(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod api;
mod chunks;
mod described;
mod events;
mod formats;
mod hostile;
mod remote;
mod server;

use std::future::Future;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use glam::{DVec3, UVec3};
use reqwest::header::HeaderMap;
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use saccade_core::volume::Volume;
use saccade_serve::{Options, ServeError, Server, Volumes};
use saccade_source::VolumeSource;
use saccade_source::memory::ArraySource;
use serde_json::Value;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

const EXTENT: UVec3 = UVec3::new(70, 45, 20);
const CHUNK: UVec3 = UVec3::new(32, 16, 8);

/// Odd everywhere, with one whole chunk and some corners that were not acquired.
fn value(voxel: UVec3) -> u8 {
    if voxel.cmplt(CHUNK).all() {
        return 0;
    }
    let UVec3 { x, y, z } = voxel;
    ((x * 7 + y * 31 + z * 101) % 251) as u8
}

fn volume() -> Volume {
    let mut volume = Volume::new("em", EXTENT, DVec3::new(4.0, 4.0, 10.0)).unwrap();
    volume.chunk = CHUNK;
    volume
}

/// z slowest, x fastest.
fn level0() -> Vec<u8> {
    let mut voxels = Vec::new();
    for z in 0..EXTENT.z {
        for y in 0..EXTENT.y {
            voxels.extend((0..EXTENT.x).map(|x| value(UVec3::new(x, y, z))));
        }
    }
    voxels
}

/// A server with one volume.
struct Served {
    source: Arc<ArraySource>,
    client: Client,
    url: String,
    stop: Option<oneshot::Sender<()>>,
    running: JoinHandle<Result<(), ServeError>>,
}

async fn serve(options: Options) -> Served {
    let source = Arc::new(ArraySource::new(volume(), level0()).unwrap());
    let (url, stop, running) = serve_source(source.clone(), options).await;
    Served {
        source,
        client: Client::new(),
        url,
        stop: Some(stop),
        running,
    }
}

async fn serve_source(
    source: Arc<dyn VolumeSource>,
    options: Options,
) -> (
    String,
    oneshot::Sender<()>,
    JoinHandle<Result<(), ServeError>>,
) {
    saccade_archive::tls::provide();
    let volumes = Volumes::new();
    volumes.publish(source, None);
    let server = Server::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .await
        .unwrap();
    let url = server.url();
    let (stop, stopped) = oneshot::channel();
    let running = tokio::spawn(server.run(volumes, options, async { drop(stopped.await) }));
    (url, stop, running)
}

impl Served {
    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.client.request(method, format!("{}{path}", self.url))
    }

    async fn get(&self, path: &str) -> Response {
        self.request(Method::GET, path).send().await.unwrap()
    }

    async fn json(&self, path: &str) -> Value {
        let response = self.get(path).await;
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        serde_json::from_slice(&response.bytes().await.unwrap()).unwrap()
    }

    /// Waits until the server knows of the revision.
    async fn until_revision(&self, revision: u64) {
        while self.json("v/em/volume.json").await["revision"]
            .as_u64()
            .unwrap()
            < revision
        {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }
}

fn header<'h>(headers: &'h HeaderMap, name: &str) -> Option<&'h str> {
    headers.get(name).map(|value| value.to_str().unwrap())
}

/// Runs a test on its own runtime, for at most a minute: a hanging stream fails instead.
fn run(test: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    let limited = async { tokio::time::timeout(Duration::from_secs(60), test).await };
    runtime.block_on(limited).expect("the test hangs");
}
