use std::fmt;
use std::str::FromStr;

/// A bucket of an object store, and what names in it begin with: `s3://bucket/prefix`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BucketLocation {
    bucket: String,
    prefix: String,
}

/// Why a text names no bucket.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} names no bucket: {reason}; write s3://bucket or s3://bucket/prefix")]
pub struct BucketLocationError {
    text: String,
    reason: &'static str,
}

impl BucketLocation {
    /// Whether a text is meant as a bucket, be it right or wrong.
    pub fn is_meant_by(text: &str) -> bool {
        text.starts_with("s3:")
    }

    /// The bucket's name.
    pub fn bucket(&self) -> &str {
        &self.bucket
    }

    /// Without slashes at its ends; empty for the whole bucket.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }
}

impl FromStr for BucketLocation {
    type Err = BucketLocationError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = |reason| BucketLocationError {
            text: text.to_owned(),
            reason,
        };
        let rest = text.strip_prefix("s3://");
        let rest = rest.ok_or_else(|| wrong("it does not begin with s3://"))?;
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        let plain = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        if bucket.is_empty() || !bucket.chars().all(plain) {
            return Err(wrong(
                "a bucket's name has letters, digits, dots and hyphens only",
            ));
        }
        let prefix = prefix.trim_matches('/');
        if !prefix.is_empty() {
            super::check_name(prefix).map_err(|_| {
                wrong("names in buckets are relative, without empty or hidden parts")
            })?;
        }
        Ok(Self {
            bucket: bucket.to_owned(),
            prefix: prefix.to_owned(),
        })
    }
}

impl fmt::Display for BucketLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "s3://{}", self.bucket)?;
        if self.prefix.is_empty() {
            Ok(())
        } else {
            write!(f, "/{}", self.prefix)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_are_read_or_refused() {
        for (text, bucket, prefix, shown) in [
            ("s3://b", "b", "", "s3://b"),
            ("s3://my.lab-1/", "my.lab-1", "", "s3://my.lab-1"),
            (
                "s3://b/2026/cortex 3//",
                "b",
                "2026/cortex 3",
                "s3://b/2026/cortex 3",
            ),
        ] {
            let read: BucketLocation = text.parse().unwrap();
            assert_eq!((read.bucket(), read.prefix()), (bucket, prefix));
            assert_eq!(read.to_string(), shown);
        }
        for bad in [
            "s3:b",
            "s3:/b",
            "s3://",
            "s3:///a",
            "s3://b c",
            "s3://b/../c",
            "s3://b/a//c",
            "folder",
        ] {
            let error = bad.parse::<BucketLocation>().unwrap_err().to_string();
            assert!(error.contains("s3://bucket"), "{error}");
        }
        assert!(BucketLocation::is_meant_by("s3:b") && !BucketLocation::is_meant_by("s3/b"));
    }
}
