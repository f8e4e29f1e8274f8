//! Bounds of chunks' values by HTTP, many at once.

use std::collections::BTreeMap;

use saccade_core::volume::Dtype;
use serde::Deserialize;

use super::{RemoteError, RemoteSource, get_json, joined};
use crate::{ChunkError, ChunkId, ValueRange};

/// Chunks that are asked for at once: fewer than servers answer, in an address that proxies let pass.
const TOGETHER: usize = 128;

#[derive(Deserialize)]
struct RangesJson {
    ranges: Vec<Option<[u16; 2]>>,
}

type Found = Result<Option<ValueRange>, ChunkError>;

/// Bounds of every value that a volume can have: what is known of a chunk of which nothing is said, or nothing that can be.
fn any(dtype: Dtype) -> ValueRange {
    ValueRange {
        min: 1,
        max: match dtype {
            Dtype::Uint8 => u16::from(u8::MAX),
            _ => u16::MAX,
        },
    }
}

impl RangesJson {
    /// Of so many chunks that were asked for, whatever came.
    fn believed(self, chunks: usize, dtype: Dtype) -> impl Iterator<Item = Option<ValueRange>> {
        let any = any(dtype);
        let believed = move |range: Option<[u16; 2]>| {
            let [min, max] = range?;
            let can_be = any.min <= min && min <= max && max <= any.max;
            Some(if can_be { ValueRange { min, max } } else { any })
        };
        let said = self.ranges.into_iter().map(believed);
        said.chain(std::iter::repeat(Some(any))).take(chunks)
    }
}

impl RemoteSource {
    pub(super) async fn ranges(&self, ids: &[ChunkId]) -> Vec<Found> {
        let dtype = self.volume.dtype;
        let mut found: Vec<Found> = ids.iter().map(|_| Ok(Some(any(dtype)))).collect();
        let mut groups: BTreeMap<(u32, u32), Vec<usize>> = BTreeMap::new();
        for (n, &id) in ids.iter().enumerate() {
            if id.voxels(&self.volume).is_some() {
                groups.entry((id.channel, id.level)).or_default().push(n);
            } else {
                found[n] = Err(ChunkError::OutOfRange { id });
            }
        }
        for (of, numbers) in groups {
            for numbers in numbers.chunks(TOGETHER) {
                match self.ask(of, numbers, ids).await {
                    Ok(ranges) => {
                        for (n, range) in numbers.iter().zip(ranges.believed(numbers.len(), dtype))
                        {
                            found[*n] = Ok(range);
                        }
                    }
                    Err(error) => log::debug!("bounds of values are not known: {error}"),
                }
            }
        }
        found
    }

    async fn ask(
        &self,
        (channel, level): (u32, u32),
        numbers: &[usize],
        ids: &[ChunkId],
    ) -> Result<RangesJson, RemoteError> {
        let chunks = numbers.iter().map(|n| {
            let [x, y, z] = ids[*n].chunk.to_array();
            format!("{x},{y},{z}")
        });
        let chunks = chunks.collect::<Vec<_>>().join(";");
        let parts = ["ranges", &channel.to_string(), &level.to_string(), &chunks];
        let url = joined(&self.url, &parts);
        get_json(&self.client, url, self.options).await
    }
}

/// What a server says of chunks' values; the first byte chooses how many were asked for.
#[cfg(all(any(test, fuzzing), not(target_family = "wasm")))]
pub(crate) fn fuzz(bytes: &[u8]) {
    let Some((&asked, bytes)) = bytes.split_first() else {
        return;
    };
    for dtype in [Dtype::Uint8, Dtype::Uint16] {
        let Ok(said) = serde_json::from_slice::<RangesJson>(bytes) else {
            return;
        };
        let ranges = said.ranges.clone();
        let any = any(dtype);
        let believed: Vec<_> = said.believed(asked.into(), dtype).collect();
        assert_eq!(believed.len(), usize::from(asked));
        for (n, range) in believed.into_iter().enumerate() {
            // Nothing was acquired only where that is said, and nothing lies outside of what can be.
            let Some(ValueRange { min, max }) = range else {
                assert_eq!(ranges[n], None);
                continue;
            };
            assert!(
                any.min <= min && min <= max && max <= any.max,
                "{min}..={max}"
            );
            if let Some([least, most]) = ranges.get(n).copied().flatten().filter(|[a, b]| a <= b) {
                assert!((min, max) == (any.min, any.max) || (min <= least && most <= max));
            }
        }
    }
}
