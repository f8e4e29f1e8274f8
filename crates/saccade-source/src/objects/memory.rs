use std::collections::BTreeMap;

use bytes::Bytes;

use super::{ObjectError, Objects, Part, is_key, part_of};
use crate::maybe_send::BoxFuture;

/// Objects in memory.
#[derive(Clone, Debug, Default)]
pub struct MemoryObjects(BTreeMap<String, Bytes>);

impl FromIterator<(String, Bytes)> for MemoryObjects {
    fn from_iter<T: IntoIterator<Item = (String, Bytes)>>(objects: T) -> Self {
        Self(objects.into_iter().collect())
    }
}

impl Objects for MemoryObjects {
    fn read<'a>(
        &'a self,
        key: &'a str,
        part: Part,
    ) -> BoxFuture<'a, Result<Option<Bytes>, ObjectError>> {
        let found = if is_key(key) {
            let location = || self.location(key);
            let bytes = self.0.get(key);
            bytes
                .map(|bytes| part_of(bytes, &part, location))
                .transpose()
        } else {
            Err(ObjectError::Key {
                key: key.to_owned(),
                location: "memory".to_owned(),
            })
        };
        Box::pin(std::future::ready(found))
    }

    fn location(&self, key: &str) -> String {
        format!("memory/{key}")
    }

    fn read_cost(&self) -> u64 {
        0
    }

    fn is_remote(&self) -> bool {
        false
    }
}
