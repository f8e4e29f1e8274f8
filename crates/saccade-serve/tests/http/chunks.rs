//! Voxels, and the conditions under which they are sent.

use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::UVec3;
use reqwest::header::{ACCEPT_ENCODING, CONTENT_LENGTH, IF_MATCH, IF_NONE_MATCH, IF_RANGE, RANGE};
use reqwest::{Method, StatusCode};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_serve::{Compress, Options};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, VolumeSource};

use super::{CHUNK, EXTENT, Served, header, level0, run, serve, serve_source, value, volume};

fn key(level: usize, chunk: UVec3) -> String {
    format!("v/em/zarr/{level}/c/0/{}/{}/{}", chunk.z, chunk.y, chunk.x)
}

/// A chunk with data.
const HERE: UVec3 = UVec3::new(1, 1, 1);
/// Another one, and with data too.
const ELSEWHERE: UVec3 = UVec3::new(0, 2, 2);

async fn tag(served: &Served, path: &str) -> String {
    let response = served.get(path).await;
    assert_eq!(response.status(), StatusCode::OK, "{path}");
    header(response.headers(), "etag").unwrap().to_owned()
}

async fn touch(served: &Served, chunk: UVec3) {
    let min = chunk * CHUNK;
    let revision = served
        .source
        .set(VoxelBox::new(min, min + 1), &[77])
        .unwrap();
    served.until_revision(revision).await;
}

#[test]
fn level_0_holds_the_array() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let (mut compared, mut differing) = (0, 0);
        for chunk in VoxelBox::of_size(EXTENT.map_chunks()).iter() {
            let response = served.get(&key(0, chunk)).await;
            let data = match response.status() {
                StatusCode::OK => response.bytes().await.unwrap().to_vec(),
                StatusCode::NOT_FOUND => vec![0; (CHUNK.x * CHUNK.y * CHUNK.z) as usize],
                other => panic!("{chunk}: {other}"),
            };
            let inside = VoxelBox::of_size(CHUNK);
            assert_eq!(data.len() as u64, inside.voxels());
            for (offset, got) in inside.iter().zip(data) {
                let voxel = chunk * CHUNK + offset;
                let want = if voxel.cmplt(EXTENT).all() {
                    value(voxel)
                } else {
                    0
                };
                assert_eq!(got, want, "voxel {voxel}");
                // The comparison tells axes apart.
                let turned = UVec3::new(voxel.z, voxel.y, voxel.x);
                differing += u32::from(voxel.cmplt(EXTENT).all() && got != value(turned));
                compared += 1;
            }
        }
        assert!(compared > EXTENT.element_product() && differing > compared / 2);
    });
}

trait Chunks {
    fn map_chunks(self) -> Self;
}

impl Chunks for UVec3 {
    fn map_chunks(self) -> Self {
        (self + CHUNK - 1) / CHUNK
    }
}

#[test]
fn coarser_levels_are_the_source_s() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let volume = served.source.volume().clone();
        for level in 1..volume.levels.len() {
            for chunk in VoxelBox::of_size(volume.chunks(level)).iter() {
                let id = ChunkId {
                    channel: 0,
                    level: level.try_into().unwrap(),
                    chunk,
                };
                let response = served.get(&key(level, chunk)).await;
                match served.source.read(id).await.unwrap() {
                    Chunk::Empty => assert_eq!(response.status(), StatusCode::NOT_FOUND),
                    Chunk::Voxels(voxels) => assert_eq!(response.bytes().await.unwrap(), voxels),
                }
            }
        }
    });
}

#[test]
fn a_tag_holds_until_its_voxels_change() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let (here, elsewhere, coarse) = (key(0, HERE), key(0, ELSEWHERE), key(1, UVec3::ZERO));
        let before = tag(&served, &here).await;
        let before_elsewhere = tag(&served, &elsewhere).await;
        let before_coarse = tag(&served, &coarse).await;
        assert!(before.starts_with('"'), "{before} is not strong");
        let held = |path: &str, tag: &str| {
            served
                .request(Method::GET, path)
                .header(IF_NONE_MATCH, tag)
                .send()
        };

        let response = held(&here, &before).await.unwrap();
        assert_eq!(response.status(), StatusCode::NOT_MODIFIED);
        assert_eq!(header(response.headers(), "etag"), Some(&*before));
        assert!(response.bytes().await.unwrap().is_empty());

        touch(&served, HERE).await;
        let response = held(&here, &before).await.unwrap();
        assert_eq!(response.status(), StatusCode::OK);
        assert_ne!(header(response.headers(), "etag"), Some(&*before));
        assert_eq!(response.bytes().await.unwrap()[0], 77);
        let response = held(&coarse, &before_coarse).await.unwrap();
        assert_eq!(
            response.status(),
            StatusCode::OK,
            "the levels above changed too"
        );
        let response = held(&elsewhere, &before_elsewhere).await.unwrap();
        assert_eq!(
            response.status(),
            StatusCode::NOT_MODIFIED,
            "the rest did not"
        );

        let demanding = served
            .request(Method::GET, &here)
            .header(IF_MATCH, &before)
            .send();
        assert_eq!(
            demanding.await.unwrap().status(),
            StatusCode::PRECONDITION_FAILED
        );
    });
}

#[test]
fn an_empty_chunk_fills() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let path = key(0, UVec3::ZERO);
        let response = served.get(&path).await;
        assert_eq!(response.status(), StatusCode::NOT_FOUND);
        assert_eq!(
            header(response.headers(), "cache-control"),
            Some("no-store")
        );
        touch(&served, UVec3::ZERO).await;
        assert_eq!(served.get(&path).await.bytes().await.unwrap()[0], 77);
    });
}

#[test]
fn heads_have_no_body() {
    run(async {
        let served = serve(Options {
            compress: Compress::Always,
            ..Options::DEFAULT
        })
        .await;
        let response = served
            .request(Method::HEAD, &key(0, HERE))
            .header(ACCEPT_ENCODING, "gzip")
            .send()
            .await
            .unwrap();
        assert_eq!(response.status(), StatusCode::OK);
        let length = CHUNK.element_product().to_string();
        assert_eq!(response.headers()[CONTENT_LENGTH], *length);
        assert_eq!(header(response.headers(), "accept-ranges"), Some("bytes"));
        assert!(response.headers().contains_key("etag"));
        assert!(response.bytes().await.unwrap().is_empty());
        // Parts are asked for with GET only.
        for range in ["bytes=0-9", "bytes=99999999-"] {
            let part = served
                .request(Method::HEAD, &key(0, HERE))
                .header(RANGE, range)
                .send()
                .await
                .unwrap();
            assert_eq!(part.status(), StatusCode::OK, "{range}");
            assert_eq!(part.headers()[CONTENT_LENGTH], *length, "{range}");
        }
        let empty = served
            .request(Method::HEAD, &key(0, UVec3::ZERO))
            .send()
            .await
            .unwrap();
        assert_eq!(empty.status(), StatusCode::NOT_FOUND);
    });
}

#[test]
fn parts_are_parts_of_the_whole() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let path = key(0, HERE);
        let whole = served.get(&path).await.bytes().await.unwrap();
        let len = whole.len();
        let cases = [
            ("bytes=0-9", 0..10),
            ("bytes=100-", 100..len),
            ("bytes=-7", len - 7..len),
            ("bytes=5-999999", 5..len),
        ];
        for (range, want) in cases {
            let response = served
                .request(Method::GET, &path)
                .header(RANGE, range)
                .send()
                .await
                .unwrap();
            assert_eq!(response.status(), StatusCode::PARTIAL_CONTENT, "{range}");
            let said = format!("bytes {}-{}/{len}", want.start, want.end - 1);
            assert_eq!(header(response.headers(), "content-range"), Some(&*said));
            assert_eq!(
                response.bytes().await.unwrap(),
                whole.slice(want),
                "{range}"
            );
        }
        let asked = |range: &str| served.request(Method::GET, &path).header(RANGE, range);
        let outside = asked(&format!("bytes={len}-")).send().await.unwrap();
        assert_eq!(outside.status(), StatusCode::RANGE_NOT_SATISFIABLE);
        let several = asked("bytes=0-1,4-5").send().await.unwrap();
        assert_eq!(
            several.status(),
            StatusCode::OK,
            "several ranges get the whole"
        );
        let tag = tag(&served, &path).await;
        let same = asked("bytes=0-1")
            .header(IF_RANGE, &tag)
            .send()
            .await
            .unwrap();
        assert_eq!(same.status(), StatusCode::PARTIAL_CONTENT);
        touch(&served, HERE).await;
        let other = asked("bytes=0-1")
            .header(IF_RANGE, &tag)
            .send()
            .await
            .unwrap();
        assert_eq!(
            other.status(),
            StatusCode::OK,
            "parts of two states must not be joined"
        );
    });
}

#[test]
fn compressed_chunks_are_the_same_chunks() {
    run(async {
        let served = serve(Options {
            compress: Compress::Always,
            ..Options::DEFAULT
        })
        .await;
        let path = key(0, HERE);
        let plain_tag = tag(&served, &path).await;
        let plain = served.get(&path).await.bytes().await.unwrap();
        let asked = || {
            served
                .request(Method::GET, &path)
                .header(ACCEPT_ENCODING, "gzip")
        };
        let response = asked().send().await.unwrap();
        assert_eq!(header(response.headers(), "content-encoding"), Some("gzip"));
        let tag = header(response.headers(), "etag").unwrap().to_owned();
        assert_ne!(tag, plain_tag, "other bytes need another strong tag");
        let packed = response.bytes().await.unwrap();
        let mut got = Vec::new();
        flate2::read::GzDecoder::new(&*packed)
            .read_to_end(&mut got)
            .unwrap();
        assert_eq!(got, plain);
        let held = asked().header(IF_NONE_MATCH, &tag).send().await.unwrap();
        assert_eq!(held.status(), StatusCode::NOT_MODIFIED);
        assert_eq!(header(held.headers(), "etag"), Some(&*tag));
        let part = asked().header(RANGE, "bytes=0-9").send().await.unwrap();
        assert_eq!(
            header(part.headers(), "content-encoding"),
            None,
            "ranges count plain bytes"
        );
        assert_eq!(part.bytes().await.unwrap(), plain.slice(..10));
    });
}

#[test]
fn near_clients_are_spared_compression() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let of = async |path: &str| {
            let request = served
                .request(Method::GET, path)
                .header(ACCEPT_ENCODING, "gzip");
            let response = request.send().await.unwrap();
            header(response.headers(), "content-encoding").map(str::to_owned)
        };
        assert_eq!(of(&key(0, HERE)).await, None);
        assert_eq!(of("v/em/zarr/zarr.json").await.as_deref(), Some("gzip"));
    });
}

/// An image that is written anew where it is kept, which is noticed when it is read again.
struct Rewritten {
    array: ArraySource,
    voxels: VoxelBox,
    is_rewritten: AtomicBool,
    is_away: AtomicBool,
}

impl VolumeSource for Rewritten {
    fn volume(&self) -> &Arc<Volume> {
        self.array.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        if self.is_away.load(Ordering::SeqCst) {
            let failed = ChunkError::Failed {
                id,
                transient: true,
                source: Arc::new(std::io::Error::other("the disk is away")),
            };
            return Box::pin(std::future::ready(Err(failed)));
        }
        if self.is_rewritten.swap(false, Ordering::SeqCst) {
            self.array.set(self.voxels, &[77]).unwrap();
        }
        self.array.read(id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.array.changes()
    }

    fn revision(&self) -> u64 {
        self.array.revision()
    }

    fn notices_by_reading(&self) -> bool {
        true
    }
}

/// Also in the answer of the very read that noticed it: equal tags, equal bytes.
#[test]
fn voxels_that_turn_out_to_be_others_have_another_tag() {
    run(async {
        let min = HERE * CHUNK;
        let source = Arc::new(Rewritten {
            array: ArraySource::new(volume(), level0()).unwrap(),
            voxels: VoxelBox::new(min, min + 1),
            is_rewritten: AtomicBool::new(false),
            is_away: AtomicBool::new(false),
        });
        let (url, _stop, _) = serve_source(source.clone(), Options::DEFAULT).await;
        let client = reqwest::Client::new();
        let get = async |held: Option<&str>| {
            let mut request = client.get(format!("{url}{}", key(0, HERE)));
            if let Some(held) = held {
                request = request.header(IF_NONE_MATCH, held);
            }
            let answer = request.send().await.unwrap();
            let tag = header(answer.headers(), "etag").map(str::to_owned);
            (answer.status(), tag, answer.bytes().await.unwrap())
        };
        for _ in 0..20 {
            let (_, first, _) = get(None).await;
            let first = first.expect("what is known to be so has a tag");
            let (held, ..) = get(Some(&first)).await;
            assert_eq!(held, StatusCode::NOT_MODIFIED);
            source.is_rewritten.store(true, Ordering::SeqCst);
            let (_, second, after) = get(None).await;
            assert_eq!(after[0], 77);
            assert_ne!(second.as_ref(), Some(&first));
            let (now, third, voxels) = get(Some(&first)).await;
            assert_eq!((now, voxels), (StatusCode::OK, after));
            assert!(second.is_none() || second == third, "{second:?} {third:?}");

            // Who asks only whether it is as it was, and nobody else, learns of it, too.
            let third = third.unwrap();
            source.is_rewritten.store(true, Ordering::SeqCst);
            let (now, fourth, _) = get(Some(&third)).await;
            assert_eq!(now, StatusCode::OK);
            assert_ne!(fourth.as_ref(), Some(&third));
            // What cannot be read now is not known to be another.
            let (_, fourth, _) = get(None).await;
            source.is_away.store(true, Ordering::SeqCst);
            let (now, ..) = get(fourth.as_deref()).await;
            assert_eq!(now, StatusCode::NOT_MODIFIED);
            let (now, ..) = get(Some(&third)).await;
            assert!(now.is_server_error(), "{now}");
            source.is_away.store(false, Ordering::SeqCst);
        }
    });
}
