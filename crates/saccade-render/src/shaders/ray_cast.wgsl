// One ray per pixel, front to back, through whatever bricks are there, for all channels that are seen.
//
// A ray is cut into segments of half a voxel of the finest level drawn at their start, measured along the
// ray; each is sampled once. The residency octree tells which can be skipped; other bricks are
// looked up one by one, and all segments in one are sampled without further lookups. See the crate's documentation for the rules an image follows.
//
// Rays drawn at once wait for each other, and drivers that draw on the CPU run both sides of every
// `if`. So what few need stands in an outer loop, and what all need in an inner one.
// Loops end where their body ends, since rays that are done are drawn along up to there.

@group(0) @binding(7) var bricks: texture_3d<f32>;
@group(0) @binding(8) var bricks_sampler: sampler;
@group(0) @binding(9) var image: texture_storage_2d<rgba8unorm, write>;

const LOG2_E = 1.4426950408889634;
// Segments of a row of bricks, of the first and of the others.
const FIRST_ROW = 32u;
const ROW = 64u;
// Light that is left when a ray ends: less than one step of the picture even on white.
const TERMINATION = 0.000244140625;
// The largest part of a surface's colour, where it faces the eye, at least.
const SURFACE_LIGHT = 0.5;
// After so many segments a ray's steps double, and again after as many: all rays end.
const SEGMENTS_PER_DOUBLING = 8192u;
// Levels finer than wanted that may stand in, when no coarser one does.
const FINER_SUBSTITUTES = 2u;
// A substitute so many levels away is too coarse: the level this far away is asked for as well.
const PREVIEW_LEVELS = 2u;

var<private> samples: u32;
var<private> rays: u32;
var<private> substituted: u32;
var<private> substituted_levels: u32;
var<private> finest: u32 = MAX_LEVELS;

// A level as a ray meets it, positions in its voxels from the anchor's low corner. Read once where the level changes: what is
// addressed by number is slow to read.
struct Grid {
    level: u32,
    eye: vec3f,
    voxels: vec3f,  // along the ray, per depth
    inverse: vec3f, // depth per voxel along each axis
    anchor: vec3i,  // [bricks]
    last: vec3i,    // [bricks]
    directory: vec3u,
    directory_base: u32,
}

fn grid_of(level: u32, ray: vec3f) -> Grid {
    let here = frame.levels[level];
    let voxels = ray * here.voxels_per_nm;
    return Grid(
        level,
        here.eye,
        voxels,
        1.0 / divisible(voxels),
        here.anchor,
        vec3i(here.bricks) - 1,
        here.directory,
        here.directory_base,
    );
}

// A brick position: which, and where its low corner is.
struct Place {
    brick: vec3u,
    low: vec3f, // [voxels of the level from the anchor's low corner]
}

fn place_of(grid: Grid, depth: f32) -> Place {
    let at = grid.eye + depth * grid.voxels;
    // Far beyond any volume, yet safe to convert.
    let steps = clamp(floor(at / f32(BRICK_EDGE)), vec3f(-1e9), vec3f(1e9));
    let brick = clamp(grid.anchor + vec3i(steps), vec3i(0), grid.last);
    return Place(vec3u(brick), vec3f(brick - grid.anchor) * f32(BRICK_EDGE));
}

// Depth at which a ray leaves the cube of `1 << span_log2` bricks that a brick is in.
fn leaving(grid: Grid, place: Place, span_log2: u32) -> f32 {
    let first = (place.brick >> vec3u(span_log2)) << vec3u(span_log2);
    let low = place.low - vec3f(place.brick - first) * f32(BRICK_EDGE);
    let high = low + f32(BRICK_EDGE << span_log2);
    let depths = (select(low, high, grid.voxels >= vec3f(0.0)) - grid.eye) * grid.inverse;
    return min(depths.x, min(depths.y, depths.z));
}

fn is_transparent(channel: u32, slot: u32) -> bool {
    let range = slot_ranges[slot];
    return is_range_hidden(channel, range & 0xffffu, range >> 16u);
}

// Linear RGB and extinction of a stored value. Nothing acquired is nothing seen.
fn color_of(channel: u32, stored: f32) -> vec4f {
    let x = table_position(channel, stored * steady.largest);
    let i = min(u32(x), TABLE_LEN - 2u);
    let low = textureLoad(colors, vec2u(i, channel), 0);
    let high = textureLoad(colors, vec2u(i + 1u, channel), 0);
    let color = mix(low, high, x - f32(i));
    return vec4f(color.rgb, select(0.0, color.a, stored > 0.0));
}

// In false colours, how far the level that is drawn lies from the one that is wanted, or which it is.
fn false_color(color: vec3f, level: u32, wanted: u32) -> vec3f {
    if FALSE_COLORS == FALSE_LEVEL {
        return mix(color, level_tint(level), 0.5);
    }
    if FALSE_COLORS == FALSE_RESIDENCY {
        let distance = i32(level) - i32(wanted);
        let tint = mix(color, substitution_tint(distance), 0.5);
        return select(tint, color, distance == 0);
    }
    return color;
}

// What is drawn for a stretch of the ray.
struct Source {
    level: u32,
    found: Found,
    eye: vec3f,     // [voxels of the level from the brick's low corner]
    voxels: vec3f,  // along the ray, per depth
    leaving: f32,   // depth up to which it holds
}

fn source(channel: u32, grid: Grid, depth: f32) -> Source {
    let place = place_of(grid, depth);
    let entry = channel_of(channel).directory_offset + grid.directory_base;
    let found = find(channel, grid.level, place.brick, entry, grid.directory);
    return Source(grid.level, found, grid.eye - place.low, grid.voxels, leaving(grid, place, found.span_log2));
}

// Bits below one.
fn bits_below(bit: u32) -> u32 {
    return select((1u << bit) - 1u, 0xffffffffu, bit >= 32u);
}

// Depth at which the level after this one is wanted: where a voxel's size is as far from one
// level as from the other, in their ratio.
fn depth_of_next(level: u32, ray: vec3f) -> f32 {
    if level + 1u >= level_count() {
        return 3e38;
    }
    let here = projected_size(1.0 / frame.levels[level].voxels_per_nm, ray);
    let next = projected_size(1.0 / frame.levels[level + 1u].voxels_per_nm, ray);
    return sqrt(here * next) / frame.pixel;
}

// Whole segments of a ray, one at least, whose samples, the first of them at `depth`, lie before
// `until`.
fn segments_until(until: f32, depth: f32, step: f32) -> u32 {
    return u32(clamp(ceil((until - depth) / step), 1.0, f32(SEGMENTS_PER_DOUBLING)));
}

// What is drawn of each channel, found for a sample of some level; holds for more of them.
var<private> drawn: array<Source, SLOTS>;
var<private> drawn_for: array<u32, SLOTS>;
// A bit per channel: nothing is known of the brick; nothing of it is seen; another level than wanted stands in, where several
// channels are seen.
var<private> missing: u32;
var<private> transparent: u32;
var<private> elsewhere: u32;
// Of the brick that is drawn, as the sampler counts: the first sample, the way to the next per depth, the
// lowest corner and what a voxel is.
var<private> first_texel: array<vec3f, SLOTS>;
var<private> texels_per_depth: array<vec3f, SLOTS>;
var<private> low_texel: array<vec3f, SLOTS>;
var<private> texel: vec3f;
// Where all channels that are sampled are drawn from one level, the way to the next sample per depth of all of them.
var<private> texels_of_all: vec3f;
// The same of the bricks after it, where one channel is seen, and with which samples of the row they begin.
var<private> next_texel: array<vec3f, 2>;
var<private> next_low: array<vec3f, 2>;
var<private> turns: vec2f;
// The sample before, of surfaces [0, 1].
var<private> sample_before: array<f32, SLOTS>;
// The levels that the largest values were drawn from and wanted at, in false colours.
var<private> largest_from: array<vec2u, SLOTS>;

// The surface that ends a ray: its channel, its level and the one wanted, and where it is.
var<private> surface: u32;
var<private> surface_level: u32;
var<private> surface_wanted: u32;
var<private> surface_at: vec3f;
// How far ahead of the first sample it is; nothing there is farther.
var<private> hit_at: f32;
// Light that comes through to it; 0 where there is none.
var<private> surface_light: f32;
// Whether the ray began in it: it is cut there. And the normal of the face or plane the ray begins at, 0 at the eye.
var<private> surface_is_cut: bool;
var<private> cut_normal: vec3f;

// Draws a channel from what was found.
fn draw_from(channel: u32, here: Source) {
    let bit = 1u << channel;
    var unseen = true;
    if here.found.entry >= FIRST_SLOT {
        let slot = here.found.entry - FIRST_SLOT;
        mark_brick_used(slot);
        unseen = is_transparent(channel, slot);
    }
    if SLOTS > 1u {
        let distance = i32(here.level) - i32(drawn_for[channel]);
        let stands_in = here.found.entry >= FIRST_SLOT && distance != 0;
        elsewhere = select(elsewhere & ~bit, elsewhere | bit, stands_in);
        substituted_levels = max(substituted_levels, select(0u, u32(abs(distance)), stands_in));
    }
    missing = select(missing & ~bit, missing | bit, here.found.entry < EMPTY);
    transparent = select(transparent & ~bit, transparent | bit, unseen);
    drawn[channel] = here;
}

// Looks up what is drawn of a channel from `depth` on; whether that is all there is to it.
fn look_up(channel: u32, grid: Grid, depth: f32) -> bool {
    let here = source(channel, grid, depth);
    drawn_for[channel] = grid.level;
    draw_from(channel, here);
    return here.found.entry >= FIRST_SLOT && !here.found.stale;
}

// The rest of a look-up: reports what is missing or stale and draws the nearest level that is there instead,
// coarser ones first [001 alg. 7.2]; passes in one step what coarser levels know to be empty as well.
fn look_further(channel: u32, depth: f32, ray: vec3f, urgency: f32) {
    let wanted = drawn[channel];
    let lacks = wanted.found.entry < EMPTY;
    if lacks || wanted.found.stale {
        mark_missed(wanted.found, urgency);
    }
    let widens = wanted.found.entry == EMPTY && !wanted.found.stale;
    let first_level = channel_of(channel).first_level;
    let coarsest = channel_of(channel).last_level;
    let preview = min(wanted.level + PREVIEW_LEVELS, coarsest);
    var coarser = 0u;
    var finer = 0u;
    if lacks && has_flag(FLAG_SUBSTITUTE) {
        var there = 0xffffffffu;
        if channel_has(channel, CHANNEL_RESIDENCY) {
            there = levels_around(channel, cell_at(depth, ray));
        }
        var asked_for = 0u;
        if misses_left > 0u {
            asked_for = (1u << coarsest) | (1u << preview);
        }
        coarser = (there | asked_for) & bits_below(coarsest + 1u) & ~bits_below(wanted.level + 1u);
        let finest = max(wanted.level - min(wanted.level, FINER_SUBSTITUTES), first_level);
        finer = there & bits_below(wanted.level) & ~bits_below(finest);
    } else if widens {
        coarser = bits_below(level_count()) & ~bits_below(wanted.level + 1u);
    }
    var here = wanted;
    while (coarser | finer) != 0u {
        let is_coarser = coarser != 0u;
        let level = select(firstLeadingBit(finer), firstTrailingBit(coarser), is_coarser);
        if is_coarser {
            coarser &= coarser - 1u;
        } else {
            finer &= bits_below(level);
        }
        let other = source(channel, grid_of(level, ray), depth);
        if widens {
            if other.found.entry != EMPTY || other.found.stale {
                break;
            }
            here.leaving = max(here.leaving, other.leaving);
        } else if other.found.entry >= FIRST_SLOT || (is_coarser && other.found.entry >= EMPTY) {
            here = other;
            here.leaving = min(other.leaving, wanted.leaving);
            break;
        } else if is_coarser && (level == coarsest || level == preview) {
            // Few bricks, soon there: before all others, and the one that shows everything first.
            mark_missed(other.found, urgency * select(1e-3, 1e-6, level == coarsest));
        }
    }
    draw_from(channel, here);
}

// Lowest corner of the brick that is drawn [texels].
fn corner_of(channel: u32) -> vec3f {
    let here = drawn[channel];
    // Whole numbers below 2^22: exact, and quicker than dividing integers.
    let grid = steady.brick_grid;
    let slot = f32(here.found.entry - FIRST_SLOT) + 0.5;
    let row = floor(slot / grid.x);
    let layer = floor(slot / (grid.x * grid.y));
    let cell = vec3f(floor(slot) - row * grid.x, row - layer * grid.y, layer);
    return cell * f32(BRICK_STORED_EDGE) + f32(BRICK_BORDER);
}

// Where samples from `depth` on lie in the brick cache.
fn aim(channel: u32, depth: f32) {
    let here = drawn[channel];
    let corner = corner_of(channel);
    low_texel[channel] = corner * texel;
    first_texel[channel] = (corner + here.eye + depth * here.voxels) * texel;
    texels_of_all = here.voxels * texel;
    texels_per_depth[channel] = texels_of_all;
}

// Where samples lie in one brick of a row, the first of the row at `depth`, and with which sample it begins.
fn aim_in_row(index: u32, turn: f32, depth: f32) {
    let here = drawn[0];
    let corner = corner_of(0u);
    let low = corner * texel;
    let first = (corner + here.eye + depth * here.voxels) * texel;
    if index == 0u {
        low_texel[0] = low;
        first_texel[0] = first;
        texels_per_depth[0] = here.voxels * texel;
        turns = vec2f(3e38);
    } else if index == 1u {
        next_low[0] = low;
        next_texel[0] = first;
        turns.x = turn;
    } else {
        next_low[1] = low;
        next_texel[1] = first;
        turns.y = turn;
    }
}

// The stored value at a place in the brick cache, as the sampler counts, from 0 to 1.
fn stored_at(at: vec3f) -> f32 {
    if JOINED {
        return stored_of_parts(at);
    }
    return textureSampleLevel(bricks, bricks_sampler, at, 0.0).r;
}

// Interpolated from two parts of 8 bit. Samplers may round each part to 8 bit again, which is
// too much of the high one; so the eight texels are joined first.
fn stored_of_parts(at: vec3f) -> f32 {
    let low = floor(at - 0.5);
    var t = at - 0.5 - low;
    if has_flag(FLAG_NEAREST) {
        t = round(t);
    }
    let texel = vec3i(low);
    let x0 = vec4f(
        joined(texel),
        joined(texel + vec3i(0, 1, 0)),
        joined(texel + vec3i(0, 0, 1)),
        joined(texel + vec3i(0, 1, 1)),
    );
    let x1 = vec4f(
        joined(texel + vec3i(1, 0, 0)),
        joined(texel + vec3i(1, 1, 0)),
        joined(texel + vec3i(1, 0, 1)),
        joined(texel + vec3i(1, 1, 1)),
    );
    let along_x = mix(x0, x1, t.x);
    let along_y = mix(along_x.xz, along_x.yw, t.y);
    return mix(along_y.x, along_y.y, t.z);
}

fn joined(texel: vec3i) -> f32 {
    return dot(textureLoad(bricks, texel, 0).rg, frame.combine);
}

// A place in a channel's brick: of a sample, by its number in the row of bricks, so far ahead of the first. `alike` where all channels are
// drawn from one level: what is addressed by number is slow to read.
fn in_brick(channel: u32, number: f32, ahead: f32, alike: bool) -> vec3f {
    var first = first_texel[channel];
    var low = low_texel[channel];
    if SLOTS == 1u {
        first = select(first, next_texel[0], number >= turns.x);
        first = select(first, next_texel[1], number >= turns.y);
        if BOUNDED {
            low = select(low, next_low[0], number >= turns.x);
            low = select(low, next_low[1], number >= turns.y);
        }
    }
    var way = texels_per_depth[channel];
    if SLOTS > 1u && alike {
        way = texels_of_all;
    }
    let at = first + ahead * way;
    if BOUNDED {
        return clamp(at, low, low + f32(BRICK_EDGE) * texel);
    }
    return at;
}

// Takes a sample of a channel, by its number in the row of bricks, so far ahead of the first; `alike` as there. Linear RGB and extinction of it, or
// what the mode keeps of it.
fn sampled_at(channel: u32, number: f32, ahead: f32, step: f32, alike: bool) -> vec4f {
    let stored = stored_at(in_brick(channel, number, ahead, alike));
    if MODE == MODE_EMISSION_ABSORPTION {
        let color = color_of(channel, stored);
        return vec4f(false_color(color.rgb, drawn[channel].level, drawn_for[channel]), color.a);
    }
    if MODE == MODE_MAXIMUM {
        if FALSE_COLORS != FALSE_NONE && stored > largest_seen[channel] {
            largest_from[channel] = vec2u(drawn[channel].level, drawn_for[channel]);
        }
        largest_seen[channel] = max(largest_seen[channel], stored);
    } else {
        let iso = channel_of(channel).iso;
        let before = sample_before[channel];
        sample_before[channel] = stored;
        if stored >= iso {
            let rise = stored - before;
            let back = select(0.0, (stored - iso) / rise, rise > 0.0 && before < iso);
            let at = ahead - back * step;
            if at < hit_at {
                hit_at = at;
                surface = channel;
                surface_level = drawn[channel].level;
                surface_wanted = drawn_for[channel];
                surface_at = in_brick(channel, number, at, alike);
            }
        }
    }
    return vec4f(0.0);
}

fn largest_of(color: vec3f) -> f32 {
    return max(color.r, max(color.g, color.b));
}

// The colour of a channel's surface: of its value, but bright enough to be seen; in the hue of the brighter end of the table where
// its own is black.
fn surface_color(channel: u32) -> vec3f {
    let own = color_of(channel, channel_of(channel).iso).rgb;
    let low = textureLoad(colors, vec2u(1u, channel), 0).rgb;
    let high = textureLoad(colors, vec2u(TABLE_LEN - 1u, channel), 0).rgb;
    let end = select(low, high, largest_of(high) >= largest_of(low));
    let hue = select(end, own, largest_of(own) > 1e-3);
    let bright = hue * (SURFACE_LIGHT / max(largest_of(hue), 1e-6));
    return select(bright, own, largest_of(own) >= SURFACE_LIGHT);
}

// Light from the surface that ended the ray: as bright as it faces the eye.
fn lit_surface(ray: vec3f) -> vec3f {
    let x = vec3f(0.5, 0.0, 0.0) * texel;
    let y = vec3f(0.0, 0.5, 0.0) * texel;
    let z = vec3f(0.0, 0.0, 0.5) * texel;
    let at = surface_at;
    let slope = vec3f(
        stored_at(at + x) - stored_at(at - x),
        stored_at(at + y) - stored_at(at - y),
        stored_at(at + z) - stored_at(at - z),
    );
    let gradient = slope * frame.levels[surface_level].voxels_per_nm;
    // What is cut shows the cut: how values change there is no shape.
    let normal = select(gradient, cut_normal, surface_is_cut);
    let facing = abs(dot(normal, ray)) / max(length(normal) * length(ray), 1e-30);
    // Where values do not change there is no surface to light: as if it faced the eye.
    let diffuse = select(facing, 1.0, length(normal) <= 1e-30);
    let color = surface_color(surface);
    return false_color(color, surface_level, surface_wanted) * (0.15 + 0.85 * diffuse);
}

// Loops, from the outside: look-ups that find no brick at once; stretches of one level and step; regions with
// nothing to see; bricks; samples.
// Channels whose samples do not go on from one place to the next have none before.
fn nothing_before(channels: u32) {
    if MODE == MODE_ISO_SURFACE {
        for (var c = 0u; c < channel_count(); c += 1u) {
            sample_before[c] = select(sample_before[c], 0.0, ((channels >> c) & 1u) != 0u);
        }
    }
}

// The light of a pixel's ray. One that is not `inside` the picture has none, but sets out together with the others.
fn trace(pixel: vec2u, inside: bool) -> vec3f {
    let from_middle = (vec2f(pixel) + 0.5) / vec2f(frame.size) * 2.0 - 1.0;
    let ray = frame.forward + from_middle.x * frame.right + from_middle.y * frame.down;
    let nm_per_depth = length(ray);
    var depths = box_depths(frame.low_nm, frame.high_nm, ray);
    cut_normal = entered_face(frame.low_nm, frame.high_nm, ray);
    for (var p = 0u; p < MOST_PLANES; p += 1u) {
        let before = depths.x;
        depths = clipped_depths(depths, frame.planes[p], ray);
        cut_normal = select(cut_normal, frame.planes[p].xyz, depths.x > before);
    }
    let urgency = 1.0 + dot(from_middle, from_middle);
    let sample_at = select(0.5, pixel_noise(pixel), has_flag(FLAG_JITTER));
    let everything = all_channels();
    texel = select(1.0 / (steady.brick_grid * f32(BRICK_STORED_EDGE)), vec3f(1.0), JOINED);

    var light = vec3f(0.0);
    var transmitted = 1.0;
    // What was transmitted when the last row of bricks began; more than can be where none did.
    var row_light = 2.0;
    var start = depths.x;
    var level = 0u;
    var level_end = -1.0;
    var segments = 0u;
    // Channels whose brick is not simply there, and those that were looked for further.
    var lost = 0u;
    var found = 0u;
    missing = 0u;
    transparent = 0u;
    surface_light = 0.0;
    for (var c = 0u; c < channel_count(); c += 1u) {
        drawn_for[c] = MAX_LEVELS;
        largest_seen[c] = 0.0;
        sample_before[c] = 0.0;
    }
    rays = select(0u, 1u, inside && start < depths.y && level_count() > 0u);
    var going = rays > 0u;
    while going {
        var depth = start;
        loop {
            if start >= level_end {
                loop {
                    if level_end >= 0.0 {
                        level += 1u;
                    }
                    level_end = depth_of_next(level, ray);
                    continuing {
                        break if start < level_end;
                    }
                }
            }
            var finest_drawn = MAX_LEVELS;
            for (var c = 0u; c < channel_count(); c += 1u) {
                finest_drawn = min(finest_drawn, channel_level(c, level));
            }
            finest = min(finest, finest_drawn);
            let deepest = deepest_of(level);
            var grid = grid_of(finest_drawn, ray);
            let voxels_per_depth = length(grid.voxels);
            let doublings = min(segments / SEGMENTS_PER_DOUBLING, 64u);
            let step = 0.5 / voxels_per_depth * exp2(f32(doublings));
            // Level and step hold up to here.
            let stretch = min(level_end, depths.y);
            let doubling = (segments / SEGMENTS_PER_DOUBLING + 1u) * SEGMENTS_PER_DOUBLING;

            // Region by region.
            loop {
                // Past regions with nothing to see.
                var region = Region(0u, 0u, 3e38);
                var is_seen = true;
                loop {
                    depth = start + sample_at * min(step, depths.y - start);
                    if has_flag(FLAG_OCTREE) {
                        region = region_at(level, deepest, depth, ray);
                    }
                    is_seen = region.hidden != everything;
                    if is_seen {
                        break;
                    }
                    let count = segments_until(min(stretch + sample_at * step, region.leaving), depth, step);
                    start += f32(count) * step;
                    segments += count;
                    found = 0u;
                    nothing_before(everything);
                    if start >= stretch || segments >= doubling {
                        break;
                    }
                }
                if !is_seen {
                    continue;
                }
                let hidden = region.hidden;
                let around = region.leaving;
                let visible = everything & ~hidden;

                if MODE == MODE_EMISSION_ABSORPTION && (hidden | region.uniform_) == everything {
                    let count = segments_until(min(stretch + sample_at * step, around), depth, step);
                    var sum = vec4f(0.0);
                    for (var c = 0u; c < channel_count(); c += 1u) {
                        if (hidden & (1u << c)) == 0u {
                            let color = color_of(c, uniform_stored[c]);
                            let from_ = channel_level(c, level);
                            sum += vec4f(color.a * false_color(color.rgb, from_, from_), color.a);
                        }
                    }
                    if sum.a > 0.0 {
                        let thickness = max(min(f32(count) * step, depths.y - start), 0.0);
                        let opacity = opacity_of_length(sum.a, thickness * nm_per_depth);
                        light += transmitted * opacity * sum.rgb / sum.a;
                        transmitted *= 1.0 - opacity;
                    }
                    start += f32(count) * step;
                    segments += count;
                    continue;
                }

                // From brick to brick within the region.
                loop {
                    let first = min(step, depths.y - start);
                    depth = start + sample_at * first;
                    lost = 0u;
                    var count = 0u;
                    var sampled = 0u;
                    var forgets = false;
                    if SLOTS == 1u {
                        // Several bricks in a row, which ends after as many segments for all rays that are drawn at once: they wait for each
                        // other there, and not at the end of each brick. Surfaces end rays too soon for that, and what is
                        // behind the end of a ray need not be looked up: the first row is short, and a ray that would end
                        // if the next took as much light as the last did goes on brick by brick.
                        let is_first = row_light > 1.0;
                        let row = select(ROW, FIRST_ROW, is_first);
                        let taken = select(transmitted / row_light, 1.0, is_first);
                        let goes_on = transmitted * taken > TERMINATION;
                        row_light = transmitted;
                        let most_bricks = select(1u, 3u, goes_on && MODE != MODE_ISO_SURFACE);
                        let wanted = grid.level;
                        let most = stretch + sample_at * step;
                        for (var index = 0u; index < most_bricks; index += 1u) {
                            let from_ = start + f32(count) * step;
                            let next = from_ + sample_at * min(step, depths.y - from_);
                            let holds = wanted == drawn_for[0] && next < drawn[0].leaving;
                            let before = vec2u(missing, transparent);
                            if !holds && found == 0u && !look_up(0u, grid, next) {
                                if index == 0u {
                                    lost = 1u;
                                } else {
                                    // The next row begins with it.
                                    forgets = true;
                                    missing = before.x;
                                    transparent = before.y;
                                }
                                break;
                            }
                            found = 0u;
                            if transparent != 0u {
                                // Where nothing of a brick is seen, it is passed as a whole.
                                if index == 0u {
                                    count = segments_until(min(most, drawn[0].leaving), next, step);
                                }
                                break;
                            }
                            aim_in_row(index, f32(count), depth);
                            sampled = 1u;
                            count += segments_until(min(min(most, around), drawn[0].leaving), next, step);
                            if count >= row {
                                count = row;
                                break;
                            }
                            let end = start + f32(count) * step;
                            let last = end + sample_at * min(step, depths.y - end);
                            if index + 1u >= most_bricks || drawn[0].level != wanted || end >= stretch || last >= around || segments + count >= doubling {
                                break;
                            }
                        }
                    } else {
                        var until = stretch + sample_at * step;
                        if hidden != 0u {
                            until = min(until, around);
                        }
                        var rest = visible;
                        for (var n = count_of(visible); n > 0u; n -= 1u) {
                            let c = lowest_of(rest);
                            rest &= rest - 1u;
                            let bit = 1u << c;
                            let wanted = channel_level(c, level);
                            let holds = wanted == drawn_for[c] && depth < drawn[c].leaving;
                            if !holds && (found & bit) == 0u {
                                if wanted != grid.level {
                                    grid = grid_of(wanted, ray);
                                }
                                if !look_up(c, grid, depth) {
                                    lost |= bit;
                                }
                            }
                            // Where nothing of a brick is seen, it is passed as a whole.
                            until = min(until, drawn[c].leaving);
                            if (transparent & bit) == 0u {
                                until = min(until, around);
                            }
                        }
                        found = select(0u, found, lost != 0u);
                        count = segments_until(until, depth, step);
                        sampled = visible & ~transparent;
                    }
                    if lost != 0u {
                        break;
                    }
                    // The last segment of a ray is cut where it leaves the volume: a row of its own, so that all segments of a
                    // row are alike.
                    count = min(count, max(u32((depths.y - start) / step), 1u));
                    let halvings = -LOG2_E * first * nm_per_depth;
                    nothing_before(everything & ~sampled);
                    var alike = true;
                    var level_of_all = MAX_LEVELS;
                    if SLOTS == 1u {
                        if drawn[0].found.entry >= FIRST_SLOT {
                            let distance = i32(drawn[0].level) - i32(drawn_for[0]);
                            if distance != 0 {
                                substituted_levels = max(substituted_levels, u32(abs(distance)));
                                substituted += count;
                            }
                        }
                    } else {
                        substituted += count * countOneBits(elsewhere & visible);
                        var rest = sampled;
                        for (var n = countOneBits(sampled); n > 0u; n -= 1u) {
                            let c = firstTrailingBit(rest);
                            rest &= rest - 1u;
                            aim(c, depth);
                            alike = alike && (level_of_all == MAX_LEVELS || level_of_all == drawn[c].level);
                            level_of_all = drawn[c].level;
                        }
                    }
                    let end = f32(count);
                    var i = 0.0;
                    // Channels of several levels, which are few, are sampled below.
                    if sampled != 0u && (SLOTS == 1u || alike) {
                        loop {
                            let ahead = i * step;
                            var sum = vec4f(0.0);
                            hit_at = 3e38;
                            if SLOTS == 1u {
                                sum = sampled_at(0u, i, ahead, step, true);
                            } else {
                                var rest = sampled;
                                for (var n = countOneBits(sampled); n > 0u; n -= 1u) {
                                    let color = sampled_at(firstTrailingBit(rest), i, ahead, step, true);
                                    rest &= rest - 1u;
                                    sum += vec4f(color.a * color.rgb, color.a);
                                }
                            }
                            if MODE == MODE_EMISSION_ABSORPTION {
                                let through = transmitted * exp2(sum.a * halvings);
                                let share = select(1.0 / max(sum.a, 1e-30), 1.0, SLOTS == 1u);
                                light += (transmitted - through) * share * sum.rgb;
                                transmitted = through;
                            }
                            if MODE == MODE_ISO_SURFACE && hit_at < 3e38 {
                                surface_is_cut = segments == 0u && i == 0.0;
                                surface_light = transmitted;
                                transmitted = 0.0;
                            }
                            i += 1.0;
                            continuing {
                                break if i >= end || transmitted <= TERMINATION;
                            }
                        }
                    }
                    if SLOTS > 1u && sampled != 0u && !alike {
                        loop {
                            let ahead = i * step;
                            var sum = vec4f(0.0);
                            hit_at = 3e38;
                            var rest = sampled;
                            for (var n = countOneBits(sampled); n > 0u; n -= 1u) {
                                let color = sampled_at(firstTrailingBit(rest), i, ahead, step, false);
                                rest &= rest - 1u;
                                sum += vec4f(color.a * color.rgb, color.a);
                            }
                            if MODE == MODE_EMISSION_ABSORPTION {
                                let through = transmitted * exp2(sum.a * halvings);
                                light += (transmitted - through) / max(sum.a, 1e-30) * sum.rgb;
                                transmitted = through;
                            }
                            if MODE == MODE_ISO_SURFACE && hit_at < 3e38 {
                                surface_is_cut = segments == 0u && i == 0.0;
                                surface_light = transmitted;
                                transmitted = 0.0;
                            }
                            i += 1.0;
                            continuing {
                                break if i >= end || transmitted <= TERMINATION;
                            }
                        }
                    }
                    samples += u32(i) * countOneBits(sampled);
                    if FALSE_COLORS == FALSE_RESIDENCY && (missing & ~hidden) != 0u {
                        // A thin magenta fog: half the light is gone after 64 voxels.
                        let voxels = f32(count) * step * voxels_per_depth;
                        let opacity = 1.0 - exp2(-voxels / 64.0);
                        light += transmitted * opacity * vec3f(0.6, 0.0, 0.4);
                        transmitted *= 1.0 - opacity;
                    }
                    start += f32(count) * step;
                    segments += count;
                    if forgets {
                        drawn_for[0] = MAX_LEVELS;
                    }
                    depth = start + sample_at * min(step, depths.y - start);
                    if depth >= around || start >= stretch || segments >= doubling || transmitted <= TERMINATION {
                        break;
                    }
                }
                continuing {
                    going = start < depths.y && transmitted > TERMINATION;
                    break if lost != 0u || !going || start >= stretch || segments >= doubling;
                }
            }
            continuing {
                break if lost != 0u || !going;
            }
        }
        if !going {
            break;
        }
        for (var c = 0u; c < channel_count(); c += 1u) {
            let bit = 1u << c;
            if (lost & bit) != 0u {
                look_further(c, depth, ray, depth * urgency * f32(1u + channel_of(c).coarser));
                found |= bit;
            }
        }
        lost = 0u;
    }
    if MODE == MODE_ISO_SURFACE && surface_light > 0.0 {
        light += surface_light * lit_surface(ray);
    }
    if MODE == MODE_MAXIMUM {
        // The light of what was met, or the background where nothing was.
        var met = false;
        for (var c = 0u; c < channel_count(); c += 1u) {
            if largest_seen[c] > 0.0 {
                let color = color_of(c, largest_seen[c]).rgb;
                light += transmitted * false_color(color, largest_from[c].x, largest_from[c].y);
                met = true;
            }
        }
        if met {
            return light;
        }
    }
    return light + transmitted * frame.background;
}

// What is drawn instead of the volume, if asked for: how much work a ray was.
fn heat_of(color: vec3f) -> vec3f {
    switch frame.heat | nothing {
        case HEAT_LOOKUPS: {
            return heat_color(f32(lookups) / frame.heat_full);
        }
        case HEAT_NODES: {
            return heat_color(f32(nodes_visited) / frame.heat_full);
        }
        case HEAT_SAMPLES: {
            return heat_color(f32(samples) / frame.heat_full);
        }
        default: {
            return color;
        }
    }
}

@compute @workgroup_size(WORKGROUP, WORKGROUP)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    // Neighbours in both directions are drawn together: their rays meet the same bricks.
    let within = vec2u(
        (local & 3u) | ((local >> 1u) & 4u),
        ((local >> 2u) & 1u) | ((local >> 3u) & 6u),
    );
    nothing = group.x >> 31u;
    read_steady();
    let pixel = group.xy * WORKGROUP + within + vec2u(0u, frame.first_row);
    let inside = all(pixel < frame.size);
    let traced = trace(pixel, inside);
    if inside {
        let color = heat_of(traced);
        textureStore(image, pixel, vec4f(srgb_from_linear(color), 1.0));
        add_to(COUNT_SAMPLES, samples);
        add_to(COUNT_LOOKUPS, lookups);
        add_to(COUNT_NODES, nodes_visited);
        add_to(COUNT_SUBSTITUTED, substituted);
        raise(MOST_SUBSTITUTED_LEVELS, substituted_levels);
        // Counted from the top, since zero means that no ray met the volume.
        raise(FINEST_LEVEL, MAX_LEVELS - finest);
        add_to(COUNT_RAYS, rays);
        if rays > 0u {
            raise(MOST_LOOKUPS, lookups);
            // Counted from the top as well.
            raise(FEWEST_LOOKUPS, 0xffffffffu - lookups);
        }
    }
    hand_over(local);
}
