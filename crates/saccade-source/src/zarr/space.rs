//! The space in which an image is shown, and how its levels lie in it.
//!
//! Up to version 0.5 an image has axes, and lists of transformations: those of a level, then those of all. From 0.6 on
//! (RFC-5) it has coordinate systems with names; all levels lie in one of them, which the specification calls
//! intrinsic and says to show. Transformations of the whole image lead from there to others.

use serde_json::Value;

use super::error::Refusal;

/// Deepest sequence of sequences that is looked into.
const DEEPEST: usize = 8;

/// The space in which an image is shown.
pub(super) struct Space<'a> {
    /// Its axes, if they are named.
    pub(super) axes: Option<&'a Vec<Value>>,
    /// What is done to all levels to get there.
    pub(super) of_all: Option<&'a Value>,
    /// What a user should know of it.
    pub(super) notes: Vec<String>,
}

/// That of an image before version 0.6.
pub(super) fn of_axes(multiscale: &Value) -> Result<Space<'_>, Refusal> {
    check_levels(multiscale)?;
    let of_all = &multiscale["coordinateTransformations"];
    check(of_all, "the image")?;
    Ok(Space {
        axes: multiscale["axes"].as_array(),
        of_all: Some(of_all),
        notes: Vec::new(),
    })
}

/// That of an image of version 0.6.
pub(super) fn of_systems<'a>(
    multiscale: &'a Value,
    systems: &'a [Value],
) -> Result<Space<'a>, Refusal> {
    check_levels(multiscale)?;
    let datasets = || multiscale["datasets"].as_array().into_iter().flatten();
    let mut outputs =
        datasets().filter_map(|dataset| end(&dataset["coordinateTransformations"][0]["output"]));
    let Some(intrinsic) = outputs.next() else {
        return Err(Refusal::wrong(
            "its levels do not say in which coordinate system they lie (output)",
        ));
    };
    if let Some(other) = outputs.find(|other| *other != intrinsic) {
        return Err(Refusal::Wrong(format!(
            "its levels lie in different coordinate systems, {intrinsic:?} and {other:?}"
        )));
    }
    let system = |name: &str| {
        let system = systems.iter().find(|system| system["name"] == name)?;
        system["axes"].as_array()
    };
    let Some(axes) = system(intrinsic) else {
        return Err(Refusal::Wrong(format!(
            "its levels lie in the coordinate system {intrinsic:?}, of which it names no axes"
        )));
    };
    let ways = multiscale["coordinateTransformations"].as_array();
    let ways = || ways.into_iter().flatten();
    // An intrinsic system may be one of voxels, whose axes mean nothing: then the first that is simply reached.
    let of_voxels = |axes: &[Value]| axes.iter().all(|axis| axis["type"] == "array");
    let (mut shown, mut of_all) = ((intrinsic, axes), None);
    if of_voxels(axes) {
        let reached = ways().find_map(|way| {
            let to = end(&way["output"])?;
            let axes = system(to).filter(|axes| !of_voxels(axes))?;
            let simple = end(&way["input"]) == Some(intrinsic) && is_simple(way);
            simple.then_some(((to, axes), way))
        });
        let Some((space, way)) = reached else {
            return Err(Refusal::Unsupported(format!(
                "its levels lie in the coordinate system {intrinsic:?}, whose axes mean nothing (array), and no scale or \
                 translation leads from there to one of x, y and z"
            )));
        };
        (shown, of_all) = (space, Some(way));
    }
    let (name, axes) = shown;
    let others = ways().filter(|way| end(&way["output"]) != Some(name));
    let others = others.map(|way| {
        let kinds = kinds(way).join(", ");
        format!("{:?} ({kinds})", end(&way["output"]).unwrap_or_default())
    });
    let others: Vec<String> = others.take(5).collect();
    let notes = if others.is_empty() {
        Vec::new()
    } else {
        let others = others.join(", ");
        vec![format!(
            "it is shown in its coordinate system {name:?}; what leads to others is not applied: {others}"
        )]
    };
    Ok(Space {
        axes: Some(axes),
        of_all,
        notes,
    })
}

/// The coordinate system or array at an end of a transformation: an object in version 0.6, a text in drafts of it.
fn end(value: &Value) -> Option<&str> {
    let named = value.as_str().or(value["name"].as_str());
    named.or_else(|| value["path"].as_str())
}

fn check_levels(multiscale: &Value) -> Result<(), Refusal> {
    let datasets = multiscale["datasets"].as_array();
    for dataset in datasets.into_iter().flatten() {
        let path = dataset["path"].as_str().unwrap_or_default();
        check(
            &dataset["coordinateTransformations"],
            &format!("its level {path:?}"),
        )?;
    }
    Ok(())
}

/// Refuses what would put voxels elsewhere than on a grid along the axes.
fn check(transformations: &Value, what: &str) -> Result<(), Refusal> {
    for transformation in list(transformations) {
        if !is_simple(transformation) {
            let kinds = kinds(transformation).join(", ");
            return Err(Refusal::Unsupported(format!(
                "{what} is placed by a transformation that is not supported ({kinds}); scale, translation and identity are"
            )));
        }
    }
    Ok(())
}

/// Whether a list of transformations leaves everything where it is, and says so.
pub(super) fn stays(transformations: &Value) -> bool {
    let mut simple = simple(transformations).peekable();
    simple.peek().is_some() && simple.all(|one| one["type"] == "identity")
}

/// Those of a list, or one alone, without the sequences that they are in.
pub(super) fn simple(transformations: &Value) -> impl Iterator<Item = &Value> {
    let mut found = Vec::new();
    for transformation in list(transformations) {
        collect(transformation, DEEPEST, &mut found);
    }
    found.into_iter()
}

/// Transformations, of which there may be one alone.
fn list(transformations: &Value) -> impl Iterator<Item = &Value> {
    let alone = transformations.is_object().then_some(transformations);
    let list = transformations.as_array().into_iter().flatten();
    alone.into_iter().chain(list)
}

fn collect<'a>(transformation: &'a Value, deepest: usize, found: &mut Vec<&'a Value>) {
    match transformation["transformations"].as_array() {
        Some(sequence) if transformation["type"] == "sequence" && deepest > 0 => {
            for one in sequence {
                collect(one, deepest - 1, found);
            }
        }
        _ => found.push(transformation),
    }
}

fn is_simple(transformation: &Value) -> bool {
    let simple = |one: &Value| match one["type"].as_str() {
        Some(kind) => matches!(kind, "scale" | "translation" | "identity"),
        // Nothing is said, and nothing known: as before there were transformations.
        None => true,
    };
    self::simple(transformation).all(simple)
}

/// Names of what a transformation is made of.
fn kinds(transformation: &Value) -> Vec<&str> {
    let mut kinds: Vec<&str> = Vec::new();
    for part in simple(transformation) {
        let kind = part["type"].as_str().unwrap_or("of no type");
        if !kinds.contains(&kind) {
            kinds.push(kind);
        }
    }
    kinds
}
