//! Revisions of volumes that cannot be.

use std::collections::HashSet;

use super::{CheckError, CheckOptions, Finding, FindingKind, Repair};
use crate::VisualizationArchive;

/// What was found of volumes' revisions.
#[derive(Debug)]
pub(super) struct Revisions {
    pub(super) findings: Vec<Finding>,
    /// Volumes that cannot be looked at for that.
    pub(super) unknown: HashSet<String>,
}

impl Revisions {
    /// Looks at all volumes' revisions before anything is written, which they could keep from it.
    pub(super) async fn look(
        archive: &VisualizationArchive,
        options: &CheckOptions,
    ) -> Result<Self, CheckError> {
        let mut found = Self {
            findings: Vec::new(),
            unknown: HashSet::new(),
        };
        for wrong in archive.catalog().wrong_revisions().await? {
            let mut reason = format!(
                "the catalog says revision {} of the volume, and its changes and tiles reach {}, so that nothing can be written",
                wrong.says, wrong.reached
            );
            let mut repair = None;
            if options.repair {
                archive.catalog().mend_revision(&wrong).await?;
                repair = Some(Repair::Recounted);
            } else {
                reason.push_str(": `saccade check --repair` sets it");
                if wrong.says < 0 {
                    reason.push_str("; until then none of its tiles is looked at");
                    found.unknown.insert(wrong.volume.clone());
                }
            }
            found.findings.push(Finding {
                kind: FindingKind::Spoilt,
                volume: Some(wrong.volume),
                tile: None,
                object: None,
                reason,
                repair,
            });
        }
        Ok(found)
    }
}
