//! The client that Saccade itself uses.

use futures::FutureExt;
use glam::UVec3;
use saccade_core::voxel_box::VoxelBox;
use saccade_serve::Options;
use saccade_source::conformance::{check_changes, check_reading};
use saccade_source::remote::RemoteSource;
use saccade_source::{ChunkId, SourceError, VolumeSource};

use super::{CHUNK, Served, run, serve};

/// A chunk as the array has it, by way of no server.
fn truth(served: &Served, id: ChunkId) -> Vec<u8> {
    let read = served.source.read(id).now_or_never().unwrap().unwrap();
    match read {
        saccade_source::Chunk::Voxels(voxels) => voxels.to_vec(),
        saccade_source::Chunk::Empty => vec![0; CHUNK.element_product() as usize],
    }
}

#[test]
fn a_remote_source_reads_what_is_served() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let remote = RemoteSource::open(&served.url, "em").await.unwrap();
        check_reading(&remote, |id| truth(&served, id), 0)
            .await
            .unwrap();
        let wrong = check_reading(
            &remote,
            |id| truth(&served, id).iter().map(|v| !v).collect(),
            0,
        );
        wrong.await.unwrap_err();
    });
}

#[test]
fn a_remote_source_follows() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let remote = RemoteSource::open(&served.url, "em").await.unwrap();
        let mut x = 0_u8;
        let change = async || {
            x += 13;
            let voxels = VoxelBox::new(
                UVec3::new(x.into(), 3, 2),
                UVec3::new(u32::from(x) + 5, 40, 19),
            );
            let values: Vec<u8> = voxels.iter().map(|_| x).collect();
            served.source.set(voxels, &values).unwrap();
            voxels
        };
        check_changes(&remote, 4, change, |id| truth(&served, id), 0)
            .await
            .unwrap();
    });
}

#[test]
fn a_volume_that_is_not_served_is_named() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let error = RemoteSource::open(&served.url, "nothing")
            .await
            .err()
            .unwrap();
        assert!(matches!(error, SourceError::NoVolume { known, .. } if known == ["em"]));
    });
}
