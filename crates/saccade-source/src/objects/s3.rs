mod told;

use std::env;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt as _;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey, resolve_bucket_region};
use object_store::path::Path;
use object_store::{
    Attribute, ClientOptions, Error, GetOptions, GetRange, GetResult, ObjectStore, RetryConfig,
};
use saccade_archive::storage::BucketLocation;
use tokio::sync::{OnceCell, Semaphore};

use super::error::Failure;
use super::refusals::{EXPIRED, Found, Refusal, Refusals};
use super::retry::Pace;
use super::same::{Marks, strong};
use super::transport::{begins_a_page, names_a_page, page, plain};
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

/// Of which one is nothing without the other.
const KEYS: [&str; 2] = ["AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"];

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
    /// Tags and versions of objects that were read in parts.
    tags: Marks<(Option<String>, Option<String>)>,
    requests: Semaphore,
    refusals: Refusals,
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
        let mut keys = KEYS.map(|_| false);
        for (name, value) in settings {
            let name = name.to_ascii_uppercase();
            if !name.starts_with("AWS_") || value.is_empty() {
                continue;
            }
            anonymous &= !CREDENTIALS.contains(&&*name);
            for (key, is_set) in KEYS.iter().zip(&mut keys) {
                *is_set |= *key == name;
            }
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
        if keys[0] != keys[1] {
            let reason = format!(
                "{} and {} belong together: set both, or none for a public bucket",
                KEYS[0], KEYS[1]
            );
            return Err(LocationError::new(&location.to_string(), reason));
        }
        let objects = Self {
            location: location.clone(),
            settings: known,
            anonymous,
            find_region,
            patience,
            store: OnceCell::new(),
            tags: Marks::default(),
            requests: Semaphore::new(REQUESTS),
            refusals: Refusals::default(),
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
            .with_http_connector(told::Connector)
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
        let found = self.ask(key, &part).await?;
        let other = |key: String| -> BoxFuture<'_, _> {
            Box::pin(async move { self.ask(&key, &Part::Range(0..1)).await })
        };
        let location = self.location(key);
        let settled = self.refusals.settle(key, found, &location, other);
        let advice = match settled.await? {
            Ok(bytes) => return Ok(Some(bytes)),
            Err(Refusal::Missing) => return Ok(None),
            Err(Refusal::Denied) => self.advice(),
            Err(Refusal::Unclear) => return Err(ObjectError::Unclear { location }),
            Err(Refusal::Expired) => EXPIRED,
        };
        Err(ObjectError::Denied { advice, location })
    }

    async fn ask(&self, key: &str, part: &Part) -> Result<Found, ObjectError> {
        self.patience
            .attempts(self, key, || self.attempt(key, part))
            .await
    }

    fn advice(&self) -> &'static str {
        if self.anonymous {
            "there are no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        } else {
            "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and what they allow in this bucket"
        }
    }

    async fn attempt(&self, key: &str, part: &Part) -> Result<Found, Failure> {
        // The semaphore is never closed.
        let _permit = self.requests.acquire().await.ok();
        let name = match self.location.prefix() {
            "" => key.to_owned(),
            prefix => format!("{prefix}/{key}"),
        };
        // As it is: the client encodes it for the address, and stores keep names, not addresses.
        let path = Path::parse(&name).unwrap_or_else(|_| Path::from(name));
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
        // Where it is refused, until the words of the refusal are there.
        let asked = told::listen(store.get_opts(&path, options));
        let (answer, told) = self.patience.idle(asked).await?;
        let answer = match answer {
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
            Err(Error::PermissionDenied { .. }) => return Ok(Found::Forbidden),
            Err(Error::Unauthenticated { .. }) => return Ok(Found::Unknown),
            Err(error) => {
                let reason = super::http::chain(&error);
                // Known in words only, among which are addresses; the conformance suite notices if these change.
                let beyond = reason.contains("status code: 416")
                    || reason.contains("<Code>InvalidRange</Code>");
                return match part {
                    Part::Range(range) if beyond => Err(too_short(range.clone())),
                    Part::Last(_) if beyond => Ok(Found::Object(Bytes::new())),
                    _ => Err(Failure::Again {
                        reason,
                        wait: told.wait,
                    }),
                };
            }
        };
        if told.is_part && matches!(part, Part::Whole { .. }) {
            return Err(Failure::again("a part was sent for the whole"));
        }
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
        let meta = &answer.meta;
        let mark = (meta.e_tag.as_deref().and_then(strong), meta.version.clone());
        let mark = (mark != (None, None)).then_some(mark);
        let same = self.tags.check(key, part, mark, || self.location(key));
        same.map_err(Failure::Final)?;
        let text = |name| answer.attributes.get(&name).map(|value| value.to_string());
        let names_a_page = text(Attribute::ContentType).is_some_and(|media| names_a_page(&media));
        let encoding = text(Attribute::ContentEncoding);
        let is_beginning = answer.range.start == 0;
        let bytes = self.body(answer).await?;
        let location = self.location(key);
        if names_a_page && is_beginning && begins_a_page(&bytes) {
            return Err(page(&location));
        }
        plain(bytes, encoding.as_deref(), part, &location).map(Found::Object)
    }

    /// As many bytes as were announced, and no more than these.
    async fn body(&self, answer: GetResult) -> Result<Bytes, Failure> {
        let expected = answer.range.end.saturating_sub(answer.range.start);
        let pace = Pace::new(self.patience.idle, self.patience.slowest);
        let mut body = answer.into_stream();
        let mut bytes = Vec::new();
        while let Some(more) = self.patience.idle(body.next()).await? {
            let more = more.map_err(|error| Failure::again(super::http::chain(&error)))?;
            bytes.extend_from_slice(&more);
            if bytes.len() as u64 > expected {
                return Err(Failure::again(format!(
                    "more than the {expected} bytes came that were announced"
                )));
            }
            pace.check(bytes.len() as u64)?;
        }
        match bytes.len() as u64 == expected {
            true => Ok(bytes.into()),
            false => Err(Failure::again(format!(
                "{} bytes came instead of {expected}",
                bytes.len()
            ))),
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
        self.refusals.all_refused().then(|| self.advice())
    }

    fn stop_guessing(&self) {
        self.refusals.stop_guessing();
    }

    fn replacements(&self, key: &str) -> u64 {
        self.tags.replacements(key)
    }

    fn read_cost(&self) -> u64 {
        256 << 10
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_credentials_is_told_as_such() {
        let location: BucketLocation = "s3://bucket/image.zarr".parse().unwrap();
        let with = |names: &[&str]| {
            let settings = names
                .iter()
                .map(|name| ((*name).to_owned(), "x".to_owned()));
            let settings = settings.chain([("AWS_REGION".to_owned(), "eu-west-1".to_owned())]);
            S3Objects::with_settings(&location, settings, Patience::default())
        };
        for half in KEYS {
            let told = with(&[half]).unwrap_err().to_string();
            assert!(
                KEYS.iter().all(|key| told.contains(key)) && told.contains("set both"),
                "{told}"
            );
        }
        with(&[]).unwrap();
        with(&KEYS).unwrap();
    }
}
