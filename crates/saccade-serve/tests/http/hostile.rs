//! Clients that are slow, many, or strangers, on real sockets.

use std::time::Duration;

use reqwest::{Method, StatusCode};
use saccade_serve::{Access, Limits, Options, Origins};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::{sleep, timeout};

use super::server::never;
use super::{CHUNK, Served, header, run, serve, serve_source};

/// Deadlines of these tests.
const SHORT: Duration = Duration::from_millis(300);
const CHUNK_PATH: &str = "v/em/zarr/0/c/0/0/0/1";

fn limited(limits: Limits) -> Options {
    Options {
        limits,
        ..Options::DEFAULT
    }
}

fn address(url: &str) -> &str {
    url.trim_start_matches("http://").trim_end_matches('/')
}

async fn connect(url: &str) -> TcpStream {
    TcpStream::connect(address(url)).await.unwrap()
}

fn request(path: &str) -> String {
    format!("GET /{path} HTTP/1.1\r\nHost: localhost\r\n\r\n")
}

/// Everything until the server ends the connection.
async fn rest(stream: &mut TcpStream) -> String {
    let mut bytes = Vec::new();
    // A reset ends it as well.
    drop(stream.read_to_end(&mut bytes).await);
    String::from_utf8_lossy(&bytes).into_owned()
}

async fn is_well(served: &Served) -> bool {
    let answer = timeout(Duration::from_secs(5), served.get(CHUNK_PATH)).await;
    answer.is_ok_and(|answer| answer.status() == StatusCode::OK)
}

/// Sends a request in pieces; what comes back until the server ends the connection.
async fn drip(served: &Served, pause: Duration) -> String {
    let mut stream = connect(&served.url).await;
    let text = request(CHUNK_PATH).replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n");
    for piece in text.as_bytes().chunks(20) {
        if stream.write_all(piece).await.is_err() {
            break;
        }
        sleep(pause).await;
    }
    rest(&mut stream).await
}

#[test]
fn a_head_that_drips_in_is_not_waited_for() {
    run(async {
        let head = SHORT;
        let served = serve(limited(Limits {
            head,
            ..Limits::DEFAULT
        }))
        .await;
        let (slow, brisk) = tokio::join!(drip(&served, SHORT), drip(&served, SHORT / 30));
        assert_eq!(slow, "");
        assert!(brisk.starts_with("HTTP/1.1 200"), "{brisk}");
        assert!(is_well(&served).await);
    });
}

/// Also after a request that was whole, and in between answers that are under way.
#[test]
fn a_next_head_that_drips_in_is_not_waited_for_either() {
    run(async {
        let head = SHORT;
        let served = serve(limited(Limits {
            head,
            ..Limits::DEFAULT
        }))
        .await;
        let whole = request(CHUNK_PATH);
        let (begun, rest_of_it) = whole.split_at(10);
        for pause in [SHORT / 30, 2 * SHORT] {
            let mut stream = connect(&served.url).await;
            // One and the beginning of the next together, then the rest of that.
            let both = format!("{whole}{begun}");
            stream.write_all(both.as_bytes()).await.unwrap();
            sleep(pause).await;
            // Where it was too late, the connection has ended.
            drop(stream.write_all(rest_of_it.as_bytes()).await);
            let last = whole.replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n");
            drop(stream.write_all(last.as_bytes()).await);
            let answers = rest(&mut stream).await.matches("HTTP/1.1 200").count();
            assert_eq!(answers, if pause < head { 3 } else { 1 }, "{pause:?}");
        }
        assert!(is_well(&served).await);
    });
}

#[test]
fn what_is_no_request_is_refused_at_once() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        for nonsense in [&b"\x16\x03\x01\x02\x00\x01"[..], b"hello\r\n", b"GET /\r\n"] {
            let mut stream = connect(&served.url).await;
            stream.write_all(nonsense).await.unwrap();
            let answer = timeout(Duration::from_secs(5), rest(&mut stream)).await;
            let answer = answer.expect("more of it is waited for");
            assert!(answer.starts_with("HTTP/1.1 400"), "{nonsense:?}: {answer}");
        }
        let mut stream = connect(&served.url).await;
        let long = format!("GET / HTTP/1.1\r\nX: {}", "y".repeat(40_000));
        drop(stream.write_all(long.as_bytes()).await);
        let answer = timeout(Duration::from_secs(5), rest(&mut stream)).await;
        let answer = answer.expect("more of it is waited for");
        assert!(
            answer.is_empty() || answer.starts_with("HTTP/1.1 431"),
            "{answer}"
        );
        assert!(is_well(&served).await);
    });
}

/// Clients that send a byte now and then take a place each, and nothing else.
#[test]
fn dripping_clients_do_not_keep_others_from_being_answered() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let mut slow = Vec::new();
        for n in 0..100 {
            let mut stream = connect(&served.url).await;
            // Half of them asked for something before.
            if n % 2 == 0 {
                stream
                    .write_all(request("volumes.json").as_bytes())
                    .await
                    .unwrap();
            }
            stream.write_all(b"GET / HTTP/1.1\r\nX: ").await.unwrap();
            slow.push(stream);
        }
        for _ in 0..20 {
            for stream in &mut slow {
                stream.write_all(b"z").await.unwrap();
            }
            assert!(is_well(&served).await);
        }
        // They were waited for: each gets its answer.
        for (n, stream) in slow.iter_mut().enumerate() {
            let end = b"\r\nHost: localhost\r\nConnection: close\r\n\r\n";
            stream.write_all(end).await.unwrap();
            let answers = rest(stream).await.matches("HTTP/1.1 200").count();
            assert_eq!(answers, if n % 2 == 0 { 2 } else { 1 }, "client {n}");
        }
    });
}

#[test]
fn connections_that_do_nothing_end() {
    run(async {
        let head = SHORT;
        let served = serve(limited(Limits {
            head,
            ..Limits::DEFAULT
        }))
        .await;
        let mut silent = connect(&served.url).await;
        let mut idle = connect(&served.url).await;
        idle.write_all(request("volumes.json").as_bytes())
            .await
            .unwrap();
        let (silent, idle) = tokio::join!(rest(&mut silent), rest(&mut idle));
        assert_eq!(silent, "");
        assert!(idle.starts_with("HTTP/1.1 200"), "{idle}");
    });
}

#[test]
fn a_body_that_nobody_asked_for_is_not_read() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        for method in ["GET", "POST"] {
            let head = format!(
                "{method} /volumes.json HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000\r\n\r\n"
            );
            // What follows a head is a body, also where it looks like the next request.
            for body in [
                "",
                "x",
                "GET /volumes.json HTTP/1.1\r\nHost: localhost\r\n\r\n",
            ] {
                let mut stream = connect(&served.url).await;
                stream.write_all(head.as_bytes()).await.unwrap();
                stream.write_all(body.as_bytes()).await.unwrap();
                let answer = timeout(Duration::from_secs(5), rest(&mut stream)).await;
                let answer = answer.expect("the body is waited for");
                assert!(answer.starts_with("HTTP/1.1 "), "{answer}");
                assert_eq!(answer.matches("HTTP/1.1 ").count(), 1, "{answer}");
            }
        }
    });
}

/// More answers than the system keeps for a client.
const MANY: usize = 4000;

async fn ask_for_many(served: &Served) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(4096).unwrap();
    let mut stream = socket
        .connect(address(&served.url).parse().unwrap())
        .await
        .unwrap();
    let asked = request(CHUNK_PATH).repeat(MANY);
    // The server may end it before it has read everything.
    drop(timeout(Duration::from_secs(5), stream.write_all(asked.as_bytes())).await);
    stream
}

#[test]
fn a_reader_that_does_not_read_is_not_written_to_for_ever() {
    run(async {
        let pace = SHORT;
        let served = serve(limited(Limits {
            pace,
            ..Limits::DEFAULT
        }))
        .await;
        let mut asleep = ask_for_many(&served).await;
        sleep(4 * SHORT).await;
        assert!(is_well(&served).await);
        let taken = rest(&mut asleep).await.len();
        let all = MANY * CHUNK.element_product() as usize;
        assert!(taken < all, "{taken} bytes were sent");
    });
}

#[test]
fn a_reader_that_reads_gets_everything() {
    run(async {
        let pace = SHORT;
        let served = serve(limited(Limits {
            pace,
            ..Limits::DEFAULT
        }))
        .await;
        let socket = connect(&served.url).await;
        let (mut reading, mut writing) = socket.into_split();
        let asked = request(CHUNK_PATH).repeat(MANY - 1)
            + &request(CHUNK_PATH).replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n");
        let (written, read) = tokio::join!(writing.write_all(asked.as_bytes()), async {
            let mut bytes = Vec::new();
            reading.read_to_end(&mut bytes).await.map(|_| bytes)
        });
        written.unwrap();
        let all = MANY * CHUNK.element_product() as usize;
        assert!(read.unwrap().len() > all);
    });
}

#[test]
fn idle_connections_make_room() {
    run(async {
        let connections = 20;
        let served = serve(limited(Limits {
            connections,
            ..Limits::DEFAULT
        }))
        .await;
        assert!(is_well(&served).await);
        let mut idle = Vec::new();
        for _ in 0..5 * connections {
            idle.push(connect(&served.url).await);
            assert!(is_well(&served).await);
        }
        let mut ended = 0;
        for stream in &mut idle {
            let read = timeout(Duration::from_millis(10), stream.read_u8()).await;
            ended += usize::from(read.is_ok());
        }
        assert!(ended >= 4 * connections, "only {ended} were ended");
        assert!(ended < 5 * connections, "more were ended than had to");
    });
}

#[test]
fn what_is_too_much_is_told_to_come_again() {
    run(async {
        let options = limited(Limits {
            connections: 3,
            requests: 2,
            ..Limits::DEFAULT
        });
        let (url, _stop, _running) = serve_source(never(), options).await;
        let mut hanging = Vec::new();
        for _ in 0..2 {
            let mut stream = connect(&url).await;
            stream
                .write_all(request(CHUNK_PATH).as_bytes())
                .await
                .unwrap();
            hanging.push(stream);
        }
        // A third is shed as a request; connections beyond it find no place while it asks.
        sleep(SHORT).await;
        let shed = reqwest::get(format!("{url}volumes.json")).await.unwrap();
        assert_eq!(shed.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert_eq!(header(shed.headers(), "retry-after"), Some("1"));
        assert_eq!(
            header(shed.headers(), "access-control-allow-origin"),
            Some("*")
        );
        // Who gives up makes room.
        hanging.pop();
        let again = async {
            loop {
                let answer = reqwest::get(format!("{url}volumes.json")).await;
                if answer.is_ok_and(|answer| answer.status() == StatusCode::OK) {
                    break;
                }
                sleep(SHORT / 10).await;
            }
        };
        timeout(Duration::from_secs(10), again).await.unwrap();
    });
}

#[test]
fn where_all_connections_are_being_answered_the_next_reads_why() {
    run(async {
        let connections = 2;
        let options = limited(Limits {
            connections,
            ..Limits::DEFAULT
        });
        let (url, _stop, _running) = serve_source(never(), options).await;
        let mut hanging = Vec::new();
        for _ in 0..connections {
            let mut stream = connect(&url).await;
            stream
                .write_all(request(CHUNK_PATH).as_bytes())
                .await
                .unwrap();
            hanging.push(stream);
        }
        sleep(SHORT).await;
        let mut next = connect(&url).await;
        let answer = rest(&mut next).await;
        assert!(
            answer.starts_with("HTTP/1.1 503") && answer.contains("Retry-After: 1"),
            "{answer}"
        );
    });
}

#[test]
fn streams_of_changes_are_counted() {
    run(async {
        let served = serve(limited(Limits {
            streams: 1,
            ..Limits::DEFAULT
        }))
        .await;
        let first = served.get("v/em/events").await;
        assert_eq!(first.status(), StatusCode::OK);
        let second = served.get("v/em/events").await;
        assert_eq!(second.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert!(is_well(&served).await);
        drop(first);
        while served.get("v/em/events").await.status() != StatusCode::OK {
            sleep(SHORT / 10).await;
        }
    });
}

/// Whoever takes all that there are makes room for others, and not for itself.
#[cfg(target_os = "linux")]
#[test]
fn one_address_cannot_take_all_streams() {
    use glam::UVec3;
    use saccade_core::voxel_box::VoxelBox;

    run(async {
        let served = serve(limited(Limits {
            streams: 4,
            ..Limits::DEFAULT
        }))
        .await;
        let from = |address: [u8; 4]| {
            let client = reqwest::Client::builder().local_address(std::net::IpAddr::from(address));
            let (client, url) = (
                client.build().unwrap(),
                format!("{}v/em/events", served.url),
            );
            async move || client.get(&url).send().await.unwrap()
        };
        let (greedy, good) = (from([127, 0, 0, 1]), from([127, 0, 0, 2]));
        let mut held = Vec::new();
        for _ in 0..4 {
            held.push(greedy().await);
        }
        assert!(held.iter().all(|answer| answer.status() == StatusCode::OK));
        let more = greedy().await;
        assert_eq!(more.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert_eq!(header(more.headers(), "retry-after"), Some("1"));
        let there = good().await;
        assert_eq!(there.status(), StatusCode::OK);
        // The newest of the others ends, as a stream does whose client may come back; the rest go on.
        let last = held.pop().unwrap().bytes().await;
        last.expect("it ends, and does not break");
        assert_eq!(greedy().await.status(), StatusCode::SERVICE_UNAVAILABLE);
        let voxels = VoxelBox::of_size(UVec3::ONE);
        served.source.set(voxels, &[9]).unwrap();
        for mut answer in held.into_iter().chain([there]) {
            let news = answer.chunk().await.unwrap().expect("it goes on");
            assert!(news.starts_with(b"event: change"), "{news:?}");
        }
    });
}

#[test]
fn strangers_names_and_pages_are_refused() {
    run(async {
        let access = Access {
            hosts: vec!["em.example".to_owned()],
            origins: Origins::Only(vec!["https://viewer.example".to_owned()]),
        };
        let served = serve(Options {
            access,
            ..Options::DEFAULT
        })
        .await;
        let ask = async |host: &str, origin: Option<&str>| {
            let mut request = served.request(Method::GET, CHUNK_PATH).header("host", host);
            if let Some(origin) = origin {
                request = request.header("origin", origin);
            }
            let response = request.send().await.unwrap();
            let allowed = header(response.headers(), "access-control-allow-origin");
            (response.status().as_u16(), allowed.map(str::to_owned))
        };
        assert_eq!(ask("em.example:8080", None).await.0, 200);
        assert_eq!(ask("127.0.0.1", None).await.0, 200);
        assert_eq!(ask("evil.example", None).await.0, 421);
        let good = "https://viewer.example".to_owned();
        assert_eq!(ask("localhost", Some(&good)).await, (200, Some(good)));
        assert_eq!(
            ask("localhost", Some("https://evil.example")).await,
            (403, None)
        );
    });
}
