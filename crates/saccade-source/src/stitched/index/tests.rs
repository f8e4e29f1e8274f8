use std::collections::BTreeMap;

use glam::{DVec2, DVec3, UVec2, UVec3};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestError, TestRng, TestRunner};
use saccade_archive::catalog::{Catalog, NewTile, Tile, TileId};
use saccade_core::transform::{SectionFromTile, SectionPoint};
use saccade_core::volume::Volume;

use super::{SectionIndex, TileIndex, TileUpdate, runs};
use crate::stitched::along_z::{AlongZ, Gaps, Reaches};

/// Where nothing is filled and no level is coarse.
const OWN: Reaches<'_> = Reaches {
    along_z: AlongZ::Nearest,
    gaps: Gaps::Empty,
    levels: &[],
};

fn tile(n: u32, size: UVec2, turn: f64, corner: DVec2) -> Tile {
    Tile {
        id: TileId(n.into()),
        name: format!("section0003_tile{n:06}"),
        section: 3,
        channel: 0,
        size,
        transform: SectionFromTile::rotated(size.as_dvec2(), turn, corner),
        pyramid: format!("tiles/section0003/section0003_tile{n:06}-0123456789abcdef.tif"),
        revision: 1,
        position: 0,
    }
}

/// Size, turn and corner.
type Place = (u32, u32, f64, f64, f64);

fn place() -> impl Strategy<Value = Place> {
    (
        1..300_u32,
        1..300_u32,
        -3.0..3.0,
        -900.0..900.0,
        -900.0..900.0,
    )
}

fn placed(n: u32, (w, h, turn, x, y): Place) -> Tile {
    tile(n, UVec2::new(w, h), turn, DVec2::new(x, y))
}

/// A rectangle, as corner and size.
fn rectangles() -> impl Strategy<Value = Vec<(f64, f64, f64, f64)>> {
    let one = (-1000.0..1000.0, -1000.0..1000.0, 0.0..500.0, 0.0..500.0);
    prop::collection::vec(one, 1..6)
}

/// What a search through all tiles finds.
fn search<'t>(tiles: impl Iterator<Item = &'t Tile>, min: DVec2, max: DVec2) -> Vec<TileId> {
    let touching = tiles.filter(|tile| {
        let (low, high) = tile.transform.bounds(tile.size.as_dvec2());
        low.0.x <= max.x && low.0.y <= max.y && high.0.x >= min.x && high.0.y >= min.y
    });
    let mut ids: Vec<_> = touching.map(|tile| tile.id).collect();
    ids.sort_unstable();
    ids
}

fn same(
    index: &SectionIndex,
    tiles: &BTreeMap<TileId, Tile>,
    rectangles: &[(f64, f64, f64, f64)],
) -> Result<(), TestCaseError> {
    prop_assert_eq!(index.tiles(), tiles.len());
    for (x, y, w, h) in rectangles {
        let (min, max) = (DVec2::new(*x, *y), DVec2::new(x + w, y + h));
        let found = index.touching(SectionPoint(min), SectionPoint(max));
        prop_assert_eq!(found, search(tiles.values(), min, max));
    }
    Ok(())
}

#[derive(Clone, Debug)]
enum Step {
    /// New, moved or imaged again with another size.
    Put(u32, Place),
    /// News that came late.
    Late(u32, Place),
    Remove(u32),
}

fn steps() -> impl Strategy<Value = Vec<Vec<Step>>> {
    let id = || 0..300_u32;
    let step = prop_oneof![
        6 => (id(), place()).prop_map(|(n, place)| Step::Put(n, place)),
        1 => (id(), place()).prop_map(|(n, place)| Step::Late(n, place)),
        3 => id().prop_map(Step::Remove),
    ];
    prop::collection::vec(prop::collection::vec(step, 1..40), 1..12)
}

proptest! {
    #[test]
    fn finds_what_a_search_through_all_finds(
        places in prop::collection::vec(place(), 0..400),
        rectangles in rectangles(),
    ) {
        let tiles: Vec<_> = (0..).zip(places).map(|(n, place)| placed(n, place)).collect();
        let index = SectionIndex::new(&tiles);
        let tiles = tiles.into_iter().map(|tile| (tile.id, tile)).collect();
        same(&index, &tiles, &rectangles)?;
    }

    #[test]
    fn updated_is_like_new(
        places in prop::collection::vec(place(), 0..300),
        steps in steps(),
        rectangles in rectangles(),
    ) {
        update(Wrong::Nothing, places, steps, &rectangles)?;
    }
}

/// What a wrong index does not hear of.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Wrong {
    Nothing,
    /// A tile of a batch is taken away.
    Removal,
    /// A tile of a batch comes.
    New,
    /// A tile of a batch is another than it was.
    Changed,
    /// It holds what is old for new.
    Late,
}

fn update(
    wrong: Wrong,
    places: Vec<Place>,
    steps: Vec<Vec<Step>>,
    rectangles: &[(f64, f64, f64, f64)],
) -> Result<(), TestCaseError> {
    let first: Vec<_> = (0..)
        .zip(places)
        .map(|(n, place)| placed(n, place))
        .collect();
    let mut index = SectionIndex::new(&first);
    let mut tiles: BTreeMap<_, _> = first.into_iter().map(|tile| (tile.id, tile)).collect();
    let mut revision = 1;
    for batch in steps {
        let before = (index.clone(), tiles.clone());
        let mut news = Vec::new();
        let mut unheard = None;
        for step in batch {
            revision += 1;
            let kind = match step {
                Step::Put(n, place) => {
                    let tile = Tile {
                        revision,
                        ..placed(n, place)
                    };
                    let known = tiles.insert(tile.id, tile.clone());
                    news.push(Ok(tile));
                    match known {
                        None => Wrong::New,
                        Some(_) => Wrong::Changed,
                    }
                }
                Step::Late(n, place) => {
                    let revision = match wrong {
                        Wrong::Late => revision,
                        _ => 0,
                    };
                    let tile = Tile {
                        revision,
                        ..placed(n, place)
                    };
                    if !tiles.contains_key(&tile.id) {
                        continue;
                    }
                    news.push(Ok(tile));
                    Wrong::Nothing
                }
                Step::Remove(n) => {
                    let known = tiles.remove(&TileId(n.into()));
                    news.push(Err(TileId(n.into())));
                    match known {
                        None => Wrong::Nothing,
                        Some(_) => Wrong::Removal,
                    }
                }
            };
            if kind == wrong && wrong != Wrong::Nothing {
                unheard = Some(news.len() - 1);
            }
        }
        if let Some(unheard) = unheard {
            drop(news.remove(unheard));
        }
        let updates = news.iter().map(|news| match news {
            Ok(tile) => TileUpdate::Put(tile),
            Err(id) => TileUpdate::Remove(*id),
        });
        index = index.updated(updates);
        same(&index, &tiles, rectangles)?;
        same(&before.0, &before.1, rectangles)?;
        prop_assert!(index.hidden.len() + index.recent.len() <= index.most_changes());
    }
    Ok(())
}

/// Negative controls: of news that an index does not hear of, or takes for new, the comparison tells.
#[test]
fn what_is_not_updated_is_found() {
    for wrong in [Wrong::Removal, Wrong::New, Wrong::Changed, Wrong::Late] {
        let config = Config {
            max_shrink_iters: 0,
            failure_persistence: None,
            ..Config::default()
        };
        let rng = TestRng::deterministic_rng(config.rng_algorithm);
        let mut runner = TestRunner::new_with_rng(config, rng);
        let cases = (
            prop::collection::vec(place(), 0..300),
            steps(),
            rectangles(),
        );
        let found = runner.run(&cases, |(places, steps, rectangles)| {
            update(wrong, places, steps, &rectangles)
        });
        assert!(matches!(found, Err(TestError::Fail(..))), "{wrong:?}");
    }
}

#[test]
fn a_tile_takes_few_bytes() {
    for side in [10, 108] {
        let grid = (0..side).flat_map(|y| (0..side).map(move |x| (x, y)));
        let place = |(x, y): (u32, u32)| {
            let corner = DVec2::new(f64::from(x), f64::from(y)) * 11_000.0;
            tile(y * side + x, UVec2::splat(12_000), 0.02, corner)
        };
        let tiles: Vec<_> = grid.map(place).collect();
        let bytes = SectionIndex::new(&tiles).bytes() / tiles.len();
        assert!(bytes < 400, "{bytes} bytes per tile");
        // Also while it grows tile by tile.
        let grown = tiles
            .chunks(7)
            .fold(SectionIndex::new(&[]), |index, tiles| {
                index.updated(tiles.iter().map(TileUpdate::Put))
            });
        let bytes = grown.bytes() / tiles.len();
        assert!(bytes < 400, "{bytes} bytes per tile");
    }
}

#[test]
fn one_tile_far_out_costs_nothing() {
    let near = (0..50).map(|n| tile(n, UVec2::splat(100), 0.0, DVec2::splat(f64::from(n) * 90.0)));
    let far = tile(50, UVec2::splat(100), 0.0, DVec2::splat(1e15));
    let tiles: Vec<_> = near.chain([far]).collect();
    assert!(SectionIndex::new(&tiles).bytes() / tiles.len() < 400);
}

/// A catalog, and a name of a volume in it.
async fn catalog(folder: &tempfile::TempDir) -> Catalog {
    with_channels(folder, &["intensity"]).await
}

async fn with_channels(folder: &tempfile::TempDir, channels: &[&str]) -> Catalog {
    let catalog = Catalog::create(&folder.path().join("catalog.sqlite"))
        .await
        .unwrap();
    let mut volume =
        Volume::new("v", UVec3::new(2000, 2000, 9), DVec3::new(4.0, 4.0, 40.0)).unwrap();
    volume.channels = channels.iter().map(|name| (*name).into()).collect();
    catalog.create_volume(&volume).await.unwrap();
    catalog
}

fn new_tile(name: &str, section: u32, corner: f64, position: u64) -> NewTile {
    NewTile {
        name: name.into(),
        section,
        channel: 0,
        size: UVec2::new(300, 200),
        transform: SectionFromTile::rotated(DVec2::new(300.0, 200.0), 0.1, DVec2::splat(corner)),
        pyramid: format!("tiles/{name}-{position}.tif"),
        position,
    }
}

const ALL: (SectionPoint, SectionPoint) = (
    SectionPoint(DVec2::splat(f64::NEG_INFINITY)),
    SectionPoint(DVec2::splat(f64::INFINITY)),
);

/// Tiles of each section, as two indices have them.
async fn compare(kept: &TileIndex, catalog: &Catalog) {
    let fresh = TileIndex::open(catalog, "v", u64::MAX).await.unwrap();
    for z in 0..9 {
        let (kept, fresh) = (
            kept.section(z).await.unwrap(),
            fresh.section(z).await.unwrap(),
        );
        let of = |index: &SectionIndex| {
            let near = index.near(0, ALL.0.0, ALL.1.0);
            let facts = near
                .iter()
                .map(|t| (t.id, t.revision, t.centre, t.pyramid.clone()));
            facts.collect::<Vec<_>>()
        };
        assert_eq!(of(&kept), of(&fresh), "section {z}");
    }
}

#[tokio::test]
async fn follows_the_catalog() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = catalog(&folder).await;
    for n in 0..6 {
        let tile = new_tile(&format!("t{n}"), n % 3, 100.0 * f64::from(n), u64::from(n));
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    let index = TileIndex::open(&catalog, "v", u64::MAX).await.unwrap();
    assert_eq!(index.acquired(0, 0..9), [0, 1, 2]);
    assert_eq!(
        (index.tiles(), index.any_acquired(0, 3..9)),
        (0, false),
        "nothing is loaded"
    );
    let held = index.section(1).await.unwrap();
    let mut seen = catalog.revision("v").await.unwrap();
    let moved = SectionFromTile::translation(DVec2::splat(700.0));
    for step in 0..8 {
        match step {
            // Imaged again, in place and in another section that is loaded, or not, or new.
            0 => drop(
                catalog
                    .commit_tile("v", &new_tile("t1", 1, 130.0, 20))
                    .await
                    .unwrap(),
            ),
            1 => drop(
                catalog
                    .commit_tile("v", &new_tile("t4", 2, 0.0, 21))
                    .await
                    .unwrap(),
            ),
            2 => drop(
                catalog
                    .commit_tile("v", &new_tile("t2", 1, 5.0, 22))
                    .await
                    .unwrap(),
            ),
            3 => drop(
                catalog
                    .commit_tile("v", &new_tile("t3", 7, 5.0, 23))
                    .await
                    .unwrap(),
            ),
            // Moved, near and far; a new one.
            4 => drop(catalog.set_transform("v", "t1", moved).await.unwrap()),
            5 => drop(catalog.set_transform("v", "t5", moved).await.unwrap()),
            6 => drop(
                catalog
                    .commit_tile("v", &new_tile("t0", 8, 5.0, 24))
                    .await
                    .unwrap(),
            ),
            _ => drop(
                catalog
                    .commit_tile("v", &new_tile("t9", 1, 900.0, 25))
                    .await
                    .unwrap(),
            ),
        }
        let changes = catalog.changes_after("v", seen).await.unwrap();
        assert!(!changes.is_empty(), "step {step} changes something");
        index.apply(&changes, &OWN).await.unwrap();
        seen = changes[changes.len() - 1].revision;
        compare(&index, &catalog).await;
    }
    assert_eq!(
        index.acquired(0, 0..9),
        [1, 2, 7, 8],
        "section 0 has lost its tiles"
    );
    assert_eq!(held.tiles(), 2, "whoever holds an index keeps it");
    assert!(index.bytes() > 200 * index.tiles(), "the tiles count");
}

/// Which sections have tiles of a channel follows tiles that come, change their channel or section, and go; and where each
/// change is seen is told: no more of the gaps around it than it fills, of what only moves those of its channel.
#[tokio::test]
async fn sections_count_by_channel() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = with_channels(&folder, &["a", "b", "c"]).await;
    let new = |name: &str, section, channel, position| NewTile {
        channel,
        ..new_tile(name, section, 20.0, position)
    };
    for section in 0..9 {
        let tile = new(&format!("a{section}"), section, 0, 1);
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    for section in [0, 3] {
        let tile = new(&format!("b{section}"), section, 1, 1);
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    let index = TileIndex::open(&catalog, "v", u64::MAX).await.unwrap();
    let reaches = Reaches {
        gaps: Gaps::Nearest(3),
        ..OWN
    };
    let of = |index: &TileIndex| [0, 1, 2].map(|channel| index.acquired(channel, 0..9));
    let every: Vec<u32> = (0..9).collect();
    assert_eq!(of(&index), [every.clone(), vec![0, 3], vec![]]);
    let moved = SectionFromTile::translation(DVec2::splat(700.0));
    let mut seen = catalog.revision("v").await.unwrap();
    for step in 0..8 {
        let (b, c, reached) = match step {
            // A gap of two is filled on both sides, one of four is not.
            0 => {
                let tile = new("b8", 8, 1, 2);
                catalog.commit_tile("v", &tile).await.unwrap();
                (vec![0, 3, 8], vec![], vec![(8..9, false)])
            }
            1 => {
                let tile = new("b7", 7, 1, 3);
                catalog.commit_tile("v", &tile).await.unwrap();
                (vec![0, 3, 7, 8], vec![], vec![(4..8, true)])
            }
            // What moves is seen as far as its own channel is, nearer to it than to the next.
            2 => {
                catalog.set_transform("v", "b3", moved).await.unwrap();
                (vec![0, 3, 7, 8], vec![], vec![(2..6, false); 2])
            }
            3 => {
                catalog.set_transform("v", "a3", moved).await.unwrap();
                (vec![0, 3, 7, 8], vec![], vec![(3..4, false); 2])
            }
            // Of another channel now; of another section.
            4 => {
                let tile = new("b3", 3, 2, 4);
                catalog.commit_tile("v", &tile).await.unwrap();
                (vec![0, 7, 8], vec![3], vec![(1..7, true); 2])
            }
            5 => {
                let tile = new("b8", 4, 1, 5);
                catalog.commit_tile("v", &tile).await.unwrap();
                (vec![0, 4, 7], vec![3], vec![(8..9, false), (1..7, true)])
            }
            // Taken away, and its gap with it.
            6 => {
                catalog.delete_tile("v", "b8", 9).await.unwrap();
                (vec![0, 7], vec![3], vec![(1..7, true)])
            }
            _ => {
                catalog.delete_tile("v", "b3", 9).await.unwrap();
                (vec![0, 7], vec![], vec![(3..4, false)])
            }
        };
        let changes = catalog.changes_after("v", seen).await.unwrap();
        let told = index.apply(&changes, &reaches).await.unwrap();
        let told: Vec<_> = { told.into_iter() }
            .map(|reach| (reach.sections, reach.everywhere))
            .collect();
        assert_eq!(told, reached, "step {step}");
        seen = changes[changes.len() - 1].revision;
        assert_eq!(of(&index), [every.clone(), b, c], "step {step}");
        let fresh = TileIndex::open(&catalog, "v", u64::MAX).await.unwrap();
        assert_eq!(of(&index), of(&fresh), "step {step}");
    }
}

#[tokio::test]
async fn a_catalog_that_cannot_be_read_leaves_nothing_stale() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = catalog(&folder).await;
    catalog
        .commit_tile("v", &new_tile("a", 4, 0.0, 1))
        .await
        .unwrap();
    let index = TileIndex::open(&catalog, "v", u64::MAX).await.unwrap();
    assert_eq!(index.section(4).await.unwrap().tiles(), 1);
    catalog
        .commit_tile("v", &new_tile("b", 4, 300.0, 2))
        .await
        .unwrap();
    let changes = catalog.changes_after("v", 1).await.unwrap();
    catalog.close().await;
    index.apply(&changes, &OWN).await.unwrap_err();
    assert!(
        index.section(4).await.is_err(),
        "asked again, not answered from before"
    );
}

#[tokio::test]
async fn memory_is_bounded_and_what_is_used_stays() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = Catalog::create(&folder.path().join("catalog.sqlite"))
        .await
        .unwrap();
    let volume = Volume::new("v", UVec3::new(4000, 4000, 40), DVec3::new(4.0, 4.0, 30.0));
    catalog.create_volume(&volume.unwrap()).await.unwrap();
    for z in 0..40 {
        let tile = new_tile(&format!("t{z}"), z, 10.0, u64::from(z) + 1);
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    let all = TileIndex::open(&catalog, "v", u64::MAX).await.unwrap();
    let empty = all.bytes();
    all.section(0).await.unwrap();
    let each = all.bytes() - empty;
    let index = TileIndex::open(&catalog, "v", 8 * each).await.unwrap();
    let mut most = 0;
    for z in 0..40 {
        index.section(z).await.unwrap();
        // This one is asked for again and again.
        let first = index.section(0).await.unwrap();
        most = most.max(index.bytes());
        assert_eq!(first.tiles(), 1);
    }
    // Names differ in length.
    assert!(most <= empty + 10 * each, "{most} of {}", 8 * each);
    assert!(index.tiles() >= 7, "{} sections are left", index.tiles());
    assert!(
        { &index.sections }
            .lock()
            .unwrap()
            .by_number
            .contains_key(&0)
    );
    assert!(
        !{ &index.sections }
            .lock()
            .unwrap()
            .by_number
            .contains_key(&3)
    );

    // What was forgotten comes back as it is now.
    let moved = new_tile("t3", 3, 500.0, 100);
    let before = catalog.revision("v").await.unwrap();
    catalog.commit_tile("v", &moved).await.unwrap();
    let changes = catalog.changes_after("v", before).await.unwrap();
    index.apply(&changes, &OWN).await.unwrap();
    let near = index.section(3).await.unwrap().near(0, ALL.0.0, ALL.1.0);
    assert!(near[0].min.x > 400.0, "{near:?}");
}

#[test]
fn neighbouring_sections_are_asked_for_at_once() {
    assert_eq!(runs([]), []);
    let all = 0..20_000;
    assert_eq!(runs(all.clone()), [all]);
    assert_eq!(
        runs([3, 4, 69, 135, u32::MAX - 1]),
        [3..70, 135..136, u32::MAX - 1..u32::MAX]
    );
}
