//! What every [`Stack`] must do.

use glam::{UVec2, UVec3};

use super::{Stack, StackError};

/// Checks a stack against all its values, given with x fastest.
///
/// # Panics
///
/// If the stack breaks a rule of the trait.
pub fn check(stack: &dyn Stack, extent: UVec3, values: &[u8]) {
    let info = stack.info().clone();
    assert_eq!(info.extent, extent, "extent");
    assert!(!info.name.is_empty(), "a stack has a name");
    let named = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    assert!(
        info.name.chars().all(named),
        "{:?} is fit for addresses and files",
        info.name
    );

    let identity = stack.identity();
    assert!(!identity.is_empty(), "a stack can be told from others");

    let want = |section: u32, min: UVec2, size: UVec2| -> Vec<u8> {
        let mut want = Vec::new();
        for y in min.y..min.y + size.y {
            for x in min.x..min.x + size.x {
                let at = (section as usize * extent.y as usize + y as usize) * extent.x as usize;
                want.push(values[at + x as usize]);
            }
        }
        want
    };
    let flat = extent.truncate();
    let mut regions = vec![
        (UVec2::ZERO, flat),
        (UVec2::ZERO, UVec2::ONE),
        (flat - 1, UVec2::ONE),
        (
            UVec2::new(flat.x / 3, flat.y / 2),
            (flat / 3).max(UVec2::ONE),
        ),
    ];
    regions.push((UVec2::new(0, flat.y - 1), UVec2::new(flat.x, 1)));
    // Backwards and twice: no order of asking is special.
    let sections = (0..extent.z).rev().chain([extent.z - 1, 0]);
    for section in sections {
        for &(min, size) in &regions {
            let got = stack
                .region(section, min, size)
                .expect("what is inside can be read");
            assert_eq!(UVec2::new(got.width, got.height), size, "size of a region");
            assert!(
                got.voxels == want(section, min, size),
                "section {section} at {min}, {size}"
            );
        }
    }
    for (section, min, size) in [
        (extent.z, UVec2::ZERO, UVec2::ONE),
        (0, flat, UVec2::ONE),
        (0, UVec2::ZERO, flat + UVec2::X),
        (0, UVec2::Y, flat),
        (0, UVec2::ZERO, UVec2::ZERO),
        (u32::MAX, UVec2::MAX, UVec2::MAX),
    ] {
        let refused = stack.region(section, min, size);
        let outside = matches!(refused, Err(StackError::Outside { .. }));
        assert!(outside, "section {section} at {min}, {size} is outside");
    }
    assert_eq!(*stack.info(), info, "the description never changes");
    assert_eq!(stack.identity(), identity, "it stays the same stack");
}
