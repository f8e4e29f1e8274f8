//! A source, a renderer and the pull between them.

mod memory;

use std::collections::{HashMap, HashSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use glam::UVec2;
use saccade_core::brick::BrickId;
use saccade_core::transfer::TransferFunction;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{
    BrickVoxels, ChannelError, ChannelView, Delivery, Fidelity, FrameReport, Gpu, MemoryUse,
    Renderer, RendererError, Statistics, View,
};
use saccade_source::{ChunkId, ValueRange, VolumeSource};

use crate::brick::{chunks_of, range_of};
use crate::channels::{self, Channel};
use crate::clock::Clock;
use crate::detail::{Content, Detail};
use crate::histogram::Sample;
use crate::host_cache::is_touched;
use crate::policy::{Limits, Pace, Refresh, Retry};
use crate::pull::{Freshness, Progress, Pull};
use crate::requests::{Event, Requests};
pub use memory::TooLarge;

/// Bricks whose bounds were told, kept in mind; beyond, all are forgotten and told again.
const MOST_TOLD: usize = 1 << 16;

/// Chunks whose bounds are looked up together.
const RANGES_TOGETHER: usize = 128;

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
}

impl Default for SessionOptions {
    fn default() -> Self {
        Self {
            gpu_bytes: 512 << 20,
            limits: Limits::default(),
            frames_in_flight: 2,
            wake: Arc::new(|| ()),
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
        } = self;
        f.debug_struct("SessionOptions")
            .field("gpu_bytes", gpu_bytes)
            .field("limits", limits)
            .field("frames_in_flight", frames_in_flight)
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

/// When to call [`Session::frame`] again, if nobody wakes the caller before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Again {
    /// With the next frame of the display.
    Now,
    /// After this time.
    After(Duration),
    /// Only when woken, or when the view changes.
    WhenWoken,
}

/// How the picture and the pull are.
#[derive(Clone, Debug, PartialEq)]
pub struct Status {
    /// Frames drawn so far.
    pub frame: u64,
    /// Whether this call drew one.
    pub drew: bool,
    /// Whether the last frame drawn is known to hold everything it wanted, up to date.
    pub complete: bool,
    /// Whether nothing will change by itself: no data on the way, no frame being drawn. An
    /// incomplete picture that is settled misses bricks that failed for good.
    pub settled: bool,
    /// Of the newest frame known about.
    pub fidelity: Fidelity,
    /// Level-of-detail bias in force in it.
    pub lod_bias: f32,
    /// The part of it that lack of GPU memory added.
    pub memory_bias: f32,
    /// Work of the newest frame known about.
    pub statistics: Statistics,
    /// GPU memory.
    pub memory: MemoryUse,
    /// Memory that chunks take \[bytes\].
    pub host_bytes: u64,
    /// Requests and failures.
    pub progress: Progress,
    /// Bricks handed to the renderer so far.
    pub delivered: u64,
    /// The volume's revision after the newest change seen: the picture is to show it.
    pub revision: u64,
    /// From submission of the newest frame known about until it was known.
    pub frame_time: Option<Duration>,
    /// Size of that frame \[pixels\].
    pub frame_size: UVec2,
    /// Whether the GPU is gone: [`Session::set_gpu`] goes on with another.
    pub lost: bool,
    /// When to call again.
    pub again: Again,
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

/// How long until it is worth looking whether the GPU has finished a frame, when the last one took
/// `frame_time`.
fn poll_after(frame_time: Option<Duration>) -> Duration {
    let quarter = frame_time.unwrap_or_default() / 4;
    quarter.clamp(Duration::from_millis(4), Duration::from_millis(50))
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
        let channels = channels::of_volume(&volume);
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

    /// How each channel of the volume is shown.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Shows or hides a channel.
    ///
    /// # Errors
    ///
    /// [`ChannelError`] for a channel that the volume does not have, and when too many would be seen.
    pub fn set_visible(&mut self, channel: u32, visible: bool) -> Result<(), ChannelError> {
        let before = self.channel_mut(channel)?.visible;
        self.channel_mut(channel)?.visible = visible;
        if let Err(error) = self.put_channels() {
            self.channel_mut(channel)?.visible = before;
            return Err(error);
        }
        if visible && !before {
            // Nobody may have counted its values.
            self.refresh.changed();
        }
        self.is_awaited();
        Ok(())
    }

    /// Sets a channel's colours and opacities; they no longer follow the histogram.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_transfer_function(
        &mut self,
        channel: u32,
        transfer: TransferFunction,
    ) -> Result<(), ChannelError> {
        let of = self.channel_mut(channel)?;
        (of.transfer, of.automatic) = (transfer, false);
        self.put_channels()?;
        self.is_awaited();
        Ok(())
    }

    /// Sets the value of a channel's surface, `[0, 1]`, for where surfaces are drawn; `None` lets it follow the
    /// opacities.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_iso(&mut self, channel: u32, iso: Option<f32>) -> Result<(), ChannelError> {
        self.channel_mut(channel)?.iso = iso;
        self.put_channels()?;
        self.is_awaited();
        Ok(())
    }

    /// Sets how finely a channel is drawn.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_detail(&mut self, channel: u32, detail: Detail) -> Result<(), ChannelError> {
        let of = self.channel_mut(channel)?;
        let by_content = detail == Detail::ByContent;
        (of.detail, of.finest_needed) = (detail, 0);
        if by_content {
            let needed = self.contents[channel as usize].finest_needed();
            self.channel_mut(channel)?.finest_needed = needed;
        }
        self.put_channels()?;
        self.is_awaited();
        Ok(())
    }

    /// Lets a channel's colours and opacities follow the histogram, as they do at first.
    ///
    /// # Errors
    ///
    /// [`ChannelError::NoSuchChannel`].
    pub fn set_automatic_transfer_function(&mut self, channel: u32) -> Result<(), ChannelError> {
        let volume = self.volume().clone();
        let of = self.channel_mut(channel)?;
        of.follow_histogram(&volume, channel as usize);
        self.put_channels()
    }

    fn channel_mut(&mut self, channel: u32) -> Result<&mut Channel, ChannelError> {
        let channels = u32::try_from(self.channels.len()).unwrap_or(u32::MAX);
        let of = self.channels.get_mut(channel as usize);
        of.ok_or(ChannelError::NoSuchChannel { channel, channels })
    }

    /// Somebody waits for the picture, as for another view.
    fn is_awaited(&mut self) {
        self.drawn_view = None;
    }

    /// Tells the renderer how channels are shown, if that changed.
    fn put_channels(&mut self) -> Result<(), ChannelError> {
        let views = channels::views(&self.channels);
        if self.views != views {
            self.renderer.set_channels(&views)?;
            self.views = views;
            // What was hidden may be seen, and the renderer may have forgotten what it knew.
            self.told.clear();
            self.dirty = true;
        }
        Ok(())
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

    /// Forgets the bounds of what changed. What changes again and again is not waited for.
    fn forget_ranges(&mut self, voxels: VoxelBox) {
        let volume = self.renderer.volume();
        let touched = |chunk: &ChunkId| is_touched(*chunk, volume, voxels);
        self.ranges.retain(|chunk, _| !touched(chunk));
        if self.searched.1.iter().any(touched) {
            if self.lost.len() > MOST_TOLD {
                self.lost.clear();
            }
            let (bricks, _) = std::mem::take(&mut self.searched);
            self.lost.extend(bricks);
            self.requests.drop_ranges();
        }
    }

    /// Wants what the newest report misses, but for what is hidden, or may be as far as is known.
    fn want_missed(&mut self) {
        let Some(report) = &self.report else {
            return;
        };
        let (frame, misses) = (report.frame, report.misses.clone());
        // What a frame does not know yet it misses.
        let knows = report.octree_is_current.then_some(frame);
        let (hidden, unknown) = self.hidden(&misses, knows);
        let seen = misses.into_iter();
        let seen = seen.filter(|id| !hidden.contains(id) && !unknown.contains(id));
        self.pull.want(frame, &seen.collect::<Vec<_>>());
        // Without what is hidden, the next frame may be complete.
        self.dirty |= !hidden.is_empty();
    }

    /// Of the bricks missed, those that the source knows to hold nothing that can be seen, and those of
    /// which that is being looked up. The renderer is told of the former, once: a brick that is missed
    /// again, by a frame that knows, is needed.
    fn hidden(
        &mut self,
        misses: &[BrickId],
        knows: Option<u64>,
    ) -> (HashSet<BrickId>, HashSet<BrickId>) {
        if self.told.len() > MOST_TOLD {
            self.told.clear();
        }
        let volume = self.renderer.volume().clone();
        let (mut hidden, mut unknown) = (HashSet::new(), HashSet::new());
        let (mut bricks, mut chunks) = (HashSet::new(), Vec::new());
        let mut seen = HashSet::new();
        for &id in misses {
            if let Some(told) = self.told.get(&id) {
                if told.is_some_and(|first| knows.is_none_or(|frame| frame < first)) {
                    hidden.insert(id);
                }
                continue;
            }
            let (ranges, requests) = (&self.ranges, &self.requests);
            let known = |chunk| {
                let at_hand = || requests.value_range(chunk).map(Some);
                ranges.get(&chunk).copied().or_else(at_hand)
            };
            let range = range_of(id, &volume, known);
            let lost = self.lost.contains(&id);
            if range.is_none() && !lost && self.renderer.may_hide(id.channel()) {
                if chunks.len() < RANGES_TOGETHER {
                    let new = chunks_of(id, &volume).filter(|chunk| known(*chunk).is_none());
                    chunks.extend(new.filter(|chunk| seen.insert(*chunk)));
                    bricks.insert(id);
                }
                unknown.insert(id);
                continue;
            }
            let hides = range
                .flatten()
                .is_some_and(|range| self.renderer.note_range(id, [range.min, range.max]));
            if hides {
                hidden.insert(id);
            }
            self.told.insert(id, hides.then_some(self.drawn + 1));
        }
        if !chunks.is_empty() && !self.requests.is_finding() {
            self.requests.find_ranges(chunks.clone());
            self.searched = (bricks, chunks);
        }
        (hidden, unknown)
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
                && contents[channel].wants(id.level())
            {
                contents[channel].note(renderer.volume(), id.level(), voxels);
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

    fn status(&self, now: Duration, drew: bool, cut: bool, draws_at: Option<Duration>) -> Status {
        let mut progress = self.pull.progress();
        if let Some(too_large) = self.too_large {
            progress.failure = Some(too_large.to_string());
        }
        let report = self.report.as_ref();
        let known = self.pending.is_empty() && !self.dirty;
        let searching = self.requests.is_sampling() || self.requests.is_finding();
        let idle = progress.wanted == 0 && !searching;
        // While frames are being drawn, their end is awaited before the next.
        let draws_at = draws_at.filter(|_| self.pending.is_empty());
        let due = [progress.retry_at, self.refresh.due(), draws_at];
        let due = due
            .into_iter()
            .flatten()
            .min()
            .map(|at| at.saturating_sub(now));
        let poll = (!self.pending.is_empty()).then(|| poll_after(self.frame_time));
        let next = due.into_iter().chain(poll).min();
        let again = match next {
            _ if cut => Again::Now,
            Some(Duration::ZERO) => Again::Now,
            Some(time) => Again::After(time),
            None => Again::WhenWoken,
        };
        Status {
            frame: self.drawn,
            drew,
            complete: known && report.is_some_and(FrameReport::is_complete),
            settled: (known && idle && self.refresh.due().is_none()) || self.too_large.is_some(),
            fidelity: report.map(|r| r.fidelity).unwrap_or_default(),
            lod_bias: report.map_or(0.0, |r| r.lod_bias),
            memory_bias: report.map_or(0.0, |r| r.memory_bias),
            statistics: report.map(|r| r.statistics).unwrap_or_default(),
            memory: self.renderer.memory(),
            host_bytes: self.pull.host_bytes(),
            progress,
            delivered: self.delivered,
            revision: self.revision,
            frame_time: self.frame_time,
            frame_size: self.frame_size,
            lost: self.renderer.gpu().is_lost(),
            again,
        }
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
