//! In which pixels a list of Render's counts. Its first tiles may not tell, or mislead: that is decided anew whenever the
//! list is read.
//!
//! Where the volume's corner was said, what is decided last counts, as if the list had been read whole at first: tiles move.
//! Where it was found by itself, tiles that are there stay, and the corner is told by other numbers.

use glam::DVec2;
use saccade_core::transform::SectionFromTile;

use super::super::Folders;
use super::frame::{self, Frame};
use super::source::{Listing, offset};
use super::{ListError, ListWatch};
use crate::replay::lists::Stage;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Counted {
    /// In those of the stage.
    Stage,
    /// In those of the transforms.
    Transforms,
    /// In those of the transforms, as long as it cannot be told.
    Open,
}

impl Counted {
    const ALL: [(Self, &str); 3] = [
        (Self::Stage, "stage"),
        (Self::Transforms, "transforms"),
        (Self::Open, "open"),
    ];

    /// Of a list that is read for the first time.
    pub(super) fn of(stage: Stage) -> Self {
        match stage {
            Stage::Pixels => Self::Stage,
            Stage::Other => Self::Transforms,
            Stage::Unknown => Self::Open,
        }
    }

    pub(super) fn text(self) -> &'static str {
        let mut all = Self::ALL.iter();
        all.find(|(one, _)| *one == self)
            .map_or("", |(_, text)| text)
    }

    pub(super) fn parse(text: &str) -> Option<Self> {
        let mut all = Self::ALL.iter();
        all.find(|(_, one)| *one == text).map(|(one, _)| *one)
    }
}

impl<F: Folders> ListWatch<F> {
    /// Decides anew in which pixels the list counts, and says so of its tiles; `None` if that is certain, or there is no
    /// volume yet.
    pub(super) fn count(&self, listing: &mut Listing) -> Option<Counted> {
        let (stage, frame) = listing.counts.zip(self.frame.as_ref())?;
        let before = frame.counted();
        let now = match stage {
            Stage::Unknown => before,
            Stage::Other => Counted::Transforms,
            Stage::Pixels if before == Counted::Stage || self.config.origin.is_some() => {
                Counted::Stage
            }
            Stage::Pixels => Counted::Transforms,
        };
        listing.count_as(now == Counted::Stage);
        Some(now)
    }

    /// Whether that is another than before.
    pub(super) fn counts_otherwise(&self, now: Counted) -> bool {
        let before = self.frame.as_ref().map(Frame::counted);
        before.is_some_and(|before| (before == Counted::Stage) != (now == Counted::Stage))
    }

    /// Keeps what was decided. If it is another than before, how far the solution's frame is from that in which the list
    /// counts now is found out, and what the volume's corner is called there if nobody said it.
    pub(super) fn keep_counted(
        &mut self,
        listing: &Listing,
        now: Counted,
    ) -> Result<(), ListError> {
        let Some(before) = &self.frame else {
            return Ok(());
        };
        let mut frame = before.clone();
        frame.counted = Some(now);
        if !self.counts_otherwise(now) {
            if before.counted != frame.counted {
                frame.keep(&self.folder, &self.kept)?;
                self.frame = Some(frame);
            }
            return Ok(());
        }
        let raw = self.raw(listing);
        let offset_before = self.adopted.as_mut().map(|adopted| {
            let now = offset(&adopted.solution, raw).unwrap_or(adopted.offset);
            std::mem::replace(&mut adopted.offset, now)
        });
        if let Some(by) = self.moved(listing).filter(|_| self.config.origin.is_none()) {
            frame.shift(by);
        }
        // Should anything fail after the first, all is decided and found out again.
        let kept = frame::keep_adopted(self.adopted.as_ref(), &self.folder, &self.kept)
            .and_then(|()| frame.keep(&self.folder, &self.kept));
        if let Err(e) = kept {
            if let Some((adopted, offset)) = self.adopted.as_mut().zip(offset_before) {
                adopted.offset = offset;
            }
            return Err(e.into());
        }
        self.frame = Some(frame);
        if now == Counted::Stage {
            log::warn!(
                "with the tiles that came, the stage's places (layout) are seen to be in pixels: --origin counts in them: \
                 {}",
                self.config.list.display()
            );
        }
        Ok(())
    }

    /// How far the tiles that are there would move \[voxels\]; if none is, those that are listed, from where the stage
    /// has them.
    fn moved(&self, listing: &Listing) -> Option<DVec2> {
        let frame = self.frame.as_ref()?;
        let corner = |transform: SectionFromTile| {
            let [.., x, y] = transform.elements();
            DVec2::new(x, y)
        };
        let mut there = Vec::new();
        let mut laid_out = Vec::new();
        for tile in &listing.tiles {
            let solved = self
                .adopted
                .as_ref()
                .and_then(|adopted| adopted.place(tile));
            let now = corner(frame.place(solved.unwrap_or(tile.stage)));
            let told = self
                .tiles
                .get(&*tile.name)
                .and_then(|tile| tile.told.as_ref());
            there.extend(told.map(|told| now - corner(told.transform)));
            let stage = tile.laid_out.map(SectionFromTile::translation);
            laid_out.extend(stage.map(|stage| now - corner(frame.place(stage))));
        }
        let all = if there.is_empty() { laid_out } else { there };
        let middle = |axis: usize| {
            let mut all: Vec<f64> = all.iter().map(|by| by[axis]).collect();
            all.sort_by(f64::total_cmp);
            all.get(all.len() / 2).copied()
        };
        Some(DVec2::new(middle(0)?, middle(1)?))
    }
}
