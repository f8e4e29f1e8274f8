//! Lists that name a tile more than once: it is one tile, as it is named last.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::hash::Hash;
use std::path::Path;

use saccade_archive::acquisition::tile_list::ListedTile;
use saccade_archive::acquisition::tile_specs::TileSpec;

/// Lines of one kind: how many, and what is said of the first.
#[derive(Default)]
struct Lines {
    count: usize,
    first: String,
}

impl Lines {
    fn add(&mut self, said: impl FnOnce() -> String) {
        if self.count == 0 {
            self.first = said();
        }
        self.count += 1;
    }

    fn said(&self) -> Option<String> {
        Some(match self.count {
            0 => return None,
            1 => self.first.clone(),
            all => format!("{}, and {} more", self.first, all - 1),
        })
    }
}

/// The last of all that are one tile, in the place of the first, and what is said of the others.
fn last_of_each<T: PartialEq, K: Hash + Eq>(
    tiles: Vec<T>,
    key: impl Fn(&T) -> K,
    same: impl Fn(&T, &T) -> bool,
    say: impl Fn(&T, &T, bool) -> String,
) -> (Vec<T>, Option<String>) {
    let mut kept: Vec<T> = Vec::with_capacity(tiles.len());
    let mut places = HashMap::new();
    let (mut others, mut repeated) = (Lines::default(), Lines::default());
    for tile in tiles {
        match places.entry(key(&tile)) {
            Entry::Vacant(place) => {
                place.insert(kept.len());
                kept.push(tile);
            }
            Entry::Occupied(place) => {
                let before = &mut kept[*place.get()];
                let same = same(before, &tile);
                let lines = if same { &mut repeated } else { &mut others };
                lines.add(|| say(before, &tile, same));
                *before = tile;
            }
        }
    }
    let said = [others.said(), repeated.said()];
    let said: Vec<_> = said.into_iter().flatten().collect();
    (kept, (!said.is_empty()).then(|| said.join("; ")))
}

/// A path as either slash writes it, and with or without `./`.
fn parts(file: &str) -> Vec<String> {
    let parts = file.split(['/', '\\']).enumerate();
    let parts = parts.filter(|(n, part)| *part != "." && (*n == 0 || !part.is_empty()));
    parts.map(|(_, part)| part.to_owned()).collect()
}

/// Of lines: an image is one tile of a section. Another section may show it, too: lost ones are filled so.
pub(super) fn lines_once(tiles: Vec<ListedTile>, path: &Path) -> (Vec<ListedTile>, Option<String>) {
    let (tiles, said) = last_of_each(
        tiles,
        |tile| (parts(&tile.file), tile.section),
        |before, tile| before.corner == tile.corner,
        |before, tile, same| match same {
            true => format!("line {} repeats line {}", tile.line, before.line),
            false => format!(
                "line {} puts {:?} elsewhere than line {}",
                tile.line, tile.file, before.line
            ),
        },
    );
    let said = said.map(|said| {
        let path = path.display();
        format!("{said}: an image is one tile of its section, and the last line that names it counts: {path}")
    });
    (tiles, said)
}

/// Of specifications: a tile is what its id says, and one image may be several tiles.
pub(super) fn specs_once(specs: Vec<TileSpec>, path: &Path) -> (Vec<TileSpec>, Option<String>) {
    let (specs, said) = last_of_each(
        specs,
        |spec| spec.id.clone(),
        TileSpec::eq,
        |_, spec, same| match same {
            true => format!("tile {:?} is repeated", spec.id),
            false => format!("tile {:?} comes again, otherwise", spec.id),
        },
    );
    let said = said.map(|said| {
        let path = path.display();
        format!("{said}: each id is one tile, as it comes last: {path}")
    });
    (specs, said)
}

#[cfg(test)]
mod tests {
    use saccade_archive::acquisition::tile_list;

    use super::*;

    fn once(text: &str) -> (Vec<(String, f64, u32)>, Option<String>) {
        let path = Path::new("list.txt");
        let (tiles, said) = lines_once(tile_list::parse(text.as_bytes(), path).unwrap(), path);
        let tiles = tiles.into_iter();
        let tiles = tiles.map(|tile| (tile.file, tile.corner.x, tile.section));
        (tiles.collect(), said)
    }

    #[test]
    fn the_last_line_counts_where_the_first_was() {
        let (tiles, said) = once("a.tif 0 0 0\nb.tif 1 0 0\n\na.tif 5 0 0\n./b.tif 1 0 0\n");
        let want = [("a.tif", 5.0, 0), ("./b.tif", 1.0, 0)];
        assert_eq!(tiles, want.map(|(file, x, z)| (file.to_owned(), x, z)));
        let said = said.unwrap();
        for words in [
            "line 4 puts \"a.tif\" elsewhere than line 1",
            "line 5 repeats line 2",
            "list.txt",
        ] {
            assert!(said.contains(words), "{said}");
        }
        let (tiles, said) = once("a.tif 0 0 0\na.tif 1 0 0\na.tif 2 0 0\na.tif 3 0 0\n");
        assert_eq!(tiles, [("a.tif".to_owned(), 3.0, 0)]);
        assert!(said.unwrap().contains("than line 1, and 2 more"));
    }

    #[test]
    fn other_sections_and_other_folders_are_other_tiles() {
        for text in [
            "a.tif 0 0 0\na.tif 0 0 1\n",
            "one/a.tif 0 0 0\ntwo/a.tif 0 0 0\n",
            "/one/a.tif 0 0 0\none/a.tif 0 0 0\n",
        ] {
            let (tiles, said) = once(text);
            assert_eq!((tiles.len(), said), (2, None), "{text}");
        }
    }
}
