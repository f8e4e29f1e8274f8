//! What the metadata of an array say: its shape, its chunks, and how they are encoded.

use serde_json::Value;

use super::error::Refusal;
use crate::codecs::Codec;
use crate::values::Number;

/// Chunks that are larger than this when decoded are refused \[bytes\].
const MOST_CHUNK: u64 = 1 << 30;
/// Chunks that a shard may have: its index must be read before any of them.
const MOST_IN_SHARD: u64 = 1 << 22;

/// What version 3 says of an array, and what is often said of groups and means nothing here.
const KNOWN: [&str; 12] = [
    "zarr_format",
    "node_type",
    "shape",
    "data_type",
    "chunk_grid",
    "chunk_key_encoding",
    "fill_value",
    "codecs",
    "attributes",
    "storage_transformers",
    "dimension_names",
    "consolidated_metadata",
];

/// How numbers become the bytes of a chunk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Encoding {
    /// Axes of the array in the order in which a chunk has them, slowest first.
    pub(super) order: Vec<usize>,
    pub(super) big_endian: bool,
    /// In the order in which they were applied.
    pub(super) codecs: Vec<Codec>,
}

/// How chunks lie in shards.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Sharding {
    /// Chunks per shard, by axis.
    pub(super) chunks: Vec<u64>,
    pub(super) index_at_start: bool,
    pub(super) index_big_endian: bool,
    pub(super) index_checked: bool,
}

impl Sharding {
    /// Chunks per shard.
    pub(super) fn count(&self) -> u64 {
        self.chunks.iter().product()
    }

    /// Bytes of its index.
    pub(super) fn index_bytes(&self) -> u64 {
        self.count() * 16 + if self.index_checked { 4 } else { 0 }
    }
}

/// How a chunk's numbers become its key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Keys {
    /// `c` comes first.
    prefixed: bool,
    separator: char,
}

impl Keys {
    pub(super) fn key(&self, chunk: &[u64]) -> String {
        let mut key = String::new();
        if self.prefixed {
            key.push('c');
        }
        for number in chunk {
            if !key.is_empty() {
                key.push(self.separator);
            }
            key += &number.to_string();
        }
        key
    }
}

/// An array.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Array {
    /// Slowest axis first.
    pub(super) shape: Vec<u64>,
    /// Of what is decoded in one piece.
    pub(super) chunk: Vec<u64>,
    pub(super) number: Number,
    pub(super) encoding: Encoding,
    pub(super) sharding: Option<Sharding>,
    pub(super) keys: Keys,
    /// A number as it is stored, for chunks that are not.
    pub(super) fill: Vec<u8>,
}

fn numbers(value: &Value) -> Option<Vec<u64>> {
    value.as_array()?.iter().map(Value::as_u64).collect()
}

impl Array {
    /// Bytes of a chunk when it is decoded.
    pub(super) fn chunk_bytes(&self) -> usize {
        let count: u64 = self.chunk.iter().product();
        usize::try_from(count).expect("checked when it was read") * self.number.bytes()
    }

    /// Chunks along each axis.
    pub(super) fn grid(&self) -> Vec<u64> {
        let axes = self.shape.iter().zip(&self.chunk);
        axes.map(|(length, chunk)| length.div_ceil(*chunk))
            .collect()
    }

    /// Of a `zarr.json`, version 3.
    pub(super) fn version_3(json: &Value) -> Result<Self, Refusal> {
        if json["node_type"]
            .as_str()
            .is_some_and(|node| node != "array")
        {
            return Err(Refusal::wrong("a level is listed, but is no array"));
        }
        format_is(json, 3)?;
        let understood = |(key, value): (&String, &Value)| {
            KNOWN.contains(&key.as_str()) || value["must_understand"] == false
        };
        if let Some((key, _)) =
            { json.as_object().into_iter().flatten() }.find(|one| !understood(*one))
        {
            return Err(Refusal::Unsupported(format!(
                "it has {key:?}, which is not known, and does not say that this does not matter (must_understand)"
            )));
        }
        let transformers = json["storage_transformers"].as_array();
        if transformers.is_some_and(|list| !list.is_empty()) {
            let reason = "it has storage transformers, which are not known";
            return Err(Refusal::Unsupported(reason.to_owned()));
        }
        let grid = &json["chunk_grid"];
        if grid["name"].as_str().is_some_and(|name| name != "regular") {
            let name = &grid["name"];
            return Err(Refusal::Unsupported(format!(
                "its chunks are {name}, not regular"
            )));
        }
        let (shape, stored) = shapes(&json["shape"], &grid["configuration"]["chunk_shape"])?;
        let number = match json["data_type"].as_str() {
            Some(name) => Number::named(name).ok_or_else(|| unknown_number(name))?,
            None => return Err(unknown_number(&json["data_type"].to_string())),
        };
        let keys = keys_3(&json["chunk_key_encoding"])?;
        let codecs = json["codecs"].as_array();
        let codecs = codecs.ok_or_else(|| Refusal::wrong("it has no codecs"))?;
        let rank = shape.len();
        let (chunk, encoding, sharding) = match &codecs[..] {
            [codec] if codec["name"] == "sharding_indexed" => {
                let (chunk, encoding, sharding) =
                    sharded(&codec["configuration"], &stored, number)?;
                (chunk, encoding, Some(sharding))
            }
            codecs => (stored.clone(), encoding_of(codecs, rank, number)?, None),
        };
        let fill = fill_3(&json["fill_value"], number, encoding.big_endian)?;
        Self {
            shape,
            chunk,
            number,
            encoding,
            sharding,
            keys,
            fill,
        }
        .checked()
    }

    /// Of a `.zarray`, version 2.
    pub(super) fn version_2(json: &Value) -> Result<Self, Refusal> {
        format_is(json, 2)?;
        let (shape, chunk) = shapes(&json["shape"], &json["chunks"])?;
        let dtype = &json["dtype"];
        let (number, big_endian) = dtype_2(dtype.as_str()).ok_or_else(|| match dtype.as_str() {
            Some(name) => unknown_number(name),
            None => unknown_number(&dtype.to_string()),
        })?;
        let mut codecs = Vec::new();
        let filters = json["filters"].as_array().into_iter().flatten();
        for codec in filters.chain(Some(&json["compressor"]).filter(|codec| !codec.is_null())) {
            codecs.push(codec_named(codec["id"].as_str().unwrap_or_default())?);
        }
        let mut order: Vec<usize> = (0..shape.len()).collect();
        match json["order"].as_str() {
            Some("F") => order.reverse(),
            Some("C") | None => {}
            Some(other) => {
                return Err(Refusal::Wrong(format!(
                    "its order {other:?} is neither C nor F"
                )));
            }
        }
        let keys = Keys {
            prefixed: false,
            separator: separator_of(&json["dimension_separator"], '.')?,
        };
        let fill = fill_3(&json["fill_value"], number, big_endian)?;
        Self {
            shape,
            chunk,
            number,
            encoding: Encoding {
                order,
                big_endian,
                codecs,
            },
            sharding: None,
            keys,
            fill,
        }
        .checked()
    }

    /// Refuses what would take absurdly much memory.
    fn checked(self) -> Result<Self, Refusal> {
        let bytes = self.number.bytes() as u64;
        let decoded = self
            .chunk
            .iter()
            .try_fold(bytes, |product, n| product.checked_mul(*n));
        if decoded.is_none_or(|decoded| decoded > MOST_CHUNK) {
            let chunk = &self.chunk;
            return Err(Refusal::Wrong(format!(
                "its chunks of {chunk:?} values are too large to decode"
            )));
        }
        let grid = self.grid();
        if grid
            .iter()
            .try_fold(1_u64, |product, n| product.checked_mul(*n))
            .is_none()
        {
            return Err(Refusal::wrong("it has more chunks than can be counted"));
        }
        if let Some(sharding) = &self.sharding {
            let count = sharding
                .chunks
                .iter()
                .try_fold(1_u64, |product, n| product.checked_mul(*n));
            if count.is_none_or(|count| count > MOST_IN_SHARD) {
                return Err(Refusal::Wrong(format!(
                    "its shards hold more than {MOST_IN_SHARD} chunks each"
                )));
            }
        }
        Ok(self)
    }
}

fn shapes(shape: &Value, chunk: &Value) -> Result<(Vec<u64>, Vec<u64>), Refusal> {
    let shape = numbers(shape).ok_or_else(|| Refusal::wrong("it has no shape"))?;
    let chunk = numbers(chunk).ok_or_else(|| Refusal::wrong("it has no chunk shape"))?;
    if shape.len() != chunk.len() || shape.contains(&0) || chunk.contains(&0) {
        return Err(Refusal::wrong(
            "its shape and that of its chunks do not fit",
        ));
    }
    Ok((shape, chunk))
}

fn unknown_number(name: &str) -> Refusal {
    Refusal::Unsupported(format!(
        "its values are {name}; whole numbers of 8 to 64 bit and floating-point ones of 32 and 64 bit \
         are shown: convert them"
    ))
}

/// Refuses metadata of another version than their file's name says.
fn format_is(json: &Value, version: u64) -> Result<(), Refusal> {
    match &json["zarr_format"] {
        format if *format == version || format.is_null() => Ok(()),
        other => Err(Refusal::Unsupported(format!(
            "its zarr_format is {other}; versions 2, in .zarray, and 3, in zarr.json, are known"
        ))),
    }
}

/// Of version 3, which allows for others than the two that are known here.
fn keys_3(encoding: &Value) -> Result<Keys, Refusal> {
    // Some write a plain name where nothing is configured.
    let name = encoding["name"].as_str().or(encoding.as_str());
    let separator = &encoding["configuration"]["separator"];
    let (prefixed, default) = match name {
        Some("default") => (true, '/'),
        Some("v2") => (false, '.'),
        None if encoding.is_null() => (true, '/'),
        _ => {
            let name = name.map_or_else(|| encoding.to_string(), |name| format!("{name:?}"));
            return Err(Refusal::Unsupported(format!(
                "its chunks are named in another way (chunk_key_encoding) than \"default\" or \"v2\", which are known: {name}"
            )));
        }
    };
    let separator = separator_of(separator, default)?;
    Ok(Keys {
        prefixed,
        separator,
    })
}

fn separator_of(value: &Value, default: char) -> Result<char, Refusal> {
    match value.as_str() {
        None if value.is_null() => Ok(default),
        Some("/") => Ok('/'),
        Some(".") => Ok('.'),
        _ => Err(Refusal::Wrong(format!("its keys are separated by {value}"))),
    }
}

/// A shard's chunks, their encoding, and where they are.
fn sharded(
    configuration: &Value,
    shard: &[u64],
    number: Number,
) -> Result<(Vec<u64>, Encoding, Sharding), Refusal> {
    let wrong = |reason: &str| Refusal::wrong(reason);
    let chunk = numbers(&configuration["chunk_shape"]);
    let chunk = chunk.ok_or_else(|| wrong("its shards' chunks have no shape"))?;
    let fits = chunk.len() == shard.len() && { shard.iter().zip(&chunk) }
        .all(|(shard, chunk)| *chunk > 0 && shard % chunk == 0);
    if !fits {
        return Err(wrong("its shards cannot be cut into its chunks"));
    }
    let codecs = configuration["codecs"].as_array();
    let codecs = codecs.ok_or_else(|| wrong("its shards' chunks have no codecs"))?;
    if codecs
        .iter()
        .any(|codec| codec["name"] == "sharding_indexed")
    {
        let nested = "the chunks of its shards are shards themselves, which is not read; shards whose chunks are plain are: write it \
                      anew with one level of shards";
        return Err(Refusal::Unsupported(nested.to_owned()));
    }
    let encoding = encoding_of(codecs, shard.len(), number)?;
    let index = configuration["index_codecs"].as_array();
    let index = index.ok_or_else(|| wrong("its shards' indices have no codecs"))?;
    let index = encoding_of(index, shard.len() + 1, Number::U64)?;
    let checked = match &index.codecs[..] {
        [] => false,
        [Codec::Crc32c] => true,
        _ => {
            let reason = "its shards' indices are compressed, so that nobody knows their length";
            return Err(Refusal::Unsupported(reason.to_owned()));
        }
    };
    if !index.order.is_sorted() {
        return Err(Refusal::Unsupported(
            "its shards' indices are transposed".to_owned(),
        ));
    }
    let index_at_start = match configuration["index_location"].as_str() {
        Some("start") => true,
        Some("end") | None => false,
        Some(other) => {
            return Err(Refusal::Wrong(format!(
                "its shards' indices are at the {other:?}"
            )));
        }
    };
    let sharding = Sharding {
        chunks: shard
            .iter()
            .zip(&chunk)
            .map(|(shard, chunk)| shard / chunk)
            .collect(),
        index_at_start,
        index_big_endian: index.big_endian,
        index_checked: checked,
    };
    Ok((chunk, encoding, sharding))
}

/// `transpose`s, `bytes`, and codecs of bytes.
fn encoding_of(codecs: &[Value], rank: usize, number: Number) -> Result<Encoding, Refusal> {
    let mut encoding = Encoding {
        order: (0..rank).collect(),
        big_endian: false,
        codecs: Vec::new(),
    };
    let mut as_bytes = false;
    for codec in codecs {
        // Some write a plain name where nothing is configured.
        let name = codec["name"]
            .as_str()
            .or(codec.as_str())
            .unwrap_or_default();
        let configuration = &codec["configuration"];
        match (name, as_bytes) {
            ("transpose", false) => {
                let axes = 0..rank as u64;
                let order = match &configuration["order"] {
                    // Drafts of version 3 had names for two of them.
                    Value::String(name) if name == "C" => axes.collect(),
                    Value::String(name) if name == "F" => axes.rev().collect(),
                    order => numbers(order).unwrap_or_default(),
                };
                let mut seen = vec![false; rank];
                for axis in &order {
                    if let Some(seen) = usize::try_from(*axis)
                        .ok()
                        .and_then(|axis| seen.get_mut(axis))
                    {
                        *seen = true;
                    }
                }
                if order.len() != rank || seen.contains(&false) {
                    return Err(Refusal::wrong("its transposition is no order of its axes"));
                }
                let axis = |axis: &u64| usize::try_from(*axis).map(|axis| encoding.order[axis]);
                let order: Result<Vec<usize>, _> = order.iter().map(axis).collect();
                encoding.order = order.map_err(Refusal::wrong)?;
            }
            ("bytes", false) => {
                as_bytes = true;
                encoding.big_endian = match configuration["endian"].as_str() {
                    Some("little") => false,
                    Some("big") => true,
                    None if number.bytes() == 1 => false,
                    _ => {
                        return Err(Refusal::wrong(
                            "it does not say the order of its bytes (endian)",
                        ));
                    }
                };
            }
            ("transpose" | "bytes", true) => {
                return Err(Refusal::Wrong(format!(
                    "its codec {name:?} takes numbers, and comes where there are bytes: after \"bytes\""
                )));
            }
            (name, true) => encoding.codecs.push(codec_named(name)?),
            (name, false) => {
                codec_named(name)?;
                return Err(Refusal::Wrong(format!(
                    "its codec {name:?} takes bytes, and none before it makes bytes of numbers (\"bytes\")"
                )));
            }
        }
    }
    if as_bytes {
        Ok(encoding)
    } else {
        Err(Refusal::wrong(
            "none of its codecs makes bytes of numbers (\"bytes\")",
        ))
    }
}

fn codec_named(name: &str) -> Result<Codec, Refusal> {
    Ok(match name {
        "gzip" => Codec::Gzip,
        "zlib" | "numcodecs.zlib" => Codec::Zlib,
        "zstd" | "numcodecs.zstd" => Codec::Zstd,
        "blosc" | "numcodecs.blosc" => Codec::Blosc,
        "lz4" | "numcodecs.lz4" => Codec::Lz4,
        "crc32c" => Codec::Crc32c,
        _ => return Err(unknown_codec(name)),
    })
}

fn unknown_codec(name: &str) -> Refusal {
    if name == "sharding_indexed" {
        let around = "its sharding is combined with other codecs around it, which is not read; write it anew with sharding as \
                      its only codec";
        return Refusal::Unsupported(around.to_owned());
    }
    Refusal::Unsupported(format!(
        "it is encoded by {name:?}; blosc, zstd, gzip, zlib, lz4 and crc32c are known, and shards whose chunks are"
    ))
}

/// Version 2's names: `<u2`.
fn dtype_2(name: Option<&str>) -> Option<(Number, bool)> {
    let name = name?;
    let (order, kind) = name.split_at_checked(1)?;
    let number = match kind {
        "u1" => Number::U8,
        "i1" => Number::I8,
        "u2" => Number::U16,
        "i2" => Number::I16,
        "u4" => Number::U32,
        "i4" => Number::I32,
        "u8" => Number::U64,
        "i8" => Number::I64,
        "f4" => Number::F32,
        "f8" => Number::F64,
        _ => return None,
    };
    match order {
        "<" => Some((number, false)),
        ">" => Some((number, true)),
        "|" if number.bytes() == 1 => Some((number, false)),
        _ => None,
    }
}

/// The bytes, highest first, of a floating-point number whose bits are told: `0x7fc00000`.
fn bits_of(text: &str, number: Number) -> Option<Vec<u8>> {
    let digits = text.strip_prefix("0x")?;
    let is_float = matches!(number, Number::F32 | Number::F64);
    let fits = digits.len() == 2 * number.bytes() && digits.bytes().all(|b| b.is_ascii_hexdigit());
    let byte = |at: usize| u8::from_str_radix(digits.get(2 * at..2 * at + 2)?, 16).ok();
    (is_float && fits).then(|| (0..number.bytes()).map(byte).collect())?
}

/// The number of what is not stored, as it would be; 0 where nothing is said.
fn fill_3(value: &Value, number: Number, big_endian: bool) -> Result<Vec<u8>, Refusal> {
    let unknown = || Refusal::Wrong(format!("its fill value {value} is no {number}"));
    if let Some(mut bytes) = value.as_str().and_then(|text| bits_of(text, number)) {
        if !big_endian {
            bytes.reverse();
        }
        return Ok(bytes);
    }
    let float = match value.as_str() {
        Some("NaN") => Some(f64::NAN),
        Some("Infinity") => Some(f64::INFINITY),
        Some("-Infinity") => Some(f64::NEG_INFINITY),
        Some(_) => return Err(unknown()),
        None => value.as_f64(),
    };
    let float = float
        .or_else(|| value.is_null().then_some(0.0))
        .ok_or_else(unknown)?;
    // Version 2 writers say 0.0 for whole numbers as well.
    let whole = value
        .as_i64()
        .map(i128::from)
        .or_else(|| value.as_u64().map(i128::from));
    #[expect(
        clippy::cast_possible_truncation,
        reason = "only whole numbers within 2^63, which are kept"
    )]
    let whole = whole
        .or_else(|| (float.fract() == 0.0 && float.abs() < 9e18).then(|| i128::from(float as i64)));
    let whole = || whole.ok_or_else(unknown);
    macro_rules! stored {
        ($type:ty) => {
            <$type>::try_from(whole()?)
                .map_err(|_| unknown())?
                .to_le_bytes()
                .to_vec()
        };
    }
    #[expect(clippy::cast_possible_truncation, reason = "to the type's precision")]
    let mut bytes = match number {
        Number::U8 => stored!(u8),
        Number::I8 => stored!(i8),
        Number::U16 => stored!(u16),
        Number::I16 => stored!(i16),
        Number::U32 => stored!(u32),
        Number::I32 => stored!(i32),
        Number::U64 => stored!(u64),
        Number::I64 => stored!(i64),
        Number::F32 => (float as f32).to_le_bytes().to_vec(),
        Number::F64 => float.to_le_bytes().to_vec(),
    };
    if big_endian {
        bytes.reverse();
    }
    Ok(bytes)
}
