//! What the names of pyramids say: ingest calls them after their volumes, sections, tiles and records.

use std::hash::BuildHasher as _;

use super::Check;
use super::repair::position_of;

/// A name as ingest gives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Name<'n> {
    pub(super) volume: &'n str,
    pub(super) section: u32,
    /// What it has of the tile's name, and the number of the attempt.
    tile: &'n str,
    /// Position of the record.
    pub(super) position: u64,
}

impl<'n> Name<'n> {
    /// `None` if ingest calls nothing so.
    pub(super) fn of(pyramid: &'n str) -> Option<Self> {
        let mut parts = pyramid.strip_prefix("tiles/")?.split('/');
        let (volume, section, file) = (parts.next()?, parts.next()?, parts.next()?);
        let section = section.parse().ok()?;
        let (tile, _) = file.rsplit_once('-')?;
        let name = Self {
            volume,
            section,
            tile,
            position: position_of(file)?,
        };
        parts.next().is_none().then_some(name)
    }

    /// Whether it is one of a tile of this name.
    pub(super) fn is_after(&self, tile: &str) -> bool {
        let plain = |c: char| {
            let stays = c.is_ascii_alphanumeric() || c == '-' || c == '_';
            if stays { c } else { '_' }
        };
        let own: String = tile.chars().take(100).map(plain).collect();
        let first = { self.tile.rsplit_once("-again") }
            .filter(|(_, attempt)| attempt.parse::<u32>().is_ok())
            .map(|(first, _)| first);
        self.tile == own || first == Some(&own)
    }
}

impl Check<'_> {
    /// The objects that are called after a record of a volume and its tile.
    pub(super) fn objects_of(&mut self, volume: &str, position: u64, tile: &str) -> Vec<String> {
        let (objects, hasher) = (self.objects, &self.hasher);
        let by_record = self.by_record.get_or_insert_with(|| {
            let mut by_record = std::collections::HashMap::<_, Vec<_>>::new();
            for (number, object) in objects.iter().enumerate() {
                if let Some(name) = Name::of(&object.name) {
                    let hash = hasher.hash_one((name.volume, name.position));
                    by_record.entry(hash).or_default().push(number);
                }
            }
            by_record
        });
        let there = by_record.get(&hasher.hash_one((volume, position)));
        let names = there.into_iter().flatten().map(|n| &objects[*n].name);
        let is_its = |name: &&String| {
            Name::of(name).is_some_and(|name| {
                name.volume == volume && name.position == position && name.is_after(tile)
            })
        };
        names.filter(is_its).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_say_what_ingest_puts_into_them() {
        let name = Name::of("tiles/v/000003/a_b-c-again2-3cf.tif").unwrap();
        assert_eq!((name.volume, name.section, name.position), ("v", 3, 0x3cf));
        for tile in ["a b-c", "a/b-c", "a_b-c", "a b-c-again2"] {
            assert!(name.is_after(tile), "{tile}");
        }
        for tile in ["a b", "a b-c-again3", "b-c", ""] {
            assert!(!name.is_after(tile), "{tile}");
        }
        for other in [
            "x",
            "tiles/v/000003/a.tif",
            "tiles/v/x/a-3.tif",
            "tiles/v/000003/deep/a-3.tif",
            "tiles/v/000003/a-3.tif-none7",
        ] {
            assert_eq!(Name::of(other), None, "{other}");
        }
    }
}
