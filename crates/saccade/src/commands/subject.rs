//! What stands under the microscope, simulated or replayed.

use std::path::Path;

use anyhow::Result;
use saccade_ingest::replay::{Acquisition, ReplayConfig, check as check_replay, run as replay};
use saccade_ingest::simulate::clock::SystemClock;
use saccade_ingest::simulate::stack::Stack;
use saccade_ingest::simulate::{
    Plan, SimulateConfig, SimulateSummary, check as check_simulate, run as simulate,
};
use saccade_ingest::{Cancel, Progress};

/// What stands under the microscope.
pub(crate) enum Subject {
    /// Tissue that the simulator cuts into tiles.
    Tissue {
        stack: Box<dyn Stack>,
        config: SimulateConfig,
    },
    /// Tiles that a microscope once wrote.
    Tiles {
        acquisition: Acquisition,
        config: ReplayConfig,
    },
}

impl Subject {
    /// Tiles there will be.
    pub(crate) fn tiles(&self) -> Result<u64> {
        Ok(match self {
            Self::Tissue { stack, config } => Plan::new(config, stack.info())?.tile_count(),
            Self::Tiles { acquisition, .. } => acquisition.tiles.len() as u64,
        })
    }

    /// Pixels there will be [Mpixel].
    pub(crate) fn mpixel(&self) -> Result<f64> {
        let pixels = match self {
            Self::Tissue { config, .. } => {
                self.tiles()? as f64 * config.tile.as_dvec2().element_product()
            }
            Self::Tiles { acquisition, .. } => acquisition
                .tiles
                .iter()
                .map(|tile| tile.size.as_dvec2().element_product())
                .sum(),
        };
        Ok(pixels / 1e6)
    }

    /// Sets the rate [Mpixel/s].
    pub(crate) fn set_rate(&mut self, rate: Option<f64>) {
        match self {
            Self::Tissue { config, .. } => config.rate_mpixel_s = rate,
            Self::Tiles { config, .. } => config.rate_mpixel_s = rate,
        }
    }

    /// Whether the acquisition archive `out` could be begun, or gone on with.
    pub(crate) fn check(&self, out: &Path) -> Result<()> {
        match self {
            Self::Tissue { stack, config } => check_simulate(config, &**stack, out)?,
            Self::Tiles {
                acquisition,
                config,
            } => check_replay(config, acquisition, out)?,
        }
        Ok(())
    }

    /// Writes the acquisition archive `out`; blocks.
    pub(crate) fn acquire(
        &self,
        out: &Path,
        cancel: &Cancel,
        progress: &dyn Progress,
    ) -> Result<SimulateSummary> {
        let clock = SystemClock;
        Ok(match self {
            Self::Tissue { stack, config } => {
                simulate(config, &**stack, out, &clock, cancel, progress)?
            }
            Self::Tiles {
                acquisition,
                config,
            } => replay(config, acquisition, out, &clock, cancel, progress)?,
        })
    }
}
