// Counters of two words.

// What goes to the higher word when `added` goes to a lower one that was `before`.
fn carry_of(before: u32, added: u32) -> u32 {
    return select(0u, 1u, before + added < before);
}
