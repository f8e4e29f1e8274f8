//! The JSON API: what its answers are, and the document that describes them.
//!
//! The document is made from the types that are sent and from the handlers that send them.

use glam::DVec3;
use saccade_core::levels::Level;
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_source::{Change, ChangeReason};
use serde::Serialize;
use utoipa::{OpenApi, ToSchema};

/// The volumes on offer.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct VolumeList {
    /// In order of their names.
    pub(crate) volumes: Vec<VolumeEntry>,
    /// Those that should be there and cannot be opened now. The server tries again.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) failing: Vec<FailingVolume>,
}

/// A volume that cannot be opened now.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct FailingVolume {
    pub(crate) name: String,
    /// What is wrong, in words for people.
    pub(crate) cause: String,
}

/// One volume on offer.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct VolumeEntry {
    /// As it stands in addresses, where it is percent-encoded.
    pub(crate) name: String,
    /// Grows with every change.
    pub(crate) revision: u64,
}

/// What has changed since a revision.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct ChangeList {
    /// A revision of the volume up to which all changes are listed.
    pub(crate) revision: u64,
    /// In order of their revisions, each later than the one that was asked for; several may be one whose box holds theirs. Null
    /// where nobody knows any more what has changed: then anything may have.
    pub(crate) changes: Option<Vec<ChangeDocument>>,
}

/// Bounds of chunks' values.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct RangeList {
    /// Least and greatest measured value of each chunk, in the order asked for; null where nothing was
    /// acquired. They hold, and may be wider than they need be.
    pub(crate) ranges: Vec<Option<[u16; 2]>>,
}

/// What a volume is, and which state of it is offered now.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct VolumeDescription {
    pub(crate) volume: VolumeDocument,
    /// Grows with every change.
    pub(crate) revision: u64,
    /// Names the state in addresses, `/v/NAME/at/VERSION/…`, for clients that never ask again.
    pub(crate) version: String,
    /// What a user should know of how it is shown, in sentences: how values were mapped, for one.
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    pub(crate) notes: Vec<String>,
}

/// What a volume is.
#[derive(Debug, PartialEq, Serialize, ToSchema)]
#[schema(as = Volume)]
pub(crate) struct VolumeDocument {
    name: String,
    dtype: DtypeDocument,
    /// What values are; where it is missing, shades.
    #[serde(skip_serializing_if = "Option::is_none")]
    kind: Option<KindDocument>,
    /// Names of the channels.
    channels: Vec<String>,
    /// Voxel size of level 0, x, y, z, in nanometres.
    voxel_nm: [f64; 3],
    /// How far the whole volume is moved in the space of whoever wrote it, x, y, z, in nanometres; where it is
    /// missing, not at all.
    #[serde(skip_serializing_if = "Option::is_none")]
    origin_nm: Option<[f64; 3]>,
    /// How much further each level lies than that, as whoever wrote it says: by a part of its voxels, x, y, z, in nanometres;
    /// where it is missing, not at all.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    shifts_nm: Vec<[f64; 3]>,
    /// Finest first.
    levels: Vec<LevelDocument>,
    /// Chunk size of every level, x, y, z, in its voxels.
    chunk: [u32; 3],
}

/// How a voxel's value is stored: unsigned, little-endian.
#[derive(Debug, PartialEq, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = Dtype)]
enum DtypeDocument {
    Uint8,
    Uint16,
}

/// What values are, if not shades: numbers of objects, which are never mixed.
#[derive(Debug, PartialEq, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = Kind)]
enum KindDocument {
    Labels,
}

/// One resolution of a volume.
#[derive(Debug, PartialEq, Serialize, ToSchema)]
#[schema(as = Level)]
struct LevelDocument {
    /// Size, x, y, z, in its voxels.
    extent: [u32; 3],
    /// Level-0 voxels per voxel, x, y, z.
    downsampling: [f64; 3],
}

impl From<&Volume> for VolumeDocument {
    fn from(volume: &Volume) -> Self {
        let level = |level: &Level| LevelDocument {
            extent: level.extent.to_array(),
            downsampling: level.downsampling.to_array(),
        };
        Self {
            name: volume.name.clone(),
            dtype: match volume.dtype {
                Dtype::Uint16 => DtypeDocument::Uint16,
                _ => DtypeDocument::Uint8,
            },
            kind: volume.kind.is_labels().then_some(KindDocument::Labels),
            channels: volume.channels.clone(),
            voxel_nm: volume.voxel_nm.to_array(),
            origin_nm: (volume.origin_nm != DVec3::ZERO).then(|| volume.origin_nm.to_array()),
            shifts_nm: volume.shifts_nm.iter().map(DVec3::to_array).collect(),
            levels: volume.levels.iter().map(level).collect(),
            chunk: volume.chunk.to_array(),
        }
    }
}

/// Voxels that are no longer what they were.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Change)]
pub(crate) struct ChangeDocument {
    /// The volume's revision after it.
    revision: u64,
    voxels: BoxDocument,
    reason: ReasonDocument,
}

/// The level-0 voxels `min <= v < max`, x, y, z.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = VoxelBox)]
struct BoxDocument {
    min: [u32; 3],
    max: [u32; 3],
}

/// Why voxels changed: a tile came, moved or was deleted, or events were missed and anything may have changed.
#[derive(Debug, Serialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
#[schema(as = ChangeReason)]
enum ReasonDocument {
    Tile,
    Transform,
    Deleted,
    Missed,
}

impl From<Change> for ChangeDocument {
    fn from(change: Change) -> Self {
        let VoxelBox { min, max } = change.voxels;
        Self {
            revision: change.revision,
            voxels: BoxDocument {
                min: min.to_array(),
                max: max.to_array(),
            },
            reason: match change.reason {
                ChangeReason::Tile => ReasonDocument::Tile,
                ChangeReason::Transform => ReasonDocument::Transform,
                ChangeReason::Deleted => ReasonDocument::Deleted,
                // Whatever else there will be: the whole box is to be read again.
                _ => ReasonDocument::Missed,
            },
        }
    }
}

/// The document at `/openapi.json`.
#[derive(OpenApi)]
#[openapi(
    info(
        title = "Saccade",
        description = "Volumes that grow while they are looked at. Voxels are served as OME-Zarr 0.5 \
            (`/v/NAME/zarr/`), OME-Zarr 0.4 (`/v/NAME/zarr2/`) and Neuroglancer precomputed \
            (`/v/NAME/precomputed/`), which their own specifications describe."
    ),
    paths(
        crate::routes::volumes,
        crate::routes::volume,
        crate::routes::status,
        crate::routes::changes,
        crate::routes::changes_after,
        crate::routes::picture,
        crate::routes::ranges,
    ),
    components(schemas(ChangeDocument))
)]
pub(crate) struct Document;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;
    use saccade_core::volume::VoxelKind;
    use serde_json::to_value;

    /// Saccade's own client reads the types of the core.
    #[test]
    fn documents_are_the_core_s_types() {
        let mut volume =
            Volume::new("v", UVec3::new(100, 90, 8), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        for (dtype, kind) in [
            (Dtype::Uint8, VoxelKind::Intensity),
            (Dtype::Uint16, VoxelKind::Intensity),
            (Dtype::Uint16, VoxelKind::Labels),
        ] {
            (volume.dtype, volume.kind) = (dtype, kind);
            volume.origin_nm = match kind {
                VoxelKind::Intensity => DVec3::ZERO,
                VoxelKind::Labels => DVec3::new(-4.0, 0.5, 1e9),
            };
            volume.shifts_nm = match kind {
                VoxelKind::Intensity => Vec::new(),
                VoxelKind::Labels => vec![DVec3::ZERO, DVec3::new(-2.0, 2.5, 0.0)],
            };
            let document = to_value(VolumeDocument::from(&volume)).unwrap();
            assert_eq!(document, to_value(&volume).unwrap());
        }
        for reason in [
            ChangeReason::Tile,
            ChangeReason::Transform,
            ChangeReason::Deleted,
            ChangeReason::Missed,
        ] {
            let change = Change {
                revision: 7,
                voxels: VoxelBox::new(UVec3::ONE, UVec3::new(2, 3, 4)),
                reason,
            };
            let document = to_value(ChangeDocument::from(change)).unwrap();
            assert_eq!(document, to_value(change).unwrap());
        }
    }
}
