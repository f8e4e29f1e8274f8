//! Memory of what is as long as a tile, in large pages where the system has some.
//!
//! A tile of 12,000 x 12,000 pixels is 35,000 pages of 4 KB. Each is a fault when it is first touched, and each row of a
//! sub-tile lies on another one, of which the processor has to look up where it is. Of pages of 2 MB there are 70.

use std::fmt;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

use bytemuck::Pod;
use bytemuck::allocation::try_zeroed_vec;
use memmap2::MmapMut;

#[cfg_attr(target_os = "linux", path = "large_buffer/linux.rs")]
#[cfg_attr(not(target_os = "linux"), path = "large_buffer/elsewhere.rs")]
mod pages;

#[cfg(test)]
mod tests;

/// Buffers that are as long at least are made of pages of their own \[bytes\]: two large ones, of which one is whole
/// wherever the buffer begins.
const OWN_PAGES: usize = 4 << 20;

/// A fixed number of values, a slice to whoever uses it.
pub struct LargeBuffer<T> {
    memory: Memory<T>,
}

enum Memory<T> {
    Heap(Vec<T>),
    /// As many bytes as the values have, which begin where a page does.
    Pages(MmapMut, PhantomData<T>),
}

impl<T: Pod> LargeBuffer<T> {
    /// So many zeros; `None` where memory does not suffice.
    pub fn zeroed(len: usize) -> Option<Self> {
        let bytes = len.checked_mul(size_of::<T>())?;
        let memory = if bytes < OWN_PAGES {
            Memory::Heap(try_zeroed_vec(len).ok()?)
        } else {
            let map = MmapMut::map_anon(bytes).ok()?;
            pages::prefer_large(&map);
            Memory::Pages(map, PhantomData)
        };
        Some(Self { memory })
    }

    /// The values, copied if they have pages of their own.
    pub fn into_vec(self) -> Vec<T> {
        match self.memory {
            Memory::Heap(values) => values,
            Memory::Pages(..) => self.to_vec(),
        }
    }
}

impl<T> From<Vec<T>> for LargeBuffer<T> {
    fn from(values: Vec<T>) -> Self {
        Self {
            memory: Memory::Heap(values),
        }
    }
}

impl<T: Pod> Deref for LargeBuffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.memory {
            Memory::Heap(values) => values,
            Memory::Pages(map, _) => bytemuck::cast_slice(map),
        }
    }
}

impl<T: Pod> DerefMut for LargeBuffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.memory {
            Memory::Heap(values) => values,
            Memory::Pages(map, _) => bytemuck::cast_slice_mut(map),
        }
    }
}

impl<T> FromIterator<T> for LargeBuffer<T> {
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        Vec::from_iter(values).into()
    }
}

impl<'a, T: Pod> IntoIterator for &'a LargeBuffer<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<T: Pod> Clone for LargeBuffer<T> {
    fn clone(&self) -> Self {
        self.to_vec().into()
    }
}

impl<T: Pod + PartialEq> PartialEq for LargeBuffer<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T: Pod + PartialEq, const N: usize> PartialEq<[T; N]> for LargeBuffer<T> {
    fn eq(&self, other: &[T; N]) -> bool {
        **self == *other
    }
}

impl<T: Pod + PartialEq> PartialEq<Vec<T>> for LargeBuffer<T> {
    fn eq(&self, other: &Vec<T>) -> bool {
        **self == **other
    }
}

impl<T: Pod + Eq> Eq for LargeBuffer<T> {}

impl<T: Pod + fmt::Debug> fmt::Debug for LargeBuffer<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}
