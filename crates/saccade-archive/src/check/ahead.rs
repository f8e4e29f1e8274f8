//! Rows that say that they follow records that were not read yet.
//!
//! Ingest passes over what a record says of a tile whose row follows a later one: of a row that is ahead of all that was read, nothing
//! would be followed until the records are as long.

use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::catalog::VolumeEntry;

impl Check<'_> {
    /// Finds rows that are ahead of what was read; with a repair, each follows what comes after its own newest record.
    pub(super) async fn ahead(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        // Whether the rows are wrong, or how far was read, nothing tells without the records.
        let Some(records) = self.records.as_ref() else {
            return Ok(());
        };
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        for row in catalog.ahead(volume).await? {
            let (at, what) = match row.deleted {
                true => (row.position, "that its end is of the record"),
                false => (row.transform_position, "that it lies where the record says"),
            };
            let mut reason = format!(
                "the catalog says {what} at byte {at}, and they were read up to byte {}: what is recorded of it until then would \
                 be passed over",
                row.read
            );
            let mut repair = None;
            if self.options.repair {
                let its = match row.deleted {
                    true => {
                        { records.position_of(&row.tile) }.filter(|_| records.is_deleted(&row.tile))
                    }
                    false => records.said(&row.tile).map(|said| said.position),
                };
                let position = its.unwrap_or(row.read.saturating_sub(1));
                let mut commit = catalog.begin(volume).await?;
                commit.follow_from(&row, position).await?;
                commit.finish().await?;
                repair = Some(Repair::Renumbered);
            } else {
                reason.push_str("; `saccade check --repair` has it be followed");
            }
            self.report.findings.push(Finding {
                kind: FindingKind::Spoilt,
                volume: Some(volume.clone()),
                tile: Some(row.tile),
                object: None,
                reason,
                repair,
            });
        }
        Ok(())
    }
}
