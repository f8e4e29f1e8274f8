use std::path::PathBuf;
use std::time::Duration;

use saccade_archive::pyramid::Encoding;

use crate::held_up::HeldUp;

/// How to ingest.
#[derive(Clone, Debug, PartialEq)]
pub struct IngestOptions {
    /// Name of the volume in the catalog; `None`: as the acquisition archive says.
    pub volume: Option<String>,
    /// A folder besides the acquisition archive's into which links to images may lead: the one that is watched,
    /// where a [`Watch`](crate::watch::Watch) keeps the records.
    pub linked: Option<PathBuf>,
    /// The archive's folder, if it has one: those who look at the volume are not told where on this machine it lies.
    pub folder: Option<PathBuf>,
    /// How pyramids are stored.
    pub encoding: Encoding,
    /// Pause between looks at the acquisition archive.
    pub poll: Duration,
    /// Whether to end once everything that is there is done, instead of following.
    pub once: bool,
    /// Tiles in work at the same time. Each holds its file and its pixels in memory.
    pub workers: usize,
    /// Looks at an incomplete file that does not change any more, before it goes to quarantine.
    pub patience: u32,
    /// Records taken up per look.
    pub batch: usize,
    /// First pause after a failed write; pauses double up to sixteen of it, and to two of it while the disk is
    /// full or the catalog's server away.
    pub retry: Duration,
    /// How long what a worker has claimed stays its own after its last sign of life. Such a sign is
    /// given four times as often.
    pub lease: Duration,
    /// Workers that may end while they work on a record, before it goes to quarantine.
    pub attempts: u32,
    /// How long a replaced pyramid stays, for readers that still have its name.
    pub keep_retired: Duration,
    /// What holds up those who find out what lies where, a [`Watch`](crate::watch::Watch) for example. While this works,
    /// the catalog tells of it, as of what holds up the ingest itself.
    pub held_up: Option<HeldUp>,
}

impl IngestOptions {
    /// What fits most.
    pub const DEFAULT: Self = Self {
        volume: None,
        linked: None,
        folder: None,
        encoding: Encoding::Jpeg { quality: 85 },
        poll: Duration::from_millis(250),
        once: false,
        workers: 2,
        patience: 120,
        batch: 1024,
        retry: Duration::from_secs(1),
        lease: Duration::from_secs(20),
        attempts: 5,
        keep_retired: Duration::from_secs(60),
        held_up: None,
    };
}

impl Default for IngestOptions {
    fn default() -> Self {
        Self::DEFAULT
    }
}
