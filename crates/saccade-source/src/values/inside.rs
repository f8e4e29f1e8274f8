//! Which numbers of a chunk are of the image.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// Which numbers of a chunk are of the image, where not all are: chunks at its end are stored whole, and what they have beyond it
/// is anything.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Inside {
    /// Of axes, slowest first: how long they are, and how much of that, from their beginning on, is of the image.
    axes: Vec<(usize, usize)>,
}

impl Inside {
    /// From the axes of a chunk, slowest first: their length, and how much of it is of the image. `None` where all is.
    pub(crate) fn new(axes: impl IntoIterator<Item = (usize, usize)>) -> Option<Self> {
        let mut merged: Vec<(usize, usize)> = axes.into_iter().collect();
        // Whole lines that follow each other are one.
        while let [.., outer, inner] = &mut merged[..]
            && inner.0 == inner.1
        {
            *outer = (outer.0 * inner.0, outer.1 * inner.0);
            merged.pop();
        }
        { merged.iter().any(|(length, inside)| inside < length) }.then_some(Self { axes: merged })
    }

    /// Where they are, in order.
    pub(crate) fn runs(&self) -> impl Iterator<Item = Range<usize>> {
        let (inner, outer) = match self.axes.split_last() {
            Some((inner, outer)) => (*inner, outer),
            None => ((0, 0), &[][..]),
        };
        let count: usize = outer.iter().map(|(_, inside)| inside).product();
        (0..count).map(move |mut number| {
            let (length, inside) = inner;
            let (mut start, mut stride) = (0, length);
            for (length, inside) in outer.iter().rev() {
                start += number % inside * stride;
                number /= inside;
                stride *= length;
            }
            start..start + inside
        })
    }
}

#[cfg(all(test, not(target_family = "wasm")))]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn whole_chunks_need_no_words() {
        assert_eq!(Inside::new([(3, 3), (5, 5)]), None);
        assert_eq!(Inside::new([]), None);
        let lines = Inside::new([(1, 1), (4, 3), (5, 5), (7, 7)]).unwrap();
        assert!(lines.runs().eq(std::iter::once(0..105)));
        let rows = Inside::new([(2, 2), (3, 1), (5, 4)]).unwrap();
        assert!(rows.runs().eq([0..4, 15..19]));
    }

    proptest! {
        #[test]
        fn runs_have_each_number_inside_once(axes in prop::collection::vec((1_usize..6, 0_usize..6), 1..5)) {
            let axes: Vec<(usize, usize)> = { axes.into_iter() }
                .map(|(length, less)| (length, length - less % length))
                .collect();
            let all: usize = axes.iter().map(|(length, _)| length).product();
            let is_inside = |number: &usize| {
                let mut rest = *number;
                axes.iter().rev().all(|(length, inside)| {
                    let at = rest % length;
                    rest /= length;
                    at < *inside
                })
            };
            let want: Vec<usize> = (0..all).filter(is_inside).collect();
            let got = Inside::new(axes.clone());
            let got: Vec<usize> = got.map_or((0..all).collect(), |inside| inside.runs().flatten().collect());
            prop_assert_eq!(got, want);
        }
    }
}
