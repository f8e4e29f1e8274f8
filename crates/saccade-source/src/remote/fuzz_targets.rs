//! What a Saccade server answers, or whoever answers in its place.

use std::sync::LazyLock;

use glam::UVec3;
use reqwest::Client;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::since::ChangesJson;
use super::{
    LARGEST_CHUNK, RefusalJson, Status, VolumeJson, VolumesJson, address, check_described, chunks,
    events,
};
use crate::fuzz_targets::pieces::pieces;
use crate::objects::client;
use crate::{Change, ChangeReason, ChunkId};

pub(crate) use super::ranges::fuzz as ranges;

/// `events`, in pieces that the first byte chooses.
pub(crate) fn server_events(bytes: &[u8]) {
    static CLIENT: LazyLock<Client> = LazyLock::new(client);
    if let Some((&choice, bytes)) = bytes.split_first() {
        events::fuzz(bytes, &pieces(choice, bytes), &CLIENT);
    }
}

/// `volume.json`: what is accepted is a volume whose chunks can be asked for, all of which lie in it.
pub(crate) fn volume(bytes: &[u8]) {
    let Ok(described) = serde_json::from_slice::<VolumeJson>(bytes) else {
        return;
    };
    let volume = described.volume;
    if check_described(&volume).is_err() {
        return;
    }
    let chunk = volume.chunk.as_u64vec3().element_product() * volume.dtype.bytes() as u64;
    assert!((1..=LARGEST_CHUNK).contains(&chunk));
    let whole = VoxelBox::of_size(volume.extent());
    for (n, level) in volume.levels.iter().enumerate() {
        let count = volume.chunks(n);
        assert!(count.min_element() > 0);
        for chunk in [UVec3::ZERO, count / 2, count - 1] {
            let id = ChunkId {
                channel: 0,
                level: u32::try_from(n).expect("a few"),
                chunk,
            };
            let voxels = id.voxels(&volume).expect("it is in the level");
            assert!(!voxels.is_empty() && voxels.max.cmple(level.extent).all());
            let of_finest = level.voxels_from_box(voxels.grown(1));
            assert!(of_finest.intersects(whole), "{id} lies outside");
        }
        let beyond = ChunkId {
            channel: 0,
            level: u32::try_from(n).expect("a few"),
            chunk: count,
        };
        assert_eq!(beyond.voxels(&volume), None);
    }
    let text = serde_json::to_vec(&volume).expect("a volume becomes JSON");
    let again: Volume = serde_json::from_slice(&text).expect("what was written is read");
    assert_eq!((&again.levels, again.chunk), (&volume.levels, volume.chunk));
    assert!(check_described(&again).is_ok());
}

/// `volumes.json`, `status.json`, what a refusal says, and what has changed since a revision.
pub(crate) fn answer(bytes: &[u8]) {
    if let Ok(list) = serde_json::from_slice::<VolumesJson>(bytes) {
        for volume in list.volumes.iter().take(8) {
            let url = address("http://host/sub?query#part", &["v", &volume.name]);
            let url = url.expect("an address");
            // Whatever a name is, it is one part of the address.
            let parts: Vec<_> = url.path_segments().expect("it has parts").collect();
            assert!(parts[..2] == ["sub", "v"] && parts.len() <= 3, "{url}");
            assert_eq!(
                (url.host_str(), url.query(), url.fragment()),
                (Some("host"), None, None)
            );
        }
    }
    if let Ok(status) = serde_json::from_slice::<Status>(bytes) {
        // Each takes its names and more of the text.
        assert!(status.quarantined.len() + status.damaged_tiles.len() <= bytes.len() / 8);
    }
    let reason = serde_json::from_slice::<RefusalJson>(bytes).unwrap_or_default();
    assert!(
        reason
            .reason()
            .is_none_or(|reason| reason.len() <= bytes.len())
    );
    let Ok(ChangesJson {
        changes: Some(changes),
    }) = serde_json::from_slice(bytes)
    else {
        return;
    };
    let revisions = chunks::Revisions::new(0);
    for change in changes {
        revisions.record(change);
        let seen = revisions.of(change.voxels);
        let is_told = change.voxels.is_empty() && change.reason != ChangeReason::Missed;
        assert!(is_told || seen >= change.revision);
        let text = serde_json::to_vec(&change).expect("a change becomes JSON");
        assert_eq!(
            serde_json::from_slice::<Change>(&text).expect("it was written"),
            change
        );
    }
}
