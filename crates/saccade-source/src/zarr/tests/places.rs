//! Levels that lie elsewhere than where the finest begins.

use glam::IVec3;
use tempfile::TempDir;

use super::*;

/// Micrometres of a voxel of level 1 \[x, y, z\]; of the finest half of that along x and y.
const COARSE: DVec3 = DVec3::new(0.5, 0.5, 2.0);
const FINE: DVec3 = DVec3::new(0.25, 0.25, 2.0);

fn scale(xyz: DVec3) -> Value {
    json!({"type": "scale", "scale": [xyz.z, xyz.y, xyz.x]})
}

fn moved(xyz: DVec3) -> Value {
    json!({"type": "translation", "translation": [xyz.z, xyz.y, xyz.x]})
}

/// An image whose levels are placed by these.
fn placed(levels: [Value; 2]) -> (TempDir, Result<ZarrSource, String>) {
    let folder = tempfile::tempdir().unwrap();
    let mut attributes = attributes("zyx", 2);
    for (level, ways) in levels.into_iter().enumerate() {
        attributes["multiscales"][0]["datasets"][level]["coordinateTransformations"] = ways;
    }
    write_image(folder.path(), "zyx", "uint8", Version::V3);
    write_attributes(folder.path(), Version::V3, &attributes);
    let source = open(folder.path());
    let source = source.map_err(|error| std::error::Error::source(&error).unwrap().to_string());
    (folder, source)
}

/// A chunk of an image whose level 1 begins `begin` of its voxels from the finest.
fn moved_chunk(volume: &Volume, id: ChunkId, begin: IVec3) -> Vec<u8> {
    let begin = if id.level == 0 { IVec3::ZERO } else { begin };
    let min = id.chunk * volume.chunk;
    let of_level = volume.levels[id.level as usize].extent;
    let value = |at: UVec3| {
        let own = at.as_ivec3() - begin;
        let stored = own.cmpge(IVec3::ZERO).all() && own.as_uvec3().cmplt(extent(id.level)).all();
        match stored && at.cmplt(of_level).all() {
            true => value(0, id.level, own.as_uvec3()),
            false => 0,
        }
    };
    let voxels = VoxelBox::new(min, min + volume.chunk).iter();
    voxels.map(|at| u8::try_from(value(at)).unwrap()).collect()
}

#[track_caller]
fn check(levels: [Value; 2], begin: [i32; 3]) {
    let (_folder, source) = placed(levels);
    let (source, begin) = (source.unwrap(), IVec3::from(begin));
    let volume = source.volume().clone();
    assert_eq!(volume.extent(), EXTENT);
    assert_eq!(volume.voxel_nm, FINE * 1e3);
    assert_eq!(volume.levels[1].downsampling, DVec3::new(2.0, 2.0, 1.0));
    assert_eq!(volume.levels[1].extent, UVec3::new(42, 21, 9));
    let oracle = |id| moved_chunk(&volume, id, begin);
    runtime()
        .block_on(check_reading(&source, oracle, 0))
        .unwrap();
    let wrong = |id| moved_chunk(&volume, id, begin + IVec3::X);
    let checked = runtime().block_on(check_reading(&source, wrong, 0));
    assert!(checked.is_err(), "a voxel further is somewhere else");
    let note = source.notes().join(" ");
    assert_eq!(
        note.contains("\"s1\" begins"),
        begin != IVec3::ZERO,
        "{note}"
    );
}

/// The middle of the first coarse voxel, from that of the first fine one, where both begin together.
const TOGETHER: DVec3 = DVec3::new(0.125, 0.125, 0.0);

#[test]
fn levels_are_where_their_translations_say() {
    for begin in [[3, -2, 0], [-5, 0, 4], [0, 20, -8], [41, 0, 0]] {
        let by = TOGETHER + IVec3::from(begin).as_dvec3() * COARSE;
        check(
            [json!([scale(FINE)]), json!([scale(COARSE), moved(by)])],
            begin,
        );
        // The image may lie anywhere itself.
        let at = DVec3::new(1000.0, -77.5, 8.0);
        check(
            [
                json!([scale(FINE), moved(at)]),
                json!([scale(COARSE), moved(at + by)]),
            ],
            begin,
        );
    }
}

/// The place of the whole is that of its finest level, after what is done to all levels.
#[test]
fn where_the_whole_lies_is_kept() {
    let at = DVec3::new(1000.0, -77.5, 8.0);
    let levels = [
        json!([scale(FINE), moved(at)]),
        json!([scale(COARSE), moved(at + TOGETHER)]),
    ];
    let (folder, source) = placed(levels.clone());
    let origin = source.unwrap().volume().origin_nm;
    assert_eq!(origin, at * 1e3);
    let mut of_all = attributes("zyx", 2);
    for (level, ways) in levels.into_iter().enumerate() {
        of_all["multiscales"][0]["datasets"][level]["coordinateTransformations"] = ways;
    }
    let (by, further) = (DVec3::new(2.0, 2.0, 3.0), DVec3::new(0.5, 0.0, -1.0));
    of_all["multiscales"][0]["coordinateTransformations"] = json!([scale(by), moved(further)]);
    write_attributes(folder.path(), Version::V3, &of_all);
    let source = open(folder.path()).unwrap();
    assert_eq!(source.volume().origin_nm, (at * by + further) * 1e3);
    assert_eq!(source.volume().voxel_nm, FINE * by * 1e3);
    assert_eq!(source.volume().shifts_nm, Vec::new());
    let (_, still) = placed([json!([scale(FINE)]), json!([scale(COARSE)])]);
    assert_eq!(still.unwrap().volume().origin_nm, DVec3::ZERO);
}

/// A level may lie a part of a voxel from where its voxels are put: that is said as it was.
#[test]
fn what_a_level_is_off_is_kept() {
    for by in [
        DVec3::ZERO,
        TOGETHER,
        TOGETHER * 2.0,
        TOGETHER + DVec3::new(1.0, -0.5, 2.0),
        TOGETHER + DVec3::splat(0.4),
    ] {
        let (_folder, source) = placed([json!([scale(FINE)]), json!([scale(COARSE), moved(by)])]);
        let source = source.unwrap();
        let volume = source.volume();
        let said = crate::ome::placed(volume)[1].first_nm;
        // Voxels that are elsewhere are moved in whole ones.
        let whole = ((by - TOGETHER) / COARSE).round() * COARSE;
        let whole = DVec3::select(
            ((by - TOGETHER) / COARSE).abs().cmpgt(DVec3::splat(0.501)),
            whole,
            DVec3::ZERO,
        );
        let off = (said - (by - whole) * 1e3).abs().max_element();
        assert!(off < 1e-6, "{by}: {said}");
    }
}

#[test]
fn a_version_that_is_not_known_is_told() {
    for (version, told) in [
        ("0.5", false),
        ("0.6.dev3", false),
        ("0.6-dev1", false),
        ("0.9", true),
        ("0.41", true),
        ("1.0", true),
    ] {
        let (folder, _) = placed([json!([scale(FINE)]), json!([scale(COARSE)])]);
        let mut said = attributes("zyx", 2);
        said["version"] = version.into();
        write_attributes(folder.path(), Version::V3, &said);
        let notes = open(folder.path()).unwrap().notes().join(" ");
        assert_eq!(
            notes.contains(&format!("version {version:?} of OME-Zarr")),
            told,
            "{version}: {notes}"
        );
    }
}

#[test]
fn half_a_voxel_is_what_writers_mean_otherwise() {
    for by in [DVec3::ZERO, TOGETHER, TOGETHER * 2.0, TOGETHER * 3.0] {
        check(
            [json!([scale(FINE)]), json!([scale(COARSE), moved(by)])],
            [0; 3],
        );
    }
}

/// Of version 0.6: what comes first in a sequence is done first.
#[test]
fn translations_before_a_scale_are_scaled() {
    let begin = [4, 1, -3];
    let by = TOGETHER / COARSE + IVec3::from(begin).as_dvec3();
    let half = COARSE / 2.0;
    check(
        [
            json!([scale(FINE)]),
            json!([{"type": "sequence", "transformations": [moved(by), scale(DVec3::splat(2.0)), scale(half)]}]),
        ],
        begin,
    );
}

#[test]
fn a_level_that_has_nothing_of_the_finest_is_refused() {
    for begin in [[42, 0, 0], [0, -21, 0], [0, 0, 9], [0, 0, 2_000_000_000]] {
        let by = TOGETHER + IVec3::from(begin).as_dvec3() * COARSE;
        let (_, opened) = placed([json!([scale(FINE)]), json!([scale(COARSE), moved(by)])]);
        let refused = opened.unwrap_err();
        assert!(
            refused.contains("\"s1\" lies elsewhere"),
            "{begin:?}: {refused}"
        );
    }
    for bad in [json!([1.0, 2.0]), json!(["a", 0, 0]), json!(7)] {
        let bad = json!({"type": "translation", "translation": bad});
        let (_, opened) = placed([json!([scale(FINE)]), json!([scale(COARSE), bad])]);
        assert!(opened.unwrap_err().contains("number for each axis"));
    }
}
