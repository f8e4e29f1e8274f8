//! The catalog's server is away: when the program starts, and while it works.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, SystemTime};

use super::postgres::Server;
use super::{Running, saccade, simulate};

/// Longest wait for what must come.
const PATIENCE: Duration = Duration::from_secs(60);

/// What a program writes, line by line.
fn lines(from: impl std::io::Read + Send + 'static) -> Receiver<String> {
    let (send, lines) = channel();
    std::thread::spawn(move || {
        for line in BufReader::new(from).lines().map_while(Result::ok) {
            if send.send(line).is_err() {
                return;
            }
        }
    });
    lines
}

/// Waits for a line that holds this.
pub(super) fn says(lines: &Receiver<String>, what: &str) -> String {
    let mut before = Vec::new();
    while let Ok(line) = lines.recv_timeout(PATIENCE) {
        if line.contains(what) {
            return line;
        }
        before.push(line);
    }
    panic!("it does not say {what:?}, but {before:#?}");
}

pub(super) struct Program {
    running: Running,
    stdout: Receiver<String>,
    pub(super) stderr: Receiver<String>,
}

impl Program {
    fn start(arguments: &[&str]) -> Self {
        Self::start_with(arguments, &[])
    }

    /// With variables of its environment.
    pub(super) fn start_with(arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        let mut command = saccade();
        command.args(arguments).envs(environment.iter().copied());
        let mut child: Child = { command.stdout(Stdio::piped()).stderr(Stdio::piped()) }
            .spawn()
            .unwrap();
        Self {
            stdout: lines(child.stdout.take().unwrap()),
            stderr: lines(child.stderr.take().unwrap()),
            running: Running(child),
        }
    }

    fn ends_well(self) {
        self.ends_with(0);
    }

    pub(super) fn ends_with(mut self, code: i32) {
        let until = SystemTime::now() + PATIENCE;
        while SystemTime::now() < until {
            if let Some(status) = self.running.0.try_wait().unwrap() {
                let said: Vec<_> = self.stderr.try_iter().collect();
                assert_eq!(status.code(), Some(code), "{said:#?}");
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("it does not end");
    }
}

pub(super) fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A database without tables is a catalog that is about to be made; one that the server does not have is not.
#[test]
fn an_empty_database_is_waited_for() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let url = runtime.block_on(server.database());
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    let archive = folder.path().join("archive");
    simulate(&acquisition, "150,130,12");

    let nowhere = url.replace("/db", "/nodb");
    for command in ["ingest", "serve"] {
        let mut arguments = vec![command];
        arguments.extend((command == "ingest").then_some(text(&acquisition)));
        arguments.extend([text(&archive), "--catalog", &nowhere]);
        let output = saccade().args(arguments).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        for part in ["no database of that name", "createdb", "/nodb"] {
            assert!(said.contains(part), "{part:?} is not in: {said}");
        }
    }

    let serve = ["serve", text(&archive), "--port", "0", "--catalog", &url];
    let serve = Program::start(&serve);
    says(
        &serve.stderr,
        "there is no catalog; `saccade ingest` makes one",
    );
    let place = [text(&acquisition), text(&archive), "--catalog", &url];
    Program::start(&[&["ingest", "--once", "--lossless"], &place[..]].concat()).ends_well();
    says(&serve.stderr, "the catalog can be used now");
    let address = says(&serve.stdout, "http://127.0.0.1:");
    saccade_archive::tls::provide();
    let until = SystemTime::now() + PATIENCE;
    while runtime
        .block_on(saccade_source::remote::volumes(&address))
        .unwrap()
        .is_empty()
    {
        assert!(SystemTime::now() < until, "the volume is not offered");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn it_is_waited_for_and_work_goes_on() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let url = runtime.block_on(server.database());
    let folder = tempfile::tempdir().unwrap();
    let (acquisition, archive) = (
        folder.path().join("acquisition"),
        folder.path().join("archive"),
    );
    simulate(&acquisition, "150,130,12");

    // At the start of ingest.
    server.kill();
    let place = [text(&acquisition), text(&archive), "--catalog", &url];
    let ingest = [&["ingest", "--once", "--lossless"], &place[..]].concat();
    let ingest = Program::start(&ingest);
    says(
        &ingest.stderr,
        "the catalog's server does not answer; start it",
    );
    server.run();
    says(&ingest.stderr, "the catalog can be used now");
    ingest.ends_well();

    // At the start of the server.
    server.kill();
    let serve = ["serve", text(&archive), "--port", "0", "--catalog", &url];
    let serve = Program::start(&serve);
    says(
        &serve.stderr,
        "the catalog's server does not answer; start it",
    );
    assert!(serve.stdout.try_recv().is_err(), "it offers nothing yet");
    server.run();
    let address = says(&serve.stdout, "http://127.0.0.1:");
    saccade_archive::tls::provide();
    let status = |path: &str| {
        let get = reqwest::get(format!("{}{path}", address.trim_end_matches('/')));
        let answer = runtime.block_on(get).unwrap();
        answer.status().as_u16()
    };
    let names = runtime.block_on(saccade_source::remote::volumes(&address));
    let name = names.unwrap().remove(0);
    let metadata = format!("/v/{name}/zarr/zarr.json");
    assert_eq!(status(&metadata), 200);

    // While it serves: sections that nobody looked at cannot be looked up, which is told, and passes.
    server.kill();
    let chunk = format!("/v/{name}/zarr/0/c/0/0/0/0");
    assert_eq!(status(&chunk), 503, "not an absent chunk, which is 404");
    for path in [&chunk, &format!("/v/{name}/status.json")] {
        let told = runtime.block_on(async {
            let get = reqwest::get(format!("{}{path}", address.trim_end_matches('/')));
            get.await.unwrap().text().await.unwrap()
        });
        assert!(told.contains("server does not answer; start it"), "{told}");
        assert!(!told.contains("postgres://"), "{told}");
    }
    says(&serve.stderr, "server does not answer");
    assert_eq!(status(&metadata), 200, "what is known stays");
    server.run();
    let until = SystemTime::now() + PATIENCE;
    while status(&chunk) != 200 {
        assert!(SystemTime::now() < until, "{} for good", status(&chunk));
        std::thread::sleep(Duration::from_millis(100));
    }
    drop(serve);
}
