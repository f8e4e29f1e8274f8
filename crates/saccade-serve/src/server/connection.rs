//! What a connection goes through: it waits until a request has come, is answered, and waits again.
//!
//! Waiting and answering are done by different threads. Ten thousand clients that send a byte now and then keep those
//! busy that wait; who has asked something does not stand in a line with them.

use std::convert::Infallible;
use std::future::{Future, poll_fn};
use std::net::SocketAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use axum::extract::ConnectInfo;
use axum::http::header::CONNECTION;
use axum::http::{HeaderValue, Request};
use axum::response::Response;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpStream;
use tokio::time::{Instant, timeout_at};

use super::connections::{Answering, Place};
use super::heads::{HEAD_BYTES, Heads, Held, UnderWay};
use super::limits::Limits;
use super::paced::Paced;

/// A client's connection, wherever it is taken care of.
#[derive(Debug)]
pub(super) struct Connection {
    stream: std::net::TcpStream,
    peer: SocketAddr,
    /// What came of the next request.
    held: Held,
    place: Arc<Place>,
    /// When the head of the next request has to be there.
    until: Instant,
}

/// What comes next.
#[derive(Debug)]
pub(super) enum Next {
    /// A request is there.
    Answer(Connection),
    /// The next one has begun, or will.
    Wait(Connection),
    /// It is gone.
    Nothing,
}

/// Waits for the first request of a new connection.
pub(super) async fn begin(
    stream: TcpStream,
    peer: SocketAddr,
    place: Arc<Place>,
    limits: Limits,
    came: impl Fn(),
) -> Next {
    // Chunks are many and small: waiting to fill packets would only delay them.
    if let Err(error) = stream.set_nodelay(true) {
        log::debug!("cannot turn off packet delay: {error}");
    }
    let until = Instant::now() + limits.head;
    wait(stream, peer, Held::default(), place, until, came).await
}

impl Connection {
    /// Waits for the rest of a request.
    pub(super) async fn wait(self, came: impl Fn()) -> Next {
        match TcpStream::from_std(self.stream) {
            Ok(stream) => wait(stream, self.peer, self.held, self.place, self.until, came).await,
            Err(error) => said(self.peer, &error),
        }
    }

    /// Answers its requests until the next one does not come in whole, or `closed` is done.
    pub(super) async fn answer(
        self,
        service: TowerToHyperService<Router>,
        limits: Limits,
        closed: impl Future<Output = ()>,
    ) -> Next {
        let Self {
            peer, held, place, ..
        } = self;
        let stream = match TcpStream::from_std(self.stream) {
            Ok(stream) => stream,
            Err(error) => return said(peer, &error),
        };
        let heads = Heads::new(Paced::new(stream, limits.pace), held);
        let flow = heads.flow().clone();
        let answer = {
            let (place, flow) = (place.clone(), flow.clone());
            service_fn(move |mut request: Request<Incoming>| {
                let kept = (place.answering(), flow.answer());
                // Nothing here takes one: it is not read, and what follows it is not taken for a request.
                let has_body = !request.body().is_end_stream();
                if has_body {
                    flow.body_comes();
                }
                request.extensions_mut().insert(ConnectInfo(peer));
                let response = service.call(request);
                async move {
                    let mut response: Response = response.await?;
                    if has_body {
                        let close = HeaderValue::from_static("close");
                        response.headers_mut().insert(CONNECTION, close);
                    }
                    Ok::<_, Infallible>(response.map(|body| Answer { body, _kept: kept }))
                }
            })
        };
        let mut serving = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(limits.head)
            .max_header_size(HEAD_BYTES)
            .max_buf_size(2 * HEAD_BYTES)
            .serve_connection(TokioIo::new(heads), answer);
        let (mut evicted, mut closed) = (pin!(place.evicted()), pin!(closed));
        let mut closing = false;
        let ended = poll_fn(|cx| {
            if evicted.as_mut().poll(cx).is_ready() {
                return Poll::Ready(Some(Ok(())));
            }
            if !closing && closed.as_mut().poll(cx).is_ready() {
                closing = true;
                Pin::new(&mut serving).graceful_shutdown();
            }
            match Pin::new(&mut serving).poll(cx) {
                Poll::Ready(ended) => Poll::Ready(Some(ended)),
                Poll::Pending if !closing && flow.waits() => Poll::Ready(None),
                Poll::Pending => Poll::Pending,
            }
        });
        match ended.await {
            Some(Ok(())) => Next::Nothing,
            Some(Err(error)) => said(peer, &error),
            None => {
                let parts = serving.into_parts();
                let (paced, held) = parts.io.into_inner().into_parts();
                let until = flow.written() + limits.head;
                let held = held.behind(&parts.read_buf);
                match paced.into_inner().into_std() {
                    Ok(stream) => Next::Wait(Self {
                        stream,
                        peer,
                        held,
                        place: place.clone(),
                        until,
                    }),
                    Err(error) => said(peer, &error),
                }
            }
        }
    }
}

/// Reads until a request is there. `came` is told of each time that only a part of it came.
async fn wait(
    mut stream: TcpStream,
    peer: SocketAddr,
    mut held: Held,
    place: Arc<Place>,
    until: Instant,
    came: impl Fn(),
) -> Next {
    let whole = async {
        let mut space = [0; 1024];
        // One that came back may have more than it seemed.
        let mut whole = held.add(&[]);
        while !whole {
            match stream.read(&mut space).await {
                Ok(0) | Err(_) => return false,
                Ok(count) => whole = held.add(&space[..count]),
            }
            if !whole {
                came();
            }
        }
        true
    };
    let whole = tokio::select! {
        whole = timeout_at(until, whole) => whole.unwrap_or(false),
        () = place.evicted() => false,
    };
    if !whole {
        return Next::Nothing;
    }
    match stream.into_std() {
        Ok(stream) => Next::Answer(Connection {
            stream,
            peer,
            held,
            place,
            until,
        }),
        Err(error) => said(peer, &error),
    }
}

fn said(peer: SocketAddr, error: &dyn std::error::Error) -> Next {
    log::debug!("{peer}: {error}");
    Next::Nothing
}

/// A body that keeps its connection's place, and its client waiting, until it is sent.
struct Answer {
    body: Body,
    _kept: (Answering, UnderWay),
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
