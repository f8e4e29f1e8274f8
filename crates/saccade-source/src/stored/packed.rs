//! From objects to decoded pieces: those that have an object to themselves, and those that share one with an index.

use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream;

use super::replaced::{ATTEMPTS, Indexed, is_replaced, never_the_same};
use super::{PieceError, PieceId};
use crate::codecs::Damage;
use crate::decoding::{Decoding, decode};
use crate::maybe_send::{MaybeSend, MaybeSync};
use crate::objects::{Objects, Part};
use crate::values::Values;

/// Objects, or ranges of one, that are read at once.
pub(crate) const AT_ONCE: usize = 8;
/// Longest range that is read at once \[bytes\], unless a single piece is longer.
const MOST_AT_ONCE: u64 = 8 << 20;

/// A piece as stored numbers, or as values; `None` for one that is not stored.
pub(crate) type Raw = Result<Option<Bytes>, PieceError>;

/// A format whose pieces may share objects, each of which has an index of its pieces.
pub(crate) trait Packed: MaybeSend + MaybeSync {
    /// Where the pieces of an object are.
    type Index: MaybeSend + MaybeSync;

    /// What the pieces lie in.
    fn objects(&self) -> &dyn Objects;

    /// How messages name a piece.
    fn which(&self, id: PieceId) -> String;

    /// What becomes of its bytes; numbers stay as they are stored where there are no `values`.
    fn decoding(&self, id: PieceId, values: Option<&Arc<Values>>) -> Decoding;

    /// The index of the object `key`, in which `of` lies; none if there is no such object.
    fn index(
        &self,
        of: PieceId,
        key: &str,
    ) -> impl Future<Output = Result<Indexed<Self::Index>, PieceError>> + MaybeSend;

    /// Where a piece is, by the index of its object; `None` if it is not stored.
    fn range(&self, index: &Self::Index, id: PieceId) -> Result<Option<Range<u64>>, Damage>;

    /// The error of a piece that is not what it should be.
    fn damaged(&self, id: PieceId, key: &str, reason: Damage) -> PieceError {
        PieceError::Damaged {
            reason,
            which: self.which(id),
            location: self.objects().location(key),
        }
    }

    /// A part of an object, for a piece.
    async fn part(&self, id: PieceId, key: &str, part: Part) -> Raw {
        let read = self.objects().read(key, part).await;
        read.map_err(|source| PieceError::Unread {
            source: Arc::new(source),
            which: self.which(id),
        })
    }

    /// Decodes a piece; what came over a network and does not decode is read once more.
    async fn decoded(
        &self,
        id: PieceId,
        key: &str,
        part: Part,
        mut bytes: Bytes,
        values: Option<&Arc<Values>>,
    ) -> Raw {
        let decoding = self.decoding(id, values);
        let mut again = self.objects().is_remote();
        loop {
            match decode(decoding.clone(), bytes).await {
                Ok(decoded) => return Ok(Some(decoded)),
                Err(_) if again => again = false,
                Err(damage) => return Err(self.damaged(id, key, damage)),
            }
            match self.part(id, key, part.clone()).await? {
                Some(read) => bytes = read,
                None => return Ok(None),
            }
        }
    }

    /// Pieces of the object `key`, all by one index.
    async fn together(
        &self,
        key: &str,
        ids: Vec<PieceId>,
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let Some(&first) = ids.first() else {
            return Vec::new();
        };
        for _ in 0..ATTEMPTS {
            let Indexed { index, version } = match self.index(first, key).await {
                Ok(index) => index,
                Err(error) if is_replaced(&error) => continue,
                Err(error) => return ids.into_iter().map(|id| (id, Err(error.clone()))).collect(),
            };
            let Some(index) = index else {
                return ids.into_iter().map(|id| (id, Ok(None))).collect();
            };
            let read = self.indexed(key, &index, &ids, values).await;
            // Else its index was of another object, whether that was noticed by this read or by one beside it.
            let is_another = |(_, raw): &(_, Raw)| raw.as_ref().is_err_and(is_replaced);
            if self.objects().replacements(key) == version && !read.iter().any(is_another) {
                return read;
            }
        }
        let error = |id| never_the_same(self.which(id), self.objects().location(key));
        ids.into_iter().map(|id| (id, Err(error(id)))).collect()
    }

    /// The same, by an index that is at hand.
    async fn indexed(
        &self,
        key: &str,
        index: &Self::Index,
        ids: &[PieceId],
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let (mut done, mut wanted, mut ranges) = (Vec::new(), Vec::new(), Vec::new());
        for &id in ids {
            match self.range(index, id) {
                Ok(Some(range)) => {
                    wanted.push(id);
                    ranges.push(range);
                }
                Ok(None) => done.push((id, Ok(None))),
                Err(damage) => done.push((id, Err(self.damaged(id, key, damage)))),
            }
        }
        let merged = coalesced(&ranges, self.objects().read_cost());
        let (wanted, ranges) = (&wanted, &ranges);
        let read = async |(span, numbers): (Range<u64>, Vec<usize>)| {
            let bytes = self
                .part(wanted[numbers[0]], key, Part::Range(span.clone()))
                .await;
            let each = numbers.into_iter().map(|n| {
                let (id, range, bytes) = (wanted[n], ranges[n].clone(), bytes.clone());
                let begin = range.start - span.start;
                async move {
                    let bytes = match bytes {
                        Ok(Some(bytes)) => bytes,
                        // An index, but no object: it was deleted in between.
                        Ok(None) => return (id, Ok(None)),
                        Err(error) => return (id, Err(error)),
                    };
                    let at = |at: u64| usize::try_from(at).expect("within what was read");
                    let own = bytes.slice(at(begin)..at(begin + (range.end - range.start)));
                    let part = Part::Range(range);
                    (id, self.decoded(id, key, part, own, values).await)
                }
            });
            futures::future::join_all(each).await
        };
        let read = stream::iter(merged).map(read).buffer_unordered(AT_ONCE);
        done.extend(read.collect::<Vec<_>>().await.into_iter().flatten());
        done
    }
}

/// Ranges of an object that are better read together: each with the numbers of those it covers.
///
/// `gap` bytes between two cost less than another request.
fn coalesced(ranges: &[Range<u64>], gap: u64) -> Vec<(Range<u64>, Vec<usize>)> {
    let mut order: Vec<usize> = (0..ranges.len()).collect();
    order.sort_by_key(|&n| (ranges[n].start, ranges[n].end));
    let mut merged: Vec<(Range<u64>, Vec<usize>)> = Vec::new();
    for n in order {
        let range = &ranges[n];
        if let Some((last, numbers)) = merged.last_mut()
            && range.start <= last.end.saturating_add(gap)
            && range.end.saturating_sub(last.start) <= MOST_AT_ONCE
        {
            last.end = last.end.max(range.end);
            numbers.push(n);
        } else {
            merged.push((range.clone(), vec![n]));
        }
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_are_read_together_and_strangers_are_not() {
        let ranges = [100..200, 0..50, 210..300, 5000..6000, 40..90];
        let merged = coalesced(&ranges, 10);
        assert_eq!(merged, [(0..300, vec![1, 4, 0, 2]), (5000..6000, vec![3])]);
        let long = [0..MOST_AT_ONCE, MOST_AT_ONCE..MOST_AT_ONCE + 1];
        assert_eq!(coalesced(&long, 10).len(), 2);
        let far = [u64::MAX - 1..u64::MAX, 0..1];
        assert_eq!(coalesced(&far, 10).len(), 2);
        assert_eq!(coalesced(&[], 10), []);
    }
}
