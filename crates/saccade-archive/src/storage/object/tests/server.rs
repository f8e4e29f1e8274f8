//! A real S3 server, and a proxy before it that loses, delays and refuses: `tests/s3/store.py`.
//!
//! `SACCADE_S3_PYTHON` names a Python that has what `tests/s3/requirements.txt` lists; `./dev test` makes one.
//! `SACCADE_S3_TESTS=require` makes it a failure if there is none, `skip` leaves these tests out; else they run where
//! one is named.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::PathBuf;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;

use super::super::{ObjectStorage, RETRIES, WHOLE};
use crate::storage::{Storage as _, conformance};

/// A server with an empty bucket. It ends with the process that started it, however that ends.
struct Server {
    child: Child,
    prints: BufReader<ChildStdout>,
    url: String,
}

impl Server {
    /// A server of which some requests, by their share, meet faults; `None` if these tests are to be left out.
    fn start(faults: &[&str]) -> Option<Self> {
        let wish = std::env::var("SACCADE_S3_TESTS").unwrap_or_default();
        let python = std::env::var("SACCADE_S3_PYTHON").unwrap_or_default();
        if wish == "skip" {
            return None;
        }
        if python.is_empty() {
            assert_ne!(
                wish, "require",
                "there is no S3 server; name a Python that has moto in SACCADE_S3_PYTHON"
            );
            return None;
        }
        let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/s3/store.py");
        let mut child = Command::new(python)
            .arg("-B")
            .arg(script)
            .args(faults)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut prints = BufReader::new(child.stdout.take().unwrap());
        let mut url = String::new();
        prints.read_line(&mut url).unwrap();
        assert!(url.starts_with("http://"), "it prints {url:?}");
        let url = url.trim().to_owned();
        Some(Self { child, prints, url })
    }

    fn storage(&self, prefix: &str) -> ObjectStorage {
        let settings = [
            ("AWS_ENDPOINT_URL", &*self.url),
            ("AWS_ACCESS_KEY_ID", "id"),
            ("AWS_SECRET_ACCESS_KEY", "secret"),
        ];
        let settings = settings.map(|(name, value)| (name.to_owned(), value.to_owned()));
        let location = format!("s3://lab{prefix}").parse().unwrap();
        ObjectStorage::with_settings(&location, settings, RETRIES).unwrap()
    }

    fn end(mut self) -> Report {
        drop(self.child.stdin.take());
        let mut report = String::new();
        self.prints.read_to_string(&mut report).unwrap();
        assert!(self.child.wait().unwrap().success());
        serde_json::from_str(&report).unwrap()
    }
}

#[derive(Debug, serde::Deserialize)]
struct Report {
    /// How often each has happened.
    faults: BTreeMap<String, u32>,
    /// Parts of uploads that were neither completed nor aborted.
    uploads: Vec<Vec<u32>>,
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_conforms() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    for prefix in ["", "/deep/prefix"] {
        conformance::check(Arc::new(server.storage(prefix))).await;
    }
    let report = server.end();
    assert!(
        report.faults.is_empty() && report.uploads.is_empty(),
        "{report:?}"
    );
}

/// What passes is overcome without a word to who asked.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_conforms_under_faults() {
    let shares = ["busy=0.04", "reset=0.03", "lost=0.04", "cut=0.03"];
    let Some(server) = Server::start(&shares) else {
        return;
    };
    conformance::check(Arc::new(server.storage("/pre"))).await;
    let happened = server.end().faults;
    for share in shares {
        let fault = share.split('=').next().unwrap();
        assert!(happened[fault] > 0, "{fault} never happened: {happened:?}");
    }
}

/// So long that it is written in three parts.
fn long(first: u8) -> Bytes {
    let some: Vec<u8> = (0..251).map(|n| n ^ first).collect();
    some.repeat((WHOLE + 1) / some.len() + 1).into()
}

/// An object's name has the server do it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_step_of_an_upload_meets_each_fault() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let storage = server.storage("");
    let mut number = 0;
    for step in ["begin", "part", "complete"] {
        for fault in ["busy", "reset", "lost", "cut"] {
            let name = format!("{step}-{fault}");
            let bytes = long(number);
            storage.write_durable(&name, bytes.clone()).await.unwrap();
            let there = storage.read(&name, None).await.unwrap();
            assert!(there == bytes, "{name}");
            storage.delete(&name).await.unwrap();
            number += 1;
        }
    }
    let report = server.end();
    assert_eq!(report.faults.values().collect::<Vec<_>>(), [&3; 4]);
    // Of these nobody was told the number.
    assert_eq!(report.uploads, [[0; 0]; 2], "one was lost, one cut short");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_given_up_leaves_no_parts() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let storage = server.storage("");
    for (name, wait) in [("begin-late", 1), ("part-hold", 3), ("complete-hold", 3)] {
        let write = storage.write_durable(name, long(0));
        let written = tokio::time::timeout(Duration::from_secs(wait), write).await;
        assert!(written.is_err(), "it is held up: {written:?}");
        storage.settled().await;
        assert_eq!(storage.list("").await.unwrap(), [""; 0]);
    }
    let report = server.end();
    assert_eq!((report.faults["late"], report.faults["hold"]), (1, 2));
    assert_eq!(report.uploads, [[0; 0]; 0]);
}
