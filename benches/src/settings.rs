//! How it is measured.

use std::path::PathBuf;

use anyhow::Result;
use saccade_render::{Gpu, wgpu};

use crate::plot::Plot;
use crate::volumes::Scale;

/// What the command line says.
#[derive(Clone, Debug, Default)]
pub(crate) struct Settings {
    /// Rows asked for; all when none is named.
    pub(crate) ids: Vec<String>,
    /// Where plots go, if anywhere.
    pub(crate) plots: Option<PathBuf>,
    /// How large the volumes and pictures of the papers' tables are; `None` is for the device to say.
    pub(crate) scale: Option<Scale>,
}

impl Settings {
    /// Whether a row is to be measured.
    pub(crate) fn wants(&self, id: &str) -> bool {
        self.ids.is_empty() || self.ids.iter().any(|wanted| wanted == id)
    }

    /// As published, but for drivers that draw on the CPU.
    pub(crate) fn scale(&self, gpu: &Gpu) -> Scale {
        let is_cpu = gpu.adapter().device_type == wgpu::DeviceType::Cpu;
        let by_device = if is_cpu { Scale::Small } else { Scale::Paper };
        self.scale.unwrap_or(by_device)
    }

    /// Writes a plot where plots go.
    pub(crate) fn plot(&self, plot: &Plot, name: &str) -> Result<()> {
        match &self.plots {
            Some(folder) => plot.write(folder, name),
            None => Ok(()),
        }
    }
}
