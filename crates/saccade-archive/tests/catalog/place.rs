//! Where a test has its catalog.

use saccade_archive::catalog::{Catalog, CatalogLocation};
use tempfile::TempDir;

use crate::postgres::Server;
use crate::suite::volume;

/// An empty place for a catalog.
pub(crate) struct Place {
    location: CatalogLocation,
    _folder: Option<TempDir>,
}

impl Place {
    pub(crate) fn file() -> Self {
        let folder = tempfile::tempdir().unwrap();
        Self {
            location: CatalogLocation::File(folder.path().join("catalog.sqlite")),
            _folder: Some(folder),
        }
    }

    /// `None` where tests with PostgreSQL are left out.
    pub(crate) async fn database() -> Option<Self> {
        let url = Server::shared()?.database().await;
        Some(Self {
            location: CatalogLocation::parse(&url),
            _folder: None,
        })
    }

    pub(crate) fn location(&self) -> &CatalogLocation {
        &self.location
    }

    /// Does what no program of ours does.
    pub(crate) async fn meddle(&self, statement: &str) {
        self.try_meddle(statement).await.unwrap();
    }

    pub(crate) async fn try_meddle(&self, statement: &str) -> Result<(), sqlx::Error> {
        let statement = sqlx::AssertSqlSafe(statement.to_owned());
        match &self.location {
            CatalogLocation::File(path) => {
                let pool = sqlx::SqlitePool::connect(path.to_str().unwrap()).await;
                let pool = pool.unwrap();
                let done = sqlx::query(statement).execute(&pool).await;
                pool.close().await;
                done.map(drop)
            }
            CatalogLocation::Postgres(url) => {
                let pool = sqlx::PgPool::connect(url).await.unwrap();
                let done = sqlx::query(statement).execute(&pool).await;
                pool.close().await;
                done.map(drop)
            }
        }
    }

    /// The catalog there, with volume `v`.
    pub(crate) async fn catalog(&self) -> Catalog {
        let catalog = Catalog::create(&self.location).await.unwrap();
        catalog.create_volume(&volume("v")).await.unwrap();
        catalog
    }
}
