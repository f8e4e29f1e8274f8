//! Keys of `volume.json`, and those that are meant to be.

use std::collections::BTreeMap;

use serde::de::IgnoredAny;

/// All that counts.
pub(super) const KNOWN: [&str; 6] = ["name", "extent", "voxel_nm", "dtype", "channels", "kind"];

/// The first key of a JSON object that is almost a known one, and that one.
pub(super) fn misspelt(text: &[u8]) -> Option<(String, &'static str)> {
    let keys: BTreeMap<String, IgnoredAny> = serde_json::from_slice(text).ok()?;
    let unknown = keys
        .into_keys()
        .filter(|key| !KNOWN.contains(&key.as_str()));
    for key in unknown {
        if let Some(meant) = KNOWN.into_iter().find(|known| is_like(&key, known)) {
            return Some((key, meant));
        }
    }
    None
}

/// Whether two keys differ in how words are joined alone, or in a letter, or in two of a long one.
fn is_like(key: &str, known: &str) -> bool {
    let letters = |text: &str| -> Vec<char> {
        let letters = text.chars().filter(|c| c.is_alphanumeric());
        letters.flat_map(char::to_lowercase).collect()
    };
    let (key, known) = (letters(key), letters(known));
    let most = if known.len() > 5 { 2 } else { 1 };
    distance(&key, &known) <= most
}

/// Letters to put in, to take out or to change, to make one of the other.
fn distance(a: &[char], b: &[char]) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut corner = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let changed = corner + usize::from(x != y);
            corner = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(corner + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances() {
        let of = |a: &str, b: &str| {
            let [a, b] = [a, b].map(|text| text.chars().collect::<Vec<_>>());
            assert_eq!(distance(&a, &b), distance(&b, &a));
            distance(&a, &b)
        };
        assert_eq!(of("", "abc"), 3);
        assert_eq!(of("abc", "abc"), 0);
        assert_eq!(of("kitten", "sitting"), 3);
        assert_eq!(of("chanels", "channels"), 1);
        assert_eq!(of("content", "extent"), 3);
    }
}
