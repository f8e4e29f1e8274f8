use glam::UVec3;
use saccade_core::volume::VolumeError;

use super::CatalogLocation;

/// Why the catalog could not do what was asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CatalogError {
    /// There is no such file, or the database is empty.
    #[error("there is no catalog; `saccade ingest` makes one: {location}")]
    NotFound {
        /// Where it was looked for.
        location: CatalogLocation,
    },
    /// The file or the database is something else.
    #[error(
        "this is not a Saccade catalog and is left as it is; give another folder or database: \
         {location}"
    )]
    NotACatalog {
        /// Where it is.
        location: CatalogLocation,
    },
    /// A newer Saccade wrote it.
    #[error(
        "the catalog was written by a newer Saccade (schema {found}, this one knows up to {known}); \
         use that version: {location}"
    )]
    NewerSchema {
        /// Schema of the file.
        found: i64,
        /// Newest schema of this program.
        known: i64,
        /// Where it is.
        location: CatalogLocation,
    },
    /// An older Saccade wrote it, and it may only be read.
    #[error(
        "the catalog was written by an older Saccade (schema {found}, this one needs {known}) and may \
         only be read here; open it once where it may be written: {location}"
    )]
    OlderSchema {
        /// Schema of the file.
        found: i64,
        /// Schema of this program.
        known: i64,
        /// Where it is.
        location: CatalogLocation,
    },
    /// It may only be read.
    #[error(
        "the catalog may only be read: check the permissions of its folder or of the database's \
         role, or whether the file system or the server is read-only: {location}"
    )]
    ReadOnly {
        /// Where it is.
        location: CatalogLocation,
    },
    /// SQLite's write-ahead log needs memory that processes share, which network file systems lack.
    #[error(
        "the catalog cannot live on a network file system ({kind}), where SQLite may lose data; put \
         the visualization archive on a local disk, or the catalog into a PostgreSQL database: \
         {location}"
    )]
    NetworkFilesystem {
        /// What the system calls it.
        kind: &'static str,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The address of the server means nothing.
    #[error(
        "this is no address of a PostgreSQL database; it looks like \
         postgres://USER:PASSWORD@HOST:5432/DATABASE: {location}"
    )]
    Address {
        /// What is wrong with it.
        source: sqlx::Error,
        /// As given.
        location: CatalogLocation,
    },
    /// The server does not answer, or not yet.
    #[error("the catalog's server does not answer; start it, or look at the network: {location}")]
    Unreachable {
        /// What happened.
        source: sqlx::Error,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The server has no such database.
    #[error(
        "the catalog's server has no database of that name; make it, as with `createdb --owner USER \
         DATABASE` on the server, or mend the address: {location}"
    )]
    NoDatabase {
        /// What the server says.
        source: sqlx::Error,
        /// Where it was looked for.
        location: CatalogLocation,
    },
    /// The server does not let this user in.
    #[error(
        "the catalog's server refuses the login; mend user and password in the address, or allow them in \
         the server's pg_hba.conf: {location}"
    )]
    Login {
        /// What the server says.
        source: sqlx::Error,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The server may lose what it has acknowledged.
    #[error(
        "the catalog's server runs with {setting}=off and may lose acknowledged tiles at a power cut; \
         set {setting} = on in its postgresql.conf and restart it: {location}"
    )]
    NotDurable {
        /// The server's setting.
        setting: &'static str,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The changes asked for are no longer kept.
    #[error(
        "the changes after revision {after} of volume {name:?} are no longer kept, only those after \
         {kept_after}: anything may have changed since"
    )]
    Missed {
        /// The volume.
        name: String,
        /// As asked for.
        after: u64,
        /// All changes after this revision are kept.
        kept_after: u64,
        /// The volume's newest revision.
        revision: u64,
    },
    /// There is no such volume.
    #[error("there is no volume {name:?}; the volumes are: {}", list(known))]
    UnknownVolume {
        /// As asked for.
        name: String,
        /// What there is.
        known: Vec<String>,
    },
    /// The name cannot be used in addresses and file names.
    #[error(transparent)]
    VolumeName(#[from] VolumeError),
    /// A volume of that name is another.
    #[error(
        "wrong {what}: volume {name:?} has {existing} in the catalog, but {asked} now; give the new \
         volume another name, or use another archive folder"
    )]
    WrongVolume {
        /// The volume.
        name: String,
        /// What differs.
        what: &'static str,
        /// In the catalog.
        existing: String,
        /// As asked for.
        asked: String,
    },
    /// The catalog's row of a volume means nothing.
    #[error(
        "what the catalog says of volume {name:?} cannot be understood ({reason}): put a copy of the catalog in its place, \
         from which `saccade ingest` goes on and `saccade check` says what it lacks; other volumes can be used as they \
         are: {location}"
    )]
    SpoiltVolume {
        /// The volume.
        name: String,
        /// What is wrong.
        reason: String,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The catalog's row of a tile means nothing.
    #[error(
        "what the catalog says of tile {tile:?} of volume {volume:?} cannot be understood ({reason}): `saccade check \
         --repair --acquisition FOLDER` mends it from the acquisition's records, and so does its record once more: {location}"
    )]
    SpoiltTile {
        /// The tile.
        tile: String,
        /// Its volume.
        volume: String,
        /// What is wrong.
        reason: String,
        /// Where it is.
        location: CatalogLocation,
    },
    /// What the catalog says of how far a volume's records were read means nothing.
    #[error(
        "how far the records of volume {volume:?} were read cannot be understood ({reason}): `saccade check --repair \
         --acquisition FOLDER` finds it out from the records: {location}"
    )]
    SpoiltCursor {
        /// The volume.
        volume: String,
        /// What is wrong.
        reason: String,
        /// Where it is.
        location: CatalogLocation,
    },
    /// A tile would lie where no voxel is.
    #[error(
        "tile {tile:?} would lie wholly outside the volume of {extent} voxels (section {section}, \
         transform {transform:?}); check its section, transform and the volume's extent"
    )]
    OutsideVolume {
        /// The tile.
        tile: String,
        /// Its section.
        section: u32,
        /// `[a, b, c, d, tx, ty]`.
        transform: [f64; 6],
        /// The volume's size \[voxels\].
        extent: UVec3,
    },
    /// No space left. The catalog is as it was before.
    #[error("no space is left for the catalog; free some, then try again: {location}")]
    Full {
        /// What the database says.
        source: sqlx::Error,
        /// Where it is.
        location: CatalogLocation,
    },
    /// A sync failed: what was written before may or may not be on the disk, and a later sync would not
    /// tell, since the system forgets what it could not write. Nothing is written from here on.
    #[error(
        "the catalog could not be made durable ({reason}), and nothing more is written to it: look at \
         the disk and the system's log, then start again, which takes in what was not acknowledged: \
         {location}"
    )]
    NotSynced {
        /// What the database says.
        reason: String,
        /// Where it is.
        location: CatalogLocation,
    },
    /// Another program holds the file for longer than anybody needs for a transaction.
    #[error(
        "the catalog is locked{}: end it, or wait until it is done, and keep no database tool or backup \
         program open on it: {location}",
        by(holders)
    )]
    Locked {
        /// What the database says.
        source: sqlx::Error,
        /// Programs that hold a lock, as far as the system tells.
        holders: Vec<String>,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The file is damaged.
    #[error(
        "the catalog's file is damaged: move it away with its -wal and -shm, and put a copy of it there, from which \
         `saccade ingest` goes on and `saccade check` says what it lacks; without a copy, what `sqlite3 FILE .recover` \
         saves, or take the acquisition in anew into another archive: {location}"
    )]
    Damaged {
        /// What the database says.
        source: sqlx::Error,
        /// Where it is.
        location: CatalogLocation,
    },
    /// The open file is not the one of its name any more: what is written to it may be lost with it.
    #[error(
        "the catalog's file was moved, deleted or replaced while it was in use, and nothing more is written: put it \
         back, with its -wal if that was moved, and start again, which takes in what was not acknowledged: {location}"
    )]
    Moved {
        /// Where it was.
        location: CatalogLocation,
    },
    /// The file that was being read is not the one of its name any more, and there is no other that could be read.
    #[error(
        "the catalog's file was moved, deleted or replaced while it was in use{}: put it back, or a copy of it, with the -wal \
         that was beside it if there was one; it is read again as soon as it is there: {location}",
        because(why.as_deref())
    )]
    Away {
        /// Why what has its place cannot be read, if there is something.
        why: Option<String>,
        /// Where it was.
        location: CatalogLocation,
    },
    /// What has the catalog's place now is the catalog of another archive.
    #[error(
        "the catalog of another archive has taken the place of this one, and nothing is read from it or written to it: put \
         the right one back, with the -wal that was beside it if it was a file, and this goes on; to see the other archive, \
         start anew with its own folder: {location}"
    )]
    Another {
        /// Where it is.
        location: CatalogLocation,
    },
    /// An older copy of the catalog was copied over its file while that was open.
    #[error(
        "an older copy of the catalog was copied over its file while it was in use, and nothing more is written, for the two \
         would mix. Stop all programs that use it, remove the -wal and -shm beside it, put the copy in its place once more, and \
         start again: `saccade ingest` takes in what the copy lacks: {location}"
    )]
    Older {
        /// Where it is.
        location: CatalogLocation,
    },
    /// A table of the catalog's is not there.
    #[error(
        "the catalog has no table {table:?}{}: it was damaged, or changed by another program. Put a copy of the catalog in its \
         place, from which `saccade ingest` goes on and `saccade check` says what it lacks; without a copy, {}: {location}",
        or_empty(table),
        without_copy(table)
    )]
    NoTable {
        /// The table.
        table: String,
        /// Where the catalog is.
        location: CatalogLocation,
    },
    /// Anything else; see the source.
    #[error("the catalog could not be read or written: {location}")]
    Database {
        /// What the database says.
        source: sqlx::Error,
        /// Where it is.
        location: CatalogLocation,
    },
}

impl CatalogError {
    /// Sorts what the database says into the caller's cases.
    pub(super) fn sort(source: sqlx::Error, location: &CatalogLocation) -> Self {
        let case = match location {
            CatalogLocation::File(_) => sqlite_case(&source),
            CatalogLocation::Postgres(_) => postgres_case(&source),
        };
        let location = location.clone();
        match case {
            Case::Full => Self::Full { source, location },
            Case::NotSynced => Self::NotSynced {
                reason: source.to_string(),
                location,
            },
            Case::Foreign => Self::NotACatalog { location },
            Case::Locked => Self::Locked {
                source,
                holders: match &location {
                    CatalogLocation::File(path) => super::holders::of(path),
                    CatalogLocation::Postgres(_) => Vec::new(),
                },
                location,
            },
            Case::Damaged => Self::Damaged { source, location },
            Case::ReadOnly => Self::ReadOnly { location },
            Case::Unreachable => Self::Unreachable { source, location },
            Case::NoDatabase => Self::NoDatabase { source, location },
            Case::Login => Self::Login { source, location },
            Case::NoTable(table) => Self::NoTable { table, location },
            Case::Other => Self::Database { source, location },
        }
    }

    /// Refuses a database that has these tables, if it lacks one of a catalog's.
    pub(super) fn refuse_without(there: &[String], location: &CatalogLocation) -> Result<(), Self> {
        match super::TABLES
            .iter()
            .find(|table| there.iter().all(|name| name != *table))
        {
            None => Ok(()),
            Some(table) => Err(Self::NoTable {
                table: (*table).to_owned(),
                location: location.clone(),
            }),
        }
    }

    /// Whether the same request may succeed later: space may be freed, another writer may finish, the
    /// server may come back.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Full { .. }
            | Self::Unreachable { .. }
            | Self::Locked { .. }
            | Self::Away { .. }
            | Self::Another { .. } => true,
            // SQLITE_IOERR.
            Self::Database { source, location } => match location {
                CatalogLocation::File(_) => {
                    primary_code(source) == Some(10) || matches!(source, sqlx::Error::PoolTimedOut)
                }
                // Serialization failures, deadlocks, locks, lack of resources, system errors.
                CatalogLocation::Postgres(_) => sql_state(source)
                    .is_some_and(|s| ["40", "53", "55", "58"].iter().any(|c| s.starts_with(c))),
            },
            _ => false,
        }
    }

    /// Whether it passes only when somebody does something, however long that takes: frees space,
    /// starts the server, or puts the right catalog back.
    pub fn is_outage(&self) -> bool {
        matches!(
            self,
            Self::Full { .. } | Self::Unreachable { .. } | Self::Another { .. }
        )
    }

    /// Where the catalog is, if that is told.
    fn location(&self) -> Option<&CatalogLocation> {
        match self {
            Self::NotFound { location }
            | Self::NotACatalog { location }
            | Self::NewerSchema { location, .. }
            | Self::OlderSchema { location, .. }
            | Self::ReadOnly { location }
            | Self::NetworkFilesystem { location, .. }
            | Self::Address { location, .. }
            | Self::Unreachable { location, .. }
            | Self::NoDatabase { location, .. }
            | Self::Login { location, .. }
            | Self::NotDurable { location, .. }
            | Self::Full { location, .. }
            | Self::NotSynced { location, .. }
            | Self::Locked { location, .. }
            | Self::Damaged { location, .. }
            | Self::Moved { location }
            | Self::Away { location, .. }
            | Self::Another { location }
            | Self::Older { location }
            | Self::NoTable { location, .. }
            | Self::SpoiltVolume { location, .. }
            | Self::SpoiltTile { location, .. }
            | Self::SpoiltCursor { location, .. }
            | Self::Database { location, .. } => Some(location),
            Self::Missed { .. }
            | Self::UnknownVolume { .. }
            | Self::VolumeName(_)
            | Self::WrongVolume { .. }
            | Self::OutsideVolume { .. } => None,
        }
    }

    /// What is wrong and how to mend it, without saying where the catalog is: for those who only look.
    pub fn without_place(&self) -> String {
        let text = self.to_string();
        match self.location() {
            Some(location) => text.replace(&format!(": {location}"), ""),
            None => text,
        }
    }

    /// Whether another connection was in the way.
    pub(super) fn is_busy(&self) -> bool {
        matches!(self, Self::Locked { .. })
    }
}

enum Case {
    Full,
    Locked,
    Damaged,
    NotSynced,
    Foreign,
    ReadOnly,
    Unreachable,
    NoDatabase,
    Login,
    NoTable(String),
    Other,
}

fn sqlite_case(error: &sqlx::Error) -> Case {
    // SQLITE_IOERR_FSYNC, SQLITE_IOERR_DIR_FSYNC.
    if matches!(code(error), Some(1034 | 1290)) {
        return Case::NotSynced;
    }
    match primary_code(error) {
        // SQLITE_BUSY, SQLITE_LOCKED.
        Some(5 | 6) => Case::Locked,
        // SQLITE_IOERR_SHMSIZE: the memory beside the log, a file as well, finds no room when the catalog is opened.
        _ if code(error) == Some(4874) => Case::Full,
        Some(11) => Case::Damaged,
        Some(13) => Case::Full,
        Some(26) => Case::Foreign,
        // SQLITE_ERROR says it in words only.
        Some(1) => no_table(error, "no such table: ").map_or(Case::Other, Case::NoTable),
        _ => Case::Other,
    }
}

fn postgres_case(error: &sqlx::Error) -> Case {
    match error {
        sqlx::Error::Io(_)
        | sqlx::Error::PoolTimedOut
        | sqlx::Error::WorkerCrashed
        // A connection that was cut in the middle of a message.
        | sqlx::Error::Protocol(_) => Case::Unreachable,
        _ => match sql_state(error).as_deref() {
            Some("53100") => Case::Full,
            // A standby, or a role without the right.
            Some("25006" | "42501") => Case::ReadOnly,
            // Shutting down, crashed, starting, full of connections; and connections that broke.
            Some(state) if state.starts_with("57P0") || state.starts_with("08") => {
                Case::Unreachable
            }
            Some("53300") => Case::Unreachable,
            Some("3D000") => Case::NoDatabase,
            Some("28000" | "28P01") => Case::Login,
            Some("42P01") => no_table(error, "relation ").map_or(Case::Other, Case::NoTable),
            _ => Case::Other,
        },
    }
}

/// The table that a database lacks, by what it says of it.
fn no_table(error: &sqlx::Error, before: &str) -> Option<String> {
    let said = error.as_database_error()?.message();
    let (_, table) = said.split_once(before)?;
    let table = table.split_whitespace().next()?.trim_matches('"');
    // Tables may be told with their schema.
    Some(table.rsplit('.').next().unwrap_or(table).to_owned())
}

/// SQLite's result code.
fn code(error: &sqlx::Error) -> Option<u32> {
    error.as_database_error()?.code()?.parse().ok()
}

/// The same without its extension.
fn primary_code(error: &sqlx::Error) -> Option<u32> {
    Some(code(error)? & 0xff)
}

/// PostgreSQL's five characters.
fn sql_state(error: &sqlx::Error) -> Option<String> {
    Some(error.as_database_error()?.code()?.into_owned())
}

/// What to do about a table that is gone, where there is no copy of it.
fn without_copy(table: &str) -> &'static str {
    match table {
        "volumes" | "_sqlx_migrations" => "take the acquisition in anew into another archive",
        _ => {
            "`saccade check --repair --acquisition FOLDER` makes the table anew, and `saccade ingest` takes in again what \
             was in it, from the records and images that are still there"
        }
    }
}

/// Behind the name of a table that is also missed where there is nothing in it.
fn or_empty(table: &str) -> &'static str {
    match table {
        "_sqlx_migrations" => ", which says what schema it has, or nothing in it",
        _ => "",
    }
}

/// Who holds a lock, behind "locked".
fn by(holders: &[String]) -> String {
    match holders {
        [] => " by another program".to_owned(),
        known => format!(" by {}", known.join(" and ")),
    }
}

/// Why what is there is of no use, behind "replaced".
fn because(why: Option<&str>) -> String {
    match why {
        Some(why) => format!(", and what is there now cannot be read ({why})"),
        None => String::new(),
    }
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        "none yet".to_owned()
    } else {
        names.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_only_looks_is_not_told_where_the_catalog_is() {
        let file = CatalogLocation::File("/srv/secret/catalog.sqlite".into());
        let full = CatalogError::Full {
            source: sqlx::Error::RowNotFound,
            location: file,
        };
        assert!(full.to_string().contains("secret"));
        assert_eq!(
            full.without_place(),
            "no space is left for the catalog; free some, then try again"
        );
        let server = CatalogLocation::parse("postgres://me:pw@host/secret");
        let away = CatalogError::sort(sqlx::Error::PoolTimedOut, &server);
        let told = away.without_place();
        assert!(
            told.contains("server does not answer") && !told.contains("secret"),
            "{told}"
        );
    }
}
