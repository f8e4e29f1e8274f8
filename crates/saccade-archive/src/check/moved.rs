//! Tiles that lie where nothing says that they do.
//!
//! `saccade update` moves tiles as well, and nobody records that but the catalog: where the newest record was followed, another
//! place is taken for that, unless the catalog's own list of changes says otherwise.

use std::collections::HashMap;

use super::{Check, CheckError, FindingKind, Repair, records::Said};
use crate::acquisition::Record;
use crate::catalog::{Placing, Tile, VolumeEntry, place};

impl Check<'_> {
    /// Notes a tile that does not lie where its newest record says.
    pub(super) fn compare_place(&mut self, tile: &Tile) {
        let said = self
            .records
            .as_ref()
            .and_then(|records| records.elsewhere(tile));
        self.elsewhere.extend(said.map(|said| (tile.clone(), said)));
    }

    /// Finds those of a section of which neither a record nor the catalog's changes say that they lie where they do.
    pub(super) async fn moved(&mut self, entry: &VolumeEntry, z: u32) -> Result<(), CheckError> {
        let elsewhere = std::mem::take(&mut self.elsewhere);
        if elsewhere.is_empty() {
            return Ok(());
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let placings = catalog.placings(volume, z).await?;
        let placings: HashMap<_, _> = placings
            .iter()
            .map(|placing| (placing.tile, placing))
            .collect();
        for (tile, said) in elsewhere {
            let placing = placings
                .get(&tile.id)
                .filter(|now| now.revision == tile.revision);
            let Some(why) = placing.and_then(|now| self.unexplained(entry, &tile, said, now))
            else {
                continue;
            };
            let record = self.record_at(entry, said.record).map(|(_, record)| record);
            let (name, to) = match record {
                Some(Record::Tile(record)) => (record.tile, record.transform),
                Some(Record::Transform(record)) => (record.tile, record.transform),
                _ => continue,
            };
            if name != tile.name || to == tile.transform {
                continue;
            }
            // One that ingest could not follow is told with what is set aside.
            if catalog.is_set_aside(volume, &name).await? {
                continue;
            }
            let reason = format!(
                "it lies at {:?}, its newest record (byte {}) says {:?}, and {why}",
                tile.transform.elements(),
                said.record,
                to.elements()
            );
            let mut repair = None;
            if self.options.repair {
                catalog.set_transform(volume, &tile.name, to).await?;
                repair = Some(Repair::Moved);
            }
            self.find(FindingKind::Spoilt, entry, Some(&tile), reason)
                .repair = repair;
        }
        Ok(())
    }

    /// Why nothing explains that a tile lies elsewhere than a record said; `None` if somebody may have moved it.
    fn unexplained(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        said: Said,
        now: &Placing,
    ) -> Option<&'static str> {
        // Another may have read on meanwhile.
        if now.transform_position >= self.read?.offset {
            return None;
        }
        if now.transform_position != said.position {
            return Some("that one was not followed");
        }
        let lies = place(
            entry.volume.extent(),
            tile.section,
            tile.size,
            tile.transform,
        )?;
        let came = now.change?;
        (came.intersection(lies) != lies)
            .then_some("it came elsewhere when it last changed, as the catalog's changes tell")
    }
}
