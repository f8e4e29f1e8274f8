//! Ingest as a whole: what arrives, what is refused, what fails, what is killed.

mod faults;
mod kill;
mod quarantine;
mod scope;
mod stream;
