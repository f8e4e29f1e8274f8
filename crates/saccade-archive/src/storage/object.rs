use std::env;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::{FutureExt as _, TryStreamExt as _};
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::limit::LimitStore;
use object_store::path::Path;
use object_store::{
    BackoffConfig, ClientOptions, GetOptions, GetRange, ObjectMeta, ObjectStore,
    ObjectStoreExt as _, PutMode, PutOptions, RetryConfig,
};

use super::{Entry, Storage, StorageError, check_name};
use crate::clock::{Clock as _, SystemClock};
use crate::percent;

mod location;
mod parts;
mod sort;

pub use location::{BucketLocation, BucketLocationError};
use parts::Uploads;
use sort::{is_broken_off, is_transport, knows_no_conditions, missing_object, sorted};

/// Requests under way at once; more wait here rather than in the store.
const REQUESTS: usize = 64;
/// How often a request is made again: for three seconds, if the store answers at once.
const RETRIES: usize = 5;
/// How often something is done at most whose answer breaks off: the client asks again only for requests that get none.
const TURNS: u32 = 4;
/// Time before it is done for the second time; twice as long before each time after that.
const PAUSE: Duration = Duration::from_millis(100);
/// Settings of which one is there where requests can be signed, or need not be.
const CREDENTIALS: [&str; 6] = [
    "aws_access_key_id",
    "aws_secret_access_key",
    "aws_web_identity_token_file",
    "aws_container_credentials_relative_uri",
    "aws_container_credentials_full_uri",
    "aws_skip_signature",
];
/// Longer objects are written in parts, so that one that fails costs little \[bytes\].
pub(super) const WHOLE: usize = 16 << 20;
/// What a request takes to begin, at a usual speed \[bytes\]: 10 ms at 50 MB/s.
const READ_COST: u64 = 512 << 10;
/// No store has longer objects \[bytes\]: S3's limit is 50 TB.
const LONGEST: u64 = 1 << 48;

/// Objects in a bucket of an object store that speaks S3, below a prefix.
///
/// The store makes a write visible whole or not at all, and answers once it is durable. Requests
/// that meet an overloaded store (503, 429), a connection that breaks or a time-out are tried
/// again for some seconds; then they fail as [`StorageError::Unavailable`]. What the store
/// refuses (403, no such bucket, the wrong region) fails at once as [`StorageError::Refused`].
///
/// Long objects are written in parts, of which nobody sees anything before the store has put them together. What is
/// given up is aborted; but a process that is killed, or whose store goes away, leaves its parts in the bucket, where no
/// listing shows them. A lifecycle rule that aborts incomplete multipart uploads removes them.
#[derive(Clone, Debug)]
pub struct ObjectStorage {
    store: Arc<dyn ObjectStore>,
    uploads: Arc<Uploads>,
    prefix: Path,
    location: Arc<str>,
}

impl ObjectStorage {
    /// The bucket as the environment describes its store: `AWS_ACCESS_KEY_ID`,
    /// `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, `AWS_REGION`, `AWS_ENDPOINT_URL` (plain HTTP if
    /// it says so), `AWS_SKIP_SIGNATURE=true` for a bucket that everybody may read, and the others
    /// that `object_store` knows. Sends nothing yet.
    ///
    /// # Errors
    ///
    /// [`StorageError::Refused`] if the environment describes no store.
    pub fn s3(location: &BucketLocation) -> Result<Self, StorageError> {
        Self::with_settings(location, env::vars(), RETRIES)
    }

    fn with_settings(
        location: &BucketLocation,
        settings: impl IntoIterator<Item = (String, String)>,
        retries: usize,
    ) -> Result<Self, StorageError> {
        crate::tls::provide();
        let place = location.to_string();
        let client = ClientOptions::new()
            .with_connect_timeout(Duration::from_secs(5))
            .with_read_timeout(Duration::from_secs(30))
            .with_timeout(Duration::from_secs(120))
            .with_pool_max_idle_per_host(REQUESTS);
        let retry = RetryConfig {
            backoff: BackoffConfig {
                init_backoff: Duration::from_millis(100),
                max_backoff: Duration::from_secs(5),
                base: 2.0,
            },
            max_retries: retries,
            retry_timeout: Duration::from_secs(10),
        };
        let mut builder = AmazonS3Builder::new()
            .with_client_options(client)
            .with_retry(retry);
        let (mut has_credentials, mut asks_machine) = (false, true);
        for (name, value) in settings {
            let name = name.to_ascii_lowercase();
            if !name.starts_with("aws_") || value.is_empty() {
                continue;
            }
            asks_machine &= name != "aws_ec2_metadata_disabled" || value != "true";
            let Ok(key) = name.parse::<AmazonS3ConfigKey>() else {
                continue;
            };
            has_credentials |= CREDENTIALS.contains(&name.as_str());
            let endpoint = matches!(
                name.as_str(),
                "aws_endpoint" | "aws_endpoint_url" | "aws_endpoint_url_s3"
            );
            if endpoint && value.starts_with("http://") {
                builder = builder.with_allow_http(true);
            }
            builder = builder.with_config(key, value);
        }
        let builder = builder.with_bucket_name(location.bucket());
        let build = |builder: AmazonS3Builder| builder.build().map_err(|e| sorted(e, &place));
        let store = if has_credentials {
            build(builder)?
        } else if asks_machine {
            // The cloud's machines are told theirs, at an address that answers nowhere else.
            let brief = RetryConfig {
                max_retries: 1,
                retry_timeout: Duration::from_secs(2),
                ..RetryConfig::default()
            };
            let machine = build(builder.clone().with_retry(brief))?;
            build(builder.with_credentials(machine.credentials().clone()))?
        } else {
            return Err(sort::no_credentials(&place));
        };
        let store = Arc::new(LimitStore::new(store, REQUESTS));
        Ok(Self::of(store, location.prefix(), place))
    }

    /// Objects of any store below a prefix; `location` is for messages.
    pub fn of(store: Arc<dyn ObjectStore>, prefix: &str, location: String) -> Self {
        Self {
            store,
            uploads: Arc::new(Uploads::new()),
            // As it is, so that others find it under the name it was given.
            prefix: Path::parse(prefix).unwrap_or_else(|_| Path::from(prefix)),
            location: location.into(),
        }
    }

    /// Asks the store for something, to know early whether it answers.
    ///
    /// # Errors
    ///
    /// [`StorageError::Refused`], [`StorageError::Unavailable`].
    pub async fn check(&self) -> Result<(), StorageError> {
        self.entries_below("", 1).await.map(|_| ())
    }

    /// What the store calls an object. Characters that not all stores take are percent-encoded.
    fn path(&self, name: &str) -> Result<Path, StorageError> {
        check_name(name)?;
        Ok(self
            .prefix
            .parts()
            .chain(Path::from(name).parts())
            .collect())
    }

    /// What we call an object of the store.
    fn name(&self, path: &Path) -> Option<String> {
        let parts: Vec<_> = path.prefix_match(&self.prefix)?.collect();
        let parts: Vec<&str> = parts.iter().map(AsRef::as_ref).collect();
        percent::decoded(&parts.join("/"))
    }

    fn failed(&self, error: object_store::Error, name: &str) -> StorageError {
        if missing_object(&error) {
            StorageError::NotFound {
                name: name.to_owned(),
            }
        } else {
            sorted(error, &format!("{}/{name}", self.location))
        }
    }

    async fn head(&self, name: &str) -> Result<ObjectMeta, StorageError> {
        let head = self.store.head(&self.path(name)?).await;
        head.map_err(|e| self.failed(e, name))
    }

    async fn read_some(
        &self,
        name: &str,
        range: Option<Range<u64>>,
    ) -> Result<Bytes, StorageError> {
        let path = self.path(name)?;
        // Stores refuse such ranges.
        if let Some(range) = &range
            && (range.is_empty() || range.start >= LONGEST)
        {
            self.head(name).await?;
            return Ok(Bytes::new());
        }
        let start = range.as_ref().map(|range| range.start);
        let options = GetOptions {
            range: range.map(GetRange::Bounded),
            ..GetOptions::default()
        };
        let mut turns = 1..TURNS;
        let error = loop {
            let answer = match self.store.get_opts(&path, options.clone()).await {
                Ok(answer) => answer,
                // Why it is refused broke off, and the client does not ask again.
                Err(e) if is_broken_off(&e) && turns.next().is_some() => continue,
                Err(e) => break self.failed(e, name),
            };
            match answer.bytes().await {
                Ok(bytes) => return Ok(bytes),
                // The client reads on where an answer broke off, but not in what has taken the object's place.
                Err(e) if is_transport(&e) && turns.next().is_some() => {}
                Err(e) => break self.failed(e, name),
            }
        };
        // A range that begins behind the end is refused, too.
        if matches!(error, StorageError::Refused { .. })
            && let Some(start) = start
            && self
                .head(name)
                .await
                .is_ok_and(|object| object.size <= start)
        {
            return Ok(Bytes::new());
        }
        Err(error)
    }

    async fn write(&self, name: &str, bytes: Bytes) -> Result<(), StorageError> {
        let path = self.path(name)?;
        let written = if bytes.len() <= WHOLE {
            self.store.put(&path, bytes.into()).await.map(|_| ())
        } else {
            self.uploads.write(&self.store, &path, &bytes).await
        };
        written.map_err(|e| sorted(e, &format!("{}/{name}", self.location)))
    }

    /// Writes an object unless there is one; what is there then.
    async fn create(&self, name: &str, bytes: Bytes) -> Result<Bytes, StorageError> {
        let path = self.path(name)?;
        again(|| async {
            let options = PutOptions::from(PutMode::Create);
            let put = self.store.put_opts(&path, bytes.clone().into(), options);
            let put = match put.await {
                Err(e) if knows_no_conditions(&e) => self.create_by_looking(&path, &bytes).await,
                put => put.map(|_| ()),
            };
            match put {
                Ok(()) | Err(object_store::Error::AlreadyExists { .. }) => {}
                Err(e) => return Err(sorted(e, &format!("{}/{name}", self.location))),
            }
            // What is there counts: an answer may have been lost, and the write been done again.
            match self.read_some(name, None).await {
                Err(StorageError::NotFound { .. }) => Err(StorageError::Unavailable {
                    source: Box::new(undone(&path)),
                    path: format!("{}/{name}", self.location),
                }),
                there => there,
            }
        })
        .await
    }

    /// The same in a store that cannot do it in one step. Two that do this at once may both write.
    async fn create_by_looking(&self, path: &Path, bytes: &Bytes) -> object_store::Result<()> {
        match self.store.head(path).await {
            Err(e) if missing_object(&e) => {
                self.store.put(path, bytes.clone().into()).await.map(|_| ())
            }
            there => there.map(|_| ()),
        }
    }

    /// Objects whose names begin with `prefix`, at most so many, sorted by name.
    async fn entries_below(&self, prefix: &str, most: usize) -> Result<Vec<Entry>, StorageError> {
        // Stores list whole folders; `prefix` may end within a name.
        let folder = prefix.rsplit_once('/').map_or("", |(folder, _)| folder);
        let folder: Path = self
            .prefix
            .parts()
            .chain(Path::from(folder).parts())
            .collect();
        let mut entries = again(|| self.list_once(&folder, prefix, most)).await?;
        entries.sort_unstable_by(|a, b| a.name.cmp(&b.name));
        Ok(entries)
    }

    async fn delete_once(&self, name: &str) -> Result<(), StorageError> {
        match self.store.delete(&self.path(name)?).await {
            Err(e) if !missing_object(&e) => Err(self.failed(e, name)),
            Ok(()) | Err(_) => Ok(()),
        }
    }

    async fn list_once(
        &self,
        folder: &Path,
        prefix: &str,
        most: usize,
    ) -> Result<Vec<Entry>, StorageError> {
        let mut listed = self.store.list(Some(folder));
        let mut entries = Vec::new();
        let failed = |e| sorted(e, &self.location);
        while entries.len() < most
            && let Some(meta) = listed.try_next().await.map_err(failed)?
        {
            let Some(name) = self.name(&meta.location) else {
                continue;
            };
            if name.starts_with(prefix) {
                entries.push(Entry {
                    name,
                    size: meta.size,
                    modified: Some(SystemTime::from(meta.last_modified)),
                });
            }
        }
        Ok(entries)
    }
}

/// Does something again, some times, while its answer breaks off or the store is away.
async fn again<T, F: Future<Output = Result<T, StorageError>>>(
    once: impl Fn() -> F,
) -> Result<T, StorageError> {
    let mut pause = PAUSE;
    for _ in 1..TURNS {
        match once().await {
            Err(e) if e.is_outage() => SystemClock.sleep(pause).await,
            done => return done,
        }
        pause *= 2;
    }
    once().await
}

/// What is said of an object that is there, and then is not: another's write came to nothing.
fn undone(path: &Path) -> object_store::Error {
    object_store::Error::NotFound {
        path: path.to_string(),
        source: "another writes it, or deletes it, at this moment".into(),
    }
}

impl Storage for ObjectStorage {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.read_some(name, range).boxed()
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        self.write(name, bytes).boxed()
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.create(name, bytes).boxed()
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        self.entries_below(prefix, usize::MAX).boxed()
    }

    fn holds_any<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<bool, StorageError>> {
        async move { Ok(!self.entries_below(prefix, 1).await?.is_empty()) }.boxed()
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        again(|| self.delete_once(name)).boxed()
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        async move { Ok(self.head(name).await?.size) }.boxed()
    }

    fn settled(&self) -> BoxFuture<'_, ()> {
        self.uploads.settled().boxed()
    }

    fn read_cost(&self) -> u64 {
        READ_COST
    }
}

#[cfg(test)]
mod tests;
