//! The document that describes the API, held against what the server answers.

use reqwest::StatusCode;
use saccade_serve::Options;
use serde_json::{Value, json};

use super::{header, run, serve};

/// Why a value is not what a schema says. Knows the parts of JSON Schema that occur; panics on others.
fn complaint(value: &Value, schema: &Value, document: &Value) -> Option<String> {
    for (key, rule) in schema.as_object().unwrap() {
        let wrong = match key.as_str() {
            "$ref" => {
                let path = rule.as_str().unwrap().trim_start_matches('#');
                let named = document
                    .pointer(path)
                    .unwrap_or_else(|| panic!("no {rule}"));
                complaint(value, named, document)
            }
            "type" => {
                let types = rule
                    .as_array()
                    .cloned()
                    .unwrap_or_else(|| vec![rule.clone()]);
                let is = |t: &Value| match t.as_str().unwrap() {
                    "object" => value.is_object(),
                    "array" => value.is_array(),
                    "string" => value.is_string(),
                    "integer" => value.is_u64(),
                    "number" => value.is_number(),
                    "null" => value.is_null(),
                    other => panic!("type {other}"),
                };
                (!types.iter().any(is)).then(|| format!("{value} is no {rule}"))
            }
            "properties" => value.as_object().and_then(|object| {
                object
                    .iter()
                    .find_map(|(name, value)| match rule.get(name) {
                        Some(schema) => complaint(value, schema, document),
                        None => Some(format!("{name} is not described")),
                    })
            }),
            "required" => {
                let names = rule
                    .as_array()
                    .unwrap()
                    .iter()
                    .map(|name| name.as_str().unwrap());
                let mut missing = names.filter(|name| value.get(name).is_none());
                missing.next().map(|name| format!("{name} is missing"))
            }
            "items" => {
                let mut items = value.as_array().into_iter().flatten();
                items.find_map(|item| complaint(item, rule, document))
            }
            "enum" => (!rule.as_array().unwrap().contains(value))
                .then(|| format!("{value} not in {rule}")),
            "allOf" => {
                let mut all = rule.as_array().unwrap().iter();
                all.find_map(|schema| complaint(value, schema, document))
            }
            "minimum" => (value.is_number() && value.as_f64() < rule.as_f64())
                .then(|| format!("{value} < {rule}")),
            "maxItems" | "minItems" => {
                let (count, wanted) = (value.as_array().map(Vec::len), rule.as_u64().unwrap());
                (count.map(|c| c as u64) != Some(wanted))
                    .then(|| format!("{value} has not {wanted} items"))
            }
            "description" | "format" => None,
            other => panic!("{other} is not known: {schema}"),
        };
        if wrong.is_some() {
            return wrong;
        }
    }
    None
}

fn schema<'d>(document: &'d Value, path: &str, status: &str, media: &str) -> &'d Value {
    &document["paths"][path]["get"]["responses"][status]["content"][media]["schema"]
}

/// Documented as well, and in words.
#[test]
fn numbers_that_are_none_are_refused() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let document = served.json("openapi.json").await;
        for (path, address) in [
            ("/v/{name}/changes/{revision}", "v/em/changes/abc"),
            ("/v/{name}/changes/{revision}", "v/em/changes/-1"),
            (
                "/v/{name}/ranges/{channel}/{level}/{chunks}",
                "v/em/ranges/a/0/0,0,0",
            ),
        ] {
            let answer = served.get(address).await;
            assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{address}");
            let words: Value = serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap();
            let error = words["error"].as_str().unwrap();
            assert!(error.contains("whole number"), "{words}");
            let responses = &document["paths"][path]["get"]["responses"];
            assert!(responses["400"].is_object(), "{path}: {responses}");
        }
    });
}

#[test]
fn answers_are_what_the_document_says() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let document = served.json("openapi.json").await;
        let paths = document["paths"].as_object().unwrap();
        let mut described: Vec<&str> = paths.keys().map(String::as_str).collect();
        described.sort_unstable();
        assert_eq!(
            described,
            [
                "/v/{name}/changes/{revision}",
                "/v/{name}/events",
                "/v/{name}/ranges/{channel}/{level}/{chunks}",
                "/v/{name}/status.json",
                "/v/{name}/thumbnail.png",
                "/v/{name}/volume.json",
                "/volumes.json"
            ]
        );
        let filled = |path: &str, name: &str| {
            let path = path.replace("{name}", name);
            let path = path.replace("{channel}/{level}/{chunks}", "0/1/0,0,0;0,0,0");
            let path = path.replace("{revision}", "0");
            path.trim_start_matches('/').to_owned()
        };
        let picture = &document["paths"]["/v/{name}/thumbnail.png"]["get"]["responses"];
        assert!(picture["424"].is_object(), "{picture}");
        for path in described {
            let response = served.get(&filled(path, "em")).await;
            assert_eq!(response.status(), StatusCode::OK, "{path}");
            let media = header(response.headers(), "content-type")
                .unwrap()
                .to_owned();
            let content = &paths[path]["get"]["responses"]["200"]["content"];
            assert!(
                content.get(&media).is_some(),
                "{path} is {media}: {content}"
            );
            if media == "application/json" {
                let answer = response.bytes().await.unwrap();
                let answer = serde_json::from_slice(&answer).unwrap();
                let schema = schema(&document, path, "200", &media);
                assert_eq!(complaint(&answer, schema, &document), None, "{path}");
                // Empty and foreign answers are told apart.
                assert!(complaint(&json!({}), schema, &document).is_some(), "{path}");
                assert!(
                    complaint(&json!({ "x": 1 }), schema, &document).is_some(),
                    "{path}"
                );
            }
            if path.contains("{name}") {
                let refused = served.get(&filled(path, "x")).await;
                assert_eq!(refused.status(), StatusCode::NOT_FOUND, "{path}");
                let refusal = serde_json::from_slice(&refused.bytes().await.unwrap()).unwrap();
                let schema = schema(&document, path, "404", "application/json");
                assert_eq!(complaint(&refusal, schema, &document), None, "{path}");
            }
        }
    });
}
