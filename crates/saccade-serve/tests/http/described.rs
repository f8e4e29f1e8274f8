//! What is said of volumes.

use reqwest::header::{ACCESS_CONTROL_REQUEST_HEADERS, ACCESS_CONTROL_REQUEST_METHOD, ORIGIN};
use reqwest::{Method, StatusCode};
use saccade_core::volume::Volume;
use saccade_serve::Options;
use serde_json::{Value, json};

use super::{CHUNK, EXTENT, header, run, serve, volume};

#[test]
fn volumes_describe_themselves() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let all = served.json("volumes.json").await;
        assert_eq!(all, json!({ "volumes": [{ "name": "em", "revision": 0 }] }));
        let described = served.json("v/em/volume.json").await;
        let got: Volume = serde_json::from_value(described["volume"].clone()).unwrap();
        assert_eq!((got, &described["revision"]), (volume(), &json!(0)));
        let status = served.json("v/em/status.json").await;
        assert_eq!(
            (&status["revision"], &status["quarantined"]),
            (&json!(0), &json!([]))
        );
    });
}

#[test]
fn the_image_is_ome_zarr() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let group = served.json("v/em/zarr/zarr.json").await;
        assert_eq!(
            (&group["zarr_format"], &group["node_type"]),
            (&json!(3), &json!("group"))
        );
        let ome = &group["attributes"]["ome"];
        assert_eq!(ome["version"], "0.5");
        assert_eq!(ome["omero"]["channels"].as_array().unwrap().len(), 1);
        let image = &ome["multiscales"][0];
        let names: Vec<&Value> = image["axes"]
            .as_array()
            .unwrap()
            .iter()
            .map(|a| &a["name"])
            .collect();
        assert_eq!(names, ["c", "z", "y", "x"]);
        assert_eq!(image["axes"][0].get("unit"), None, "channels have no unit");
        let datasets = image["datasets"].as_array().unwrap();
        assert!(datasets.len() > 1);
        for dataset in datasets {
            let path = dataset["path"].as_str().unwrap();
            let array = served.json(&format!("v/em/zarr/{path}/zarr.json")).await;
            assert_eq!(array["dimension_names"], json!(names));
            let grid = &array["chunk_grid"]["configuration"]["chunk_shape"];
            assert_eq!(*grid, json!([1, CHUNK.z, CHUNK.y, CHUNK.x]));
            assert_eq!(
                (&array["data_type"], &array["fill_value"]),
                (&json!("uint8"), &json!(0))
            );
            assert_eq!(array["codecs"], json!([{ "name": "bytes" }]));
        }
        let first = served.json("v/em/zarr/0/zarr.json").await;
        assert_eq!(first["shape"], json!([1, EXTENT.z, EXTENT.y, EXTENT.x]));
    });
}

#[test]
fn what_does_not_exist_names_what_does() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let cases = [
            ("v/nothing/volume.json", "em"),
            ("v/nothing/events", "em"),
            ("v/nothing/zarr/0/c/0/0/0/0", "em"),
            ("v/em/zarr/17/zarr.json", "0/zarr.json"),
            ("v/em/zarr/0/c/0/9/0/0", "chunks"),
            ("v/em/zarr/0/c/1/0/0/0", "chunks"),
            ("v/em/zarr/0/c/0/0/0", "LEVEL/c/C/Z/Y/X"),
            ("v/em/zarr/.zattrs", "zarr.json"),
            ("v/em/zarr2/zarr.json", ".zattrs"),
            ("v/em/zarr2/17/.zarray", "0/.zarray"),
            ("v/em/precomputed/0/0-1_0-1_0-1", "0/0-32_0-16_0-8"),
            ("v/em/precomputed/zarr.json", "info"),
            ("v/em", "/v/em/volume.json"),
            ("nothing/at/all", "/volumes.json"),
            ("v/em/zarr/%2e%2e/%2e%2e/secret", "zarr.json"),
        ];
        for (path, known) in cases {
            let response = served.get(path).await;
            assert_eq!(response.status(), StatusCode::NOT_FOUND, "{path}");
            let text = response.text().await.unwrap();
            let refusal: Value = serde_json::from_str(&text).unwrap();
            assert!(!refusal["error"].as_str().unwrap().is_empty(), "{path}");
            assert!(
                refusal["known"].to_string().contains(known),
                "{path}: {text}"
            );
        }
    });
}

#[test]
fn pages_of_other_origins_may_ask() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let chunk = "v/em/zarr/0/c/0/0/0/1";
        let preflight = served
            .request(Method::OPTIONS, chunk)
            .header(ORIGIN, "https://example.org")
            .header(ACCESS_CONTROL_REQUEST_METHOD, "GET")
            .header(ACCESS_CONTROL_REQUEST_HEADERS, "range")
            .send()
            .await
            .unwrap();
        assert!(preflight.status().is_success());
        assert_eq!(
            header(preflight.headers(), "access-control-allow-headers"),
            Some("*")
        );
        // Present, absent and nonsensical alike.
        for path in [
            chunk,
            "v/em/zarr/0/c/0/0/0/0",
            "v/em/zarr/x",
            "volumes.json",
        ] {
            let response = served
                .request(Method::GET, path)
                .header(ORIGIN, "https://example.org")
                .send();
            let headers = response.await.unwrap().headers().clone();
            assert_eq!(
                header(&headers, "access-control-allow-origin"),
                Some("*"),
                "{path}"
            );
            let exposed = header(&headers, "access-control-expose-headers").unwrap();
            for name in [
                "content-range",
                "content-length",
                "etag",
                "accept-ranges",
                "retry-after",
            ] {
                assert!(exposed.contains(name), "{path}: {name} is not in {exposed}");
            }
        }
    });
}

#[test]
fn there_is_always_a_front_page() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let response = served.get("").await;
        assert_eq!(response.status(), StatusCode::OK);
        assert!(
            header(response.headers(), "content-type")
                .unwrap()
                .starts_with("text/html")
        );
        assert_eq!(served.get("?volume=em").await.status(), StatusCode::OK);
    });
}
