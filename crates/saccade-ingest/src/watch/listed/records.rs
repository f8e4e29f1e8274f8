//! What was told, and what is to be.

use std::collections::HashMap;
use std::fs;
use std::sync::Arc;
use std::time::SystemTime;

use glam::UVec2;
use saccade_archive::acquisition::{
    Cursor, DeleteRecord, Record, RecordReader, TileRecord, TransformRecord,
};
use saccade_archive::image::read_size;

use super::super::list::{self, List};
use super::super::stamp::{Seen, Stamp};
use super::super::{Folders, LINK, PATIENCE, file_name};
use super::index::{Sought, base, key};
use super::{Image, ListError, ListWatch, Tile, Told};

impl<F: Folders> ListWatch<F> {
    /// Becomes the one that writes the records, if no other process is.
    pub(super) fn take_over(&mut self) -> Result<bool, ListError> {
        let Some(records) = List::open(&self.kept)? else {
            return Ok(false);
        };
        let modified = fs::metadata(self.kept.join(RecordReader::FILE)).and_then(|m| m.modified());
        self.told_until = modified.unwrap_or(SystemTime::UNIX_EPOCH);
        let mut reader = RecordReader::new(&self.kept, Cursor::default());
        // Tellings of a file of which it is not known what it looked like.
        let mut unknown: HashMap<u64, u32> = HashMap::new();
        loop {
            let lines = reader.read(4096)?;
            if lines.is_empty() {
                break;
            }
            for record in lines.into_iter().filter_map(|line| line.record.ok()) {
                match record {
                    Record::Tile(tile) => {
                        let file = file_name(&tile.file).to_owned();
                        *unknown.entry(key(&file)).or_default() += 1;
                        self.seen.insert(key(&file), None);
                        let told = Told {
                            file,
                            section: tile.section,
                            size: tile.size,
                            transform: tile.transform,
                            channel: tile.channel,
                        };
                        let name: Arc<str> = tile.tile.into();
                        let names = self.by_name.entry(key(base(&told.file))).or_default();
                        names.insert(Arc::clone(&name));
                        self.tiles.entry(name).or_default().told = Some(told);
                    }
                    Record::Transform(TransformRecord { tile, transform }) => {
                        let told = self.tiles.get_mut(&*tile).and_then(|t| t.told.as_mut());
                        if let Some(told) = told {
                            told.transform = transform;
                        }
                    }
                    Record::Delete(DeleteRecord { tile }) => _ = self.tiles.remove(&*tile),
                }
            }
        }
        self.stamps.each(|key, seen| {
            if let Some(known) = self.seen.get_mut(&key) {
                *known = seen.known();
            }
            if let Some(tellings) = unknown.get_mut(&key) {
                *tellings = tellings.saturating_sub(1);
            }
        });
        // A process that died told of a file and kept no more: what it looked like before says nothing.
        for (key, _) in unknown.into_iter().filter(|(_, tellings)| *tellings > 0) {
            self.seen.insert(key, None);
        }
        self.records = Some(records);
        Ok(true)
    }

    /// Writes what is to be told; how much it was. What cannot be written is kept.
    pub(super) fn tell(&mut self) -> Result<u64, ListError> {
        let (list, untold, stamps) = (&mut self.records, &mut self.untold, &mut self.stamps);
        let learned = std::mem::take(&mut self.learned);
        if list.is_some() {
            stamps.add(&learned);
        }
        Ok(list::tell(list.as_mut(), untold, stamps)?)
    }

    /// Reads the sizes of images that were found, and tells of their tiles.
    pub(super) fn read_images(&mut self, now: SystemTime) {
        let Some(patience) = self.config.poll.checked_mul(PATIENCE) else {
            return;
        };
        for _ in 0..self.unread.len().min(self.config.budget) {
            let Some(mut unread) = self.unread.pop_front() else {
                break;
            };
            let Some(Tile {
                wanted: Some(wanted),
                told,
            }) = self.tiles.get_mut(&unread.tile)
            else {
                continue;
            };
            let Sought::There(file) = self.index.find(&wanted.file) else {
                let tile = unread.tile;
                self.look_for(&tile, now);
                continue;
            };
            let path = self.folder.join(&file);
            let file = file.to_string_lossy().into_owned();
            // Before anything is read: what changes later is seen to have changed.
            let stamp = self.disk.stamp(&path).ok();
            let size = match read_size(&path) {
                Ok([x, y]) => UVec2::new(x, y),
                Err(_) => {
                    if stamp != unread.stamp {
                        (unread.stamp, unread.since) = (stamp, now);
                    }
                    if now.duration_since(unread.since).unwrap_or_default() < patience {
                        self.unread.push_back(unread);
                        continue;
                    }
                    // Ingest finds out what is wrong, and says so.
                    UVec2::ONE
                }
            };
            let record = TileRecord {
                tile: unread.tile.to_string(),
                file: format!("{LINK}/{file}"),
                section: wanted.section,
                size,
                transform: wanted.transform,
                channel: wanted.channel.clone(),
            };
            wanted.image = Image::Told;
            *told = Some(Told {
                section: wanted.section,
                size,
                transform: wanted.transform,
                channel: wanted.channel.clone(),
                file: file.clone(),
            });
            let was_replaced = stamp.is_some_and(|stamp| self.was_replaced(&file, &stamp));
            // One that is being written stays known as it was told of first: once it rests, that tells all of its tiles again.
            let known = self.seen.get(&key(&file)).copied().flatten();
            let growing = known.filter(|_| was_replaced && self.again.holds(key(&file)));
            let seen = stamp.map(|stamp| {
                // Whoever writes one that is not whole may still go on.
                if stamp.is_young(now) || size == UVec2::ONE {
                    self.again.add(key(&file), &file, now);
                }
                (key(&file), growing.unwrap_or(Seen::of(&stamp)))
            });
            self.seen.insert(key(&file), seen.map(|(_, seen)| seen));
            self.untold.push_back((Record::Tile(record), seen));
            if was_replaced && growing.is_none() {
                // Nobody else will see it: what the file looks like now is known from here on.
                self.tell_others_again(&file, &unread.tile, now);
            }
        }
    }

    /// Whether a file is another than the one that was told of before.
    fn was_replaced(&self, file: &str, stamp: &Stamp) -> bool {
        match self.seen.get(&key(file)) {
            Some(Some(before)) => before.is_replaced_by(Seen::of(stamp)),
            Some(None) => stamp.modified > self.told_until,
            None => false,
        }
    }

    /// The image of all tiles that show a file, but for one, is another.
    fn tell_others_again(&mut self, file: &str, but: &str, now: SystemTime) {
        let tiles = self.by_name.get(&key(base(file))).cloned();
        for tile in tiles.unwrap_or_default() {
            let told = self.tiles.get(&tile).and_then(|tile| tile.told.as_ref());
            if &*tile != but && told.is_some_and(|told| told.file == file) {
                self.tell_again(&tile, now);
            }
        }
    }
}
