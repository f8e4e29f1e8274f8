//! From the bytes of a stored chunk to its values: the part of reading that takes a processor's time.
//!
//! What is to be done is a value, [`Decoding`], so that it can be sent to where it is done: natively to a thread, in
//! browsers as text to a worker.

#[cfg(not(target_family = "wasm"))]
#[path = "decoding/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "decoding/wasm.rs"]
mod platform;
#[cfg(any(test, target_family = "wasm"))]
mod pool;

use std::sync::Arc;

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use crate::codecs::Damage;
use crate::values::{Inside, Values};
use crate::{precomputed, zarr};

pub(crate) use platform::decode;
#[cfg(target_family = "wasm")]
pub use platform::{Counts, counts, use_workers, work};

/// How a format makes bytes of numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Packing {
    Zarr(zarr::Packing),
    Precomputed(precomputed::Packing),
}

/// What becomes of a chunk's bytes.
#[derive(Clone, Debug)]
pub(crate) struct Decoding {
    packing: Packing,
    /// Numbers stay as they are stored where this is `None`.
    values: Option<Arc<Values>>,
    /// Which of them are of the image; all where this is `None`.
    inside: Option<Inside>,
}

/// As it is sent.
#[cfg(any(test, target_family = "wasm"))]
#[derive(Serialize)]
struct Sent<'a>(&'a Packing, Option<&'a Values>, Option<&'a Inside>);

impl Decoding {
    pub(crate) fn new(packing: Packing, values: Option<&Arc<Values>>) -> Self {
        let values = values.cloned();
        Self {
            packing,
            values,
            inside: None,
        }
    }

    /// Of a chunk of which not all is of the image.
    pub(crate) fn within(self, inside: Option<Inside>) -> Self {
        Self { inside, ..self }
    }

    /// Does it.
    pub(crate) fn run(&self, bytes: Bytes) -> Result<Bytes, Damage> {
        let numbers = match &self.packing {
            Packing::Zarr(packing) => packing.unpack(bytes),
            Packing::Precomputed(packing) => packing.unpack(bytes),
        }?;
        Ok(match &self.values {
            Some(values) => values.convert(numbers, self.inside.as_ref()),
            None => numbers,
        })
    }

    /// For somebody else to do.
    #[cfg(any(test, target_family = "wasm"))]
    pub(crate) fn to_text(&self) -> Result<String, Damage> {
        let sent = Sent(&self.packing, self.values.as_deref(), self.inside.as_ref());
        serde_json::to_string(&sent).map_err(|error| format!("it cannot be handed over: {error}"))
    }

    /// What somebody else is to do.
    #[cfg(any(test, target_family = "wasm"))]
    pub(crate) fn from_text(text: &str) -> Result<Self, Damage> {
        let read = serde_json::from_str(text);
        let (packing, values, inside): (Packing, Option<Values>, Option<Inside>) =
            read.map_err(|error| format!("it was handed over as something else: {error}"))?;
        let values = values.map(Arc::new);
        Ok(Self {
            packing,
            values,
            inside,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values::{Number, Spread};

    /// A worker does the same as a thread: also with windows that no short decimal number says.
    #[test]
    fn what_is_sent_does_the_same() {
        let window = Spread::Real {
            min: -0.1 / 3.0,
            max: f64::from(f32::MAX) / 7.0,
        };
        let stored: Vec<u8> = (0..1000_u32)
            .flat_map(|n| (n as f32 * 1e34).to_be_bytes())
            .collect();
        let zipped = {
            use std::io::Write as _;
            let mut zip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            zip.write_all(&stored).unwrap();
            Bytes::from(zip.finish().unwrap())
        };
        let packing = zarr::Packing::new(vec![crate::codecs::Codec::Gzip], stored.len());
        let shades = Values::fitted(Number::F32, true, Some(window));
        let names = Values::names(Number::U32, true).unwrap();
        let of_whole =
            |number, min, max| Values::fitted(number, true, Some(Spread::Whole { min, max }));
        let wide = of_whole(Number::U64, 1 << 33, u64::MAX.into());
        let low = of_whole(Number::I64, i64::MIN.into(), i128::from(i64::MIN) + 9);
        let inside = Inside::new([(10, 7), (100, 100)]);
        for values in [shades, names, wide, low] {
            let values = Arc::new(values);
            for values in [None, Some(&values)] {
                let here =
                    Decoding::new(Packing::Zarr(packing.clone()), values).within(inside.clone());
                let text = here.to_text().unwrap();
                let there = Decoding::from_text(&text).unwrap();
                assert_eq!(there.to_text().unwrap(), text);
                let want = here.run(zipped.clone()).unwrap();
                assert_eq!(there.run(zipped.clone()).unwrap(), want, "{text}");
                assert_eq!(values.is_none(), want == stored);
            }
        }
        assert!(Decoding::from_text("[]").is_err());
    }
}
