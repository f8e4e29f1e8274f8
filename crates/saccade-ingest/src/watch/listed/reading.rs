//! The list is read again, and what it says now is taken over.

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::SystemTime;

use glam::{DVec2, UVec2, UVec3};
use saccade_archive::acquisition::{
    AcquisitionError, ChannelRef, DeleteRecord, Record, TransformRecord,
};
use saccade_core::transform::SectionFromTile;

use super::super::{BEFORE_FIRST, Folders};
use super::frame::Frame;
use super::index::{Sought, base, key, names};
use super::source::{self, Listing, State, adopt, offset, raw, solution_again};
use super::{Image, ListError, ListWatch, Tile, Trouble, Wanted, frame};
use crate::replay::RawTile;

impl<F: Folders> ListWatch<F> {
    /// Reads the list if it has changed and rests. Whether it may soon be read.
    pub(super) fn read_list(&mut self, now: SystemTime) -> Result<bool, ListError> {
        let projects = self.index.projects().map(|path| self.folder.join(path));
        let mut projects: Vec<PathBuf> = projects.collect();
        projects.sort_by_key(|path| (path.components().count(), path.clone()));
        let age = match self.files.look(&self.disk, &projects) {
            State::Gone => {
                let path = self.config.list.clone();
                return Err(ListError::Gone { path });
            }
            State::Same => {
                self.unsure = None;
                return self.troubled();
            }
            State::Changed(age) if age < self.config.rest => {
                self.unsure = None;
                return Ok(true);
            }
            // Nothing but time will tell whether it is whole.
            State::Changed(age) if self.unsure.is_some() && age < self.config.drop_after => {
                return Ok(true);
            }
            State::Changed(age) => age,
        };
        (self.trouble, self.unsure) = (None, None);
        // One that was begun without channels goes on so.
        let channels = self.frame.as_ref().is_none_or(Frame::has_channels);
        let mut listing = match source::read(&self.config, channels) {
            Ok(listing) if listing.tiles.is_empty() && listing.unfit.is_none() => {
                self.trouble = Some(Trouble::Empty);
                self.files.are_read();
                return self.troubled();
            }
            Ok(listing) => listing,
            Err(e) => return self.unreadable(e),
        };
        if let Some(line) = listing.cut_at.filter(|_| self.may_grow()) {
            let said = format!(
                "line {line} ends the list without a line feed, and may be cut within a number; the list is read once a line \
                 feed is there, or it has not changed for {} s: {}",
                self.config.drop_after.as_secs_f64(),
                self.config.list.display()
            );
            log::warn!("{said}");
            self.unsure = Some(said);
            return Ok(true);
        }
        listing.check_fit(&self.config)?;
        if self.frame.is_none() {
            listing.check_channels(&self.config)?;
        }
        let others = listing.tiles.len();
        let pattern = self.config.channel_in.as_ref().map(ToString::to_string);
        let unfit = listing.unfit.as_ref().zip(pattern);
        self.unfit = unfit.map(|(unfit, pattern)| unfit.said(others, &pattern));
        listing.notes.extend(self.unfit.clone());
        self.say_notes(std::mem::take(&mut listing.notes));
        let known: HashSet<&str> = listing.tiles.iter().map(|tile| &*tile.name).collect();
        let dropped =
            |(name, tile): &(&Arc<str>, &Tile)| tile.told.is_some() && !known.contains(&***name);
        // Half of a list looks like a list.
        if age < self.config.drop_after {
            let mut dropped = self.tiles.iter().filter(dropped);
            if let Some((first, _)) = dropped.next() {
                let said = format!(
                    "the list names {} tiles no more, such as {first:?}; in case it is being written, it is read once it \
                     has not changed for {} s: {}",
                    1 + dropped.count(),
                    self.config.drop_after.as_secs_f64(),
                    self.config.list.display()
                );
                log::warn!("{said}");
                self.unsure = Some(said);
                return Ok(true);
            }
        }
        let counted = self.count(&mut listing);
        if self.frame.is_none() {
            let begun = frame::begin(
                &self.config,
                &self.folder,
                &mut self.index,
                &listing,
                &projects,
            );
            let (frame, adopted) = begun?;
            frame.keep(&self.folder, &self.kept)?;
            frame::keep_adopted(adopted.as_ref(), &self.folder, &self.kept)?;
            if self.config.extent.is_none() && age < self.config.drop_after {
                let (UVec3 { x, y, z }, tiles) = (frame.extent(), listing.tiles.len());
                log::warn!(
                    "the {tiles} tiles that are listed so far decide that the volume has {x} x {y} x {z} voxels, and the list \
                     changed a moment ago: if it still grows, begin under another name (--volume NAME) with --extent and \
                     --origin: {}",
                    self.config.list.display()
                );
            }
            (self.frame, self.adopted) = (Some(frame), adopted);
        } else if let Some(adopted) = &mut self.adopted {
            match solution_again(&adopted.solution.path, listing.own.as_ref()) {
                Ok(solution) => {
                    adopted.solution = solution;
                    if !counted.is_some_and(|now| self.counts_otherwise(now)) {
                        self.align(&listing)?;
                    }
                }
                Err(e) => return self.unreadable(e),
            }
        } else {
            match adopt(&listing, &projects, self.raw(&listing)) {
                Ok(None) => {}
                Ok(Some(adopted)) => {
                    frame::keep_adopted(Some(&adopted), &self.folder, &self.kept)?;
                    self.adopted = Some(adopted);
                }
                Err(e) => return self.unreadable(e),
            }
        }
        if let Some(counted) = counted {
            self.keep_counted(&listing, counted)?;
        }
        self.say_registration();
        self.say_shift();
        self.say_unsolved(&listing, &projects);
        self.files.are_read();
        self.enter(listing, now);
        Ok(false)
    }

    /// Says what of the list does not count, once as long as it stays so.
    fn say_notes(&mut self, notes: Vec<String>) {
        for note in { notes.iter() }.filter(|note| !self.notes_said.contains(note)) {
            log::warn!("{note}");
        }
        self.notes_said = notes;
    }

    /// The tiles as replay knows them; those that are not there count as large as the largest of the others.
    pub(super) fn raw(&self, listing: &Listing) -> Vec<RawTile> {
        let size = |name: &str| {
            let size = self.tiles.get(name)?.told.as_ref()?.size;
            (size != UVec2::ZERO).then_some(size)
        };
        let sizes = listing.tiles.iter().filter_map(|tile| size(&tile.name));
        let largest = sizes.max_by_key(|size| u64::from(size.x) * u64::from(size.y));
        raw(&listing.tiles, |n: usize| {
            let tile = &listing.tiles[n];
            let size = size(&tile.name).or(tile.size).or(largest);
            size.unwrap_or(UVec2::ONE)
        })
    }

    /// Finds out anew how far the solution's frame is from the list's, unless of the tiles that are there some lie where it says, and the
    /// others where the list has them: then it knows more of them at most.
    fn align(&mut self, listing: &Listing) -> Result<(), ListError> {
        let raw = self.raw(listing);
        let Some((adopted, frame)) = self.adopted.as_mut().zip(self.frame.as_ref()) else {
            return Ok(());
        };
        let (mut same, mut moved) = (false, false);
        for named in &listing.tiles {
            let told = { self.tiles.get(&*named.name) }.and_then(|tile| tile.told.as_ref());
            let Some((told, now)) = told.zip(adopted.place(named)) else {
                continue;
            };
            match same_place(told.transform, frame.place(now)) {
                true => same = true,
                false => moved |= !same_place(told.transform, frame.place(named.stage)),
            }
        }
        if same && !moved {
            return Ok(());
        }
        if let Some(offset) = offset(&adopted.solution, raw)
            && offset != adopted.offset
        {
            adopted.offset = offset;
            frame::keep_adopted(self.adopted.as_ref(), &self.folder, &self.kept)?;
        }
        Ok(())
    }

    /// Says which file's places count, if they are not the list's, once, and when that changes.
    fn say_registration(&mut self) {
        let adopted = self.adopted.as_ref();
        let path = adopted.map(|adopted| &adopted.solution.path);
        // What the list itself says of registration is no other file.
        let path = path.filter(|path| **path != self.config.list);
        if let Some(path) = path.filter(|path| self.registration_said.as_ref() != Some(path)) {
            log::warn!(
                "the tiles lie where registration has put them, not where the list says: {}",
                path.display()
            );
            self.registration_said = Some(path.clone());
        }
    }

    /// Says how far registration's places are moved, once, and when that changes.
    fn say_shift(&mut self) {
        let Some(adopted) = &self.adopted else {
            return;
        };
        let before = self.shift_said.replace(adopted.offset);
        if before == Some(adopted.offset) {
            return;
        }
        let DVec2 { x, y } = -adopted.offset;
        let path = adopted.solution.path.display();
        log::info!(
            "registration's places are moved by {x:.3}, {y:.3} pixels to where the list has the tiles, in whose pixels \
             --origin counts: {path}"
        );
    }

    /// Says how many tiles registration does not know, when that changes, or why what it found is not used.
    fn say_unsolved(&mut self, listing: &Listing, projects: &[PathBuf]) {
        let Some(adopted) = &self.adopted else {
            if !self.unused_said
                && let Some(why) =
                    source::unused(listing).or_else(|| source::unused_project(listing, projects))
            {
                log::warn!("{why}");
                self.unused_said = true;
            }
            return;
        };
        let mut unsolved = listing.tiles.iter().filter(|t| adopted.place(t).is_none());
        let first = unsolved.next();
        let count = unsolved.count() + usize::from(first.is_some());
        if count == std::mem::replace(&mut self.unsolved_said, count) {
            return;
        }
        let path = adopted.solution.path.display();
        match first {
            Some(first) => log::warn!(
                "registration knows {} of the {} tiles; the others, such as {:?}, lie where the list has them: {path}",
                listing.tiles.len() - count,
                listing.tiles.len(),
                first.name
            ),
            None => log::warn!("registration knows all tiles now: {path}"),
        }
    }

    fn unreadable(&mut self, error: AcquisitionError) -> Result<bool, ListError> {
        self.trouble = Some(Trouble::Unreadable(Arc::new(error)));
        self.files.are_read();
        self.troubled()
    }

    fn troubled(&self) -> Result<bool, ListError> {
        match self.trouble.clone() {
            None => Ok(false),
            Some(Trouble::Unreadable(source)) => Err(ListError::List { source }),
            Some(Trouble::Empty) => Err(ListError::Empty {
                path: self.config.list.clone(),
            }),
        }
    }

    /// Takes over what the list says now.
    fn enter(&mut self, listing: Listing, now: SystemTime) {
        let Some(frame) = self.frame.clone() else {
            return;
        };
        self.index
            .know(listing.tiles.iter().map(|tile| &*tile.file));
        for tile in self.tiles.values_mut() {
            tile.wanted = None;
        }
        self.missing.clear();
        self.unclear.clear();
        // What was told of an image that was replaced since says nothing.
        for unread in &self.unread {
            if let Some(told) = { self.tiles.get_mut(&unread.tile) }.and_then(|t| t.told.as_mut()) {
                told.size = UVec2::ZERO;
            }
        }
        let before = std::mem::take(&mut self.unread).into_iter();
        let mut before: HashMap<_, _> =
            before.map(|unread| (unread.tile.clone(), unread)).collect();
        for named in listing.tiles {
            let solved = self
                .adopted
                .as_ref()
                .and_then(|adopted| adopted.place(&named));
            let transform = frame.place(solved.unwrap_or(named.stage));
            let section = named
                .section
                .checked_sub(frame.first)
                .unwrap_or(BEFORE_FIRST);
            let name: Arc<str> = named.name.into();
            for image in names(&named.file) {
                let tiles = self.by_name.entry(key(&image)).or_default();
                tiles.insert(Arc::clone(&name));
            }
            let tile = self.tiles.entry(Arc::clone(&name)).or_default();
            let image = match &mut tile.told {
                // One that lay outside of the volume was not taken in: it is told of anew, image and all.
                Some(told)
                    if self.index.is_still(&told.file, &named.file)
                        && (told.section, told.size == UVec2::ZERO) == (section, false)
                        && told.channel == named.channel.clone().map(ChannelRef::Name)
                        && (frame.holds(section, told.size, told.transform)
                            || same_place(told.transform, transform)) =>
                {
                    if !same_place(told.transform, transform) {
                        told.transform = transform;
                        let record = TransformRecord {
                            tile: name.to_string(),
                            transform,
                        };
                        self.untold.push_back((Record::Transform(record), None));
                    }
                    Image::Told
                }
                _ => Image::Missing,
            };
            tile.wanted = Some(Wanted {
                file: named.file,
                section,
                transform,
                channel: named.channel.map(ChannelRef::Name),
                image,
            });
            if image == Image::Missing {
                self.look_for(&name, now);
            }
        }
        for unread in &mut self.unread {
            if let Some(before) = before.remove(&unread.tile) {
                *unread = before;
            }
        }
        self.give_back();
        let untold = &mut self.untold;
        self.tiles.retain(|name, tile| {
            if tile.wanted.is_none() && tile.told.is_some() {
                let tile = name.to_string();
                untold.push_back((Record::Delete(DeleteRecord { tile }), None));
            }
            tile.wanted.is_some()
        });
        if self.missing_said.is_some() {
            self.missing_said = self.missing();
        }
    }
}

impl<F: Folders> ListWatch<F> {
    /// Takes away the tiles whose own image is not there and which show one that may as well be another's, or that is surely not
    /// theirs: the list did not name the other when it was taken, or their own folder was not there. So what is shown does not
    /// depend on what came first.
    fn give_back(&mut self) {
        let told = { self.tiles.iter() }.filter_map(|(name, tile)| {
            let wanted = { tile.wanted.as_ref() }.filter(|wanted| wanted.image == Image::Missing);
            Some((name, &wanted?.file, &tile.told.as_ref()?.file))
        });
        let wrong = told.filter(|(_, wanted, told)| {
            self.folder.join(told).is_file()
                && (!self.index.may_be(told, wanted)
                    || self.index.is_stray(told, wanted)
                    || self.is_anothers(told, wanted))
        });
        let wrong: Vec<Arc<str>> = wrong.map(|(name, ..)| Arc::clone(name)).collect();
        for name in wrong {
            if let Some(tile) = self.tiles.get_mut(&name) {
                let told = tile.told.take();
                let (tile, file) = (name.to_string(), told.map_or_else(String::new, |t| t.file));
                log::warn!(
                    "tile {tile} showed {file:?}, which is not its image, and is taken away until that comes"
                );
                self.untold
                    .push_back((Record::Delete(DeleteRecord { tile }), None));
            }
        }
    }

    /// Whether an image is what the list calls by other words than `file`.
    fn is_anothers(&self, image: &str, file: &str) -> bool {
        let tiles = self.by_name.get(&key(base(image)));
        let others = { tiles.into_iter().flatten() }.filter_map(|tile| {
            let wanted = self.tiles.get(tile)?.wanted.as_ref()?;
            (wanted.file != file && self.index.may_be(image, &wanted.file)).then_some(wanted)
        });
        let there = Sought::There(image.into());
        { others }.any(|other| self.index.sought(&other.file) == there)
    }
}

/// Whether two transforms say the same; text may lose a number's last bit.
fn same_place(a: SectionFromTile, b: SectionFromTile) -> bool {
    let mut pairs = a.elements().into_iter().zip(b.elements());
    pairs.all(|(a, b)| (a - b).abs() <= 1e-12 * a.abs().max(1.0))
}
