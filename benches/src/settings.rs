//! How it is measured.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use image::GrayImage;
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
    /// Folder or address of an image that is drawn, if any.
    pub(crate) image: Option<String>,
}

/// Whether what was asked for is this row, or the beginning of its id up to a dot.
pub(crate) fn names(wanted: &str, id: &str) -> bool {
    wanted == id || (wanted.ends_with('.') && id.starts_with(wanted))
}

impl Settings {
    /// Whether a row is to be measured.
    pub(crate) fn wants(&self, id: &str) -> bool {
        self.ids.is_empty() || self.ids.iter().any(|wanted| names(wanted, id))
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

    /// Writes a description as `NAME.json` where plots go.
    pub(crate) fn json(&self, value: &serde_json::Value, name: &str) -> Result<()> {
        let Some(folder) = &self.plots else {
            return Ok(());
        };
        let file = folder.join(format!("{name}.json"));
        { std::fs::create_dir_all(folder) }
            .and_then(|()| std::fs::write(&file, format!("{value:#}\n")))
            .with_context(|| format!("cannot write {}", file.display()))
    }

    /// Writes a picture as `NAME.png` where plots go.
    pub(crate) fn picture(&self, picture: &GrayImage, name: &str) -> Result<()> {
        let Some(folder) = &self.plots else {
            return Ok(());
        };
        let file = folder.join(format!("{name}.png"));
        std::fs::create_dir_all(folder)?;
        { picture.save(&file) }.with_context(|| format!("cannot write {}", file.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_named_whole_or_up_to_a_dot() {
        let settings = |ids: &[&str]| Settings {
            ids: ids.iter().map(|id| (*id).to_owned()).collect(),
            ..Settings::default()
        };
        assert!(settings(&[]).wants("render.a.b"));
        assert!(settings(&["x", "render.a.b"]).wants("render.a.b"));
        assert!(settings(&["render."]).wants("render.a.b"));
        assert!(settings(&["render.a."]).wants("render.a.b"));
        assert!(!settings(&["render.a"]).wants("render.a.b"));
        assert!(!settings(&["rend"]).wants("render.a.b"));
    }
}
