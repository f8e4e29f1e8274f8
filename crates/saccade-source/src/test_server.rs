//! A server of objects on loopback that does what it is told, faults included. For tests.
#![expect(clippy::unwrap_used, reason = "for tests, which fail where it fails")]

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream};

use crate::objects::{HttpObjects, Objects, Patience, S3Objects};

/// What happens to a request.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Fault {
    /// This status line and headers, and a body of a few bytes.
    Status(&'static str),
    /// The connection is closed without an answer.
    Reset,
    /// Half a body, then the connection is closed.
    Cut,
    /// A body with so many bytes more or fewer than it should have, whose length is told right.
    Longer(isize),
    /// A length is told that is not the body's.
    WrongLength,
    /// A body that never ends, of no told length.
    Endless,
    /// Half a body, then nothing until the client goes.
    Stall,
    /// A few bytes a second.
    Drip,
    /// The same, of the status line and headers.
    SlowHead,
    /// The whole object, whatever part was asked for.
    Whole,
    /// Another part than was asked for.
    OtherPart,
    /// The right number of other bytes.
    Garbage,
}

/// Objects, and what is done to those who ask for them.
#[derive(Debug)]
pub(crate) struct TestServer {
    pub(crate) url: String,
    pub(crate) objects: Mutex<BTreeMap<String, Bytes>>,
    /// For the next requests, in order.
    pub(crate) next: Mutex<VecDeque<Fault>>,
    /// For every request of a path that ends so.
    pub(crate) always: Mutex<Vec<(String, Fault)>>,
    /// Paths and ranges that were asked for.
    pub(crate) log: Mutex<Vec<(String, Option<String>)>>,
    /// What is said of objects that there are not.
    pub(crate) missing: Mutex<&'static str>,
    /// Tag of every object, if they have any.
    pub(crate) tag: Mutex<Option<&'static str>>,
    /// Further headers of every object, each behind a line's end.
    pub(crate) headers: Mutex<&'static str>,
    /// Every answer waits so long.
    pub(crate) latency: Mutex<Duration>,
    /// Requests that are being answered, and the most there ever were.
    pub(crate) busy: AtomicUsize,
    pub(crate) busiest: AtomicUsize,
    /// Clients that went while an answer was held back.
    pub(crate) gone: AtomicUsize,
}

impl TestServer {
    pub(crate) async fn start(objects: impl IntoIterator<Item = (String, Bytes)>) -> Arc<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server = Arc::new(Self {
            url: format!("http://{}/sub", listener.local_addr().unwrap()),
            objects: Mutex::new(objects.into_iter().collect()),
            next: Mutex::default(),
            always: Mutex::default(),
            log: Mutex::default(),
            missing: Mutex::new("404 Not Found"),
            tag: Mutex::default(),
            headers: Mutex::default(),
            latency: Mutex::default(),
            busy: AtomicUsize::new(0),
            busiest: AtomicUsize::new(0),
            gone: AtomicUsize::new(0),
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

    /// Objects of a folder.
    pub(crate) async fn of_folder(folder: &std::path::Path) -> Arc<Self> {
        fn collect(folder: &std::path::Path, prefix: &str, into: &mut Vec<(String, Bytes)>) {
            for entry in std::fs::read_dir(folder).unwrap() {
                let entry = entry.unwrap();
                let name = format!("{prefix}{}", entry.file_name().to_str().unwrap());
                if entry.path().is_dir() {
                    collect(&entry.path(), &format!("{name}/"), into);
                } else {
                    into.push((name, std::fs::read(entry.path()).unwrap().into()));
                }
            }
        }
        let mut objects = Vec::new();
        collect(folder, "", &mut objects);
        Self::start(objects).await
    }

    /// The same objects by S3's requests, which differ in paths only.
    pub(crate) fn s3(&self, patience: Patience) -> S3Objects {
        let endpoint = self.url.trim_end_matches("/sub").to_owned();
        let settings = [
            ("AWS_ENDPOINT_URL".to_owned(), endpoint),
            ("AWS_REGION".to_owned(), "us-east-1".to_owned()),
        ];
        S3Objects::with_settings(&"s3://sub".parse().unwrap(), settings, patience).unwrap()
    }

    /// Both ways to its objects.
    pub(crate) fn stores(&self, patience: Patience) -> [Arc<dyn Objects>; 2] {
        let http = HttpObjects::with_patience(&self.url, patience).unwrap();
        [Arc::new(http), Arc::new(self.s3(patience))]
    }

    pub(crate) fn fail_next(&self, faults: impl IntoIterator<Item = Fault>) {
        self.next.lock().unwrap().extend(faults);
    }

    pub(crate) fn fail_always(&self, end: &str, fault: Fault) {
        self.always.lock().unwrap().push((end.to_owned(), fault));
    }

    pub(crate) fn asked(&self, part: &str) -> usize {
        let log = self.log.lock().unwrap();
        log.iter().filter(|(path, _)| path.contains(part)).count()
    }

    async fn serve(&self, stream: TcpStream) -> std::io::Result<()> {
        let mut stream = BufReader::new(stream);
        loop {
            let (mut path, mut range, mut head) = (String::new(), None, false);
            loop {
                let mut line = String::new();
                if stream.read_line(&mut line).await? == 0 {
                    return Ok(());
                }
                if path.is_empty() {
                    head = line.starts_with("HEAD ");
                    line.split(' ').nth(1).unwrap_or("").clone_into(&mut path);
                } else if let Some(value) = line.strip_prefix("range: bytes=") {
                    range = Some(value.trim().to_owned());
                } else if line == "\r\n" {
                    break;
                }
            }
            self.log.lock().unwrap().push((path.clone(), range.clone()));
            let now = self.busy.fetch_add(1, Ordering::SeqCst) + 1;
            self.busiest.fetch_max(now, Ordering::SeqCst);
            let latency = *self.latency.lock().unwrap();
            if !latency.is_zero() {
                tokio::time::sleep(latency).await;
            }
            let answered = self.answer(&mut stream, &path, range.as_deref(), head);
            let answered = answered.await;
            self.busy.fetch_sub(1, Ordering::SeqCst);
            if !answered? {
                return Ok(());
            }
        }
    }

    fn fault(&self, path: &str) -> Option<Fault> {
        let next = self.next.lock().unwrap().pop_front();
        let always = self.always.lock().unwrap();
        next.or_else(|| {
            let found = always.iter().find(|(end, _)| path.ends_with(&**end));
            found.map(|(_, fault)| *fault)
        })
    }

    /// Answers; whether the connection goes on.
    async fn answer(
        &self,
        stream: &mut BufReader<TcpStream>,
        path: &str,
        range: Option<&str>,
        head_only: bool,
    ) -> std::io::Result<bool> {
        let fault = self.fault(path);
        if let Some(Fault::Status(status)) = fault {
            send(stream, status, b"sorry", head_only).await?;
            return Ok(true);
        }
        let key = path.strip_prefix("/sub/").unwrap_or("").split('?').next();
        let object = self.objects.lock().unwrap().get(key.unwrap_or("")).cloned();
        let Some(object) = object else {
            let missing = *self.missing.lock().unwrap();
            send(stream, missing, b"no such key", head_only).await?;
            return Ok(true);
        };
        let wanted = range.map(|range| bounds(range, object.len()));
        let (mut head, mut body) = match wanted {
            Some(range) if !matches!(fault, Some(Fault::Whole)) => {
                if range.is_empty() {
                    send(stream, "416 Range Not Satisfiable", b"", head_only).await?;
                    return Ok(true);
                }
                let (first, last, length) = (range.start, range.end - 1, object.len());
                let head =
                    format!("206 Partial Content\r\ncontent-range: bytes {first}-{last}/{length}");
                (head, object.slice(range))
            }
            _ => ("200 OK".to_owned(), object),
        };
        if let Some(tag) = *self.tag.lock().unwrap() {
            head += &format!("\r\netag: {tag}");
        }
        head += *self.headers.lock().unwrap();
        match fault {
            None | Some(Fault::Whole | Fault::Status(_)) => {}
            Some(Fault::SlowHead) => {
                for byte in format!("HTTP/1.1 {head}\r\n").as_bytes().chunks(1) {
                    stream.write_all(byte).await?;
                    stream.flush().await?;
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
                return Ok(false);
            }
            Some(Fault::Reset) => {
                stream.shutdown().await?;
                return Ok(false);
            }
            Some(Fault::Garbage) => {
                body = body
                    .iter()
                    .map(|byte| byte.wrapping_mul(3) ^ 0x5a)
                    .collect()
            }
            Some(Fault::Longer(by)) => {
                let mut bytes = body.to_vec();
                bytes.resize(bytes.len().saturating_add_signed(by), 1);
                body = bytes.into();
            }
            Some(Fault::OtherPart) => {
                let (first, last) = (7, 6 + body.len());
                head =
                    format!("206 Partial Content\r\ncontent-range: bytes {first}-{last}/99999999");
            }
            Some(Fault::Endless) => {
                stream
                    .write_all(format!("HTTP/1.1 {head}\r\n\r\n").as_bytes())
                    .await?;
                loop {
                    stream.write_all(&[7; 4096]).await?;
                }
            }
            Some(fault @ (Fault::Cut | Fault::Stall | Fault::Drip | Fault::WrongLength)) => {
                let told = body.len() + usize::from(matches!(fault, Fault::WrongLength)) * 5;
                let head = format!("HTTP/1.1 {head}\r\ncontent-length: {told}\r\n\r\n");
                stream.write_all(head.as_bytes()).await?;
                let half = body.len() / 2;
                match fault {
                    Fault::WrongLength => stream.write_all(&body).await?,
                    Fault::Drip => {
                        for byte in body.chunks(1) {
                            stream.write_all(byte).await?;
                            stream.flush().await?;
                            tokio::time::sleep(Duration::from_millis(100)).await;
                        }
                    }
                    _ => stream.write_all(&body[..half]).await?,
                }
                stream.flush().await?;
                if matches!(fault, Fault::Stall) {
                    // Returns when the client hangs up.
                    let _ = stream.read(&mut [0]).await;
                    self.gone.fetch_add(1, Ordering::SeqCst);
                }
                stream.shutdown().await?;
                return Ok(false);
            }
        }
        send(stream, &head, &body, head_only).await?;
        Ok(true)
    }
}

/// Of `2-5`, `2-` or `-5`; empty if there is nothing of it.
fn bounds(range: &str, length: usize) -> Range<usize> {
    let (first, last) = range.split_once('-').unwrap();
    let number = |text: &str| text.parse::<u64>().unwrap();
    let length = length as u64;
    let bounds = match (first, last) {
        ("", count) => length.saturating_sub(number(count))..length,
        (first, "") => number(first).min(length)..length,
        (first, last) => number(first).min(length)..number(last).saturating_add(1).min(length),
    };
    usize::try_from(bounds.start).unwrap()..usize::try_from(bounds.end).unwrap()
}

async fn send(
    stream: &mut BufReader<TcpStream>,
    head: &str,
    body: &[u8],
    head_only: bool,
) -> std::io::Result<()> {
    let head = format!("HTTP/1.1 {head}\r\ncontent-length: {}\r\n\r\n", body.len());
    let body = if head_only { &[] } else { body };
    stream.write_all(&[head.as_bytes(), body].concat()).await?;
    stream.flush().await
}
