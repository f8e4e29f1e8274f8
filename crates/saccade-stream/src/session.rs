//! A source, a renderer and the pull between them.

mod hidden;
mod memory;
mod shown;
mod status;

use std::collections::{HashMap, HashSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use glam::UVec2;
use saccade_core::brick::BrickId;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{
    BrickVoxels, ChannelError, ChannelView, Delivery, FrameReport, Gpu, Renderer, RendererError,
    View,
};
use saccade_source::{ChunkId, ValueRange, VolumeSource};

use crate::channels::{self, Channel};
use crate::clock::Clock;
use crate::detail::{Content, Detail};
use crate::histogram::Sample;
use crate::policy::{Limits, Pace, Refresh, Retry};
use crate::pull::{Freshness, Pull};
use crate::requests::{Event, Requests};
pub use memory::{TooLarge, TooMuch};
pub use status::{Again, Status};

/// Bricks whose bounds were told, kept in mind; beyond, all are forgotten and told again.
const MOST_TOLD: usize = 1 << 16;

/// Called, from any thread, when [`Session::frame`] would find something new.
pub type Wake = Arc<dyn Fn() + Send + Sync>;

/// What a session may use.
#[derive(Clone)]
pub struct SessionOptions {
    /// Ceiling for GPU memory \[bytes\]. An eighth of it is kept for the picture and for bricks on their way, or more
    /// where the picture takes more. One that leaves too little for bricks is not drawn.
    pub gpu_bytes: u64,
    /// What the pull may take; [`Limits::host_bytes`] is the ceiling for main memory.
    pub limits: Limits,
    /// Pictures being drawn at once: 2 keeps a GPU busy, 1 answers the hand faster.
    pub frames_in_flight: usize,
    /// Called when there is something new.
    pub wake: Wake,
    /// Channels that are seen at first; `None` leaves it to the volume.
    pub seen: Option<Vec<u32>>,
}

impl Default for SessionOptions {
    fn default() -> Self {
        Self {
            gpu_bytes: 512 << 20,
            limits: Limits::default(),
            frames_in_flight: 2,
            wake: Arc::new(|| ()),
            seen: None,
        }
    }
}

impl fmt::Debug for SessionOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            gpu_bytes,
            limits,
            frames_in_flight,
            wake: _,
            seen,
        } = self;
        f.debug_struct("SessionOptions")
            .field("gpu_bytes", gpu_bytes)
            .field("limits", limits)
            .field("frames_in_flight", frames_in_flight)
            .field("seen", seen)
            .finish_non_exhaustive()
    }
}

/// Why there is no session.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    /// The volume cannot be drawn.
    #[error("volume {name:?} cannot be drawn")]
    Renderer {
        /// Why.
        source: RendererError,
        /// The volume's name.
        name: String,
    },
    /// Its channels cannot be shown.
    #[error("the volume's channels cannot be shown")]
    Channels {
        /// Why.
        #[from]
        source: ChannelError,
    },
}

/// A volume being shown. Methods are called inside of a Tokio runtime's context natively.
pub struct Session {
    renderer: Renderer,
    pull: Pull,
    requests: Requests,
    clock: Clock,
    refresh: Refresh,
    channels: Vec<Channel>,
    /// How much detail each has, as far as bricks that arrived tell.
    contents: Vec<Content>,
    /// As the renderer has them.
    views: Vec<ChannelView>,
    frames_in_flight: usize,
    /// Ceiling for GPU memory, as the user set it \[bytes\].
    gpu_bytes: u64,
    /// Of that, what is kept for the picture \[bytes\].
    kept_bytes: u64,
    /// Why nothing is drawn, if that is why.
    too_large: Option<TooLarge>,
    retry: Retry,
    /// Bricks whose bounds the renderer was told since they last changed; for those that are hidden, the first frame
    /// that may know.
    told: HashMap<BrickId, Option<u64>>,
    /// Bounds of chunks that were looked up since they last changed.
    ranges: HashMap<ChunkId, Option<ValueRange>>,
    /// Bricks, and their chunks, whose bounds are being looked up.
    searched: (HashSet<BrickId>, Vec<ChunkId>),
    /// Bricks that changed while that was done: they wait no longer.
    lost: HashSet<BrickId>,
    /// Frames without a report.
    pending: VecDeque<Submitted>,
    drawn: u64,
    delivered: u64,
    drawn_view: Option<View>,
    /// Whether the picture would differ if drawn again.
    dirty: bool,
    report: Option<FrameReport>,
    revision: u64,
    frame_time: Option<Duration>,
    frame_size: UVec2,
    /// When that frame was known.
    known_at: Option<Duration>,
}

struct Submitted {
    frame: u64,
    at: Duration,
    size: UVec2,
}

impl Session {
    /// Starts listening to the source; nothing is drawn yet.
    ///
    /// # Errors
    ///
    /// [`SessionError`] when the volume or the ceiling does not suit the GPU.
    pub fn new(
        gpu: &Gpu,
        source: Arc<dyn VolumeSource>,
        options: SessionOptions,
    ) -> Result<Self, SessionError> {
        let volume = source.volume().clone();
        let kept_bytes = memory::kept_at_first(options.gpu_bytes);
        let renderer = memory::renderer(gpu, &volume, options.gpu_bytes, kept_bytes)?;
        let requests = Requests::new(source.clone(), options.wake);
        // Asked after listening began: no change is lost between the two.
        let revision = source.revision();
        let mut channels = channels::of_volume(&volume);
        if let Some(seen) = &options.seen {
            for (index, channel) in (0..).zip(&mut channels) {
                channel.visible = seen.contains(&index);
            }
        }
        let mut session = Self {
            renderer,
            retry: options.limits.retry,
            pull: Pull::new(volume, options.limits),
            requests,
            clock: Clock::start(),
            refresh: Refresh::new(),
            contents: vec![Content::default(); channels.len()],
            channels,
            views: Vec::new(),
            frames_in_flight: options.frames_in_flight.max(1),
            gpu_bytes: options.gpu_bytes,
            kept_bytes,
            too_large: None,
            told: HashMap::new(),
            ranges: HashMap::new(),
            searched: (HashSet::new(), Vec::new()),
            lost: HashSet::new(),
            pending: VecDeque::new(),
            drawn: 0,
            delivered: 0,
            drawn_view: None,
            dirty: true,
            report: None,
            revision,
            frame_time: None,
            frame_size: UVec2::ZERO,
            known_at: None,
        };
        session.put_channels()?;
        Ok(session)
    }

    /// Goes on with another device, as when [`Status::lost`] says that this one is gone.
    ///
    /// Made again is what was on the device, and what mirrors it: page tables, octree, bricks. Kept are
    /// the source and requests to it, chunks in main memory, channels and their histograms. So the picture comes
    /// back as fast as bricks can be sent, and nothing is read twice that main memory still holds.
    ///
    /// # Errors
    ///
    /// [`SessionError`] when the volume does not suit this device; the session stays as it was.
    pub fn set_gpu(&mut self, gpu: &Gpu) -> Result<(), SessionError> {
        let volume = self.renderer.volume();
        self.renderer = memory::renderer(gpu, volume, self.gpu_bytes, self.kept_bytes)?;
        self.begin_again()?;
        Ok(())
    }

    /// Nothing is on the device.
    fn begin_again(&mut self) -> Result<(), ChannelError> {
        self.pull.restart();
        self.told.clear();
        self.pending.clear();
        self.drawn = 0;
        self.drawn_view = None;
        self.dirty = true;
        self.report = None;
        self.known_at = None;
        self.views.clear();
        self.put_channels()
    }

    /// The volume shown.
    pub fn volume(&self) -> &Arc<Volume> {
        self.renderer.volume()
    }

    /// What draws: its output, its memory.
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }

    /// Takes what arrived, asks for what is missing, draws if the picture would change.
    pub fn frame(&mut self, view: &View) -> Status {
        let reports = self.renderer.poll();
        self.advance(view, reports, false)
    }

    /// [`Self::frame`] with the reports of frames that are finished. Unwatched, pictures
    /// that are not the last are mostly left out.
    pub(crate) fn advance(
        &mut self,
        view: &View,
        reports: Vec<FrameReport>,
        unwatched: bool,
    ) -> Status {
        let now = self.clock.now();
        self.make_room(view.size);
        self.take_events(now);
        for report in reports {
            self.take_report(report, now);
        }
        if self.refresh.starts(now) {
            let seen = self.views.iter().map(|view| view.channel);
            self.requests.sample(seen.collect(), self.retry);
        }
        self.requests.apply(self.pull.plan(now));
        let cut = self.deliver();
        // Delivered bricks make room for others' chunks.
        self.requests.apply(self.pull.plan(now));

        let draws_at = self.pace(view, unwatched).draws_at();
        let free = self.pending.len() < self.frames_in_flight;
        let drew = free && draws_at.is_some_and(|at| at <= now);
        if drew {
            self.draw(view, now);
        }
        self.dirty |= self.drawn_view != Some(*view);
        self.status(now, drew, cut, draws_at.filter(|_| !drew))
    }

    fn pace(&self, view: &View, unwatched: bool) -> Pace {
        let visible = view.size.min_element() > 0 && self.too_large.is_none();
        Pace {
            view_changed: visible && self.drawn_view != Some(*view),
            data_changed: visible && self.dirty,
            more_to_come: self.pull.has_more(),
            unwatched,
            last: self.known_at.zip(self.frame_time),
        }
    }

    /// Draws what is there, finished or not.
    #[cfg(not(target_family = "wasm"))]
    pub(crate) fn draw_now(&mut self, view: &View) {
        self.draw(view, self.clock.now());
    }

    fn draw(&mut self, view: &View, now: Duration) {
        self.drawn = self.renderer.render(view);
        self.drawn_view = Some(*view);
        self.pending.push_back(Submitted {
            frame: self.drawn,
            at: now,
            size: view.size,
        });
        self.dirty = false;
    }

    fn take_events(&mut self, now: Duration) {
        let mut changed = false;
        while let Some(event) = self.requests.next() {
            match event {
                Event::Answer { ticket, answer } => self.pull.answer(ticket, answer, now),
                Event::Change(change) => {
                    self.revision = self.revision.max(change.revision);
                    self.pull.change(change.voxels);
                    self.renderer.invalidate(change.voxels);
                    self.told.clear();
                    self.forget_ranges(change.voxels);
                    let whole = VoxelBox::of_size(self.volume().extent()).voxels();
                    let voxels = change.voxels.voxels();
                    let contents = self.contents.iter_mut();
                    contents.for_each(|content| content.change(voxels, whole));
                    changed = true;
                    self.refresh.changed();
                    self.dirty = true;
                }
                Event::Ranges { ranges, .. } => {
                    if self.ranges.len() > MOST_TOLD {
                        self.ranges.clear();
                    }
                    self.ranges.extend(ranges);
                    self.searched = (HashSet::new(), Vec::new());
                    changed = true;
                }
                Event::Sample { samples, .. } => self.take_samples(samples),
            }
        }
        if changed {
            self.want_missed();
        }
    }

    fn take_samples(&mut self, samples: Vec<(u32, Sample)>) {
        let volume = self.volume().clone();
        for (channel, sample) in samples {
            if sample.partial {
                self.refresh.changed();
            }
            if let Ok(of) = self.channel_mut(channel) {
                of.histogram = sample.histogram;
                if of.automatic {
                    of.follow_histogram(&volume, channel as usize);
                }
            }
        }
        if let Err(error) = self.put_channels() {
            log::error!("channels were refused: {error}");
        }
    }

    fn take_report(&mut self, report: FrameReport, now: Duration) {
        while let Some(known) = self.pending.pop_front_if(|f| f.frame <= report.frame) {
            self.frame_time = Some(now.saturating_sub(known.at));
            self.known_at = Some(now);
            self.frame_size = known.size;
        }
        self.dirty |= report.redraw;
        self.report = Some(report);
        self.want_missed();
    }

    /// Hands ready bricks to the renderer; whether there may be more.
    fn deliver(&mut self) -> bool {
        let (renderer, clock) = (&mut self.renderer, self.clock);
        let (channels, contents) = (&self.channels, &mut self.contents);
        let mut judged = Vec::new();
        let sink = |id: BrickId, voxels: BrickVoxels<'_>, freshness| {
            let channel = id.channel() as usize;
            // Whatever the detail is now: who chooses it by content later has no bricks that arrive then.
            if let BrickVoxels::Voxels(voxels) = voxels
                && contents[channel].wants(id)
            {
                contents[channel].note(renderer.volume(), id, voxels);
                if channels[channel].detail == Detail::ByContent {
                    judged.push(channel);
                }
            }
            let delivered = match freshness {
                Freshness::Current => renderer.deliver(id, voxels),
                Freshness::Outdated => renderer.deliver_outdated(id, voxels),
            };
            match delivered {
                Ok(Delivery::Resident | Delivery::Empty | Delivery::NoRoom) => {}
                Err(error) => log::error!("a brick was refused: {error}"),
            }
        };
        let delivery = self.pull.deliver(self.drawn + 1, || clock.now(), sink);
        self.dirty |= delivery.bricks > 0;
        self.delivered += delivery.bricks as u64;
        if !judged.is_empty() {
            for channel in judged {
                self.channels[channel].finest_needed = self.contents[channel].finest_needed();
            }
            if let Err(error) = self.put_channels() {
                log::error!("channels were refused: {error}");
            }
        }
        delivery.cut
    }

    /// Reports of all frames drawn so far, once they are drawn.
    #[cfg(not(target_family = "wasm"))]
    pub(crate) async fn finish(&mut self) -> Vec<FrameReport> {
        self.renderer.finish().await
    }

    /// Waits for something from the background.
    #[cfg(not(target_family = "wasm"))]
    pub(crate) async fn woken(&self) {
        self.requests.woken().await;
    }
}
