//! A small server that does what it is told, faults included.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::UVec3;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use super::super::NOTHING_ACQUIRED;
use crate::memory::ArraySource;
use crate::{Change, ChangeReason, Chunk, ChunkId, VolumeSource};
use saccade_core::voxel_box::VoxelBox;

/// What happens to the next request for a chunk.
#[derive(Clone, Copy, Debug)]
pub(super) enum Fault {
    /// This status line and headers.
    Status(&'static str),
    /// The same, with this body.
    Refusal(&'static str, &'static str),
    /// The connection is closed without an answer.
    Reset,
    /// Half a body, then the connection is closed.
    Cut,
    /// A whole answer with so many bytes more or fewer.
    Longer(isize),
    /// An answer without an end.
    Endless,
    /// Half a body, then nothing until the client goes.
    Stall,
    /// The right body in small pieces.
    Drip,
    /// The right body, a byte now and then.
    Trickle,
}

pub(super) struct Server {
    pub(super) base: String,
    pub(super) source: ArraySource,
    pub(super) faults: Mutex<VecDeque<Fault>>,
    /// Every request's target, and its `last-event-id`.
    pub(super) log: Mutex<Vec<(String, Option<u64>)>>,
    /// Clients that went while an answer was held back.
    pub(super) gone: AtomicUsize,
    /// Replaces the answer for `volume.json`.
    pub(super) description: Mutex<Option<String>>,
    history: Mutex<Vec<String>>,
    state: watch::Sender<State>,
}

#[derive(Clone, Copy, Default)]
struct State {
    /// Events there are.
    events: usize,
    /// Connections for events are closed when this grows.
    cuts: usize,
    /// Nothing is known of events before this one.
    forgotten: usize,
}

impl Server {
    pub(super) async fn start(source: ArraySource) -> Arc<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server = Arc::new(Self {
            base: format!("http://{}/sub", listener.local_addr().unwrap()),
            source,
            faults: Mutex::default(),
            log: Mutex::default(),
            gone: AtomicUsize::new(0),
            description: Mutex::default(),
            history: Mutex::default(),
            state: watch::Sender::default(),
        });
        let this = server.clone();
        tokio::spawn(async move {
            loop {
                let (stream, _) = listener.accept().await.unwrap();
                let this = this.clone();
                // A client that goes away is part of the game.
                tokio::spawn(async move { this.serve(stream).await.ok() });
            }
        });
        server
    }

    /// Sets voxels and remembers the event.
    pub(super) fn set(&self, voxels: VoxelBox, value: u8) -> VoxelBox {
        let values = vec![value; usize::try_from(voxels.voxels()).unwrap()];
        let revision = self.source.set(voxels, &values).unwrap();
        let reason = ChangeReason::Tile;
        let change = Change {
            revision,
            voxels,
            reason,
        };
        let data = serde_json::to_string(&change).unwrap();
        self.send(format!(
            "event: change\r\nid: {revision}\r\ndata: {data}\r\n\r\n"
        ));
        voxels
    }

    /// Remembers an event as text.
    pub(super) fn send(&self, event: String) {
        let mut history = self.history.lock().unwrap();
        history.push(event);
        self.state.send_modify(|s| s.events = history.len());
    }

    /// Closes the connections for events.
    pub(super) fn cut_events(&self) {
        self.state.send_modify(|s| s.cuts += 1);
    }

    /// Forgets all events so far.
    pub(super) fn forget(&self) {
        self.state.send_modify(|s| s.forgotten = s.events);
    }

    pub(super) fn requests(&self, part: &str) -> Vec<(String, Option<u64>)> {
        let log = self.log.lock().unwrap();
        log.iter()
            .filter(|(t, _)| t.contains(part))
            .cloned()
            .collect()
    }

    async fn serve(&self, stream: TcpStream) -> std::io::Result<()> {
        let mut stream = BufReader::new(stream);
        loop {
            let mut target = String::new();
            let mut last = None;
            loop {
                let mut line = String::new();
                if stream.read_line(&mut line).await? == 0 {
                    return Ok(());
                }
                if target.is_empty() {
                    line.split(' ').nth(1).unwrap_or("").clone_into(&mut target);
                } else if let Some(id) = line.strip_prefix("last-event-id: ") {
                    last = id.trim().parse().ok();
                } else if line == "\r\n" {
                    break;
                }
            }
            self.log.lock().unwrap().push((target.clone(), last));
            let path = target.split('?').next().unwrap_or("");
            match path.strip_prefix("/sub/") {
                Some("volumes.json") => {
                    let text = r#"{"volumes":[{"name":"v 1","revision":0},{"name":"w"}]}"#;
                    answer(&mut stream, "200 OK", text.as_bytes()).await?;
                }
                Some("v/v%201/volume.json") => {
                    let volume = serde_json::to_string(&**self.source.volume()).unwrap();
                    let other = self.description.lock().unwrap().clone();
                    let text = other.unwrap_or(format!(r#"{{"volume":{volume},"revision":0}}"#));
                    answer(&mut stream, "200 OK", text.as_bytes()).await?;
                }
                Some("v/v%201/events") => return self.events(stream, last).await,
                Some(path) if path.starts_with("v/v%201/changes/") => {
                    let fault = self.faults.lock().unwrap().pop_front();
                    if let Some(Fault::Status(status)) = fault {
                        answer(&mut stream, status, b"sorry").await?;
                        continue;
                    }
                    let revision = path.rsplit('/').next().unwrap().parse().unwrap();
                    let changes = self.source.changes_after(revision).await;
                    let text = serde_json::json!({ "revision": 0, "changes": changes });
                    answer(&mut stream, "200 OK", text.to_string().as_bytes()).await?;
                }
                Some(path) if path.starts_with("v/v%201/zarr/") => {
                    self.chunk(&mut stream, path).await?;
                }
                _ => answer(&mut stream, "404 Not Found", b"").await?,
            }
        }
    }

    async fn events(
        &self,
        mut stream: BufReader<TcpStream>,
        last: Option<u64>,
    ) -> std::io::Result<()> {
        let mut state = self.state.subscribe();
        let cuts = state.borrow().cuts;
        let head = "HTTP/1.1 200 OK\r\ncontent-type: text/event-stream\r\n\r\n: welcome\n\n";
        stream.write_all(head.as_bytes()).await?;
        // Revision n is event n - 1.
        let mut next = usize::try_from(last.unwrap()).unwrap();
        loop {
            let now = *state.borrow_and_update();
            if now.cuts > cuts {
                return Ok(());
            }
            if next < now.forgotten {
                next = now.forgotten;
                let (voxels, reason) = (VoxelBox::EMPTY, ChangeReason::Missed);
                let change = Change {
                    revision: next as u64,
                    voxels,
                    reason,
                };
                let data = serde_json::to_string(&change).unwrap();
                let event = format!("event: change\nid: {next}\ndata: {data}\n\n");
                stream.write_all(event.as_bytes()).await?;
            }
            let new = self.history.lock().unwrap()[next..now.events].concat();
            next = now.events;
            // In pieces, as networks do.
            for piece in new.as_bytes().chunks(17) {
                stream.write_all(piece).await?;
                stream.flush().await?;
            }
            let mut byte = [0];
            tokio::select! {
                changed = state.changed() => changed.unwrap(),
                _ = stream.read(&mut byte) => return Ok(()),
            }
        }
    }

    async fn chunk(&self, stream: &mut BufReader<TcpStream>, path: &str) -> std::io::Result<()> {
        let numbers = path.split('/').filter_map(|p| p.parse().ok());
        let [level, channel, z, y, x] = numbers.collect::<Vec<u32>>().try_into().unwrap();
        let chunk = UVec3::new(x, y, z);
        let id = ChunkId {
            channel,
            level,
            chunk,
        };
        let Ok(Chunk::Voxels(mut bytes)) = self.source.read(id).await else {
            let head = format!("404 Not Found\r\n{NOTHING_ACQUIRED}: 1");
            return answer(stream, &head, b"nothing acquired").await;
        };
        let head = format!("HTTP/1.1 200 OK\r\ncontent-length: {}\r\n\r\n", bytes.len());
        let fault = self.faults.lock().unwrap().pop_front();
        match fault {
            None => answer(stream, "200 OK", &bytes).await,
            Some(Fault::Status(status)) => answer(stream, status, b"sorry").await,
            Some(Fault::Refusal(status, body)) => answer(stream, status, body.as_bytes()).await,
            Some(Fault::Reset) => stream.shutdown().await,
            Some(Fault::Cut) => {
                bytes.truncate(bytes.len() / 2);
                stream
                    .write_all(&[head.as_bytes(), &bytes].concat())
                    .await?;
                stream.shutdown().await
            }
            Some(Fault::Longer(by)) => {
                let mut bytes = bytes.to_vec();
                bytes.resize(bytes.len().checked_add_signed(by).unwrap(), 1);
                answer(stream, "200 OK", &bytes).await
            }
            Some(Fault::Endless) => {
                stream.write_all(b"HTTP/1.1 200 OK\r\n\r\n").await?;
                loop {
                    stream.write_all(&bytes).await?;
                }
            }
            Some(Fault::Stall) => {
                bytes.truncate(bytes.len() / 2);
                stream
                    .write_all(&[head.as_bytes(), &bytes].concat())
                    .await?;
                stream.flush().await?;
                let mut byte = [0];
                // Returns when the client hangs up.
                let _ = stream.read(&mut byte).await;
                self.gone.fetch_add(1, Ordering::SeqCst);
                Ok(())
            }
            Some(Fault::Trickle) => {
                stream.write_all(head.as_bytes()).await?;
                for byte in bytes.chunks(1) {
                    stream.write_all(byte).await?;
                    stream.flush().await?;
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                Ok(())
            }
            Some(Fault::Drip) => {
                stream.write_all(head.as_bytes()).await?;
                for piece in bytes.chunks(bytes.len() / 10) {
                    stream.write_all(piece).await?;
                    stream.flush().await?;
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
                Ok(())
            }
        }
    }
}

async fn answer(
    stream: &mut BufReader<TcpStream>,
    status: &str,
    body: &[u8],
) -> std::io::Result<()> {
    let head = format!(
        "HTTP/1.1 {status}\r\ncontent-length: {}\r\n\r\n",
        body.len()
    );
    stream.write_all(&[head.as_bytes(), body].concat()).await?;
    stream.flush().await
}

/// Waits until something holds; the test's own time limit ends it otherwise.
pub(super) async fn until(mut holds: impl FnMut() -> bool) {
    while !holds() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}
