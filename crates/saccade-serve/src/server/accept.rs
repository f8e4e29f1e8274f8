//! The accept loop, and the room where connections wait for their requests.

use std::cell::Cell;
use std::io;
use std::net::SocketAddr;
use std::panic::resume_unwind;
use std::pin::pin;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use axum::Router;
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Handle};
use tokio::sync::{oneshot, watch};
use tokio::task::JoinSet;

use super::connection::{Next, begin};
use super::connections::Connections;
use super::limits::Limits;

/// How long answers under way may take once the server is to stop.
const LAST_ANSWERS: Duration = Duration::from_secs(2);
/// Until the next attempt, where the system has no more connections to give.
const OUT_OF_FILES: Duration = Duration::from_millis(20);
/// What a client reads for whom there is no place.
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nConnection: close\r\n\
    Access-Control-Allow-Origin: *\r\nContent-Length: 0\r\n\r\n";
/// How much less of a processor the room gets than who answers, where both want it: a tenth (Linux's `nice`).
#[cfg(target_os = "linux")]
const NICE: i32 = 10;
/// How long parts of requests wait for others, so that the room is entered for many at once.
const NAP: Duration = Duration::from_millis(1);

thread_local! {
    /// Parts of requests that came since the room last had nothing to do.
    static PARTS: Cell<u32> = const { Cell::new(0) };
}

/// Accepts connections until `closing` turns true; then finishes the answers under way.
///
/// Connections wait in a thread of their own, and are answered where this is called.
///
/// # Errors
///
/// If the system gives no such thread.
pub(super) async fn accept(
    listener: TcpListener,
    router: Router,
    limits: Limits,
    closing: watch::Receiver<bool>,
) -> io::Result<()> {
    let room = Room {
        service: TowerToHyperService::new(router),
        limits: limits.within_open_files(),
        closing,
        answering: Handle::current(),
    };
    let listener = listener.into_std()?;
    let runtime = Builder::new_current_thread()
        .enable_all()
        .on_thread_park(nap)
        .build()?;
    let (end, ended) = oneshot::channel();
    let thread = thread::Builder::new().name("saccade-accept".to_owned());
    let thread = thread.spawn(move || {
        give_way();
        let kept = runtime.block_on(room.keep(listener));
        // Nobody waits where the server was dropped.
        let _ = end.send(kept);
    })?;
    match ended.await {
        Ok(kept) => kept,
        Err(_) => match thread.join() {
            Err(panic) => resume_unwind(panic),
            Ok(()) => Ok(()),
        },
    }
}

/// Lets those go first who answer.
fn give_way() {
    // Elsewhere than on Linux that would be the whole program.
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICE) {
        log::debug!("connections are accepted at full priority: {error}");
    }
}

/// Before the room waits for more. A request that comes whole is never kept waiting by this alone.
fn nap() {
    if PARTS.take() > 0 {
        thread::sleep(NAP);
    }
}

struct Room {
    service: TowerToHyperService<Router>,
    limits: Limits,
    closing: watch::Receiver<bool>,
    /// Where requests are answered.
    answering: Handle,
}

impl Room {
    async fn keep(self, listener: std::net::TcpListener) -> io::Result<()> {
        let listener = TcpListener::from_std(listener)?;
        let connections = Connections::new(self.limits.connections);
        // Of all connections, wherever they are taken care of.
        let mut tasks = JoinSet::new();
        let mut closed = pin!(closed(self.closing.clone()));
        loop {
            let accepted = tokio::select! {
                () = &mut closed => break,
                accepted = listener.accept() => accepted,
                Some(next) = tasks.join_next() => {
                    // One that panicked is gone.
                    self.go_on(next.unwrap_or(Next::Nothing), &mut tasks);
                    continue;
                }
            };
            match accepted {
                Ok((stream, peer)) => self.admit(stream, peer, &connections, &mut tasks),
                Err(error) if is_the_client_s(&error) => {}
                Err(error) => {
                    log::warn!("no connection can be accepted: {error}");
                    connections.evict();
                    tokio::time::sleep(OUT_OF_FILES).await;
                }
            }
        }
        drop(listener);
        // Who has not asked wholly is not answered any more.
        let finished = async { while tasks.join_next().await.is_some() {} };
        // Whoever is not done by then is cut off.
        drop(tokio::time::timeout(LAST_ANSWERS, finished).await);
        Ok(())
    }

    fn admit(
        &self,
        stream: TcpStream,
        peer: SocketAddr,
        connections: &Arc<Connections>,
        tasks: &mut JoinSet<Next>,
    ) {
        match connections.admit() {
            Some(place) => {
                let began = begin(stream, peer, place, self.limits, came);
                tasks.spawn(self.unless_closed(began));
            }
            // Its buffer is empty: this takes no time. A client that is gone does not matter.
            None => drop(stream.try_write(FULL)),
        }
    }

    fn go_on(&self, next: Next, tasks: &mut JoinSet<Next>) {
        match next {
            Next::Answer(connection) => {
                let closed = closed(self.closing.clone());
                let answers = connection.answer(self.service.clone(), self.limits, closed);
                tasks.spawn_on(answers, &self.answering);
            }
            Next::Wait(connection) => {
                tasks.spawn(self.unless_closed(connection.wait(came)));
            }
            Next::Nothing => {}
        }
    }

    /// What is waited for, unless the server stops.
    fn unless_closed(
        &self,
        next: impl Future<Output = Next> + Send + 'static,
    ) -> impl Future<Output = Next> + Send + 'static {
        let closed = closed(self.closing.clone());
        async {
            tokio::select! {
                next = next => next,
                () = closed => Next::Nothing,
            }
        }
    }
}

/// Only a part of a request came.
fn came() {
    PARTS.set(PARTS.get().saturating_add(1));
}

/// Done when the server is to stop, or is gone.
async fn closed(mut closing: watch::Receiver<bool>) {
    drop(closing.wait_for(|closing| *closing).await);
}

/// It went away before it was accepted.
fn is_the_client_s(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset};
    matches!(
        error.kind(),
        ConnectionAborted | ConnectionRefused | ConnectionReset
    )
}
