//! Lists of Render's that grow: their first tiles do not tell whether the stage counts pixels.

use std::collections::BTreeMap;
use std::path::Path;
use std::thread::{JoinHandle, spawn};

use glam::{DVec2, UVec3};
use saccade_ingest::watch::ListConfig;
use tokio::runtime::Builder;

use super::{SIZE, Scope, config, roomy, write};
use crate::scope::{Seen, VOLUME, archive, seen};

/// Where the transforms put tiles, and where the stage had them \[its units a pixel\].
#[derive(Clone)]
struct Specs {
    turned: bool,
    unit: f64,
    places: Vec<[f64; 2]>,
}

impl Specs {
    fn text(&self, count: usize) -> String {
        let spec = |(n, [x, y]): (usize, &[f64; 2])| {
            let [stage_x, stage_y] = [1300.0, 400.0].map(|at: f64| at * self.unit);
            let (stage_x, stage_y) = (x * self.unit + stage_x, y * self.unit + stage_y);
            let turned = if self.turned { 0.001 } else { 0.0 };
            format!(
                r#"{{"tileId": "{n}", "z": 0, "width": {}, "height": {},
                    "layout": {{"stageX": {stage_x}, "stageY": {stage_y}}},
                    "mipmapLevels": {{"0": {{"imageUrl": "file:///scope/t{n}.tif"}}}},
                    "transforms": {{"type": "list", "specList": [
                        {{"className": "mpicbg.trakem2.transform.AffineModel2D",
                          "dataString": "1 {turned} 0 1 {x} {y}"}}]}}}}"#,
                SIZE.x, SIZE.y
            )
        };
        let specs: Vec<_> = self
            .places
            .iter()
            .enumerate()
            .take(count)
            .map(spec)
            .collect();
        format!("[{}]", specs.join(","))
    }
}

type Places = BTreeMap<String, [f64; 2]>;

/// Follows a list that grows, each time by a new process, beside others; where all lie in the end.
fn grown(
    specs: &Specs,
    counts: &'static [usize],
    config: fn(&Path) -> ListConfig,
) -> JoinHandle<Places> {
    let specs = specs.clone();
    let grows = async move {
        let scope = Scope::new();
        let list = scope.file("specs.json");
        for n in 0..specs.places.len() {
            scope.image(&format!("t{n}"), u8::try_from(n).unwrap());
        }
        let archive = archive(&scope.0.path().join("archive")).await;
        for count in counts {
            write(&list, specs.text(*count));
            scope.once(config(&list), &archive).await;
            let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
            assert_eq!(set_aside, [], "{count}");
        }
        let place = |(name, tile): (String, Seen)| {
            let [.., x, y] = tile.transform;
            (name, [x, y])
        };
        seen(&archive).await.into_iter().map(place).collect()
    };
    spawn(|| {
        Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap()
            .block_on(grows)
    })
}

fn is_as(got: &Places, want: &Places, what: &str) {
    assert!(got.keys().eq(want.keys()), "{what}: {got:?}, {want:?}");
    for (name, want) in want {
        let apart = DVec2::from_array(got[name]) - DVec2::from_array(*want);
        assert!(
            apart.abs().max_element() < 1e-6,
            "{what}: {got:?}, {want:?}"
        );
    }
}

/// However it grows, it ends where it would have lain had it been whole at first.
#[test]
fn a_list_that_begins_with_one_tile_ends_as_one_that_was_whole() {
    let row = [0.0, 50.0, 100.0, 150.0, 200.0, 250.0];
    let begin = |(unit, turned): (f64, bool)| {
        let places = row.map(|x| [x, x / 25.0]).to_vec();
        let specs = Specs {
            turned,
            unit,
            places,
        };
        let whole = grown(&specs, &[6], roomy);
        let all: [&[usize]; 2] = [&[1, 2, 6], &[2, 3, 6]];
        let parts = all.map(|steps| (steps, grown(&specs, steps, roomy)));
        (specs, whole, parts)
    };
    for (specs, whole, parts) in [(1.0, true), (4.0, false), (0.004, true)].map(begin) {
        let what = format!("{} a pixel, turned {}", specs.unit, specs.turned);
        let whole = whole.join().unwrap();
        for (steps, grown) in parts {
            is_as(
                &grown.join().unwrap(),
                &whole,
                &format!("{what}: {steps:?}"),
            );
        }
        // The corner counts in the stage's pixels where these are pixels, else in the transforms'.
        let corner = if specs.unit == 1.0 {
            [1300.0, 400.0]
        } else {
            [0.0, 0.0]
        };
        let first = DVec2::from_array(whole["t0"]) - DVec2::from_array(corner);
        assert!(first.abs().max_element() < 1.0, "{what}: {whole:?}");
    }
}

fn sized(list: &Path) -> ListConfig {
    ListConfig {
        extent: Some(UVec3::new(310, 51, 1)),
        ..config(list)
    }
}

/// Where nobody said where the corner is, what is there stays, and what comes lies beside it.
#[test]
fn tiles_that_are_there_stay_where_the_corner_was_found() {
    let row = [0.0, 50.0, 100.0, 150.0, 200.0, 250.0];
    let begin = |(unit, turned): (f64, bool)| {
        let specs = Specs {
            turned,
            unit,
            places: row.map(|x| [x, 0.0]).to_vec(),
        };
        // Of two tiles, micrometers look like pixels.
        let all: [&[usize]; 2] = [&[1, 6], &[2, 3, 6]];
        (unit, all.map(|steps| (steps, grown(&specs, steps, sized))))
    };
    for (unit, parts) in [(1.0, false), (4.0, true), (0.004, false)].map(begin) {
        let want = { row.iter().enumerate() }.map(|(n, x)| (format!("t{n}"), [*x, 0.0]));
        let want = want.collect();
        for (steps, grown) in parts {
            let got = grown.join().unwrap();
            let corner = got["t0"];
            assert!(corner.iter().all(|at| (0.0..1.0).contains(at)), "{got:?}");
            let [left, top] = corner;
            let got = { got.into_iter() }.map(|(name, [x, y])| (name, [x - left, y - top]));
            is_as(&got.collect(), &want, &format!("{unit} a pixel: {steps:?}"));
        }
    }
}

/// One that an earlier version began, with nothing kept of it.
#[tokio::test]
async fn a_list_that_was_begun_without_it_being_kept_is_followed_on() {
    let scope = Scope::new();
    let list = scope.file("specs.json");
    let places: Vec<_> = [0.0, 50.0, 100.0].map(|x| [x, 0.0]).to_vec();
    let sized = || sized(&list);
    let archive = archive(&scope.0.path().join("archive")).await;
    for n in 0..places.len() {
        scope.image(&format!("t{n}"), u8::try_from(n).unwrap());
    }
    let specs = |unit| Specs {
        turned: false,
        unit,
        places: places.clone(),
    };
    write(&list, specs(1.0).text(2));
    scope.once(sized(), &archive).await;
    let settings = scope.kept().join("watched.json");
    let kept = std::fs::read_to_string(&settings).unwrap();
    let mut kept: serde_json::Value = serde_json::from_str(&kept).unwrap();
    assert_eq!(kept["counted"], "stage");
    kept.as_object_mut().unwrap().remove("counted");
    std::fs::write(&settings, kept.to_string()).unwrap();
    let told = scope.records().len();
    scope.once(sized(), &archive).await;
    assert_eq!(scope.records().len(), told, "nothing moves");
    // What was taken for pixels is seen to be none.
    kept.as_object_mut().unwrap().remove("counted");
    std::fs::write(&settings, kept.to_string()).unwrap();
    write(&list, specs(9.0).text(3));
    scope.once(sized(), &archive).await;
    let tiles: Vec<_> = seen(&archive).await.into_values().collect();
    let x: Vec<_> = tiles.iter().map(|tile| tile.transform[4]).collect();
    assert_eq!(x, [0.0, 50.0, 100.0]);
}
