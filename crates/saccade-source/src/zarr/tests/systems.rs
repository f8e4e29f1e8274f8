//! Images of version 0.6, after the examples of its specification (`multiscales_strict`, `scene`, array coordinate systems).

use serde_json::json;

use super::*;

fn system(name: &str, kind: &str, unit: Option<&str>, names: [&str; 3]) -> Value {
    let axis = |name: &str| match unit {
        Some(unit) => json!({"name": name, "type": kind, "unit": unit}),
        None => json!({"name": name, "type": kind}),
    };
    json!({"name": name, "axes": names.map(axis)})
}

/// Levels of 0.25 x 0.25 x 2 and of 0.5 x 0.5 x 2, the second a sequence, in `intrinsic`, which is not the first.
fn example() -> Value {
    json!({"version": "0.6", "multiscales": [{
        "name": "example",
        "coordinateSystems": [
            system("world", "space", Some("millimeter"), ["z", "y", "x"]),
            system("intrinsic", "space", Some("micrometer"), ["z", "y", "x"]),
        ],
        "datasets": [
            {"path": "s0", "coordinateTransformations": [
                {"type": "scale", "scale": [2.0, 0.25, 0.25], "input": {"path": "s0"}, "output": {"name": "intrinsic"}}]},
            {"path": "s1", "coordinateTransformations": [
                {"type": "sequence", "input": {"path": "s1"}, "output": {"name": "intrinsic"}, "transformations": [
                    {"type": "scale", "scale": [2.0, 0.5, 0.5]},
                    {"type": "translation", "translation": [0.0, 0.125, 0.125]}]}]},
        ],
    }]})
}

fn written(folder: &Path, attributes: &Value) {
    write_image(folder, "zyx", "uint8", Version::V3);
    write_attributes(folder, Version::V3, attributes);
}

fn opened(attributes: &Value) -> Result<ZarrSource, String> {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path(), attributes);
    open(folder.path()).map_err(|error| std::error::Error::source(&error).unwrap().to_string())
}

fn edited(path: &str, value: Value) -> Value {
    let mut attributes = example();
    let (parent, name) = path.rsplit_once('/').unwrap();
    attributes.pointer_mut(parent).unwrap()[name] = value;
    attributes
}

#[test]
fn levels_lie_in_the_system_that_they_name() {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path(), &example());
    let source = open(folder.path()).unwrap();
    let volume = source.volume().clone();
    assert_eq!(volume.voxel_nm, DVec3::new(250.0, 250.0, 2000.0));
    assert_eq!(volume.levels[1].downsampling, DVec3::new(2.0, 2.0, 1.0));
    assert!(source.notes().is_empty(), "{:?}", source.notes());
    runtime()
        .block_on(check_reading(
            &source,
            |id| expected(&volume, id, true, false),
            0,
        ))
        .unwrap();
    // Drafts name ends by texts.
    let text = example().to_string();
    let text = text.replace(r#"{"name":"intrinsic"}"#, r#""intrinsic""#);
    let text = text.replace(r#"{"path":"s0"}"#, r#""s0""#);
    let draft: Value = serde_json::from_str(&text.replace("\"0.6\"", "\"0.6.dev3\"")).unwrap();
    assert!(draft != example());
    let source = opened(&draft).unwrap();
    assert_eq!(source.volume().voxel_nm, volume.voxel_nm);
}

/// What leads on to others, be it simple or not, is told and changes nothing.
#[test]
fn other_systems_are_told() {
    for (way, kind) in [
        (
            json!({"type": "scale", "scale": [10.0, 10.0, 10.0]}),
            "scale",
        ),
        (
            json!({"type": "affine", "affine": [[1, 0, 0, 5], [0, 1, 0, 5], [0, 0, 1, 5]]}),
            "affine",
        ),
        (
            json!({"type": "displacements", "path": "field"}),
            "displacements",
        ),
    ] {
        let mut way = way;
        way["input"] = json!({"name": "intrinsic"});
        way["output"] = json!({"name": "world"});
        let source = opened(&edited(
            "/multiscales/0/coordinateTransformations",
            json!([way]),
        ))
        .unwrap();
        assert_eq!(
            source.volume().voxel_nm,
            DVec3::new(250.0, 250.0, 2000.0),
            "{kind}"
        );
        let note = source.notes().join(" ");
        assert!(
            note.contains("\"intrinsic\"") && note.contains("\"world\""),
            "{note}"
        );
        assert!(note.contains(kind), "{note}");
    }
}

/// Levels in voxels of the finest, and a scale from there to micrometres.
#[test]
fn a_system_of_voxels_is_left_by_a_scale() {
    let mut attributes = example();
    let names = ["dim_0", "dim_1", "dim_2"];
    attributes["multiscales"][0]["coordinateSystems"][1] =
        system("intrinsic", "array", None, names);
    let placed = "/multiscales/0/datasets/0/coordinateTransformations/0";
    *attributes.pointer_mut(placed).unwrap() =
        json!({"type": "identity", "input": {"path": "s0"}, "output": {"name": "intrinsic"}});
    let sequence = "/multiscales/0/datasets/1/coordinateTransformations/0/transformations/0/scale";
    *attributes.pointer_mut(sequence).unwrap() = json!([1.0, 2.0, 2.0]);
    let refused = opened(&attributes).unwrap_err();
    assert!(
        refused.contains("\"intrinsic\"") && refused.contains("array"),
        "{refused}"
    );
    let scale = json!([2e-3, 0.25e-3, 0.25e-3]);
    let way = json!({"type": "scale", "scale": scale, "input": {"name": "intrinsic"}, "output": {"name": "world"}});
    attributes["multiscales"][0]["coordinateTransformations"] = json!([way]);
    let source = opened(&attributes).unwrap();
    let volume = source.volume();
    assert!(
        volume
            .voxel_nm
            .abs_diff_eq(DVec3::new(250.0, 250.0, 2000.0), 1e-6),
        "{}",
        volume.voxel_nm
    );
    assert_eq!(volume.levels[1].downsampling, DVec3::new(2.0, 2.0, 1.0));
    assert!(source.notes().is_empty(), "{:?}", source.notes());
}

#[test]
fn what_bends_a_level_is_refused_by_name() {
    let placed = "/multiscales/0/datasets/1/coordinateTransformations";
    let ends = json!({"input": {"path": "s1"}, "output": {"name": "intrinsic"}});
    let with_ends = |mut way: Value| {
        way["input"] = ends["input"].clone();
        way["output"] = ends["output"].clone();
        json!([way])
    };
    for (way, words) in [
        (
            json!({"type": "affine", "affine": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}),
            "affine",
        ),
        (
            json!({"type": "rotation", "rotation": [[0, -1], [1, 0]]}),
            "rotation",
        ),
        (
            json!({"type": "displacements", "path": "field"}),
            "displacements",
        ),
        (json!({"type": "mapAxis", "mapAxis": [0, 2, 1]}), "mapAxis"),
        (
            json!({"type": "byDimension", "transformations": [{"transformation": {"type": "scale", "scale": [1.0]},
            "inputAxes": [0], "outputAxes": [0]}]}),
            "byDimension",
        ),
        (
            json!({"type": "sequence", "transformations": [{"type": "scale", "scale": [2.0, 0.5, 0.5]},
            {"type": "affine", "path": "matrix"}]}),
            "affine",
        ),
    ] {
        let refused = opened(&edited(placed, with_ends(way.clone()))).unwrap_err();
        assert!(
            refused.contains(words) && refused.contains("\"s1\""),
            "{refused}"
        );
        // Before version 0.6 as well, of a level or of all.
        for path in [
            "/multiscales/0/datasets/1/coordinateTransformations",
            "/multiscales/0/coordinateTransformations",
        ] {
            let mut old = attributes("zyx", 2);
            let (parent, name) = path.rsplit_once('/').unwrap();
            old.pointer_mut(parent).unwrap()[name] = json!([way.clone()]);
            let refused = opened(&old).unwrap_err();
            assert!(refused.contains(words), "{refused}");
        }
    }
    let mut depths = json!({"type": "affine"});
    for _ in 0..50 {
        depths = json!({"type": "sequence", "transformations": [depths]});
    }
    assert!(opened(&edited(placed, with_ends(depths))).is_err());
}

#[test]
fn systems_that_make_no_sense_are_refused() {
    for (path, value, words) in [
        (
            "/multiscales/0/coordinateSystems",
            json!([]),
            "names no axes",
        ),
        (
            "/multiscales/0/coordinateSystems/1/name",
            json!("other"),
            "\"intrinsic\"",
        ),
        (
            "/multiscales/0/coordinateSystems/1/axes",
            json!({"z": {}}),
            "names no axes",
        ),
        (
            "/multiscales/0/datasets/1/coordinateTransformations/0/output/name",
            json!("world"),
            "different",
        ),
        (
            "/multiscales/0/coordinateSystems/1/axes/0/name",
            json!("q"),
            "axis \"q\"",
        ),
    ] {
        let refused = opened(&edited(path, value)).err().unwrap_or_default();
        assert!(refused.contains(words), "{path}: {refused}");
    }
    let mut nowhere = example();
    for level in 0..2 {
        nowhere["multiscales"][0]["datasets"][level]["coordinateTransformations"] = json!([]);
    }
    assert!(opened(&nowhere).unwrap_err().contains("output"));
    let scene = json!({"version": "0.6", "scene": {"coordinateTransformations": [
        {"type": "translation", "translation": [0, 8, 8], "input": {"path": "tile_1", "name": "physical"},
            "output": {"path": "tile_0", "name": "physical"}}]}});
    assert!(
        opened(&scene)
            .unwrap_err()
            .contains("SCENE/NAME: tile_0, tile_1")
    );
}
