//! What an `info` says of its volume.

use glam::{DVec3, I64Vec3, UVec3};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::error::Refusal;
use crate::stored::Placed;
use crate::values::Number;

/// Chunks that are larger than this when decoded are refused \[bytes\].
const MOST_CHUNK: u64 = 1 << 30;
/// How far off a level may be because its offset is a whole number, rounded from level to level \[voxels of the level\].
const ROUNDED: f64 = 0.999;
/// Levels that are looked at.
const MOST_SCALES: usize = 64;

/// A volume of several levels.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Info {
    pub(super) number: Number,
    pub(super) channels: u32,
    /// Whether its values name things.
    pub(super) is_segmentation: bool,
    /// Finest first.
    pub(super) scales: Vec<Scale>,
}

/// A level.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Scale {
    pub(super) key: String,
    /// \[voxels\]
    pub(super) size: UVec3,
    /// First voxel, as chunks' names count.
    pub(super) offset: [i64; 3],
    /// Where that is in the volume, which begins where its finest level does.
    pub(super) placed: Placed,
    /// \[nm\]
    pub(super) resolution: DVec3,
    pub(super) chunk: UVec3,
    pub(super) encoding: Encoding,
    pub(super) sharding: Option<Sharding>,
}

/// How a chunk's numbers become bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Encoding {
    Raw,
    Jpeg,
    Png,
    /// In blocks of so many voxels.
    CompressedSegmentation(UVec3),
}

/// How chunks lie in shards: `neuroglancer_uint64_sharded_v1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sharding {
    pub(super) preshift_bits: u32,
    pub(super) murmur: bool,
    pub(super) minishard_bits: u32,
    pub(super) shard_bits: u32,
    pub(super) index_gzip: bool,
    pub(super) data_gzip: bool,
}

impl Scale {
    /// Chunks along each axis.
    pub(super) fn grid(&self) -> UVec3 {
        (self.size + (self.chunk - 1)) / self.chunk
    }

    /// Of its first voxel, in the space of all levels.
    pub(super) fn corner_nm(&self) -> DVec3 {
        I64Vec3::from(self.offset).as_dvec3() * self.resolution
    }
}

fn wrong(reason: impl ToString) -> Refusal {
    Refusal::Wrong(reason.to_string())
}

fn unsupported(reason: impl ToString) -> Refusal {
    Refusal::Unsupported(reason.to_string())
}

fn extent(value: &Value, what: &str) -> Result<UVec3, Refusal> {
    let three = value.as_array().filter(|three| three.len() == 3);
    let three = three.ok_or_else(|| wrong(format!("its {what} is not three numbers")))?;
    let mut extent = UVec3::ZERO;
    for (to, value) in extent.as_mut().iter_mut().zip(three) {
        let number = value.as_u64().and_then(|n| u32::try_from(n).ok());
        let number = number.filter(|n| (1..1 << 31).contains(n));
        *to = number.ok_or_else(|| wrong(format!("its {what} is impossible: {value}")))?;
    }
    Ok(extent)
}

impl Info {
    /// Of JSON.
    pub(super) fn parse(json: &Value) -> Result<Self, Refusal> {
        match json["@type"].as_str() {
            None | Some("neuroglancer_multiscale_volume") => {}
            Some(other) => {
                return Err(unsupported(format!(
                    "it is a {other}, and only volumes have voxels"
                )));
            }
        }
        let number = json["data_type"].as_str().unwrap_or_default();
        let number = Number::named(number)
            .ok_or_else(|| unsupported(format!("its values are {number:?}")))?;
        let channels = json["num_channels"]
            .as_u64()
            .and_then(|n| u32::try_from(n).ok());
        let channels = channels.filter(|n| (1..=65_536).contains(n));
        let channels = channels.ok_or_else(|| wrong("its number of channels is impossible"))?;
        let scales = json["scales"]
            .as_array()
            .filter(|scales| !scales.is_empty());
        let scales = scales.ok_or_else(|| wrong("it lists no levels (scales)"))?;
        let scales = scales.iter().take(MOST_SCALES);
        let scales = scales.map(|json| Scale::parse(json, number, channels));
        let mut scales: Vec<Scale> = scales.collect::<Result<_, _>>()?;
        // Nothing says that they come in order.
        scales.sort_by(|a, b| {
            a.resolution
                .element_product()
                .total_cmp(&b.resolution.element_product())
        });
        let begin = scales[0].corner_nm();
        for scale in &mut scales {
            let corner = (scale.corner_nm() - begin) / scale.resolution;
            scale.placed = Placed::new(scale.size, corner, ROUNDED);
        }
        Ok(Self {
            number,
            channels,
            is_segmentation: json["type"].as_str() == Some("segmentation"),
            scales,
        })
    }
}

impl Scale {
    fn parse(json: &Value, number: Number, channels: u32) -> Result<Self, Refusal> {
        let key = json["key"]
            .as_str()
            .ok_or_else(|| wrong("a level (scale) has no key"))?;
        if !crate::objects::is_key(key) {
            return Err(wrong(format!(
                "the level {key:?} lies outside of the volume, or its parts are empty or dots: name it as its folder is, such as \
                 \"8_8_30\""
            )));
        }
        let size = extent(&json["size"], "size")?;
        let chunk = extent(&json["chunk_sizes"][0], "chunk size")?;
        let bytes = chunk.min(size).to_array().map(u64::from).into_iter();
        let mut bytes = bytes.chain([u64::from(channels)]);
        let bytes = bytes.try_fold(number.bytes() as u64, u64::checked_mul);
        if bytes.is_none_or(|bytes| bytes > MOST_CHUNK) {
            return Err(wrong(format!(
                "its chunks of {chunk} voxels are too large to decode"
            )));
        }
        let mut resolution = DVec3::ZERO;
        for (to, value) in resolution
            .as_mut()
            .iter_mut()
            .zip(json["resolution"].as_array().into_iter().flatten())
        {
            *to = value.as_f64().unwrap_or_default();
        }
        if !(resolution.is_finite() && resolution.min_element() > 0.0) {
            return Err(wrong("its voxels have no size (resolution)"));
        }
        let mut offset = [0; 3];
        for (to, value) in offset
            .iter_mut()
            .zip(json["voxel_offset"].as_array().into_iter().flatten())
        {
            let number = value.as_i64().filter(|n| n.unsigned_abs() < 1 << 53);
            *to =
                number.ok_or_else(|| wrong(format!("its voxel_offset is impossible: {value}")))?;
        }
        let encoding = match json["encoding"].as_str().unwrap_or_default() {
            "raw" => Encoding::Raw,
            "jpeg" if number == Number::U8 && matches!(channels, 1 | 3) => Encoding::Jpeg,
            "jpeg" => {
                return Err(wrong(
                    "it says jpeg, which has 1 or 3 channels of 8 bit only",
                ));
            }
            "png" if matches!(number, Number::U8 | Number::U16) && channels <= 4 => Encoding::Png,
            "png" => {
                return Err(wrong(
                    "it says png, which has 1 to 4 channels of 8 or 16 bit only",
                ));
            }
            "compressed_segmentation" if matches!(number, Number::U32 | Number::U64) => {
                let block = &json["compressed_segmentation_block_size"];
                let block = extent(block, "compressed_segmentation_block_size")?;
                if block.max_element() > 256 {
                    return Err(wrong(format!("its blocks of {block} voxels are too large")));
                }
                Encoding::CompressedSegmentation(block)
            }
            "compressed_segmentation" => {
                return Err(wrong(
                    "it says compressed_segmentation, which has uint32 or uint64 only",
                ));
            }
            other => {
                return Err(unsupported(format!(
                    "it is encoded as {other:?}; raw, jpeg, png and compressed_segmentation are known"
                )));
            }
        };
        let sharding = match &json["sharding"] {
            Value::Null => None,
            sharding => Some(Sharding::parse(sharding)?),
        };
        Ok(Self {
            key: key.to_owned(),
            size,
            offset,
            placed: Placed::new(size, DVec3::ZERO, 0.0),
            resolution,
            chunk,
            encoding,
            sharding,
        })
    }
}

impl Sharding {
    fn parse(json: &Value) -> Result<Self, Refusal> {
        let kind = json["@type"].as_str().unwrap_or_default();
        if kind != "neuroglancer_uint64_sharded_v1" {
            return Err(unsupported(format!("its shards are of the kind {kind:?}")));
        }
        let bits = |name: &str, most: u64| {
            let bits = json[name].as_u64().filter(|bits| *bits <= most);
            let bits = bits.and_then(|bits| u32::try_from(bits).ok());
            bits.ok_or_else(|| wrong(format!("its {name} is impossible: {}", json[name])))
        };
        let gzip = |name: &str| match json[name].as_str() {
            None | Some("raw") => Ok(false),
            Some("gzip") => Ok(true),
            Some(other) => Err(unsupported(format!("its {name} is {other:?}"))),
        };
        let sharding = Self {
            preshift_bits: bits("preshift_bits", 64)?,
            murmur: match json["hash"].as_str() {
                Some("identity") => false,
                Some("murmurhash3_x86_128") => true,
                Some(other) => {
                    return Err(unsupported(format!(
                        "its shards are hashed by {other:?}; identity and murmurhash3_x86_128 are known"
                    )));
                }
                None => return Err(wrong("it does not say how its shards are hashed (hash)")),
            },
            minishard_bits: bits("minishard_bits", 60)?,
            shard_bits: bits("shard_bits", 64)?,
            index_gzip: gzip("minishard_index_encoding")?,
            data_gzip: gzip("data_encoding")?,
        };
        if sharding.minishard_bits + sharding.shard_bits > 64 {
            return Err(wrong("its shards' numbers have more than 64 bits"));
        }
        Ok(sharding)
    }
}
