//! Volumes that the catalog has lost, while it has their tiles.

use super::{Check, CheckError, Finding, FindingKind, Repair};

impl Check<'_> {
    /// Finds rows of tiles whose volume's row is gone. Of their pyramids nothing else is told, be they as many and as young as they
    /// are, unless they should be of a volume that is there.
    pub(super) async fn lost_volumes(&mut self) -> Result<(), CheckError> {
        for lost in self.archive.catalog().lost_volumes().await? {
            let mut reason = format!(
                "the catalog's table \"volumes\" has none of the number {}, of which {} of its tiles are",
                lost.number, lost.tiles
            );
            let is_there = { lost.name.as_ref() }.is_some_and(|name| self.known.contains(name));
            reason.push_str(match lost.name {
                Some(_) if is_there => {
                    ", and they name pyramids of one that is there: put a copy of the catalog in its place; without one, \
                     `saccade check --repair --acquisition FOLDER` finds from the records which tiles are lost, and `saccade ingest` \
                     enters them anew"
                }
                Some(_) => {
                    ": `saccade ingest` of its acquisition, or a copy of the catalog in its place, makes them its again"
                }
                None => ", and none of these names a pyramid: put a copy of the catalog in its place",
            });
            let mut repair = None;
            if is_there && self.options.repair {
                let left = self.archive.catalog().take_out_lost(&lost).await?;
                repair = (left == 0).then_some(Repair::TakenAway);
            }
            self.unknown.extend(lost.name.clone().filter(|_| !is_there));
            self.report.findings.push(Finding {
                kind: FindingKind::Spoilt,
                volume: lost.name,
                tile: None,
                object: None,
                reason,
                repair,
            });
        }
        Ok(())
    }
}
