//! Randomness by position: a hash of where something is, never of when it was asked for.

use glam::IVec3;

/// A well-mixed 64-bit number (the finaliser of splitmix64).
pub(super) const fn mix(bits: u64) -> u64 {
    let bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ (bits >> 31)
}

/// The random bits that belong to a cell of a lattice.
pub(super) const fn hash(seed: u64, cell: IVec3) -> u64 {
    let x = (cell.x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let y = (cell.y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    let z = (cell.z as u64).wrapping_mul(0x1656_67b1_9e37_79f9);
    mix(seed ^ mix(x ^ y.rotate_left(21) ^ z.rotate_left(42)))
}

/// Field `n` of four, as a number in `[0, 1)`.
pub(super) fn unit(bits: u64, n: u32) -> f64 {
    let field = (bits >> (16 * n)) & 0xffff;
    // 16 bits are exact in f64.
    field as f64 / 65_536.0
}

/// Field `n` of four, as a number in `[-1, 1)`.
pub(super) fn signed(bits: u64, n: u32) -> f64 {
    2.0 * unit(bits, n) - 1.0
}

/// Rounds down. `f64::floor` is a library call on baseline x86-64, and this runs per voxel.
pub(super) fn floor(value: f64) -> i32 {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "positions over lattice spacing; `as` saturates"
    )]
    let toward_zero = value as i32;
    toward_zero - i32::from(value < f64::from(toward_zero))
}

/// [`floor`] of each coordinate.
pub(super) fn floor3(value: glam::DVec3) -> IVec3 {
    IVec3::new(floor(value.x), floor(value.y), floor(value.z))
}
