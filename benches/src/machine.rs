//! What the figures were taken on.

use std::fs;
use std::thread;

use serde::Serialize;

/// Processor, graphics and system.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Machine {
    cpu: String,
    cores: usize,
    gpu: String,
    os: String,
}

impl Machine {
    pub(crate) fn here() -> Self {
        let field = |file: &str, key: &str, separator: char| {
            let text = fs::read_to_string(file).unwrap_or_default();
            let line = text
                .lines()
                .find_map(|l| l.strip_prefix(key)?.trim().strip_prefix(separator));
            line.map_or("unknown".to_owned(), |l| {
                l.trim().trim_matches('"').to_owned()
            })
        };
        let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
        let gpu = pollster::block_on(saccade_render::Gpu::headless());
        Self {
            cpu: field("/proc/cpuinfo", "model name", ':'),
            cores: thread::available_parallelism().map_or(1, usize::from),
            gpu: gpu.map_or("none".to_owned(), |g| {
                let adapter = g.adapter();
                format!(
                    "{} ({} {})",
                    adapter.name, adapter.driver, adapter.driver_info
                )
            }),
            os: format!(
                "{}, Linux {}",
                field("/etc/os-release", "PRETTY_NAME", '='),
                kernel.trim()
            ),
        }
    }
}

impl std::fmt::Display for Machine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            cpu,
            cores,
            gpu,
            os,
        } = self;
        write!(f, "{cpu}, {cores} cores; {gpu}; {os}")
    }
}
