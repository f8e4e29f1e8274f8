//! The same voxels in every format, and addresses that name a version.

use std::time::Duration;

use glam::UVec3;
use reqwest::StatusCode;
use reqwest::header::{ORIGIN, RANGE};
use reqwest::{Method, Response};
use saccade_core::voxel_box::VoxelBox;
use saccade_serve::Options;
use saccade_source::VolumeSource;
use saccade_source::remote::NOTHING_ACQUIRED;
use serde_json::json;

use super::server::never;
use super::{CHUNK, EXTENT, Served, header, run, serve, serve_source, value};

/// What a format calls a chunk of a level, and the box of it that the object holds.
type Named = fn(&Served, usize, UVec3) -> (String, VoxelBox);

fn zarr3(_: &Served, level: usize, c: UVec3) -> (String, VoxelBox) {
    let key = format!("zarr/{level}/c/0/{}/{}/{}", c.z, c.y, c.x);
    (key, VoxelBox::of_size(CHUNK))
}

fn zarr2(_: &Served, level: usize, c: UVec3) -> (String, VoxelBox) {
    let key = format!("zarr2/{level}/0/{}/{}/{}", c.z, c.y, c.x);
    (key, VoxelBox::of_size(CHUNK))
}

fn precomputed(served: &Served, level: usize, c: UVec3) -> (String, VoxelBox) {
    let min = c * CHUNK;
    let max = (min + CHUNK).min(served.source.volume().levels[level].extent);
    let axis = |axis: usize| format!("{}-{}", min[axis], max[axis]);
    let key = format!("precomputed/{level}/{}_{}_{}", axis(0), axis(1), axis(2));
    (key, VoxelBox::of_size(max - min))
}

const FORMATS: [Named; 3] = [zarr3, zarr2, precomputed];

async fn voxels(response: Response, expected: u64) -> Vec<u8> {
    match response.status() {
        StatusCode::OK => response.bytes().await.unwrap().to_vec(),
        StatusCode::NOT_FOUND => vec![0; usize::try_from(expected).unwrap()],
        other => panic!("{other}"),
    }
}

#[test]
fn level_0_is_the_array_in_every_format() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        for named in FORMATS {
            let (mut inside, mut differing) = (0, 0);
            let chunks = served.source.volume().chunks(0);
            for chunk in VoxelBox::of_size(chunks).iter() {
                let (key, held) = named(&served, 0, chunk);
                let got = voxels(served.get(&format!("v/em/{key}")).await, held.voxels()).await;
                assert_eq!(got.len() as u64, held.voxels(), "{key}");
                for (offset, got) in held.iter().zip(got) {
                    let voxel = chunk * CHUNK + offset;
                    if voxel.cmplt(EXTENT).all() {
                        assert_eq!(got, value(voxel), "{key}: voxel {voxel}");
                        inside += 1;
                        let turned = UVec3::new(voxel.z, voxel.y, voxel.x);
                        differing += u32::from(got != value(turned));
                    } else {
                        assert_eq!(got, 0, "{key}: voxel {voxel}");
                    }
                }
            }
            assert_eq!(inside, EXTENT.element_product());
            assert!(differing > inside / 2, "the comparison tells axes apart");
        }
    });
}

#[test]
fn coarser_levels_agree_in_every_format() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let volume = served.source.volume().clone();
        for level in 1..volume.levels.len() {
            for chunk in VoxelBox::of_size(volume.chunks(level)).iter() {
                let (key, whole) = zarr3(&served, level, chunk);
                let want = voxels(served.get(&format!("v/em/{key}")).await, whole.voxels()).await;
                for named in [zarr2, precomputed] {
                    let (key, held) = named(&served, level, chunk);
                    let response = served.get(&format!("v/em/{key}")).await;
                    let got = voxels(response, held.voxels()).await;
                    let part = whole.iter().zip(&want).filter(|(at, _)| held.contains(*at));
                    assert!(part.map(|(_, value)| value).eq(&got), "{key}");
                }
            }
        }
    });
}

#[test]
fn every_format_answers_as_the_standard_says() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        for named in FORMATS {
            let (key, held) = named(&served, 0, UVec3::ONE);
            let path = format!("v/em/{key}");
            let ask = |method| {
                served
                    .request(method, &path)
                    .header(ORIGIN, "http://else.where")
            };
            let head = ask(Method::HEAD).send().await.unwrap();
            assert_eq!(head.status(), StatusCode::OK, "{key}");
            let length = held.voxels().to_string();
            assert_eq!(header(head.headers(), "content-length"), Some(&*length));
            assert_eq!(
                header(head.headers(), "access-control-allow-origin"),
                Some("*")
            );
            let tag = header(head.headers(), "etag").unwrap().to_owned();
            let part = ask(Method::GET).header(RANGE, "bytes=-5");
            let part = part.send().await.unwrap();
            assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
            assert_eq!(part.bytes().await.unwrap().len(), 5);
            for (name, value, status) in [
                ("if-none-match", &*tag, StatusCode::NOT_MODIFIED),
                ("if-match", &*tag, StatusCode::OK),
                ("if-match", "\"other\"", StatusCode::PRECONDITION_FAILED),
                (
                    "range",
                    "bytes=99999999-",
                    StatusCode::RANGE_NOT_SATISFIABLE,
                ),
            ] {
                let answer = ask(Method::GET).header(name, value).send().await.unwrap();
                assert_eq!(answer.status(), status, "{key}: {name}: {value}");
                let read_by = header(answer.headers(), "access-control-allow-origin");
                assert_eq!(read_by, Some("*"), "{key}: {name}: {value}");
            }
            let (nothing, _) = named(&served, 0, UVec3::ZERO);
            for method in [Method::GET, Method::HEAD] {
                let nothing = served
                    .request(method, &format!("v/em/{nothing}"))
                    .header(ORIGIN, "http://else.where");
                let nothing = nothing.send().await.unwrap();
                assert_eq!(nothing.status(), StatusCode::NOT_FOUND);
                let headers = nothing.headers();
                assert!(header(headers, NOTHING_ACQUIRED).is_some());
                assert_eq!(header(headers, "access-control-allow-origin"), Some("*"));
                assert_eq!(header(headers, "cache-control"), Some("no-store"));
            }
        }
    });
}

/// Chunks that take too long, in every format.
#[test]
fn every_format_says_when_to_ask_again() {
    run(async {
        let options = Options {
            patience: Duration::from_millis(20),
            ..Options::DEFAULT
        };
        let served = serve(Options::DEFAULT).await;
        let (url, _stop, _) = serve_source(never(), options).await;
        for named in FORMATS {
            let (key, _) = named(&served, 0, UVec3::ONE);
            let late = served.client.get(format!("{url}v/em/{key}"));
            let late = late.header(ORIGIN, "http://else.where");
            let late = late.send().await.unwrap();
            assert_eq!(late.status(), StatusCode::SERVICE_UNAVAILABLE, "{key}");
            let headers = late.headers();
            assert_eq!(header(headers, "retry-after"), Some("1"), "{key}");
            assert_eq!(header(headers, "access-control-allow-origin"), Some("*"));
            let exposed = header(headers, "access-control-expose-headers").unwrap();
            assert!(exposed.contains("retry-after"), "{exposed}");
        }
    });
}

#[test]
fn each_format_describes_itself() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let group = served.json("v/em/zarr2/.zgroup").await;
        assert_eq!(group, json!({ "zarr_format": 2 }));
        let image = &served.json("v/em/zarr2/.zattrs").await["multiscales"][0];
        assert_eq!(image["version"], "0.4");
        let array = served.json("v/em/zarr2/0/.zarray").await;
        assert_eq!(array["shape"], json!([1, EXTENT.z, EXTENT.y, EXTENT.x]));
        let info = served.json("v/em/precomputed/info").await;
        assert_eq!(info["scales"][0]["size"], json!(EXTENT.to_array()));
    });
}

/// Bytes, and whether they may be kept without ever asking again.
async fn kept(served: &Served, path: &str) -> (Vec<u8>, bool) {
    let response = served.get(path).await;
    assert_eq!(response.status(), StatusCode::OK, "{path}");
    let cache = header(response.headers(), "cache-control")
        .unwrap()
        .to_owned();
    (
        response.bytes().await.unwrap().to_vec(),
        cache.contains("immutable"),
    )
}

#[test]
fn a_version_in_the_address_is_kept_as_long_as_it_is_true() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let version = async || {
            let described = served.json("v/em/volume.json").await;
            described["version"].as_str().unwrap().to_owned()
        };
        let first = version().await;
        let (changing, still) = (UVec3::ONE, UVec3::new(0, 2, 2));
        let at = |version: &str, chunk| {
            let (key, _) = zarr3(&served, 0, chunk);
            format!("v/em/at/{version}/{key}")
        };
        let (before, lasts) = kept(&served, &at(&first, changing)).await;
        assert!(lasts);
        let (key, _) = zarr3(&served, 0, changing);
        let plain = kept(&served, &format!("v/em/{key}")).await;
        assert_eq!(
            plain,
            (before.clone(), false),
            "without a version: ask again"
        );

        let min = changing * CHUNK;
        let revision = served
            .source
            .set(VoxelBox::new(min, min + 1), &[77])
            .unwrap();
        served.until_revision(revision).await;
        let second = version().await;
        assert_ne!(first, second);
        let (now, lasts) = kept(&served, &at(&first, changing)).await;
        assert_eq!((now[0], lasts), (77, false), "that version is gone");
        assert!(kept(&served, &at(&first, still)).await.1);
        assert!(kept(&served, &at(&second, changing)).await.1);
        let of_another_process = format!("0123456789abcdef-{revision}");
        for unknown in ["1", "x", "%20", &of_another_process, &format!("{second}0")] {
            let (_, lasts) = kept(&served, &at(unknown, changing)).await;
            assert!(!lasts, "{unknown}");
        }
    });
}

#[test]
fn the_list_shows_every_volume_and_where_it_is() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let page = served.get("volumes").await;
        assert_eq!(page.status(), StatusCode::OK);
        assert!(
            header(page.headers(), "content-type")
                .unwrap()
                .starts_with("text/html")
        );
        assert!(page.headers().contains_key("content-security-policy"));
        let page = page.text().await.unwrap();
        for folder in ["zarr", "zarr2", "precomputed"] {
            assert!(
                page.contains(&format!("{}v/em/{folder}/", served.url)),
                "{page}"
            );
        }
        let picture = served.get("v/em/thumbnail.png").await;
        assert_eq!(header(picture.headers(), "content-type"), Some("image/png"));
        let tag = header(picture.headers(), "etag").unwrap().to_owned();
        assert!(picture.bytes().await.unwrap().starts_with(b"\x89PNG"));
        let again = served.request(Method::GET, "v/em/thumbnail.png");
        let again = again.header("if-none-match", tag).send().await.unwrap();
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
    });
}
