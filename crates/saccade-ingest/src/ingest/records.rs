//! Reading records while others write to them.

use std::time::Duration;

use saccade_archive::acquisition::{AcquisitionError, RecordReader};
use saccade_archive::clock::Clock;

use super::prepare::Backoff;
use super::{IngestError, IngestOptions};
use crate::progress::Progress;

/// Attempts at reading the records when all that is there is to be done once.
const ATTEMPTS_ONCE: u32 = 4;

/// Asks the records. A share that fails for a moment does not end the stream, and neither do records that are
/// being written anew.
pub(super) async fn patiently<T>(
    clock: &dyn Clock,
    options: &IngestOptions,
    progress: &dyn Progress,
    mut ask: impl FnMut() -> Result<T, AcquisitionError>,
) -> Result<T, IngestError> {
    let mut backoff = Backoff::new(options.retry, clock);
    let mut cut = None;
    loop {
        match ask() {
            Ok(answer) => {
                if cut.is_some() {
                    progress.held_up(None);
                    progress.notice("the records are whole again");
                }
                backoff.over(progress, "the records can be read again");
                return Ok(answer);
            }
            // Copying programs and editors cut a file before they write it anew.
            Err(AcquisitionError::RecordsCut { len, read, path }) => {
                let patience = options.poll * options.patience;
                let now = clock.monotonic();
                let cut = cut.get_or_insert_with(|| Cut::new(len, now));
                if !cut.may_become_whole(len, now, patience) {
                    return Err(AcquisitionError::RecordsCut { len, read, path }.into());
                }
                let seconds = patience.as_secs_f64();
                let why = format!(
                    "the records end at byte {len}, but were read up to byte {read} before; in case they are being \
                     written anew, they are waited for, for {seconds:.0} s unless they grow: {}",
                    path.display()
                );
                if !cut.told {
                    progress.notice(&why);
                    cut.told = true;
                }
                progress.held_up(Some(&why));
                clock.sleep(options.poll).await;
            }
            Err(e) => {
                // Who waits for the end is told, rather than kept; a stream waits for its share.
                let away = matches!(e, AcquisitionError::Read { .. });
                let passing = away && backoff.failures < ATTEMPTS_ONCE;
                if !backoff.may_go_on(away && !options.once, passing) {
                    return Err(e.into());
                }
                backoff.say_and_wait(progress, &e).await;
            }
        }
    }
}

/// Records that are shorter than what was read of them.
struct Cut {
    /// When they were first so, or grew last.
    since: Duration,
    len: u64,
    told: bool,
}

impl Cut {
    fn new(len: u64, now: Duration) -> Self {
        Self {
            since: now,
            len,
            told: false,
        }
    }

    /// Whether it is still worth waiting. What grows is waited for as long as it does, once enough of it is there to
    /// be known as the same: else it may be another acquisition, tile by tile.
    fn may_become_whole(&mut self, len: u64, now: Duration, patience: Duration) -> bool {
        if len > self.len && len >= RecordReader::KNOWN_BY {
            self.since = now;
        }
        self.len = len;
        now.saturating_sub(self.since) < patience
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_grows_is_waited_for_once_it_is_known() {
        let patience = Duration::from_secs(30);
        let (known, unknown) = (RecordReader::KNOWN_BY, 10);
        // Looked at every twenty seconds.
        for (lens, waits) in [
            ([0, known, known + 1, known + 2], [true; 4]),
            (
                [0, unknown, unknown + 1, unknown + 2],
                [true, true, false, false],
            ),
            ([known; 4], [true, true, false, false]),
            ([known, 0, known, 0], [true; 4]),
        ] {
            let begin = Duration::from_secs(1000);
            let mut cut = Cut::new(lens[0], begin);
            for (look, (len, wait)) in (0..).zip(lens.into_iter().zip(waits)) {
                let now = begin + Duration::from_secs(20) * look;
                assert_eq!(
                    cut.may_become_whole(len, now, patience),
                    wait,
                    "{lens:?} at {len}"
                );
            }
        }
    }
}
