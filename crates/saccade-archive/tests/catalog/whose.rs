//! What has a catalog's place but is not the catalog, or not all of it.

use std::time::Duration;

use saccade_archive::catalog::{Catalog, CatalogError};

use crate::place::Place;
use crate::suite::{at, tile};

const OURS: &str = "0123456789abcdef0123456789abcdef";
const THEIRS: &str = "ffffffffffffffffffffffffffffffff";

/// Waits until something is so.
async fn until<T>(mut is_so: impl AsyncFnMut() -> Option<T>) -> T {
    let wait = async {
        loop {
            if let Some(so) = is_so().await {
                return so;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), wait)
        .await
        .expect("in time")
}

/// As where a backup of the other was restored over it.
pub(crate) async fn another_archives_catalog_is_neither_read_nor_written(place: &Place) {
    let catalog = place.catalog().await;
    assert_eq!(catalog.give_identity(OURS).await.unwrap(), OURS);
    catalog.belongs_to(OURS);
    let [a, b] = ["a", "b"].map(|name| tile(name, 0, at(0.0, 0.0), 1));
    catalog.commit_tile("v", &a).await.unwrap();
    let mut heard = catalog.subscribe("v").await.unwrap();
    catalog.verify().await.unwrap();

    let become_of = async |identity| {
        let statement = format!("UPDATE archive SET identity = '{identity}'");
        place.meddle(&statement).await;
    };
    become_of(THEIRS).await;
    let refused = catalog.commit_tile("v", &b).await.unwrap_err();
    let said = refused.to_string();
    assert!(
        matches!(refused, CatalogError::Another { .. }) && refused.is_outage(),
        "{said}"
    );
    assert!(
        said.contains("catalog of another archive")
            && said.contains("put the right one back")
            && said.contains(&place.location().to_string()),
        "{said}"
    );
    for told in [
        catalog.verify().await.err(),
        catalog.entry("v").await.err(),
        catalog.changes_after("v", 0).await.err(),
        catalog.volume("w").await.err(),
    ] {
        assert!(
            matches!(told, Some(CatalogError::Another { .. })),
            "{told:?}"
        );
    }
    let theirs = Catalog::open(place.location()).await.unwrap();
    assert_eq!(theirs.entry("v").await.unwrap().tiles, 1);

    heard.borrow_and_update();
    become_of(OURS).await;
    let entry = until(async || catalog.entry("v").await.ok()).await;
    assert_eq!((entry.tiles, catalog.times_replaced()), (1, 1));
    until(async || (*heard.borrow_and_update() == 1).then_some(())).await;
    catalog.commit_tile("v", &b).await.unwrap();

    // Who only looks notices as well.
    become_of(THEIRS).await;
    until(async || {
        let told = catalog.entry("v").await.err();
        matches!(told, Some(CatalogError::Another { .. })).then_some(())
    })
    .await;
    assert_eq!(theirs.entry("v").await.unwrap().tiles, 2);
    become_of(OURS).await;
    until(async || catalog.entry("v").await.ok()).await;
    assert_eq!(catalog.times_replaced(), 2);
}

pub(crate) async fn a_table_that_is_gone_is_named_with_the_way_out(place: &Place) {
    let catalog = place.catalog().await;
    catalog
        .commit_tile("v", &tile("a", 0, at(0.0, 0.0), 1))
        .await
        .unwrap();
    place.meddle("DROP TABLE tiles").await;
    for told in [
        catalog.tile("v", "a").await.unwrap_err(),
        catalog.delete_tile("v", "a", 3).await.unwrap_err(),
        Catalog::open(place.location()).await.unwrap_err(),
        Catalog::create(place.location()).await.unwrap_err(),
    ] {
        let said = told.to_string();
        assert!(
            matches!(&told, CatalogError::NoTable { table, .. } if table == "tiles"),
            "{told:?}"
        );
        assert!(!told.is_transient() && !told.is_outage());
        for part in [
            "has no table \"tiles\"",
            "a copy",
            "saccade check",
            "saccade check --repair --acquisition FOLDER",
            &place.location().to_string(),
        ] {
            assert!(said.contains(part), "{part:?} is not in: {said}");
        }
    }
    catalog.close().await;

    // As it was but for what was in it.
    for gone in [
        &["tiles"][..],
        &["archive", "changes", "held_up", "sections", "waiting"],
    ] {
        for table in gone {
            place.meddle(&format!("DROP TABLE IF EXISTS {table}")).await;
        }
        let made = Catalog::make_tables_anew(place.location()).await.unwrap();
        let mut sorted = made.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, gone);
        assert!(
            Catalog::make_tables_anew(place.location())
                .await
                .unwrap()
                .is_empty()
        );
    }
    let catalog = Catalog::open(place.location()).await.unwrap();
    assert_eq!(catalog.tile("v", "a").await.unwrap(), None);
    for name in ["a", "b"] {
        let new = tile(name, 0, at(0.0, 0.0), 1);
        catalog.commit_tile("v", &new).await.unwrap();
    }
    assert_eq!(catalog.section_tiles("v", 0).await.unwrap().len(), 2);
    catalog.close().await;
    // One name, one tile.
    let again = "INSERT INTO tiles SELECT 99, volume, name, section, width, height, a, b, c, d, tx, ty, pyramid, \
                 revision, position, transform_position, channel, deleted FROM tiles WHERE name = 'a'";
    assert!(place.try_meddle(again).await.is_err());

    for table in [
        "changes",
        "tiles",
        "quarantine",
        "early_transforms",
        "cursors",
        "waiting",
        "retired",
        "sections",
        "held_up",
        "volumes",
    ] {
        place.meddle(&format!("DROP TABLE {table}")).await;
    }
    let told = Catalog::make_tables_anew(place.location())
        .await
        .unwrap_err();
    let said = told.to_string();
    assert!(
        said.contains("has no table \"volumes\"") && said.contains("take the acquisition in anew"),
        "{said}"
    );
}
