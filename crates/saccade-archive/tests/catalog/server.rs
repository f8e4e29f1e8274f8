//! What only a server can do: be empty, be another's, forget, die.

use std::collections::BTreeSet;
use std::time::Duration;

use saccade_archive::catalog::{Catalog, CatalogError, CatalogLocation, ChangeReason};
use sqlx::{Connection, PgConnection, SqliteConnection};

use crate::place::Place;
use crate::postgres::Server;
use crate::suite::{at, tile, volume};

async fn sql(url: &str, statements: &'static str) {
    let mut connection = PgConnection::connect(url).await.unwrap();
    sqlx::raw_sql(statements)
        .execute(&mut connection)
        .await
        .unwrap();
    connection.close().await.unwrap();
}

#[tokio::test]
async fn what_is_no_catalog_is_left_alone() {
    let Some(server) = Server::shared() else {
        return;
    };
    let url = server.database().await;
    let location = CatalogLocation::parse(&url);
    let none = Catalog::open(&location).await;
    assert!(
        matches!(none, Err(CatalogError::NotFound { .. })),
        "{none:?}"
    );
    sql(&url, "CREATE TABLE birds (name TEXT)").await;
    let foreign = Catalog::create(&location).await;
    assert!(
        matches!(foreign, Err(CatalogError::NotACatalog { .. })),
        "{foreign:?}"
    );
    sql(&url, "INSERT INTO birds VALUES ('wren')").await;

    let url = server.database().await;
    let location = CatalogLocation::parse(&url);
    Catalog::create(&location).await.unwrap().close().await;
    let future = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
                  VALUES (4711, 'from the future', true, ''::bytea, 0)";
    sql(&url, future).await;
    let refused = Catalog::open(&location).await;
    assert!(
        matches!(refused, Err(CatalogError::NewerSchema { found: 4711, .. })),
        "{refused:?}"
    );

    let nowhere = CatalogLocation::parse(&url.replace("/db", "/nodb"));
    for refused in [
        Catalog::open(&nowhere).await,
        Catalog::create(&nowhere).await,
    ] {
        assert!(
            matches!(refused, Err(CatalogError::NoDatabase { .. })),
            "{refused:?}"
        );
    }
    let stranger = CatalogLocation::parse(&url.replace("saccade@", "nobody-here@"));
    let refused = Catalog::open(&stranger).await;
    assert!(
        matches!(refused, Err(CatalogError::Login { .. })),
        "{refused:?}"
    );

    let nonsense = CatalogLocation::parse("postgres://host:port/db");
    let refused = Catalog::open(&nonsense).await;
    assert!(
        matches!(refused, Err(CatalogError::Address { .. })),
        "{refused:?}"
    );
}

#[tokio::test]
async fn a_role_that_may_only_read_can_read() {
    let Some(server) = Server::shared() else {
        return;
    };
    let url = server.database().await;
    let catalog = Catalog::create(&CatalogLocation::parse(&url))
        .await
        .unwrap();
    catalog.create_volume(&volume("v")).await.unwrap();
    catalog
        .commit_tile("v", &tile("a", 0, at(0.0, 0.0), 1))
        .await
        .unwrap();
    sql(
        &url,
        "DO $$ BEGIN CREATE ROLE viewer LOGIN; EXCEPTION WHEN duplicate_object THEN NULL; END $$;
         GRANT SELECT ON ALL TABLES IN SCHEMA public TO viewer",
    )
    .await;
    let viewer = url.replace("saccade@", "viewer@");
    let reading = Catalog::open(&CatalogLocation::parse(&viewer))
        .await
        .unwrap();
    assert_eq!(reading.section_tiles("v", 0).await.unwrap().len(), 1);
    let refused = reading
        .commit_tile("v", &tile("b", 0, at(0.0, 0.0), 2))
        .await;
    assert!(
        matches!(refused, Err(CatalogError::ReadOnly { .. })),
        "{refused:?}"
    );
}

#[tokio::test]
async fn a_server_that_forgets_is_refused() {
    let Some(server) = Server::start(&["fsync=off"]) else {
        return;
    };
    let url = server.database().await;
    let refused = Catalog::create(&CatalogLocation::parse(&url))
        .await
        .unwrap_err();
    assert!(
        matches!(
            refused,
            CatalogError::NotDurable {
                setting: "fsync",
                ..
            }
        ),
        "{refused}"
    );
    assert!(refused.to_string().contains("set fsync = on"), "{refused}");
}

#[tokio::test]
async fn commits_are_synchronous_whatever_the_database_says() {
    let Some(server) = Server::start(&["synchronous_commit=off"]) else {
        return;
    };
    let url = server.database().await;
    let catalog = Catalog::create(&CatalogLocation::parse(&url))
        .await
        .unwrap();
    catalog.create_volume(&volume("v")).await.unwrap();
    // Without a sync, the server's death takes with it what was said a moment ago.
    for n in 0..20 {
        let tile = tile(&format!("t{n}"), 0, at(0.0, 0.0), n);
        catalog.commit_tile("v", &tile).await.unwrap();
        if n % 5 == 4 {
            server.kill();
            server.run();
            assert_eq!(catalog.entry("v").await.unwrap().tiles, n + 1);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn listeners_outlive_the_server() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let location = CatalogLocation::parse(&server.database().await);
    let here = Catalog::create(&location).await.unwrap();
    here.create_volume(&volume("v")).await.unwrap();
    let there = Catalog::open(&location).await.unwrap();
    let mut heard = here.subscribe("v").await.unwrap();
    for round in 0..3u64 {
        let new = tile(&format!("t{round}"), 0, at(0.0, 0.0), round);
        there.commit_tile("v", &new).await.unwrap();
        let hear = heard.wait_for(|revision| *revision == 2 * round + 1);
        tokio::time::timeout(Duration::from_secs(20), hear)
            .await
            .unwrap()
            .unwrap();

        server.kill();
        let away = there.entry("v").await.unwrap_err();
        assert!(matches!(away, CatalogError::Unreachable { .. }), "{away}");
        assert!(away.is_transient() && away.is_outage());
        server.run();
        // While the listener may still be looking for its connection.
        there
            .set_transform("v", &new.name, at(3.0, 0.0))
            .await
            .unwrap();
        let hear = heard.wait_for(|revision| *revision == 2 * round + 2);
        tokio::time::timeout(Duration::from_secs(20), hear)
            .await
            .unwrap()
            .unwrap();
    }
    let reasons: Vec<_> = here.changes_after("v", 4).await.unwrap();
    let reasons: Vec<_> = reasons.iter().map(|c| c.reason).collect();
    assert_eq!(reasons, [ChangeReason::Tile, ChangeReason::Transform]);
}

/// Table, column, kind, whether it may be empty.
type Column = (String, String, String, bool);

/// Both sets of migrations describe the same tables.
#[tokio::test]
async fn one_schema() {
    let Some(there) = Place::database().await else {
        return;
    };
    let here = Place::file();
    for place in [&here, &there] {
        place.catalog().await.close().await;
    }
    let (CatalogLocation::File(path), CatalogLocation::Postgres(url)) =
        (here.location(), there.location())
    else {
        panic!("a file and a database")
    };
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path);
    let mut file = SqliteConnection::connect_with(&options).await.unwrap();
    let columns = "SELECT t.name, c.name, CASE c.type WHEN 'INTEGER' THEN 'bigint' \
                     WHEN 'REAL' THEN 'double precision' WHEN 'TEXT' THEN 'text' ELSE c.type END, \
                     c.\"notnull\" = 0 AND c.pk = 0 \
                   FROM sqlite_schema t JOIN pragma_table_info(t.name) c \
                   WHERE t.type = 'table' AND t.name NOT LIKE 'sqlite%' AND t.name NOT LIKE '\\_sqlx%' ESCAPE '\\'";
    let in_file: Vec<Column> = sqlx::query_as(columns).fetch_all(&mut file).await.unwrap();
    let indices = "SELECT name FROM sqlite_schema WHERE type = 'index' AND sql IS NOT NULL";
    let file_indices: Vec<String> = sqlx::query_scalar(indices)
        .fetch_all(&mut file)
        .await
        .unwrap();

    let mut server = PgConnection::connect(url).await.unwrap();
    let columns = "SELECT table_name::text, column_name::text, data_type::text, is_nullable = 'YES' \
                   FROM information_schema.columns \
                   WHERE table_schema = 'public' AND table_name NOT LIKE '\\_sqlx%'";
    let in_server: Vec<Column> = sqlx::query_as(columns)
        .fetch_all(&mut server)
        .await
        .unwrap();
    let indices = "SELECT indexname::text FROM pg_indexes WHERE schemaname = 'public' \
                   AND indexname NOT LIKE '%\\_pkey' AND indexname NOT LIKE '%\\_key'";
    let server_indices: Vec<String> = sqlx::query_scalar(indices)
        .fetch_all(&mut server)
        .await
        .unwrap();

    let set = |columns: Vec<Column>| columns.into_iter().collect::<BTreeSet<_>>();
    let (in_file, in_server) = (set(in_file), set(in_server));
    assert!(in_file.len() > 50, "{in_file:?}");
    assert_eq!(in_file, in_server);
    let names = |indices: Vec<String>| indices.into_iter().collect::<BTreeSet<_>>();
    assert_eq!(names(file_indices), names(server_indices));
}
