//! What is refused is either missing or not to be read: which, is asked.

use super::*;

const FORBIDDEN: &str = "403 Forbidden";

#[tokio::test]
async fn forbidden_is_missing_only_where_all_that_is_missing_is_forbidden() {
    let server = TestServer::start(conformance::objects()).await;
    server.fail_always("ten", Fault::Status("403 Forbidden"));
    for store in [&of(&server) as &dyn Objects, &s3_of(&server)] {
        let error = ten(store).await.unwrap_err();
        let named = error.to_string();
        assert!(
            named.contains("access is denied") && named.contains("ten"),
            "{named}"
        );
    }
    *server.missing.lock().unwrap() = "403 Forbidden";
    for store in [&of(&server) as &dyn Objects, &s3_of(&server)] {
        let before = server.asked(NOBODYS);
        for key in ["none", "a/none", "a/b/ten"] {
            let got = store.read(key, Part::Last(3)).await;
            assert!(matches!(got, Ok(None)), "{key}: {got:?}");
        }
        assert_eq!(server.asked(NOBODYS), before + 1, "it is asked once");
        assert!(store.denied().is_some(), "all was forbidden so far");
        let whole = store.read(".zattrs", Part::Whole { most: 9 }).await;
        assert_eq!(whole.unwrap().as_deref(), Some(&b"{}"[..]));
        assert_eq!(store.denied(), None, "something may be read");
    }
}

/// A login that runs out hides what is there; a hole hides nothing.
#[tokio::test]
async fn a_login_that_runs_out_is_no_hole() {
    let server = TestServer::start(conformance::objects()).await;
    for (missing, refusal) in [
        ("404 Not Found", FORBIDDEN),
        ("404 Not Found", "401 Unauthorized"),
        (FORBIDDEN, FORBIDDEN),
        (FORBIDDEN, "401 Unauthorized"),
    ] {
        *server.missing.lock().unwrap() = missing;
        for store in server.stores(patience()) {
            let hole = async || store.read("none", Part::Last(3)).await;
            ten(&*store).await.unwrap();
            for _ in 0..2 {
                assert!(matches!(hole().await, Ok(None)), "{missing} {refusal}");
            }
            for round in 0..2 {
                server.fail_always("", Fault::Status(refusal));
                for key in ["c/long", "a/b/ten", "none"] {
                    let error = store.read(key, Part::Range(0..4)).await.unwrap_err();
                    let named = error.to_string();
                    let says = named.contains("run out") || missing.starts_with("404");
                    assert!(
                        matches!(error, ObjectError::Denied { .. }) && says && named.contains(key),
                        "{missing} {refusal} {round}: {named}"
                    );
                }
                // A new one is let in again, and holes are holes.
                server.always.lock().unwrap().clear();
                ten(&*store).await.unwrap();
                let got = hole().await;
                assert!(matches!(got, Ok(None)), "{missing} {refusal}: {got:?}");
            }
        }
    }
}

/// Whatever else is refused or not, who is not known sees nothing.
#[tokio::test]
async fn who_is_not_known_finds_nothing_missing() {
    let server = TestServer::start(conformance::objects()).await;
    *server.missing.lock().unwrap() = "401 Unauthorized";
    for store in server.stores(patience()) {
        let error = store.read("none", Part::Last(3)).await.unwrap_err();
        assert!(matches!(error, ObjectError::Denied { .. }), "{error}");
        ten(&*store).await.unwrap();
        let error = store.read("none", Part::Last(3)).await.unwrap_err();
        assert!(matches!(error, ObjectError::Denied { .. }), "{error}");
    }
    assert_eq!(server.asked(NOBODYS), 0);
}

#[tokio::test]
async fn holes_cost_few_questions() {
    const HOLES: usize = 200;
    let server = TestServer::start(conformance::objects()).await;
    *server.missing.lock().unwrap() = FORBIDDEN;
    *server.latency.lock().unwrap() = Duration::from_millis(3);
    for store in server.stores(patience()) {
        ten(&*store).await.unwrap();
        let keys: Vec<String> = (0..HOLES).map(|n| format!("hole/{n}")).collect();
        let extra = || server.log.lock().unwrap().len();
        let before = extra();
        let reads = keys.iter().map(|key| store.read(key, Part::Last(3)));
        for read in futures::future::join_all(reads).await {
            assert!(matches!(read, Ok(None)), "{read:?}");
        }
        let together = extra() - before - HOLES;
        assert!(together <= HOLES / 4, "{together} questions");
        let before = extra();
        for key in &keys[..10] {
            let read = store.read(key, Part::Last(3)).await;
            assert!(matches!(read, Ok(None)), "{read:?}");
        }
        let each = extra() - before - 10;
        assert!(each <= 10, "{each} questions");
    }
    assert_eq!(server.asked(NOBODYS), 2, "once for each");
}

/// A question that fails says nothing of what is there, and is asked again.
#[tokio::test]
async fn what_cannot_be_judged_is_told() {
    let server = TestServer::start(conformance::objects()).await;
    *server.missing.lock().unwrap() = FORBIDDEN;
    for store in server.stores(patience()) {
        ten(&*store).await.unwrap();
        server.fail_always(NOBODYS, Fault::Status("503 Slow Down"));
        let keys = ["none", "nowhere", "never"];
        let reads = keys.map(|key| store.read(key, Part::Last(3)));
        for read in futures::future::join_all(reads).await {
            let error = read.unwrap_err();
            let named = error.to_string();
            assert!(error.is_transient() && named.contains("503"), "{named}");
        }
        server.always.lock().unwrap().clear();
        let got = store.read("none", Part::Last(3)).await;
        assert!(matches!(got, Ok(None)), "{got:?}");
    }
}

/// Who says of one object that there is none would say so of another.
#[tokio::test]
async fn what_is_forbidden_is_there_where_other_objects_are_missing() {
    let server = TestServer::start(conformance::objects()).await;
    *server.missing.lock().unwrap() = FORBIDDEN;
    server.fail_always("c/long", Fault::Status(FORBIDDEN));
    // By S3, whatever else is answered is asked again.
    for (n, gone) in [(0, "404 Not Found"), (0, "410 Gone"), (1, "404 Not Found")] {
        let store = server.stores(patience())[n].clone();
        let long = async || store.read("c/long", Part::Range(0..4)).await;
        ten(&*store).await.unwrap();
        assert!(
            matches!(long().await, Ok(None)),
            "nothing speaks against it"
        );
        server.fail_next([Fault::Status(gone)]);
        let got = store.read("labels/zarr.json", Part::Last(3)).await;
        assert!(matches!(got, Ok(None)), "{got:?}");
        for _ in 0..2 {
            let error = long().await.unwrap_err();
            let is_denied = matches!(error, ObjectError::Denied { .. });
            assert!(is_denied && error.to_string().contains("c/long"), "{error}");
        }
    }
}

/// Descriptions are often open to all whose voxels are not.
#[tokio::test]
async fn what_could_be_read_before_is_no_hole() {
    let server = TestServer::start(conformance::objects()).await;
    *server.missing.lock().unwrap() = FORBIDDEN;
    for store in server.stores(patience()) {
        let part = async |key: &str| store.read(key, Part::Range(0..2)).await;
        for key in [".zattrs", "a/b/ten", "c/long", ".zattrs"] {
            assert!(part(key).await.unwrap().is_some(), "{key}");
        }
        server.fail_always("c/long", Fault::Status(FORBIDDEN));
        let named = part("c/long").await.unwrap_err().to_string();
        assert!(named.contains("run out"), "the very same: {named}");
        assert!(matches!(part("none").await, Ok(None)));
        server.fail_always("ten", Fault::Status(FORBIDDEN));
        server.fail_always("empty", Fault::Status(FORBIDDEN));
        server.always.lock().unwrap().remove(0);
        assert!(part("c/long").await.unwrap().is_some());
        server.fail_always("c/long", Fault::Status(FORBIDDEN));
        let named = part("a/empty").await.unwrap_err().to_string();
        assert!(
            named.contains("run out") && named.contains("a/empty"),
            "{named}"
        );
        server.always.lock().unwrap().clear();
    }
}

#[tokio::test]
async fn where_nobody_guesses_a_forbidden_object_is_an_error() {
    let server = TestServer::start(conformance::objects()).await;
    *server.missing.lock().unwrap() = FORBIDDEN;
    for store in server.stores(patience()) {
        assert!(matches!(store.read("none", Part::Last(3)).await, Ok(None)));
        store.stop_guessing();
        for granted in [false, true] {
            let error = store.read("none", Part::Last(3)).await.unwrap_err();
            let named = error.to_string();
            let is_unclear = matches!(error, ObjectError::Unclear { .. });
            assert!(
                is_unclear && !error.is_transient() && named.contains("none"),
                "{granted}: {named}"
            );
            assert!(!error.without_place().contains("http"), "{named}");
            ten(&*store).await.unwrap();
        }
    }
}
