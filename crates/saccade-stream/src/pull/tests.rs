use std::io;

use glam::{DVec3, UVec3};

use super::*;

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Eight bricks and eight chunks per axis at level 0; every brick needs chunks of its neighbours.
fn volume() -> Arc<Volume> {
    let volume = Volume::new("v", UVec3::splat(256), DVec3::ONE).unwrap();
    Arc::new(Volume {
        chunk: UVec3::splat(32),
        ..volume
    })
}

fn pull(limits: Limits) -> Pull {
    Pull::new(volume(), limits)
}

fn brick(x: u32) -> BrickId {
    BrickId::new(0, 0, UVec3::new(x, 3, 3)).unwrap()
}

fn voxels() -> Chunk {
    Chunk::Voxels(vec![9; 32 * 32 * 32].into())
}

fn failed(id: ChunkId, transient: bool) -> ChunkError {
    ChunkError::Failed {
        id,
        transient,
        source: Arc::new(io::Error::other("unplugged")),
    }
}

/// Answers everything that is in flight.
fn answer_all(pull: &mut Pull, requests: Vec<Request>, now: Duration) {
    for request in requests {
        pull.answer(request.ticket, Ok(voxels()), now);
    }
}

fn delivered(pull: &mut Pull, frame: u64) -> Vec<BrickId> {
    let bricks = delivered_as(pull, frame);
    bricks.into_iter().map(|(id, _)| id).collect()
}

fn delivered_as(pull: &mut Pull, frame: u64) -> Vec<(BrickId, Freshness)> {
    let mut bricks = Vec::new();
    pull.deliver(
        frame,
        || ms(0),
        |id, _, freshness| bricks.push((id, freshness)),
    );
    bricks
}

#[test]
fn a_brick_goes_from_wanted_to_delivered() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    assert_eq!(pull.state(brick(3)), BrickState::NotWanted);
    pull.want(1, &[brick(3)]);
    assert_eq!(pull.state(brick(3)), BrickState::Wanted);
    let actions = pull.plan(ms(0));
    assert_eq!(actions.start.len(), 27, "its own chunk and all neighbours");
    assert_eq!(pull.state(brick(3)), BrickState::Loading);
    assert!(delivered(&mut pull, 2).is_empty(), "nothing is there yet");
    answer_all(&mut pull, actions.start, ms(0));
    assert_eq!(pull.state(brick(3)), BrickState::Ready);
    assert_eq!(delivered(&mut pull, 2), [brick(3)]);
    assert_eq!(pull.state(brick(3)), BrickState::NotWanted);
    assert!(pull.plan(ms(0)).start.is_empty());
    assert_eq!(pull.progress(), Progress::default());
}

#[test]
fn requests_follow_the_order_of_need_and_the_limit() {
    let mut pull = pull(Limits {
        in_flight: 30,
        ..Limits::default()
    });
    pull.want(1, &[brick(5), brick(2)]);
    let start = pull.plan(ms(0)).start;
    assert_eq!(start.len(), 30);
    assert!(
        start[..27].iter().all(|r| (4..=6).contains(&r.id.chunk.x)),
        "the first brick's"
    );
    assert!(
        start[27..].iter().all(|r| (1..=3).contains(&r.id.chunk.x)),
        "then the second's"
    );
    assert!(pull.plan(ms(0)).start.is_empty(), "no more than the limit");
    answer_all(&mut pull, start[..2].to_vec(), ms(0));
    assert_eq!(pull.plan(ms(0)).start.len(), 2);
}

#[test]
fn a_new_view_comes_first_and_old_requests_are_dropped_after_a_while() {
    let mut pull = pull(Limits {
        in_flight: 30,
        grace: 2,
        ..Limits::default()
    });
    pull.want(1, &[brick(1)]);
    let old = pull.plan(ms(0)).start;
    for frame in 2..=3 {
        pull.want(frame, &[brick(6)]);
        let actions = pull.plan(ms(0));
        assert!(
            actions.cancel.is_empty(),
            "frame {frame} is within the grace"
        );
    }
    pull.want(4, &[brick(6)]);
    let cancel = pull.plan(ms(0)).cancel;
    let old_tickets: Vec<_> = old.iter().map(|r| r.ticket).collect();
    assert_eq!(cancel.len(), 27);
    assert!(cancel.iter().all(|t| old_tickets.contains(t)));
    assert_eq!(
        pull.plan(ms(0)).start.len(),
        24,
        "their places are free: 27 less 3 in flight"
    );
    // A late answer to a cancelled request changes nothing.
    let in_flight = pull.progress().in_flight;
    pull.answer(old[0].ticket, Ok(voxels()), ms(0));
    assert_eq!(pull.progress().in_flight, in_flight);
}

#[test]
fn reports_from_before_a_delivery_do_not_ask_again() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    pull.want(1, &[brick(3)]);
    let start = pull.plan(ms(0)).start;
    answer_all(&mut pull, start, ms(0));
    assert_eq!(delivered(&mut pull, 5).len(), 1);
    pull.want(4, &[brick(3)]);
    assert_eq!(
        pull.state(brick(3)),
        BrickState::NotWanted,
        "frame 4 was drawn without it"
    );
    pull.want(5, &[brick(3)]);
    assert_ne!(
        pull.state(brick(3)),
        BrickState::NotWanted,
        "frame 5 had it: it was evicted"
    );
    assert!(
        pull.plan(ms(0)).start.is_empty(),
        "its chunks are still kept"
    );
    assert_eq!(delivered(&mut pull, 6).len(), 1);
    pull.want(2, &[brick(4)]);
    assert_eq!(
        pull.state(brick(4)),
        BrickState::NotWanted,
        "reports never go back in time"
    );
}

#[test]
fn passing_failures_are_repeated_with_growing_delays() {
    let retry = crate::policy::Retry {
        first: ms(100),
        longest: ms(1000),
    };
    let mut pull = pull(Limits {
        in_flight: 100,
        retry,
        ..Limits::default()
    });
    pull.want(1, &[brick(3)]);
    let mut start = pull.plan(ms(0)).start;
    let Request { mut ticket, id } = start.swap_remove(0);
    answer_all(&mut pull, start, ms(0));
    let mut now = ms(0);
    for delay in [100, 200, 400, 800, 1000, 1000] {
        pull.answer(ticket, Err(failed(id, true)), now);
        assert_eq!(pull.state(brick(3)), BrickState::Waiting);
        let failure = pull.progress().failure.unwrap();
        assert!(
            failure.ends_with("could not be read: unplugged"),
            "{failure}"
        );
        assert_eq!(pull.progress().retry_at, Some(now + ms(delay)));
        assert!(pull.plan(now + ms(delay - 1)).start.is_empty());
        now += ms(delay);
        ticket = pull.plan(now).start[0].ticket;
    }
    let patience = ChunkError::NotReady {
        id,
        retry_after: ms(900),
    };
    pull.answer(ticket, Err(patience), now);
    assert_eq!(
        pull.progress().retry_at,
        Some(now + ms(1000)),
        "the longer of both delays"
    );
    now += ms(1000);
    let ticket = pull.plan(now).start[0].ticket;
    let hindered = ChunkError::Hindered {
        id,
        retry_after: ms(900),
        reason: "the server is away".to_owned(),
    };
    pull.answer(ticket, Err(hindered), now);
    let failure = pull.progress().failure.unwrap();
    assert!(failure.ends_with("the server is away"), "{failure}");
    now += ms(1000);
    let ticket = pull.plan(now).start[0].ticket;
    pull.answer(ticket, Ok(voxels()), now);
    assert_eq!(pull.state(brick(3)), BrickState::Ready);
    assert_eq!(pull.progress().failure, None, "it succeeded in the end");
}

#[test]
fn lasting_failures_are_reported_and_not_repeated_before_a_change() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    pull.want(1, &[brick(3), brick(5)]);
    let start = pull.plan(ms(0)).start;
    let broken = start[0];
    assert_eq!(
        broken.id.chunk,
        UVec3::new(2, 2, 2),
        "needed by brick 3 only"
    );
    for request in start {
        let answer = if request == broken {
            Err(failed(broken.id, false))
        } else {
            Ok(voxels())
        };
        pull.answer(request.ticket, answer, ms(0));
    }
    assert_eq!(pull.state(brick(3)), BrickState::Failed);
    assert_eq!(
        delivered(&mut pull, 2),
        [brick(5)],
        "others are not held up"
    );
    assert_eq!((pull.progress().failed, pull.progress().wanted), (1, 0));
    pull.want(3, &[brick(3)]);
    assert!(pull.plan(ms(1_000_000)).start.is_empty());

    pull.change(VoxelBox::new(UVec3::splat(200), UVec3::splat(201)));
    assert_eq!(
        pull.state(brick(3)),
        BrickState::Failed,
        "a change elsewhere mends nothing"
    );
    pull.change(VoxelBox::new(UVec3::splat(64), UVec3::splat(65)));
    assert_eq!(pull.progress().failure, None);
    let start = pull.plan(ms(1_000_000)).start;
    assert_eq!(
        start.len(),
        1,
        "the chunk that failed is the one that changed"
    );
    answer_all(&mut pull, start, ms(0));
    assert_eq!(delivered(&mut pull, 4), [brick(3)]);
}

#[test]
fn chunks_of_the_wrong_size_are_failures() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    pull.want(1, &[brick(3)]);
    let start = pull.plan(ms(0)).start;
    for request in start {
        pull.answer(request.ticket, Ok(Chunk::Voxels(vec![1; 77].into())), ms(0));
    }
    assert_eq!(pull.state(brick(3)), BrickState::Failed);
    assert!(
        pull.progress()
            .failure
            .unwrap()
            .contains("77 bytes instead of 32768")
    );
}

#[test]
fn answers_that_began_before_a_change_are_shown_and_asked_for_again() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    pull.want(1, &[brick(3)]);
    let start = pull.plan(ms(0)).start;
    pull.change(VoxelBox::new(UVec3::splat(96), UVec3::splat(97)));
    assert!(pull.plan(ms(0)).start.is_empty(), "they are awaited");
    answer_all(&mut pull, start, ms(0));
    assert_eq!(pull.state(brick(3)), BrickState::Ready);
    assert_eq!(
        delivered_as(&mut pull, 2),
        [(brick(3), Freshness::Outdated)]
    );

    pull.want(2, &[brick(3)]);
    assert_eq!(pull.state(brick(3)), BrickState::Loading);
    assert!(delivered(&mut pull, 3).is_empty(), "not the same once more");
    let again = pull.plan(ms(0)).start;
    assert_eq!(
        again.iter().map(|r| r.id.chunk).collect::<Vec<_>>(),
        [UVec3::splat(3)],
        "the brick's own chunk"
    );
    answer_all(&mut pull, again, ms(0));
    assert_eq!(delivered_as(&mut pull, 3), [(brick(3), Freshness::Current)]);
}

#[test]
fn neighbours_share_what_is_out_of_date() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    pull.want(1, &[brick(3), brick(4)]);
    let (late, start) = pull
        .plan(ms(0))
        .start
        .into_iter()
        .partition(|r| r.id.chunk.x == 5);
    pull.change(VoxelBox::new(UVec3::splat(96), UVec3::splat(97)));
    answer_all(&mut pull, start, ms(0));
    assert_eq!(
        delivered_as(&mut pull, 2),
        [(brick(3), Freshness::Outdated)]
    );
    // Brick 3 is asked for again while brick 4 still waits for its far side.
    pull.want(2, &[brick(3), brick(4)]);
    let again = pull.plan(ms(0)).start;
    assert_eq!(again.len(), 1);
    answer_all(&mut pull, late, ms(0));
    assert_eq!(
        delivered_as(&mut pull, 3),
        [(brick(4), Freshness::Outdated)]
    );
    pull.want(3, &[brick(3), brick(4)]);
    answer_all(&mut pull, again, ms(0));
    let both = [
        (brick(3), Freshness::Current),
        (brick(4), Freshness::Current),
    ];
    assert_eq!(delivered_as(&mut pull, 4), both);
}

#[test]
fn a_failure_from_before_a_change_is_no_failure() {
    let mut pull = pull(Limits {
        in_flight: 100,
        ..Limits::default()
    });
    pull.want(1, &[brick(3)]);
    let start = pull.plan(ms(0)).start;
    pull.change(VoxelBox::of_size(UVec3::splat(256)));
    for request in start {
        pull.answer(request.ticket, Err(failed(request.id, false)), ms(0));
    }
    assert_eq!(pull.progress().failed, 0);
    assert_eq!(pull.plan(ms(0)).start.len(), 27, "all are asked for again");
}

#[test]
fn memory_for_loading_is_bounded_and_one_brick_always_fits() {
    let chunk = 32_u64.pow(3) + 128;
    for (host_bytes, requests) in [
        (0, 27),
        (2 * 27 * chunk, 27),
        (2 * 36 * chunk, 36),
        (2 * 54 * chunk, 45),
    ] {
        let mut pull = pull(Limits {
            host_bytes,
            in_flight: 1000,
            ..Limits::default()
        });
        pull.want(1, &[brick(1), brick(2), brick(3)]);
        assert_eq!(
            pull.plan(ms(0)).start.len(),
            requests,
            "with {host_bytes} bytes"
        );
    }
}

#[test]
fn memory_stays_below_the_ceiling() {
    let host_bytes = 8 << 20;
    let mut pull = pull(Limits {
        host_bytes,
        in_flight: 8,
        ..Limits::default()
    });
    let all: Vec<BrickId> = VoxelBox::of_size(UVec3::splat(8))
        .iter()
        .map(|b| BrickId::new(0, 0, b).unwrap())
        .collect();
    pull.want(1, &all);
    let mut count = 0;
    while count < all.len() {
        let start = pull.plan(ms(0)).start;
        answer_all(&mut pull, start, ms(0));
        count += delivered(&mut pull, 2).len();
        let used = pull.host_bytes();
        assert!(used <= host_bytes, "{used} bytes after {count} bricks");
    }
}

#[test]
fn a_frame_delivers_within_its_budget() {
    let limits = Limits {
        in_flight: 1000,
        delivery_bytes: 2 * 34 * 34 * 34,
        ..Limits::default()
    };
    let mut pull = pull(limits);
    pull.want(1, &[brick(1), brick(2), brick(3), brick(4), brick(5)]);
    let start = pull.plan(ms(0)).start;
    answer_all(&mut pull, start, ms(0));
    for expected in [(2, true), (2, true), (1, false), (0, false)] {
        let Delivery { bricks, cut } = pull.deliver(2, || ms(0), |_, _, _| ());
        assert_eq!((bricks, cut), expected);
    }
}
