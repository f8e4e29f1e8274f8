//! Who of several workers does what, and what becomes of it when one breaks down. Knows nothing of how workers are
//! reached, so that every order of events can be tested.

use std::collections::VecDeque;

/// Jobs that a worker has: one that it does, and one that it need not wait for.
const IN_HAND: usize = 2;
/// Workers that may break down, one after the other, before they are ready to work.
const STILLBORN: u32 = 3;

/// Something to be done.
pub(super) trait Job {
    /// Whether anybody waits for it.
    fn is_wanted(&self) -> bool;
}

struct Task<J> {
    number: u32,
    job: J,
    /// Whether a worker broke down at it.
    broke_one: bool,
}

/// Jobs, in the order in which they came, and workers.
pub(super) struct Pool<J> {
    next: u32,
    waiting: VecDeque<Task<J>>,
    /// What each has in hand, in the order in which it does it.
    workers: Vec<VecDeque<Task<J>>>,
    /// Which of them were seen to work.
    ready: Vec<bool>,
    /// How many broke down before they were, since one last was.
    stillborn: u32,
    dropped: u64,
}

impl<J: Job> Pool<J> {
    pub(super) fn new(workers: usize) -> Self {
        Self {
            next: 0,
            waiting: VecDeque::new(),
            workers: (0..workers.max(1)).map(|_| VecDeque::new()).collect(),
            ready: vec![false; workers.max(1)],
            stillborn: 0,
            dropped: 0,
        }
    }

    pub(super) fn submit(&mut self, job: J) {
        self.waiting.push_back(Task {
            number: self.next,
            job,
            broke_one: false,
        });
        self.next = self.next.wrapping_add(1);
    }

    /// The next job, by its number, and the worker that is to have it now. Jobs that nobody wants any more are forgotten.
    pub(super) fn next(&mut self) -> Option<(usize, u32, &J)> {
        let before = self.waiting.len();
        self.waiting.retain(|task| task.job.is_wanted());
        self.dropped += (before - self.waiting.len()) as u64;
        let all = self.workers.iter().enumerate();
        let (worker, jobs) = all.min_by_key(|(_, jobs)| jobs.len())?;
        if jobs.len() >= IN_HAND {
            return None;
        }
        let task = self.waiting.pop_front()?;
        let hand = &mut self.workers[worker];
        hand.push_back(task);
        hand.back().map(|task| (worker, task.number, &task.job))
    }

    /// A worker shows that it works.
    pub(super) fn works(&mut self, worker: usize) {
        if let Some(ready) = self.ready.get_mut(worker) {
            *ready = true;
            self.stillborn = 0;
        }
    }

    /// A worker has done a job; `None` if it was not given that one.
    pub(super) fn done(&mut self, worker: usize, number: u32) -> Option<J> {
        let hand = self.workers.get_mut(worker)?;
        let at = hand.iter().position(|task| task.number == number)?;
        hand.remove(at).map(|task| task.job)
    }

    /// A worker broke down, and another takes its place. What it had in hand is given to the next; a job at which a
    /// second one broke down is returned.
    pub(super) fn broke(&mut self, worker: usize) -> Option<J> {
        let mut hand = std::mem::take(self.workers.get_mut(worker)?);
        if !std::mem::replace(&mut self.ready[worker], false) {
            self.stillborn += 1;
        }
        let culprit = match hand.front_mut() {
            Some(first) if first.broke_one => hand.pop_front().map(|task| task.job),
            Some(first) => {
                first.broke_one = true;
                None
            }
            None => None,
        };
        while let Some(task) = hand.pop_back() {
            self.waiting.push_front(task);
        }
        culprit
    }

    /// Whether workers break down before they are ready: then nobody should wait for them.
    pub(super) fn is_hopeless(&self) -> bool {
        self.stillborn >= STILLBORN
    }

    /// Whether a worker has anything in hand.
    pub(super) fn is_busy(&self, worker: usize) -> bool {
        self.workers
            .get(worker)
            .is_some_and(|hand| !hand.is_empty())
    }

    /// Takes all jobs back.
    pub(super) fn take_all(&mut self) -> Vec<J> {
        let hands = self.workers.iter_mut().flat_map(std::mem::take);
        let mut tasks: Vec<_> = hands.chain(std::mem::take(&mut self.waiting)).collect();
        tasks.sort_by_key(|task| task.number);
        tasks.into_iter().map(|task| task.job).collect()
    }

    /// Jobs that were forgotten before anybody began.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::collections::BTreeSet;
    use std::rc::Rc;

    use proptest::prelude::*;

    use super::*;

    struct Wanted(u32, Rc<Cell<bool>>);

    impl Job for Wanted {
        fn is_wanted(&self) -> bool {
            self.1.get()
        }
    }

    fn job(name: u32) -> (Wanted, Rc<Cell<bool>>) {
        let wanted = Rc::new(Cell::new(true));
        (Wanted(name, wanted.clone()), wanted)
    }

    fn posted(pool: &mut Pool<Wanted>) -> Vec<(usize, u32)> {
        std::iter::from_fn(|| pool.next().map(|(worker, _, job)| (worker, job.0))).collect()
    }

    #[test]
    fn jobs_are_given_out_in_order_and_unwanted_ones_are_forgotten() {
        let mut pool = Pool::new(2);
        let wanted: Vec<_> = (0..7)
            .map(|name| {
                let (job, wanted) = job(name);
                pool.submit(job);
                wanted
            })
            .collect();
        assert_eq!(posted(&mut pool), [(0, 0), (1, 1), (0, 2), (1, 3)]);
        wanted[4].set(false);
        wanted[6].set(false);
        assert_eq!(pool.done(1, 1).map(|job| job.0), Some(1));
        assert_eq!(posted(&mut pool), [(1, 5)]);
        assert_eq!(pool.dropped(), 2);
        assert!(pool.done(1, 1).is_none(), "once");
        assert!(pool.done(0, 5).is_none(), "another's");
        assert!(pool.done(9, 5).is_none());
    }

    #[test]
    fn a_job_that_breaks_two_workers_is_given_up_and_others_are_done() {
        let mut pool = Pool::new(1);
        for name in 0..3 {
            pool.submit(job(name).0);
        }
        assert_eq!(posted(&mut pool), [(0, 0), (0, 1)]);
        assert!(pool.broke(0).is_none(), "it is tried again");
        assert_eq!(posted(&mut pool), [(0, 0), (0, 1)]);
        assert_eq!(pool.broke(0).map(|job| job.0), Some(0));
        assert!(!pool.is_hopeless());
        assert_eq!(posted(&mut pool), [(0, 1), (0, 2)], "nobody else is blamed");
        assert!(pool.broke(0).is_none());
        assert!(pool.is_hopeless(), "none was ever ready");
        let left: Vec<u32> = pool.take_all().iter().map(|job| job.0).collect();
        assert_eq!(left, [1, 2]);
        let mut pool = Pool::new(1);
        for round in 0..20 {
            pool.submit(job(round).0);
            pool.works(0);
            assert!(pool.next().is_some() && pool.broke(0).is_none());
            pool.works(0);
            assert!(pool.next().is_some() && pool.broke(0).is_some());
            assert!(!pool.is_hopeless(), "chunks break workers that are well");
        }
    }

    proptest! {
        /// Whatever happens, in whichever order: each job ends once, as done, given up or forgotten, and no worker
        /// has more than its share.
        #[test]
        fn every_job_ends_once(workers in 1..5_usize, events in prop::collection::vec((0..6_u8, any::<u8>()), 0..200)) {
            let mut pool = Pool::new(workers);
            let (mut names, mut ended, mut hands) = (Vec::new(), BTreeSet::new(), vec![Vec::new(); workers]);
            for (event, which) in events {
                let which = usize::from(which);
                let worker = which % workers;
                match event {
                    0 | 1 => {
                        let (job, wanted) = job(u32::try_from(names.len()).unwrap());
                        names.push(wanted);
                        pool.submit(job);
                    }
                    2 => {
                        if let Some(wanted) = names.get(which % names.len().max(1)) {
                            wanted.set(false);
                        }
                    }
                    3 => {
                        while let Some((worker, number, job)) = pool.next() {
                            prop_assert!(job.is_wanted());
                            hands[worker].push((number, job.0));
                            prop_assert!(hands[worker].len() <= IN_HAND);
                        }
                    }
                    4 => {
                        if !hands[worker].is_empty() {
                            let (number, name) = hands[worker].remove(0);
                            prop_assert_eq!(pool.done(worker, number).map(|job| job.0), Some(name));
                            prop_assert!(ended.insert(name));
                        }
                    }
                    _ => {
                        hands[worker].clear();
                        if let Some(job) = pool.broke(worker) {
                            prop_assert!(ended.insert(job.0));
                        }
                    }
                }
                for (worker, hand) in hands.iter().enumerate() {
                    prop_assert_eq!(pool.is_busy(worker), !hand.is_empty());
                }
            }
            for job in pool.take_all() {
                prop_assert!(ended.insert(job.0));
            }
            prop_assert_eq!(ended.len() as u64 + pool.dropped(), names.len() as u64);
        }
    }
}
