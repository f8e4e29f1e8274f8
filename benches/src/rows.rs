//! The rows, in groups that are measured together.

mod attackers;
mod blocks;
mod codec;
mod construct;
mod first_light;
mod frame_cost;
mod image;
mod index;
mod ingest;
mod petascale;
mod render;
mod resample;
mod restart;
mod section;
mod serve;
mod streaming;
mod table_9_1;
mod update;
mod versus;
mod watch;
mod workers;
mod working_set;
mod zarr_reads;

use anyhow::Result;

use crate::report::Row;
use crate::settings::Settings;

/// Rows that share their set-up.
pub(crate) struct Group {
    pub(crate) ids: &'static [&'static str],
    /// Measures those that are wanted, or all of the group.
    pub(crate) measure: fn(&Settings) -> Result<Vec<Row>>,
}

pub(crate) static GROUPS: &[Group] = &[
    Group {
        ids: first_light::IDS,
        measure: |_| first_light::measure(),
    },
    Group {
        ids: update::IDS,
        measure: |_| update::measure(),
    },
    Group {
        ids: update::REMOTE_IDS,
        measure: |_| update::measure_remote(),
    },
    Group {
        ids: ingest::IDS,
        measure: |_| ingest::measure(),
    },
    Group {
        ids: ingest::SUSTAINED_IDS,
        measure: |_| ingest::measure_sustained(),
    },
    Group {
        ids: ingest::MEMORY_IDS,
        measure: |_| ingest::measure_memory(),
    },
    Group {
        ids: workers::IDS,
        measure: |_| workers::measure(),
    },
    Group {
        ids: ingest::SIMULATE_IDS,
        measure: |_| ingest::simulate(),
    },
    Group {
        ids: watch::IDS,
        measure: watch::measure,
    },
    Group {
        ids: codec::IDS,
        measure: |_| codec::measure(),
    },
    Group {
        ids: construct::IDS,
        measure: |_| construct::measure(),
    },
    Group {
        ids: blocks::IDS,
        measure: |_| blocks::measure(),
    },
    Group {
        ids: section::IDS,
        measure: |_| section::measure(),
    },
    Group {
        ids: resample::IDS,
        measure: |_| resample::measure(),
    },
    Group {
        ids: zarr_reads::IDS,
        measure: |_| zarr_reads::measure(),
    },
    Group {
        ids: index::IDS,
        measure: |_| index::measure(),
    },
    Group {
        ids: restart::IDS,
        measure: |_| restart::measure(),
    },
    Group {
        ids: render::IDS,
        measure: render::measure,
    },
    Group {
        ids: render::SEGMENTED_IDS,
        measure: render::measure_segmented,
    },
    Group {
        ids: serve::SLOWLORIS_IDS,
        measure: |_| serve::measure_slowloris(),
    },
    Group {
        ids: serve::NGINX_IDS,
        measure: |_| serve::measure_nginx(),
    },
    Group {
        ids: serve::LONG_IDS,
        measure: serve::measure_long,
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
    Group {
        ids: table_9_1::IDS,
        measure: table_9_1::measure,
    },
    Group {
        ids: table_9_1::LEAF_IDS,
        measure: table_9_1::leaf_sizes,
    },
    Group {
        ids: image::IDS,
        measure: image::measure,
    },
    Group {
        ids: working_set::IDS,
        measure: working_set::measure,
    },
    Group {
        ids: petascale::TABLE_1_IDS,
        measure: petascale::table_1,
    },
    Group {
        ids: petascale::TABLE_2_IDS,
        measure: petascale::table_2,
    },
    Group {
        ids: petascale::FIGURE_6_IDS,
        measure: petascale::figure_6,
    },
    Group {
        ids: petascale::FIGURE_7_IDS,
        measure: petascale::figure_7,
    },
    Group {
        ids: frame_cost::CPU_IDS,
        measure: frame_cost::cpu_time,
    },
    Group {
        ids: frame_cost::OCTREE_IDS,
        measure: |_| frame_cost::octree(),
    },
    Group {
        ids: streaming::STREAMING_IDS,
        measure: streaming::streaming,
    },
    Group {
        ids: streaming::FLIGHT_IDS,
        measure: streaming::flight,
    },
];

pub(crate) use attackers::attack;
pub(crate) use workers::worker;

/// A Tokio runtime as the command line uses it.
fn runtime() -> Result<tokio::runtime::Runtime> {
    Ok(tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?)
}
