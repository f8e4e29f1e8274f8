//! Pictures against a brute-force ray-caster, and the caches at work, on whatever GPU there is.
//!
//! Without an adapter these tests print so and pass; `SACCADE_GPU_TESTS=require` makes that a
//! failure. `SACCADE_GPU_TEST_IMAGES=DIR` keeps the pictures.

#![expect(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]
#![expect(clippy::cast_possible_truncation, reason = "values are made to fit")]

mod behaviour;
mod channels;
mod extremes;
mod false_colors;
mod functions;
mod fuzz;
mod harness;
mod labels;
mod modes;
mod octree;
mod oracle;
mod pictures;
mod residency;
mod scene;
mod thin;
