//! What it means that a store refuses an object: that it may not be read, or that there is none.
//!
//! Stores that do not let their readers list what there is refuse whatever they do not have, so that of most
//! sparse images there are refusals without end. A login that has run out looks the same, and what it hides is not
//! empty. So each refusal is judged by what the store says *after* it: an object that could be read before and still
//! can shows that the login was good when the refusal came. Refusals that came before the question share its answer.
//!
//! That they mean nothing is a guess, which is given up where it is contradicted: a store that says of any object that there is none
//! (404, 410) would say so of this one, and one that could be read before is there. Where a hole for good would come of the guess, as in a
//! copy of the image, nobody guesses ([`Refusals::stop_guessing`]).

use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use bytes::Bytes;
use quick_cache::sync::Cache;
use tokio::sync::Mutex;

use super::ObjectError;
use crate::maybe_send::BoxFuture;

/// Names an object that nobody has.
pub(super) const NOBODYS: &str = "saccade-asks-whether-missing-objects-are-forbidden";
/// Objects that were read, and are known to be there.
const KNOWN: usize = 1 << 14;

/// What a store answers to one question.
#[derive(Debug)]
pub(super) enum Found {
    Object(Bytes),
    Nothing,
    /// Whoever asks may not read it, or there is none.
    Forbidden,
    /// Whoever asks is not known, or not any more. Never a way to say that there is none.
    Unknown,
}

/// Why an object is not there to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// There is none.
    Missing,
    /// It may not be read.
    Denied,
    /// Either of these: as objects that nobody has are refused as well, nobody can tell.
    Unclear,
    /// Nothing may be read any more.
    Expired,
}

/// How to mend [`Refusal::Expired`].
pub(super) const EXPIRED: &str = "what could be read before is refused now; the login, or the token in the address, may have run out: \
     renew it and open the image again";

/// What a store refused so far.
#[derive(Debug)]
pub(super) struct Refusals {
    /// Whether any answer was other than a refusal.
    heard: AtomicBool,
    /// Whether an object that nobody has was refused.
    forbids_missing: AtomicBool,
    /// Whether it said of any object that there is none.
    tells_missing: AtomicBool,
    /// Whether what is refused is not taken for missing, whatever else is refused.
    guesses_no_more: AtomicBool,
    /// Objects that were read.
    granted: Cache<String, ()>,
    /// The newest of them: an image's description may be open to all while its voxels are not.
    newest: std::sync::Mutex<Option<String>>,
    /// Judgements that were begun.
    begun: AtomicU64,
    judged: Mutex<Judged>,
}

/// Why nothing could be found out.
#[derive(Debug)]
struct Unjudged {
    attempts: u32,
    reason: String,
}

#[derive(Debug, Default)]
struct Judged {
    /// Number of the newest judgement, and what it was.
    last: Option<(u64, Result<Refusal, Unjudged>)>,
    /// Whether objects that nobody has are refused, and whether the login was good when it was asked.
    forbids: Option<(bool, bool)>,
}

impl Default for Refusals {
    fn default() -> Self {
        Self {
            heard: AtomicBool::default(),
            forbids_missing: AtomicBool::default(),
            tells_missing: AtomicBool::default(),
            guesses_no_more: AtomicBool::default(),
            granted: Cache::new(KNOWN),
            newest: std::sync::Mutex::default(),
            begun: AtomicU64::default(),
            judged: Mutex::default(),
        }
    }
}

impl Refusals {
    /// The object, or `None` if there is none, of what a store answers; `ask` asks for another one.
    pub(super) async fn settle<'a>(
        &self,
        key: &str,
        found: Found,
        location: &str,
        ask: impl Fn(String) -> BoxFuture<'a, Result<Found, ObjectError>>,
    ) -> Result<Result<Bytes, Refusal>, ObjectError> {
        match found {
            Found::Object(bytes) => {
                self.heard.store(true, Ordering::Relaxed);
                self.grant(key);
                return Ok(Ok(bytes));
            }
            Found::Nothing => {
                self.heard.store(true, Ordering::Relaxed);
                self.tells_missing.store(true, Ordering::Relaxed);
                return Ok(Err(Refusal::Missing));
            }
            // It is there.
            Found::Forbidden if self.granted.get(key).is_some() => {
                return Ok(Err(Refusal::Expired));
            }
            Found::Forbidden => {}
            Found::Unknown => {
                let expired = self.newest().is_some();
                return Ok(Err(if expired {
                    Refusal::Expired
                } else {
                    Refusal::Denied
                }));
            }
        }
        // What is begun from here on is begun after the refusal.
        let before = self.begun.load(Ordering::SeqCst);
        let mut judged = self.judged.lock().await;
        match &judged.last {
            Some((number, Ok(refusal))) if *number > before => return Ok(Err(*refusal)),
            Some((number, Err(why))) if *number > before => {
                return Err(ObjectError::Unavailable {
                    attempts: why.attempts,
                    reason: why.reason.clone(),
                    location: location.to_owned(),
                });
            }
            _ => {}
        }
        let number = self.begun.fetch_add(1, Ordering::SeqCst) + 1;
        let result = self.judge(&mut judged.forbids, location, ask).await;
        let kept = result.as_ref().map_err(|error| match error {
            ObjectError::Unavailable {
                attempts, reason, ..
            } => Unjudged {
                attempts: *attempts,
                reason: reason.clone(),
            },
            error => Unjudged {
                attempts: 1,
                reason: error.without_place(),
            },
        });
        judged.last = Some((number, kept.copied()));
        result.map(Err)
    }

    async fn judge<'a>(
        &self,
        forbids: &mut Option<(bool, bool)>,
        location: &str,
        ask: impl Fn(String) -> BoxFuture<'a, Result<Found, ObjectError>>,
    ) -> Result<Refusal, ObjectError> {
        let ask = async |key: &str| match ask(key.to_owned()).await {
            // It was let through, whatever is wrong with it.
            Err(
                ObjectError::TooShort { .. }
                | ObjectError::TooLong { .. }
                | ObjectError::Replaced { .. },
            ) => Ok(Found::Object(Bytes::new())),
            asked => asked,
        };
        let granted = self.newest();
        let granted = granted.as_deref();
        let known = match *forbids {
            // Nothing is left to ask with before anything could be read.
            Some((refused, _)) if granted.is_none() => Some(refused),
            Some((true, true)) => Some(true),
            _ => None,
        };
        let tells = || self.tells_missing.load(Ordering::Relaxed);
        let known = if tells() { Some(false) } else { known };
        let refused = match known {
            Some(refused) => refused,
            None => match ask(NOBODYS).await? {
                Found::Unknown if granted.is_some() => return Ok(Refusal::Expired),
                Found::Unknown => return Ok(Refusal::Denied),
                Found::Forbidden => true,
                Found::Nothing => {
                    self.tells_missing.store(true, Ordering::Relaxed);
                    false
                }
                Found::Object(_) => false,
            },
        };
        if !refused {
            *forbids = Some((false, true));
            return Ok(Refusal::Denied);
        }
        // Asked last: what was refused before was refused to somebody who may read this.
        if let Some(granted) = granted {
            match ask(granted).await? {
                Found::Forbidden | Found::Unknown => return Ok(Refusal::Expired),
                Found::Nothing => self.tells_missing.store(true, Ordering::Relaxed),
                Found::Object(_) => {}
            }
        }
        // Another may have been heard of meanwhile.
        if tells() {
            return Ok(Refusal::Denied);
        }
        *forbids = Some((true, granted.is_some()));
        let guesses = !self.guesses_no_more.load(Ordering::Relaxed);
        if !self.forbids_missing.swap(true, Ordering::Relaxed) && guesses {
            log::warn!(
                "forbidden objects are taken for missing ones, as all missing ones are forbidden, such as {location}"
            );
        }
        Ok(match guesses {
            true => Refusal::Missing,
            false => Refusal::Unclear,
        })
    }

    fn grant(&self, key: &str) {
        if self.granted.get(key).is_none() {
            self.granted.insert(key.to_owned(), ());
        }
        let mut newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        if newest.as_deref() != Some(key) {
            *newest = Some(key.to_owned());
        }
    }

    fn newest(&self) -> Option<String> {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        newest.clone()
    }

    /// What is refused from here on is never taken for missing.
    pub(super) fn stop_guessing(&self) {
        self.guesses_no_more.store(true, Ordering::Relaxed);
    }

    /// Whether all that was asked for so far was refused, even what there cannot be.
    pub(super) fn all_refused(&self) -> bool {
        self.forbids_missing.load(Ordering::Relaxed) && !self.heard.load(Ordering::Relaxed)
    }
}
