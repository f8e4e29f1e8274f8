//! Keys of `volume.json` and of records, and those that are meant to be.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, Visitor};

/// All that counts in `volume.json`.
pub(super) const KNOWN: [&str; 6] = ["name", "extent", "voxel_nm", "dtype", "channels", "kind"];

/// The first key of a JSON object that is none of the `known`, but almost one of those, and that one.
pub(super) fn misspelt(text: &[u8], known: &[&'static str]) -> Option<(String, &'static str)> {
    let mut json = serde_json::Deserializer::from_slice(text);
    json.deserialize_map(Keys(known)).ok()?
}

/// Looks at keys alone, and keeps none but the one that it finds.
struct Keys<'a>(&'a [&'static str]);

impl<'de> Visitor<'de> for Keys<'_> {
    type Value = Option<(String, &'static str)>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let mut found = None;
        while let Some(like) = map.next_key_seed(Key(self.0))? {
            map.next_value::<IgnoredAny>()?;
            found = found.or(like);
        }
        Ok(found)
    }
}

/// One key.
struct Key<'a>(&'a [&'static str]);

impl<'de> DeserializeSeed<'de> for Key<'_> {
    type Value = Option<(String, &'static str)>;

    fn deserialize<D: Deserializer<'de>>(self, key: D) -> Result<Self::Value, D::Error> {
        key.deserialize_str(self)
    }
}

impl Visitor<'_> for Key<'_> {
    type Value = Option<(String, &'static str)>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a key")
    }

    fn visit_str<E>(self, key: &str) -> Result<Self::Value, E> {
        if self.0.contains(&key) {
            return Ok(None);
        }
        let meant = self.0.iter().find(|known| is_like(key, known));
        Ok(meant.map(|meant| (key.to_owned(), *meant)))
    }
}

/// Whether two keys differ in how words are joined alone, or in two neighbours that changed places, or, of a word
/// of six letters, in one, and of a long one in two. Most other short words are one letter from a short word.
fn is_like(key: &str, known: &str) -> bool {
    fn letters(text: &str) -> impl Iterator<Item = char> + '_ {
        let letters = text.chars().filter(|c| c.is_alphanumeric());
        letters.flat_map(char::to_lowercase)
    }
    // Most are told apart by this alone.
    if letters(key).count().abs_diff(letters(known).count()) > 2 {
        return false;
    }
    let key: Vec<char> = letters(key).collect();
    let known: Vec<char> = letters(known).collect();
    let most = match known.len() {
        0..6 => 0,
        6 | 7 => 1,
        _ => 2,
    };
    distance(&key, &known) <= most || is_swapped(&key, &known)
}

/// Whether one is the other with two neighbours in each other's place.
fn is_swapped(a: &[char], b: &[char]) -> bool {
    let differ = |at: &usize| a[*at] != b[*at];
    if a.len() != b.len() {
        return false;
    }
    let places: Vec<usize> = (0..a.len()).filter(differ).collect();
    matches!(*places, [i, j] if j == i + 1 && a[i] == b[j] && a[j] == b[i])
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

    #[test]
    fn short_words_are_like_none_but_themselves() {
        for (key, known) in [
            ("nmae", "name"),
            ("Name", "name"),
            ("knid", "kind"),
            ("dytpe", "dtype"),
            ("d_type", "dtype"),
            ("extant", "extent"),
            ("extetn", "extent"),
            ("voxelNm", "voxel_nm"),
            ("voxels_nm", "voxel_nm"),
            ("chanel", "channels"),
            ("chanel", "channel"),
            ("channels", "channel"),
            ("chnanel", "channel"),
        ] {
            assert!(is_like(key, known), "{key} {known}");
        }
        for (key, known) in [
            ("names", "name"),
            ("game", "name"),
            ("kinds", "kind"),
            ("wind", "kind"),
            ("mind", "kind"),
            ("type", "dtype"),
            ("text", "extent"),
            ("intent", "extent"),
            ("voxel", "voxel_nm"),
            ("panel", "channel"),
            ("chapel", "channel"),
            ("flannel", "channel"),
            ("eman", "name"),
        ] {
            assert!(!is_like(key, known), "{key} {known}");
        }
    }

    #[test]
    fn keys_inside_others_and_values_are_no_keys() {
        let of = |text: &str| misspelt(text.as_bytes(), &["channel"]).map(|(key, _)| key);
        assert_eq!(
            of(r#"{"a":{"chanel":1},"b":["chanel"],"c":"chanel"}"#),
            None
        );
        assert_eq!(
            of(r#"{"a":{},"chanel":1,"channe":2}"#),
            Some("chanel".into())
        );
        assert_eq!(of(r#"{"ch\u0061nel":1}"#), Some("chanel".into()));
        assert_eq!(of(r#"{"channel":1}"#), None);
        assert_eq!(of(r#"{"chanel":1"#), None);
        assert_eq!(of(r#"["chanel"]"#), None);
    }
}
