//! What the catalog promises, on SQLite and on PostgreSQL: order, revisions, boxes, all or nothing,
//! several processes, several workers.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![allow(
    clippy::disallowed_methods,
    reason = "tests also wait for what really happens"
)]
#![expect(clippy::cast_possible_truncation, reason = "small whole numbers")]

mod place;
#[path = "../support/postgres.rs"]
mod postgres;
mod properties;
mod rectified;
mod server;
mod spoilt;
mod sqlite;
mod suite;
mod whose;
mod workers;

/// Each of these promises holds wherever a catalog is.
macro_rules! on_both {
    ($($module:ident::$name:ident),* $(,)?) => {
        mod on_sqlite {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                crate::$module::$name(&crate::place::Place::file()).await;
            })*
        }
        mod on_postgres {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                if let Some(place) = crate::place::Place::database().await {
                    crate::$module::$name(&place).await;
                }
            })*
        }
    };
}

on_both! {
    suite::a_tile_is_what_was_entered,
    suite::a_moved_tile_changes_its_old_and_its_new_place,
    suite::nothing_leaves_the_volume,
    suite::an_early_transform_waits_for_its_tile,
    suite::a_deleted_tile_is_gone_until_a_later_record_brings_it_back,
    suite::channels_stay_apart,
    suite::a_replaced_pyramid_is_retired_not_forgotten,
    suite::a_commit_happens_whole_or_not_at_all,
    suite::tiles_are_found_by_id,
    suite::sections_are_those_with_tiles,
    suite::channels_have_the_sections_of_their_tiles,
    suite::long_histories_come_in_pieces_without_gaps,
    suite::other_processes_commits_are_heard,
    suite::several_writers_take_turns,
    suite::other_sizes_and_unknown_names_are_refused,
    rectified::names_go_where_they_belong_and_nobody_hears_of_it,
    rectified::rows_are_rectified_as_they_were_found_or_not_at_all,
    rectified::who_follows_hears_what_is_shown_again_and_taken_away,
    rectified::who_is_ahead_of_what_was_read_is_found_and_follows_again,
    spoilt::a_spoilt_tile_is_told_and_goes_with_its_next_record,
    spoilt::where_a_tile_of_no_size_lies_is_kept_until_it_has_one,
    spoilt::a_record_that_is_done_once_more_moves_nothing_back,
    spoilt::chunks_that_no_memory_holds_make_no_volume,
    spoilt::what_is_queued_and_cannot_be_understood_is_set_aside,
    spoilt::what_a_tile_names_is_not_on_the_list_of_what_is_to_be_deleted,
    spoilt::what_no_program_of_ours_does_to_a_tile_is_found,
    whose::another_archives_catalog_is_neither_read_nor_written,
    whose::a_table_that_is_gone_is_named_with_the_way_out,
    workers::workers_share_what_is_to_be_done,
    workers::a_dead_workers_claims_return,
    workers::a_sign_of_life_keeps_claims,
    workers::records_of_a_tile_are_worked_on_in_order,
    workers::who_leaves_gives_back,
    workers::what_the_dead_had_is_free_at_once,
    workers::records_are_read_once,
    workers::old_changes_are_forgotten_and_said_to_be,
    workers::workers_that_die_lose_nothing,
}
