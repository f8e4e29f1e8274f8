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
    pad_0: u32,
    bricks: vec3u,
    pad_1: u32,
    directory: vec3u,     // entries of the page directory per axis
    pad_2: u32,
    down: vec3u,          // level-0 voxels per voxel [log2]
    pad_3: u32,
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
// Per channel: linear RGB and extinction; entries below an index that are not transparent.
@group(0) @binding(2) var<storage, read> colors: array<vec4f>;
@group(0) @binding(3) var<storage, read> opaque_before: array<u32>;
// Smallest and largest value of each slot.
@group(0) @binding(4) var<storage, read> ranges: array<u32>;
@group(0) @binding(5) var bricks: texture_3d<f32>;
@group(0) @binding(6) var trilinear: sampler;
@group(0) @binding(7) var image: texture_storage_2d<rgba8unorm, write>;
// The page directory and page tables, or nodes.
@group(0) @binding(8) var<storage, read> index: array<u32>;
@group(0) @binding(9) var<storage, read> blocks: array<u32>;

// What a baseline finds for a place: a brick, or how far there is none.
struct Spot {
    entry: u32,
    level: u32,
    brick: vec3u,
    leaving: f32, // depth
}

// Entries of page tables, or nodes of the octree, that the ray has read.
var<private> work: u32;
var<private> samples: u32;

fn divisible(v: vec3f) -> vec3f {
    return select(v, select(vec3f(-1e-20), vec3f(1e-20), v >= vec3f(0.0)), abs(v) < vec3f(1e-20));
}

fn brick_at(level: u32, depth: f32, ray: vec3f) -> vec3u {
    let at = frame.levels[level].eye + depth * ray * frame.levels[level].voxels_per_nm;
    let last = vec3f(frame.levels[level].bricks - 1u);
    return vec3u(clamp(floor(at / EDGE), vec3f(0.0), last));
}

// Depth at which a ray leaves a box of `edge` bricks whose lowest brick is `first`.
fn leaving_box(level: u32, first: vec3u, edge: u32, ray: vec3f) -> f32 {
    let low = vec3f(first) * EDGE;
    let bound = select(low, low + f32(edge) * EDGE, ray >= vec3f(0.0));
    let voxels = divisible(ray * frame.levels[level].voxels_per_nm);
    let depths = (bound - frame.levels[level].eye) / voxels;
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
    let scaled = frame.table[channel];
    return clamp(stored * scaled.x + scaled.y, 0.0, f32(TABLE_LEN - 1u));
}

fn is_range_hidden(channel: u32, range: u32) -> bool {
    let high = range >> 16u;
    let first = u32(table_position(channel, f32(range & 0xffffu)));
    let last = u32(ceil(table_position(channel, f32(high))));
    let before = channel * (TABLE_LEN + 1u);
    return high == 0u || opaque_before[before + last + 1u] == opaque_before[before + first];
}

fn color_of(channel: u32, stored: f32) -> vec4f {
    if stored <= 0.0 {
        return vec4f(0.0);
    }
    let x = table_position(channel, stored * frame.largest);
    let i = min(u32(x), TABLE_LEN - 2u);
    let at = channel * TABLE_LEN + i;
    return mix(colors[at], colors[at + 1u], x - f32(i));
}

fn projected_size(edges: vec3f, direction: vec3f) -> f32 {
    return sqrt(dot(abs(normalize(direction)), edges.yzx * edges.zxy));
}

fn depth_of_next(level: u32, ray: vec3f) -> f32 {
    if level + 1u >= frame.level_count {
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
var<private> drawn_for: array<u32, SLOTS>;
// Texels: the brick's low corner, the first sample from there, and the way to the next per depth.
var<private> corner: array<vec3f, SLOTS>;
var<private> from_corner: array<vec3f, SLOTS>;
var<private> per_depth: array<vec3f, SLOTS>;

fn aim(channel: u32, depth: f32, ray: vec3f) {
    let here = drawn[channel];
    let slot = here.entry - FIRST_SLOT;
    let grid = frame.brick_grid;
    let cell = vec3u(slot % grid.x, slot / grid.x % grid.y, slot / (grid.x * grid.y));
    let voxels = ray * frame.levels[here.level].voxels_per_nm;
    corner[channel] = vec3f(cell * STORED_EDGE + 1u);
    from_corner[channel] = frame.levels[here.level].eye - vec3f(here.brick) * EDGE + depth * voxels;
    per_depth[channel] = voxels;
}

fn stored_at(channel: u32, ahead: f32) -> f32 {
    let at = clamp(from_corner[channel] + ahead * per_depth[channel], vec3f(0.0), vec3f(EDGE));
    let texel = 1.0 / vec3f(frame.brick_grid * STORED_EDGE);
    return textureSampleLevel(bricks, trilinear, (corner[channel] + at) * texel, 0.0).r;
}

fn trace(pixel: vec2u) -> vec3f {
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
    var misses = 0u;
    // Channels that are drawn from here on, as bits.
    var sampled = 0u;
    for (var c = 0u; c < SLOTS; c += 1u) {
        drawn_for[c] = MAX_LEVELS;
    }
    if frame.counting == 1u && start < end {
        atomicAdd(&report[COUNT_RAYS], 1u);
    }
    let meets = start < end;
    while start < end && transmitted > TERMINATION && misses == 0u {
        while start >= level_end {
            if level_end >= 0.0 {
                level += 1u;
            }
            level_end = depth_of_next(level, ray);
        }
        let wanted = clamp(level, frame.first_level, frame.last_level);
        let voxels_per_depth = length(ray * frame.levels[wanted].voxels_per_nm);
        let doublings = min(segments / SEGMENTS_PER_DOUBLING, 64u);
        let step = 0.5 / voxels_per_depth * exp2(f32(doublings));
        let first = min(step, end - start);
        let depth = start + 0.5 * first;
        var until = min(level_end + 0.5 * step, end + 0.5 * step);
        let was_sampled = sampled != 0u;
        sampled = 0u;
        for (var c = 0u; c < SLOTS; c += 1u) {
            if (EACH_SAMPLE && was_sampled) || wanted != drawn_for[c] || depth >= drawn[c].leaving {
                drawn[c] = find(c, wanted, depth, ray);
                drawn_for[c] = wanted;
                misses += u32(drawn[c].entry == MISSING);
            }
            until = min(until, drawn[c].leaving);
            sampled |= select(0u, 1u << c, drawn[c].entry >= FIRST_SLOT);
        }
        let ahead_of_all = u32(clamp(ceil((until - depth) / step), 1.0, f32(SEGMENTS_PER_DOUBLING)));
        let count = select(ahead_of_all, 1u, EACH_SAMPLE && sampled != 0u);
        for (var c = 0u; c < SLOTS; c += 1u) {
            if (sampled & (1u << c)) != 0u {
                aim(c, depth, ray);
            }
        }
        if sampled != 0u {
            for (var i = 0u; i < count && transmitted > TERMINATION; i += 1u) {
                let segment = min(step, end - start - f32(i) * step);
                let ahead = f32(i) * step + 0.5 * (segment - first);
                var sum = vec4f(0.0);
                for (var c = 0u; c < SLOTS; c += 1u) {
                    if (sampled & (1u << c)) == 0u {
                        continue;
                    }
                    samples += 1u;
                    let color = color_of(c, stored_at(c, ahead));
                    sum += vec4f(color.a * color.rgb, color.a);
                }
                if sum.a > 0.0 {
                    let opacity = 1.0 - exp(-sum.a * max(segment, 0.0) * nm_per_depth);
                    light += transmitted * opacity * sum.rgb / sum.a;
                    transmitted *= 1.0 - opacity;
                }
            }
        }
        start += f32(count) * step;
        segments += count;
    }
    if frame.counting == 1u && meets {
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
fn main(@builtin(global_invocation_id) id: vec3u) {
    if all(id.xy < frame.size) {
        textureStore(image, id.xy, vec4f(encoded(trace(id.xy)), 1.0));
    }
}
