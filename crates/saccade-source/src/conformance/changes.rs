use futures::StreamExt;
use saccade_core::voxel_box::VoxelBox;

use super::reading::some_chunks;
use super::{Oracle, Violation, compare, ensure, read_bytes, violation};
use crate::{Change, ChangeReason, VolumeSource};

/// After each of `count` changes the source says so, in order, and reads what `oracle` then says.
///
/// `change` changes something and returns the box of level-0 voxels it touched.
///
/// # Errors
///
/// The first [`Violation`].
pub async fn check_changes(
    source: &dyn VolumeSource,
    count: usize,
    mut change: impl AsyncFnMut() -> VoxelBox,
    oracle: impl Oracle,
    tolerance: u8,
) -> Result<(), Violation> {
    let volume = source.volume().clone();
    let mut changes = source.changes();
    let mut last = None;
    for _ in 0..count {
        // What was read before must not be what is read afterwards.
        for id in some_chunks(&volume) {
            read_bytes(source, id).await?;
        }
        let touched = change().await;
        let mut told = VoxelBox::EMPTY;
        while told.intersection(touched) != touched && !touched.is_empty() {
            let Some(change) = changes.next().await else {
                return Err(violation("tell changes", "the stream of changes ended"));
            };
            check_order(source, &mut last, change)?;
            told = told.union(change.voxels);
        }
        for id in some_chunks(&volume) {
            let got = read_bytes(source, id).await?;
            compare(source, id, &got, &oracle(id), tolerance)?;
        }
    }
    Ok(())
}

/// After `cause` made a listener miss changes, the next change it gets is
/// [`ChangeReason::Missed`] and covers the volume; then all goes on in order.
///
/// # Errors
///
/// The first [`Violation`].
pub async fn check_missed(
    source: &dyn VolumeSource,
    cause: impl AsyncFnOnce(),
    mut change: impl AsyncFnMut() -> VoxelBox,
) -> Result<(), Violation> {
    const RULE: &str = "say that changes were missed";
    let mut changes = source.changes();
    cause().await;
    let Some(missed) = changes.next().await else {
        return Err(violation(RULE, "the stream of changes ended"));
    };
    ensure(missed.reason == ChangeReason::Missed, RULE, || {
        format!("the next change was {missed:?}")
    })?;
    let mut last = None;
    check_order(source, &mut last, missed)?;
    for _ in 0..3 {
        change().await;
        let Some(change) = changes.next().await else {
            return Err(violation(RULE, "the stream of changes ended"));
        };
        check_order(source, &mut last, change)?;
    }
    Ok(())
}

/// Whoever comes back with a revision that the volume had learns of all that has changed since, and of nothing before; of a
/// revision that it never had nothing is known.
///
/// `change` changes something and returns the box of level-0 voxels it touched. For sources that remember these changes.
///
/// # Errors
///
/// The first [`Violation`].
pub async fn check_changes_after(
    source: &dyn VolumeSource,
    mut change: impl AsyncFnMut() -> VoxelBox,
) -> Result<(), Violation> {
    const RULE: &str = "tell what has changed since a revision";
    const CHANGES: usize = 4;
    let mut news = source.changes();
    let mut made = Vec::new();
    for _ in 0..CHANGES {
        let before = source.revision();
        let touched = change().await;
        let mut told = VoxelBox::EMPTY;
        while told.intersection(touched) != touched {
            let Some(change) = news.next().await else {
                return Err(violation(RULE, "the stream of changes ended"));
            };
            told = told.union(change.voxels);
        }
        made.push((before, touched));
    }
    for (n, &(since, _)) in made.iter().enumerate() {
        let Some(told) = source.changes_after(since).await else {
            return Err(violation(RULE, format!("of {since} nothing is known")));
        };
        let mut last = None;
        for change in &told {
            check_order(source, &mut last, *change)?;
            ensure(change.revision > since, RULE, || {
                format!("{change:?} is not after {since}")
            })?;
        }
        for (_, touched) in &made[n..] {
            let is_told = |voxel| told.iter().any(|change| change.voxels.contains(voxel));
            ensure(touched.iter().all(is_told), RULE, || {
                format!("{touched} changed after {since}, and only {told:?} is told")
            })?;
        }
    }
    let now = source.revision();
    let nothing = source.changes_after(now).await;
    ensure(nothing.as_ref().is_some_and(Vec::is_empty), RULE, || {
        format!("{nothing:?} is after the newest revision {now}")
    })?;
    let other = source.changes_after(now + 1000).await;
    ensure(other.is_none(), RULE, || {
        format!("{other:?} is told after {}, which it never had", now + 1000)
    })
}

fn check_order(
    source: &dyn VolumeSource,
    last: &mut Option<u64>,
    change: Change,
) -> Result<(), Violation> {
    // One revision may bring several changes.
    let in_order = last.is_none_or(|last| change.revision >= last);
    ensure(in_order, "tell changes in order of revision", || {
        format!("{change:?} came after revision {last:?}")
    })?;
    *last = Some(change.revision);
    let missed = change.reason == ChangeReason::Missed;
    let whole = VoxelBox::of_size(source.volume().extent());
    let covers = change.voxels.intersection(whole) == whole;
    ensure(
        covers || !missed,
        "cover everything when changes were missed",
        || format!("{change:?} does not cover {whole}"),
    )
}
