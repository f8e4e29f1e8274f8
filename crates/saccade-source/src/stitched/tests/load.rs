//! What nobody waits for any more ends, down to the reads; what is asked for first is built first.

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use futures::future::{BoxFuture, Either, select};
use glam::{DVec3, UVec3};
use saccade_archive::storage::{Entry, MemoryStorage, Storage, StorageError};
use tokio::sync::Semaphore;

use super::fixture::{Fixture, tile};
use super::run;
use crate::stitched::{StitchedOptions, StitchedSource};
use crate::{Chunk, ChunkId, VolumeSource};

/// Lets so many reads through, counts those that are under way, and writes down what was asked for.
#[derive(Debug)]
struct Turnstile {
    inner: MemoryStorage,
    passes: Semaphore,
    under_way: AtomicUsize,
    names: Mutex<Vec<String>>,
}

/// A read that is under way until it is answered or dropped.
struct UnderWay<'a>(&'a AtomicUsize);

impl Drop for UnderWay<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

impl Turnstile {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            inner: MemoryStorage::new(),
            passes: Semaphore::new(0),
            under_way: AtomicUsize::new(0),
            names: Mutex::default(),
        })
    }

    fn asked(&self) -> usize {
        self.names.lock().unwrap().len()
    }

    /// Waits until it has been so for a while.
    async fn settles(&self, is: impl Fn(&Self) -> bool) {
        let mut since = 0;
        let mut asked = self.asked();
        // So long that a thread that waits for its turn on a busy machine has had it.
        while since < 50 {
            tokio::time::sleep(Duration::from_millis(2)).await;
            let same = asked == self.asked() && is(self);
            since = if same { since + 1 } else { 0 };
            asked = self.asked();
        }
    }

    fn waiting(&self) -> usize {
        self.under_way.load(Ordering::SeqCst)
    }
}

impl Storage for Turnstile {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        Box::pin(async move {
            self.names.lock().unwrap().push(name.to_owned());
            self.under_way.fetch_add(1, Ordering::SeqCst);
            let _under_way = UnderWay(&self.under_way);
            self.passes.acquire().await.unwrap().forget();
            self.inner.read(name, range).await
        })
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        self.inner.write_durable(name, bytes)
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.inner.create_durable(name, bytes)
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        self.inner.entries(prefix)
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        self.inner.delete(name)
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        self.inner.size(name)
    }
}

const BLOCKS: u32 = 12;

/// A tile in the middle of each of twelve blocks that lie in a row.
async fn row(storage: Arc<Turnstile>) -> Fixture {
    let extent = UVec3::new(BLOCKS * 512, 140, 2);
    let mut fixture = Fixture::on(storage, extent, DVec3::new(4.0, 4.0, 30.0)).await;
    for n in 0..BLOCKS {
        let corner = (f64::from(n * 512 + 100), 5.0);
        let tile = tile((300, 130), 0, corner, 1.0, 1.0, n.into());
        fixture.put(&format!("t{n:02}"), tile).await;
    }
    fixture
}

async fn open(fixture: &Fixture, builds: usize) -> StitchedSource {
    let options = StitchedOptions {
        builds,
        // Each sub-tile is a read.
        beginning_bytes: 0,
        ..StitchedOptions::default()
    };
    fixture.open_with(options).await
}

/// The chunk in the middle of a block.
fn chunk(level: u32, block: u32) -> ChunkId {
    ChunkId {
        channel: 0,
        level,
        chunk: UVec3::new(block * 8 + 3, 0, 0),
    }
}

/// A chunk is given up after so many reads of it were answered: its pyramid's index, its sub-tiles; of level
/// 3 it is made of several tiles' thumbnails.
#[test]
fn requests_that_are_dropped_end_their_reads() {
    run(async {
        let mut dropped = 0;
        for (level, answered) in [(0, 0), (0, 1), (3, 0), (3, 3), (3, 9)] {
            let turnstile = Turnstile::new();
            let fixture = row(turnstile.clone()).await;
            let source = open(&fixture, 2).await;
            let block = if level == 0 { 2 } else { 0 };
            turnstile.passes.add_permits(answered);
            let read = source.read(chunk(level, block));
            let stuck = std::pin::pin!(turnstile.settles(|t| t.waiting() > 0));
            match select(read, stuck).await {
                Either::Left(_) => panic!("{answered} reads were enough"),
                Either::Right(((), read)) => {
                    // Before they end, which they may do at once.
                    dropped += turnstile.waiting();
                    drop(read);
                }
            }
            // Nobody lets them through.
            turnstile.settles(|t| t.waiting() == 0).await;
            let asked = turnstile.asked();
            turnstile.passes.add_permits(1000);
            turnstile.settles(|_| true).await;
            assert_eq!(turnstile.asked(), asked, "it went on by itself");
            assert_eq!(source.statistics().blocks_built, 0);
            source.read(chunk(level, block)).await.unwrap();
            assert_eq!(source.statistics().blocks_built, 1);
        }
        // So many that ending one of them only would be noticed.
        assert!(dropped >= 10, "{dropped} reads were under way");
    });
}

#[test]
fn who_still_waits_keeps_the_reads() {
    run(async {
        let turnstile = Turnstile::new();
        let fixture = row(turnstile.clone()).await;
        let source = open(&fixture, 2).await;
        let (one, other) = (source.read(chunk(0, 2)), source.read(chunk(0, 2)));
        let both = futures::future::join(one, async {
            let stuck = std::pin::pin!(turnstile.settles(|t| t.waiting() > 0));
            // Gives up.
            let _ = select(other, stuck).await;
            turnstile.passes.add_permits(1000);
        });
        both.await.0.unwrap();
        assert_eq!(source.statistics().blocks_built, 1);
    });
}

/// The index of a small pyramid, and all of its levels, come with one read; without room for that, with two.
#[test]
fn what_comes_with_an_index_is_not_read_again() {
    run(async {
        for (beginning_bytes, reads) in [(StitchedOptions::default().beginning_bytes, 1), (0, 2)] {
            for level in [0, 1, 3] {
                let turnstile = Turnstile::new();
                turnstile.passes.add_permits(1000);
                let fixture = row(turnstile.clone()).await;
                let options = StitchedOptions {
                    beginning_bytes,
                    ..StitchedOptions::default()
                };
                let source = fixture.open_with(options).await;
                let block = if level == 3 { 0 } else { 2 };
                let got = source.read(chunk(level, block)).await.unwrap();
                assert_ne!(got, Chunk::Empty);
                let mut names = turnstile.names.lock().unwrap().clone();
                names.retain(|name| name.starts_with("tiles/"));
                let asked = names.len();
                names.sort();
                names.dedup();
                assert_eq!(
                    asked,
                    reads * names.len(),
                    "level {level}: {} tiles",
                    names.len()
                );
                let other = open(&fixture, 2).await;
                assert_eq!(other.read(chunk(level, block)).await.unwrap(), got);
            }
        }
    });
}

/// However many wait, blocks are built in the order in which they were asked for, and those that nobody waits for
/// any more are passed over.
#[test]
fn order_is_kept_under_load() {
    run(async {
        for builds in [1, 2] {
            let turnstile = Turnstile::new();
            let fixture = row(turnstile.clone()).await;
            let source = open(&fixture, builds).await;
            let order: [u32; 12] = [7, 2, 9, 0, 11, 4, 1, 3, 10, 5, 8, 6];
            let mut reads: Vec<_> = { order.iter() }
                .map(|block| {
                    let read = source.read(chunk(0, *block));
                    (*block, read)
                })
                .collect();
            // All are asked for, in this order, before any is answered.
            for (_, read) in &mut reads {
                assert!(futures::poll!(read).is_pending());
            }
            turnstile.settles(|t| t.waiting() == builds).await;
            // The view turned: these are not needed any more.
            let dropped = [9, 4, 6];
            reads.retain(|(block, _)| !dropped.contains(block));
            turnstile.passes.add_permits(1000);
            let left = reads.into_iter().map(|(_, read)| read);
            futures::future::try_join_all(left).await.unwrap();

            let mut asked = turnstile.names.lock().unwrap().clone();
            let tile = |name: &String| name["tiles/t".len()..][..2].parse::<u32>().unwrap();
            let mut seen = Vec::new();
            asked.retain(|name| {
                let first = !seen.contains(&tile(name));
                seen.push(tile(name));
                first
            });
            let built: Vec<u32> = asked.iter().map(tile).collect();
            let wanted = order.iter().filter(|block| !dropped.contains(block));
            let wanted: Vec<u32> = wanted.copied().collect();
            // Of those that are built at once, any may read first.
            for (at, block) in wanted.iter().enumerate() {
                let got = built.iter().position(|b| b == block).unwrap();
                let off = got.abs_diff(at);
                assert!(off < 2 * builds - 1, "{built:?}, not {wanted:?}");
            }
            assert_eq!(built.len(), wanted.len(), "{built:?}");
        }
    });
}
