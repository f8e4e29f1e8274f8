//! Where the voxels that are stored of a level lie in the level.

use glam::{DVec3, I64Vec3, UVec3};
use saccade_core::levels::Level;
use saccade_core::voxel_box::VoxelBox;

/// Where a stored array begins in the level that it is of, and how large it is \[voxels of the level\].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Placed {
    begin: I64Vec3,
    size: UVec3,
    /// How much further it lies than its voxels are put.
    off: DVec3,
}

impl Placed {
    /// One of `size` voxels whose first corner lies `corner` of its voxels from the volume's. No more than `slack` of them is
    /// what writers round, or mean differently: it counts as none.
    pub(crate) fn new(size: UVec3, corner: DVec3, slack: f64) -> Self {
        let begin = corner.to_array().map(|voxels| {
            // Saturates: what is that far away is nowhere in the volume.
            #[expect(
                clippy::cast_possible_truncation,
                reason = "rounded; beyond that it saturates"
            )]
            let whole = voxels.round() as i64;
            let is_none = voxels.is_nan() || voxels.abs() <= slack;
            if is_none { 0 } else { whole }
        });
        let begin = I64Vec3::from(begin);
        // What is left of a division is nothing that anybody said.
        let said = |off: f64| off.abs() > 1e-6 && off.abs() <= 1.0;
        let off = (corner - begin.as_dvec3()).to_array();
        Self {
            begin,
            size,
            off: off.map(|off| if said(off) { off } else { 0.0 }).into(),
        }
    }

    /// How much further it lies than its voxels are put: less than one of them.
    pub(crate) fn off(&self) -> DVec3 {
        self.off
    }

    /// The level that it is of, in a volume of `finest` voxels; `None` if it has nothing of it. Where it covers the volume,
    /// the level ends as it does, whichever way it was rounded.
    pub(crate) fn level(&self, finest: UVec3, downsampling: DVec3) -> Option<Level> {
        let mut extent = self.size;
        for axis in 0..3 {
            let (whole, by) = (f64::from(finest[axis]), downsampling[axis]);
            // As if it began where the volume does, and from where it begins: it may be longer for it.
            let size = f64::from(self.size[axis]);
            let ends = |at: f64| ((at + size) * by - whole).abs() < by;
            let covers = ends(0.0) || ends(self.off[axis]);
            if self.begin[axis] != 0 || !covers {
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "from 1 to the finest's extent"
                )]
                let voxels = (whole / by - 1e-6).ceil().max(1.0) as u32;
                extent[axis] = voxels;
            }
        }
        let level = Level {
            extent,
            downsampling,
        };
        { self.part(VoxelBox::of_size(extent)) }.map(|_| level)
    }

    /// What it has of a box of the level: in its own voxels, and where that begins within the box.
    pub(crate) fn part(&self, voxels: VoxelBox) -> Option<(VoxelBox, UVec3)> {
        let first = voxels.min.as_i64vec3();
        let end = voxels.max.as_i64vec3().saturating_sub(self.begin);
        let min = first.saturating_sub(self.begin).max(I64Vec3::ZERO);
        let max = end.min(self.size.as_i64vec3());
        if min.cmpge(max).any() {
            return None;
        }
        let inside = min.saturating_add(self.begin) - first;
        let own = VoxelBox::new(min.as_uvec3(), max.as_uvec3());
        Some((own, inside.as_uvec3()))
    }

    /// Where a box of its own voxels lies in the level, as far as there are such voxels.
    pub(crate) fn whole(&self, own: VoxelBox) -> VoxelBox {
        let place = |at: UVec3| {
            let at = at.as_i64vec3().saturating_add(self.begin);
            at.clamp(I64Vec3::ZERO, I64Vec3::splat(u32::MAX.into()))
                .as_uvec3()
        };
        VoxelBox::new(place(own.min), place(own.max))
    }

    /// What of a level of this name is not as one expects, in words: that it begins elsewhere than the volume, or ends
    /// elsewhere, as if the finest one had another size. `extent` is what [`Self::level`] made of it.
    pub(crate) fn note(&self, level: &str, extent: UVec3) -> Option<String> {
        let [x, y, z] = self.begin.to_array();
        if self.begin != I64Vec3::ZERO {
            return Some(format!(
                "its level {level} begins {x}, {y}, {z} of its voxels (x, y, z) from where the finest does, and is shown there"
            ));
        }
        let size = self.size;
        (size != extent).then(|| {
            format!(
                "its level {level} has {} x {} x {} voxels, and {} x {} x {} would cover the finest one: it is of a part, or of \
                 more, or one of the two says a wrong size",
                size.x, size.y, size.z, extent.x, extent.y, extent.z
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FINEST: UVec3 = UVec3::new(101, 91, 9);
    const BY: DVec3 = DVec3::new(4.0, 2.0, 1.0);

    fn placed(size: [u32; 3], corner: [f64; 3]) -> Placed {
        Placed::new(size.into(), corner.into(), 0.5)
    }

    #[test]
    fn what_covers_the_volume_is_the_level() {
        // Rounded down and up, and moved by what is rounded.
        for size in [[25, 45, 9], [26, 46, 9], [25, 46, 9]] {
            let placed = placed(size, [0.5, -0.4, f64::NAN]);
            let level = placed.level(FINEST, BY).unwrap();
            assert_eq!(level.extent.to_array(), size);
            let all = VoxelBox::of_size(level.extent);
            assert_eq!(placed.part(all), Some((all, UVec3::ZERO)));
            assert!(placed.note("1", level.extent).is_none());
        }
    }

    /// Chunks that are halved begin on a grid that is not the volume's, and need one voxel more to reach its end.
    #[test]
    fn what_begins_before_the_volume_and_ends_behind_it_is_not_cut() {
        let placed = |size, corner: f64| Placed::new(size, DVec3::new(0.0, corner, 0.0), 0.999);
        let (finest, by) = (UVec3::new(20, 40, 9), DVec3::new(4.0, 4.0, 1.0));
        let level = placed(UVec3::new(5, 11, 9), -0.75)
            .level(finest, by)
            .unwrap();
        assert_eq!(level.extent, UVec3::new(5, 11, 9));
        assert_eq!(
            placed(UVec3::new(5, 11, 9), -0.75).off(),
            DVec3::new(0.0, -0.75, 0.0)
        );
        // Without that, or longer still, it is another size.
        for (size, corner) in [(11, 0.0), (11, 0.75), (12, -0.75), (8, -0.75)] {
            let level = placed(UVec3::new(5, size, 9), corner)
                .level(finest, by)
                .unwrap();
            assert_eq!(level.extent.y, 10, "{size} {corner}");
        }
    }

    #[test]
    fn what_lies_elsewhere_is_part_of_the_level() {
        let placed = placed([10, 100, 4], [3.2, -7.0, 6.0]);
        let level = placed.level(FINEST, BY).unwrap();
        assert_eq!(level.extent, UVec3::new(26, 46, 9));
        let note = placed.note("\"s1\"", level.extent).unwrap();
        assert!(note.contains("\"s1\" begins 3, -7, 6 of"), "{note}");
        let part = |min: [u32; 3], max: [u32; 3]| {
            let part = placed.part(VoxelBox::new(min.into(), max.into()));
            part.map(|(own, at)| (own.min.to_array(), own.max.to_array(), at.to_array()))
        };
        assert_eq!(
            part([0, 0, 0], [25, 45, 9]),
            Some(([0, 7, 0], [10, 52, 3], [3, 0, 6]))
        );
        assert_eq!(
            part([5, 4, 8], [8, 5, 9]),
            Some(([2, 11, 2], [5, 12, 3], [0, 0, 0]))
        );
        assert_eq!(part([0, 0, 0], [3, 45, 9]), None);
        assert_eq!(part([13, 0, 0], [25, 45, 9]), None);
    }

    #[test]
    fn a_size_that_does_not_fit_is_told() {
        // One that is twice as long as the others say, and one of a part.
        for size in [[50, 45, 9], [25, 45, 4]] {
            let placed = placed(size, [0.0; 3]);
            let level = placed.level(FINEST, BY).unwrap();
            let note = placed.note("\"s1\"", level.extent).unwrap();
            let [x, y, z] = size;
            let both = [
                format!("\"s1\" has {x} x {y} x {z} voxels"),
                format!(
                    "{} x {} x {} would cover",
                    level.extent.x, level.extent.y, level.extent.z
                ),
            ];
            assert!(both.iter().all(|part| note.contains(part)), "{note}");
        }
    }

    #[test]
    fn what_has_nothing_of_the_volume_is_no_level_of_it() {
        for corner in [
            [26.0, 0.0, 0.0],
            [-25.0, 0.0, 0.0],
            [0.0, 0.0, 1e300],
            [0.0, -1e300, 0.0],
        ] {
            assert_eq!(placed([25, 45, 9], corner).level(FINEST, BY), None);
        }
        assert!(
            placed([25, 45, 9], [24.0, 0.0, 0.0])
                .level(FINEST, BY)
                .is_some()
        );
    }
}
