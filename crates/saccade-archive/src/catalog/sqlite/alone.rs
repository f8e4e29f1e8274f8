//! What the file itself has, without the log beside it.
//!
//! Pages of the file that was open may be in the log, and hide those of a file that was copied over it.

use std::collections::BTreeMap;
use std::path::Path;

use sqlx::{ConnectOptions as _, Connection as _, Row as _};

use super::{Access, options};

/// What tells a file from another archive's, and from an older copy of itself.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(in crate::catalog) struct Alone {
    /// The archive's identity, if that was moved to the file yet.
    pub(in crate::catalog) identity: Option<String>,
    /// Revision of each volume. They only grow, and volumes are never removed.
    revisions: BTreeMap<i64, i64>,
}

impl Alone {
    /// Reads it without a lock. Whoever moves the log to the file meanwhile may spoil what is read, or fail it.
    pub(in crate::catalog) async fn read(path: &Path) -> Result<Self, sqlx::Error> {
        let mut connection = options(path, Access::ReadUnchanging).connect().await?;
        let identity = "SELECT identity FROM archive WHERE part = 1";
        let identity = sqlx::query_scalar(identity).fetch_optional(&mut connection);
        let identity = identity.await?;
        let revisions = sqlx::query("SELECT id, revision FROM volumes")
            .fetch_all(&mut connection)
            .await?;
        let revisions = { revisions.iter() }.map(|row| Ok((row.try_get(0)?, row.try_get(1)?)));
        let revisions = revisions.collect::<Result<_, sqlx::Error>>()?;
        connection.close().await?;
        Ok(Self {
            identity,
            revisions,
        })
    }

    /// Whether a volume lacks revisions that it had before.
    pub(in crate::catalog) fn is_older_than(&self, before: &Self) -> bool {
        let mut known = before.revisions.iter();
        known.any(|(volume, before)| self.revisions.get(volume).is_none_or(|now| now < before))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(revisions: &[(i64, i64)]) -> Alone {
        Alone {
            identity: None,
            revisions: revisions.iter().copied().collect(),
        }
    }

    #[test]
    fn what_lacks_a_revision_or_a_volume_is_older() {
        let before = of(&[(1, 7), (2, 0)]);
        for older in [of(&[]), of(&[(1, 7)]), of(&[(1, 6), (2, 9), (3, 1)])] {
            assert!(older.is_older_than(&before), "{older:?}");
        }
        for newer in [&before, &of(&[(1, 8), (2, 0), (3, 0)])] {
            assert!(!newer.is_older_than(&before), "{newer:?}");
        }
        assert!(!before.is_older_than(&of(&[])), "nothing was known");
    }
}
