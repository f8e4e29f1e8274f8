//! Which arrays and shards an export has, and what describes them.

use std::sync::Arc;

use glam::UVec3;
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use serde_json::{Value, json};

use super::{ExportError, ExportOptions};
use crate::ome::{self, Placed};

/// Most chunks along an axis of a shard.
const MOST_CHUNKS: u32 = 8;
/// Most voxels' worth of a shard \[bytes\].
const MOST_BYTES: u64 = 64 << 20;

/// One shard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ShardId {
    /// Level of the image.
    pub(super) level: usize,
    /// Channel of the image.
    pub(super) channel: u32,
    /// Position \[shards\], slowest axis first.
    pub(super) zyx: [u32; 3],
}

impl ShardId {
    /// Name of its object.
    pub(super) fn key(self) -> String {
        let [z, y, x] = self.zyx;
        format!("{}/c/{}/{z}/{y}/{x}", self.level, self.channel)
    }

    pub(super) fn xyz(self) -> UVec3 {
        let [z, y, x] = self.zyx;
        UVec3::new(x, y, z)
    }
}

/// One level of the image.
#[derive(Clone, Debug)]
pub(super) struct PlannedLevel {
    /// The volume's.
    pub(super) level: u32,
    /// What of it is exported \[voxels of the level\].
    pub(super) voxels: VoxelBox,
    /// Size of a shard \[voxels\], whole chunks.
    pub(super) shard: UVec3,
}

impl PlannedLevel {
    /// Shards along each axis.
    fn shards(&self) -> UVec3 {
        let size = self.voxels.size();
        UVec3::from_array(std::array::from_fn(|axis| {
            size[axis].div_ceil(self.shard[axis])
        }))
    }

    /// What a shard holds of the volume \[voxels of the level\].
    pub(super) fn voxels_of(&self, shard: UVec3) -> VoxelBox {
        let min = self.voxels.min + shard * self.shard;
        VoxelBox::new(min, min.saturating_add(self.shard)).intersection(self.voxels)
    }
}

/// All that an export is.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) volume: Arc<Volume>,
    pub(super) channels: Vec<u32>,
    pub(super) levels: Vec<PlannedLevel>,
    compression: u8,
    /// Whether ids of labels may become other numbers.
    pub(super) rename_labels: bool,
}

impl Plan {
    pub(super) fn new(volume: &Arc<Volume>, options: &ExportOptions) -> Result<Self, ExportError> {
        let extent = volume.extent();
        let whole = VoxelBox::of_size(extent);
        let region = options.region.unwrap_or(whole);
        let part = region.intersection(whole);
        if part.is_empty() {
            return Err(ExportError::Region { region, extent });
        }
        let count = u32::try_from(volume.channels.len()).unwrap_or(u32::MAX);
        let channels = { options.channels.clone() }.unwrap_or_else(|| (0..count).collect());
        for (n, &channel) in channels.iter().enumerate() {
            if channel >= count || channels[..n].contains(&channel) {
                let known = volume.channels.clone();
                return Err(ExportError::Channel { channel, known });
            }
        }
        let last = u32::try_from(volume.levels.len() - 1).unwrap_or(u32::MAX);
        if options.finest > last {
            let level = options.finest;
            return Err(ExportError::Level { level, last });
        }
        let mut levels = Vec::new();
        for level in options.finest..=last {
            let voxels = volume.levels[level as usize].box_from_voxels(part);
            levels.push(PlannedLevel {
                level,
                voxels,
                shard: shard_size(voxels.size(), volume.chunk, volume.dtype),
            });
            if voxels.size().cmple(volume.chunk).all() {
                break;
            }
        }
        Ok(Self {
            volume: volume.clone(),
            channels,
            levels,
            compression: options.compression.min(22),
            rename_labels: options.rename_labels,
        })
    }

    /// Every shard, the coarsest levels first: what is wrong shows soon.
    pub(super) fn shards(&self) -> impl Iterator<Item = ShardId> {
        let levels = self.levels.iter().enumerate().rev();
        levels.flat_map(move |(level, planned)| {
            let channels = 0..u32::try_from(self.channels.len()).unwrap_or(u32::MAX);
            channels.flat_map(move |channel| {
                let shards = VoxelBox::of_size(planned.shards());
                shards.iter().map(move |UVec3 { x, y, z }| ShardId {
                    level,
                    channel,
                    zyx: [z, y, x],
                })
            })
        })
    }

    /// Shards in which voxels of a box are, in any channel \[voxels of level 0\]. Takes as long as they are many,
    /// whatever the export's size.
    pub(super) fn touched(&self, voxels: VoxelBox) -> impl Iterator<Item = ShardId> {
        let levels = self.levels.iter().enumerate().rev();
        levels.flat_map(move |(level, planned)| {
            let of_level = self.volume.levels[planned.level as usize].box_from_voxels(voxels);
            let part = of_level.intersection(planned.voxels);
            // Shards are counted from the corner of what is exported.
            let part = match part.is_empty() {
                true => VoxelBox::EMPTY,
                false => {
                    VoxelBox::new(part.min - planned.voxels.min, part.max - planned.voxels.min)
                }
            };
            let channels = 0..u32::try_from(self.channels.len()).unwrap_or(u32::MAX);
            channels.flat_map(move |channel| {
                let shards = part.cells(planned.shard);
                shards.map(move |UVec3 { x, y, z }| ShardId {
                    level,
                    channel,
                    zyx: [z, y, x],
                })
            })
        })
    }

    /// What tells this export from others of the same place.
    pub(super) fn description(&self) -> Value {
        let extents = self
            .volume
            .levels
            .iter()
            .map(|level| level.extent.to_array());
        let mut description = json!({
            "volume": self.volume.name,
            "extents": extents.collect::<Vec<_>>(),
            "channels": self.channels,
            "finest": self.levels[0].level,
            "min": self.levels[0].voxels.min.to_array(),
            "max": self.levels[0].voxels.max.to_array(),
            "arrays": (0..self.levels.len()).map(|level| self.array(level)).collect::<Vec<_>>(),
        });
        if self.volume.kind.is_labels() {
            description["labels"] = true.into();
        }
        if self.rename_labels {
            description["renamed"] = true.into();
        }
        description
    }

    /// The image's description: `zarr.json` of the group.
    pub(super) fn group(&self) -> Value {
        let placed = ome::placed(&self.volume);
        let levels = self.levels.iter().map(|planned| {
            let Placed { voxel_nm, first_nm } = placed[planned.level as usize];
            Placed {
                voxel_nm,
                first_nm: first_nm + planned.voxels.min.as_dvec3() * voxel_nm,
            }
        });
        let levels: Vec<_> = levels.collect();
        let section = self.levels[0].voxels.size().z / 2;
        let mut image = ome::image(&self.volume, &self.channels, &levels, section);
        image["version"] = "0.5".into();
        json!({
            "zarr_format": 3,
            "node_type": "group",
            "attributes": { "ome": image },
        })
    }

    /// A level's description: `zarr.json` of an array.
    pub(super) fn array(&self, level: usize) -> Value {
        let planned = &self.levels[level];
        let czyx = |c: usize, UVec3 { x, y, z }| json!([c, z, y, x]);
        let data_type = match self.volume.dtype {
            Dtype::Uint16 => "uint16",
            _ => "uint8",
        };
        let bytes = json!({ "name": "bytes", "configuration": { "endian": "little" } });
        let mut codecs = vec![bytes.clone()];
        if self.compression > 0 {
            let zstd = json!({ "level": self.compression, "checksum": true });
            codecs.push(json!({ "name": "zstd", "configuration": zstd }));
        }
        json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": czyx(self.channels.len(), planned.voxels.size()),
            "data_type": data_type,
            "fill_value": 0,
            "chunk_grid": {
                "name": "regular",
                "configuration": { "chunk_shape": czyx(1, planned.shard) },
            },
            "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
            "codecs": [{
                "name": "sharding_indexed",
                "configuration": {
                    "chunk_shape": czyx(1, self.volume.chunk),
                    "codecs": codecs,
                    "index_codecs": [bytes, { "name": "crc32c" }],
                    "index_location": "end",
                },
            }],
            "dimension_names": ome::AXES,
            "attributes": {},
        })
    }
}

/// Whether what was begun there, or is there, may be what is begun now, both as [`Plan::description`] has them: the same, or the same
/// without other numbers for ids of labels, so that its shards have only ids that fit.
pub(super) fn goes_on(there: &Value, now: &Value) -> bool {
    let mut strict = now.clone();
    if let Some(strict) = strict.as_object_mut() {
        strict.remove("renamed");
    }
    there == now || *there == strict
}

/// What is told of an export.
type Fact<'a> = dyn Fn(&Value) -> String + 'a;

/// What differs between two exports, as [`Plan::description`] has them, in a line.
pub(super) fn differences(there: &Value, now: &Value) -> String {
    let list = |value: &Value| match value {
        Value::Array(items) => {
            let items: Vec<_> = items.iter().map(ToString::to_string).collect();
            items.join(",")
        }
        Value::Null => "unknown".to_owned(),
        value => value.to_string(),
    };
    let region = |of: &Value| format!("{},{}", list(&of["min"]), list(&of["max"]));
    let level = |of: &Value| of["extents"][0].clone();
    let stored = |of: &Value| of["arrays"][0]["codecs"][0]["configuration"]["codecs"].clone();
    let compression = |of: &Value| match &stored(of)[1]["configuration"]["level"] {
        Value::Null => "none".to_owned(),
        level => level.to_string(),
    };
    let facts: [(&str, &Fact<'_>); 7] = [
        ("volume", &|of| list(&of["volume"])),
        ("the volume's extent", &|of| list(&level(of))),
        ("finest level", &|of| list(&of["finest"])),
        ("region in voxels of that level", &region),
        ("channels", &|of| list(&of["channels"])),
        ("compression", &compression),
        ("ids of labels may be renamed:", &|of| {
            (of["renamed"] == true).to_string()
        }),
    ];
    let differing = facts.iter().filter_map(|(name, fact)| {
        let (there, now) = (fact(there), fact(now));
        (there != now).then(|| format!("{name} {there} there, {now} now"))
    });
    let differing: Vec<_> = differing.collect();
    match differing.is_empty() {
        true => "its levels or chunks are others".to_owned(),
        false => differing.join("; "),
    }
}

/// As many chunks as fit into the limits, and no more than there are.
fn shard_size(size: UVec3, chunk: UVec3, dtype: Dtype) -> UVec3 {
    let chunks: [u32; 3] = std::array::from_fn(|axis| size[axis].div_ceil(chunk[axis]));
    let mut along = UVec3::from_array(chunks).min(UVec3::splat(MOST_CHUNKS));
    let bytes = |along: UVec3| VoxelBox::of_size(along * chunk).voxels() * dtype.bytes() as u64;
    while bytes(along) > MOST_BYTES && along != UVec3::ONE {
        let longest = (0..3).max_by_key(|axis| along[*axis]).unwrap_or(0);
        along[longest] = along[longest].div_ceil(2);
    }
    along * chunk
}

/// What an export says of itself, which may be another's or none: the same goes on and differs in nothing, others are told
/// apart.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz_state(bytes: &[u8]) {
    let there: Value = serde_json::from_slice(bytes).unwrap_or_default();
    let extent = UVec3::new(100, 90, 80);
    let volume = Volume::new("v", extent, glam::DVec3::ONE).expect("a volume");
    let options = ExportOptions {
        rename_labels: true,
        ..ExportOptions::default()
    };
    let now = Plan::new(&Arc::new(volume), &options)
        .expect("a plan")
        .description();
    assert!(goes_on(&there, &there) && goes_on(&now, &now));
    let told = differences(&there, &now);
    assert!(!told.is_empty());
    if goes_on(&there, &now) {
        // But for the names of ids.
        assert!(there == now || told.contains("renamed"), "{told}");
        assert_eq!(there["arrays"], now["arrays"]);
    }
    assert_eq!(
        differences(&there, &there),
        "its levels or chunks are others"
    );
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;

    fn plan(extent: UVec3, chunk: UVec3, region: Option<VoxelBox>, finest: u32) -> Plan {
        let mut volume = Volume::new("em", extent, DVec3::new(4.0, 4.0, 16.0)).unwrap();
        volume.channels = ["a", "b"].map(Into::into).into();
        volume.chunk = chunk;
        let finest = finest.min(u32::try_from(volume.levels.len()).unwrap() - 1);
        let options = ExportOptions {
            region,
            finest,
            ..ExportOptions::default()
        };
        Plan::new(&Arc::new(volume), &options).unwrap()
    }

    fn any_box(within: u32) -> impl Strategy<Value = VoxelBox> {
        let corner = || prop::array::uniform3(0..within);
        (corner(), corner()).prop_map(|(one, other)| {
            let (one, other) = (UVec3::from(one), UVec3::from(other));
            VoxelBox::new(one.min(other), one.max(other))
        })
    }

    proptest! {
        /// Each that holds a voxel of the box, and no other.
        #[test]
        fn touched_are_those_that_hold_voxels_of_the_box(
            region in any_box(150), changed in any_box(200), chunk in 1..9_u32, finest in 0..3_u32,
        ) {
            let whole = VoxelBox::of_size(UVec3::new(140, 90, 40));
            let region = Some(region).filter(|region| region.intersects(whole));
            let plan = plan(whole.max, UVec3::new(chunk, 3, 4), region, finest);
            let holds = |shard: &ShardId| {
                let planned = &plan.levels[shard.level];
                let of_level = plan.volume.levels[planned.level as usize].box_from_voxels(changed);
                planned.voxels_of(shard.xyz()).intersects(of_level)
            };
            let want: Vec<_> = plan.shards().filter(holds).collect();
            prop_assert_eq!(plan.touched(changed).collect::<Vec<_>>(), want);
        }
    }

    /// A tile of a volume of a thousand million shards.
    #[test]
    fn few_are_found_among_many() {
        let plan = plan(UVec3::splat(1 << 20), UVec3::splat(64), None, 0);
        let corner = UVec3::new(777_777, 123_456, 654_321);
        let tile = VoxelBox::new(corner, corner + UVec3::new(4096, 4096, 1));
        let touched = plan.touched(tile).count();
        assert!((20..5000).contains(&touched), "{touched}");
    }
}
