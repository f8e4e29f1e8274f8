//! The acquisition archive: where a microscope writes, and the formats in which it says what.
//!
//! A folder with
//!
//! - `volume.json`: [`AcquisitionInfo`], written once, before the first tile;
//! - `tiles.jsonl`: one [`Record`] per line, only ever appended to;
//! - image files, named by the records, relative to the folder.
//!
//! Other people's formats become the same words: [`tile_list`] reads plain `file x y z` lists,
//! [`tile_configuration`] those of Fiji's stitching plugins, [`tile_specs`] the tiles of a Render
//! stack, [`trakem2`] the affine transforms of a TrakEM2 project.
//!
//! Reading never changes the archive. Unknown fields are ignored, so that a microscope may say
//! more than is understood here; but one of `volume.json` that is spelt almost as a known one is refused, and so is
//! a tile's record without a `channel` that has almost one, for then something else than what was meant would be
//! taken in.
//!
//! A link that leads out of the folder is not followed, be it an image or the records: whoever writes the folder
//! would show files that are another's. The folder itself may be one.

mod key;
pub mod listed_images;
mod record;
mod text;
pub mod tile_configuration;
pub mod tile_list;
pub mod tile_specs;
pub mod trakem2;

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};

use glam::{DVec3, UVec3};
use saccade_core::volume::{Dtype, Volume, VolumeError, VoxelKind, check_name};
use serde::{Deserialize, Serialize};

use crate::storage::{SystemDisk, read_regular, write_whole};

pub use text::readable;

pub use record::{
    BrokenRecord, ChannelRef, Cursor, DeleteRecord, Record, RecordLine, RecordReader, RecordWriter,
    TileRecord, TransformRecord,
};

/// Why an acquisition archive, or a file that describes one, could not be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AcquisitionError {
    /// A file or folder could not be read.
    #[error("cannot read {}; check that it exists and that you may read it", path.display())]
    Read {
        /// What the system says.
        source: io::Error,
        /// File or folder.
        path: PathBuf,
    },
    /// A file could not be written.
    #[error("cannot write {}; check the folder's permissions and its free space", path.display())]
    Write {
        /// What the system says.
        source: io::Error,
        /// File.
        path: PathBuf,
    },
    /// The folder holds no `volume.json`.
    #[error(
        "this folder is no acquisition archive: it has no {}, which the microscope's software writes before the \
         first tile. Images whose names say where they lie are taken in with --pattern, and those of which a list says \
         it with --list; of a stack, `saccade simulate ACQUISITION --input FOLDER` makes an acquisition, and \
         `saccade demo --input FOLDER` shows it at once: {}",
        AcquisitionInfo::FILE, path.display()
    )]
    NoInfo {
        /// Folder.
        path: PathBuf,
    },
    /// `volume.json` is not what it should be.
    #[error(
        "cannot understand {}; it should hold {{\"name\": .., \"extent\": [x, y, z], \
         \"voxel_nm\": [x, y, z]}}, and may hold \"dtype\" (\"uint8\" or \"uint16\"), \
         \"channels\" (names) and \"kind\" (\"intensity\" or \"labels\")",
        path.display()
    )]
    Info {
        /// Where it stops making sense.
        source: serde_json::Error,
        /// File.
        path: PathBuf,
    },
    /// `volume.json` has a key that is almost a known one.
    #[error(
        "{key:?} means nothing in {}; is {meant:?} meant? What counts is {}; a key of your own needs a name \
         that is less like them",
        path.display(), key::KNOWN.join(", ")
    )]
    Key {
        /// As it is there.
        key: String,
        /// The one it is like.
        meant: &'static str,
        /// File.
        path: PathBuf,
    },
    /// Channels of `volume.json` that cannot be told apart.
    #[error("{mistake}; mend \"channels\" in {}", path.display())]
    Channels {
        /// What is wrong with them.
        mistake: String,
        /// File.
        path: PathBuf,
    },
    /// `volume.json` describes no volume that can be.
    #[error("the acquisition archive describes no possible volume; mend {}", path.display())]
    Volume {
        /// What is wrong.
        source: VolumeError,
        /// File.
        path: PathBuf,
    },
    /// A file is a link to somewhere else.
    #[error(
        "this is a link that leads out of the acquisition's folder, and is not followed; put the file itself \
         there: {}",
        path.display()
    )]
    LeadsOut {
        /// The link.
        path: PathBuf,
    },
    /// The records were cut or replaced, although they are only ever appended to.
    #[error(
        "the records end at byte {len}, but were read up to byte {read} before, and are only ever appended; \
         put the old ones back, or take these in under another name (`saccade ingest --volume NAME`) or into \
         another archive: {}",
        path.display()
    )]
    RecordsCut {
        /// Length of the file \[bytes\].
        len: u64,
        /// What was read earlier \[bytes\].
        read: u64,
        /// File.
        path: PathBuf,
    },
    /// Other records have taken the place of those that were read.
    #[error(
        "these are not the records of which {line} lines were taken in before: another acquisition has taken \
         their place; take it in under another name (`saccade ingest --volume NAME`) or into another archive, \
         or put the old records back: {}",
        path.display()
    )]
    RecordsReplaced {
        /// Lines that were read earlier.
        line: u64,
        /// File.
        path: PathBuf,
    },
    /// A text is in another encoding than all others.
    #[error(
        "this text is UTF-16, which editors of Windows call \"Unicode\"; save it as UTF-8: {}",
        path.display()
    )]
    Utf16 {
        /// File.
        path: PathBuf,
    },
    /// A line of a text file makes no sense.
    #[error("line {line}: {reason}: {}", path.display())]
    Line {
        /// Line, from 1.
        line: u64,
        /// What is wrong with it.
        reason: String,
        /// File.
        path: PathBuf,
    },
    /// A JSON file holds no tile specifications.
    #[error("these are no tile specifications (a JSON array of tiles): {}", path.display())]
    Json {
        /// Where it stops making sense.
        source: serde_json::Error,
        /// File.
        path: PathBuf,
    },
    /// A tile of a file cannot be used.
    #[error("tile {tile:?}: {reason}: {}", path.display())]
    Tile {
        /// The tile.
        tile: String,
        /// What is wrong with it.
        reason: String,
        /// File.
        path: PathBuf,
    },
    /// An XML file makes no sense.
    #[error("cannot understand the TrakEM2 project {}", path.display())]
    Xml {
        /// Where it stops making sense.
        source: roxmltree::Error,
        /// File.
        path: PathBuf,
    },
}

impl AcquisitionError {
    /// The file or folder that it is about.
    pub fn path(&self) -> &Path {
        match self {
            Self::Read { path, .. }
            | Self::Write { path, .. }
            | Self::NoInfo { path }
            | Self::Info { path, .. }
            | Self::Key { path, .. }
            | Self::Channels { path, .. }
            | Self::Volume { path, .. }
            | Self::LeadsOut { path }
            | Self::RecordsCut { path, .. }
            | Self::RecordsReplaced { path, .. }
            | Self::Utf16 { path }
            | Self::Line { path, .. }
            | Self::Json { path, .. }
            | Self::Tile { path, .. }
            | Self::Xml { path, .. } => path,
        }
    }
}

/// What is acquired: the content of `volume.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AcquisitionInfo {
    /// Name of the volume.
    pub name: String,
    /// Size, also of what will come later \[level-0 voxels\].
    pub extent: UVec3,
    /// Voxel size \[nm\].
    pub voxel_nm: DVec3,
    /// Type of the voxels: `uint8`, also if it is not said, or `uint16`.
    #[serde(default = "uint8", skip_serializing_if = "is_uint8")]
    pub dtype: Dtype,
    /// Names of the channels; none: one without a name.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub channels: Vec<String>,
    /// What the voxels are.
    #[serde(default, skip_serializing_if = "VoxelKind::is_intensity")]
    pub kind: VoxelKind,
}

fn uint8() -> Dtype {
    Dtype::Uint8
}

fn is_uint8(dtype: &Dtype) -> bool {
    *dtype == Dtype::Uint8
}

impl AcquisitionInfo {
    /// The file's name in the archive.
    pub const FILE: &str = "volume.json";

    /// A volume with one channel of 8-bit shades.
    pub fn new(name: &str, extent: UVec3, voxel_nm: DVec3) -> Self {
        Self {
            name: name.to_owned(),
            extent,
            voxel_nm,
            dtype: Dtype::Uint8,
            channels: Vec::new(),
            kind: VoxelKind::Intensity,
        }
    }

    /// Reads it from an acquisition archive.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::NoInfo`], [`AcquisitionError::Read`], [`AcquisitionError::LeadsOut`],
    /// [`AcquisitionError::Utf16`], and [`AcquisitionError::Info`], [`AcquisitionError::Key`] or [`AcquisitionError::Channels`] for what it says.
    pub fn read(folder: &Path) -> Result<Self, AcquisitionError> {
        let path = folder.join(Self::FILE);
        // The folder first: "you may not look in here" is not "there is nothing here".
        fs::read_dir(folder).map_err(|source| AcquisitionError::Read {
            source,
            path: folder.to_owned(),
        })?;
        refuse_link_out(&path)?;
        let text = match read_regular(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                return Err(AcquisitionError::NoInfo {
                    path: folder.to_owned(),
                });
            }
            Err(source) => return Err(AcquisitionError::Read { source, path }),
        };
        let text = text::content(&text, &path)?;
        if let Some((key, meant)) = key::misspelt(text, &key::KNOWN) {
            return Err(AcquisitionError::Key { key, meant, path });
        }
        let info: Self = match serde_json::from_slice(text) {
            Ok(info) => info,
            Err(source) => return Err(AcquisitionError::Info { source, path }),
        };
        match info.channel_mistake() {
            Some(mistake) => Err(AcquisitionError::Channels { mistake, path }),
            None => Ok(info),
        }
    }

    /// Reads which volume an acquisition archive describes; with another name for it, the file's does not count.
    ///
    /// # Errors
    ///
    /// As [`Self::read`], and [`AcquisitionError::Volume`].
    pub fn read_volume(folder: &Path, name: Option<&str>) -> Result<Volume, AcquisitionError> {
        let info = Self::read(folder)?;
        let described = info.volume().and_then(|volume| match name {
            // Whoever takes it in looks at that.
            Some(name) => Ok(Volume {
                name: name.to_owned(),
                ..volume
            }),
            None => check_name(&volume.name).map(|()| volume),
        });
        described.map_err(|source| AcquisitionError::Volume {
            source,
            path: folder.join(Self::FILE),
        })
    }

    /// What is wrong with the channels' names, by which tiles name them; `None` if nothing is.
    pub fn channel_mistake(&self) -> Option<String> {
        let mut known = BTreeSet::new();
        for name in &self.channels {
            if name.trim().is_empty() {
                return Some(
                    "a channel has an empty name, by which no tile can name it".to_owned(),
                );
            }
            if !known.insert(name) {
                return Some(format!(
                    "two channels are called {name:?}, and no tile could name the second"
                ));
            }
        }
        None
    }

    /// Writes it into an acquisition archive, whole or not at all. The folder is made if missing.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Write`].
    pub fn write(&self, folder: &Path) -> Result<(), AcquisitionError> {
        let path = folder.join(Self::FILE);
        let text = serde_json::to_vec_pretty(self).expect("numbers and a string become JSON");
        fs::create_dir_all(folder)
            .and_then(|()| write_whole(&SystemDisk, &path, &text))
            .map_err(|source| AcquisitionError::Write { source, path })
    }

    /// The volume it describes.
    ///
    /// # Errors
    ///
    /// [`VolumeError`] for an empty extent or an impossible voxel size.
    pub fn volume(&self) -> Result<Volume, VolumeError> {
        let mut volume = Volume::new(&self.name, self.extent, self.voxel_nm)?;
        volume.dtype = self.dtype;
        volume.kind = self.kind;
        if !self.channels.is_empty() {
            volume.channels.clone_from(&self.channels);
        }
        Ok(volume)
    }
}

/// Whether a path, links followed, lies below a folder, links followed. What is not there leads nowhere.
fn stays_below(path: &Path, folder: &Path) -> bool {
    match (path.canonicalize(), folder.canonicalize()) {
        (Ok(path), Ok(folder)) => path.starts_with(folder),
        _ => true,
    }
}

/// Refuses a file that is a link out of its folder.
///
/// # Errors
///
/// [`AcquisitionError::LeadsOut`].
pub fn refuse_link_out(path: &Path) -> Result<(), AcquisitionError> {
    let is_link = fs::symlink_metadata(path).is_ok_and(|meta| meta.is_symlink());
    let folder = path.parent().filter(|_| is_link);
    if folder.is_some_and(|folder| !stays_below(path, folder)) {
        return Err(AcquisitionError::LeadsOut {
            path: path.to_owned(),
        });
    }
    Ok(())
}

/// Whether an image that a record names lies in the archive's folder, or in `linked`, wherever links on its way
/// lead. One that is not there yet does.
pub fn is_inside(image: &Path, folder: &Path, linked: Option<&Path>) -> bool {
    stays_below(image, folder) || linked.is_some_and(|linked| stays_below(image, linked))
}

/// The path of an image that a record names, or `None` if the name leads out of the archive.
pub fn image_path(folder: &Path, file: &str) -> Option<PathBuf> {
    let file = Path::new(file);
    let inside = file
        .components()
        .all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    (inside && file.file_name().is_some()).then(|| folder.join(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A real acquisition: three sections of fourteen tiles, with stage positions and a solution.
    #[test]
    #[expect(clippy::print_stderr, reason = "a skipped test says so")]
    fn a_real_list_and_its_solution_meet() {
        let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
        let shared = std::env::var_os("SACCADE_SHARED").map_or(beside, PathBuf::from);
        let data = shared.join("data/at-tutorial-tiles");
        if !data.is_dir() {
            eprintln!("skipped: no {}; set SACCADE_SHARED", data.display());
            return;
        }
        let list = tile_list::read(&data.join("DEMO_post_mongo/rick0.txt")).unwrap();
        let patches = trakem2::read(&data.join("temp0_final/stack/Affine.xml")).unwrap();
        assert_eq!((list.len(), patches.len()), (42, 42));
        let images = listed_images::Images::below(&data.join("StarterMaterials/TIF")).unwrap();
        let found = images.of_list(list.iter().map(|tile| &*tile.file));
        for (tile, image) in list.iter().zip(found) {
            let image = image.unwrap();
            assert!(
                image.ends_with(format!("{}.tif", tile.name())),
                "{}",
                image.display()
            );
            let patch = patches.iter().find(|p| p.name() == tile.name()).unwrap();
            assert_eq!(
                (patch.section, patch.size),
                (tile.section, glam::UVec2::new(1376, 1040))
            );
            // The solution moves tiles of neighbouring columns by hundreds of pixels at most.
            let (min, _) = patch.transform.bounds(patch.size.as_dvec2());
            let moved = (min.0 - tile.corner).length();
            assert!(moved < 800.0, "{} moved by {moved}", tile.name());
        }
        assert_eq!(list[0].corner, glam::DVec2::new(0.0, 5142.0));
    }

    /// Nobody ever writes to them: whoever waited for that would wait for ever.
    #[cfg(unix)]
    #[test]
    fn pipes_in_the_places_of_texts_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join(AcquisitionInfo::FILE);
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        let refused = [
            AcquisitionInfo::read(folder.path()).map(drop),
            tile_list::read(&pipe).map(drop),
            tile_configuration::read(&pipe).map(drop),
            tile_specs::read(&pipe).map(drop),
            trakem2::read(&pipe).map(drop),
        ];
        for refused in refused {
            let refused = refused.unwrap_err();
            assert!(
                matches!(refused, AcquisitionError::Read { .. }),
                "{refused}"
            );
            assert_eq!(refused.path(), pipe);
        }
    }

    #[test]
    fn a_mark_is_passed_over_and_utf16_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        let json = r#"[{"tileId": "t", "z": 0, "width": 9, "height": 9,
            "mipmapLevels": {"0": {"imageUrl": "a.tif"}}, "transforms": {"specList": []}}]"#;
        let xml = r#"<trakem2><t2_layer z="0"><t2_patch width="9" height="7" transform="matrix(1,0,0,1,0,0)"
            file_path="a.tif"/></t2_layer></trakem2>"#;
        type Read = fn(&Path) -> Result<usize, AcquisitionError>;
        let kinds: [(&str, Read); 4] = [
            ("a.tif 1 2 3\n", |p| tile_list::read(p).map(|all| all.len())),
            ("dim = 2\na.tif; ; (1, 2)\n", |p| {
                tile_configuration::read(p).map(|all| all.len())
            }),
            (json, |p| tile_specs::read(p).map(|all| all.len())),
            (xml, |p| trakem2::read(p).map(|all| all.len())),
        ];
        for (text, read) in kinds {
            fs::write(&path, format!("\u{feff}{text}")).unwrap();
            assert_eq!(read(&path).unwrap(), 1, "{text}");
            let wide = "\u{feff}".encode_utf16().chain(text.encode_utf16());
            fs::write(&path, wide.flat_map(u16::to_le_bytes).collect::<Vec<_>>()).unwrap();
            let refused = read(&path).unwrap_err().to_string();
            assert!(
                refused.contains("UTF-16") && refused.contains("save it as UTF-8"),
                "{refused}"
            );
        }
        fs::write(
            &path,
            format!("ok.tif 1 2 3\n{} 1 2\n", "a".repeat(30 << 20)),
        )
        .unwrap();
        let refused = tile_list::read(&path).unwrap_err().to_string();
        assert!(
            refused.len() < 1000 && refused.contains("line 2"),
            "{}",
            refused.len()
        );
    }

    #[test]
    fn info_survives_its_file_and_more_fields() {
        let folder = tempfile::tempdir().unwrap();
        let mut info =
            AcquisitionInfo::new("cortex", UVec3::new(10, 20, 3), DVec3::new(4.0, 4.0, 40.0));
        info.write(&folder.path().join("new")).unwrap();
        assert_eq!(
            AcquisitionInfo::read(&folder.path().join("new")).unwrap(),
            info
        );

        let more = r#"{"name":"cortex","extent":[10,20,3],"voxel_nm":[4,4,40],"kV":1.5}"#;
        fs::write(folder.path().join(AcquisitionInfo::FILE), more).unwrap();
        assert_eq!(AcquisitionInfo::read(folder.path()).unwrap(), info);
        assert_eq!(info.volume().unwrap().channels.len(), 1);

        let more = r#"{"name":"cortex","extent":[10,20,3],"voxel_nm":[4,4,40],
            "dtype":"uint16","channels":["SE","BSE"],"kind":"labels"}"#;
        fs::write(folder.path().join(AcquisitionInfo::FILE), more).unwrap();
        info.dtype = Dtype::Uint16;
        info.channels = vec!["SE".to_owned(), "BSE".to_owned()];
        info.kind = VoxelKind::Labels;
        assert_eq!(AcquisitionInfo::read(folder.path()).unwrap(), info);
        info.write(folder.path()).unwrap();
        assert_eq!(AcquisitionInfo::read(folder.path()).unwrap(), info);
        let volume = info.volume().unwrap();
        assert_eq!(
            (volume.dtype, volume.channels),
            (Dtype::Uint16, info.channels)
        );
    }

    #[test]
    fn keys_that_are_almost_known_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let read = |more: &str| {
            let text =
                format!(r#"{{"name":"cortex","extent":[10,20,3],"voxel_nm":[4,4,40]{more}}}"#);
            fs::write(folder.path().join(AcquisitionInfo::FILE), text).unwrap();
            AcquisitionInfo::read(folder.path())
        };
        for (key, want) in [
            ("chanels", "channels"),
            ("channel", "channels"),
            ("Channels", "channels"),
            ("dType", "dtype"),
            ("knid", "kind"),
            ("voxel-nm", "voxel_nm"),
        ] {
            let refused = read(&format!(r#","{key}":["SE"]"#)).unwrap_err();
            let told = refused.to_string();
            assert!(
                matches!(refused, AcquisitionError::Key { meant, .. } if meant == want),
                "{key}: {told}"
            );
            for part in [key, want, "volume.json", "name, extent, voxel_nm, dtype"] {
                assert!(told.contains(part), "{part:?} is not in: {told}");
            }
        }
        // In place of one that is needed.
        let text = r#"{"name":"cortex","extents":[10,20,3],"voxel_nm":[4,4,40]}"#;
        fs::write(folder.path().join(AcquisitionInfo::FILE), text).unwrap();
        let refused = AcquisitionInfo::read(folder.path()).unwrap_err();
        assert!(matches!(
            refused,
            AcquisitionError::Key {
                meant: "extent",
                ..
            }
        ));
        // What a microscope says besides is its own.
        let own = r#","kV":1.5,"date":"May","operator":{"kinds":1},"stage":[1],"sample":"x","size":3,
            "names":["a"],"game":1,"type":"SEM""#;
        assert!(read(own).is_ok());
        // Twice is not once.
        let twice = read(r#","dtype":"uint8","dtype":"uint16""#).unwrap_err();
        assert!(matches!(twice, AcquisitionError::Info { .. }), "{twice}");
    }

    #[test]
    fn channels_have_names_of_their_own() {
        let folder = tempfile::tempdir().unwrap();
        for (channels, part) in [
            (r#"["SE","BSE","SE"]"#, "\"SE\""),
            (r#"["SE",""]"#, "empty"),
            (r#"[" "]"#, "empty"),
        ] {
            let text = format!(
                r#"{{"name":"v","extent":[1,2,3],"voxel_nm":[4,4,40],"channels":{channels}}}"#
            );
            fs::write(folder.path().join(AcquisitionInfo::FILE), text).unwrap();
            let refused = AcquisitionInfo::read(folder.path()).unwrap_err();
            assert!(matches!(refused, AcquisitionError::Channels { .. }));
            let told = refused.to_string();
            assert!(
                told.contains(part) && told.contains("volume.json"),
                "{told}"
            );
        }
    }

    #[test]
    fn links_out_of_the_archive_are_not_followed() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let (archive, elsewhere) = (folder.path().join("a"), folder.path().join("b"));
        let info = AcquisitionInfo::new("v", UVec3::ONE, DVec3::ONE);
        info.write(&elsewhere).unwrap();
        fs::write(elsewhere.join(RecordReader::FILE), "secret\n").unwrap();
        fs::create_dir(&archive).unwrap();
        for file in [AcquisitionInfo::FILE, RecordReader::FILE] {
            symlink(elsewhere.join(file), archive.join(file)).unwrap();
        }
        let refused = AcquisitionInfo::read(&archive).unwrap_err();
        assert!(
            matches!(refused, AcquisitionError::LeadsOut { .. }),
            "{refused}"
        );
        let mut reader = RecordReader::new(&archive, Cursor::default());
        let refused = reader.read(1).unwrap_err();
        assert!(
            matches!(refused, AcquisitionError::LeadsOut { .. }),
            "{refused}"
        );
        // The folder itself may be a link, and links within it are its own.
        let link = folder.path().join("link");
        symlink(&elsewhere, &link).unwrap();
        fs::rename(elsewhere.join(RecordReader::FILE), elsewhere.join("today")).unwrap();
        symlink("today", elsewhere.join(RecordReader::FILE)).unwrap();
        assert_eq!(AcquisitionInfo::read(&link).unwrap(), info);
        let mut reader = RecordReader::new(&link, Cursor::default());
        assert_eq!(reader.read(1).unwrap().len(), 1);
        // Images as well, and in the one folder besides that may be looked into.
        symlink(elsewhere.join("today"), archive.join("image")).unwrap();
        symlink(&elsewhere, archive.join("deep")).unwrap();
        for image in ["image", "deep/today"].map(|file| archive.join(file)) {
            assert!(!is_inside(&image, &archive, None));
            assert!(!is_inside(&image, &archive, Some(&folder.path().join("a"))));
            assert!(is_inside(&image, &archive, Some(&elsewhere)));
        }
        assert!(is_inside(&link.join("today"), &link, None));
        assert!(is_inside(&archive.join("missing"), &archive, None));
    }

    #[test]
    fn what_is_missing_or_broken_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let read = |path: &Path| AcquisitionInfo::read(path).unwrap_err();
        assert!(matches!(
            read(&folder.path().join("none")),
            AcquisitionError::Read { .. }
        ));
        assert!(matches!(
            read(folder.path()),
            AcquisitionError::NoInfo { .. }
        ));
        fs::write(folder.path().join(AcquisitionInfo::FILE), r#"{"name":"x"}"#).unwrap();
        assert!(matches!(read(folder.path()), AcquisitionError::Info { .. }));
    }

    #[test]
    fn images_stay_inside_the_archive() {
        let folder = Path::new("/archive");
        let inside = |file| image_path(folder, file);
        assert_eq!(
            inside("tiles/a.tif").unwrap(),
            Path::new("/archive/tiles/a.tif")
        );
        assert!(inside("./a.tif").is_some());
        for out in ["/etc/passwd", "../a.tif", "tiles/../../a.tif", "", "."] {
            assert_eq!(inside(out), None, "{out}");
        }
    }
}
