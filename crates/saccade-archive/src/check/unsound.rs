//! Whether the catalog's file is sound, before anything else is believed of what it says.

use super::{CheckError, CheckOptions, Finding, FindingKind, Repair};
use crate::VisualizationArchive;

/// Kinds of what SQLite says that are told.
const TOLD: usize = 4;

/// Looks at the catalog's own file, and makes its indexes anew if that is wanted and helps. Of one that is not sound all else
/// would be found wrong: there is nothing more to look at then.
pub(super) async fn look(
    archive: &VisualizationArchive,
    options: &CheckOptions,
) -> Result<Option<Finding>, CheckError> {
    let catalog = archive.catalog();
    let said = catalog.unsound().await?;
    if said.is_empty() {
        return Ok(None);
    }
    let mut reason = format!("the catalog's file is damaged ({})", told(&said));
    let mut repair = None;
    if options.repair {
        let left = catalog.make_indexes_anew().await?;
        if left.is_empty() {
            repair = Some(Repair::Reindexed);
        } else {
            reason.push_str(&format!(
                ", and new indexes do not mend it ({}). Nothing is deleted or counted anew. Move it away with its -wal and -shm, and \
                 put a copy of it there, from which `saccade ingest` goes on; without a copy, take the acquisition in anew into \
                 another archive",
                told(&left)
            ));
        }
    } else {
        reason.push_str(
            ": `saccade check --repair` makes its indexes anew if that mends it, and deletes nothing otherwise; until then it is not \
             known what the archive lacks",
        );
    }
    Ok(Some(Finding {
        kind: FindingKind::Unsound,
        volume: None,
        tile: None,
        object: None,
        reason,
        repair,
    }))
}

/// Indexes that the catalog's file lacks, each made anew if that is wanted and the rows allow it.
pub(super) async fn lacking_indexes(
    archive: &VisualizationArchive,
    options: &CheckOptions,
) -> Result<Vec<(String, Finding)>, CheckError> {
    let catalog = archive.catalog();
    let mut findings = Vec::new();
    for index in catalog.lacking_indexes().await? {
        let mut reason = format!("the catalog's file lacks its index {index:?}");
        let mut repair = None;
        if !options.repair {
            reason.push_str(
                ": `saccade check --repair` makes it anew, where no two rows have one name",
            );
        } else if catalog.make_index(&index).await? {
            repair = Some(Repair::Reindexed);
        }
        let finding = Finding {
            kind: FindingKind::Unsound,
            volume: None,
            tile: None,
            object: None,
            reason,
            repair,
        };
        findings.push((index, finding));
    }
    Ok(findings)
}

/// Makes an index once rows of one name are mended as far as can be.
pub(super) async fn make_at_last(
    archive: &VisualizationArchive,
    options: &CheckOptions,
    index: &str,
    finding: &mut Finding,
) -> Result<(), CheckError> {
    if archive.catalog().make_index(index).await? {
        finding.repair = Some(Repair::Reindexed);
        return Ok(());
    }
    let how = match &options.acquisition {
        Some(_) => {
            "of which the records of the acquisition do not tell whose it is: take those out of its table \"tiles\" that are not, or \
             put a copy of the catalog there, from which `saccade ingest` goes on"
        }
        None => "give --acquisition FOLDER as well, whose records tell whose it is",
    };
    let said = format!(", which cannot be made while two rows have one name: {how}");
    finding.reason.push_str(&said);
    Ok(())
}

/// What is said, once of each kind: it may be the same of thousands of rows.
fn told(said: &[String]) -> String {
    let mut kinds: Vec<(String, &str, usize)> = Vec::new();
    for line in said {
        let kind: String = line.chars().filter(|c| !c.is_ascii_digit()).collect();
        match kinds.iter_mut().find(|(known, ..)| *known == kind) {
            Some((_, _, more)) => *more += 1,
            None => kinds.push((kind, line, 0)),
        }
    }
    let rest = kinds.len().saturating_sub(TOLD);
    let lines = kinds.iter().take(TOLD).map(|(_, line, more)| match more {
        0 => (*line).to_owned(),
        more => format!("{line}, and {more} more like it"),
    });
    let mut lines: Vec<_> = lines.collect();
    if rest > 0 {
        lines.push(format!("{rest} others"));
    }
    lines.join("; ")
}
