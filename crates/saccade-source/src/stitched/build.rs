//! Builds the sections of a block.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use futures::FutureExt;
use futures::future::{join_all, try_join, try_join_all};
use futures::stream::{self, StreamExt, TryStreamExt};
use glam::{DVec2, UVec2};
use saccade_core::levels::Level;
use saccade_core::volume::{Dtype, Volume, VoxelKind};
use saccade_core::voxel_box::VoxelBox;

use super::along_z::{AlongZ, Gaps, Reach, Reaches, Sections, between};
use super::block::{Block, BlockGrid, Failure, Slice};
use super::canvas::Canvas;
use super::coverage::{Candidate, Grid, Overlaps, Segment, Uncovered};
use super::error::StitchError;
use super::index::IndexedTile;
use super::resample::{Interpolation, Sample};
use super::sampling::{Layer, Layers, halvings};
use super::tiles::{Image, Tiles};
use super::{StitchedOptions, StitchedStatistics};
use crate::ValueRange;
use crate::processors::on_a_processor;

/// Sections of a block on which work is under way.
const SECTIONS_AT_ONCE: usize = 4;
/// Tiles of a section whose values are looked up for the bounds of a box, at most.
const MOST_BOUNDS: usize = 64;

pub(super) struct Builder {
    volume: Arc<Volume>,
    tiles: Arc<Tiles>,
    rules: Rules,
    try_again: Duration,
    blocks: AtomicU64,
    voxels: AtomicU64,
}

/// How it is stitched.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rules {
    pub(super) interpolation: Interpolation,
    pub(super) overlaps: Overlaps,
    along_z: AlongZ,
    gaps: Gaps,
    /// Whether they are labels, whose 0 is one of them.
    pub(super) labels: bool,
}

impl Rules {
    /// As asked for, but that labels are never mixed: the pixel, tile and section that lie nearest.
    fn new(options: &StitchedOptions, kind: VoxelKind) -> Self {
        let asked = Self {
            interpolation: options.interpolation.unwrap_or_default(),
            overlaps: options.overlaps,
            along_z: options.along_z,
            gaps: options.gaps,
            labels: kind.is_labels(),
        };
        if !asked.labels {
            return asked;
        }
        Self {
            interpolation: Interpolation::Nearest,
            overlaps: Overlaps::NearestCentre,
            along_z: AlongZ::Nearest,
            gaps: match asked.gaps {
                Gaps::Linear(most) => Gaps::Nearest(most),
                gaps => gaps,
            },
            labels: true,
        }
    }

    /// What was asked for and is not done, in words.
    pub(super) fn refused(options: &StitchedOptions, kind: VoxelKind) -> Vec<&'static str> {
        let rules = Self::new(options, kind);
        let asked = [
            (
                "interpolation",
                options
                    .interpolation
                    .is_some_and(|i| i != rules.interpolation),
            ),
            ("blending", options.overlaps != rules.overlaps),
            ("mixing along z", options.along_z != rules.along_z),
            ("mixing in gaps", options.gaps != rules.gaps),
        ];
        let refused = asked.into_iter().filter(|(_, differs)| *differs);
        refused.map(|(what, _)| what).collect()
    }
}

/// Voxels of one channel and level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub(super) channel: u32,
    pub(super) level: u32,
    pub(super) voxels: VoxelBox,
}

/// What a block will be made of: the sections that its voxels look at, and their tiles near it.
pub(super) struct Plan {
    /// Of each z.
    sections: Vec<Sections>,
    near: BTreeMap<u32, Vec<Arc<IndexedTile>>>,
}

/// What one tile gives to a section of a block.
pub(super) struct Part {
    pub(super) candidate: Candidate,
    pub(super) segments: Vec<Segment>,
}

impl Builder {
    pub(super) fn new(volume: Arc<Volume>, tiles: Tiles, options: &StitchedOptions) -> Self {
        let rules = Rules::new(options, volume.kind);
        Self {
            volume,
            tiles: Arc::new(tiles),
            rules,
            try_again: options.try_again,
            blocks: AtomicU64::new(0),
            voxels: AtomicU64::new(0),
        }
    }

    pub(super) fn tiles(&self) -> &Tiles {
        &self.tiles
    }

    pub(super) fn statistics(&self) -> StitchedStatistics {
        let index = self.tiles.index();
        StitchedStatistics {
            blocks_built: self.blocks.load(Ordering::Relaxed),
            voxels_built: self.voxels.load(Ordering::Relaxed),
            pyramids_opened: self.tiles.opened(),
            sub_tiles_decoded: self.tiles.decoded(),
            thumbnails_from_disk: self.tiles.thumbnails_from_disk(),
            thumbnail_bytes: self.tiles.thumbnail_bytes(),
            tiles_indexed: index.tiles(),
            section_bytes: index.bytes(),
            ..StitchedStatistics::default()
        }
    }

    /// Whether voxels touch a section that has a tile of their channel, or one that shows such.
    pub(super) fn may_have_data(&self, place: Place) -> bool {
        let level0 = self.level(place).voxels_from_box(place.voxels);
        let reach = self.rules.gaps.longest();
        let first = level0.min.z.saturating_sub(reach);
        let end = level0.max.z.saturating_add(reach);
        self.tiles.index().any_acquired(place.channel, first..end)
    }

    /// What says where changes are seen.
    pub(super) fn reaches(&self) -> Reaches<'_> {
        Reaches {
            along_z: self.rules.along_z,
            gaps: self.rules.gaps,
            levels: &self.volume.levels,
        }
    }

    /// The level-0 voxels that may be others when those of a box of one section are.
    pub(super) fn touched(&self, mut voxels: VoxelBox, reach: &Reach) -> VoxelBox {
        let extent = self.volume.extent();
        voxels.min.z = reach.sections.start;
        voxels.max.z = reach.sections.end.min(extent.z);
        if reach.everywhere {
            voxels.min = voxels.min.with_x(0).with_y(0);
            voxels.max = voxels.max.with_x(extent.x).with_y(extent.y);
        }
        voxels
    }

    /// Makes a plan: it and the tiles' pyramids, which never change, say what the block will be.
    pub(super) async fn plan(&self, place: Place) -> Result<Plan, StitchError> {
        let (min, max) = Grid::of_level(self.level(place), place.voxels).bounds();
        let z = place.voxels.min.z..place.voxels.max.z;
        let sections: Vec<Sections> = z.map(|z| self.sections(place, z, None)).collect();
        let mut near = BTreeMap::new();
        for section in sections.iter().flat_map(Sections::all) {
            if let Entry::Vacant(vacant) = near.entry(section) {
                vacant.insert(self.near(section, place.channel, (min, max), None).await?);
            }
        }
        Ok(Plan { sections, near })
    }

    /// All that a block depends on, in words.
    pub(super) fn description(&self, place: Place, plan: &Plan) -> String {
        let (volume, rules) = (&self.volume, self.rules);
        let (sections, near) = (&plan.sections, &plan.near);
        format!("block 4 {volume:?} {rules:?} {place:?} {sections:?} {near:?}")
    }

    /// Builds a block, as planned if it was.
    pub(super) async fn block(
        &self,
        grid: &BlockGrid,
        place: Place,
        plan: Option<&Plan>,
    ) -> Result<Block, StitchError> {
        match self.volume.dtype {
            Dtype::Uint16 => self.block_of::<u16>(grid, place, plan).await,
            _ => self.block_of::<u8>(grid, place, plan).await,
        }
    }

    async fn block_of<S: Sample>(
        &self,
        grid: &BlockGrid,
        place: Place,
        plan: Option<&Plan>,
    ) -> Result<Block, StitchError> {
        let voxels = place.voxels;
        let slices = (voxels.min.z..voxels.max.z).map(|z| self.slice::<S>(place, z, plan));
        let slices = stream::iter(slices).buffered(SECTIONS_AT_ONCE);
        let slices: Vec<_> = slices.try_collect().await?;
        self.blocks.fetch_add(1, Ordering::Relaxed);
        self.voxels.fetch_add(voxels.voxels(), Ordering::Relaxed);
        let (chunk, try_again) = (grid.chunk(), self.try_again);
        let block = on_a_processor(move || Block::cut(voxels, chunk, &slices, try_again)).await;
        Ok(block)
    }

    fn level(&self, place: Place) -> Level {
        self.volume.levels[place.level as usize]
    }

    fn sections(&self, place: Place, z: u32, plan: Option<&Plan>) -> Sections {
        let number = (z - place.voxels.min.z) as usize;
        if let Some(sections) = plan.and_then(|plan| plan.sections.get(number)) {
            return sections.clone();
        }
        let rules = (self.rules.along_z, self.rules.gaps);
        Sections::of(
            self.tiles.index(),
            rules,
            (place.channel, self.level(place)),
            z,
        )
    }

    /// Bounds of the values in a box: of the sub-tiles below it, none of which is read. `None` where
    /// nothing is.
    pub(super) async fn range(&self, place: Place) -> Result<Option<ValueRange>, StitchError> {
        let z = place.voxels.min.z..place.voxels.max.z;
        let slices = z.map(|z| self.range_of_slice(place, z));
        let ranges = stream::iter(slices).buffered(SECTIONS_AT_ONCE);
        let ranges: Vec<_> = ranges.try_collect().await?;
        let range = ranges.into_iter().flatten().reduce(union);
        let largest = match self.volume.dtype {
            Dtype::Uint16 => u16::MAX,
            _ => u16::from(u8::MAX),
        };
        // What is measured is at least 1.
        Ok(range.map(|(least, most)| ValueRange {
            min: least.clamp(1, largest),
            max: most.clamp(1, largest),
        }))
    }

    async fn range_of_slice(
        &self,
        place: Place,
        z: u32,
    ) -> Result<Option<(u16, u16)>, StitchError> {
        match self.sections(place, z, None) {
            Sections::FirstOf(sections) => self.range_of(place, &sections).await,
            Sections::Between(below, above, _) => {
                let below = self.range_of(place, &below).await?;
                let above = self.range_of(place, &above).await?;
                Ok(below.into_iter().chain(above).reduce(union))
            }
        }
    }

    async fn range_of(
        &self,
        place: Place,
        sections: &[u32],
    ) -> Result<Option<(u16, u16)>, StitchError> {
        let whole = Grid::of_level(self.level(place), place.voxels);
        // Which voxels are sampled how finely is not asked: each kind is taken for all.
        let (mut needed, mut done) = (BTreeSet::new(), BTreeSet::new());
        for &section in sections {
            let near = self.near(section, place.channel, whole.bounds(), None);
            needed.extend(near.await?.iter().map(|tile| halvings(tile, whole.step)));
            if !needed.is_empty() {
                break;
            }
        }
        let mut range = None;
        while let Some(&next) = needed.difference(&done).next() {
            let grid = whole.finer(1 << next);
            let (seen, also) = self.range_on(place, sections, (whole, grid)).await?;
            range = range.into_iter().chain(seen).reduce(union);
            needed.extend(also);
            done.insert(next);
        }
        Ok(range)
    }

    /// The same of voxels that are sampled alike, on a grid; and how finely the tiles that it looked at
    /// need them to be.
    async fn range_on(
        &self,
        place: Place,
        sections: &[u32],
        (whole, grid): (Grid, Grid),
    ) -> Result<(Option<(u16, u16)>, BTreeSet<u32>), StitchError> {
        let mut range = None;
        let mut needed = BTreeSet::new();
        for &section in sections {
            let near = self.near(section, place.channel, whole.bounds(), None);
            let near = near.await?;
            if near.is_empty() {
                continue;
            }
            // To open so many costs more than it saves to know what they show.
            if near.len() > MOST_BOUNDS {
                return Ok((Some((1, u16::MAX)), needed));
            }
            needed.extend(near.iter().map(|tile| halvings(tile, whole.step)));
            let opened = near.into_iter().map(async |tile| {
                let level = grid.level_of(&tile);
                let image = self.tiles.bounds(&tile, level).await?;
                Ok(Candidate::new(tile, image, level, self.rules.labels))
            });
            let candidates = try_join_all(opened).await?.into_iter();
            let ranges = candidates.map(|candidate| {
                let (seen, covers) = candidate.range(&grid, self.rules.interpolation);
                (candidate, seen, covers)
            });
            let ranges: Vec<_> = ranges.collect();
            for (candidate, seen, _) in &ranges {
                // A finer tile that covers all hides it.
                let hides = |(other, _, covers): &(Candidate, _, bool)| {
                    *covers && !candidate.is_fine_beside(other)
                };
                if !ranges.iter().any(hides) {
                    range = range.into_iter().chain(*seen).reduce(union);
                }
            }
            // Other sections are hidden.
            if ranges.iter().any(|(_, _, covers)| *covers) {
                break;
            }
        }
        Ok((range, needed))
    }

    /// The tiles of a section whose bounds touch a rectangle \[level-0 voxels\].
    async fn near(
        &self,
        section: u32,
        channel: u32,
        (min, max): (DVec2, DVec2),
        plan: Option<&Plan>,
    ) -> Result<Vec<Arc<IndexedTile>>, StitchError> {
        if let Some(near) = plan.and_then(|plan| plan.near.get(&section)) {
            return Ok(near.clone());
        }
        let index = self.tiles.index().section(section).await;
        let damaged = self.tiles.damaged();
        let index = index.map_err(|source| damaged.note_section(section, source))?;
        damaged.clear_section(section);
        Ok(index.near(channel, min, max))
    }

    /// Stitches one z of some voxels, without those around it, to little-endian values.
    pub(super) async fn cross_section(
        &self,
        place: Place,
    ) -> Result<Option<Vec<u8>>, Arc<StitchError>> {
        match self.volume.dtype {
            Dtype::Uint16 => self.cross_section_of::<u16>(place).await,
            _ => self.cross_section_of::<u8>(place).await,
        }
    }

    async fn cross_section_of<S: Sample>(
        &self,
        place: Place,
    ) -> Result<Option<Vec<u8>>, Arc<StitchError>> {
        let slice = self.slice::<S>(place, place.voxels.min.z, None).await;
        let slice = slice.map_err(Arc::new)?;
        match slice.failures.first() {
            Some(failure) => Err(failure.error()),
            None => Ok(slice.values.map(|values| {
                let mut bytes = vec![0; values.len() * S::DTYPE.bytes()];
                S::write(&values, &mut bytes);
                bytes
            })),
        }
    }

    /// Stitches one z of a block.
    async fn slice<S: Sample>(
        &self,
        place: Place,
        z: u32,
        plan: Option<&Plan>,
    ) -> Result<Slice<S>, StitchError> {
        let (below, above, part) = match self.sections(place, z, plan) {
            Sections::FirstOf(sections) => return self.first_of(place, sections, plan).await,
            Sections::Between(below, above, part) => (below, above, part),
        };
        let below = self.first_of::<S>(place, below, plan);
        let above = self.first_of::<S>(place, above, plan);
        let (mut below, above) = try_join(below, above).await?;
        let mixed = on_a_processor(move || {
            below.values = match (below.values, above.values) {
                (Some(mut below), Some(above)) => {
                    between(&mut below, &above, part);
                    Some(below)
                }
                (below, above) => below.or(above),
            };
            below.failures.extend(above.failures);
            below
        });
        Ok(mixed.await)
    }

    /// Stitches a plane of voxels, each from the first of these sections that has a tile there.
    async fn first_of<S: Sample>(
        &self,
        place: Place,
        sections: Vec<u32>,
        plan: Option<&Plan>,
    ) -> Result<Slice<S>, StitchError> {
        let (voxels, level, rules) = (place.voxels, self.level(place), self.rules);
        let size = voxels.size().truncate();
        let mut parts = Vec::new();
        let mut failures = Vec::new();
        let whole = Grid::of_level(level, voxels);
        let mut layers = Layers::new(whole);
        for section in sections {
            let near = self.near(section, place.channel, whole.bounds(), plan);
            let near = near.await?;
            if near.is_empty() {
                continue;
            }
            let looked_at = on_a_processor(move || {
                layers.look_at(&near);
                (layers, near)
            });
            let near;
            (layers, near) = looked_at.await;
            for halvings in layers.halvings() {
                let Some(layer) = layers.take(halvings) else {
                    continue;
                };
                let near = near.clone();
                let (grid, by) = (layer.grid, layer.by);
                // Coarse levels span many sections, of which the first hides nearly all: only what
                // may still be seen is opened.
                let seen = on_a_processor(move || {
                    let touches = |tile: &Arc<_>| layer.uncovered.touches(&grid, tile);
                    (near.into_iter().filter(touches).collect(), layer.uncovered)
                });
                let (near, uncovered): (Vec<_>, Uncovered) = seen.await;
                let opened = near.iter().map(|tile| {
                    let of_pyramid = grid.level_of(tile);
                    let image = self.tiles.image(tile, of_pyramid);
                    image.map(move |image| (of_pyramid, image))
                });
                let opened = join_all(opened).await;
                let mut candidates = Vec::new();
                for (tile, (of_pyramid, image)) in near.into_iter().zip(opened) {
                    match image {
                        Ok(image) => {
                            candidates.push(Candidate::new(tile, image, of_pyramid, rules.labels));
                        }
                        Err(error) => {
                            let damaged = self.tiles.damaged();
                            let thumbnail = tile.coarsest_level();
                            let error = match of_pyramid >= thumbnail {
                                true => {
                                    damaged.note_sub_tiles(&tile, thumbnail, &[UVec2::ZERO], error)
                                }
                                false => damaged.note(&tile, error),
                            };
                            failures.push(Failure::bounds(error, &tile, level, voxels));
                        }
                    }
                }
                let covered =
                    on_a_processor(move || cover(&grid, rules.overlaps, uncovered, candidates));
                let (uncovered, new_parts) = covered.await;
                parts.extend(new_parts.into_iter().map(|part| (grid, part)));
                layers.put(
                    halvings,
                    Layer {
                        grid,
                        by,
                        uncovered,
                    },
                );
            }
            if layers.all_covered() {
                break;
            }
        }
        if parts.is_empty() {
            return Ok(Slice {
                values: None,
                failures,
            });
        }
        let fetched = parts.into_iter().map(async |(grid, part): (Grid, Part)| {
            let (candidate, interpolation) = (&part.candidate, rules.interpolation);
            let wanted = candidate.sub_tiles(&grid, &part.segments, interpolation);
            let fetched = match &candidate.image {
                Image::Thumbnail(thumbnail) => Ok(thumbnail.fetched(&wanted, rules.labels)),
                Image::Pyramid(pyramid) => {
                    let section = candidate.tile.section;
                    { self.tiles.fetch(pyramid, section, candidate.level, wanted) }.await
                }
            };
            (grid, part, fetched)
        });
        let fetched = join_all(fetched).await;
        let tiles = self.tiles.clone();
        let sampled = on_a_processor(move || {
            let mut canvases: BTreeMap<u32, Canvas<S>> = BTreeMap::new();
            for (grid, part, fetched) in fetched {
                let by = grid.size.x / size.x;
                let canvas = canvases.entry(by);
                let canvas = canvas.or_insert_with(|| Canvas::new(grid, by, rules));
                let drawn = fetched.and_then(|fetched| canvas.draw(&tiles, &part, fetched));
                let (candidate, tile) = (&part.candidate, &part.candidate.tile);
                let looked_at = || match &candidate.image {
                    Image::Thumbnail(_) => (tile.coarsest_level(), vec![UVec2::ZERO]),
                    Image::Pyramid(_) => {
                        let wanted =
                            candidate.sub_tiles(&grid, &part.segments, rules.interpolation);
                        (candidate.level, wanted)
                    }
                };
                match drawn {
                    Ok(()) => tiles.damaged().clear(tile, looked_at),
                    Err(error) => {
                        let (level, wanted) = looked_at();
                        let error = tiles.damaged().note_sub_tiles(tile, level, &wanted, error);
                        failures.push(Failure::segments(error, &part.segments, by));
                    }
                }
            }
            // Each has values where the others have none.
            let finished = canvases.into_values().map(Canvas::finish);
            let values = finished.reduce(|mut values, others| {
                for (value, other) in values.iter_mut().zip(others) {
                    if *value == S::default() {
                        *value = other;
                    }
                }
                values
            });
            Slice { values, failures }
        });
        Ok(sampled.await)
    }
}

/// Bounds of both.
fn union(a: (u16, u16), b: (u16, u16)) -> (u16, u16) {
    (a.0.min(b.0), a.1.max(b.1))
}

fn cover(
    grid: &Grid,
    overlaps: Overlaps,
    mut uncovered: Uncovered,
    mut candidates: Vec<Candidate>,
) -> (Uncovered, Vec<Part>) {
    // Sums of blended ones are rounded alike, whatever order the index has them in.
    candidates.sort_unstable_by_key(|candidate| candidate.tile.age());
    let segments = uncovered.cover(grid, overlaps, &candidates);
    let parts = candidates.into_iter().zip(segments);
    let parts = parts.filter(|(_, segments)| !segments.is_empty());
    let parts = parts.map(|(candidate, segments)| Part {
        candidate,
        segments,
    });
    (uncovered, parts.collect())
}
