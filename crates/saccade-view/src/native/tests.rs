//! A real window, on a display without a screen.

use std::cell::RefCell;
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use egui::{ColorImage, ViewportCommand};
use glam::{DVec3, UVec3};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, VolumeSource};

use super::*;
use crate::handover::Shown;

/// Blobs; reads are counted.
struct Blobs {
    inner: ArraySource,
    reads: AtomicU64,
}

impl Blobs {
    fn new() -> Self {
        let extent = UVec3::new(70, 60, 50);
        let volume = Volume::new("blobs", extent, DVec3::splat(4.0)).unwrap();
        let value = |at: UVec3| {
            let wave = |v: u32, length: f64| (f64::from(v) / length).sin();
            let sum = wave(at.x, 7.0) + wave(at.y, 5.0) + wave(at.z, 9.0);
            if sum > 0.4 { 220 } else { 30 }
        };
        let voxels = VoxelBox::of_size(extent).iter().map(value).collect();
        Self {
            inner: ArraySource::new(volume, voxels).unwrap(),
            reads: AtomicU64::new(0),
        }
    }
}

impl VolumeSource for Blobs {
    fn volume(&self) -> &Arc<Volume> {
        self.inner.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        self.reads.fetch_add(1, Ordering::Relaxed);
        self.inner.read(id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.inner.changes()
    }
}

/// What a hand did to the windows, and saw.
#[derive(Default)]
struct Seen {
    windows: u32,
    /// Of the whole window, once each was complete.
    pictures: Vec<Arc<ColorImage>>,
    /// Reads of the source when a picture was taken.
    reads: Vec<u64>,
    failure: Option<String>,
}

/// Looks at a window, turns the camera, loses the device, looks at the next window, and closes that.
struct Hand<'a> {
    shown: Shown,
    seen: &'a RefCell<Seen>,
    source: Arc<Blobs>,
    losses: u32,
    asked: bool,
    loses: bool,
    shot: Arc<Mutex<Option<Arc<ColorImage>>>>,
}

impl eframe::App for Hand<'_> {
    fn ui(&mut self, ui: &mut egui::Ui, frame: &mut eframe::Frame) {
        if std::mem::take(&mut self.loses) {
            let gpu = self.shown.app_mut().session.renderer().gpu();
            gpu.device().destroy();
        }
        self.shown.ui(ui, frame);
        let mut seen = self.seen.borrow_mut();
        let context = ui.ctx();
        context.request_repaint_after(Duration::from_millis(20));
        if context.input(|input| input.time) > 100.0 {
            seen.failure = Some(format!("window {} is never complete", seen.windows));
            context.send_viewport_cmd(ViewportCommand::Close);
            return;
        }
        let shot = self.shot.lock().unwrap().take();
        let app = self.shown.app_mut();
        if let Some(image) = shot {
            self.asked = false;
            seen.pictures.push(image);
            seen.reads.push(self.source.reads.load(Ordering::Relaxed));
            if seen.pictures.len() == 1 {
                app.camera = app.camera.orbited(50.0, 20.0);
            } else if seen.windows <= self.losses {
                // Before the next frame: as drivers do, it goes while something is drawn.
                self.loses = true;
            } else {
                context.send_viewport_cmd(ViewportCommand::Close);
            }
            context.request_repaint();
            return;
        }
        let complete = app.status.as_ref().is_some_and(|s| s.complete && s.settled);
        if complete && !self.asked && !app.preview {
            self.asked = true;
            let shot = self.shot.clone();
            context.request_screenshot(move |image| *shot.lock().unwrap() = Some(image));
        }
    }
}

/// Windows until the end, whose devices are lost so many times.
fn look(losses: u32) -> (Result<(), ViewError>, Seen) {
    let source = Arc::new(Blobs::new());
    let options = ViewOptions {
        ui: false,
        ..ViewOptions::default()
    };
    let windows = Windows::new(source.clone(), None, options);
    let seen = RefCell::new(Seen::default());
    let native = || eframe::NativeOptions {
        event_loop_builder: Some(Box::new(|builder| {
            use winit::platform::x11::EventLoopBuilderExtX11 as _;
            builder.with_any_thread(true);
        })),
        ..eframe::NativeOptions::default()
    };
    let result = windows.run(native, |shown| {
        seen.borrow_mut().windows += 1;
        Box::new(Hand {
            shown,
            seen: &seen,
            source: source.clone(),
            losses,
            asked: false,
            loses: false,
            shot: Arc::default(),
        })
    });
    drop(windows);
    (result, seen.into_inner())
}

/// In a process of its own, with a display: see below. Event loops are made once a process, so this is one test.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "started by the test below, with a display"]
async fn on_a_display() {
    let (result, seen) = look(1);
    result.unwrap();
    assert_eq!(seen.failure, None);
    assert_eq!(seen.windows, 2, "one more after the loss");
    let [first, turned, after] = &seen.pictures[..] else {
        panic!("{} pictures", seen.pictures.len());
    };
    assert_eq!(first.size, after.size, "as large as it was");
    assert!(
        first.pixels.iter().any(|p| p.r() > 100) && first.pixels.iter().any(|p| p.r() < 20),
        "something is seen"
    );
    assert!(first.pixels != turned.pixels, "the camera was turned");
    assert!(turned.pixels == after.pixels, "the picture is back");
    assert_eq!(seen.reads[1], seen.reads[2], "nothing is read again");

    let (result, seen) = look(u32::MAX);
    assert!(
        matches!(result, Err(ViewError::Lost)),
        "{result:?} after {} windows",
        seen.windows
    );
    assert_eq!(seen.windows, 4, "three devices are replaced");
}

#[test]
#[expect(clippy::print_stderr, reason = "why a test was left out")]
fn a_window_whose_device_is_lost_comes_back_with_its_picture() {
    let wanted = std::env::var("SACCADE_WINDOW_TESTS").is_ok_and(|v| v == "require");
    let server = Command::new("Xvfb")
        .args([
            "-displayfd",
            "1",
            "-screen",
            "0",
            "1024x768x24",
            "-nolisten",
            "tcp",
        ])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn();
    let mut server = match server {
        Ok(server) => server,
        Err(error) if wanted => panic!("Xvfb (Debian and Ubuntu: xvfb) does not start: {error}"),
        Err(error) => {
            eprintln!("left out: no Xvfb ({error}); SACCADE_WINDOW_TESTS=require asks for it");
            return;
        }
    };
    let mut display = String::new();
    let output = server.stdout.take().unwrap();
    BufReader::new(output).read_line(&mut display).unwrap();
    let name = "native::tests::on_a_display";
    let test = Command::new(std::env::current_exe().unwrap())
        .args([name, "--exact", "--ignored", "--nocapture"])
        .env("DISPLAY", format!(":{}", display.trim()))
        .env_remove("WAYLAND_DISPLAY")
        .output();
    server.kill().unwrap();
    server.wait().unwrap();
    let test = test.unwrap();
    let [out, err] = [&test.stdout, &test.stderr].map(|text| String::from_utf8_lossy(text));
    assert!(test.status.success(), "{out}\n{err}");
    assert!(out.contains("1 passed"), "{out}\n{err}");
}
