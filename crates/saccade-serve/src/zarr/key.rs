//! The keys of the virtual hierarchy.

use glam::UVec3;
use saccade_source::ChunkId;

/// What a key below the image's root names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Key {
    /// The image: `zarr.json`.
    Group,
    /// A level's array: `L/zarr.json`.
    Array {
        /// Level.
        level: u32,
    },
    /// A chunk: `L/c/C/Z/Y/X`.
    Chunk(ChunkId),
}

impl Key {
    /// Keys have one spelling; `None` for any other text.
    pub(crate) fn parse(key: &str) -> Option<Self> {
        let parts: Vec<&str> = key.split('/').collect();
        Some(match parts[..] {
            ["zarr.json"] => Self::Group,
            [level, "zarr.json"] => Self::Array {
                level: index(level)?,
            },
            [level, "c", c, z, y, x] => Self::Chunk(ChunkId {
                channel: index(c)?,
                level: index(level)?,
                chunk: UVec3::new(index(x)?, index(y)?, index(z)?),
            }),
            _ => return None,
        })
    }
}

fn index(text: &str) -> Option<u32> {
    let plain = text.bytes().all(|b| b.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    plain.then(|| text.parse().ok())?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_have_one_spelling() {
        assert_eq!(Key::parse("zarr.json"), Some(Key::Group));
        assert_eq!(Key::parse("12/zarr.json"), Some(Key::Array { level: 12 }));
        let id = ChunkId {
            channel: 0,
            level: 1,
            chunk: UVec3::new(4, 3, 2),
        };
        assert_eq!(
            Key::parse("1/c/0/2/3/4"),
            Some(Key::Chunk(id)),
            "z, y, x turns to x, y, z"
        );
        let garbage = [
            "",
            "/",
            "1",
            "01/zarr.json",
            "+1/zarr.json",
            "-1/zarr.json",
            "1/c/0/2/3",
            "1/c/0/2/3/",
            "1/c/0/2/3/4/5",
            "1/c/0/2/3/4294967296",
            "../zarr.json",
            "1/c/0/2/3/x",
            ".zattrs",
        ];
        for key in garbage {
            assert_eq!(Key::parse(key), None, "{key:?}");
        }
    }
}
