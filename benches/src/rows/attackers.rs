//! Clients that never finish a request, and send a byte of it now and then.
//!
//! They are a process of their own. Attackers sit on other computers: what theirs costs here is not the server's, so the
//! process gives way to all others (`nice 19`), and says at its end how many bytes it sent all the same.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, ensure};

use crate::clock::Stopwatch;

/// Between two bytes of one of them.
pub(super) const BYTE: Duration = Duration::from_secs(1);
/// Bytes come one by one, as from many places, and not in a burst.
const PAUSE: Duration = Duration::from_micros(100);

/// What the process is told: the server, how many sockets, and its priority.
const ATTACK: &str = "SACCADE_BENCH_ATTACK";

/// How attackers share processors with whom they attack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Priority {
    /// As everybody else.
    Equal,
    /// Behind everybody else.
    Last,
}

/// A process of slow clients, until it is stopped.
pub(super) struct Attackers {
    process: Child,
    said: BufReader<ChildStdout>,
    began: Stopwatch,
    sockets: usize,
}

impl Attackers {
    /// Begins; returns once all have sent the beginning of a request.
    pub(super) fn start(server: SocketAddr, sockets: usize, priority: Priority) -> Result<Self> {
        let nice = match priority {
            Priority::Equal => 0,
            Priority::Last => 19,
        };
        let mut process = Command::new(std::env::current_exe()?)
            .env(ATTACK, format!("{server} {sockets} {nice}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("the attackers cannot be started")?;
        let said = process.stdout.take().context("the attackers say nothing")?;
        let mut attackers = Self {
            process,
            said: BufReader::new(said),
            began: Stopwatch::start(),
            sockets,
        };
        let connected = attackers.number()?;
        ensure!(
            connected * 10.0 > sockets as f64 * 9.0,
            "{connected} of {sockets} slow sockets"
        );
        attackers.began = Stopwatch::start();
        Ok(attackers)
    }

    fn number(&mut self) -> Result<f64> {
        let mut line = String::new();
        self.said.read_line(&mut line)?;
        line.trim().parse().context("the attackers are gone")
    }

    /// Ends them. An attack that hardly took place is an error.
    pub(super) fn stop(mut self) -> Result<()> {
        let planned = self.began.elapsed().div_duration_f64(BYTE) * self.sockets as f64;
        drop(self.process.stdin.take());
        let sent = self.number()?;
        self.process.wait()?;
        ensure!(
            sent > 0.9 * planned - 1000.0,
            "the attackers sent {sent} bytes instead of {planned:.0}"
        );
        Ok(())
    }
}

impl Drop for Attackers {
    fn drop(&mut self) {
        // Gone already, unless something else failed.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Attacks, if this process was started for that.
pub(crate) fn attack() -> Option<Result<()>> {
    let told = std::env::var(ATTACK).ok()?;
    Some(run(&told))
}

fn run(told: &str) -> Result<()> {
    let words: Vec<&str> = told.split(' ').collect();
    let [server, sockets, nice] = words[..] else {
        anyhow::bail!("{ATTACK} is {told:?}");
    };
    let (server, sockets): (SocketAddr, usize) = (server.parse()?, sockets.parse()?);
    rustix::process::setpriority_process(None, nice.parse()?)?;
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // Ends when whoever started it says so, or is gone.
            drop(std::io::stdin().read_to_end(&mut Vec::new()));
            stop.store(true, Ordering::Relaxed);
        });
        let mut streams: Vec<_> = (0..sockets).map(|_| slow_client(server)).collect();
        println!("{}", streams.iter().flatten().count());
        let (mut next, watch) = (0, Stopwatch::start());
        while !stop.load(Ordering::Relaxed) {
            let bytes = watch.elapsed().div_duration_f64(BYTE) * sockets as f64;
            while (next as f64) < bytes {
                let stream = &mut streams[next % sockets];
                let sent = { stream.as_ref() }.is_some_and(|mut s| s.write_all(b"z").is_ok());
                if !sent {
                    // The server ended it.
                    *stream = slow_client(server);
                }
                next += 1;
            }
            std::thread::sleep(PAUSE);
        }
        println!("{next}");
    });
    Ok(())
}

fn slow_client(server: SocketAddr) -> Option<TcpStream> {
    let mut stream = TcpStream::connect(server).ok()?;
    stream.set_nonblocking(true).ok()?;
    let head = b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ";
    stream.write_all(head).ok()?;
    Some(stream)
}
