//! The accept loop, and what a connection goes through.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use axum::extract::ConnectInfo;
use axum::http::Request;
use axum::response::Response;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

use super::connections::{Answering, Connection, Connections};
use super::limits::Limits;
use super::paced::Paced;

/// How long answers under way may take once the server is to stop.
const LAST_ANSWERS: Duration = Duration::from_secs(2);
/// Longest head of a request \[bytes\].
const HEAD_BYTES: usize = 32 * 1024;
/// Until the next attempt, where the system has no more connections to give.
const OUT_OF_FILES: Duration = Duration::from_millis(20);
/// What a client reads for whom there is no place.
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nConnection: close\r\n\
    Access-Control-Allow-Origin: *\r\nContent-Length: 0\r\n\r\n";

/// Accepts connections until `closing` turns true; then finishes the answers under way.
pub(super) async fn accept(
    listener: TcpListener,
    router: Router,
    limits: Limits,
    mut closing: watch::Receiver<bool>,
) {
    let limits = limits.within_open_files();
    let connections = Connections::new(limits.connections);
    let service = TowerToHyperService::new(router);
    let mut tasks = JoinSet::new();
    let mut closed = pin!(closed(closing.clone()));
    loop {
        let accepted = tokio::select! {
            () = &mut closed => break,
            accepted = listener.accept() => accepted,
            Some(_) = tasks.join_next() => continue,
        };
        match accepted {
            Ok((stream, peer)) => match connections.admit() {
                Some(connection) => {
                    let service = service.clone();
                    let closed = self::closed(closing.clone());
                    tasks.spawn(serve(stream, peer, service, limits, connection, closed));
                }
                // Its buffer is empty: this takes no time. A client that is gone does not matter.
                None => drop(stream.try_write(FULL)),
            },
            Err(error) if is_the_client_s(&error) => {}
            Err(error) => {
                log::warn!("no connection can be accepted: {error}");
                connections.evict();
                tokio::time::sleep(OUT_OF_FILES).await;
            }
        }
    }
    drop(listener);
    // Marks the news as seen: every connection has its own receiver.
    closing.mark_unchanged();
    let finished = async { while tasks.join_next().await.is_some() {} };
    // Whoever is not done by then is cut off.
    drop(tokio::time::timeout(LAST_ANSWERS, finished).await);
}

/// Done when the server is to stop, or is gone.
async fn closed(mut closing: watch::Receiver<bool>) {
    drop(closing.wait_for(|closing| *closing).await);
}

/// It went away before it was accepted.
fn is_the_client_s(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset};
    matches!(
        error.kind(),
        ConnectionAborted | ConnectionRefused | ConnectionReset
    )
}

async fn serve(
    stream: TcpStream,
    peer: SocketAddr,
    service: TowerToHyperService<Router>,
    limits: Limits,
    connection: Arc<Connection>,
    closed: impl Future<Output = ()>,
) {
    // Chunks are many and small: waiting to fill packets would only delay them.
    if let Err(error) = stream.set_nodelay(true) {
        log::debug!("cannot turn off packet delay: {error}");
    }
    let answer = {
        let connection = connection.clone();
        service_fn(move |mut request: Request<Incoming>| {
            let answering = connection.answering();
            request.extensions_mut().insert(ConnectInfo(peer));
            let response = service.call(request);
            async move {
                let response: Response = response.await?;
                Ok::<_, Infallible>(response.map(|body| Answer {
                    body,
                    _answering: answering,
                }))
            }
        })
    };
    let mut serving = pin!(
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(limits.head)
            .max_header_size(HEAD_BYTES)
            .max_buf_size(2 * HEAD_BYTES)
            .serve_connection(TokioIo::new(Paced::new(stream, limits.pace)), answer)
    );
    let mut evicted = pin!(connection.evicted());
    tokio::select! {
        ended = &mut serving => return said(peer, ended),
        () = &mut evicted => return,
        () = closed => serving.as_mut().graceful_shutdown(),
    }
    tokio::select! {
        ended = serving => said(peer, ended),
        () = evicted => {}
    }
}

fn said(peer: SocketAddr, ended: hyper::Result<()>) {
    if let Err(error) = ended {
        log::debug!("{peer}: {error}");
    }
}

/// A body that keeps its connection's place until it is sent.
struct Answer {
    body: Body,
    _answering: Answering,
}

impl HttpBody for Answer {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
