//! The order of sub-tiles in a file: neighbours on the plane are near each other on disk.

use glam::UVec2;

/// Position along the Z-shaped curve through the plane, x the lower bit \[000 §5.1\].
pub(super) fn morton(x: u32, y: u32) -> u64 {
    spread(x) | spread(y) << 1
}

/// All positions of a `size.x * size.y` grid along the curve.
pub(super) fn in_morton_order(size: UVec2) -> Vec<UVec2> {
    let mut cells: Vec<_> = (0..size.y)
        .flat_map(|y| (0..size.x).map(move |x| UVec2::new(x, y)))
        .collect();
    cells.sort_unstable_by_key(|c| morton(c.x, c.y));
    cells
}

/// Puts a zero between every two bits.
fn spread(v: u32) -> u64 {
    let mut v = u64::from(v);
    v = (v | v << 16) & 0x0000_ffff_0000_ffff;
    v = (v | v << 8) & 0x00ff_00ff_00ff_00ff;
    v = (v | v << 4) & 0x0f0f_0f0f_0f0f_0f0f;
    v = (v | v << 2) & 0x3333_3333_3333_3333;
    (v | v << 1) & 0x5555_5555_5555_5555
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_grid_by_hand() {
        let order = in_morton_order(UVec2::new(3, 2));
        assert_eq!(
            order,
            [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (2, 1)].map(UVec2::from)
        );
    }

    #[test]
    fn bits_interleave() {
        for (x, y) in [
            (0, 0),
            (1, 0),
            (0, 1),
            (0xffff_ffff, 0),
            (0xdead_beef, 0x1234_5678),
        ] {
            let slow = (0..32).fold(0, |code: u64, bit| {
                code | u64::from(x >> bit & 1) << (2 * bit)
                    | u64::from(y >> bit & 1) << (2 * bit + 1)
            });
            assert_eq!(morton(x, y), slow, "{x:x} {y:x}");
        }
    }
}
