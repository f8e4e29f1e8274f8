//! SQLite and PostgreSQL behind one door.
//!
//! Statements are the same text for both wherever they can be: numbered parameters, 64-bit integers,
//! `ON CONFLICT` and `RETURNING` mean the same to both. Where they cannot, a [`Statement`] has two
//! texts side by side.

use sqlx::postgres::PgRow;
use sqlx::sqlite::SqliteRow;
use sqlx::{
    Decode, Error, PgConnection, PgPool, Postgres, Row as _, SqlSafeStr as _, Sqlite,
    SqliteConnection, Type,
};

use super::sqlite;

/// An open database.
#[derive(Debug)]
pub(super) enum Database {
    Sqlite(sqlite::Opened),
    Postgres(PgPool),
}

/// What to say to each.
#[derive(Clone, Copy)]
pub(super) struct Statement {
    pub(super) sqlite: &'static str,
    pub(super) postgres: &'static str,
}

impl From<&'static str> for Statement {
    fn from(both: &'static str) -> Self {
        Self {
            sqlite: both,
            postgres: both,
        }
    }
}

/// A parameter of a statement.
#[derive(Clone, Copy, Debug)]
pub(super) enum Value<'a> {
    Integer(i64),
    MaybeInteger(Option<i64>),
    Real(f64),
    Text(&'a str),
    MaybeText(Option<&'a str>),
}

impl From<i64> for Value<'_> {
    fn from(value: i64) -> Self {
        Self::Integer(value)
    }
}

impl From<u32> for Value<'_> {
    fn from(value: u32) -> Self {
        Self::Integer(value.into())
    }
}

/// The databases' integers are signed. Revisions and positions never come near the sign.
impl From<u64> for Value<'_> {
    fn from(value: u64) -> Self {
        Self::Integer(i64::try_from(value).unwrap_or(i64::MAX))
    }
}

impl From<f64> for Value<'_> {
    fn from(value: f64) -> Self {
        Self::Real(value)
    }
}

impl<'a> From<&'a str> for Value<'a> {
    fn from(value: &'a str) -> Self {
        Self::Text(value)
    }
}

impl<'a> From<&'a String> for Value<'a> {
    fn from(value: &'a String) -> Self {
        Self::Text(value)
    }
}

/// A row of an answer.
pub(super) enum Row {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

impl Row {
    pub(super) fn get<T>(&self, column: &str) -> Result<T, Error>
    where
        T: for<'r> Decode<'r, Sqlite>
            + Type<Sqlite>
            + for<'r> Decode<'r, Postgres>
            + Type<Postgres>,
    {
        match self {
            Self::Sqlite(row) => row.try_get(column),
            Self::Postgres(row) => row.try_get(column),
        }
    }

    /// The bytes of a text, which need not be one: SQLite keeps what it is given.
    pub(super) fn text(&self, column: &str) -> Result<Vec<u8>, Error> {
        match self {
            Self::Sqlite(row) => row.try_get_unchecked(column),
            Self::Postgres(row) => row.try_get(column).map(String::into_bytes),
        }
    }
}

macro_rules! query {
    ($sql:expr, $values:expr) => {
        $values
            .iter()
            .fold(sqlx::query($sql), |query, value| match *value {
                Value::Integer(value) => query.bind(value),
                Value::MaybeInteger(value) => query.bind(value),
                Value::Real(value) => query.bind(value),
                Value::Text(value) => query.bind(value),
                Value::MaybeText(value) => query.bind(value),
            })
    };
}

impl Database {
    /// The rows that a question finds.
    pub(super) async fn all(
        &self,
        question: impl Into<Statement>,
        values: &[Value<'_>],
    ) -> Result<Vec<Row>, Error> {
        let question = question.into();
        match self {
            Self::Sqlite(opened) => {
                let readers = opened.readers();
                let rows = query!(question.sqlite, values).fetch_all(&readers);
                Ok(rows.await?.into_iter().map(Row::Sqlite).collect())
            }
            Self::Postgres(pool) => {
                let rows = query!(question.postgres, values).fetch_all(pool);
                Ok(rows.await?.into_iter().map(Row::Postgres).collect())
            }
        }
    }

    pub(super) async fn close(&self) {
        match self {
            Self::Sqlite(opened) => opened.close().await,
            Self::Postgres(pool) => pool.close().await,
        }
    }

    pub(super) fn is_closed(&self) -> bool {
        match self {
            Self::Sqlite(opened) => opened.is_closed(),
            Self::Postgres(pool) => pool.is_closed(),
        }
    }
}

/// Whether a transaction must survive a power cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Durability {
    /// Once it is committed it stays.
    Durable,
    /// It may be lost, whole: cheaper by a sync.
    Soon,
}

/// A transaction that may write. Dropped, it is undone.
#[derive(Debug)]
pub(super) enum Transaction {
    Sqlite(sqlx::Transaction<'static, Sqlite>),
    Postgres(sqlx::Transaction<'static, Postgres>),
}

enum Connection<'c> {
    Sqlite(&'c mut SqliteConnection),
    Postgres(&'c mut PgConnection),
}

impl Transaction {
    /// `None` if the database may only be read.
    pub(super) async fn begin(
        database: &Database,
        durability: Durability,
    ) -> Result<Option<Self>, Error> {
        match database {
            Database::Sqlite(opened) => {
                let Some(writer) = &opened.writer else {
                    return Ok(None);
                };
                let mut connection = writer.acquire().await?;
                // Said each time, so that nothing is left over from one that was broken off.
                let sync = match durability {
                    Durability::Durable => "PRAGMA synchronous = FULL",
                    Durability::Soon => "PRAGMA synchronous = NORMAL",
                };
                sqlx::query(sync).execute(&mut *connection).await?;
                opened.tidy(&mut connection).await?;
                // IMMEDIATE: one that begins by reading could not always go on to write.
                let begin = "BEGIN IMMEDIATE".into_sql_str();
                let begun = sqlx::Transaction::begin(connection, Some(begin)).await?;
                Ok(Some(Self::Sqlite(begun)))
            }
            Database::Postgres(pool) => {
                let mut begun = pool.begin().await?;
                if durability == Durability::Soon {
                    let sync = "SET LOCAL synchronous_commit = off";
                    sqlx::query(sync).execute(&mut *begun).await?;
                }
                Ok(Some(Self::Postgres(begun)))
            }
        }
    }

    fn connection(&mut self) -> Connection<'_> {
        match self {
            Self::Sqlite(transaction) => Connection::Sqlite(transaction),
            Self::Postgres(transaction) => Connection::Postgres(transaction),
        }
    }

    /// Does something; returns how many rows it was done to.
    pub(super) async fn run(
        &mut self,
        statement: impl Into<Statement>,
        values: &[Value<'_>],
    ) -> Result<u64, Error> {
        let statement = statement.into();
        Ok(match self.connection() {
            Connection::Sqlite(connection) => {
                let done = query!(statement.sqlite, values).execute(connection);
                done.await?.rows_affected()
            }
            Connection::Postgres(connection) => {
                let done = query!(statement.postgres, values).execute(connection);
                done.await?.rows_affected()
            }
        })
    }

    /// The rows that a question finds, or that a statement returns.
    pub(super) async fn all(
        &mut self,
        question: impl Into<Statement>,
        values: &[Value<'_>],
    ) -> Result<Vec<Row>, Error> {
        let question = question.into();
        match self.connection() {
            Connection::Sqlite(connection) => {
                let rows = query!(question.sqlite, values).fetch_all(connection);
                Ok(rows.await?.into_iter().map(Row::Sqlite).collect())
            }
            Connection::Postgres(connection) => {
                let rows = query!(question.postgres, values).fetch_all(connection);
                Ok(rows.await?.into_iter().map(Row::Postgres).collect())
            }
        }
    }

    /// The row that a question finds, or that a statement returns, if any.
    pub(super) async fn one(
        &mut self,
        question: impl Into<Statement>,
        values: &[Value<'_>],
    ) -> Result<Option<Row>, Error> {
        Ok(self.all(question, values).await?.pop())
    }

    pub(super) async fn commit(self) -> Result<(), Error> {
        match self {
            Self::Sqlite(transaction) => transaction.commit().await,
            Self::Postgres(transaction) => transaction.commit().await,
        }
    }
}
