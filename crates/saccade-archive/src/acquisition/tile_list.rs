//! Plain tile lists: `file x y z` per line, as TrakEM2 imports them.

use std::path::Path;

use glam::DVec2;

use super::AcquisitionError;
use super::text::{content, quoted};
use crate::percent;
use crate::storage::read_regular;

/// A line of a tile list.
#[derive(Clone, Debug, PartialEq)]
pub struct ListedTile {
    /// The image as the list names it.
    pub file: String,
    /// Low corner in its section \[pixels\].
    pub corner: DVec2,
    /// Section: z index, possibly not starting at 0.
    pub section: u32,
    /// Its line in the list, from 1.
    pub line: u64,
    /// Whether the list ends right behind its last number, of which more may be about to be written.
    pub may_be_cut: bool,
}

impl ListedTile {
    /// The file's name without folder and extension: the tile's name.
    pub fn name(&self) -> &str {
        stem(&self.file)
    }
}

/// File name without folder; either slash separates folders, for lists are written on any system.
pub fn base(file: &str) -> &str {
    file.rsplit(['/', '\\']).next().unwrap_or(file)
}

/// What a listed file means if it is written as part of a URL; `None` if it cannot be, or means itself.
///
/// Whether it is written so, only the files tell that are there. No folder is reached but those that its slashes separate:
/// an encoded one is none of them.
pub fn decoded(file: &str) -> Option<String> {
    let slashes = |text: &str| text.matches(['/', '\\']).count();
    let decoded = percent::decoded(file)?;
    let is_file = !decoded.contains('\0') && slashes(&decoded) == slashes(file);
    (is_file && decoded != file).then_some(decoded)
}

/// File name without folder and extension.
pub fn stem(file: &str) -> &str {
    let name = base(file);
    name.rsplit_once('.')
        .map_or(name, |(stem, _)| if stem.is_empty() { name } else { stem })
}

/// Reads a tile list. Columns are separated by white space, or all by commas; file names may contain blanks. Empty
/// lines and lines that begin with `#` are skipped, and a first line that names the last columns `x`, `y` and `z`.
///
/// # Errors
///
/// [`AcquisitionError::Read`]; [`AcquisitionError::Utf16`]; [`AcquisitionError::Line`] for the first line without
/// three numbers at its end, or with a section that is no whole number from 0.
pub fn read(path: &Path) -> Result<Vec<ListedTile>, AcquisitionError> {
    let bytes = read_regular(path).map_err(|source| AcquisitionError::Read {
        source,
        path: path.to_owned(),
    })?;
    parse(&bytes, path)
}

/// The same from the file's bytes; `path` is for messages.
///
/// # Errors
///
/// As [`read`], but for reading.
pub fn parse(bytes: &[u8], path: &Path) -> Result<Vec<ListedTile>, AcquisitionError> {
    let text = String::from_utf8_lossy(content(bytes, path)?);
    let mut tiles = Vec::new();
    for (line, text) in (1..).zip(text.lines()) {
        let text = text.trim();
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        if tiles.is_empty() && is_header(text) {
            continue;
        }
        tiles.push(listed(text, line).map_err(|reason| AcquisitionError::Line {
            line,
            reason,
            path: path.to_owned(),
        })?);
    }
    let lines = text.lines().count() as u64;
    if let Some(last) = tiles.last_mut().filter(|last| last.line == lines) {
        last.may_be_cut = text.ends_with(|c: char| !c.is_whitespace());
    }
    Ok(tiles)
}

/// File, x, y and z of a line. Commas count only where they separate all of them: a decimal comma is none of these.
fn columns(text: &str) -> Option<[&str; 4]> {
    let split = |is_end: fn(char) -> bool| {
        let mut file = text;
        let mut column = || {
            let (rest, last) = file.rsplit_once(is_end)?;
            file = rest.trim_end();
            Some(last.trim())
        };
        let (z, y, x) = (column()?, column()?, column()?);
        Some([file, x, y, z])
    };
    let is_written = |columns: &[&str; 4]| {
        !columns[1..]
            .iter()
            .any(|text| text.contains([',', ' ', '\t']))
    };
    let by_commas = split(|c| c == ',').filter(is_written);
    by_commas.or_else(|| split(char::is_whitespace))
}

fn is_header(text: &str) -> bool {
    let named = |columns: [&str; 4]| {
        columns[1..]
            .iter()
            .zip(["x", "y", "z"])
            .all(|(a, b)| a.eq_ignore_ascii_case(b))
    };
    columns(text).is_some_and(named)
}

fn listed(text: &str, line: u64) -> Result<ListedTile, String> {
    let [file, x, y, z] =
        columns(text).ok_or_else(|| format!("{} is not `file x y z`", quoted(text)))?;
    let number = |what: &str, text: &str| match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("{what} is {}, which is no number", quoted(text))),
    };
    let corner = DVec2::new(number("x", x)?, number("y", y)?);
    let z_value = number("z", z)?;
    let valid = z_value >= 0.0 && z_value.fract() == 0.0 && z_value <= f64::from(u32::MAX);
    if !valid {
        return Err(format!(
            "z is {}, but a section is a whole number from 0",
            quoted(z)
        ));
    }
    #[expect(clippy::cast_possible_truncation, reason = "checked above")]
    let section = z_value as u32;
    Ok(ListedTile {
        file: file.to_owned(),
        corner,
        section,
        line,
        may_be_cut: false,
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_number_that_nothing_ends_may_be_cut() {
        let cut = |text: &str| {
            let tiles = parse(text.as_bytes(), Path::new("list.txt")).unwrap();
            tiles.iter().map(|tile| tile.may_be_cut).collect::<Vec<_>>()
        };
        assert_eq!(cut("a.tif 0 0 0\nb.tif 0 0 10"), [false, true]);
        for ended in ["\n", "\r", " ", "\r\n"] {
            assert_eq!(cut(&format!("a.tif 0 0 10{ended}")), [false], "{ended:?}");
        }
        assert_eq!(cut("a.tif 0 0 10\n# no more"), [false]);
        assert!(cut("# none").is_empty());
    }

    #[test]
    fn blanks_comments_and_columns() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list.txt");
        fs::write(
            &path,
            "# made by hand\n\na/b c.tif\t1.5  -2 7\r\nd.tif 0 0 0.0\n",
        )
        .unwrap();
        let tiles = read(&path).unwrap();
        assert_eq!(tiles.len(), 2);
        assert_eq!(
            (tiles[0].file.as_str(), tiles[0].name()),
            ("a/b c.tif", "b c")
        );
        assert_eq!(
            (tiles[0].corner, tiles[0].section),
            (DVec2::new(1.5, -2.0), 7)
        );
        for bad in [
            "a.tif 1 2",
            "a.tif 1 2 3.5",
            "a.tif 1 x 3",
            "a.tif 1 2 -1",
            "a.tif inf 1 1",
        ] {
            fs::write(&path, format!("ok.tif 1 2 3\n{bad}\n")).unwrap();
            let refused = matches!(read(&path), Err(AcquisitionError::Line { line: 2, .. }));
            assert!(refused, "{bad}");
        }
    }

    #[test]
    fn commas_and_a_header_are_as_good_as_blanks() {
        let read = |text: &str| parse(text.as_bytes(), Path::new("list.csv"));
        let tiles = read("file,x,y,z\na b.tif,1.5,-2,7\nc,1.tif, 1, 2, 3\n").unwrap();
        assert_eq!((tiles[0].file.as_str(), tiles[0].section), ("a b.tif", 7));
        assert_eq!(tiles[0].corner, DVec2::new(1.5, -2.0));
        assert_eq!((tiles[1].file.as_str(), tiles[1].section), ("c,1.tif", 3));
        assert_eq!(
            read("# by hand\nImage X Y Z\na.tif 1 2 3\n").unwrap().len(),
            1
        );
        assert_eq!(read("a,b.tif 1 2 3\n").unwrap()[0].file, "a,b.tif");
        for bad in [
            "a.tif 0,5 3,2 1",
            "a.tif,1,2",
            "a.tif;1;2;3",
            "a.tif 1 2 3\nfile x y z",
            "a.tif,0,5 3,2 1",
        ] {
            assert!(
                matches!(read(bad), Err(AcquisitionError::Line { .. })),
                "{bad}"
            );
        }
    }
}
