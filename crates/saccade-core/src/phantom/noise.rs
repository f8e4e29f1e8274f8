//! Smooth noise, evaluated along rows.

use glam::{DVec3, IVec3};

use super::random::{floor, hash, signed};

/// Noise of `N` independent components (at most 4) in `[-1, 1]`, along one row of x.
///
/// Random values on a cubic lattice, joined smoothly. The lattice plane left and right of the
/// current position is remembered, so a step along the row costs one interpolation.
pub(super) struct RowNoise<const N: usize> {
    seed: u64,
    per_nm: f64,
    y: (i32, f64),
    z: (i32, f64),
    at: i32,
    left: [f64; N],
    right: [f64; N],
}

/// Eases `[0, 1]` so that neighbouring lattice cells join without a crease.
fn ease(t: f64) -> f64 {
    t * t * (3.0 - 2.0 * t)
}

fn cell_and_ease(position: f64) -> (i32, f64) {
    let cell = floor(position);
    (cell, ease(position - f64::from(cell)))
}

impl<const N: usize> RowNoise<N> {
    /// Noise with lattice spacing `period_nm`, along the row at `y_nm`, `z_nm`.
    pub(super) fn new(seed: u64, period_nm: f64, y_nm: f64, z_nm: f64) -> Self {
        let per_nm = 1.0 / period_nm;
        let (y, z) = (cell_and_ease(y_nm * per_nm), cell_and_ease(z_nm * per_nm));
        let mut row = Self {
            seed,
            per_nm,
            y,
            z,
            at: 0,
            left: [0.0; N],
            right: [0.0; N],
        };
        row.left = row.plane(0);
        row.right = row.plane(1);
        row
    }

    /// The value of the lattice plane `x`, interpolated to the row.
    fn plane(&self, x: i32) -> [f64; N] {
        let bits = |dy, dz| hash(self.seed, IVec3::new(x, self.y.0 + dy, self.z.0 + dz));
        let corners = [bits(0, 0), bits(1, 0), bits(0, 1), bits(1, 1)];
        let mut values = [0.0; N];
        for (n, value) in (0..).zip(&mut values) {
            let [a, b, c, d] = corners.map(|bits| signed(bits, n));
            let low = a + (b - a) * self.y.1;
            let high = c + (d - c) * self.y.1;
            *value = low + (high - low) * self.z.1;
        }
        values
    }

    /// The noise at `x_nm` of the row.
    pub(super) fn at(&mut self, x_nm: f64) -> [f64; N] {
        let position = x_nm * self.per_nm;
        let cell = floor(position);
        if cell != self.at {
            self.left = if cell == self.at + 1 {
                self.right
            } else {
                self.plane(cell)
            };
            self.right = self.plane(cell + 1);
            self.at = cell;
        }
        let t = ease(position - f64::from(cell));
        std::array::from_fn(|n| self.left[n] + (self.right[n] - self.left[n]) * t)
    }
}

/// Bends straight geometry into tissue: displacements of three sizes, along one row of x.
///
/// Steep enough to look grown, flat enough never to fold: each octave moves neighbouring points
/// by well under half their distance, so what is connected stays connected.
pub(super) struct RowWarp {
    y_nm: f64,
    z_nm: f64,
    octaves: [(RowNoise<3>, f64); 3],
}

/// Period and amplitude of each octave \[nm\].
const OCTAVES: [(f64, f64); 3] = [(3100.0, 330.0), (900.0, 80.0), (250.0, 15.0)];

/// No displacement is longer than this along any axis \[nm\].
pub(super) const WARP_REACH_NM: f64 = OCTAVES[0].1 + OCTAVES[1].1 + OCTAVES[2].1;

impl RowWarp {
    pub(super) fn new(seed: u64, y_nm: f64, z_nm: f64) -> Self {
        let mut n = 0;
        let octaves = OCTAVES.map(|(period, amplitude)| {
            n += 1;
            (
                RowNoise::new(super::random::mix(seed ^ n), period, y_nm, z_nm),
                amplitude,
            )
        });
        Self {
            y_nm,
            z_nm,
            octaves,
        }
    }

    /// Where in the straight geometry the tissue at `x_nm` of the row comes from \[nm\].
    pub(super) fn at(&mut self, x_nm: f64) -> DVec3 {
        let mut point = DVec3::new(x_nm, self.y_nm, self.z_nm);
        for (noise, amplitude) in &mut self.octaves {
            point += DVec3::from_array(noise.at(x_nm)) * *amplitude;
        }
        point
    }
}

/// The tissue position \[nm\] that comes from `straight` \[nm\].
pub(super) fn unwarped(seed: u64, straight: DVec3) -> DVec3 {
    let mut point = straight;
    // The displacement contracts by about a half per round.
    for _ in 0..40 {
        let error = straight - RowWarp::new(seed, point.y, point.z).at(point.x);
        point += error;
        if error.abs().max_element() < 1e-6 {
            break;
        }
    }
    point
}
