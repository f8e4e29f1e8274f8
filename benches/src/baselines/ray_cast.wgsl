// The ray-caster that all baselines share: segments, levels, colours and compositing as the product's pictures
// have them. A baseline adds `find`, the way to a brick; before this file come its constants:
//
//   SLOTS     channels that are seen
//   STACK     nodes of each channel that are remembered
//   HIDES     page tables know what the transfer function hides
//   EACH_SAMPLE  bricks are searched for at every sample, not only where one ends
//
// Bricks, their borders and their sampling are the product's, so that only the traversal differs.

const EDGE = 32.0;
const STORED_EDGE = 34u;
const TABLE_LEN = 256u;
const LOG2_E = 1.4426950408889634;
const TERMINATION = 0.000244140625;
const SEGMENTS_PER_DOUBLING = 8192u;
const MAX_LEVELS = 32u;

const MISSING = 0u;
const EMPTY = 1u;
const FIRST_SLOT = 2u;

const COUNTERS = 16u;
const COUNT_MISSES = 0u;
const COUNT_RAYS = 1u;
const COUNT_SAMPLES = 2u; // two words
const COUNT_WORK = 4u;    // two words
const MOST_WORK = 6u;
const FEWEST_WORK = 7u;   // counted from the top
const MASK_WORDS = 65536u;
const MISSES = 65536u;

struct Level {
    eye: vec3f,           // [voxels of the level]
    directory_base: u32,
    voxels_per_nm: vec3f,
    down: u32,            // level-0 voxels per voxel [log2], a byte per axis
    bricks: vec3u,
    pad_0: u32,
    directory: vec3u,     // entries of the page directory per axis
    pad_1: u32,
}

struct Frame {
    forward: vec3f,       // as the product's: rays are 1 nm of depth long
    pixel: f32,
    right: vec3f,
    level_count: u32,
    down: vec3f,
    first_level: u32,
    low_nm: vec3f,
    last_level: u32,
    high_nm: vec3f,
    directory_entries: u32, // of one channel
    brick_grid: vec3u,
    start_level: u32,     // level whose nodes an octree is entered at
    size: vec2u,
    usage_words: u32,
    largest: f32,
    counting: u32,        // 1 where work is counted
    table: array<vec4f, 16>, // of each channel, scale and offset of its colour table
    levels: array<Level, MAX_LEVELS>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
// Counters; a bit per slot in use; a bit per miss that was seen, by hash; misses in pairs of words.
@group(0) @binding(1) var<storage, read_write> report: array<atomic<u32>>;
// Per channel a row: linear RGB and extinction; entries below an index that are not transparent. Textures, as the
// product's: drivers that draw on the CPU read a buffer value by value.
@group(0) @binding(2) var colors: texture_2d<f32>;
@group(0) @binding(3) var opaque_before: texture_2d<u32>;
// Smallest and largest value of each slot.
@group(0) @binding(4) var<storage, read> ranges: array<u32>;
@group(0) @binding(5) var bricks: texture_3d<f32>;
@group(0) @binding(6) var trilinear: sampler;
@group(0) @binding(7) var image: texture_storage_2d<rgba8unorm, write>;

// What the frame says of all rays alike, read before they part, as the product does.
struct Steady {
    level_count: u32,
    first_level: u32,
    last_level: u32,
    directory_entries: u32,
    start_level: u32,
    start_bricks: vec3u, // per axis, of the start level
    brick_grid: vec3f,
    texel: vec3f,        // of the brick cache
    largest: f32,
    table: vec2f,        // of the only channel
}

var<private> steady: Steady;

fn read_steady() {
    let slots = vec3f(frame.brick_grid);
    steady = Steady(
        frame.level_count,
        frame.first_level,
        frame.last_level,
        frame.directory_entries,
        frame.start_level,
        frame.levels[frame.start_level].bricks,
        slots,
        1.0 / (slots * f32(STORED_EDGE)),
        frame.largest,
        frame.table[0].xy,
    );
}

// A level as a ray meets it, read where the level changes.
struct Grid {
    level: u32,
    eye: vec3f,
    voxels: vec3f,  // along the ray, per depth
    inverse: vec3f, // depth per voxel along each axis
    last: vec3f,    // brick
    bricks: vec3u,
    directory: vec3u,
    directory_base: u32,
    down: u32,
}

// Of the level that is wanted.
var<private> grid: Grid;

fn grid_of(level: u32, ray: vec3f) -> Grid {
    let here = frame.levels[level];
    let voxels = ray * here.voxels_per_nm;
    return Grid(
        level,
        here.eye,
        voxels,
        1.0 / divisible(voxels),
        vec3f(here.bricks - 1u),
        here.bricks,
        here.directory,
        here.directory_base,
        here.down,
    );
}

// What a baseline finds for a place: a brick of the wanted level, or how far there is none.
struct Spot {
    entry: u32,
    brick: vec3u,
    leaving: f32, // depth
}

// Entries of page tables, or nodes of the octree, that the ray has read.
var<private> work: u32;
var<private> samples: u32;

// Channels of which the place last looked for is not there, as bits, and the brick of each that is missing.
var<private> lost: u32;
var<private> lost_level: array<u32, SLOTS>;
var<private> lost_brick: array<vec3u, SLOTS>;

fn divisible(v: vec3f) -> vec3f {
    return select(v, select(vec3f(-1e-20), vec3f(1e-20), v >= vec3f(0.0)), abs(v) < vec3f(1e-20));
}

// A number per axis, from a byte each.
fn axes(bytes: u32) -> vec3u {
    return vec3u(bytes & 255u, (bytes >> 8u) & 255u, bytes >> 16u);
}

fn brick_at(depth: f32) -> vec3u {
    let at = grid.eye + depth * grid.voxels;
    return vec3u(clamp(floor(at / EDGE), vec3f(0.0), grid.last));
}

// Depth at which a ray leaves a box of `1 << span` bricks per axis, which a brick is in.
fn leaving_box(brick: vec3u, span: vec3u) -> f32 {
    let low = vec3f((brick >> span) << span) * EDGE;
    let bound = select(low, low + EDGE * vec3f(vec3u(1u) << span), grid.voxels >= vec3f(0.0));
    let depths = (bound - grid.eye) * grid.inverse;
    return min(depths.x, min(depths.y, depths.z));
}

// Per channel, the entry noted last: a ray notes a brick once for many samples.
var<private> marked: array<u32, SLOTS>;

fn mark_used(channel: u32, entry: u32) {
    if entry < FIRST_SLOT || entry == marked[channel] {
        return;
    }
    marked[channel] = entry;
    let slot = entry - FIRST_SLOT;
    let word = COUNTERS + slot / 32u;
    let bit = 1u << (slot % 32u);
    if (atomicLoad(&report[word]) & bit) == 0u {
        atomicOr(&report[word], bit);
    }
}

// To be reported when the ray has ended, which it does here.
fn lose(channel: u32, level: u32, brick: vec3u) {
    lost |= 1u << channel;
    lost_level[channel] = level;
    lost_brick[channel] = brick;
}

fn mark_missed(channel: u32, level: u32, brick: vec3u) {
    let key = vec2u(brick.x | (brick.y << 16u), brick.z | (level << 16u) | (channel << 24u));
    let hash = ((key.x * 0x9e3779b1u) ^ (key.y * 0x85ebca77u)) * 0xc2b2ae3du;
    let place = (hash ^ (hash >> 15u)) % (MASK_WORDS * 32u);
    let word = COUNTERS + frame.usage_words + place / 32u;
    let bit = 1u << (place % 32u);
    if (atomicOr(&report[word], bit) & bit) != 0u {
        return;
    }
    let n = atomicAdd(&report[COUNT_MISSES], 1u);
    if n < MISSES {
        let at = COUNTERS + frame.usage_words + MASK_WORDS + 2u * n;
        atomicStore(&report[at], key.x);
        atomicStore(&report[at + 1u], key.y);
    }
}

fn table_position(channel: u32, stored: f32) -> f32 {
    var scaled = steady.table;
    if SLOTS > 1u {
        scaled = frame.table[channel].xy;
    }
    return clamp(stored * scaled.x + scaled.y, 0.0, f32(TABLE_LEN - 1u));
}

fn is_range_hidden(channel: u32, range: u32) -> bool {
    let high = range >> 16u;
    let first = u32(table_position(channel, f32(range & 0xffffu)));
    let last = u32(ceil(table_position(channel, f32(high))));
    let before = textureLoad(opaque_before, vec2u(first, channel), 0).r;
    let behind = textureLoad(opaque_before, vec2u(last + 1u, channel), 0).r;
    return high == 0u || behind == before;
}

fn color_of(channel: u32, stored: f32) -> vec4f {
    let x = table_position(channel, stored * steady.largest);
    let i = min(u32(x), TABLE_LEN - 2u);
    let low = textureLoad(colors, vec2u(i, channel), 0);
    let high = textureLoad(colors, vec2u(i + 1u, channel), 0);
    let color = mix(low, high, x - f32(i));
    return vec4f(color.rgb, select(0.0, color.a, stored > 0.0));
}

fn projected_size(edges: vec3f, direction: vec3f) -> f32 {
    return sqrt(dot(abs(normalize(direction)), edges.yzx * edges.zxy));
}

fn depth_of_next(level: u32, ray: vec3f) -> f32 {
    if level + 1u >= steady.level_count {
        return 3e38;
    }
    let here = projected_size(1.0 / frame.levels[level].voxels_per_nm, ray);
    let next = projected_size(1.0 / frame.levels[level + 1u].voxels_per_nm, ray);
    return sqrt(here * next) / frame.pixel;
}

fn encoded(linear: vec3f) -> vec3f {
    let l = clamp(linear, vec3f(0.0), vec3f(1.0));
    return select(1.055 * pow(l, vec3f(1.0 / 2.4)) - 0.055, l * 12.92, l <= vec3f(0.0031308));
}

var<private> drawn: array<Spot, SLOTS>;
// As the sampler counts: the first sample. The way to the next per depth is the same in all bricks.
var<private> first_texel: array<vec3f, SLOTS>;
var<private> texels_per_depth: vec3f;

// f32 places samples of what is measured well enough that none leaves the border of its brick.
fn aim(channel: u32, depth: f32) {
    let here = drawn[channel];
    let across = steady.brick_grid;
    // Whole numbers below 2^22: exact, and quicker than dividing integers.
    let slot = f32(here.entry - FIRST_SLOT) + 0.5;
    let row = floor(slot / across.x);
    let layer = floor(slot / (across.x * across.y));
    let cell = vec3f(floor(slot) - row * across.x, row - layer * across.y, layer);
    let corner = cell * f32(STORED_EDGE) + 1.0;
    let inside = grid.eye - vec3f(here.brick) * EDGE + depth * grid.voxels;
    first_texel[channel] = (corner + inside) * steady.texel;
}

fn sampled_at(channel: u32, ahead: f32) -> vec4f {
    let at = first_texel[channel] + ahead * texels_per_depth;
    return color_of(channel, textureSampleLevel(bricks, trilinear, at, 0.0).r);
}

// Loops over channels take as many turns as a ray needs.
fn count_of(channels: u32) -> u32 {
    return select(countOneBits(channels), 1u, SLOTS == 1u);
}

fn lowest_of(channels: u32) -> u32 {
    return select(firstTrailingBit(channels), 0u, SLOTS == 1u);
}

// Loops, from the outside: stretches of one level and step; bricks, or samples where each is searched for; samples. Drivers
// that draw on the CPU run all of what is not in a loop further inside for each.
fn trace(pixel: vec2u, inside: bool) -> vec3f {
    let from_middle = (vec2f(pixel) + 0.5) / vec2f(frame.size) * 2.0 - 1.0;
    let ray = frame.forward + from_middle.x * frame.right + from_middle.y * frame.down;
    let nm_per_depth = length(ray);
    let inverse = 1.0 / divisible(ray);
    let a = frame.low_nm * inverse;
    let b = frame.high_nm * inverse;
    let near = min(a, b);
    let far = max(a, b);
    var start = max(max(near.x, near.y), max(near.z, 0.0));
    let end = min(far.x, min(far.y, far.z));
    var light = vec3f(0.0);
    var transmitted = 1.0;
    var level = 0u;
    var level_end = -1.0;
    var segments = 0u;
    // Channels that are drawn from here on, as bits.
    var sampled = 0u;
    let meets = inside && start < end;
    var going = meets;
    while going {
        loop {
            if start < level_end {
                break;
            }
            if level_end >= 0.0 {
                level += 1u;
            }
            level_end = depth_of_next(level, ray);
        }
        let wanted = clamp(level, steady.first_level, steady.last_level);
        if wanted != grid.level {
            for (var c = 0u; c < SLOTS; c += 1u) {
                drawn[c].leaving = -1.0;
            }
        }
        grid = grid_of(wanted, ray);
        texels_per_depth = grid.voxels * steady.texel;
        let doublings = min(segments / SEGMENTS_PER_DOUBLING, 64u);
        let step = 0.5 / length(grid.voxels) * exp2(f32(doublings));
        // Level and step hold up to here.
        let stretch = min(level_end, end);
        let doubling = (segments / SEGMENTS_PER_DOUBLING + 1u) * SEGMENTS_PER_DOUBLING;
        loop {
            let first = min(step, end - start);
            let depth = start + 0.5 * first;
            var until = stretch + 0.5 * step;
            // Channels to search for.
            var due = 0u;
            for (var c = 0u; c < SLOTS; c += 1u) {
                let holds = depth < drawn[c].leaving && !(EACH_SAMPLE && sampled != 0u);
                due |= select(1u << c, 0u, holds);
            }
            for (var n = countOneBits(due); n > 0u; n -= 1u) {
                let c = lowest_of(due);
                due &= due - 1u;
                drawn[c] = find(c, depth);
            }
            sampled = 0u;
            for (var c = 0u; c < SLOTS; c += 1u) {
                until = min(until, drawn[c].leaving);
                sampled |= select(0u, 1u << c, drawn[c].entry >= FIRST_SLOT);
            }
            let ahead_of_all = u32(clamp(ceil((until - depth) / step), 1.0, f32(SEGMENTS_PER_DOUBLING)));
            var count = select(ahead_of_all, 1u, EACH_SAMPLE && sampled != 0u);
            // The last segment, which is cut where the ray leaves the volume, goes alone.
            count = min(count, max(u32((end - start) / step), 1u));
            var rest = sampled;
            for (var n = countOneBits(sampled); n > 0u; n -= 1u) {
                aim(lowest_of(rest), depth);
                rest &= rest - 1u;
            }
            let halvings = -LOG2_E * first * nm_per_depth;
            var i = 0.0;
            if sampled != 0u {
                loop {
                    let ahead = i * step;
                    var sum = vec4f(0.0);
                    if SLOTS == 1u {
                        sum = sampled_at(0u, ahead);
                    } else {
                        var rest = sampled;
                        for (var n = countOneBits(sampled); n > 0u; n -= 1u) {
                            let color = sampled_at(firstTrailingBit(rest), ahead);
                            rest &= rest - 1u;
                            sum += vec4f(color.a * color.rgb, color.a);
                        }
                    }
                    let through = transmitted * exp2(sum.a * halvings);
                    let share = select(1.0 / max(sum.a, 1e-30), 1.0, SLOTS == 1u);
                    light += (transmitted - through) * share * sum.rgb;
                    transmitted = through;
                    i += 1.0;
                    continuing {
                        break if i >= f32(count) || transmitted <= TERMINATION;
                    }
                }
            }
            samples += u32(i) * countOneBits(sampled);
            start += f32(count) * step;
            segments += count;
            continuing {
                going = start < end && transmitted > TERMINATION && lost == 0u;
                break if !going || start >= stretch || segments >= doubling;
            }
        }
    }
    for (var n = countOneBits(lost); n > 0u; n -= 1u) {
        let c = lowest_of(lost);
        lost &= lost - 1u;
        mark_missed(c, lost_level[c], lost_brick[c]);
    }
    if frame.counting == 1u && meets {
        atomicAdd(&report[COUNT_RAYS], 1u);
        add(COUNT_SAMPLES, samples);
        add(COUNT_WORK, work);
        atomicMax(&report[MOST_WORK], work);
        atomicMax(&report[FEWEST_WORK], 0xffffffffu - work);
    }
    return light;
}

// To a number of two words.
fn add(counter: u32, count: u32) {
    let before = atomicAdd(&report[counter], count);
    if before > 0xffffffffu - count {
        atomicAdd(&report[counter + 1u], 1u);
    }
}

@compute @workgroup_size(8, 8)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    // Neighbours in both directions are drawn together, as the product's.
    let within = vec2u(
        (local & 3u) | ((local >> 1u) & 4u),
        ((local >> 2u) & 1u) | ((local >> 3u) & 6u),
    );
    read_steady();
    let pixel = group.xy * 8u + within;
    let inside = all(pixel < frame.size);
    let light = trace(pixel, inside);
    if inside {
        textureStore(image, pixel, vec4f(encoded(light), 1.0));
    }
}
