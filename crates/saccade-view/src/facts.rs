//! How true the picture is, for people and for scripts.

use saccade_core::camera::Camera;
use saccade_core::transfer::TransferFunction;
use saccade_source::remote::Status as Acquisition;
use saccade_stream::{Channel, Status};
use serde::Serialize;

use crate::detail::text_of;

/// What is known about the picture on the screen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facts<'a> {
    /// Of the session.
    pub(crate) status: &'a Status,
    /// Whether the picture is smaller than its place for now.
    pub(crate) preview: bool,
    /// Of the acquisition, where a server tells.
    pub(crate) acquisition: Option<&'a Acquisition>,
}

/// The picture in one word.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Fidelity {
    /// Everything is there, at the level and in the size it should have.
    Complete,
    /// Something is on its way.
    Loading,
    /// Something is missing and will not come.
    Failed,
    /// The GPU is gone.
    Lost,
}

impl Facts<'_> {
    pub(crate) fn fidelity(&self) -> Fidelity {
        if self.status.lost {
            Fidelity::Lost
        } else if self.status.complete && !self.preview {
            Fidelity::Complete
        } else if self.status.settled && !self.preview {
            Fidelity::Failed
        } else {
            Fidelity::Loading
        }
    }
}

/// How a piece of the line is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tone {
    Plain,
    Good,
    Busy,
    Bad,
}

/// One piece of the line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Piece {
    pub(crate) text: String,
    pub(crate) tone: Tone,
    /// More, on hover.
    pub(crate) more: Option<String>,
}

fn piece(tone: Tone, text: String) -> Piece {
    Piece {
        text,
        tone,
        more: None,
    }
}

/// `1 brick`, `2 bricks`.
fn count(n: u64, one: &str) -> String {
    format!("{n} {one}{}", if n == 1 { "" } else { "s" })
}

/// Files named on hover.
const MAX_NAMED: usize = 12;

/// The fidelity line, from the most to the least urgent.
pub(crate) fn line(facts: &Facts<'_>) -> Vec<Piece> {
    let status = facts.status;
    let mut line = vec![truth(facts)];
    let fidelity = &status.fidelity;
    if fidelity.substituted_levels > 0 {
        let levels = count(fidelity.substituted_levels.into(), "level");
        line.push(piece(Tone::Busy, format!("substituted by up to {levels}")));
    }
    if fidelity.stale > 0 {
        let bricks = count(fidelity.stale.into(), "brick");
        line.push(piece(Tone::Busy, format!("{bricks} out of date")));
    }
    if status.memory_bias > 0.0 {
        let mut full = piece(
            Tone::Busy,
            format!(
                "coarser by {:.1} levels: GPU memory is full",
                status.memory_bias
            ),
        );
        full.more = Some(format!(
            "The bricks of this view do not fit {} MB. Allow more memory, or look closer.",
            status.memory.ceiling >> 20
        ));
        line.push(full);
    }
    if facts.preview {
        line.push(piece(Tone::Busy, "preview".to_owned()));
    }
    match fidelity.level {
        Some(level) => line.push(piece(Tone::Plain, format!("level {level}"))),
        None => line.push(piece(Tone::Plain, "nothing in view".to_owned())),
    }
    if let Some(time) = status.frame_time {
        line.push(piece(Tone::Plain, format!("{} ms", time.as_millis())));
    }
    line.push(piece(Tone::Plain, format!("revision {}", status.revision)));
    line.extend(facts.acquisition.into_iter().flat_map(of_acquisition));
    line
}

/// The first piece: whether to believe the picture.
fn truth(facts: &Facts<'_>) -> Piece {
    let status = facts.status;
    let missing = || count(status.fidelity.missing.into(), "brick");
    let progress = &status.progress;
    let mut truth = match facts.fidelity() {
        Fidelity::Complete => piece(Tone::Good, "complete".to_owned()),
        Fidelity::Lost => piece(Tone::Bad, "the GPU is gone".to_owned()),
        // Not for want of bricks.
        Fidelity::Failed if status.fidelity.missing == 0 => {
            let why = progress.failure.as_deref();
            piece(Tone::Bad, why.unwrap_or("this cannot be drawn").to_owned())
        }
        Fidelity::Failed => piece(Tone::Bad, format!("{} cannot be shown", missing())),
        Fidelity::Loading if progress.failure.is_some() => {
            piece(Tone::Bad, format!("{} missing, trying again", missing()))
        }
        Fidelity::Loading if status.fidelity.missing > 0 => {
            piece(Tone::Busy, format!("{} missing", missing()))
        }
        Fidelity::Loading => piece(Tone::Busy, "looking".to_owned()),
    };
    truth.more = progress.failure.clone();
    truth
}

fn of_acquisition(acquisition: &Acquisition) -> Vec<Piece> {
    let mut pieces = Vec::new();
    if let Some(tiles) = acquisition.tiles {
        let mut text = count(tiles, "tile");
        if let Some(sections) = acquisition.sections {
            text.push_str(&format!(" in {}", count(sections, "section")));
        }
        pieces.push(piece(Tone::Plain, text));
    }
    if !acquisition.quarantined.is_empty() {
        let files = &acquisition.quarantined;
        // Not all are listed.
        let all = acquisition.set_aside.max(files.len() as u64);
        let mut bad = piece(Tone::Bad, format!("{} set aside", count(all, "file")));
        let mut named: Vec<String> = files
            .iter()
            .take(MAX_NAMED)
            .map(|q| format!("{}: {}", q.file, q.reason))
            .collect();
        if all > named.len() as u64 {
            named.push(format!("and {} more", all - named.len() as u64));
        }
        bad.more = Some(named.join("\n"));
        pieces.push(bad);
    }
    if acquisition.damaged > 0 {
        let text = format!("{} cannot be read", count(acquisition.damaged, "tile"));
        let mut bad = piece(Tone::Bad, text);
        let named = acquisition.damaged_tiles.iter().take(MAX_NAMED);
        let mut named: Vec<String> = named.map(|tile| tile.reason.clone()).collect();
        let more = acquisition.damaged.saturating_sub(named.len() as u64);
        if more > 0 {
            named.push(format!("and {more} more"));
        }
        bad.more = Some(named.join("\n"));
        pieces.push(bad);
    }
    pieces
}

/// What `window.saccade.status()` tells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct PageStatus<'a> {
    pub(crate) volume: &'a str,
    /// Newest revision the picture is to show.
    pub(crate) revision: u64,
    pub(crate) fidelity: Fidelity,
    /// Whether nothing will change by itself.
    pub(crate) settled: bool,
    /// Bricks missing, at least.
    pub(crate) missing: u32,
    pub(crate) stale: u32,
    pub(crate) substituted_levels: u32,
    pub(crate) level: Option<u32>,
    pub(crate) memory_bias: f32,
    /// Pictures drawn so far.
    pub(crate) frame: u64,
    pub(crate) frame_ms: Option<f64>,
    /// As `?camera=` takes it.
    pub(crate) camera: String,
    /// Of the picture \[pixels\].
    pub(crate) size: [u32; 2],
    /// Of the first channel that is seen, as `?transfer=` takes it.
    pub(crate) transfer: Option<&'a TransferFunction>,
    /// Those that are seen, as `?channels=` takes them.
    pub(crate) channels: Vec<u32>,
    /// How finely those are drawn, as `?detail=` takes it.
    pub(crate) detail: String,
    /// Requests in flight.
    pub(crate) requests: usize,
    /// The newest failure, in words.
    pub(crate) failure: Option<&'a str>,
    pub(crate) tiles: Option<u64>,
    pub(crate) quarantined: u64,
}

impl<'a> PageStatus<'a> {
    pub(crate) fn new(
        facts: &Facts<'a>,
        volume: &'a str,
        camera: &Camera,
        size: glam::UVec2,
        channels: &'a [Channel],
    ) -> Self {
        let status = facts.status;
        let seen = || (0_u32..).zip(channels).filter(|(_, c)| c.visible);
        let details = seen().map(|(index, c)| format!("{index}:{}", text_of(&c.detail)));
        Self {
            volume,
            revision: status.revision,
            fidelity: facts.fidelity(),
            settled: status.settled && !facts.preview,
            missing: status.fidelity.missing,
            stale: status.fidelity.stale,
            substituted_levels: status.fidelity.substituted_levels,
            level: status.fidelity.level,
            memory_bias: status.memory_bias,
            frame: status.frame,
            frame_ms: status.frame_time.map(|time| time.as_secs_f64() * 1e3),
            camera: camera.to_string(),
            size: size.to_array(),
            transfer: seen().next().map(|(_, channel)| &channel.transfer),
            channels: seen().map(|(index, _)| index).collect(),
            detail: details.collect::<Vec<_>>().join(","),
            requests: status.progress.in_flight,
            failure: status.progress.failure.as_deref(),
            tiles: facts.acquisition.and_then(|a| a.tiles),
            quarantined: facts
                .acquisition
                .map_or(0, |a| a.set_aside.max(a.quarantined.len() as u64)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use saccade_render::{Fidelity as Bricks, MemoryUse, Statistics};
    use saccade_source::remote::Quarantined;
    use saccade_stream::Again;
    use saccade_stream::pull::Progress;

    use super::*;

    fn complete() -> Status {
        Status {
            frame: 7,
            drew: false,
            frame_known: 7,
            complete: true,
            settled: true,
            fidelity: Bricks {
                level: Some(2),
                ..Bricks::default()
            },
            lod_bias: 0.0,
            memory_bias: 0.0,
            statistics: Statistics::default(),
            memory: MemoryUse {
                ceiling: 64 << 20,
                ..MemoryUse::default()
            },
            host_bytes: 0,
            progress: Progress::default(),
            delivered: 0,
            revision: 14,
            frame_time: Some(Duration::from_millis(12)),
            frame_size: glam::UVec2::new(640, 480),
            lost: false,
            again: Again::WhenWoken,
        }
    }

    fn text(status: &Status, preview: bool, acquisition: Option<&Acquisition>) -> String {
        let pieces = line(&Facts {
            status,
            preview,
            acquisition,
        });
        pieces
            .into_iter()
            .map(|p| p.text)
            .collect::<Vec<_>>()
            .join(" · ")
    }

    #[test]
    fn a_complete_picture_says_so_first() {
        assert_eq!(
            text(&complete(), false, None),
            "complete · level 2 · 12 ms · revision 14"
        );
    }

    #[test]
    fn every_defect_is_named() {
        let mut status = Status {
            complete: false,
            settled: false,
            ..complete()
        };
        status.fidelity = Bricks {
            missing: 3,
            stale: 1,
            substituted_levels: 2,
            ..status.fidelity
        };
        status.memory_bias = 1.25;
        assert_eq!(
            text(&status, true, None),
            "3 bricks missing · substituted by up to 2 levels · 1 brick out of date · \
             coarser by 1.2 levels: GPU memory is full · preview · level 2 · 12 ms · \
             revision 14"
        );
    }

    #[test]
    fn a_small_picture_is_not_complete() {
        let status = complete();
        let facts = Facts {
            status: &status,
            preview: true,
            acquisition: None,
        };
        assert_eq!(facts.fidelity(), Fidelity::Loading);
    }

    #[test]
    fn failures_say_why() {
        let mut status = Status {
            complete: false,
            ..complete()
        };
        status.fidelity.missing = 1;
        status.progress.failure = Some("unplugged".to_owned());
        for (settled, words) in [(true, "1 brick cannot be shown"), (false, "trying again")] {
            status.settled = settled;
            let facts = Facts {
                status: &status,
                preview: false,
                acquisition: None,
            };
            let first = line(&facts).swap_remove(0);
            assert!(first.text.contains(words), "{}", first.text);
            assert_eq!(
                (first.tone, first.more.as_deref()),
                (Tone::Bad, Some("unplugged"))
            );
        }
    }

    #[test]
    fn what_is_not_drawn_at_all_says_why() {
        let mut status = Status {
            complete: false,
            ..complete()
        };
        status.progress.failure = Some("too large".to_owned());
        let facts = Facts {
            status: &status,
            preview: false,
            acquisition: None,
        };
        let first = line(&facts).swap_remove(0);
        assert_eq!((first.text.as_str(), first.tone), ("too large", Tone::Bad));
    }

    #[test]
    fn files_set_aside_are_counted_and_explained() {
        let file = |n| Quarantined {
            file: format!("t{n}.tif"),
            tile: None,
            reason: "16 bit".to_owned(),
        };
        let acquisition = Acquisition {
            revision: 14,
            tiles: Some(1),
            sections: Some(3),
            quarantined: (0..20).map(file).collect(),
            ..Acquisition::default()
        };
        let status = complete();
        let text = text(&status, false, Some(&acquisition));
        assert!(
            text.ends_with("1 tile in 3 sections · 20 files set aside"),
            "{text}"
        );
        let facts = Facts {
            status: &status,
            preview: false,
            acquisition: Some(&acquisition),
        };
        let more = line(&facts).pop().unwrap().more.unwrap();
        assert!(
            more.starts_with("t0.tif: 16 bit\n") && more.ends_with("and 8 more"),
            "{more}"
        );
    }

    #[test]
    fn tiles_that_cannot_be_read_are_counted_and_explained() {
        let tile = saccade_source::Damage {
            section: 3,
            object: "tiles/v/000003/a.tif".to_owned(),
            reason: "the pyramid is missing".to_owned(),
        };
        let acquisition = Acquisition {
            damaged: 3,
            damaged_tiles: vec![tile.clone(), tile],
            ..Acquisition::default()
        };
        let facts = Facts {
            status: &complete(),
            preview: false,
            acquisition: Some(&acquisition),
        };
        let last = line(&facts).pop().unwrap();
        assert_eq!(
            (last.tone, &*last.text),
            (Tone::Bad, "3 tiles cannot be read")
        );
        let more = last.more.unwrap();
        assert!(more.starts_with("the pyramid is missing\n") && more.ends_with("and 1 more"));
    }

    #[test]
    fn scripts_read_plain_json() {
        let status = complete();
        let facts = Facts {
            status: &status,
            preview: false,
            acquisition: None,
        };
        let size = glam::DVec3::splat(100.0);
        let transfer = saccade_core::transfer::Histogram::default().transfer_function(size);
        let hidden = Channel {
            name: "other".to_owned(),
            visible: false,
            histogram: Default::default(),
            transfer: TransferFunction {
                window: [0.1, 0.2],
                ..transfer.clone()
            },
            automatic: true,
            iso: None,
            detail: saccade_stream::Detail::Chosen {
                levels: 1..=4,
                coarser: 1,
            },
            finest_needed: 0,
        };
        let seen = Channel {
            visible: true,
            transfer: transfer.clone(),
            ..hidden.clone()
        };
        let channels = [hidden, seen];
        let volume = saccade_core::volume::Volume::new("v", glam::UVec3::ONE, size).unwrap();
        let camera = Camera::around(&volume);
        let page = PageStatus::new(&facts, "v", &camera, glam::UVec2::new(4, 3), &channels);
        let json = serde_json::to_value(&page).unwrap();
        assert_eq!(json["fidelity"], "complete");
        assert_eq!(json["revision"], 14);
        assert_eq!(json["size"], serde_json::json!([4, 3]));
        assert_eq!(
            json["camera"].as_str().unwrap().parse::<Camera>().unwrap(),
            camera
        );
        let back: TransferFunction = serde_json::from_value(json["transfer"].clone()).unwrap();
        assert_eq!(back, transfer);
        assert_eq!(json["channels"], serde_json::json!([1]));
        assert_eq!(json["detail"], "1:1-4+1");
    }
}
