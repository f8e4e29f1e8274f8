use super::*;

/// Of each kind of memory, and just where one ends.
fn lengths() -> [usize; 5] {
    let pages = OWN_PAGES / size_of::<u16>();
    [0, 1, pages - 1, pages, pages + 4097]
}

#[test]
fn there_are_as_many_zeros_as_were_asked_for() {
    for len in lengths() {
        let buffer = LargeBuffer::<u16>::zeroed(len).unwrap();
        assert_eq!(buffer.len(), len);
        assert!(buffer.iter().all(|&value| value == 0), "{len}");
        let in_pages = matches!(buffer.memory, Memory::Pages(..));
        assert_eq!(in_pages, len * 2 >= OWN_PAGES, "{len}");
    }
}

#[test]
fn what_is_written_is_there_and_in_no_copy() {
    for len in lengths().into_iter().filter(|&len| len > 0) {
        let mut buffer = LargeBuffer::<u16>::zeroed(len).unwrap();
        let before = buffer.clone();
        assert!(buffer == before);
        buffer[len - 1] = 0xabcd;
        assert_eq!(buffer[len - 1], 0xabcd);
        assert_eq!(before[len - 1], 0);
        assert!(buffer != before);
        assert!(buffer == buffer.to_vec());
    }
}

#[test]
fn what_no_memory_holds_is_refused() {
    for len in [usize::MAX, usize::MAX / 2, usize::MAX / 4, 1 << 55] {
        assert!(LargeBuffer::<u16>::zeroed(len).is_none(), "{len}");
    }
}
