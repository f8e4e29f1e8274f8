//! The stream of changes.

use futures::StreamExt;
use futures::stream::BoxStream;
use glam::UVec3;
use reqwest::{Method, StatusCode};
use saccade_core::voxel_box::VoxelBox;
use saccade_serve::Options;
use saccade_source::{Change, ChangeReason};

use super::{EXTENT, Served, header, run, serve};

/// One event of the stream, taken apart by hand.
#[derive(Debug)]
struct Event {
    kind: String,
    id: u64,
    change: Change,
}

async fn listen(served: &Served, last: Option<&str>) -> BoxStream<'static, Event> {
    let mut request = served.request(Method::GET, "v/em/events");
    if let Some(last) = last {
        request = request.header("last-event-id", last);
    }
    let response = request.send().await.unwrap();
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(
        header(response.headers(), "content-type"),
        Some("text/event-stream")
    );
    let state = (Box::pin(response.bytes_stream()), String::new());
    let events = futures::stream::unfold(state, |(mut bytes, mut text)| async {
        loop {
            if let Some((event, rest)) = text.split_once("\n\n") {
                let field = |name: &str| {
                    let line = event.lines().find_map(|line| line.strip_prefix(name));
                    line.map(|line| line.trim().to_owned())
                };
                let parsed = field("data:").map(|data| Event {
                    kind: field("event:").unwrap(),
                    id: field("id:").unwrap().parse().unwrap(),
                    change: serde_json::from_str(&data).unwrap(),
                });
                text = rest.to_owned();
                match parsed {
                    Some(event) => return Some((event, (bytes, text))),
                    None => continue,
                }
            }
            text.push_str(std::str::from_utf8(&bytes.next().await?.ok()?).unwrap());
        }
    });
    events.boxed()
}

fn touch(served: &Served, x: u32) -> VoxelBox {
    let voxels = VoxelBox::new(UVec3::new(x, 0, 0), UVec3::new(x + 1, 1, 1));
    served.source.set(voxels, &[9]).unwrap();
    voxels
}

#[test]
fn changes_arrive_in_order() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        let mut events = listen(&served, None).await;
        for revision in 1..=3_u32 {
            let voxels = touch(&served, revision);
            let event = events.next().await.unwrap();
            assert_eq!(
                (event.kind.as_str(), event.id),
                ("change", u64::from(revision))
            );
            let want = Change {
                revision: event.id,
                voxels,
                reason: ChangeReason::Tile,
            };
            assert_eq!(event.change, want);
        }
    });
}

#[test]
fn who_comes_back_gets_what_was_missed() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        for x in 0..4 {
            touch(&served, x);
        }
        served.until_revision(4).await;
        let mut events = listen(&served, Some("2")).await;
        assert_eq!(events.next().await.unwrap().id, 3);
        assert_eq!(events.next().await.unwrap().id, 4);
        touch(&served, 9);
        assert_eq!(events.next().await.unwrap().id, 5);
        let mut events = listen(&served, Some("0")).await;
        assert_eq!(events.next().await.unwrap().id, 1);
    });
}

#[test]
fn who_comes_from_elsewhere_is_told_to_forget_everything() {
    run(async {
        let served = serve(Options::DEFAULT).await;
        touch(&served, 0);
        served.until_revision(1).await;
        for unknown in ["2", "999999"] {
            let mut events = listen(&served, Some(unknown)).await;
            let event = events.next().await.unwrap();
            assert_eq!((event.id, event.change.reason), (1, ChangeReason::Missed));
            assert_eq!(event.change.voxels, VoxelBox::of_size(EXTENT));
        }
    });
}

#[test]
fn stopping_ends_the_stream() {
    run(async {
        let mut served = serve(Options::DEFAULT).await;
        let mut events = listen(&served, None).await;
        served.stop.take().unwrap().send(()).unwrap();
        assert!(events.next().await.is_none());
        served.running.await.unwrap().unwrap();
    });
}
