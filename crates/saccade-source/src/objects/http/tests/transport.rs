//! Answers that are not the object: pages for people, and what was compressed unasked.

use std::io::Write as _;

use super::*;

const PAGE: &str =
    "<!DOCTYPE html>\n<html><head><title>Log in</title></head><body>Who are you?</body></html>";

fn zipped(bytes: &[u8]) -> Bytes {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap().into()
}

/// Whatever part was asked for, and however long the page is.
#[tokio::test]
async fn a_page_is_no_object() {
    let server = TestServer::start(conformance::objects()).await;
    let keys = ["a/b/ten", ".zattrs"];
    for key in keys {
        let page = Bytes::from_static(PAGE.as_bytes());
        server.objects.lock().unwrap().insert(key.to_owned(), page);
    }
    *server.headers.lock().unwrap() = "\r\ncontent-type: text/html; charset=utf-8";
    for (way, store) in server.stores(patience()).iter().enumerate() {
        let parts = [
            Part::Whole { most: 1000 },
            Part::Whole { most: 20 },
            Part::Range(0..40),
            Part::Range(10..1 << 20),
        ];
        // What S3 sends beside the part that was asked for is refused as such.
        for part in &parts[..if way == 0 { 4 } else { 1 }] {
            // As who asks to log in does, who knows of no parts.
            server.fail_next([Fault::Whole]);
            let before = server.asked("ten");
            let read = store.read("a/b/ten", part.clone()).await;
            let named = read.unwrap_err().to_string();
            assert!(
                named.contains("a web page (HTML)") && named.contains("a/b/ten"),
                "{way} {part:?}: {named}"
            );
            assert_eq!(server.asked("ten"), before + 1, "asked again: {part:?}");
        }
    }
    // What is no page is not taken for one, whatever it is called.
    for store in server.stores(patience()) {
        let got = store.read("c/long", Part::Range(0..4)).await.unwrap();
        assert_eq!(got.unwrap().len(), 4);
    }
}

#[tokio::test]
async fn what_is_compressed_in_transport_is_what_it_was() {
    let server = TestServer::start(conformance::objects()).await;
    let voxels: Vec<u8> = (0..5000_u32).map(|n| (n % 7) as u8).collect();
    for (key, bytes) in [("plain", &voxels[..]), ("bomb", &[0; 100_000])] {
        let object = zipped(bytes);
        server
            .objects
            .lock()
            .unwrap()
            .insert(key.to_owned(), object);
    }
    *server.headers.lock().unwrap() = "\r\ncontent-encoding: gzip";
    let most = 5000;
    for store in server.stores(patience()) {
        let got = store.read("plain", Part::Whole { most }).await.unwrap();
        assert!(got.unwrap() == voxels);
        let bomb = store.read("bomb", Part::Whole { most }).await;
        let named = bomb.unwrap_err().to_string();
        assert!(
            named.contains("more than the 5000 bytes") && named.contains("bomb"),
            "{named}"
        );
        let part = store.read("plain", Part::Range(3..9)).await;
        let named = part.unwrap_err().to_string();
        assert!(
            named.contains("Content-Encoding: gzip") && named.contains("plain"),
            "{named}"
        );
    }
    *server.headers.lock().unwrap() = "\r\ncontent-encoding: br";
    for store in server.stores(patience()) {
        let got = store.read("plain", Part::Whole { most }).await;
        let named = got.unwrap_err().to_string();
        assert!(
            named.contains("Content-Encoding: br") && named.contains("as it is"),
            "{named}"
        );
    }
}
