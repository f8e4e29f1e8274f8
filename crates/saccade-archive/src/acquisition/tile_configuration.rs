//! Tile configurations of Fiji's stitching plugins: `file; ; (x, y)` per line.
//!
//! What the microscope said is `TileConfiguration.txt`; what the plugin computed,
//! `TileConfiguration.registered.txt`, in the same form.

use std::path::{Path, PathBuf};

use glam::DVec2;

use super::AcquisitionError;
use super::text::{content, quoted};
use super::tile_list::ListedTile;
use crate::storage::read_regular;

/// Reads a tile configuration. With `dim = 3`, z is the section, and a whole number; with `dim = 2`
/// all tiles are of section 0.
///
/// # Errors
///
/// [`AcquisitionError::Read`]; [`AcquisitionError::Utf16`]; [`AcquisitionError::Line`] for the first line that makes
/// no sense, for a file without `dim`, and for files that hold several tiles each.
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
    let (mut dimensions, mut tiles, mut last) = (None, Vec::new(), 0);
    let wrong = |line, reason| AcquisitionError::Line {
        line,
        reason,
        path: path.to_owned(),
    };
    for (line, text) in (1..).zip(text.lines()) {
        last = line;
        let text = text.trim();
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        if let Some((name, value)) = setting(text) {
            match (name, value) {
                ("dim", "2") => dimensions = Some(2),
                ("dim", "3") => dimensions = Some(3),
                ("dim", _) => {
                    return Err(wrong(line, format!("dim is {}, not 2 or 3", quoted(value))));
                }
                ("multiseries", "true") => {
                    let reason = "files of several tiles cannot be read; write each tile into a \
                                  file of its own";
                    return Err(wrong(line, reason.to_owned()));
                }
                _ => {}
            }
            continue;
        }
        let Some(dimensions) = dimensions else {
            return Err(wrong(
                line,
                "a tile comes before `dim = 2` or `dim = 3`".into(),
            ));
        };
        tiles.push(tile(text, dimensions, line).map_err(|reason| wrong(line, reason))?);
    }
    match dimensions {
        Some(_) => Ok(tiles),
        None => Err(wrong(
            last.max(1),
            "there is no `dim = 2` or `dim = 3`".into(),
        )),
    }
}

/// Where the plugin writes what it computed from a configuration.
pub fn registered(path: &Path) -> PathBuf {
    path.with_extension("registered.txt")
}

fn setting(text: &str) -> Option<(&str, &str)> {
    let (name, value) = text.split_once('=')?;
    // File names may hold an equals sign; settings hold no semicolon.
    (!text.contains(';')).then(|| (name.trim(), value.trim()))
}

fn tile(text: &str, dimensions: usize, line: u64) -> Result<ListedTile, String> {
    let form = || format!("{} is not `file; ; (x, y)`", quoted(text));
    let (rest, position) = text.rsplit_once(';').ok_or_else(form)?;
    // Between the semicolons stands the series within the file.
    let (file, _) = rest.rsplit_once(';').ok_or_else(form)?;
    let inside = position.trim().strip_prefix('(');
    let inside = inside.and_then(|p| p.strip_suffix(')')).ok_or_else(form)?;
    let numbers: Result<Vec<f64>, _> = inside.split(',').map(|n| n.trim().parse()).collect();
    let numbers = numbers.map_err(|_| form())?;
    if numbers.len() != dimensions || !numbers.iter().all(|n| n.is_finite()) {
        let text = quoted(text);
        return Err(format!("{text} does not have {dimensions} coordinates"));
    }
    let z = numbers.get(2).copied().unwrap_or(0.0);
    if !(z >= 0.0 && z.fract() == 0.0 && z <= f64::from(u32::MAX)) {
        return Err(format!("z is {z}, but a section is a whole number from 0"));
    }
    #[expect(clippy::cast_possible_truncation, reason = "checked above")]
    let section = z as u32;
    Ok(ListedTile {
        file: file.trim().to_owned(),
        corner: DVec2::new(numbers[0], numbers[1]),
        section,
        line,
        // A parenthesis ends them.
        may_be_cut: false,
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn parse(text: &str) -> Result<Vec<ListedTile>, AcquisitionError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("TileConfiguration.txt");
        fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn two_and_three_dimensions() {
        let flat = "# Define the number of dimensions\ndim = 2\n\n# Define the image coordinates\n\
                    a=b.tif; ; (0.0, -3.5)\r\nfolder/c d.tif; 0; (1e2,7)\n";
        let tiles = parse(flat).unwrap();
        let got: Vec<_> = tiles
            .iter()
            .map(|t| (t.file.as_str(), t.corner, t.section))
            .collect();
        let want = [
            ("a=b.tif", DVec2::new(0.0, -3.5), 0),
            ("folder/c d.tif", DVec2::new(100.0, 7.0), 0),
        ];
        assert_eq!(got, want);
        let deep = parse("dim = 3\na.tif; ; (1, 2, 7.0)\n").unwrap();
        assert_eq!((deep[0].corner, deep[0].section), (DVec2::new(1.0, 2.0), 7));
        assert!(parse("dim = 2\n").unwrap().is_empty());
    }

    #[test]
    fn nonsense_is_refused_with_its_line() {
        for (text, line) in [
            ("a.tif; ; (0, 0)\n", 1),
            ("\n", 1),
            ("dim = 4\n", 1),
            ("dim = 2\na.tif; ; (0, 0, 0)\n", 2),
            ("dim = 3\na.tif; ; (0, 0)\n", 2),
            ("dim = 3\na.tif; ; (0, 0, 1.5)\n", 2),
            ("dim = 2\na.tif; (0, 0)\n", 2),
            ("dim = 2\na.tif; ; 0, 0\n", 2),
            ("dim = 2\n# c\na.tif; ; (0, x)\n", 3),
            ("dim = 2\na.tif; ; (NaN, 0)\n", 2),
            ("dim = 2\nmultiseries = true\na.czi; 3; (0, 0)\n", 2),
        ] {
            match parse(text) {
                Err(AcquisitionError::Line { line: got, .. }) => assert_eq!(got, line, "{text:?}"),
                other => panic!("{text:?}: {other:?}"),
            }
        }
    }

    #[test]
    fn the_registered_one_lies_beside() {
        let path = Path::new("x/TileConfiguration.txt");
        assert_eq!(
            registered(path),
            Path::new("x/TileConfiguration.registered.txt")
        );
    }
}
