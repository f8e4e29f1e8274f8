/// An entry of the page directory or of a page table block, as the shader reads it.
///
/// It is unmapped, empty, or names a cache slot: a page table block's, or in the last step a
/// brick's. A *stale* entry is still drawn as it was, and asked for again at the same time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(crate) struct Entry(u32);

impl Entry {
    /// Nothing is known.
    pub(crate) const UNMAPPED: Self = Self(0);
    /// Known to hold nothing.
    pub(crate) const EMPTY: Self = Self(1);
    /// The entry of slot 0; the others follow.
    pub(crate) const FIRST_SLOT: u32 = 2;
    /// Set on what changed since it was delivered.
    pub(crate) const STALE: u32 = 1 << 31;

    /// Names a slot.
    pub(crate) fn of_slot(slot: u32) -> Self {
        debug_assert!(slot < Self::STALE - Self::FIRST_SLOT, "slots are far fewer");
        Self(slot + Self::FIRST_SLOT)
    }

    /// The slot it names.
    pub(crate) fn slot(self) -> Option<u32> {
        (self.0 & !Self::STALE).checked_sub(Self::FIRST_SLOT)
    }

    /// Marked as out of date; an unmapped entry has nothing to be out of date.
    pub(crate) fn stale(self) -> Self {
        if self == Self::UNMAPPED {
            self
        } else {
            Self(self.0 | Self::STALE)
        }
    }

    /// Whether a ray that meets it asks for it.
    pub(crate) fn is_wanted(self) -> bool {
        self == Self::UNMAPPED || self.0 & Self::STALE != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_do_not_overlap() {
        for slot in [0, 1, 77, Entry::STALE - Entry::FIRST_SLOT - 1] {
            let entry = Entry::of_slot(slot);
            assert_eq!(
                (entry.slot(), entry.stale().slot()),
                (Some(slot), Some(slot))
            );
            assert!(!entry.is_wanted() && entry.stale().is_wanted());
        }
        for entry in [Entry::UNMAPPED, Entry::EMPTY, Entry::EMPTY.stale()] {
            assert_eq!(entry.slot(), None);
        }
        assert!(Entry::UNMAPPED.is_wanted() && !Entry::EMPTY.is_wanted());
        assert_eq!(Entry::UNMAPPED.stale(), Entry::UNMAPPED);
        assert_eq!(
            Entry::default(),
            Entry::UNMAPPED,
            "zeroed GPU memory is unmapped"
        );
    }
}
