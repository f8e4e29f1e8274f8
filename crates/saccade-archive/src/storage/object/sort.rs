//! What a store says, sorted into the caller's cases.

use std::error::Error as _;
use std::io;

use object_store::Error;

use crate::storage::StorageError;
use crate::storage::error::NO_BUCKET;

/// The HTTP status that ended a request, if one did.
///
/// `object_store` tells it in words only. The tests, which ask a server, notice if these change.
pub(super) fn status(error: &Error) -> Option<u16> {
    causes(error).into_iter().find_map(|text| {
        let (_, after) = text.split_once("status code: ")?;
        after.get(..3)?.parse().ok()
    })
}

fn chain(error: &Error) -> impl Iterator<Item = &(dyn std::error::Error + 'static)> {
    std::iter::successors(error.source(), |&e| e.source())
}

fn causes(error: &Error) -> Vec<String> {
    chain(error).map(|e| e.to_string()).collect()
}

const NO_CREDENTIALS: &str = "there are no credentials; set AWS_ACCESS_KEY_ID and \
    AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a bucket that everybody may read";

/// What is said where nobody can have any.
pub(super) fn no_credentials(path: &str) -> StorageError {
    let source = Error::Generic {
        store: "S3",
        source: "no AWS_ variable has any, and AWS_EC2_METADATA_DISABLED is set".into(),
    };
    StorageError::Refused {
        source: Box::new(source),
        advice: NO_CREDENTIALS,
        path: path.to_owned(),
    }
}

/// Whether there is no such object, though its bucket may be there.
pub(super) fn missing_object(error: &Error) -> bool {
    matches!(error, Error::NotFound { .. }) && !says(error, "NoSuchBucket")
}

/// Whether the store knows nothing of an upload in parts any more: it was aborted, or is complete.
pub(super) fn lost_upload(error: &Error) -> bool {
    says(error, "NoSuchUpload")
}

/// Whether the store cannot write an object only if there is none.
pub(super) fn knows_no_conditions(error: &Error) -> bool {
    matches!(error, Error::NotImplemented { .. }) || status(error) == Some(501)
}

fn says(error: &Error, what: &str) -> bool {
    causes(error).iter().any(|text| text.contains(what))
}

/// Sorts what is not about a missing object; `path` is for the message.
pub(super) fn sorted(error: Error, path: &str) -> StorageError {
    let path = path.to_owned();
    let status = status(&error);
    if lost_upload(&error) {
        return StorageError::Unavailable {
            source: Box::new(error),
            path,
        };
    }
    let advice = if says(&error, "NoSuchBucket") || matches!(error, Error::NotFound { .. }) {
        NO_BUCKET
    } else if says(&error, "AuthorizationHeaderMalformed")
        || says(&error, "PermanentRedirect")
        || says(&error, "incorrectly configured region")
        || matches!(status, Some(301 | 307 | 308))
    {
        "the bucket is in another region; set AWS_REGION to it"
    } else if says(&error, "169.254.") {
        NO_CREDENTIALS
    } else if matches!(status, Some(401 | 403))
        || matches!(
            error,
            Error::PermissionDenied { .. } | Error::Unauthenticated { .. }
        )
    {
        "access is denied; check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, what they allow in this \
         bucket, and this computer's clock"
    } else if status == Some(507) {
        let source = io::Error::other(error);
        return StorageError::Full { source, path };
    } else if matches!(status, Some(408 | 429 | 500..)) || is_transport(&error) {
        return StorageError::Unavailable {
            source: Box::new(error),
            path,
        };
    } else {
        "the object store refuses the request; check AWS_ENDPOINT_URL and the other AWS_ variables"
    };
    StorageError::Refused {
        source: Box::new(error),
        advice,
        path,
    }
}

/// Whether the request did not get there, or its answer not back.
pub(super) fn is_transport(error: &Error) -> bool {
    chain(error).any(|e| e.is::<object_store::client::HttpError>())
}

/// Whether an answer began to come, and not all of it came.
pub(super) fn is_broken_off(error: &Error) -> bool {
    is_transport(error) && says(error, "response body")
}
