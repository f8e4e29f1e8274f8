//! What the metadata of a group say of its image.

use glam::DVec3;
use serde_json::Value;

use super::error::Refusal;
use super::space;

/// What an axis of an array is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Axis {
    /// Time: the first is shown.
    T,
    /// Channel.
    C,
    /// Space: 0 for x, 1 for y, 2 for z.
    Space(usize),
}

/// An image of several levels.
#[derive(Debug)]
pub(super) struct Image {
    /// Of its arrays, slowest first.
    pub(super) axes: Vec<Axis>,
    /// Voxel size of the finest level \[nm\].
    pub(super) voxel_nm: DVec3,
    /// Finest voxels per voxel, by level, where transformations tell.
    pub(super) downsampling: Vec<Option<DVec3>>,
    /// How far all of it is moved \[nm\].
    pub(super) origin_nm: DVec3,
    /// Middle of each level's first voxel, from that of the finest's \[finest voxels\].
    pub(super) first: Vec<DVec3>,
    /// Channels, as far as anything is said of them.
    pub(super) channels: Vec<Channel>,
    /// Whether it says that its values name things.
    pub(super) is_labels: bool,
    /// What a user should know of how it is shown, in sentences.
    pub(super) notes: Vec<String>,
}

/// What is said of a channel.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Channel {
    /// Empty for none.
    pub(super) label: String,
    /// Red, green, blue.
    pub(super) color: Option<[u8; 3]>,
    /// Values at the two ends of its colours, as stored.
    pub(super) window: Option<[f64; 2]>,
    /// The values that there can be.
    pub(super) whole: Option<[f64; 2]>,
    /// Whether it is shown at first.
    pub(super) active: bool,
}

/// The part of a group's attributes that says what the image is, whatever its version.
pub(super) fn ome(attributes: &Value) -> &Value {
    // Version 0.5 has a name space of its own.
    let ome = &attributes["ome"];
    if ome.is_object() { ome } else { attributes }
}

/// Versions of OME-Zarr that are read as they are meant.
const KNOWN: [&str; 6] = ["0.1", "0.2", "0.3", "0.4", "0.5", "0.6"];

/// The version that an image says it is of: since 0.5 all of it, before that its multiscales.
fn version(ome: &Value) -> Option<&str> {
    { ome["version"].as_str() }.or_else(|| ome["multiscales"][0]["version"].as_str())
}

/// Whether it is one of those, or a draft of one, as `0.6-dev1` and `0.6.dev1`.
fn is_known(version: &str) -> bool {
    KNOWN.iter().any(|known| {
        let rest = version.strip_prefix(known);
        rest.is_some_and(|rest| !rest.starts_with(|c: char| c.is_ascii_digit()))
    })
}

/// Paths of an image's levels, finest first.
pub(super) fn paths(ome: &Value) -> Result<Vec<String>, Refusal> {
    let refused = |reason: &str| Refusal::Unsupported(reason.to_owned());
    if ome["plate"].is_object() {
        let wells = ome["plate"]["wells"].as_array().into_iter().flatten();
        let wells = wells.filter_map(|well| well["path"].as_str()).take(3);
        let wells: Vec<String> = wells.map(|well| format!("PLATE/{well}/0")).collect();
        let such = match &*wells {
            [] => "PLATE/A/1/0".to_owned(),
            wells => wells.join(" or "),
        };
        return Err(refused(&format!(
            "it is a plate of many images; name one of them, as in {such}"
        )));
    }
    if ome["well"].is_object() {
        return Err(refused(
            "it is a well of several images; name one of them, as in WELL/0",
        ));
    }
    if !ome["bioformats2raw.layout"].is_null() && ome["multiscales"].is_null() {
        return Err(refused(
            "it is a collection of images; name one of them, as in COLLECTION/0",
        ));
    }
    if let Some(labels) = ome["labels"].as_array()
        && ome["multiscales"].is_null()
    {
        let names: Vec<&str> = labels.iter().filter_map(Value::as_str).take(5).collect();
        let names = names.join(", ");
        return Err(refused(&format!(
            "it is a list of label images; name one of them, as in LABELS/NAME: {names}"
        )));
    }
    if let Some(ways) = ome["scene"]["coordinateTransformations"].as_array()
        && ome["multiscales"].is_null()
    {
        let ends = ways.iter().flat_map(|way| [&way["input"], &way["output"]]);
        let mut names: Vec<&str> = ends.filter_map(|end| end["path"].as_str()).collect();
        names.sort_unstable();
        names.dedup();
        names.truncate(5);
        let names = names.join(", ");
        return Err(refused(&format!(
            "it is a scene of several images; name one of them, as in SCENE/NAME: {names}"
        )));
    }
    let multiscale = &ome["multiscales"][0];
    if !multiscale.is_object() {
        return Err(refused(
            "it has no multiscales, so it is no OME-Zarr image; name the image in it",
        ));
    }
    let datasets = multiscale["datasets"].as_array();
    let datasets = datasets.filter(|list| !list.is_empty());
    let datasets = datasets.ok_or_else(|| Refusal::wrong("it lists no levels (datasets)"))?;
    let path = |dataset: &Value| {
        let path = dataset["path"].as_str();
        let path = path.ok_or_else(|| Refusal::wrong("a level (dataset) has no path"))?;
        let parts = path.split('/').filter(|part| !matches!(*part, "" | "."));
        let inside = parts
            .clone()
            .all(|part| part != ".." && !part.contains(['\\', '\0']));
        if path.starts_with('/') || !inside {
            let outside = format!("the level {path:?} lies outside of the image");
            return Err(Refusal::Wrong(outside));
        }
        Ok(parts.collect::<Vec<_>>().join("/"))
    };
    datasets.iter().map(path).collect()
}

impl Image {
    /// Of attributes, and of the number of axes that its arrays have.
    pub(super) fn parse(ome: &Value, rank: usize) -> Result<Self, Refusal> {
        let multiscale = &ome["multiscales"][0];
        let space = match multiscale["coordinateSystems"].as_array() {
            Some(systems) => space::of_systems(multiscale, systems)?,
            None => space::of_axes(multiscale)?,
        };
        let named = space.axes;
        let axes = axes(named, rank)?;
        let datasets = multiscale["datasets"].as_array().into_iter().flatten();
        let placed = datasets.map(|dataset| &dataset["coordinateTransformations"]);
        let placed: Vec<&Value> = placed.collect();
        let ways = placed.iter().map(|list| way(&axes, list));
        let ways: Vec<Way> = ways.collect::<Result<_, _>>()?;
        let of_all = { space.of_all }.map(|transformations| way(&axes, transformations));
        let of_all = of_all.transpose()?;
        let moved = { of_all.as_ref() }.map_or(DVec3::ZERO, |way| way.first);
        let of_all = of_all.and_then(|way| way.scale);
        let says_scale = of_all.is_some();
        let of_all = of_all.unwrap_or(DVec3::ONE);
        let begin = ways.first().map_or(DVec3::ZERO, |way| way.first);
        let finest = ways.first().and_then(|way| way.scale);
        let units = units(named.map_or(&[][..], |named| named), &axes);
        let says_size = finest.is_some() || placed.first().is_some_and(|list| space::stays(list));
        let finest = finest.unwrap_or(DVec3::ONE);
        let size_note = units.note(says_size || says_scale);
        let units = units.nm;
        let mut voxel_nm = finest * of_all * units;
        let origin_nm = (begin * of_all + moved) * units;
        if !axes.contains(&Axis::Space(2)) {
            voxel_nm.z = voxel_nm.x;
        }
        if !(voxel_nm.is_finite() && voxel_nm.min_element() > 0.0) {
            let reason = "its voxels have no size (coordinateTransformations)";
            return Err(Refusal::wrong(reason));
        }
        if !origin_nm.is_finite() {
            let reason = "it lies nowhere (coordinateTransformations)";
            return Err(Refusal::wrong(reason));
        }
        let downsampling = |way: &Way| Some(way.scale? / finest).filter(|d| d.is_finite());
        let channels = ome["omero"]["channels"].as_array().into_iter().flatten();
        let mut notes = space.notes;
        notes.extend(size_note);
        notes.extend(version(ome).filter(|version| !is_known(version)).map(|version| {
            format!(
                "it is of version {version:?} of OME-Zarr, and {} are known here: what newer ones say differently is \
                 taken as those say it", KNOWN.join(", ")
            )
        }));
        Ok(Self {
            voxel_nm,
            origin_nm,
            downsampling: ways.iter().map(downsampling).collect(),
            first: { ways.iter() }
                .map(|way| (way.first - begin) / finest)
                .collect(),
            channels: channels.map(channel).collect(),
            is_labels: ome["image-label"].is_object(),
            notes,
            axes,
        })
    }
}

fn channel(channel: &Value) -> Channel {
    let window = &channel["window"];
    let pair = |low: &str, high: &str| {
        let pair = [window[low].as_f64()?, window[high].as_f64()?];
        (pair[0] < pair[1]).then_some(pair)
    };
    Channel {
        label: channel["label"].as_str().unwrap_or_default().to_owned(),
        color: channel["color"].as_str().and_then(color),
        window: pair("start", "end"),
        whole: pair("min", "max"),
        active: channel["active"].as_bool().unwrap_or(true),
    }
}

/// Six hexadecimal digits, with or without a hash in front; eight if there is opacity behind.
fn color(text: &str) -> Option<[u8; 3]> {
    let text = text.strip_prefix('#').unwrap_or(text);
    let digits = matches!(text.len(), 6 | 8) && text.bytes().all(|b| b.is_ascii_hexdigit());
    let number = digits.then(|| u32::from_str_radix(&text[..6], 16).ok())??;
    let [_, red, green, blue] = number.to_be_bytes();
    Some([red, green, blue])
}

/// Axes by name; before version 0.3 they had none, and were t, c, z, y, x.
fn axes(named: Option<&Vec<Value>>, rank: usize) -> Result<Vec<Axis>, Refusal> {
    let wrong = |reason: String| Refusal::Wrong(reason);
    let names: Vec<String> = match named {
        Some(axes) => {
            // Version 0.3 had plain names.
            let name = |axis: &Value| {
                axis.as_str()
                    .or(axis["name"].as_str())
                    .map(str::to_lowercase)
            };
            let names: Option<Vec<_>> = axes.iter().map(name).collect();
            names.ok_or_else(|| wrong("an axis has no name".to_owned()))?
        }
        None => {
            let skip = 5_usize.checked_sub(rank);
            let skip = skip.ok_or_else(|| wrong("more than five axes have no names".to_owned()))?;
            ["t", "c", "z", "y", "x"][skip..]
                .iter()
                .map(|name| (*name).to_owned())
                .collect()
        }
    };
    if names.len() != rank {
        let named = names.len();
        return Err(wrong(format!("it has {rank} axes, and {named} have names")));
    }
    let mut axes = Vec::new();
    for name in &names {
        let axis = match name.as_str() {
            "t" => Axis::T,
            "c" => Axis::C,
            "x" => Axis::Space(0),
            "y" => Axis::Space(1),
            "z" => Axis::Space(2),
            _ => {
                return Err(Refusal::Unsupported(format!(
                    "it has an axis {name:?}; t, c, z, y and x are known"
                )));
            }
        };
        if axes.contains(&axis) {
            return Err(wrong(format!("it has two axes {name:?}")));
        }
        axes.push(axis);
    }
    if !(axes.contains(&Axis::Space(0)) && axes.contains(&Axis::Space(1))) {
        let names = names.join(", ");
        return Err(Refusal::Unsupported(format!(
            "it has no axes x and y, which images need, but {names}"
        )));
    }
    Ok(axes)
}

/// Where a list of transformations puts voxels, x, y, z.
struct Way {
    /// Size of one; `None` if that is not said.
    scale: Option<DVec3>,
    /// Middle of the first.
    first: DVec3,
}

/// That of all of them, one after the other. Of an axis that there is not, nothing is done.
fn way(axes: &[Axis], transformations: &Value) -> Result<Way, Refusal> {
    let numbers = |list: &Value, missing: f64| {
        let list = list.as_array().filter(|list| list.len() == axes.len())?;
        let mut numbers = DVec3::splat(missing);
        for (axis, value) in axes.iter().zip(list) {
            if let Axis::Space(axis) = axis {
                numbers[*axis] = value.as_f64()?;
            }
        }
        Some(numbers)
    };
    let (mut scale, mut first) = (None, DVec3::ZERO);
    for one in space::simple(transformations) {
        if one["type"] == "translation" {
            let moved = numbers(&one["translation"], 0.0);
            first += moved.ok_or_else(|| {
                let reason =
                    "a translation has no number for each axis (coordinateTransformations)";
                Refusal::wrong(reason)
            })?;
        } else if one["type"] == "scale" || !one["scale"].is_null() {
            let by = numbers(&one["scale"], 1.0).ok_or_else(|| {
                let reason = "a scale has no number for each axis (coordinateTransformations)";
                Refusal::wrong(reason)
            })?;
            first *= by;
            scale = Some(scale.unwrap_or(DVec3::ONE) * by);
        }
    }
    Ok(Way { scale, first })
}

/// Units of the axes of space.
struct Units {
    /// Nanometres in those of x, y, z; in micrometres where not all are known.
    nm: DVec3,
    /// Their names, different ones once.
    names: Vec<String>,
    /// Whether all are known; z may have none, and has that of x.
    complete: bool,
    /// Names that are not known.
    unknown: Vec<String>,
}

impl Units {
    /// What a user should know of how large voxels are taken to be.
    fn note(&self, says_scale: bool) -> Option<String> {
        let names = self.names.join(", ");
        if !self.unknown.is_empty() {
            let unknown = self.unknown.join(", ");
            return Some(format!(
                "lengths are said in units that are not known: {unknown}; all are taken for micrometers"
            ));
        }
        if !self.complete {
            return Some(
                "the image does not say how large its voxels are; they are taken for 1 micrometer where it does not"
                    .to_owned(),
            );
        }
        let taken =
            "the image does not say how large its voxels are (scale); voxels are taken for 1";
        (!says_scale).then(|| format!("{taken} {names}"))
    }
}

fn units(named: &[Value], axes: &[Axis]) -> Units {
    let mut nm: [Option<f64>; 3] = [None; 3];
    let (mut names, mut unknown) = (Vec::new(), Vec::new());
    for (axis, value) in axes.iter().zip(named) {
        if let (Axis::Space(axis), Some(unit)) = (axis, value["unit"].as_str()) {
            nm[*axis] = nm_per(unit);
            let list = match nm[*axis] {
                Some(_) => &mut names,
                None => &mut unknown,
            };
            let name = match nm[*axis] {
                Some(_) => unit.to_owned(),
                None => format!("{unit:?}"),
            };
            if !list.contains(&name) {
                list.push(name);
            }
        }
    }
    let known = match nm {
        [Some(x), Some(y), z] if unknown.is_empty() => Some(DVec3::new(x, y, z.unwrap_or(x))),
        _ => None,
    };
    Units {
        nm: known.unwrap_or(DVec3::splat(1e3)),
        names,
        complete: known.is_some(),
        unknown,
    }
}

/// Nanometres in a unit of length of the specification.
fn nm_per(unit: &str) -> Option<f64> {
    Some(match unit {
        "yoctometer" => 1e-15,
        "zeptometer" => 1e-12,
        "attometer" => 1e-9,
        "femtometer" => 1e-6,
        "picometer" => 1e-3,
        "angstrom" => 0.1,
        "nanometer" => 1.0,
        "micrometer" | "micron" => 1e3,
        "millimeter" => 1e6,
        "centimeter" => 1e7,
        "inch" => 2.54e7,
        "decimeter" => 1e8,
        "foot" => 3.048e8,
        "yard" => 9.144e8,
        "meter" => 1e9,
        "hectometer" => 1e11,
        "kilometer" => 1e12,
        "mile" => 1.609_344e12,
        "megameter" => 1e15,
        "gigameter" => 1e18,
        "terameter" => 1e21,
        "petameter" => 1e24,
        "parsec" => 3.085_677_581_491_367e25,
        "exameter" => 1e27,
        "zettameter" => 1e30,
        "yottameter" => 1e33,
        _ => return None,
    })
}
