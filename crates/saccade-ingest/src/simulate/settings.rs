//! What an acquisition's tiles were made from, kept beside them: only the same may go on.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use saccade_archive::acquisition::{AcquisitionError, AcquisitionInfo};
use saccade_archive::storage::{SystemDisk, write_whole};
use serde_json::{Map, Value, json};

use super::SimulateConfig;

/// The settings that determine the tiles, by name. Rate and corrections are none of them: they say
/// when something is written, not what.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Settings(Map<String, Value>);

impl Settings {
    /// The file's name in the acquisition archive.
    pub(crate) const FILE: &str = "simulation.json";

    /// Of a simulation; `input` says which tissue it is.
    pub(crate) fn of_simulation(config: &SimulateConfig, input: &str) -> Self {
        Self::new(json!({
            "input": input,
            "seed": config.seed,
            "tile": config.tile.to_array(),
            "overlap": config.overlap,
            "jitter": config.jitter_px,
            "rotation": config.rotation_deg,
            "stage-error": config.stage_error_px,
            "shuffle": config.shuffle,
        }))
    }

    /// Of a replay; `input` says which acquisition it is.
    pub(crate) fn of_replay(input: &str) -> Self {
        Self::new(json!({ "input": input }))
    }

    /// Of a watched folder, by the names of its options.
    pub(crate) fn of_watch(pattern: &str, pitch: [f64; 2], pixel: f64, first: u32) -> Self {
        Self::new(json!({ "pattern": pattern, "pitch": pitch, "pixel": pixel, "first": first }))
    }

    /// Of a folder whose tiles a list names, by the names of its options.
    pub(crate) fn of_list(list: &str, origin: [f64; 2], first: u32, pixel: f64) -> Self {
        Self::new(json!({ "list": list, "origin": origin, "first": first, "pixel": pixel }))
    }

    /// The same with one more that is text.
    pub(crate) fn with(mut self, name: &str, text: &str) -> Self {
        self.0.insert(name.to_owned(), text.into());
        self
    }

    /// Of what registration found, and how far its frame is from the stage's.
    pub(crate) fn of_solution(path: &str, offset: [f64; 2]) -> Self {
        Self::new(json!({ "solution": path, "offset": offset }))
    }

    /// One that is text.
    pub(crate) fn text(&self, name: &str) -> Option<&str> {
        self.0.get(name)?.as_str()
    }

    /// One that is a whole number.
    pub(crate) fn number(&self, name: &str) -> Option<u32> {
        u32::try_from(self.0.get(name)?.as_u64()?).ok()
    }

    /// One that is two numbers.
    pub(crate) fn pair(&self, name: &str) -> Option<[f64; 2]> {
        let pair = self.0.get(name)?.as_array()?;
        let [x, y] = &pair[..] else { return None };
        Some([x.as_f64()?, y.as_f64()?])
    }

    /// As it will be read again: text may lose a number's last bit.
    fn new(settings: Value) -> Self {
        let text = settings.to_string();
        Self(serde_json::from_str(&text).expect("what became JSON is JSON"))
    }

    /// Those of an archive; `None` if it has none, or none that can be understood.
    pub(crate) fn read(folder: &Path) -> Result<Option<Self>, AcquisitionError> {
        Self::read_from(folder.join(Self::FILE))
    }

    /// Those of a file; `None` if there is none, or none that can be understood.
    pub(crate) fn read_from(path: PathBuf) -> Result<Option<Self>, AcquisitionError> {
        match fs::read(&path) {
            Ok(text) => Ok(serde_json::from_slice(&text).ok().map(Self)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(AcquisitionError::Read { source, path }),
        }
    }

    /// Writes them into an archive, whole or not at all. The folder is made if missing.
    pub(crate) fn write(&self, folder: &Path) -> Result<(), AcquisitionError> {
        let path = folder.join(Self::FILE);
        match fs::create_dir_all(folder) {
            Ok(()) => self.write_to(path),
            Err(source) => Err(AcquisitionError::Write { source, path }),
        }
    }

    /// Writes them into a file, whole or not at all.
    pub(crate) fn write_to(&self, path: PathBuf) -> Result<(), AcquisitionError> {
        let text = serde_json::to_vec_pretty(&self.0).expect("JSON becomes text");
        write_whole(&SystemDisk, &path, &text)
            .map_err(|source| AcquisitionError::Write { source, path })
    }

    /// What these say otherwise than those `there`, for people.
    pub(crate) fn differences(&self, there: &Self) -> Vec<String> {
        let names: std::collections::BTreeSet<&String> =
            there.0.keys().chain(self.0.keys()).collect();
        let differs = |name: &&String| there.0.get(*name) != self.0.get(*name);
        let say =
            |name: &String| difference(name, &words(there.0.get(name)), &words(self.0.get(name)));
        names.into_iter().filter(differs).map(say).collect()
    }
}

/// What two descriptions of a volume say differently, for people.
pub(crate) fn volume_differences(there: &AcquisitionInfo, now: &AcquisitionInfo) -> Vec<String> {
    let mut differences = Vec::new();
    if there.name != now.name {
        differences.push(difference("name", &there.name, &now.name));
    }
    if there.extent != now.extent {
        let words = |info: &AcquisitionInfo| by(&info.extent.to_array());
        differences.push(difference("extent", &words(there), &words(now)));
    }
    if there.voxel_nm != now.voxel_nm {
        let words = |info: &AcquisitionInfo| by(&info.voxel_nm.to_array());
        differences.push(difference("voxel-nm", &words(there), &words(now)));
    }
    if there.dtype != now.dtype {
        let bits = |info: &AcquisitionInfo| format!("{} bits", 8 * info.dtype.bytes());
        differences.push(difference("voxel", &bits(there), &bits(now)));
    }
    if there.kind != now.kind {
        let words = |info: &AcquisitionInfo| format!("{:?}", info.kind).to_lowercase();
        differences.push(difference("kind", &words(there), &words(now)));
    }
    if there.channels != now.channels {
        let words = |info: &AcquisitionInfo| match &info.channels[..] {
            [] => "one without a name".to_owned(),
            names => names.join(","),
        };
        differences.push(difference("channels", &words(there), &words(now)));
    }
    differences
}

pub(crate) fn difference(name: &str, there: &str, now: &str) -> String {
    format!("{name} is {there} there, {now} now")
}

fn by<T: ToString>(sizes: &[T]) -> String {
    let sizes: Vec<_> = sizes.iter().map(ToString::to_string).collect();
    sizes.join(" x ")
}

fn words(value: Option<&Value>) -> String {
    match value {
        None => "not set".to_owned(),
        Some(Value::String(text)) => text.clone(),
        Some(Value::Array(sizes)) => by(sizes),
        Some(other) => other.to_string(),
    }
}

/// A short name for bytes: equal for equal ones, and hardly ever for others (FNV-1a, 64 bit).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fingerprint(u64);

impl Fingerprint {
    pub(crate) fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    pub(crate) fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

impl std::fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprints_are_the_published_ones() {
        let of = |bytes: &[u8]| {
            let mut fingerprint = Fingerprint::new();
            fingerprint.add(bytes);
            fingerprint.to_string()
        };
        // From the authors' test vectors.
        assert_eq!(of(b""), "cbf29ce484222325");
        assert_eq!(of(b"a"), "af63dc4c8601ec8c");
        assert_eq!(of(b"foobar"), "85944171f73967e8");
    }

    #[test]
    fn every_setting_that_makes_tiles_counts_and_is_named() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Settings::read(folder.path()).unwrap(), None);
        let config = SimulateConfig {
            jitter_px: 0.1 + 0.2,
            ..SimulateConfig::default()
        };
        let settings = Settings::of_simulation(&config, "phantom");
        settings.write(folder.path()).unwrap();
        let there = Settings::read(folder.path()).unwrap().unwrap();
        assert_eq!(settings.differences(&there), Vec::<String>::new());

        let other = SimulateConfig {
            seed: 2,
            tile: glam::UVec2::new(64, 48),
            overlap: 0.2,
            jitter_px: 1.0,
            rotation_deg: 1.0,
            stage_error_px: 1.0,
            shuffle: true,
            ..config.clone()
        };
        let differences = Settings::of_simulation(&other, "stack 1").differences(&there);
        let names = [
            "input",
            "jitter",
            "overlap",
            "rotation",
            "seed",
            "shuffle",
            "stage-error",
            "tile",
        ];
        let named: Vec<_> = differences
            .iter()
            .map(|text| text.split(' ').next().unwrap())
            .collect();
        assert_eq!(named, names);
        assert!(differences.contains(&"tile is 1024 x 1024 there, 64 x 48 now".to_owned()));

        let paced = SimulateConfig {
            rate_mpixel_s: None,
            corrections: super::super::Corrections::AtEnd,
            ..config
        };
        let paced = Settings::of_simulation(&paced, "phantom");
        assert_eq!(paced, there, "when is not what");
    }
}
