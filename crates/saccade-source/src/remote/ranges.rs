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

impl RemoteSource {
    pub(super) async fn ranges(&self, ids: &[ChunkId]) -> Vec<Found> {
        let any = ValueRange {
            min: 1,
            max: match self.volume.dtype {
                Dtype::Uint8 => u16::from(u8::MAX),
                _ => u16::MAX,
            },
        };
        let mut found: Vec<Found> = ids.iter().map(|_| Ok(Some(any))).collect();
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
                        for (n, range) in numbers.iter().zip(ranges) {
                            found[*n] = Ok(range.map(|[min, max]| ValueRange { min, max }));
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
    ) -> Result<Vec<Option<[u16; 2]>>, RemoteError> {
        let chunks = numbers.iter().map(|n| {
            let [x, y, z] = ids[*n].chunk.to_array();
            format!("{x},{y},{z}")
        });
        let chunks = chunks.collect::<Vec<_>>().join(";");
        let parts = ["ranges", &channel.to_string(), &level.to_string(), &chunks];
        let url = joined(&self.url, &parts);
        let RangesJson { ranges } = get_json(&self.client, url, self.options).await?;
        Ok(ranges)
    }
}
