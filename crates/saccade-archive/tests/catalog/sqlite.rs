//! Files, and what is in them.

use std::path::Path;

use saccade_archive::catalog::{Catalog, CatalogError, ChangeReason, DeleteOutcome};
use saccade_archive::{ArchiveError, VisualizationArchive};

use crate::suite::{all_changes, volume};

#[tokio::test]
async fn a_catalog_of_the_first_schema_is_brought_up() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("catalog.sqlite");
    let first = include_str!("../../migrations/sqlite/0001_first.sql");
    sql(&path, first).await;
    let description = serde_json::to_string(&volume("v")).unwrap();
    sql(&path, &format!(
        "INSERT INTO volumes VALUES (1, 'v', '{description}', 3, 3);
         INSERT INTO tiles VALUES (1, 1, 'a', 2, 20, 10, 1, 0, 0, 1, 5, 6, 'tiles/a', 1, 0, 0),
             (2, 1, 'b', 2, 20, 10, 1, 0, 0, 1, 0, 0, 'tiles/b', 2, 1, 1),
             (3, 1, 'c', 4, 20, 10, 1, 0, 0, 1, 0, 0, 'tiles/c', 3, 2, 2);
         INSERT INTO changes VALUES (1, 1, 1, 2, 5, 6, 25, 16, 'tile'),
             (1, 2, 2, 2, 0, 0, 20, 10, 'tile'), (1, 3, 3, 4, 0, 0, 20, 10, 'transform');
         INSERT INTO cursors VALUES (1, 500, 3);
         CREATE TABLE _sqlx_migrations (version BIGINT PRIMARY KEY, description TEXT NOT NULL,
             installed_on TIMESTAMP NOT NULL DEFAULT CURRENT_TIMESTAMP, success BOOLEAN NOT NULL,
             checksum BLOB NOT NULL, execution_time BIGINT NOT NULL);
         INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
             VALUES (1, 'first', true, x'{}', 1);",
        // What the first version of the program noted of its file.
        "25fd3d881f73b2437659234f8695fad1af353f2f9c6624435927b0b778da3c13e9c860a3023ac509ba99afd56c9cf64b"
    )).await;
    let catalog = Catalog::open(&path).await.unwrap();
    assert_eq!(catalog.sections("v").await.unwrap(), [2, 4]);
    let cursor = catalog.cursor("v").await.unwrap();
    assert_eq!((cursor.offset, cursor.line, cursor.seen), (500, 3, None));
    let tiles = catalog.section_tiles("v", 2).await.unwrap();
    let names: Vec<_> = tiles.iter().map(|t| (&*t.name, t.channel)).collect();
    assert_eq!(names, [("a", 0), ("b", 0)]);
    let reasons: Vec<_> = all_changes(&catalog)
        .await
        .iter()
        .map(|c| c.reason)
        .collect();
    let (tile, transform) = (ChangeReason::Tile, ChangeReason::Transform);
    assert_eq!(reasons, [tile, tile, transform]);
    let deleted = catalog.delete_tile("v", "c", 9).await.unwrap();
    assert_eq!(deleted, DeleteOutcome::Deleted);
    assert_eq!(catalog.sections("v").await.unwrap(), [2]);
    assert_eq!(catalog.statistics("v").await.unwrap().tiles, 2);
}

#[tokio::test]
async fn what_is_no_archive_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("catalog.sqlite");
    let none = VisualizationArchive::open(folder.path()).await;
    assert!(matches!(none, Err(ArchiveError::NotAnArchive { .. })));
    assert!(matches!(
        Catalog::open(&path).await,
        Err(CatalogError::NotFound { .. })
    ));
    assert!(!path.exists());

    std::fs::write(&path, "dear diary").unwrap();
    let text = VisualizationArchive::open(folder.path()).await;
    assert!(matches!(
        text,
        Err(ArchiveError::Catalog(CatalogError::NotACatalog { .. }))
    ));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "dear diary");

    // Somebody else's database.
    std::fs::remove_file(&path).unwrap();
    sql(&path, "CREATE TABLE birds (name TEXT)").await;
    assert!(matches!(
        Catalog::open(&path).await,
        Err(CatalogError::NotACatalog { .. })
    ));
}

#[tokio::test]
async fn a_newer_schema_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("catalog.sqlite");
    Catalog::create(&path).await.unwrap().close().await;
    Catalog::open(&path).await.unwrap().close().await;
    let future = "INSERT INTO _sqlx_migrations \
                  (version, description, success, checksum, execution_time) \
                  VALUES (4711, 'from the future', true, x'00', 0)";
    sql(&path, future).await;
    let refused = Catalog::open(&path).await;
    assert!(
        matches!(refused, Err(CatalogError::NewerSchema { found: 4711, .. })),
        "{refused:?}"
    );
}

/// Its tables would be made once more, which are there.
#[tokio::test]
async fn a_catalog_that_does_not_say_its_schema_is_named_with_the_way_out() {
    for how in [
        "DROP TABLE _sqlx_migrations",
        "DELETE FROM _sqlx_migrations",
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalog.sqlite");
        let catalog = Catalog::create(&path).await.unwrap();
        catalog.create_volume(&volume("v")).await.unwrap();
        catalog.close().await;
        sql(&path, how).await;
        let (opened, created) = (Catalog::open(&path).await, Catalog::create(&path).await);
        for told in [opened, created] {
            let told = told.unwrap_err();
            assert!(
                matches!(&told, CatalogError::NoTable { table, .. } if table == "_sqlx_migrations"),
                "{how}: {told:?}"
            );
            let said = told.to_string();
            for part in ["or nothing in it", "a copy", "into another archive"] {
                assert!(said.contains(part), "{part:?} is not in: {said}");
            }
        }
    }
}

/// Does something to the file behind the catalog's back.
async fn sql(path: &Path, statements: &str) {
    use sqlx::Connection;
    let options = sqlx::sqlite::SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true);
    let mut connection = sqlx::SqliteConnection::connect_with(&options)
        .await
        .unwrap();
    sqlx::raw_sql(sqlx::AssertSqlSafe(statements))
        .execute(&mut connection)
        .await
        .unwrap();
    connection.close().await.unwrap();
}
