//! A PostgreSQL server of its own for each test binary, from the system's packages.
//!
//! `SACCADE_POSTGRES_TESTS=require` makes it a failure if there is none, `skip` leaves these tests out;
//! else they run where a server is installed. `SACCADE_POSTGRES_BIN` names the folder of its programs.

use std::fs;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

use sqlx::{Connection, PgConnection};

/// A server. It ends with the process that started it, however that ends.
pub(crate) struct Server {
    programs: PathBuf,
    folder: PathBuf,
    settings: Vec<String>,
    databases: AtomicU32,
    running: Mutex<Option<Child>>,
    /// Ends the server and removes its folder when this process' end of its pipe is closed.
    _undertaker: Child,
}

impl Server {
    /// The server that the tests of a process share; `None` if they are to be left out.
    pub(crate) fn shared() -> Option<&'static Self> {
        static SHARED: OnceLock<Option<Server>> = OnceLock::new();
        SHARED.get_or_init(|| Self::start(&[])).as_ref()
    }

    /// A server for one test, with settings as in `postgresql.conf`.
    pub(crate) fn start(settings: &[&str]) -> Option<Self> {
        let wish = std::env::var("SACCADE_POSTGRES_TESTS").unwrap_or_default();
        if wish == "skip" {
            return None;
        }
        let Some(programs) = programs() else {
            assert_ne!(
                wish, "require",
                "there is no PostgreSQL server; install Debian's `postgresql`, or name the folder of \
                 its programs in SACCADE_POSTGRES_BIN"
            );
            return None;
        };
        static SERVERS: AtomicU32 = AtomicU32::new(0);
        let number = SERVERS.fetch_add(1, Ordering::Relaxed);
        // Not below a private folder: the server runs as another user if this one is root. And a
        // socket's path must be short.
        let name = format!("saccade-pg-{}-{number}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        fs::create_dir(&folder).unwrap();
        if is_root() {
            done(Command::new("chown").arg("nobody").arg(&folder));
        }
        let data = folder.join("data");
        let mut initdb = as_server(&programs.join("initdb"));
        initdb.args(["--username=saccade", "--auth=trust", "--encoding=UTF8"]);
        initdb
            .args(["--locale=C", "--no-sync", "--pgdata"])
            .arg(&data);
        done(initdb.current_dir(&folder).stdout(Stdio::null()));
        let undertaker = Command::new("sh")
            .args(["-c", UNDERTAKER, "sh"])
            .arg(&folder)
            .stdin(Stdio::piped())
            .process_group(0)
            .spawn()
            .unwrap();
        let server = Self {
            programs,
            folder,
            settings: settings.iter().map(|s| (*s).to_owned()).collect(),
            databases: AtomicU32::new(0),
            running: Mutex::new(None),
            _undertaker: undertaker,
        };
        server.run();
        Some(server)
    }

    /// Starts it, again if it was killed.
    pub(crate) fn run(&self) {
        let mut patience = 3000;
        // What a killed server's processes still hold makes the next one refuse to start.
        loop {
            let mut server = as_server(&self.programs.join("postgres"));
            server.arg("-D").arg(self.folder.join("data"));
            server.arg("-k").arg(&self.folder);
            server.args(["-c", "listen_addresses=", "-c", "max_connections=150"]);
            for setting in &self.settings {
                server.args(["-c", setting]);
            }
            let log = fs::File::options()
                .create(true)
                .append(true)
                .open(self.folder.join("log"))
                .unwrap();
            server.current_dir(&self.folder).process_group(0);
            server.stdin(Stdio::null()).stdout(log.try_clone().unwrap());
            let mut child = server.stderr(log).spawn().unwrap();
            while child.try_wait().unwrap().is_none() {
                assert!(patience > 0, "{}", self.log());
                patience -= 1;
                let mut ready = Command::new(self.programs.join("pg_isready"));
                ready.arg("--quiet").arg("--host").arg(&self.folder);
                if ready.status().unwrap().success() {
                    *self.running.lock().unwrap() = Some(child);
                    return;
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            assert!(patience > 0, "{}", self.log());
            patience -= 1;
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// `kill -9`.
    pub(crate) fn kill(&self) {
        let mut child = self.running.lock().unwrap().take().expect("it runs");
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// A new, empty database.
    pub(crate) async fn database(&self) -> String {
        let name = format!("db{}", self.databases.fetch_add(1, Ordering::Relaxed));
        let mut connection = PgConnection::connect(&self.url("postgres")).await.unwrap();
        let create = sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"));
        sqlx::query(create).execute(&mut connection).await.unwrap();
        connection.close().await.unwrap();
        self.url(&name)
    }

    fn url(&self, database: &str) -> String {
        let host = self.folder.display();
        format!("postgres://saccade@localhost/{database}?host={host}")
    }

    fn log(&self) -> String {
        fs::read_to_string(self.folder.join("log")).unwrap_or_default()
    }
}

/// Waits for the end of its input, which comes with the end of who holds the other side.
const UNDERTAKER: &str = r#"
read -r _
read -r pid <"$1/data/postmaster.pid" && kill -QUIT "$pid"
for _ in 1 2 3 4 5 6 7 8 9 10; do kill -0 "$pid" 2>/dev/null || break; sleep 0.1; done
rm -rf "$1"
"#;

fn programs() -> Option<PathBuf> {
    let named = std::env::var_os("SACCADE_POSTGRES_BIN").map(PathBuf::from);
    let versions = fs::read_dir("/usr/lib/postgresql").into_iter().flatten();
    let mut versions: Vec<_> = versions.flatten().map(|v| v.path().join("bin")).collect();
    versions.sort();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let on_path = std::env::split_paths(&path).collect::<Vec<_>>();
    let mut all = named
        .into_iter()
        .chain(versions.into_iter().rev())
        .chain(on_path);
    all.find(|folder| {
        ["postgres", "initdb"]
            .iter()
            .all(|p| folder.join(p).is_file())
    })
}

fn is_root() -> bool {
    use std::os::unix::fs::MetadataExt;
    fs::metadata("/proc/self").is_ok_and(|own| own.uid() == 0)
}

/// The server refuses to run as root.
fn as_server(program: &Path) -> Command {
    if !is_root() {
        return Command::new(program);
    }
    let mut command = Command::new("setpriv");
    command.args(["--reuid=nobody", "--regid=nogroup", "--clear-groups"]);
    command.arg(program);
    command
}

fn done(command: &mut Command) {
    let status = command.status().unwrap();
    assert!(status.success(), "{command:?}: {status}");
}
