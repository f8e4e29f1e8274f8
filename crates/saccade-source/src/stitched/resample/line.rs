//! Bilinear interpolation along lines, many samples at a time.
//!
//! Sections are turned by a few degrees at most, so neighbouring samples mostly lie between
//! neighbouring pixels: a line falls into runs in which pixels lie as the samples do and only the
//! weights change. Runs need no gathering. Where they would be short, pixels are gathered one by one,
//! and only the arithmetic is shared. [`super::wide`] does the same faster where it can.
//!
//! What a sample is must not depend on where the line begins to be drawn, which other tiles decide: neighbours that
//! come would change it a little, outside of where they are. So a line has a first sample, from which
//! samples are counted and put into groups, and any of them may be the first one that is wanted.
//!
//! Weights along x have 8 bits, those along y 16, slopes at least 16: a result is less than one grey
//! level from what is exact.

/// Samples that are interpolated at once.
const LANES: usize = 16;
/// Bits after the point of positions.
pub(super) const BITS: u32 = 32;
/// Samples of a run, at most, as slopes are rounded to 2^-16 pixels.
const LONGEST_RUN: usize = 64;
/// Lines whose runs are shorter on average are gathered.
const SHORT_RUN: i64 = 20;
/// Samples within which a line that is straight leaves no pixel's edge behind: more than are drawn in one piece.
const STRAIGHT: i64 = 4096;

type Lanes<T> = [T; LANES];

/// Bytes that must follow an image's pixels.
pub(super) const MARGIN: usize = LANES + 1;

/// Where samples lie \[pixels, 32 bits after the point\]; a pixel's value is at whole numbers.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line {
    x: i64,
    y: i64,
    pub(super) dx: i64,
    pub(super) dy: i64,
}

impl Line {
    /// The first sample, and the way from one to the next, in an image of which pixel `origin` is the first at hand. What
    /// follows the point does not depend on that.
    pub(super) fn new(at: glam::DVec2, origin: glam::DVec2, along: glam::DVec2) -> Self {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "positions in an image in memory are small"
        )]
        let fixed = |v: f64| (v * (1_u64 << BITS) as f64).round() as i64;
        Self {
            x: fixed(at.x) - fixed(origin.x),
            y: fixed(at.y) - fixed(origin.y),
            dx: fixed(along.x),
            dy: fixed(along.y),
        }
    }

    /// Whether samples lie as pixels do.
    fn is_straight(&self) -> bool {
        let off = (self.dx - (1 << BITS)).abs().max(self.dy.abs());
        off.saturating_mul(STRAIGHT) < (1 << BITS) / 10_000
    }

    /// The same, where each sample lies so near to a whole pixel from the last that all have the same
    /// weights. Rounding must not move it over a pixel's edge.
    fn pixel_for_pixel(self) -> Self {
        const HALF: i64 = 1 << (BITS - 12);
        Self {
            x: (self.x + HALF) >> (BITS - 11) << (BITS - 11),
            y: (self.y + HALF) >> (BITS - 11) << (BITS - 11),
            dx: 1 << BITS,
            dy: 0,
        }
    }

    pub(super) fn step(&mut self, samples: usize) {
        self.x += self.dx * samples as i64;
        self.y += self.dy * samples as i64;
    }

    /// Number of the pixel to the upper left.
    pub(super) fn pixel(&self, width: usize) -> usize {
        whole(self.y, BITS) * width + whole(self.x, BITS)
    }

    /// What follows the point \[pixels\].
    #[expect(
        clippy::cast_possible_truncation,
        reason = "what is cut is before the point"
    )]
    pub(super) fn fractions(&self) -> [f32; 2] {
        // 24 bits are all that fit, and never round up to 1.
        [self.x, self.y].map(|v| (v as u32 >> 8) as f32 / (1_u32 << 24) as f32)
    }

    /// What follows the point \[2^-16 pixels\].
    pub(super) fn weights(&self) -> [u16; 2] {
        [self.x, self.y].map(|v| low(v >> (BITS - 16)))
    }
}

/// What is before the point of a position in an image.
#[expect(
    clippy::cast_possible_truncation,
    reason = "positions in an image are not negative and smaller than it"
)]
fn whole(position: i64, bits: u32) -> usize {
    (position >> bits) as usize
}

/// The lowest 16 bits.
#[expect(clippy::cast_possible_truncation, reason = "the rest is cut")]
fn low(value: i64) -> u16 {
    value as u16
}

/// Rounded to 2^-16 pixels.
pub(super) fn rounded(slope: i64) -> i64 {
    (slope + (1 << (BITS - 17))) >> (BITS - 16)
}

/// What each lane adds to the first one's weight.
fn ramp(slope: i64) -> Lanes<u16> {
    std::array::from_fn(|n| low(slope * n as i64))
}

/// Samples until `from + n * slope` leaves 0 to 2^16.
fn until_it_leaves(from: u16, slope: i64) -> usize {
    // Slopes of runs are less than a pixel.
    let slope = i32::try_from(slope).unwrap_or(i32::MAX);
    let room = u32::from(if slope > 0 { u16::MAX - from } else { from });
    let samples = room.checked_div(slope.unsigned_abs());
    samples.map_or(usize::MAX, |samples| samples as usize + 1)
}

/// What becomes of an interpolated value, which has 8 bits after the point. Nothing measured is 0.
pub(super) trait OfSum: Default + bytemuck::Pod {
    fn of_sum(sum: u16) -> Self;
}

/// Rounded.
impl OfSum for u8 {
    #[inline(always)]
    fn of_sum(sum: u16) -> Self {
        ((sum.wrapping_add(128) >> 8) as Self).max(1)
    }
}

/// As it is.
impl OfSum for u16 {
    #[inline(always)]
    fn of_sum(sum: u16) -> Self {
        sum.max(1 << 8)
    }
}

/// Interpolates between an upper and a lower pair, 8 bits after the point.
#[inline(always)]
fn lerp(top: [u8; 2], bottom: [u8; 2], wx: u16, wy: u16) -> u16 {
    let right = ((wx >> 1) + 64) >> 7;
    lerp_at(top, bottom, right, wy)
}

/// The same with a weight of 0 to 256 along x.
#[inline(always)]
fn lerp_at(top: [u8; 2], bottom: [u8; 2], right: u16, wy: u16) -> u16 {
    // 8 bits before and 8 bits after the point: no sum here reaches 2^16.
    let left = 256 - right;
    let along = |pair: [u8; 2]| {
        let [a, b] = pair.map(u16::from);
        a.wrapping_mul(left).wrapping_add(b.wrapping_mul(right))
    };
    let part = |v: u16| ((u32::from(v) * u32::from(wy)) >> 16) as u16;
    let (top, bottom) = (along(top), along(bottom));
    top.wrapping_sub(part(top)).wrapping_add(part(bottom))
}

/// Interpolates in an image, `width` pixels wide, with [`MARGIN`] bytes behind its end: sample `skip` of a line, and those
/// after it. All of these must lie between its pixels.
pub(super) fn interpolate<K: OfSum>(
    values: &[u8],
    width: usize,
    mut line: Line,
    skip: usize,
    out: &mut [K],
) {
    let one = 1_i64 << BITS;
    if line.is_straight() {
        line = line.pixel_for_pixel();
    }
    let slips = (line.dx - one).abs() + line.dy.abs();
    if slips == 0 {
        line.step(skip);
        return shifted(values, width, line, out);
    }
    if super::wide::serves(values, line) {
        let lead = skip % LANES;
        line.step(skip - lead);
        let before = if lead == 0 { 0 } else { LANES - lead };
        let (first, rest) = out.split_at_mut(before.min(out.len()));
        if lead > 0 {
            group(values, width, line, lead, first);
            line.step(LANES);
        }
        let done = super::wide::interpolate(values, width, line, rest);
        line.step(done);
        return gathered(values, width, line, 0, &mut rest[done..]);
    }
    if slips.saturating_mul(SHORT_RUN) < one {
        in_runs(values, width, line, skip, out);
    } else {
        gathered(values, width, line, skip, out);
    }
}

/// All samples have the same weights.
fn shifted<K: OfSum>(values: &[u8], width: usize, line: Line, out: &mut [K]) {
    let (at, [wx, wy]) = (line.pixel(width), line.weights());
    let row = |from: usize| values[from..from + out.len()].iter();
    let right = ((wx >> 1) + 64) >> 7;
    let top = row(at).zip(row(at + 1));
    if wy == 0 && right == 0 {
        for (out, (value, _)) in out.iter_mut().zip(top) {
            *out = K::of_sum(u16::from(*value) << 8);
        }
    } else {
        let bottom = row(at + width).zip(row(at + width + 1));
        for (out, ((a, b), (c, d))) in out.iter_mut().zip(top.zip(bottom)) {
            *out = K::of_sum(lerp_at([*a, *b], [*c, *d], right, wy));
        }
    }
}

pub(super) fn in_runs<K: OfSum>(
    values: &[u8],
    width: usize,
    mut line: Line,
    mut skip: usize,
    out: &mut [K],
) {
    let slopes = [rounded(line.dx - (1 << BITS)), rounded(line.dy)];
    let ramps = slopes.map(ramp);
    let stride = slopes.map(|slope| low(slope * LANES as i64));
    let mut done = 0;
    while done < out.len() {
        let mut weights = line.weights();
        let stays = |n: usize| until_it_leaves(weights[n], slopes[n]);
        let run = stays(0).min(stays(1)).min(LONGEST_RUN);
        // Runs that nobody wants are walked over, so that all begin where they always do.
        if run <= skip {
            skip -= run;
            line.step(run);
            continue;
        }
        let mut at = line.pixel(width).wrapping_add(skip);
        weights = [0, 1].map(|n| weights[n].wrapping_add(low(slopes[n] * skip as i64)));
        let end = (done + run - skip).min(out.len());
        skip = 0;
        while done < end {
            let pixels = &values[at..at + width + MARGIN];
            let part = |from: usize| pixels[from..].first_chunk().expect("the margin");
            let pixels = [part(0), part(1), part(width), part(width + 1)];
            // Past the run's end is nonsense, which the next run writes over.
            if let Some(to) = out[done..].first_chunk_mut() {
                lerp_run(pixels, weights, &ramps, to);
            } else {
                let mut last = [K::default(); LANES];
                lerp_run(pixels, weights, &ramps, &mut last);
                let to = &mut out[done..];
                to.copy_from_slice(&last[..to.len()]);
            }
            (done, at) = (done + LANES, at + LANES);
            weights = [0, 1].map(|n| weights[n].wrapping_add(stride[n]));
        }
        done = end;
        line.step(run);
    }
}

/// Not inlined: what is known of the arguments outside makes the compiler shuffle lanes.
#[inline(never)]
fn lerp_run<K: OfSum>(
    pixels: [&Lanes<u8>; 4],
    weights: [u16; 2],
    ramps: &[Lanes<u16>; 2],
    out: &mut Lanes<K>,
) {
    let [a, b, c, d] = pixels;
    for (n, out) in out.iter_mut().enumerate() {
        let [wx, wy] = [0, 1].map(|axis| ramps[axis][n].wrapping_add(weights[axis]));
        *out = K::of_sum(lerp([a[n], b[n]], [c[n], d[n]], wx, wy));
    }
}

pub(super) fn gathered<K: OfSum>(
    values: &[u8],
    width: usize,
    mut line: Line,
    skip: usize,
    mut out: &mut [K],
) {
    let mut lead = skip % LANES;
    line.step(skip - lead);
    while !out.is_empty() {
        let (to, rest) = out.split_at_mut((LANES - lead).min(out.len()));
        group(values, width, line, lead, to);
        line.step(LANES);
        (lead, out) = (0, rest);
    }
}

/// Lanes `lead` and following of the group that a line begins with.
fn group<K: OfSum>(values: &[u8], width: usize, line: Line, lead: usize, out: &mut [K]) {
    // Of 16 bits after the point, so that pixels and the lanes' weights agree; anew for each group.
    let (dx, dy) = (rounded(line.dx), rounded(line.dy));
    let ramps = [dx, dy].map(ramp);
    let (mut x, mut y) = (line.x >> (BITS - 16), line.y >> (BITS - 16));
    (x, y) = (x + dx * lead as i64, y + dy * lead as i64);
    let mut pairs = [[0_u16; LANES]; 2];
    let [top, bottom] = &mut pairs;
    let lanes = lead..lead + out.len();
    for (top, bottom) in top[lanes.clone()]
        .iter_mut()
        .zip(&mut bottom[lanes.clone()])
    {
        let at = whole(y, 16) * width + whole(x, 16);
        let pixels = &values[at..at + width + 2];
        *top = u16::from_le_bytes([pixels[0], pixels[1]]);
        *bottom = u16::from_le_bytes([pixels[width], pixels[width + 1]]);
        (x, y) = (x + dx, y + dy);
    }
    let weights = line.weights();
    if let Some(to) = out.as_mut_array() {
        lerp_pairs(&pairs, weights, &ramps, to);
    } else {
        let mut whole = [K::default(); LANES];
        lerp_pairs(&pairs, weights, &ramps, &mut whole);
        out.copy_from_slice(&whole[lanes]);
    }
}

#[inline(never)]
fn lerp_pairs<K: OfSum>(
    [top, bottom]: &[Lanes<u16>; 2],
    weights: [u16; 2],
    ramps: &[Lanes<u16>; 2],
    out: &mut Lanes<K>,
) {
    for (n, out) in out.iter_mut().enumerate() {
        let [wx, wy] = [0, 1].map(|axis| ramps[axis][n].wrapping_add(weights[axis]));
        let sum = lerp(top[n].to_le_bytes(), bottom[n].to_le_bytes(), wx, wy);
        *out = K::of_sum(sum);
    }
}
