//! Interpolation in floating point: of 16-bit values, whose products do not fit into 32 bits, and
//! along cubic curves.
//!
//! Differences of 16-bit values and their products with weights have 24 bits: what is rounded off is
//! a hundredth of a grey level.

use super::line::Line;
use super::sample::sealed::{Arithmetic, Kept};

/// Samples that are interpolated at once.
const LANES: usize = 8;

type Lanes<T> = [T; LANES];

/// Which pixel is to the upper left of each sample, and how far right of and below it they lie.
struct Places {
    pixels: Lanes<usize>,
    x: Lanes<f32>,
    y: Lanes<f32>,
}

impl Places {
    #[inline(always)]
    fn of(line: &mut Line, width: usize, samples: usize) -> Self {
        let mut places = Self {
            pixels: [0; LANES],
            x: [0.0; LANES],
            y: [0.0; LANES],
        };
        for n in 0..samples {
            places.pixels[n] = line.pixel(width);
            [places.x[n], places.y[n]] = line.fractions();
            line.step(1);
        }
        places
    }
}

#[inline(always)]
fn lerp(a: f32, b: f32, weight: f32) -> f32 {
    a + (b - a) * weight
}

/// As [`super::line::interpolate`].
pub(super) fn linear<S: Arithmetic, K: Kept<S>>(
    values: &[S],
    width: usize,
    mut line: Line,
    out: &mut [K],
) {
    for out in out.chunks_mut(LANES) {
        let places = Places::of(&mut line, width, out.len());
        let mut corners = [[0.0_f32; LANES]; 4];
        for (n, at) in places.pixels.into_iter().enumerate().take(out.len()) {
            let pixels = &values[at..at + width + 2];
            let here = [pixels[0], pixels[1], pixels[width], pixels[width + 1]];
            for (corner, value) in corners.iter_mut().zip(here) {
                corner[n] = value.number();
            }
        }
        let [a, b, c, d] = corners;
        for (n, out) in out.iter_mut().enumerate() {
            let (x, y) = (places.x[n], places.y[n]);
            *out = K::of_number(lerp(lerp(a[n], b[n], x), lerp(c[n], d[n], x), y));
        }
    }
}

/// Weights of four neighbouring pixels, for a sample `t` right of the second: the cubic curve through
/// all pixels whose slope at each is half the difference of its neighbours (Catmull and Rom).
#[inline(always)]
fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// Along cubic curves. Around each sample, two pixels in each direction must be there.
pub(super) fn cubic<S: Arithmetic, K: Kept<S>>(
    values: &[S],
    width: usize,
    mut line: Line,
    out: &mut [K],
) {
    for out in out.chunks_mut(LANES) {
        let places = Places::of(&mut line, width, out.len());
        for (n, out) in out.iter_mut().enumerate() {
            let first = places.pixels[n] - width - 1;
            let (along, down) = (catmull_rom(places.x[n]), catmull_rom(places.y[n]));
            let mut sum = 0.0;
            for (row, weight) in down.into_iter().enumerate() {
                let from = first + row * width;
                let [a, b, c, d]: [S; 4] = *values[from..].first_chunk().expect("the margin");
                let [p, q, r, s] = along;
                let across = p * a.number() + q * b.number() + r * c.number() + s * d.number();
                sum += weight * across;
            }
            *out = K::of_number(sum);
        }
    }
}

/// The pixels that samples lie in, `least` in place of smaller ones.
pub(super) fn nearest<S: Arithmetic, K: Kept<S>>(
    values: &[S],
    width: usize,
    mut line: Line,
    least: S,
    out: &mut [K],
) {
    for out in out {
        let [x, y] = line.weights().map(|w| usize::from(w >= 1 << 15));
        *out = K::of_pixel(values[line.pixel(width) + y * width + x].max(least));
        line.step(1);
    }
}
