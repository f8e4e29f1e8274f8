//! Paths that are found by how they end.

use std::collections::BTreeMap;

/// Paths in the order of their ends, so that those which end alike lie beside one another.
#[derive(Clone, Debug, Default)]
pub struct Ends<T>(BTreeMap<String, Vec<T>>);

impl<T> Ends<T> {
    /// Adds what has a path, with slashes.
    pub fn insert(&mut self, path: &str, value: T) {
        self.0.entry(from_its_end(path)).or_default().push(value);
    }

    /// Those that end so: in these last parts, such as `s01/raw`.
    pub fn ending<'a>(&'a self, end: &str) -> impl Iterator<Item = &'a T> + use<'a, T> {
        let end = from_its_end(end);
        let from = self.0.range(end.clone()..);
        let alike = from.take_while(move |(path, _)| path.starts_with(&end));
        alike.flat_map(|(_, values)| values)
    }
}

/// Each part is ended by a slash, so that none is the beginning of another.
fn from_its_end(path: &str) -> String {
    let parts = path.rsplit('/').filter(|part| !part.is_empty());
    parts.flat_map(|part| [part, "/"]).collect()
}
