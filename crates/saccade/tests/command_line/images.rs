//! Images behind addresses, and what a server fetches for its clients: nothing but these.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::json;

use crate::errors::{assert_failed, text};
use crate::{Running, run, saccade, stderr};

/// Files on loopback, and who asked for which.
#[derive(Default)]
struct Files {
    /// Paths and answers: a status with its headers, and a body.
    files: BTreeMap<String, (String, Vec<u8>)>,
    /// A path whose answer never comes.
    silent: String,
    /// Where a path begins so, the connection is closed.
    broken: Option<&'static str>,
    /// What is answered for other paths, if it is not 404.
    missing: Option<&'static str>,
    asked: Mutex<Vec<String>>,
}

impl Files {
    fn with(mut self, path: &str, body: impl Into<Vec<u8>>) -> Self {
        self.files
            .insert(path.to_owned(), ("200 OK".to_owned(), body.into()));
        self
    }

    fn silent_at(mut self, path: &str) -> Self {
        path.clone_into(&mut self.silent);
        self
    }

    fn start(self) -> (Arc<Self>, String) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let files = Arc::new(self);
        let this = files.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let this = this.clone();
                std::thread::spawn(move || this.answer(&stream.unwrap()));
            }
        });
        (files, address)
    }

    fn answer(&self, stream: &TcpStream) -> Option<()> {
        let mut reader = BufReader::new(stream);
        loop {
            let mut first = String::new();
            reader.read_line(&mut first).ok().filter(|n| *n > 0)?;
            let path = first.split(' ').nth(1)?.to_owned();
            self.asked.lock().unwrap().push(path.clone());
            let mut line = String::new();
            while line != "\r\n" {
                line.clear();
                reader.read_line(&mut line).ok().filter(|n| *n > 0)?;
            }
            if path == self.silent {
                // Until the client goes.
                reader.read_line(&mut line).ok();
                return None;
            }
            if self.broken.is_some_and(|broken| path.starts_with(broken)) {
                return None;
            }
            let missing = self.missing.unwrap_or("404 Not Found");
            let missing = (missing.to_owned(), Vec::new());
            let (status, body) = self.files.get(&path).unwrap_or(&missing);
            let head = format!(
                "HTTP/1.1 {status}\r\ncontent-length: {}\r\n\r\n",
                body.len()
            );
            let mut writer = stream;
            writer.write_all(&[head.as_bytes(), body].concat()).ok()?;
        }
    }
}

/// An OME-Zarr image of 100 x 70 x 9 voxels in chunks of 100 x 70 x 3, the last of which is elsewhere.
fn image(elsewhere: &str) -> Files {
    let axis = |name: &str| json!({"name": name, "type": "space", "unit": "nanometer"});
    let scale = json!([{"type": "scale", "scale": [40, 4, 4]}]);
    let multiscales = json!([{"axes": [axis("z"), axis("y"), axis("x")],
        "datasets": [{"path": "0", "coordinateTransformations": scale}]}]);
    let group = json!({"zarr_format": 3, "node_type": "group",
        "attributes": {"ome": {"version": "0.5", "multiscales": multiscales}}});
    let array = json!({"zarr_format": 3, "node_type": "array", "shape": [9, 70, 100], "data_type": "uint8",
        "fill_value": 0, "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [3, 70, 100]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [{"name": "bytes"}]});
    let chunk = |first: u32| -> Vec<u8> {
        (0..21_000_u32)
            .map(|n| u8::try_from(1 + (n * 7 + first) % 250).unwrap())
            .collect()
    };
    let mut files = Files::default()
        .with("/data/image.zarr/zarr.json", group.to_string())
        .with("/data/image.zarr/0/zarr.json", array.to_string())
        .with("/data/image.zarr/0/c/0/0/0", chunk(0))
        .with("/data/image.zarr/0/c/1/0/0", chunk(100));
    let moved = format!("302 Found\r\nlocation: http://{elsewhere}/inside");
    files
        .files
        .insert("/data/image.zarr/0/c/2/0/0".to_owned(), (moved, Vec::new()));
    files
}

#[test]
fn a_server_fetches_from_its_image_and_from_nowhere_else() {
    let (secret, elsewhere) = Files::default().with("/inside", vec![7; 21_000]).start();
    let (files, address) = image(&elsewhere).start();
    let image = format!("http://{address}/data/image.zarr");
    let (_server, url) = Running::start(saccade().args(["serve", &image, "--port", "0"]));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let get = |path: &str| {
        let url = format!("{}{path}", url.trim_end_matches('/'));
        runtime.block_on(async {
            let answer = reqwest::get(url).await.unwrap();
            (answer.status().as_u16(), answer.bytes().await.unwrap())
        })
    };
    let (status, json) = get("/v/image/volume.json");
    assert_eq!(status, 200, "{json:?}");
    // Only chunks of z below 6 can be read; chunks of ours are 64 voxels deep, so that all end in an error that
    // is not the secret.
    let (status, body) = get("/v/image/zarr/0/c/0/0/0/0");
    assert_eq!(status, 424, "what others do not repeat");
    let refusal: serde_json::Value = serde_json::from_slice(&body).unwrap();
    let cause = refusal["cause"].as_str().unwrap();
    assert!(
        cause.contains("chunk [2, 0, 0] of level 0") && cause.contains("302 Found"),
        "{cause}"
    );
    // A folder is shown as what describes it.
    for (folder, described) in [
        ("zarr/", "zarr.json"),
        ("zarr2", ".zattrs"),
        ("precomputed/", "info"),
    ] {
        let (status, json) = get(&format!("/v/image/{folder}"));
        let folder = folder.trim_end_matches('/');
        assert_eq!(
            (status, json),
            get(&format!("/v/image/{folder}/{described}"))
        );
        assert_eq!(status, 200);
    }
    assert!(
        files
            .asked
            .lock()
            .unwrap()
            .iter()
            .any(|path| path.ends_with("0/c/2/0/0"))
    );
    // Addresses of other places, in every way to write them.
    let escaped = elsewhere.replace(':', "%3A");
    for path in [
        format!("/v/http%3A%2F%2F{escaped}%2Finside/volume.json"),
        format!("/v/image/zarr/http%3A%2F%2F{escaped}%2Finside"),
        format!("/v/image/zarr/0/c/0/0/0/0?url=http://{elsewhere}/inside"),
        format!("//{elsewhere}/inside"),
        "/v/image/zarr/..%2F..%2F..%2Finside".to_owned(),
        "/v/image/zarr/0/c/0/0/0/..%2f..%2f..%2finside".to_owned(),
        "/v/image/precomputed/..%2f..%2finside".to_owned(),
    ] {
        let (status, body) = get(&path);
        assert!(
            status >= 400 && !body.starts_with(&[7; 8]),
            "{path}: {status}"
        );
    }
    // A request whose target is another's address, as proxies are asked.
    let mut stream =
        TcpStream::connect(url.trim_start_matches("http://").trim_end_matches('/')).unwrap();
    let request = format!(
        "GET http://{elsewhere}/inside HTTP/1.1\r\nhost: {elsewhere}\r\nconnection: close\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    assert!(
        !answer.starts_with(b"HTTP/1.1 2"),
        "{}",
        String::from_utf8_lossy(&answer)
    );
    let asked = secret.asked.lock().unwrap().clone();
    assert!(asked.is_empty(), "somebody else was asked: {asked:?}");
    for path in files.asked.lock().unwrap().iter() {
        assert!(
            path.starts_with("/data/image.zarr/"),
            "{path} is no part of the image"
        );
    }
}

/// Whoever started it learns that there is no image yet.
#[cfg(unix)]
#[test]
fn an_export_that_is_interrupted_says_so() {
    for signal in ["-INT", "-TERM"] {
        let mut files = image("127.0.0.1:1");
        let silent = "/data/image.zarr/0/c/2/0/0";
        files.files.remove(silent);
        let (files, address) = files.silent_at(silent).start();
        let place = format!("http://{address}/data/image.zarr");
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out.zarr");
        let mut export = saccade();
        export.args(["export", &place, text(&out)]);
        let mut export = Running(export.stderr(Stdio::piped()).spawn().unwrap());
        while !files
            .asked
            .lock()
            .unwrap()
            .iter()
            .any(|path| path == silent)
        {
            assert!(export.0.try_wait().unwrap().is_none(), "it has ended");
            std::thread::sleep(Duration::from_millis(10));
        }
        let id = export.0.id().to_string();
        let told = Command::new("kill").args([signal, &id]).status().unwrap();
        assert!(told.success());
        assert_eq!(export.0.wait().unwrap().code(), Some(130), "{signal}");
        let mut said = String::new();
        let mut stderr = export.0.stderr.take().unwrap();
        stderr.read_to_string(&mut said).unwrap();
        assert!(
            said.contains("interrupted; the same command goes on"),
            "{said}"
        );
        assert!(!out.join("zarr.json").exists() && out.join("export.json").exists());
        assert!(!out.join(".incoming").exists());
    }
}

/// Whether a Saccade server is behind an address is asked first; that nobody says so is not the end.
#[test]
fn an_image_is_exported_though_nobody_says_that_it_is_no_server() {
    let mut files = image("127.0.0.1:1");
    files.files.remove("/data/image.zarr/0/c/2/0/0");
    files.broken = Some("/data/image.zarr/volumes.json");
    let (files, address) = files.start();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out.zarr");
    let place = format!("http://{address}/data/image.zarr");
    let exported = run(["export", &place, text(&out)]);
    assert!(exported.status.success(), "{}", stderr(&exported));
    assert!(out.join("zarr.json").exists());
    let asked = files.asked.lock().unwrap().clone();
    let probes = asked.iter().filter(|path| path.ends_with("volumes.json"));
    assert!(probes.count() > 1, "it is asked again");
    // Where nothing answers, both are told.
    let files = Files {
        broken: Some("/"),
        ..Files::default()
    };
    let (_files, address) = files.start();
    let nothing = run([
        "export",
        &format!("http://{address}/image.zarr"),
        text(&out),
    ]);
    let parts = [
        "is the server running",
        "no image opens",
        "image.zarr/zarr.json",
    ];
    assert_failed(&nothing, 1, &parts);
}

/// A bucket that may not be listed forbids what it does not have, and a login that fails forbids what it has.
#[test]
fn forbidden_chunks_are_exported_as_nothing_only_where_that_is_said() {
    let mut files = image("127.0.0.1:1");
    files.files.remove("/data/image.zarr/0/c/2/0/0");
    files.missing = Some("403 Forbidden");
    let (_files, address) = files.start();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out.zarr");
    let place = format!("http://{address}/data/image.zarr");
    let refused = run(["export", &place, text(&out)]);
    let parts = ["--forbidden-is-missing", "0/c/2/0/0", "access is denied"];
    assert_failed(&refused, 1, &parts);
    assert!(!out.join("zarr.json").exists());
    let exported = run(["export", &place, text(&out), "--forbidden-is-missing"]);
    assert!(exported.status.success(), "{}", stderr(&exported));
    assert!(out.join("zarr.json").exists());
}

/// An image that should be there by its name is not missed as an archive.
#[test]
fn a_missing_image_is_missed_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let image = folder.path().join("cells.ome.zarr");
    for made in [false, true] {
        if made {
            std::fs::create_dir(&image).unwrap();
        }
        for command in [
            &["serve", text(&image), "--port", "0"][..],
            &["export", text(&image), "out"],
        ] {
            assert_failed(
                &run(command),
                1,
                &["no image that can be opened", text(&image)],
            );
        }
    }
}

#[test]
fn what_is_no_image_says_what_was_looked_for() {
    let (_files, address) = Files::default().with("/page/index.html", "hello").start();
    let picture = std::env::temp_dir().join("saccade-never-written.png");
    let picture = picture.to_str().unwrap();
    let output = run(["render", &format!("http://{address}/page"), "-o", picture]);
    let said = stderr(&output);
    assert!(!output.status.success());
    for part in ["zarr.json", "info", &address] {
        assert!(said.contains(part), "{part:?} is not in: {said}");
    }
    let output = run(["render", "ftp://host/x.zarr", "-o", picture]);
    assert!(
        !output.status.success() && stderr(&output).contains("ftp"),
        "{}",
        stderr(&output)
    );
}

/// A store that knows no such bucket says so in XML, whatever it is asked.
#[test]
fn an_export_to_a_bucket_that_is_not_there_says_how_to_mend_it() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            std::thread::spawn(move || {
                let mut stream = stream.unwrap();
                let mut asked = BufReader::new(stream.try_clone().unwrap());
                loop {
                    let (mut line, mut length) = (String::new(), 0_u64);
                    while line != "\r\n" {
                        line.clear();
                        if asked.read_line(&mut line).unwrap_or(0) == 0 {
                            return;
                        }
                        let header = line.to_ascii_lowercase();
                        if let Some(told) = header.strip_prefix("content-length:") {
                            length = told.trim().parse().unwrap();
                        }
                    }
                    let mut body = Vec::new();
                    asked.by_ref().take(length).read_to_end(&mut body).unwrap();
                    let xml = "<?xml version=\"1.0\"?><Error><Code>NoSuchBucket</Code><Message>The specified bucket does not \
                               exist</Message><BucketName>nowhere</BucketName></Error>";
                    let head = format!(
                        "HTTP/1.1 404 Not Found\r\ncontent-type: application/xml\r\ncontent-length: {}\r\n\r\n",
                        xml.len()
                    );
                    if stream.write_all(format!("{head}{xml}").as_bytes()).is_err() {
                        return;
                    }
                }
            });
        }
    });
    let folder = tempfile::tempdir().unwrap();
    let archive = crate::archive(folder.path());
    let output = saccade()
        .args(["export", &archive, "s3://nowhere/image.zarr"])
        .env("AWS_ENDPOINT_URL", &endpoint)
        .env("AWS_ACCESS_KEY_ID", "id")
        .env("AWS_SECRET_ACCESS_KEY", "secret")
        .env("AWS_REGION", "us-east-1")
        .output()
        .unwrap();
    let parts = ["no such bucket; make it first", "s3://nowhere/image.zarr"];
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(parts.iter().all(|part| said.contains(part)), "{said}");
    assert!(
        said.contains("NoSuchBucket: The specified") && !said.contains("<Code>"),
        "{said}"
    );
}
