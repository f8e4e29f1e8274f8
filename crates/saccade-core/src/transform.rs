//! Where a tile lies in the volume: the papers' alignment matrix.

use glam::{DAffine2, DVec2};
use serde::{Deserialize, Serialize};

/// A position in a tile \[pixels of its finest level\]; pixel `i` covers `[i, i + 1)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TilePoint(pub DVec2);

/// A position in a section \[level-0 voxels\]; the x and y of a voxel position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SectionPoint(pub DVec2);

/// The affine map to level-0 voxels of a section from pixels of a tile.
///
/// As text and JSON it is `[a, b, c, d, tx, ty]`: `x' = a x + c y + tx`, `y' = b x + d y + ty`,
/// the order that TrakEM2, SVG and Render use.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "[f64; 6]", into = "[f64; 6]")]
pub struct SectionFromTile(DAffine2);

/// Numbers that are no usable transform.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("transform {elements:?} cannot be inverted")]
pub struct SingularTransform {
    /// `[a, b, c, d, tx, ty]`.
    pub elements: [f64; 6],
}

impl SectionFromTile {
    /// Pixel `i` is voxel `i`.
    pub const IDENTITY: Self = Self(DAffine2::IDENTITY);

    /// From `[a, b, c, d, tx, ty]`.
    ///
    /// # Errors
    ///
    /// [`SingularTransform`] when an element is not finite or the area of a pixel is zero.
    pub fn new(elements: [f64; 6]) -> Result<Self, SingularTransform> {
        let affine = DAffine2::from_cols_array(&elements);
        let determinant = affine.matrix2.determinant();
        if elements.iter().all(|e| e.is_finite()) && determinant.abs() > 1e-12 {
            Ok(Self(affine))
        } else {
            Err(SingularTransform { elements })
        }
    }

    /// Pure translation by voxels.
    pub fn translation(by: DVec2) -> Self {
        Self(DAffine2::from_translation(by))
    }

    /// Rotation by `radians` about the tile's centre, then the tile's low corner moved to `corner`.
    pub fn rotated(tile_size: DVec2, radians: f64, corner: DVec2) -> Self {
        let centre = tile_size / 2.0;
        let turn = DAffine2::from_angle(radians) * DAffine2::from_translation(-centre);
        Self(DAffine2::from_translation(corner + centre) * turn)
    }

    /// `[a, b, c, d, tx, ty]`.
    pub fn elements(self) -> [f64; 6] {
        self.0.to_cols_array()
    }

    /// The position in the section.
    pub fn apply(self, p: TilePoint) -> SectionPoint {
        SectionPoint(self.0.transform_point2(p.0))
    }

    /// The map to pixels of the tile from voxels of the section.
    pub fn tile_from_section(self) -> TileFromSection {
        TileFromSection(self.0.inverse())
    }

    /// Moved by voxels of the section.
    pub fn shifted(self, by: DVec2) -> Self {
        Self(DAffine2::from_translation(by) * self.0)
    }

    /// Bounds `(min, max)` in the section of a tile of `size` pixels.
    pub fn bounds(self, size: DVec2) -> (SectionPoint, SectionPoint) {
        let corners = [
            DVec2::ZERO,
            DVec2::new(size.x, 0.0),
            DVec2::new(0.0, size.y),
            size,
        ];
        let corners = corners.map(|c| self.apply(TilePoint(c)).0);
        let min = corners.into_iter().fold(DVec2::INFINITY, DVec2::min);
        let max = corners.into_iter().fold(DVec2::NEG_INFINITY, DVec2::max);
        (SectionPoint(min), SectionPoint(max))
    }
}

impl TryFrom<[f64; 6]> for SectionFromTile {
    type Error = SingularTransform;
    fn try_from(elements: [f64; 6]) -> Result<Self, SingularTransform> {
        Self::new(elements)
    }
}

impl From<SectionFromTile> for [f64; 6] {
    fn from(transform: SectionFromTile) -> Self {
        transform.elements()
    }
}

/// The affine map to pixels of a tile from level-0 voxels of its section.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TileFromSection(DAffine2);

impl TileFromSection {
    /// The position in the tile.
    pub fn apply(self, p: SectionPoint) -> TilePoint {
        TilePoint(self.0.transform_point2(p.0))
    }

    /// How far the position in the tile moves per voxel along x of the section.
    pub fn along_x(self) -> DVec2 {
        self.0.matrix2.x_axis
    }

    /// How far the position in the tile moves per voxel along y of the section.
    pub fn along_y(self) -> DVec2 {
        self.0.matrix2.y_axis
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotation_keeps_the_centre() {
        let size = DVec2::new(200.0, 100.0);
        let t = SectionFromTile::rotated(size, 0.3, DVec2::new(10.0, 20.0));
        let centre = t.apply(TilePoint(size / 2.0)).0;
        assert!((centre - DVec2::new(110.0, 70.0)).length() < 1e-9);
        let back = t.tile_from_section().apply(SectionPoint(centre)).0;
        assert!((back - size / 2.0).length() < 1e-9);
    }

    #[test]
    fn elements_are_in_the_order_of_trakem2() {
        let t = SectionFromTile::new([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
        assert_eq!(
            t.apply(TilePoint(DVec2::new(1.0, 0.0))).0,
            DVec2::new(6.0, 8.0)
        );
        assert_eq!(
            t.apply(TilePoint(DVec2::new(0.0, 1.0))).0,
            DVec2::new(8.0, 10.0)
        );
        let json = serde_json::to_string(&t).unwrap();
        assert_eq!(json, "[1.0,2.0,3.0,4.0,5.0,6.0]");
        assert_eq!(serde_json::from_str::<SectionFromTile>(&json).unwrap(), t);
    }

    #[test]
    fn flat_and_poisoned_transforms_are_refused() {
        assert!(SectionFromTile::new([1.0, 2.0, 2.0, 4.0, 0.0, 0.0]).is_err());
        assert!(SectionFromTile::new([1.0, 0.0, 0.0, 1.0, f64::NAN, 0.0]).is_err());
        assert!(serde_json::from_str::<SectionFromTile>("[0,0,0,0,1,1]").is_err());
    }
}
