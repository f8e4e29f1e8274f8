//! Ingest as a whole: what arrives, what is refused, what fails, what is killed.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![allow(
    clippy::disallowed_methods,
    reason = "tests also wait for what really happens"
)]

mod bare;
mod crashes;
mod faults;
mod in_the_way;
mod kill;
mod kinds;
mod lists;
mod mended;
#[path = "../../../saccade-archive/tests/support/postgres.rs"]
mod postgres;
mod pretended;
mod quarantine;
mod replaced;
mod scope;
mod spoilt;
mod stream;
mod told;
mod workers;
