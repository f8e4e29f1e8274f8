//! Voxels that are larger than any pixel: each from several samples.

use glam::UVec2;

use super::Sample;
use super::sample::FINE_BITS;

/// Each `by` x `by` values become one, `by` up to 16: the mean of those that are not 0, which is rounded
/// nowhere before.
pub(in crate::stitched) fn averaged<S: Sample>(values: &[S::Fine], size: UVec2, by: u32) -> Vec<S> {
    let (width, by) = (size.x as usize * by as usize, by as usize);
    let mut averaged = Vec::with_capacity(size.x as usize * size.y as usize);
    let mut sums = vec![(0_u32, 0_u32); size.x as usize];
    for rows in values.chunks_exact(width * by) {
        sums.fill((0, 0));
        for row in rows.chunks_exact(width) {
            for (values, (sum, count)) in row.chunks_exact(by).zip(&mut sums) {
                // 256 of at most (2^16 - 1) * 2^8 each: less than 2^32.
                *sum += values.iter().map(|v| (*v).into()).sum::<u32>();
                let there = values.iter().filter(|v| **v != S::Fine::default());
                *count += u32::try_from(there.count()).unwrap_or(0);
            }
        }
        averaged.extend(sums.iter().map(|(sum, count)| {
            let whole = u64::from(*count) << FINE_BITS;
            let mean = (u64::from(*sum) + whole / 2)
                .checked_div(whole)
                .unwrap_or(0);
            S::of(u16::try_from(mean).expect("a mean of 16-bit values has 16 bits"))
        }));
    }
    averaged
}

/// Each `by` x `by` values become one: the most frequent of those that are `there`, of several the
/// smallest; 0 where none is. So do labels of pyramids ([`saccade_archive::pyramid::encode_labels`]).
pub(in crate::stitched) fn most_frequent<S: Sample>(
    values: &[S],
    there: &[bool],
    size: UVec2,
    by: u32,
) -> Vec<S> {
    let (width, by) = (size.x as usize * by as usize, by as usize);
    let mut labels = Vec::with_capacity(size.x as usize * size.y as usize);
    let mut votes = Vec::with_capacity(by * by);
    let rows = values.chunks_exact(width * by);
    for (values, there) in rows.zip(there.chunks_exact(width * by)) {
        for x in (0..width).step_by(by) {
            votes.clear();
            for y in (0..by).map(|y| y * width) {
                let row = y + x..y + x + by;
                let row = values[row.clone()].iter().zip(&there[row]);
                votes.extend(row.filter(|(_, there)| **there).map(|(value, _)| *value));
            }
            labels.push(winner(&mut votes));
        }
    }
    labels
}

/// The most frequent of some labels, of several the smallest; 0 of none.
fn winner<S: Sample>(votes: &mut [S]) -> S {
    let first = votes.first().copied().unwrap_or_default();
    // Most voxels lie within one object.
    if votes.iter().all(|vote| *vote == first) {
        return first;
    }
    votes.sort_unstable();
    let (mut most, mut label) = (0, first);
    for same in votes.chunk_by(|a, b| a == b) {
        if same.len() > most {
            (most, label) = (same.len(), same[0]);
        }
    }
    label
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_leave_out_what_is_not_there() {
        let values = [1, 2, 0, 0, 4, 6, 0, 9, 0, 0, 255, 255, 0, 0, 255, 254];
        let fine = values.map(|value| value << 8);
        assert_eq!(averaged::<u8>(&fine, UVec2::new(2, 2), 2), [3, 9, 0, 255]);
        let whole = averaged::<u8>(&fine, UVec2::new(4, 4), 1);
        assert!(whole.into_iter().map(u16::from).eq(values));
    }

    #[test]
    fn means_are_rounded_once() {
        // Of 10.498 and 11.498, and of 10.502 and 11.502: rounded first, both pairs are alike.
        let size = UVec2::new(1, 1);
        assert_eq!(averaged::<u8>(&[2688, 2688, 2943, 2943], size, 2), [11]);
        assert_eq!(averaged::<u8>(&[2687, 2687, 2687, 2688], size, 2), [10]);
        let largest = vec![u32::from(u16::MAX) << 8; 256];
        assert_eq!(averaged::<u16>(&largest, size, 16), [u16::MAX]);
    }

    #[test]
    fn labels_are_voted_for_by_those_that_are_there() {
        let values = [7, 7, 0, 0, 9, 3, 0, 200, 5, 4, 0, 0, 4, 5, 0, 0];
        let mut there = [true; 16];
        let voted = |there: &[bool]| most_frequent::<u8>(&values, there, UVec2::new(2, 2), 2);
        assert_eq!(voted(&there), [7, 0, 4, 0], "of several the smallest");
        there[2] = false;
        there[3] = false;
        there[6] = false;
        there[8..10].fill(false);
        there[12..14].fill(false);
        assert_eq!(voted(&there), [7, 200, 0, 0], "none is there");
        let all = [true; 16];
        assert_eq!(most_frequent(&values, &all, UVec2::new(4, 4), 1), values);
    }
}
