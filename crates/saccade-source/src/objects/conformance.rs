//! What every [`Objects`] must do. All implementations run it.

use bytes::Bytes;

use super::{ObjectError, Objects, Part};

/// Objects that a store holds when it is checked; nothing else but these.
pub fn objects() -> Vec<(String, Bytes)> {
    let long = (0..100_000_u32)
        .flat_map(u32::to_le_bytes)
        .collect::<Vec<u8>>();
    vec![
        ("a/b/ten".to_owned(), Bytes::from_static(b"0123456789")),
        ("a/empty".to_owned(), Bytes::new()),
        (".zattrs".to_owned(), Bytes::from_static(b"{}")),
        ("c/long".to_owned(), long.into()),
    ]
}

/// Checks a store that holds [`objects`].
///
/// # Panics
///
/// If it breaks its contract: this is a test.
pub async fn check(store: &dyn Objects) {
    for (key, bytes) in objects() {
        let most = bytes.len() as u64;
        let whole = store.read(&key, Part::Whole { most }).await;
        assert!(
            whole.expect("whole") == Some(bytes),
            "{key} came back as another"
        );
        if most > 0 {
            let cut = store.read(&key, Part::Whole { most: most - 1 }).await;
            assert!(
                matches!(cut, Err(ObjectError::TooLong { .. })),
                "{key}: {cut:?}"
            );
        }
        assert!(
            store
                .location(&key)
                .contains(key.rsplit('/').next().expect("a part"))
        );
    }
    parts_come_back(store).await;
    what_is_not_there_is_none(store).await;
    no_key_leads_out(store).await;
}

async fn parts_come_back(store: &dyn Objects) {
    let ten = "a/b/ten";
    for (part, want) in [
        (Part::Range(0..10), &b"0123456789"[..]),
        (Part::Range(3..5), b"34"),
        (Part::Range(9..10), b"9"),
        (Part::Range(4..4), b""),
        (Part::Last(1), b"9"),
        (Part::Last(10), b"0123456789"),
        (Part::Last(400), b"0123456789"),
    ] {
        let got = store.read(ten, part.clone()).await.expect("a part");
        assert_eq!(got.as_deref(), Some(want), "{part:?}");
    }
    for beyond in [5..11, 10..12, 400..500, u64::MAX - 5..u64::MAX] {
        let got = store.read(ten, Part::Range(beyond.clone())).await;
        let short = matches!(got, Err(ObjectError::TooShort { .. }));
        assert!(short, "{beyond:?} of ten bytes: {got:?}");
    }
    let end = store
        .read("a/empty", Part::Last(20))
        .await
        .expect("the end");
    assert_eq!(end.as_deref(), Some(&b""[..]));
    let middle = store.read("c/long", Part::Range(200_000..200_004)).await;
    let want = 50_000_u32.to_le_bytes();
    assert_eq!(middle.expect("a part").as_deref(), Some(&want[..]));
}

async fn what_is_not_there_is_none(store: &dyn Objects) {
    for key in ["a/b/eleven", "none", "a/b", "a/b/ten/more"] {
        for part in [Part::Whole { most: 10 }, Part::Range(0..4), Part::Last(4)] {
            let got = store.read(key, part.clone()).await;
            let is_none = match &got {
                // Where there are folders, one is no object, but not nothing.
                Err(ObjectError::NoFile { .. }) => key == "a/b",
                got => matches!(got, Ok(None)),
            };
            assert!(is_none, "{key} {part:?}: {got:?}");
        }
    }
}

async fn no_key_leads_out(store: &dyn Objects) {
    for key in [
        "",
        "/a",
        "../a",
        "a/../../b",
        "a//b",
        "a/./b",
        "a/",
        "..\\a",
        "a\0b",
    ] {
        let got = store.read(key, Part::Last(4)).await;
        assert!(
            matches!(got, Err(ObjectError::Key { .. })),
            "{key:?}: {got:?}"
        );
    }
}
