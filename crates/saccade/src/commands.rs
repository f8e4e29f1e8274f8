//! One module per subcommand.

pub(crate) mod check;
pub(crate) mod demo;
pub(crate) mod export;
mod followed;
pub(crate) mod ingest;
pub(crate) mod render;
pub(crate) mod serve;
pub(crate) mod simulate;
mod subject;
pub(crate) mod update;
pub(crate) mod view;
