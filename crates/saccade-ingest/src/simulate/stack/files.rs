//! Section files: which they are, and in which order.

use std::cmp::Ordering;
use std::fs;
use std::path::{Path, PathBuf};

use super::StackError;

/// Whether the name is that of an image that could be a section.
pub(super) fn is_section(path: &Path) -> bool {
    has_extension(path, &["png", "tif", "tiff"])
}

/// Whether the name is that of a TIFF file.
pub(super) fn is_tiff(path: &Path) -> bool {
    has_extension(path, &["tif", "tiff"])
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    let extension = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default();
    extensions.iter().any(|e| extension.eq_ignore_ascii_case(e))
}

/// The sections in a folder in natural order: `2.png` before `10.png`. Hidden files are none.
pub(super) fn sections_of(folder: &Path) -> Result<Vec<PathBuf>, StackError> {
    let failed = |source| StackError::Read {
        source,
        path: folder.to_owned(),
    };
    let mut sections = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
        let path = entry.path();
        if !hidden && is_section(&path) && path.is_file() {
            sections.push(path);
        }
    }
    sections.sort_by(|a, b| natural(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(sections)
}

/// Compares texts so that numbers in them count as numbers, whatever their leading zeros.
pub(super) fn natural(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a, b);
    loop {
        let (Some(l), Some(r)) = (left.chars().next(), right.chars().next()) else {
            // Ties, such as `01` and `1`, are still put in an order.
            return left.len().cmp(&right.len()).then_with(|| a.cmp(b));
        };
        if l.is_ascii_digit() && r.is_ascii_digit() {
            let (l, left_rest) = number(left);
            let (r, right_rest) = number(right);
            match l.len().cmp(&r.len()).then_with(|| l.cmp(r)) {
                Ordering::Equal => (left, right) = (left_rest, right_rest),
                unequal => return unequal,
            }
        } else if l == r {
            (left, right) = (&left[l.len_utf8()..], &right[r.len_utf8()..]);
        } else {
            return l.cmp(&r);
        }
    }
}

/// The leading digits without leading zeros, and the rest.
fn number(text: &str) -> (&str, &str) {
    let end = text
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(text.len());
    let (digits, rest) = text.split_at(end);
    (digits.trim_start_matches('0'), rest)
}

/// A name fit for addresses and files, from a file or folder; generic names get their parent's too.
pub(crate) fn volume_name(path: &Path) -> String {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let clean = |part: &Path| -> String {
        let name = part
            .file_stem()
            .and_then(|n| n.to_str())
            .unwrap_or_default();
        let fit = |c: char| {
            if c.is_ascii_alphanumeric() || c == '_' {
                c
            } else {
                '-'
            }
        };
        name.chars()
            .map(fit)
            .collect::<String>()
            .trim_matches('-')
            .to_owned()
    };
    let names: Vec<String> = path
        .ancestors()
        .map(clean)
        .filter(|n| !n.is_empty())
        .take(2)
        .collect();
    match &names[..] {
        [] => "stack".to_owned(),
        [name, parent] if name.len() < 6 => format!("{parent}-{name}"),
        [name, ..] => name.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_count_as_numbers() {
        let mut names = [
            "b",
            "s10.png",
            "s9.png",
            "s009b.png",
            "a-2",
            "a-10",
            "s9.tif",
            "",
            "s09.png",
        ];
        names.sort_by(|a, b| natural(a, b));
        assert_eq!(
            names,
            [
                "",
                "a-2",
                "a-10",
                "b",
                "s09.png",
                "s9.png",
                "s9.tif",
                "s009b.png",
                "s10.png"
            ]
        );
        // Longer than any integer type.
        assert_eq!(
            natural("x99999999999999999999999", "x100000000000000000000000"),
            Ordering::Less
        );
    }

    #[test]
    fn names_are_fit_for_addresses() {
        assert_eq!(volume_name(Path::new("/data/stack1/raw")), "stack1-raw");
        assert_eq!(
            volume_name(Path::new("/data/grayscale maps/")),
            "grayscale-maps"
        );
        assert_eq!(volume_name(Path::new("/")), "stack");
    }
}
