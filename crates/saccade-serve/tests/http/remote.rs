//! The client that Saccade itself uses.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use futures::FutureExt;
use glam::{DVec3, UVec3};
use saccade_archive::storage::{FaultyStorage, MemoryStorage, Storage, WriteFault};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_serve::Options;
use saccade_source::conformance::{check_changes, check_changes_after, check_reading};
use saccade_source::export::{ExportOptions, export};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::remote::{RENAMED_LABEL, RemoteSource};
use saccade_source::{Change, Chunk, ChunkError, ChunkId, SourceError, VolumeSource};

use super::{CHUNK, Served, level0, run, serve, serve_source, volume};

/// A chunk as the array has it, by way of no server.
fn truth(served: &Served, id: ChunkId) -> Vec<u8> {
    let read = served.source.read(id).now_or_never().unwrap().unwrap();
    match read {
        Chunk::Voxels(voxels) => voxels.to_vec(),
        Chunk::Empty => vec![0; CHUNK.element_product() as usize],
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

/// What a source knows of its past goes through a server, and what it does not know is not made up.
#[test]
fn a_remote_source_tells_what_has_changed() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let remote = RemoteSource::open(&served.url, "em").await.unwrap();
        let mut x = 0;
        let change = async || {
            x += 9;
            let voxels = VoxelBox::new(UVec3::new(x, 3, 2), UVec3::new(x + 5, 40, 19));
            let values: Vec<u8> = voxels.iter().map(|_| 77).collect();
            served.source.set(voxels, &values).unwrap();
            voxels
        };
        check_changes_after(&remote, change).await.unwrap();
        // One that comes back later, with a revision that it once saw.
        drop(remote);
        let remote = RemoteSource::open(&served.url, "em").await.unwrap();
        let told = remote.changes_after(2).await.unwrap();
        let revisions: Vec<u64> = told.iter().map(|change| change.revision).collect();
        assert_eq!(revisions, [3, 4]);

        let forgetful = Arc::new(Wide {
            labels: ArraySource::new(volume(), level0()).unwrap(),
            notes: Vec::new(),
            id: 70_000,
            there: UVec3::ZERO,
            met: AtomicBool::new(false),
        });
        let (url, _stop, _) = serve_source(forgetful, Options::DEFAULT).await;
        let remote = RemoteSource::open(&url, "em").await.unwrap();
        assert_eq!(remote.changes_after(0).await, None);
    });
}

/// One that was interrupted, of a volume that grew meanwhile, keeps what has not changed.
#[test]
fn an_export_through_a_server_goes_on() {
    run(async {
        let extent = UVec3::new(300, 140, 20);
        let mut grown = Volume::new("em", extent, DVec3::splat(8.0)).unwrap();
        grown.chunk = UVec3::splat(16);
        let voxels = vec![7; extent.element_product() as usize];
        let source = Arc::new(ArraySource::new(grown, voxels).unwrap());
        let (url, _stop, _) = serve_source(source.clone(), Options::DEFAULT).await;
        let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
        let exported = async || {
            let remote: Arc<dyn VolumeSource> =
                Arc::new(RemoteSource::open(&url, "em").await.unwrap());
            export(&remote, &storage, &ExportOptions::default(), &|_| {}).await
        };
        storage.fail_write(9, WriteFault::CrashBefore);
        exported().await.unwrap_err();
        storage.restart();
        let before = storage.list("").await.unwrap();
        let there = before.iter().filter(|name| name.contains("/c/")).count() as u64;
        let corner = VoxelBox::new(UVec3::new(290, 3, 3), UVec3::new(291, 4, 4));
        source.set(corner, &[200]).unwrap();
        let client = reqwest::Client::new();
        while {
            client
                .get(format!("{url}v/em/volume.json"))
                .send()
                .await
                .unwrap()
        }
        .json::<serde_json::Value>()
        .await
        .unwrap()["revision"]
            != 1
        {
            tokio::time::sleep(std::time::Duration::from_millis(2)).await;
        }
        let done = exported().await.unwrap();
        assert!(
            done.kept > 0 && done.kept < there,
            "{done:?}, {there} were there"
        );
        assert_eq!(done.done, done.shards);
        assert!(exported().await.unwrap().was_whole);
    });
}

/// Labels of which one has no room in the volume.
struct Wide {
    labels: ArraySource,
    notes: Vec<String>,
    /// Its id.
    id: i128,
    /// The chunk that has it.
    there: UVec3,
    met: AtomicBool,
}

impl VolumeSource for Wide {
    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn volume(&self) -> &Arc<Volume> {
        self.labels.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        if id.chunk == self.there {
            self.met.store(true, Ordering::SeqCst);
        }
        self.labels.read(id)
    }

    fn renamed_label(&self) -> Option<i128> {
        self.met.load(Ordering::SeqCst).then_some(self.id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.labels.changes()
    }
}

#[test]
fn ids_that_a_server_renames_are_known_where_they_are_read() {
    id_that_a_server_renames(70_000);
    id_that_a_server_renames(-3);
    id_that_a_server_renames(u64::MAX.into());
}

fn id_that_a_server_renames(renamed: i128) {
    run(async {
        let there = UVec3::new(1, 1, 1);
        let source = Arc::new(Wide {
            labels: ArraySource::new(volume(), level0()).unwrap(),
            notes: vec!["ids were mapped".to_owned()],
            id: renamed,
            there,
            met: AtomicBool::new(false),
        });
        let (url, _stop, _) = serve_source(source, Options::DEFAULT).await;
        let remote = RemoteSource::open(&url, "em").await.unwrap();
        let id = |chunk| ChunkId {
            channel: 0,
            level: 0,
            chunk,
        };
        remote.read(id(UVec3::new(0, 1, 1))).await.unwrap();
        assert_eq!(remote.renamed_label(), None, "none was met yet");
        assert_eq!(remote.notes(), ["ids were mapped"]);
        remote.read(id(there)).await.unwrap();
        assert_eq!(remote.renamed_label(), Some(renamed));
        // What was kept elsewhere says it as well, also where nothing is read again.
        let path = format!("{url}v/em/zarr/0/c/0/1/1/1");
        let client = reqwest::Client::new();
        let first = client.get(&path).send().await.unwrap();
        let held = client
            .get(&path)
            .header("if-none-match", &first.headers()["etag"]);
        let held = held.send().await.unwrap();
        assert_eq!(held.status(), reqwest::StatusCode::NOT_MODIFIED);
        for answer in [first, held] {
            assert_eq!(answer.headers()[RENAMED_LABEL], *renamed.to_string());
        }
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
