//! Tile specifications of the Render web services, as JSON: an array of tiles, each with its image,
//! its place on the stage and its list of transforms.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DAffine2, DVec2, UVec2};
use saccade_core::transform::SectionFromTile;
use serde::Deserialize;

use super::AcquisitionError;
use super::text::{content, quoted};
use super::tile_list::stem;
use crate::storage::read_regular;

/// A tile of a Render stack.
#[derive(Clone, Debug, PartialEq)]
pub struct TileSpec {
    /// Its id.
    pub id: String,
    /// Its full-size image: a path, without the scheme of a file URL but percent-encoded as that is; of several channels, the
    /// one that is shown by default.
    pub file: String,
    /// Its images of several channels, if it has such.
    pub channels: Vec<ChannelImage>,
    /// Section: its z, possibly not starting at 0.
    pub section: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where the stage was: low corner in its section \[pixels\].
    pub stage: Option<DVec2>,
    /// To pixels of the section from pixels of the tile: all its affine transforms, in order.
    pub transform: SectionFromTile,
    /// Kinds of transform that are left out: deformations of the lens, which come before the affine ones.
    pub left_out: Vec<String>,
}

/// The image of one channel of a tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChannelImage {
    /// The channel's name.
    pub name: String,
    /// The full-size image, as [`TileSpec::file`].
    pub file: String,
}

impl ChannelImage {
    /// The image's name without folder and extension.
    pub fn stem(&self) -> &str {
        stem(&self.file)
    }
}

impl TileSpec {
    /// The image's name without folder and extension.
    pub fn name(&self) -> &str {
        stem(&self.file)
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Json {
    tile_id: String,
    z: f64,
    width: f64,
    height: f64,
    layout: Option<Layout>,
    #[serde(default)]
    mipmap_levels: BTreeMap<String, Mipmap>,
    #[serde(default)]
    channels: Option<Vec<Channel>>,
    transforms: Transforms,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Channel {
    name: Option<String>,
    #[serde(default)]
    mipmap_levels: BTreeMap<String, Mipmap>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Layout {
    stage_x: Option<f64>,
    stage_y: Option<f64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Mipmap {
    image_url: Option<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Transforms {
    #[serde(default)]
    spec_list: Vec<Transform>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Transform {
    class_name: Option<String>,
    data_string: Option<String>,
    ref_id: Option<String>,
}

/// Reads tile specifications.
///
/// Of the transforms, affine ones and translations are understood. Corrections of the lens and
/// references to transforms kept elsewhere are left out, which [`TileSpec::left_out`] tells; any
/// other kind is refused, for without it the tile would lie elsewhere.
///
/// # Errors
///
/// [`AcquisitionError::Read`], [`AcquisitionError::Utf16`], [`AcquisitionError::Json`], and [`AcquisitionError::Tile`] for a tile that
/// cannot be used.
pub fn read(path: &Path) -> Result<Vec<TileSpec>, AcquisitionError> {
    let bytes = read_regular(path).map_err(|source| AcquisitionError::Read {
        source,
        path: path.to_owned(),
    })?;
    parse(&bytes, path)
}

/// The same from the file's bytes; `path` is for messages.
///
/// # Errors
///
/// As [`read`], but for reading.
pub fn parse(bytes: &[u8], path: &Path) -> Result<Vec<TileSpec>, AcquisitionError> {
    let specs: Vec<Json> =
        serde_json::from_slice(content(bytes, path)?).map_err(|source| AcquisitionError::Json {
            source,
            path: path.to_owned(),
        })?;
    let specs = specs.into_iter().map(|json| {
        let tile = json.tile_id.clone();
        spec(json).map_err(|reason| AcquisitionError::Tile {
            tile,
            reason,
            path: path.to_owned(),
        })
    });
    specs.collect()
}

fn spec(json: Json) -> Result<TileSpec, String> {
    let whole = |what: &str, value: f64, least: f64| {
        if value >= least && value.fract() == 0.0 && value <= f64::from(u32::MAX) {
            #[expect(clippy::cast_possible_truncation, reason = "checked above")]
            Ok(value as u32)
        } else {
            Err(format!(
                "{what} is {value}, not a whole number from {least}"
            ))
        }
    };
    let channels = json.channels.as_deref().unwrap_or_default();
    // One without a name is what others have at the top.
    let alone = match channels {
        [one] if one.name.is_none() => full_size(&one.mipmap_levels),
        _ => None,
    };
    let channels = match alone {
        Some(_) => Vec::new(),
        None => channel_images(channels)?,
    };
    let file = full_size(&json.mipmap_levels).or(alone);
    let file = file.or_else(|| channels.first().map(|channel| channel.file.clone()));
    let file = file.ok_or("it has no image of level 0")?;
    let mut affine = DAffine2::IDENTITY;
    let mut left_out = Vec::new();
    for transform in &json.transforms.spec_list {
        match understood(transform)? {
            Understood::Affine(next) => affine = next * affine,
            Understood::LeftOut(kind) => left_out.push(kind),
        }
    }
    let transform = SectionFromTile::new(affine.to_cols_array()).map_err(|e| e.to_string())?;
    let stage = json.layout.as_ref().and_then(|layout| {
        let stage = DVec2::new(layout.stage_x?, layout.stage_y?);
        stage.is_finite().then_some(stage)
    });
    Ok(TileSpec {
        file,
        channels,
        section: whole("z", json.z, 0.0)?,
        size: UVec2::new(
            whole("width", json.width, 1.0)?,
            whole("height", json.height, 1.0)?,
        ),
        id: json.tile_id,
        stage,
        transform,
        left_out,
    })
}

/// The image of level 0.
fn full_size(levels: &BTreeMap<String, Mipmap>) -> Option<String> {
    let url = levels.get("0")?.image_url.as_deref()?;
    let path = url.strip_prefix("file:").map_or(url, without_host);
    Some(path.to_owned())
}

fn channel_images(channels: &[Channel]) -> Result<Vec<ChannelImage>, String> {
    let mut images: Vec<ChannelImage> = Vec::with_capacity(channels.len());
    for channel in channels {
        let name = channel
            .name
            .as_deref()
            .filter(|name| !name.trim().is_empty());
        let name = name.ok_or("one of its channels has no name")?;
        if images.iter().any(|image| image.name == name) {
            return Err(format!("two of its channels are called {}", quoted(name)));
        }
        let file = full_size(&channel.mipmap_levels);
        let file =
            file.ok_or_else(|| format!("its channel {} has no image of level 0", quoted(name)))?;
        images.push(ChannelImage {
            name: name.to_owned(),
            file,
        });
    }
    Ok(images)
}

/// `///path`, `//path` and `/path` are all written for the same file.
fn without_host(path: &str) -> &str {
    let slashes = path.len() - path.trim_start_matches('/').len();
    &path[slashes.saturating_sub(1)..]
}

enum Understood {
    Affine(DAffine2),
    LeftOut(String),
}

fn understood(transform: &Transform) -> Result<Understood, String> {
    if let Some(reference) = &transform.ref_id {
        return Ok(Understood::LeftOut(format!("reference to {reference}")));
    }
    let class = transform.class_name.as_deref().unwrap_or_default();
    let kind = class.rsplit('.').next().unwrap_or_default();
    let data = transform.data_string.as_deref().unwrap_or_default();
    let numbers = || -> Option<Vec<f64>> {
        let numbers = data.split_whitespace().map(|n| n.parse().ok());
        numbers.collect()
    };
    let affine = match kind {
        // Both in the order of columns.
        "AffineModel2D" => numbers()
            .and_then(|n| <[f64; 6]>::try_from(n).ok())
            .map(|n| DAffine2::from_cols_array(&n)),
        "TranslationModel2D" => numbers()
            .and_then(|n| <[f64; 2]>::try_from(n).ok())
            .map(|n| DAffine2::from_translation(n.into())),
        "NonLinearCoordinateTransform" | "NonLinearTransform" => {
            return Ok(Understood::LeftOut(kind.to_owned()));
        }
        _ => {
            return Err(format!(
                "its transform of kind {class:?} cannot be used; use affine transforms only"
            ));
        }
    };
    let affine = affine.ok_or_else(|| format!("{kind} has the parameters {data:?}"))?;
    Ok(Understood::Affine(affine))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use std::path::PathBuf;

    use saccade_core::transform::TilePoint;

    use super::*;

    fn parse(transforms: &str, rest: &str) -> Result<Vec<TileSpec>, AcquisitionError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("specs.json");
        let json = format!(
            r#"[{{"tileId": "t.7", "z": 7.0, "width": 30.0, "height": 20,
                 "mipmapLevels": {{"0": {{"imageUrl": "file:///scope/a.b/c.tif"}}}},
                 "transforms": {{"type": "list", "specList": [{transforms}]}} {rest}}}]"#
        );
        fs::write(&path, json).unwrap();
        read(&path)
    }

    const TURN: &str = r#"{"type": "leaf", "className": "mpicbg.trakem2.transform.AffineModel2D",
                           "dataString": "0 1 -1 0 5 6"}"#;
    const MOVE: &str = r#"{"className": "mpicbg.trakem2.transform.TranslationModel2D",
                           "dataString": "100 0"}"#;
    const LENS: &str = r#"{"className": "lenscorrection.NonLinearTransform", "dataString": "1 2"}"#;

    #[test]
    fn transforms_are_applied_in_order() {
        let stage = r#", "layout": {"sectionId": "7.0", "stageX": 310.5, "stageY": -2}"#;
        let read = parse(&format!("{LENS}, {TURN}, {MOVE}"), stage).unwrap();
        let tile = &read[0];
        assert_eq!(
            (tile.id.as_str(), tile.name(), tile.section),
            ("t.7", "c", 7)
        );
        assert_eq!(tile.file, "/scope/a.b/c.tif");
        assert_eq!(tile.size, UVec2::new(30, 20));
        assert_eq!(tile.stage, Some(DVec2::new(310.5, -2.0)));
        assert_eq!(tile.left_out, ["NonLinearTransform"]);
        // (2, 3) is turned to (-3 + 5, 2 + 6), then moved.
        let at = tile.transform.apply(TilePoint(DVec2::new(2.0, 3.0)));
        assert_eq!(at.0, DVec2::new(102.0, 8.0));
        // The other way round is another place.
        let other = parse(&format!("{MOVE}, {TURN}"), "").unwrap();
        let at = other[0].transform.apply(TilePoint(DVec2::new(2.0, 3.0)));
        assert_eq!(at.0, DVec2::new(2.0, 108.0));
        assert_eq!(other[0].stage, None);
    }

    #[test]
    fn channels_have_images_of_their_own() {
        let channel = |name: &str, file: &str| {
            format!(r#"{{{name} "mipmapLevels": {{"0": {{"imageUrl": "file:/raw/{file}.tif"}}}}}}"#)
        };
        let read =
            |channels: &[String]| parse("", &format!(r#", "channels": [{}]"#, channels.join(",")));
        let named = |name: &str| channel(&format!(r#""name": "{name}","#), name);
        let tile = &read(&[named("PSD95"), named("DAPI")]).unwrap()[0];
        let images: Vec<_> = { tile.channels.iter() }
            .map(|c| (&*c.name, &*c.file))
            .collect();
        assert_eq!(
            images,
            [("PSD95", "/raw/PSD95.tif"), ("DAPI", "/raw/DAPI.tif")]
        );
        assert_eq!(tile.file, "/scope/a.b/c.tif");
        let none = channel("", "only");
        assert_eq!(read(&[]).unwrap()[0].channels, []);
        assert_eq!(read(std::slice::from_ref(&none)).unwrap()[0].channels, []);
        for (bad, why) in [
            (vec![named("a"), none], "no name"),
            (vec![named("a"), named("a")], "are called \"a\""),
            (vec![r#"{"name": "a"}"#.to_owned()], "no image of level 0"),
        ] {
            let refused = read(&bad).unwrap_err().to_string();
            assert!(refused.contains(why), "{refused}");
        }
    }

    #[test]
    fn what_cannot_be_used_is_refused_with_the_tile() {
        for transforms in [
            r#"{"className": "mpicbg.trakem2.transform.PolynomialTransform2D", "dataString": "1"}"#,
            r#"{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "1 0 0 1 0"}"#,
            r#"{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "1 0 0 1 0 x"}"#,
            r#"{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "0 0 0 0 0 0"}"#,
            "{}",
        ] {
            match parse(transforms, "") {
                Err(AcquisitionError::Tile { tile, .. }) => assert_eq!(tile, "t.7"),
                other => panic!("{transforms}: {other:?}"),
            }
        }
        let json = parse("", r#", "z": -1"#);
        assert!(json.is_err(), "{json:?}");
    }

    #[test]
    #[expect(clippy::print_stderr, reason = "a skipped test says so")]
    fn real_specifications_are_read() {
        let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
        let shared = std::env::var_os("SACCADE_SHARED").map_or(beside, PathBuf::from);
        let folder = shared.join("data/asap-em-montage-json");
        if !folder.is_dir() {
            eprintln!("skipped: no {}; set SACCADE_SHARED", folder.display());
            return;
        }
        let read = |file: &str| read(&folder.join(file));
        let tiles = read("em_montage_qc_post_tilespecs.json").unwrap();
        assert_eq!(tiles.len(), 46);
        let sections: Vec<u32> = tiles.iter().map(|tile| tile.section).collect();
        assert!(sections.contains(&1028) && sections.contains(&1029));
        for tile in &tiles {
            let stage = tile.stage.expect("this microscope knows its stage");
            let solved = tile.transform.apply(TilePoint(DVec2::ZERO)).0;
            let scale = tile.transform.elements()[0];
            assert!((0.9..1.1).contains(&scale), "{}: {scale}", tile.id);
            assert!(stage.is_finite() && solved.is_finite());
            assert_eq!(tile.left_out, ["NonLinearCoordinateTransform"]);
        }
        // Of array tomography, with an image for each channel.
        let tiles = read("multichan_intensity_correction_template.json").unwrap();
        assert_eq!(tiles.len(), 8);
        for tile in &tiles {
            let names: Vec<_> = tile.channels.iter().map(|image| &*image.name).collect();
            assert_eq!(names, ["PSD95", "DAPI_1"], "{}", tile.id);
            assert_eq!(tile.file, tile.channels[1].file);
            assert!(tile.channels[0].stem().starts_with("PSD95_S0000_F000"));
        }
        let refused = read("fusion_test_tilespecs_ref.json").unwrap_err();
        assert!(
            refused.to_string().contains("PolynomialTransform2D"),
            "{refused}"
        );
        // Other JSON is none of it.
        let other = read("TEMCA_mdfile.json");
        assert!(
            matches!(other, Err(AcquisitionError::Json { .. })),
            "{other:?}"
        );
    }
}
