//! Bytes as they come: in pieces.

/// Pieces that the bytes come in at most; what is left comes at once.
const MOST: usize = 48;

/// All bytes, in pieces whose lengths `choice` chooses.
pub fn pieces(choice: u8, mut bytes: &[u8]) -> Vec<&[u8]> {
    let longest = [1, 2, 3, 7, 40, 300, 3000, 30_000][usize::from(choice) % 8];
    let mut state = u32::from(choice) | 1;
    let mut pieces = Vec::new();
    while !bytes.is_empty() {
        state = state.wrapping_mul(0x915f_77f5).wrapping_add(1);
        let some = 1 + (state >> 12) as usize % longest;
        let some = if pieces.len() < MOST {
            some.min(bytes.len())
        } else {
            bytes.len()
        };
        let (piece, rest) = bytes.split_at(some);
        pieces.push(piece);
        bytes = rest;
    }
    pieces
}
