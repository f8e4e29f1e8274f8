//! Places in a cache, and which of them was used longest ago.

/// Number of a frame. The first is 1.
pub(crate) type Frame = u64;

/// No slot: the end of the list.
const NONE: u32 = u32::MAX;

#[derive(Clone, Copy, Debug)]
struct Link {
    older: u32,
    newer: u32,
    last_used: Frame,
}

/// A fixed number of slots. Those with an owner form a list by their last use.
#[derive(Debug)]
pub(crate) struct Slots<T> {
    owners: Vec<Option<T>>,
    links: Vec<Link>,
    free: Vec<u32>,
    oldest: u32,
    newest: u32,
    /// A search found nothing unused since this frame. Holds until a slot is freed.
    exhausted: Option<Frame>,
}

impl<T> Slots<T> {
    pub(crate) fn new(count: u32) -> Self {
        let link = Link {
            older: NONE,
            newer: NONE,
            last_used: 0,
        };
        Self {
            owners: (0..count).map(|_| None).collect(),
            links: vec![link; count as usize],
            free: (0..count).rev().collect(),
            oldest: NONE,
            newest: NONE,
            exhausted: None,
        }
    }

    /// Slots with and without owner.
    pub(crate) fn capacity(&self) -> u32 {
        u32::try_from(self.owners.len()).expect("slots are made from a u32")
    }

    /// Slots with an owner.
    pub(crate) fn len(&self) -> u32 {
        self.capacity() - u32::try_from(self.free.len()).expect("no more than all")
    }

    pub(crate) fn has_free(&self) -> bool {
        !self.free.is_empty()
    }

    pub(crate) fn owner(&self, slot: u32) -> Option<&T> {
        self.owners.get(slot as usize)?.as_ref()
    }

    pub(crate) fn owner_mut(&mut self, slot: u32) -> Option<&mut T> {
        self.owners.get_mut(slot as usize)?.as_mut()
    }

    /// Slots and their owners.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (u32, &T)> {
        (0..)
            .zip(&self.owners)
            .filter_map(|(slot, owner)| Some((slot, owner.as_ref()?)))
    }

    /// Gives a free slot to an owner; `None` when there is none.
    pub(crate) fn insert(&mut self, owner: T, now: Frame) -> Option<u32> {
        let slot = self.free.pop()?;
        self.owners[slot as usize] = Some(owner);
        self.links[slot as usize].last_used = now;
        self.push_newest(slot);
        Some(slot)
    }

    /// Takes a slot from its owner.
    pub(crate) fn remove(&mut self, slot: u32) -> Option<T> {
        let owner = self.owners.get_mut(slot as usize)?.take()?;
        self.unlink(slot);
        self.free.push(slot);
        self.exhausted = None;
        Some(owner)
    }

    /// Notes a use. Slots without owner have none.
    pub(crate) fn touch(&mut self, slot: u32, frame: Frame) {
        let owned = self.owner(slot).is_some();
        if owned && self.links[slot as usize].last_used <= frame {
            self.links[slot as usize].last_used = frame;
            self.unlink(slot);
            self.push_newest(slot);
        }
    }

    /// The slot used longest ago, if it was not used in `since` or later.
    pub(crate) fn oldest_unused(&mut self, since: Frame) -> Option<u32> {
        if self.exhausted.is_some_and(|frame| frame >= since) {
            return None;
        }
        // Fresh slots count as used by a frame yet to come, so the list is only nearly sorted.
        let mut slot = self.oldest;
        while slot != NONE {
            if self.links[slot as usize].last_used < since {
                return Some(slot);
            }
            slot = self.links[slot as usize].newer;
        }
        self.exhausted = Some(since);
        None
    }

    /// Of the slots whose owner is `spare`, the one used longest ago.
    pub(crate) fn oldest_spare(&self, spare: impl Fn(&T) -> bool) -> Option<u32> {
        let mut slot = self.oldest;
        while slot != NONE && !self.owner(slot).is_some_and(&spare) {
            slot = self.links[slot as usize].newer;
        }
        (slot != NONE).then_some(slot)
    }

    #[cfg(test)]
    pub(crate) fn last_used(&self, slot: u32) -> Frame {
        self.links[slot as usize].last_used
    }

    fn unlink(&mut self, slot: u32) {
        let Link { older, newer, .. } = self.links[slot as usize];
        match older {
            NONE => self.oldest = newer,
            older => self.links[older as usize].newer = newer,
        }
        match newer {
            NONE => self.newest = older,
            newer => self.links[newer as usize].older = older,
        }
    }

    fn push_newest(&mut self, slot: u32) {
        let link = &mut self.links[slot as usize];
        link.older = self.newest;
        link.newer = NONE;
        match self.newest {
            NONE => self.oldest = slot,
            newest => self.links[newest as usize].newer = slot,
        }
        self.newest = slot;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oldest_goes_first_and_what_is_in_use_stays() {
        let mut slots = Slots::new(3);
        let [a, b, c] = ["a", "b", "c"].map(|owner| slots.insert(owner, 1).unwrap());
        assert_eq!(slots.insert("d", 1), None);
        slots.touch(a, 2);
        assert_eq!(slots.oldest_unused(1), None, "all were used in frame 1");
        assert_eq!(slots.oldest_unused(2), Some(b));
        slots.touch(b, 3);
        assert_eq!(slots.oldest_unused(2), Some(c));
        slots.touch(c, 3);
        assert_eq!(slots.oldest_unused(3), Some(a));
        assert_eq!(slots.remove(a), Some("a"));
        assert_eq!((slots.len(), slots.capacity()), (2, 3));
        assert_eq!(slots.remove(a), None);
    }

    #[test]
    fn a_late_report_does_not_age_what_is_fresh() {
        let mut slots = Slots::new(2);
        let fresh = slots.insert((), 10).unwrap();
        let old = slots.insert((), 7).unwrap();
        slots.touch(fresh, 8);
        assert_eq!(slots.last_used(fresh), 10);
        assert_eq!(slots.oldest_unused(9), Some(old), "behind a fresh one");
        slots.touch(old, 9);
        assert_eq!(slots.oldest_unused(9), None);
        assert_eq!(
            slots.oldest_unused(10),
            Some(old),
            "a newer frame asks anew"
        );
    }

    /// Against a plain list.
    #[test]
    fn any_order_of_uses_is_remembered() {
        let mut slots = Slots::new(7);
        let mut model: Vec<u32> = Vec::new();
        let mut random = 1_u32;
        for now in 1..20_000 {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let slot = (random >> 8) % 7;
            match random >> 28 {
                0..6 => {
                    if let Some(new) = slots.insert(now, now) {
                        model.push(new);
                    }
                }
                6..12 => {
                    slots.touch(slot, now);
                    if let Some(at) = model.iter().position(|&s| s == slot) {
                        model.remove(at);
                        model.push(slot);
                    }
                }
                _ => {
                    let removed = slots.remove(slot).is_some();
                    assert_eq!(removed, model.contains(&slot));
                    model.retain(|&s| s != slot);
                }
            }
            assert_eq!(slots.oldest_unused(now + 1), model.first().copied());
            assert_eq!(slots.len() as usize, model.len());
        }
    }
}
