//! A disk that is really full: a small one in memory, in a name space of its own, where the system allows that. `./dev test` says so
//! where it does not; `SACCADE_FULL_DISK_TESTS=require` makes that a failure, `skip` leaves the tests out.

use std::fs;
use std::process::{Command, Stdio};
use std::time::Duration;

use super::errors::text;
use super::kills_of_changes::exported;
use super::{Running, done, simulate};

/// Everything that ingest writes finds no room: pyramids and the catalog. `$1` is the program, `$2` the acquisition, `$3` the disk,
/// `$4` what becomes of it while the disk is full, `wait` or `KILL`, or `OPEN` for one that starts then, `$5` a folder for what is said and for the archive that is made.
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
head -c 15m /dev/zero > "$3/ballast"
"$1" ingest "$2" "$3/archive" --once --lossless 2> "$5/log" &
ingest=$!
until_said 'waits: no space is left to write; free some' "$5/log"
# It goes on waiting.
sleep 1
kill -0 $ingest
if [ "$4" = KILL ]; then
  kill -KILL $ingest
  wait $ingest || true
  rm "$3/ballast"
  "$1" ingest "$2" "$3/archive" --once --lossless 2> "$5/again"
else
  rm "$3/ballast"
  wait $ingest
fi
"$1" check "$3/archive" --acquisition "$2" > "$5/check" 2>&1
cp -r "$3/archive" "$5/archive"
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
        .stdin(Stdio::null());
    let mut running = Running(command.spawn().unwrap());
    let mut looks = (0..3600).map(|_| {
        std::thread::sleep(Duration::from_millis(50));
        running.0.try_wait().unwrap()
    });
    let status = looks.find_map(|status| status).expect("it hangs");
    let said = |name: &str| fs::read_to_string(at("out").join(name)).unwrap_or_default();
    let (log, check) = (said("log"), said("check"));
    assert!(status.success(), "{log}\n{}\n{check}", said("again"));
    assert!(
        end == "OPEN" || log.contains("No space left on device"),
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

#[test]
fn work_goes_on_when_there_is_room_again() {
    fill_and_go_on("wait");
}

#[test]
fn who_is_killed_while_the_disk_is_full_loses_nothing() {
    fill_and_go_on("KILL");
}

#[test]
fn who_finds_no_room_to_open_the_archive_waits_for_it() {
    fill_and_go_on("OPEN");
}
