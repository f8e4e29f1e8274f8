//! A disk that is really full: a small one in memory, in a name space of its own, where the system allows that. `./dev test` says so
//! where it does not; `SACCADE_FULL_DISK_TESTS=require` makes that a failure, `skip` leaves the tests out.

use std::fs;
use std::io::Write;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use super::errors::text;
use super::kills_of_changes::exported;
use super::{done, simulate};

/// Everything that ingest writes finds no room: pyramids and the catalog. `$1` is the program, `$2` the acquisition, `$3` the disk,
/// `$4` what becomes of it while the disk is full, `wait` or `KILL`, `PYRAMIDS` if only they find no room, `OPEN` for one that starts then, `SEEN` for one that a server tells of, or `LATE` for one that does and starts then, `$5` a folder for what is said and for the archive that is made.
const SCRIPT: &str = r#"
set -e
# Waits until ingest, in the background, says that.
until_said() {
  tries=0
  until grep -q "$1" "$2"; do
    tries=$((tries + 1))
    test $tries -lt 600
    sleep 0.1
  done
}
mount -t tmpfs -o size=16m saccade-test "$3"
if [ "$4" = OPEN ]; then
  # There is an archive, and no room to open it in.
  "$1" ingest "$2" "$3/archive" --once --lossless 2> "$5/first"
  cat /dev/zero > "$3/ballast" 2> "$5/full" || true
  grep -q 'No space left' "$5/full"
  # Who is told to end does not wait for room.
  "$1" ingest "$2" "$3/archive" --lossless 2> "$5/early" &
  early=$!
  until_said 'no space is left for the catalog' "$5/early"
  kill -TERM $early
  (sleep 20; kill -KILL $early) &
  guard=$!
  wait $early
  kill $guard
  "$1" ingest "$2" "$3/archive" --once --lossless 2> "$5/log" &
  ingest=$!
  until_said 'no space is left for the catalog' "$5/log"
  sleep 1
  kill -0 $ingest
  rm "$3/ballast"
  wait $ingest
  "$1" check "$3/archive" --acquisition "$2" > "$5/check" 2>&1
  cp -r "$3/archive" "$5/archive"
  exit 0
fi
if [ "$4" = SEEN ] || [ "$4" = LATE ]; then
  # Somebody looks from elsewhere while nothing can be noted in the catalog.
  "$1" ingest "$2" "$3/archive" --once --lossless 2> "$5/first"
  "$1" serve "$3/archive" --port 0 > "$5/serve" 2> "$5/serving" &
  serve=$!
  go_on() {
    "$1" ingest "$2" "$3/archive" --lossless 2> "$5/log" &
    ingest=$!
  }
  if [ "$4" = SEEN ]; then
    go_on "$@"
  fi
  until_said http "$5/serve"
  cat /dev/zero > "$3/ballast" 2> "$5/full" || true
  if [ "$4" = LATE ]; then
    go_on "$@"
  fi
  touch "$5/is-full"
  until_said yes "$5/seen"
  rm "$3/ballast"
  touch "$5/is-free"
  until_said yes "$5/seen-free"
  kill -INT $ingest
  wait $ingest
  kill -INT $serve
  wait $serve
  "$1" check "$3/archive" --acquisition "$2" > "$5/check" 2>&1
  cp -r "$3/archive" "$5/archive"
  exit 0
fi
head -c 15m /dev/zero > "$3/ballast"
# Whether a pyramid or the catalog finds no room first is up to the disk.
why='waits: no space is left'
catalog="$3/archive/catalog.sqlite"
if [ "$4" = PYRAMIDS ]; then
  catalog="$5/catalog.sqlite"
  why='waits: no space is left to write; free some'
fi
"$1" ingest "$2" "$3/archive" --catalog "$catalog" --once --lossless 2> "$5/log" &
ingest=$!
until_said "$why" "$5/log"
# It goes on waiting.
sleep 1
kill -0 $ingest
if [ "$4" = KILL ]; then
  kill -KILL $ingest
  wait $ingest || true
  rm "$3/ballast"
  "$1" ingest "$2" "$3/archive" --catalog "$catalog" --once --lossless 2> "$5/again"
else
  rm "$3/ballast"
  wait $ingest
fi
"$1" check "$3/archive" --catalog "$catalog" --acquisition "$2" > "$5/check" 2>&1
cp -r "$3/archive" "$5/archive"
if [ "$4" = PYRAMIDS ]; then
  mv "$catalog" "$5/archive/catalog.sqlite"
fi
"#;

/// Whether this system lets anybody mount a disk of their own.
fn can_mount() -> bool {
    let tried = Command::new("unshare")
        .args(["--user", "--map-root-user", "--mount", "sh", "-c"])
        .arg("mount -t tmpfs saccade-test /mnt")
        .stderr(Stdio::null())
        .status();
    tried.is_ok_and(|status| status.success())
}

/// Ends a script and what it has started, whatever becomes of the test.
struct Group(Child);

impl Drop for Group {
    fn drop(&mut self) {
        let group = rustix::process::Pid::from_child(&self.0);
        // It is empty where the script has ended well.
        rustix::process::kill_process_group(group, rustix::process::Signal::KILL).ok();
        drop(self.0.wait());
    }
}

fn fill_and_go_on(end: &str) {
    let wish = std::env::var("SACCADE_FULL_DISK_TESTS").unwrap_or_default();
    if wish == "skip" {
        return;
    }
    if !can_mount() {
        assert_ne!(wish, "require", "no disk can be mounted with `unshare`");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for name in ["disk", "out"] {
        fs::create_dir(at(name)).unwrap();
    }
    simulate(&at("acquisition"), "300,260,16");
    let program = env!("CARGO_BIN_EXE_saccade");
    let mut command = Command::new("unshare");
    command
        .args([
            "--user",
            "--map-root-user",
            "--mount",
            "--fork",
            "--kill-child",
            "sh",
            "-c",
            SCRIPT,
            "sh",
        ])
        .arg(program)
        .args([at("acquisition"), at("disk")])
        .arg(end)
        .arg(at("out"))
        .stdin(Stdio::null())
        .process_group(0);
    let mut running = Group(command.spawn().unwrap());
    if end == "SEEN" || end == "LATE" {
        look_on(&at("acquisition"), &at("out"));
    }
    let mut looks = (0..3600).map(|_| {
        std::thread::sleep(Duration::from_millis(50));
        running.0.try_wait().unwrap()
    });
    let status = looks.find_map(|status| status).expect("it hangs");
    let said = |name: &str| fs::read_to_string(at("out").join(name)).unwrap_or_default();
    let (log, check) = (said("log"), said("check"));
    assert!(status.success(), "{log}\n{}\n{check}", said("again"));
    assert!(
        end != "PYRAMIDS" || log.contains("No space left on device"),
        "{log}"
    );
    // What a machine with room makes.
    let [roomy, acquisition] = ["roomy", "acquisition"].map(at);
    done([
        "ingest",
        text(&acquisition),
        text(&roomy),
        "--once",
        "--lossless",
    ]);
    let [want, got] = [roomy, at("out").join("archive")].map(|archive| exported(&archive));
    assert!(got == want, "other voxels");
}

/// Has new records come while the disk is full, and looks what the server says of them: why they wait, and for longer than
/// workers count as alive that give no sign of it.
fn look_on(acquisition: &Path, out: &Path) {
    saccade_archive::tls::provide();
    let until = |what: &str, is_so: &dyn Fn() -> bool| {
        let looks = (0..1200).any(|_| {
            std::thread::sleep(Duration::from_millis(50));
            is_so()
        });
        assert!(looks, "{what} does not happen");
    };
    until("a full disk", &|| out.join("is-full").exists());
    let said = fs::read_to_string(out.join("serve")).unwrap();
    let url = { said.split_whitespace() }.find(|word| word.starts_with("http"));
    let address = format!("{}v/phantom/status.json", url.unwrap());
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let status = || {
        let get = async { reqwest::get(&address).await?.json().await };
        runtime
            .block_on::<_>(get)
            .unwrap_or(serde_json::Value::Null)
    };
    let reasons = || {
        let status: serde_json::Value = status();
        let held = status["held_up"].as_array().cloned().unwrap_or_default();
        let whys = held.iter().map(|held| held["why"].to_string());
        whys.collect::<Vec<_>>().join("; ")
    };
    let records = acquisition.join("tiles.jsonl");
    let lines = fs::read_to_string(&records).unwrap();
    let again = lines.lines().next().unwrap();
    let again = again.replace("\"tile\":\"", "\"tile\":\"later-");
    let mut file = fs::OpenOptions::new().append(true).open(&records).unwrap();
    writeln!(file, "{again}").unwrap();
    until("a reason", &|| {
        reasons().contains("no space is left for the catalog")
    });
    let mut missing = 0;
    for _ in 0..50 {
        std::thread::sleep(Duration::from_millis(500));
        missing += u32::from(!reasons().contains("no space is left"));
    }
    assert_eq!(missing, 0, "it is not told throughout");
    fs::write(out.join("seen"), "yes").unwrap();
    until("room", &|| out.join("is-free").exists());
    let before = lines.matches("\"record\":\"tile\"").count() as u64;
    until("its end", &|| {
        status()["tiles"] == before + 1 && !reasons().contains("no space")
    });
    fs::write(out.join("seen-free"), "yes").unwrap();
}

#[test]
fn why_nothing_comes_in_is_told_by_a_server() {
    fill_and_go_on("SEEN");
}

/// It cannot even say there that it is at work.
#[test]
fn why_nothing_comes_in_is_told_of_who_begins_on_a_full_disk() {
    fill_and_go_on("LATE");
}

#[test]
fn work_goes_on_when_there_is_room_again() {
    fill_and_go_on("wait");
}

#[test]
fn pyramids_wait_for_room_while_there_is_some_for_the_catalog() {
    fill_and_go_on("PYRAMIDS");
}

#[test]
fn who_is_killed_while_the_disk_is_full_loses_nothing() {
    fill_and_go_on("KILL");
}

#[test]
fn who_finds_no_room_to_open_the_archive_waits_for_it() {
    fill_and_go_on("OPEN");
}
