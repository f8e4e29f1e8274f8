use std::env;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey, resolve_bucket_region};
use object_store::path::Path;
use object_store::{ClientOptions, Error, GetOptions, GetRange, ObjectStore, RetryConfig};
use saccade_archive::storage::BucketLocation;
use tokio::sync::{OnceCell, Semaphore};

use super::error::Failure;
use super::{LocationError, ObjectError, Objects, Part, Patience, is_key};
use crate::maybe_send::BoxFuture;

/// Requests under way at once.
const REQUESTS: usize = 48;
/// Settings of which one is there where requests can be signed.
const CREDENTIALS: [&str; 5] = [
    "AWS_ACCESS_KEY_ID",
    "AWS_SECRET_ACCESS_KEY",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
];
const NOBODYS: &str = "saccade-asks-whether-missing-objects-are-forbidden";

/// Objects in a bucket of a store that speaks S3, below a prefix.
///
/// Requests are signed where the environment has credentials (`AWS_ACCESS_KEY_ID` and the others that
/// `object_store` knows), and anonymous where it has none: public buckets need no setting. The region
/// of a bucket of Amazon's is asked for where neither `AWS_REGION` nor `AWS_ENDPOINT_URL` is set.
///
/// Answers mean what they do for [`HttpObjects`](super::HttpObjects).
#[derive(Debug)]
pub struct S3Objects {
    location: BucketLocation,
    settings: Vec<(AmazonS3ConfigKey, String)>,
    anonymous: bool,
    find_region: bool,
    patience: Patience,
    store: OnceCell<Arc<dyn ObjectStore>>,
    requests: Semaphore,
    forbids_missing: OnceCell<bool>,
    /// Whether any answer was other than a refusal.
    granted: AtomicBool,
}

impl S3Objects {
    /// Those of a bucket, of the store that the environment describes. Sends nothing yet.
    ///
    /// # Errors
    ///
    /// [`LocationError`] if the environment describes no store.
    pub fn new(location: &BucketLocation) -> Result<Self, LocationError> {
        Self::with_settings(location, env::vars(), Patience::default())
    }

    /// Like [`Self::new`], with settings of the caller's instead of the environment's, and other patience.
    ///
    /// # Errors
    ///
    /// As [`Self::new`].
    pub fn with_settings(
        location: &BucketLocation,
        settings: impl IntoIterator<Item = (String, String)>,
        patience: Patience,
    ) -> Result<Self, LocationError> {
        let mut known = Vec::new();
        let (mut anonymous, mut find_region) = (true, true);
        for (name, value) in settings {
            let name = name.to_ascii_uppercase();
            if !name.starts_with("AWS_") || value.is_empty() {
                continue;
            }
            anonymous &= !CREDENTIALS.contains(&&*name);
            find_region &= !name.contains("REGION") && !name.contains("ENDPOINT");
            if name.starts_with("AWS_ENDPOINT") && value.starts_with("http://") {
                known.push((
                    AmazonS3ConfigKey::Client("allow_http".parse().map_err(|_| {
                        LocationError::new(&location.to_string(), "plain HTTP is not supported")
                    })?),
                    "true".to_owned(),
                ));
            }
            if let Ok(key) = name.to_ascii_lowercase().parse::<AmazonS3ConfigKey>() {
                known.push((key, value));
            }
        }
        let objects = Self {
            location: location.clone(),
            settings: known,
            anonymous,
            find_region,
            patience,
            store: OnceCell::new(),
            requests: Semaphore::new(REQUESTS),
            forbids_missing: OnceCell::new(),
            granted: AtomicBool::new(false),
        };
        objects.build(None)?;
        Ok(objects)
    }

    fn build(&self, region: Option<String>) -> Result<Arc<dyn ObjectStore>, LocationError> {
        saccade_archive::tls::provide();
        let client = ClientOptions::new()
            .with_connect_timeout(Duration::from_secs(5))
            .with_read_timeout(self.patience.idle)
            .with_timeout(Duration::from_secs(300))
            .with_pool_max_idle_per_host(REQUESTS);
        // Attempts are counted in one place, which is ours.
        let retry = RetryConfig {
            max_retries: 0,
            ..RetryConfig::default()
        };
        let mut builder = AmazonS3Builder::new()
            .with_client_options(client)
            .with_retry(retry);
        for (key, value) in &self.settings {
            builder = builder.with_config(*key, value);
        }
        if self.anonymous {
            builder = builder.with_skip_signature(true);
        }
        if let Some(region) = region {
            builder = builder.with_region(region);
        }
        let built = builder.with_bucket_name(self.location.bucket()).build();
        let wrong = |error: Error| LocationError::new(&self.location.to_string(), error);
        Ok(Arc::new(built.map_err(wrong)?))
    }

    async fn store(&self) -> Result<&Arc<dyn ObjectStore>, Failure> {
        let connect = async {
            let region = if self.find_region {
                let options = ClientOptions::new().with_timeout(self.patience.idle);
                let found = resolve_bucket_region(self.location.bucket(), &options).await;
                Some(found.map_err(|error| Failure::again(super::http::chain(&error)))?)
            } else {
                None
            };
            self.build(region).map_err(|error| {
                Failure::Final(ObjectError::Answer {
                    answer: error.to_string(),
                    location: self.location.to_string(),
                })
            })
        };
        self.store.get_or_try_init(|| connect).await
    }

    async fn part(&self, key: &str, part: Part) -> Result<Option<Bytes>, ObjectError> {
        if !is_key(key) {
            return Err(ObjectError::Key {
                key: key.to_owned(),
                location: self.location.to_string(),
            });
        }
        if let Part::Range(range) = &part
            && range.is_empty()
        {
            return Ok(Some(Bytes::new()));
        }
        match self
            .patience
            .attempts(self, key, || self.attempt(key, &part))
            .await?
        {
            Found::Object(bytes) => {
                self.granted.store(true, Ordering::Relaxed);
                Ok(Some(bytes))
            }
            Found::Nothing => {
                self.granted.store(true, Ordering::Relaxed);
                Ok(None)
            }
            Found::Forbidden if self.forbids_missing().await? => Ok(None),
            Found::Forbidden => Err(ObjectError::Denied {
                advice: self.advice(),
                location: self.location(key),
            }),
        }
    }

    fn advice(&self) -> &'static str {
        if self.anonymous {
            "there are no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        } else {
            "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and what they allow in this bucket"
        }
    }

    async fn forbids_missing(&self) -> Result<bool, ObjectError> {
        let ask = async || {
            let part = Part::Range(0..1);
            let asked = self
                .patience
                .attempts(self, NOBODYS, || self.attempt(NOBODYS, &part));
            let forbids = matches!(asked.await?, Found::Forbidden);
            if forbids {
                let location = &self.location;
                log::warn!(
                    "forbidden objects are taken for missing ones, as all missing ones are forbidden: {location}"
                );
            }
            Ok(forbids)
        };
        self.forbids_missing.get_or_try_init(ask).await.copied()
    }

    async fn attempt(&self, key: &str, part: &Part) -> Result<Found, Failure> {
        // The semaphore is never closed.
        let _permit = self.requests.acquire().await.ok();
        let path: Path = match self.location.prefix() {
            "" => Path::from(key),
            prefix => Path::from(format!("{prefix}/{key}")),
        };
        let options = GetOptions {
            range: match part {
                Part::Whole { .. } => None,
                Part::Range(range) => Some(GetRange::Bounded(range.clone())),
                Part::Last(count) => Some(GetRange::Suffix(*count)),
            },
            ..GetOptions::default()
        };
        let store = self.store().await?;
        let too_short = |wanted: std::ops::Range<u64>| {
            Failure::Final(ObjectError::TooShort {
                wanted,
                location: self.location(key),
            })
        };
        let answer = match store.get_opts(&path, options).await {
            Ok(answer) => answer,
            Err(Error::NotFound { source, .. }) => {
                let source = super::http::chain(&*source);
                if source.contains("NoSuchBucket") {
                    return Err(Failure::Final(ObjectError::Answer {
                        answer: "that there is no such bucket (check its name, and AWS_ENDPOINT_URL for stores other than Amazon's)"
                            .to_owned(),
                        location: self.location.to_string(),
                    }));
                }
                return Ok(Found::Nothing);
            }
            Err(Error::PermissionDenied { .. } | Error::Unauthenticated { .. }) => {
                return Ok(Found::Forbidden);
            }
            Err(error) => {
                let reason = super::http::chain(&error);
                // Known in words only, among which are addresses; the conformance suite notices if these change.
                let beyond = reason.contains("status code: 416")
                    || reason.contains("<Code>InvalidRange</Code>");
                return match part {
                    Part::Range(range) if beyond => Err(too_short(range.clone())),
                    Part::Last(_) if beyond => Ok(Found::Object(Bytes::new())),
                    _ => Err(Failure::again(reason)),
                };
            }
        };
        if let Part::Whole { most } = part
            && answer.meta.size > *most
        {
            return Err(Failure::Final(ObjectError::TooLong {
                most: *most,
                location: self.location(key),
            }));
        }
        let sent = answer.range.clone();
        if let Part::Range(wanted) = part
            && sent != *wanted
        {
            return Err(if sent.start == wanted.start && sent.end < wanted.end {
                too_short(wanted.clone())
            } else {
                Failure::again(format!("bytes {sent:?} were sent for {wanted:?}"))
            });
        }
        let bytes = answer.bytes().await;
        let bytes = bytes.map_err(|error| Failure::again(super::http::chain(&error)))?;
        let expected = sent.end.saturating_sub(sent.start);
        if bytes.len() as u64 == expected {
            Ok(Found::Object(bytes))
        } else {
            let count = bytes.len();
            Err(Failure::again(format!(
                "{count} bytes came instead of {expected}"
            )))
        }
    }
}

impl Objects for S3Objects {
    fn read<'a>(
        &'a self,
        key: &'a str,
        part: Part,
    ) -> BoxFuture<'a, Result<Option<Bytes>, ObjectError>> {
        Box::pin(self.part(key, part))
    }

    fn location(&self, key: &str) -> String {
        format!("{}/{key}", self.location)
    }

    fn folders(&self) -> Vec<String> {
        let parts = self.location.prefix().split('/');
        let parts = parts.filter(|part| !part.is_empty());
        parts.map(str::to_owned).collect()
    }

    fn denied(&self) -> Option<&'static str> {
        let forbidden = self.forbids_missing.get() == Some(&true);
        (forbidden && !self.granted.load(Ordering::Relaxed)).then(|| self.advice())
    }

    fn read_cost(&self) -> u64 {
        256 << 10
    }
}

enum Found {
    Object(Bytes),
    Nothing,
    Forbidden,
}
