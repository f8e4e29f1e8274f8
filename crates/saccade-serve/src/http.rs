//! Tags, conditions, ranges and refusals.

mod range;
mod refusal;
mod tag;

pub(crate) use range::{Requested, requested};
pub(crate) use refusal::{Refusal, cause, failing, not_found, refusal, try_again};
pub(crate) use tag::{Tag, mark_encoding};
#[cfg(any(test, fuzzing))]
pub(crate) use {range::fuzz as fuzz_range, tag::fuzz as fuzz_tag};
