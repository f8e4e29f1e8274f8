//! Whether the stage of Render's tiles (their layout) counts pixels.

use glam::DVec2;
use saccade_archive::acquisition::tile_specs::TileSpec;
use saccade_core::transform::TilePoint;

/// What the stage's places are in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stage {
    /// In pixels, as the transforms' are, but for where both begin.
    Pixels,
    /// In something else, such as nanometers or steps of a motor, or elsewhere: a section would be many times as large.
    Other,
    /// It cannot be told: there is no stage, or the tiles all lie at one place.
    Unknown,
}

/// Where the transform of a tile puts its corner.
pub(super) fn transformed_corner(spec: &TileSpec) -> DVec2 {
    spec.transform.apply(TilePoint(DVec2::ZERO)).0
}

impl Stage {
    /// It counts pixels if its places are the transforms', within a tile's size, for three tiles of four; of few tiles,
    /// which say little, for each of them.
    pub(super) fn of(specs: &[TileSpec]) -> Self {
        /// Fewer are few.
        const MANY: usize = 8;
        let places =
            { specs.iter() }.filter_map(|spec| Some((spec.stage?, transformed_corner(spec))));
        let places: Vec<(DVec2, DVec2)> = places.collect();
        let tile = { specs.iter() }.fold(0, |most, spec| most.max(spec.size.max_element()));
        let tile = f64::from(tile);
        let spread = |of: fn(&(DVec2, DVec2)) -> DVec2| {
            let low = { places.iter() }.fold(DVec2::INFINITY, |low, place| low.min(of(place)));
            let high =
                { places.iter() }.fold(DVec2::NEG_INFINITY, |high, place| high.max(of(place)));
            (high - low).max_element()
        };
        if spread(|place| place.0).max(spread(|place| place.1)) < tile / 2.0 {
            return Self::Unknown;
        }
        let apart: Vec<DVec2> = { places.iter() }
            .map(|(stage, there)| there - stage)
            .collect();
        let middle = |axis: usize| {
            let mut all: Vec<f64> = apart.iter().map(|apart| apart[axis]).collect();
            let middle = all.len() / 2;
            match middle < all.len() {
                true => *all.select_nth_unstable_by(middle, f64::total_cmp).1,
                false => 0.0,
            }
        };
        let middle = DVec2::new(middle(0), middle(1));
        let near = |apart: &&DVec2| (**apart - middle).abs().max_element() <= tile;
        let near = apart.iter().filter(near).count();
        let enough = match apart.len() {
            few @ ..MANY => few,
            many => (3 * many).div_ceil(4),
        };
        if near >= enough {
            Self::Pixels
        } else {
            Self::Other
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec2;
    use saccade_core::transform::SectionFromTile;

    use super::*;

    /// Tiles of 100 pixels whose transforms put them at the first places, and the stage at the second.
    fn stage(places: &[([f64; 2], [f64; 2])]) -> Stage {
        let spec = |(there, stage): &([f64; 2], [f64; 2])| TileSpec {
            id: String::new(),
            file: String::new(),
            section: 0,
            size: UVec2::splat(100),
            stage: Some(DVec2::from_array(*stage)),
            transform: SectionFromTile::translation(DVec2::from_array(*there)),
            left_out: Vec::new(),
            channels: Vec::new(),
        };
        Stage::of(&places.iter().map(spec).collect::<Vec<_>>())
    }

    #[test]
    fn one_place_says_nothing() {
        assert_eq!(stage(&[]), Stage::Unknown);
        let one = ([0.0, 0.0], [9e9, -7.0]);
        assert_eq!(stage(&[one]), Stage::Unknown);
        assert_eq!(stage(&[one; 9]), Stage::Unknown);
        // Neither do tiles that know no stage.
        let none = TileSpec {
            stage: None,
            ..TileSpec {
                id: String::new(),
                file: String::new(),
                section: 0,
                size: UVec2::splat(100),
                stage: None,
                transform: SectionFromTile::IDENTITY,
                left_out: Vec::new(),
                channels: Vec::new(),
            }
        };
        assert_eq!(Stage::of(&[none.clone(), none]), Stage::Unknown);
    }

    #[test]
    fn tiles_that_are_apart_tell() {
        let row = |step: f64, count: u32| {
            let places =
                (0..count).map(|n| ([90.0 * f64::from(n), 0.0], [step * f64::from(n) + 5e5, 3.0]));
            places.collect::<Vec<_>>()
        };
        for count in [2, 3, 7, 8, 50] {
            assert_eq!(stage(&row(90.0, count)), Stage::Pixels, "{count}");
            assert_eq!(stage(&row(360.0, count)), Stage::Other, "{count}");
        }
        // Micrometers are few where pixels are many.
        assert_eq!(stage(&row(0.36, 5)), Stage::Other);
        // Of many, some may be lost.
        let mut lost = row(90.0, 8);
        lost[3].0 = [4e4, 0.0];
        assert_eq!(stage(&lost), Stage::Pixels);
        assert_eq!(stage(&lost[..7]), Stage::Other);
        // Most of a column of sections at one place hide no section that is laid out in nanometers.
        let mut column = vec![([0.0, 0.0], [5e5, 0.0]); 3];
        column.push(([90.0, 0.0], [5e5 + 360.0, 0.0]));
        assert_eq!(stage(&column), Stage::Other);
    }
}
