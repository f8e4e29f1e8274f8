//! The server under load: beside nginx, and among clients that mean no good.

use std::fs;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use glam::UVec3;
use saccade_archive::VisualizationArchive;
use saccade_core::voxel_box::VoxelBox;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{self, IngestOptions};
use saccade_serve::{Options, Server, Volumes};
use saccade_source::stitched::{StitchedOptions, StitchedSource};
use saccade_source::{Chunk, ChunkId, VolumeSource};
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;
use tokio::runtime::Runtime;

use crate::clock::Stopwatch;
use crate::memory;
use crate::report::Row;
use crate::rows::attackers::{Attackers, BYTE, Priority};
use crate::rows::runtime;
use crate::scene::{Mosaic, NAME};
use crate::settings::Settings;
use crate::volumes::Scale;

const SLOWLORIS: &str = "serve.slowloris_p99_ratio";
const NGINX: &str = "serve.vs_nginx";

pub(crate) const SLOWLORIS_IDS: &[&str] = &[SLOWLORIS];
pub(crate) const NGINX_IDS: &[&str] = &[NGINX];

const MEMORY_GROWTH: &str = "serve.two_minutes.memory_growth_mb";
const LONG_P99: &str = "serve.two_minutes.p99_ms";
const LONG_NGINX: &str = "serve.two_minutes.vs_nginx";

pub(crate) const LONG_IDS: &[&str] = &[MEMORY_GROWTH, LONG_P99, LONG_NGINX];

const RUNS: usize = 3;

// --- among slow clients -------------------------------------------------------------------------

/// Connections that send a byte now and then.
const SLOW: usize = 10_000;
/// Requests of the good client, one after the other.
const REQUESTS: usize = 4000;

pub(crate) fn measure_slowloris() -> Result<Vec<Row>> {
    let served = Served::new()?;
    let client = runtime()?;
    let keys = served.keys();
    let slow = slow_sockets();
    let mut ours = Attacks::default();
    let mut theirs = Attacks::default();
    // What the attack costs whoever is attacked, on this machine.
    let nginx = nginx_program().map(|program| Nginx::start(&program, &served));
    let nginx = nginx.transpose()?;
    for _ in 0..RUNS {
        ours.measure(&client, served.address, &keys, slow)?;
        if let Some(nginx) = &nginx {
            theirs.measure(&client, nginx.address, &keys, slow)?;
        }
    }
    let ms = |p99: &[f64]| rounded(&p99.iter().map(|p99| p99 * 1e3).collect::<Vec<_>>());
    let mut row = Row::new(SLOWLORIS, "of the idle p99", ours.ratios(Priority::Last))
        .setting("slow sockets", slow)
        .setting("a byte every", "1 s each")
        .setting("requests per run", REQUESTS)
        .setting("chunk", "64 x 64 x 32, stitched before")
        .setting("idle p99 [ms]", ms(&ours.idle))
        .setting("p99 among them [ms]", ms(&ours.last))
        .setting(
            "among attackers of equal priority",
            rounded(&ours.ratios(Priority::Equal)),
        );
    if nginx.is_some() {
        let ratios = |priority| rounded(&theirs.ratios(priority));
        row = row
            .setting("nginx in our place, from files", ratios(Priority::Last))
            .setting(
                "nginx among attackers of equal priority",
                ratios(Priority::Equal),
            )
            .setting("nginx's idle p99 [ms]", ms(&theirs.idle))
            .setting("nginx's p99 among them [ms]", ms(&theirs.last));
    }
    Ok(vec![row])
}

/// The 99th percentiles of a good client's requests \[s\].
#[derive(Debug, Default)]
struct Attacks {
    idle: Vec<f64>,
    last: Vec<f64>,
    equal: Vec<f64>,
}

impl Attacks {
    /// Alone, and among slow clients of either priority.
    fn measure(
        &mut self,
        client: &Runtime,
        server: SocketAddr,
        keys: &[String],
        slow: usize,
    ) -> Result<()> {
        self.idle.push(client.block_on(good_client(server, keys))?);
        for priority in [Priority::Last, Priority::Equal] {
            let attackers = Attackers::start(server, slow, priority)?;
            // The answers to their arrival are over.
            client.block_on(async { tokio::time::sleep(BYTE).await });
            let attacked = client.block_on(good_client(server, keys))?;
            attackers.stop()?;
            client.block_on(async { tokio::time::sleep(BYTE).await });
            match priority {
                Priority::Last => self.last.push(attacked),
                Priority::Equal => self.equal.push(attacked),
            }
        }
        Ok(())
    }

    fn ratios(&self, priority: Priority) -> Vec<f64> {
        let attacked = match priority {
            Priority::Last => &self.last,
            Priority::Equal => &self.equal,
        };
        let pairs = attacked.iter().zip(&self.idle);
        pairs.map(|(attacked, idle)| attacked / idle).collect()
    }
}

/// As many as the process may have, beside what the server keeps of them.
fn slow_sockets() -> usize {
    let limits = fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let line = limits
        .lines()
        .find_map(|l| l.strip_prefix("Max open files"));
    let files = line.and_then(|l| l.split_whitespace().next()?.parse::<usize>().ok());
    SLOW.min(files.unwrap_or(256) / 2)
}

/// The 99th percentile of one client's requests \[s\].
async fn good_client(server: SocketAddr, keys: &[String]) -> Result<f64> {
    let mut client = Client::connect(server).await?;
    let mut choice = Choice(1);
    let mut times = Vec::with_capacity(REQUESTS);
    for _ in 0..REQUESTS {
        let watch = Stopwatch::start();
        client.get(choice.of(keys)).await?;
        times.push(watch.elapsed().as_secs_f64());
    }
    Ok(percentile99(times))
}

// --- beside nginx -------------------------------------------------------------------------------

const CLIENTS: usize = 64;
const LOAD: Duration = Duration::from_secs(10);

pub(crate) fn measure_nginx() -> Result<Vec<Row>> {
    let Some(program) = nginx_program() else {
        eprintln!(
            "  left out: there is no nginx (./dev bench fetches Debian's, or name one in SACCADE_NGINX)"
        );
        return Ok(Vec::new());
    };
    let served = Served::new()?;
    let nginx = Nginx::start(&program, &served)?;
    let client = runtime()?;
    let keys = Arc::new(served.keys());
    let mut ratios = Vec::new();
    let mut rates = [Vec::new(), Vec::new()];
    let mut p99 = [Vec::new(), Vec::new()];
    for _ in 0..RUNS {
        for (which, server) in [served.address, nginx.address].into_iter().enumerate() {
            let (rate, slowest) = client.block_on(load(server, &keys, LOAD))?;
            rates[which].push(rate);
            p99[which].push(slowest * 1e3);
        }
        ratios.push(rates[0][rates[0].len() - 1] / rates[1][rates[1].len() - 1]);
    }
    let row = Row::new(NGINX, "of nginx's requests per second", ratios)
        .setting("clients", CLIENTS)
        .setting("seconds per run", LOAD.as_secs())
        .setting(
            "chunk",
            "64 x 64 x 32, stitched before, nginx's from cached files",
        )
        .setting("requests per second", rounded(&rates[0]))
        .setting("nginx's", rounded(&rates[1]))
        .setting("p99 [ms]", rounded(&p99[0]))
        .setting("nginx's p99 [ms]", rounded(&p99[1]));
    Ok(vec![row])
}

/// How long it is for when memory is watched; a twelfth where the scale is small.
const LONG: Duration = Duration::from_mins(2);
/// Looks at memory during that.
const LOOKS: u32 = 12;

/// The same load for long, and what it leaves in memory: the server is in this process, and its clients keep nothing that
/// grows.
pub(crate) fn measure_long(settings: &Settings) -> Result<Vec<Row>> {
    let length = match settings.scale {
        Some(Scale::Small) => LONG / 12,
        _ => LONG,
    };
    let served = Served::new()?;
    let client = runtime()?;
    let keys = Arc::new(served.keys());
    // Connections, buffers and caches are there before it counts.
    client.block_on(load(served.address, &keys, length / 12))?;
    let looks = client.spawn(async move {
        let mut looks = vec![memory::resident()?];
        for _ in 0..LOOKS {
            tokio::time::sleep(length / LOOKS).await;
            looks.push(memory::resident()?);
        }
        anyhow::Ok(looks)
    });
    let (rate, p99) = client.block_on(load(served.address, &keys, length))?;
    let looks: Vec<f64> = { client.block_on(looks)?? }.into_iter().map(mb).collect();
    let growth = looks[looks.len() - 1] - looks[0];
    let of_load = |row: Row| {
        row.setting("clients", CLIENTS)
            .setting("seconds", length.as_secs())
            .setting("requests per second", rate.round())
    };
    let mut rows = vec![
        of_load(Row::new(MEMORY_GROWTH, "MB", vec![growth]))
            .setting("resident [MB], in even steps", rounded(&looks)),
        of_load(Row::new(LONG_P99, "ms", vec![p99 * 1e3])),
    ];
    if let Some(program) = nginx_program() {
        let nginx = Nginx::start(&program, &served)?;
        let (nginx_rate, nginx_p99) = client.block_on(load(nginx.address, &keys, length))?;
        let unit = "of nginx's requests per second";
        rows.push(
            of_load(Row::new(LONG_NGINX, unit, vec![rate / nginx_rate]))
                .setting("nginx's", nginx_rate.round())
                .setting("nginx's p99 [ms]", rounded(&[nginx_p99 * 1e3])),
        );
    }
    Ok(rows)
}

fn mb(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}

/// Requests per second of all clients, and the 99th percentile \[s\].
async fn load(server: SocketAddr, keys: &Arc<Vec<String>>, length: Duration) -> Result<(f64, f64)> {
    let watch = Stopwatch::start();
    let clients = (0..CLIENTS).map(|seed| {
        let keys = keys.clone();
        tokio::spawn(async move {
            let mut client = Client::connect(server).await?;
            let mut choice = Choice(seed as u64);
            let mut times = Times::default();
            while watch.elapsed() < length {
                let one = Stopwatch::start();
                client.get(choice.of(&keys)).await?;
                times.add(one.elapsed().as_secs_f64());
            }
            anyhow::Ok(times)
        })
    });
    let mut times = Times::default();
    for client in clients.collect::<Vec<_>>() {
        times.merge(&client.await??);
    }
    let rate = times.count() as f64 / watch.elapsed().as_secs_f64();
    Ok((rate, times.percentile(0.99)))
}

/// Up to 67 s.
const BINS: usize = 26 * 64;

/// How many requests took how long, in as much memory for any number of them.
struct Times([u64; BINS]);

impl Default for Times {
    fn default() -> Self {
        Self([0; BINS])
    }
}

impl Times {
    /// The first ends here \[s\].
    const SHORTEST: f64 = 1e-6;
    /// In each doubling: no time is taken for one that is 1.1 % longer.
    const PER_OCTAVE: f64 = 64.0;
    fn add(&mut self, seconds: f64) {
        let bin = (seconds / Self::SHORTEST).log2() * Self::PER_OCTAVE;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "below 0 is 0, and what is too large the last"
        )]
        let bin = (bin.ceil() as usize).min(BINS - 1);
        self.0[bin] += 1;
    }

    fn merge(&mut self, others: &Self) {
        for (own, other) in self.0.iter_mut().zip(&others.0) {
            *own += other;
        }
    }

    fn count(&self) -> u64 {
        self.0.iter().sum()
    }

    /// The time that so many took no longer than, of all \[s\].
    fn percentile(&self, share: f64) -> f64 {
        let wanted = self.count() as f64 * share;
        let mut so_far = 0;
        let bin = self.0.iter().position(|count| {
            so_far += count;
            so_far > 0 && so_far as f64 >= wanted
        });
        bin.map_or(f64::NAN, |bin| {
            Self::SHORTEST * (bin as f64 / Self::PER_OCTAVE).exp2()
        })
    }
}

/// nginx, serving the same bytes as files.
struct Nginx {
    process: Child,
    address: SocketAddr,
    _folder: TempDir,
}

impl Nginx {
    fn start(program: &Path, served: &Served) -> Result<Self> {
        let folder = TempDir::with_prefix("saccade-nginx-")?;
        // Its workers may run as somebody else.
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755))?;
        for (key, bytes) in &served.chunks {
            let file = folder.path().join(key.trim_start_matches('/'));
            fs::create_dir_all(file.parent().context("a chunk has a folder")?)?;
            fs::write(file, bytes)?;
        }
        let address = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?;
        let root = folder.path().display();
        let temporary = ["client_body", "proxy", "fastcgi", "uwsgi", "scgi"];
        let temporary = temporary
            .map(|of| format!("{of}_temp_path {root}/{of};"))
            .join(" ");
        let settings = format!(
            "worker_processes auto; daemon off; pid {root}/pid; error_log stderr error; \
             worker_rlimit_nofile 30000; events {{ worker_connections 20000; }} \
             http {{ access_log off; sendfile on; tcp_nopush on; tcp_nodelay on; \
             keepalive_requests 1000000000; open_file_cache max=10000; {temporary} \
             default_type application/octet-stream; server {{ listen {address}; root {root}; }} }}"
        );
        let file = folder.path().join("nginx.conf");
        fs::write(&file, settings)?;
        let process = Command::new(program)
            .args(["-e", "stderr", "-p"])
            .arg(folder.path())
            .arg("-c")
            .arg(&file)
            .stdin(Stdio::null())
            .spawn()
            .with_context(|| format!("cannot run {}", program.display()))?;
        let nginx = Self {
            process,
            address,
            _folder: folder,
        };
        let watch = Stopwatch::start();
        while std::net::TcpStream::connect(address).is_err() {
            ensure!(
                watch.elapsed() < Duration::from_secs(5),
                "nginx does not answer"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(nginx)
    }
}

impl Drop for Nginx {
    fn drop(&mut self) {
        // Its workers end with it only when it is asked.
        let process = self.process.id().to_string();
        drop(Command::new("kill").arg(process).status());
        drop(self.process.wait());
    }
}

fn nginx_program() -> Option<PathBuf> {
    let named = std::env::var_os("SACCADE_NGINX").map(PathBuf::from);
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&path).map(|folder| folder.join("nginx"));
    let usual = Some(PathBuf::from("/usr/sbin/nginx"));
    named
        .into_iter()
        .chain(found)
        .chain(usual)
        .find(|file| file.is_file())
}

// --- what both need -----------------------------------------------------------------------------

/// A server in this process, with threads of its own, and what it serves: chunks stitched out of tiles, all
/// of which were asked for before.
struct Served {
    _runtime: Runtime,
    _archive: TempDir,
    address: SocketAddr,
    chunks: Vec<(String, Vec<u8>)>,
}

const MOSAIC: Mosaic = Mosaic {
    edge: 512,
    side: 2,
    sections: 64,
};

impl Served {
    fn new() -> Result<Self> {
        let folder = TempDir::with_prefix("saccade-served-")?;
        let runtime = runtime()?;
        let (server, source, chunks) = runtime.block_on(async {
            let source = Arc::new(stitched(folder.path()).await?);
            let server = Server::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))).await?;
            let mut chunks = Vec::new();
            for chunk in VoxelBox::of_size(source.volume().chunks(0)).iter() {
                let id = ChunkId {
                    channel: 0,
                    level: 0,
                    chunk,
                };
                // Beyond the tiles there is nothing.
                let Chunk::Voxels(bytes) = source.read(id).await? else {
                    continue;
                };
                let UVec3 { x, y, z } = chunk;
                chunks.push((format!("/v/{NAME}/zarr/0/c/0/{z}/{y}/{x}"), bytes.to_vec()));
            }
            anyhow::Ok((server, source, chunks))
        })?;
        let address = server.address();
        let volumes = Volumes::new();
        let _inside = runtime.enter();
        volumes.publish(source, None);
        runtime.spawn(server.run(volumes, Options::DEFAULT, std::future::pending()));
        drop(_inside);
        Ok(Self {
            _runtime: runtime,
            _archive: folder,
            address,
            chunks,
        })
    }

    fn keys(&self) -> Vec<String> {
        self.chunks.iter().map(|(key, _)| key.clone()).collect()
    }
}

/// A mosaic taken in, as `saccade serve` opens it.
async fn stitched(folder: &Path) -> Result<StitchedSource> {
    let acquisition = folder.join("acquisition");
    MOSAIC.acquire(&acquisition)?;
    let archive = VisualizationArchive::create(&folder.join("archive")).await?;
    let options = IngestOptions {
        once: true,
        ..Default::default()
    };
    ingest::run(&acquisition, &archive, &options, &(), &Cancel::new()).await?;
    Ok(StitchedSource::open(&archive, NAME, StitchedOptions::default()).await?)
}

/// One connection that is kept, and as little work as possible on this side of it.
struct Client {
    stream: BufReader<TcpStream>,
    line: String,
    body: Vec<u8>,
}

impl Client {
    async fn connect(server: SocketAddr) -> Result<Self> {
        let stream = TcpStream::connect(server).await?;
        stream.set_nodelay(true)?;
        Ok(Self {
            stream: BufReader::with_capacity(4 * 1024, stream),
            line: String::new(),
            body: Vec::new(),
        })
    }

    async fn get(&mut self, key: &str) -> Result<()> {
        let request = format!("GET {key} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        self.stream.write_all(request.as_bytes()).await?;
        let mut length = None;
        let mut first = true;
        loop {
            self.line.clear();
            ensure!(
                self.stream.read_line(&mut self.line).await? > 0,
                "the connection ended"
            );
            let line = self.line.trim_end();
            if std::mem::take(&mut first) {
                ensure!(line.starts_with("HTTP/1.1 200"), "{key}: {line}");
            } else if line.is_empty() {
                break;
            } else if let Some((name, value)) = line.split_once(':')
                && name.eq_ignore_ascii_case("content-length")
            {
                length = Some(value.trim().parse::<usize>()?);
            }
        }
        self.body
            .resize(length.context("an answer without length")?, 0);
        self.stream.read_exact(&mut self.body).await?;
        Ok(())
    }
}

/// Splitmix64: the same choice in every run.
struct Choice(u64);

impl Choice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    fn of<'a>(&mut self, keys: &'a [String]) -> &'a str {
        let at = self.next() % keys.len() as u64;
        &keys[usize::try_from(at).unwrap_or(0)]
    }
}

fn percentile99(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times
        .get(times.len() * 99 / 100)
        .copied()
        .unwrap_or(f64::NAN)
}

fn rounded(values: &[f64]) -> Vec<f64> {
    values.iter().map(|v| (v * 100.0).round() / 100.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn binned_times_have_the_percentiles_of_all() {
        let mut choice = Choice(7);
        // From 20 µs to 20 ms, and a few that are not.
        let mut all: Vec<f64> = (0..5000)
            .map(|_| 2e-5 * 1000_f64.powf(choice.next() as f64 / u64::MAX as f64))
            .collect();
        all.extend([0.0, 1e-9, 3.0, 1e9]);
        let mut halves = [Times::default(), Times::default()];
        for (n, time) in all.iter().enumerate() {
            halves[n % 2].add(*time);
        }
        let [mut times, other] = halves;
        times.merge(&other);
        assert_eq!(times.count(), all.len() as u64);
        let (got, want) = (times.percentile(0.99), percentile99(all));
        assert!((got / want - 1.0).abs() < 0.02, "{got} s for {want} s");
        assert!(times.percentile(0.5) < got / 10.0);
        assert!(Times::default().percentile(0.99).is_nan());
    }
}
