//! Where every tile lies, in truth and as the stage believes. Pure.
//!
//! Each tile owns a cell of a regular grid, smaller than the tile by the overlap. Half of the
//! overlap on each side is the slack that rotation and shift may use up, in that order: whatever
//! the numbers drawn, the turned and shifted tile still covers its cell, and the cells cover the
//! section. Coverage is thus a property of the construction, not of luck.

use std::f64::consts::TAU;

use glam::{DVec2, UVec2, UVec3};
use saccade_archive::acquisition::AcquisitionInfo;
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{MAX_EXTENT, check_name};

use super::stack::StackInfo;
use super::{SimulateConfig, SimulateError};

/// No tile is turned further \[degrees\]: what real microscopes keep to \[000 §7\].
const MOST_ROTATION_DEG: f64 = 5.0;
/// Share of the slack that rotations may use up.
const ROTATION_SHARE: f64 = 0.7;

/// One tile to acquire.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedTile {
    /// Name, unique in the volume.
    pub name: String,
    /// Section: z index.
    pub section: u32,
    /// Column and row in its section's grid.
    pub cell: UVec2,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where it really lies.
    pub truth: SectionFromTile,
    /// Where the stage believes it lies.
    pub stage: SectionFromTile,
}

/// All tiles of an acquisition, computed when asked for.
#[derive(Clone, Debug)]
pub struct Plan {
    config: SimulateConfig,
    info: AcquisitionInfo,
    grid: UVec2,
    /// Size of a grid cell \[voxels\].
    step: DVec2,
    /// How far tile borders may move inwards without uncovering the cell \[pixels\].
    slack: DVec2,
}

impl Plan {
    /// The plan for a stack.
    ///
    /// # Errors
    ///
    /// [`SimulateError::Setting`], [`SimulateError::Name`].
    pub fn new(config: &SimulateConfig, stack: &StackInfo) -> Result<Self, SimulateError> {
        let wrong = |setting, value: &dyn std::fmt::Display, must| {
            Err(SimulateError::Setting {
                setting,
                value: value.to_string(),
                must,
            })
        };
        let not_negative = |value: f64| value.is_finite() && value >= 0.0;
        if config.tile.min_element() < 32 || config.tile.max_element() > 1 << 16 {
            return wrong(
                "the tile size",
                &config.tile,
                "32 to 65536 pixels along each axis",
            );
        }
        if !(0.02..=0.5).contains(&config.overlap) {
            return wrong("the overlap", &config.overlap, "between 0.02 and 0.5");
        }
        for (setting, value) in [
            ("the jitter", config.jitter_px),
            ("the rotation", config.rotation_deg),
            ("the stage error", config.stage_error_px),
        ] {
            if !not_negative(value) {
                return wrong(setting, &value, "0 or more");
            }
        }
        let voxel_nm = config
            .voxel_nm
            .unwrap_or_else(|| stack.voxel_nm_or_assumed());
        super::check_rate_and_voxel(config.rate_mpixel_s, voxel_nm)?;
        let name = config.name.clone().unwrap_or_else(|| stack.name.clone());
        check_name(&name)?;
        if stack.extent.max_element() > MAX_EXTENT {
            let must = "at most 2,097,152 voxels along each axis";
            return wrong("the extent", &stack.extent, must);
        }
        let size = config.tile.as_dvec2();
        let overlap = size * config.overlap;
        // A pixel stays in reserve on each side, so that rounding never uncovers a voxel.
        let (step, slack) = (size - overlap, (0.5 * overlap - 1.0).max(DVec2::ZERO));
        let grid = (stack.extent.truncate().as_dvec2() / step)
            .ceil()
            .as_uvec2()
            .max(UVec2::ONE);
        Ok(Self {
            config: config.clone(),
            info: AcquisitionInfo::new(&name, stack.extent, voxel_nm),
            grid,
            step,
            slack,
        })
    }

    /// What `volume.json` will say.
    pub fn info(&self) -> &AcquisitionInfo {
        &self.info
    }

    /// Columns and rows of tiles in each section.
    pub fn grid(&self) -> UVec2 {
        self.grid
    }

    /// Tiles of the whole acquisition.
    pub fn tile_count(&self) -> u64 {
        u64::from(self.grid.x) * u64::from(self.grid.y) * u64::from(self.info.extent.z)
    }

    /// Sections in the order in which they are acquired.
    pub fn sections(&self) -> Vec<u32> {
        let mut sections: Vec<u32> = (0..self.info.extent.z).collect();
        if self.config.shuffle {
            let order =
                |z: &u32| Random::new(self.config.seed ^ 0x5ec7, UVec3::new(*z, 0, 0)).bits();
            sections.sort_by_cached_key(|z| (order(z), *z));
        }
        sections
    }

    /// Tiles of a section, in the order in which they are acquired: row by row.
    pub fn tiles(&self, section: u32) -> Vec<PlannedTile> {
        let rows = (0..self.grid.y).flat_map(|y| (0..self.grid.x).map(move |x| UVec2::new(x, y)));
        rows.map(|cell| self.tile(section, cell)).collect()
    }

    fn tile(&self, section: u32, cell: UVec2) -> PlannedTile {
        let mut random = Random::new(self.config.seed, cell.extend(section));
        let size = self.config.tile;
        let half = size.as_dvec2() / 2.0;

        let most = MOST_ROTATION_DEG.to_radians().min(self.most_rotation());
        let radians = random.normal() * self.config.rotation_deg.to_radians();
        let radians = radians.clamp(-most, most);
        let left = (self.slack - inset(half, radians.abs())).max(DVec2::ZERO);

        // Where the overlap is narrow the spread shrinks, so that not every shift ends at the limit.
        let spread = DVec2::splat(self.config.jitter_px).min(self.slack * 0.4);
        let shift = DVec2::new(random.normal(), random.normal()) * spread;
        let shift = shift.clamp(-left, left);

        // The grid lies in the middle of the section; its border tiles reach over the edges.
        let low = 0.5 * (self.info.extent.truncate().as_dvec2() - self.step * self.grid.as_dvec2());
        let centre = low + (cell.as_dvec2() + 0.5) * self.step + shift;
        let truth = SectionFromTile::rotated(size.as_dvec2(), radians, centre - half);

        let error = DVec2::new(random.normal(), random.normal())
            .clamp(DVec2::splat(-3.0), DVec2::splat(3.0));
        let stage = truth.shifted(error * self.config.stage_error_px);
        let name = format!("s{section:05}_r{:03}_c{:03}", cell.y, cell.x);
        PlannedTile {
            name,
            section,
            cell,
            size,
            truth,
            stage,
        }
    }

    /// The rotation that uses up its share of the slack \[radians\].
    fn most_rotation(&self) -> f64 {
        let half = self.config.tile.as_dvec2() / 2.0;
        let fits = |radians: f64| {
            inset(half, radians)
                .cmple(self.slack * ROTATION_SHARE)
                .all()
        };
        let (mut low, mut high) = (0.0, MOST_ROTATION_DEG.to_radians());
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if fits(middle) {
                low = middle
            } else {
                high = middle
            }
        }
        low
    }
}

/// How much smaller, per side, the upright rectangle is that a turned one of these half sides
/// surely contains.
fn inset(half: DVec2, radians: f64) -> DVec2 {
    let (sin, cos) = radians.sin_cos();
    // The upright rectangle h fits where h.x cos + h.y sin <= half.x, and likewise for y; taking
    // h <= half in the sine terms keeps to the safe side.
    let inner = (half - DVec2::new(half.y, half.x) * sin) / cos;
    (half - inner).max(DVec2::ZERO)
}

/// Random numbers that belong to a place: the order of asking for tiles does not matter.
struct Random {
    state: u64,
}

impl Random {
    fn new(seed: u64, place: UVec3) -> Self {
        let mut random = Self { state: seed };
        for part in place.to_array() {
            random.state = random.bits() ^ u64::from(part);
        }
        random
    }

    /// The next step of splitmix64.
    fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// In `(0, 1]`.
    fn unit(&mut self) -> f64 {
        ((self.bits() >> 11) + 1) as f64 / (1_u64 << 53) as f64
    }

    /// Standard normal (Box and Muller).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.unit().ln()).sqrt();
        radius * (TAU * self.unit()).cos()
    }
}
