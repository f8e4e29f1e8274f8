//! The rows, in groups that are measured together.

mod codec;
mod construct;
mod first_light;
mod index;
mod ingest;
mod render;
mod resample;
mod section;
mod serve;
mod versus;

use anyhow::Result;

use crate::report::Row;

/// Rows that share their set-up.
pub(crate) struct Group {
    pub(crate) ids: &'static [&'static str],
    pub(crate) measure: fn() -> Result<Vec<Row>>,
}

pub(crate) static GROUPS: &[Group] = &[
    Group {
        ids: first_light::IDS,
        measure: first_light::measure,
    },
    Group {
        ids: ingest::IDS,
        measure: ingest::measure,
    },
    Group {
        ids: ingest::MEMORY_IDS,
        measure: ingest::measure_memory,
    },
    Group {
        ids: ingest::SIMULATE_IDS,
        measure: ingest::simulate,
    },
    Group {
        ids: codec::IDS,
        measure: codec::measure,
    },
    Group {
        ids: construct::IDS,
        measure: construct::measure,
    },
    Group {
        ids: section::IDS,
        measure: section::measure,
    },
    Group {
        ids: resample::IDS,
        measure: resample::measure,
    },
    Group {
        ids: index::IDS,
        measure: index::measure,
    },
    Group {
        ids: render::IDS,
        measure: render::measure,
    },
    Group {
        ids: serve::SLOWLORIS_IDS,
        measure: serve::measure_slowloris,
    },
    Group {
        ids: serve::NGINX_IDS,
        measure: serve::measure_nginx,
    },
    Group {
        ids: versus::DENSE_IDS,
        measure: versus::vs_dense_texture,
    },
    Group {
        ids: versus::SMALL_IDS,
        measure: versus::vs_small_volume,
    },
    Group {
        ids: versus::PAGE_TABLES_IDS,
        measure: versus::vs_page_tables,
    },
];

/// A Tokio runtime as the command line uses it.
fn runtime() -> Result<tokio::runtime::Runtime> {
    Ok(tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?)
}
