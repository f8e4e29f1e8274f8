//! What has a catalog's place but is not the catalog.

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
