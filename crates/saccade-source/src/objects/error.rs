use std::ops::Range;
use std::time::Duration;

/// Why an object could not be read. That there is none is no error.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ObjectError {
    /// A key that leads out of its store: the caller's mistake, or a trick in foreign metadata.
    #[error("{key:?} names nothing below {location}")]
    Key {
        /// As asked for.
        key: String,
        /// Folder or address.
        location: String,
    },
    /// The store forbids it.
    #[error("access is denied; {advice}: {location}")]
    Denied {
        /// How to mend it.
        advice: &'static str,
        /// File or address.
        location: String,
    },
    /// The store forbids it, as it forbids objects that nobody has: it may be missing.
    #[error(
        "access is denied, as it is to objects that are not there, so that this one may be missing or forbidden; log in, or let forbidden \
         objects be taken for missing ones: {location}"
    )]
    Unclear {
        /// Address.
        location: String,
    },
    /// The store answers with something else than the object.
    #[error("instead of the object, the answer is {answer}: {location}")]
    Answer {
        /// What came.
        answer: String,
        /// Address.
        location: String,
    },
    /// The store does not answer, or not wholly, however often it is asked.
    #[error("not read in {attempts} attempts: {reason}: {location}")]
    Unavailable {
        /// Times it was asked.
        attempts: u32,
        /// What went wrong the last time.
        reason: String,
        /// File or address.
        location: String,
    },
    /// Parts of it were read, and now there is another object in its place.
    #[error("it was replaced while it was read; open the image again: {location}")]
    Replaced {
        /// Address.
        location: String,
    },
    /// The object is longer than it may be.
    #[error("it has more than {most} bytes, which is more than it can need: {location}")]
    TooLong {
        /// Bytes it may have.
        most: u64,
        /// File or address.
        location: String,
    },
    /// The object ends before a range that something else says is there.
    #[error("it ends before byte {}: {location}", wanted.end)]
    TooShort {
        /// What was asked for \[bytes\].
        wanted: Range<u64>,
        /// File or address.
        location: String,
    },
    /// Something lies in its place that is not read.
    #[error("{what}: {location}")]
    NoFile {
        /// What it is, and how to mend it.
        what: &'static str,
        /// File.
        location: String,
    },
    /// The system cannot read a file.
    #[error("cannot read {location}")]
    Io {
        /// What it says.
        source: std::io::Error,
        /// File.
        location: String,
    },
}

impl ObjectError {
    /// What is wrong, without saying where the image is kept: for those who only look.
    pub fn without_place(&self) -> String {
        let location = match self {
            Self::Key { key, .. } => return format!("{key:?} names nothing there"),
            Self::Io { source, .. } => return format!("its file cannot be read: {source}"),
            Self::Denied { location, .. }
            | Self::Unclear { location }
            | Self::Answer { location, .. }
            | Self::Unavailable { location, .. }
            | Self::Replaced { location }
            | Self::TooLong { location, .. }
            | Self::NoFile { location, .. }
            | Self::TooShort { location, .. } => location,
        };
        let whole = self.to_string();
        match whole.strip_suffix(location.as_str()) {
            Some(rest) => rest.trim_end_matches(": ").to_owned(),
            None => whole,
        }
    }

    /// Whether the same may succeed later.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Unavailable { .. } | Self::Io { .. })
    }
}

/// Why one attempt failed, and whether another makes sense.
#[derive(Debug)]
pub(super) enum Failure {
    /// Another attempt may succeed, after a wait if the store says so.
    Again {
        reason: String,
        wait: Option<Duration>,
    },
    /// No attempt will.
    Final(ObjectError),
}

impl Failure {
    pub(super) fn again(reason: impl ToString) -> Self {
        Self::Again {
            reason: reason.to_string(),
            wait: None,
        }
    }
}
