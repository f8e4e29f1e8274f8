//! Where a catalog is.

use std::fmt;
use std::path::{Path, PathBuf};

/// A file of SQLite's, or a database of a PostgreSQL server.
#[derive(Clone, PartialEq, Eq)]
pub enum CatalogLocation {
    /// A file on a local disk: several processes of one machine.
    File(PathBuf),
    /// `postgres://USER@HOST:PORT/DATABASE`: several machines.
    Postgres(Box<str>),
}

impl CatalogLocation {
    /// What a user gives: an address that begins with `postgres://` or `postgresql://`, else a path.
    pub fn parse(location: &str) -> Self {
        if ["postgres://", "postgresql://"]
            .iter()
            .any(|scheme| location.starts_with(scheme))
        {
            Self::Postgres(location.into())
        } else {
            Self::File(location.into())
        }
    }
}

impl From<&Path> for CatalogLocation {
    fn from(path: &Path) -> Self {
        Self::File(path.to_owned())
    }
}

impl From<&PathBuf> for CatalogLocation {
    fn from(path: &PathBuf) -> Self {
        Self::File(path.clone())
    }
}

impl From<&Self> for CatalogLocation {
    fn from(location: &Self) -> Self {
        location.clone()
    }
}

/// For people and logs: without the password.
impl fmt::Display for CatalogLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => path.display().fmt(f),
            Self::Postgres(url) => f.write_str(&without_password(url)),
        }
    }
}

impl fmt::Debug for CatalogLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.to_string(), f)
    }
}

/// Leaves out whatever may hold a secret: the password, and the parameters.
fn without_password(url: &str) -> String {
    let (url, parameters) = url.split_once('?').unwrap_or((url, ""));
    let Some((scheme, rest)) = url.split_once("://") else {
        return url.to_owned();
    };
    match rest.rsplit_once('@') {
        // The question mark may be the password's.
        None if parameters.contains('@') => {
            let name = rest.split([':', '/']).next().unwrap_or_default();
            format!("{scheme}://{name}")
        }
        Some((login, place)) => {
            let user = login.split_once(':').map_or(login, |(user, _)| user);
            format!("{scheme}://{user}@{place}")
        }
        None => format!("{scheme}://{rest}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_told_from_paths() {
        for (text, server) in [
            ("postgres://host/db", true),
            ("postgresql:///db", true),
            ("catalog.sqlite", false),
            ("/a/postgres://b", false),
            ("postgres:/file", false),
        ] {
            let location = CatalogLocation::parse(text);
            assert_eq!(
                matches!(location, CatalogLocation::Postgres(_)),
                server,
                "{text}"
            );
        }
    }

    #[test]
    fn passwords_are_not_shown() {
        let secret = CatalogLocation::parse("postgres://me:p@ss:w@host:5/db?password=p@ss&x=1");
        for shown in [secret.to_string(), format!("{secret:?}")] {
            assert!(shown.contains("postgres://me@host:5/db"), "{shown}");
            assert!(!shown.contains("p@ss"), "{shown}");
        }
        let open = CatalogLocation::parse("postgres://host/db");
        assert_eq!(open.to_string(), "postgres://host/db");
        let half = CatalogLocation::parse("postgres://me:hush?hush@host/db");
        assert_eq!(half.to_string(), "postgres://me");
    }
}
