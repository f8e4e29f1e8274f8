// One ray per pixel, front to back, through whatever bricks are there.
//
// A ray is cut into segments of half a voxel of the level wanted at their start, measured along the
// ray; each is sampled once. The residency octree tells which can be skipped; other bricks are
// looked up one by one, and all segments in one are sampled without further lookups. See the crate's documentation for the rules an image follows.

@group(0) @binding(7) var bricks: texture_3d<f32>;
@group(0) @binding(8) var bricks_sampler: sampler;
@group(0) @binding(9) var image: texture_storage_2d<rgba8unorm, write>;

// Light that is left when a ray ends: less than one step of the picture even on white.
const TERMINATION = 0.000244140625;
// After so many segments a ray's steps double, and again after as many: all rays end.
const SEGMENTS_PER_DOUBLING = 8192u;
// Levels finer than wanted that may stand in, when no coarser one does.
const FINER_SUBSTITUTES = 2u;
// A substitute so many levels away is too coarse: the level this far away is asked for as well.
const PREVIEW_LEVELS = 2u;

var<workgroup> tallies: array<atomic<u32>, TALLIES>;

var<private> samples: u32;
var<private> substituted: u32;
var<private> substituted_levels: u32;
var<private> finest: u32 = MAX_LEVELS;

// A brick position: which, and where its low corner is.
struct Place {
    brick: vec3u,
    low: vec3f, // [voxels of the level from the anchor's low corner]
}

fn place_of(level: u32, depth: f32, ray: vec3f) -> Place {
    let at = frame.levels[level].eye + depth * ray * frame.levels[level].voxels_per_nm;
    let anchor = frame.levels[level].anchor;
    let last = vec3i(frame.levels[level].bricks) - 1;
    // Far beyond any volume, yet safe to convert.
    let steps = clamp(floor(at / f32(BRICK_EDGE)), vec3f(-1e9), vec3f(1e9));
    let brick = clamp(anchor + vec3i(steps), vec3i(0), last);
    return Place(vec3u(brick), vec3f(brick - anchor) * f32(BRICK_EDGE));
}

// Depth at which a ray leaves the cube of `1 << span_log2` bricks that a brick is in.
fn leaving(level: u32, place: Place, span_log2: u32, ray: vec3f) -> f32 {
    let first = (place.brick >> vec3u(span_log2)) << vec3u(span_log2);
    let low = place.low - vec3f(place.brick - first) * f32(BRICK_EDGE);
    let high = low + f32(BRICK_EDGE << span_log2);
    let voxels = ray * frame.levels[level].voxels_per_nm;
    return leaving_depth(low, high, frame.levels[level].eye, voxels);
}

fn is_transparent(slot: u32) -> bool {
    let range = slot_ranges[slot];
    let low = range & 0xffu;
    let high = (range >> 8u) & 0xffu;
    return is_range_hidden(low, high);
}

fn color_of(stored: f32) -> vec4f {
    let x = clamp(stored, 0.0, 1.0) * f32(TABLE_LEN - 1u);
    let i = min(u32(x), TABLE_LEN - 2u);
    return mix(transfer.colors[i], transfer.colors[i + 1u], x - f32(i));
}

// What is drawn for a stretch of the ray.
struct Source {
    level: u32,
    found: Found,
    place: Place,
    leaving: f32, // depth up to which it holds
}

fn source(level: u32, depth: f32, ray: vec3f) -> Source {
    let place = place_of(level, depth, ray);
    let found = find(level, place.brick);
    return Source(level, found, place, leaving(level, place, found.span_log2, ray));
}

fn is_known(found: Found) -> bool {
    return found.entry >= EMPTY;
}

// Empty space known to be empty in coarser levels too is skipped in one step.
fn widened(empty: Source, depth: f32, ray: vec3f) -> Source {
    var wide = empty;
    for (var level = empty.level + 1u; level < frame.level_count; level += 1u) {
        let coarser = source(level, depth, ray);
        if coarser.found.entry != EMPTY || coarser.found.stale {
            break;
        }
        wide.leaving = max(wide.leaving, coarser.leaving);
    }
    return wide;
}

// Bits below one.
fn bits_below(bit: u32) -> u32 {
    return select((1u << bit) - 1u, 0xffffffffu, bit >= 32u);
}

// The nearest level that is there, coarser ones first [001 alg. 7.2].
fn substitute(wanted: Source, depth: f32, ray: vec3f, urgency: f32) -> Source {
    var there = 0xffffffffu;
    if (frame.flags & FLAG_RESIDENCY) != 0u {
        there = levels_around(cell_at(depth, ray));
    }
    let coarsest = frame.level_count - 1u;
    let preview = min(wanted.level + PREVIEW_LEVELS, coarsest);
    var asked_for = 0u;
    if misses_left > 0u {
        asked_for = (1u << coarsest) | (1u << preview);
    }
    var coarser = (there | asked_for) & bits_below(frame.level_count) & ~bits_below(wanted.level + 1u);
    while coarser != 0u {
        let level = firstTrailingBit(coarser);
        coarser &= coarser - 1u;
        var other = source(level, depth, ray);
        if is_known(other.found) {
            other.leaving = min(other.leaving, wanted.leaving);
            return other;
        }
        // Few bricks, soon there: before all others, and the one that shows everything first.
        if level == coarsest {
            mark_missed(other.found, urgency * 1e-6);
        } else if level == preview {
            mark_missed(other.found, urgency * 1e-3);
        }
    }
    let finest = wanted.level - min(wanted.level, FINER_SUBSTITUTES);
    var finer = there & bits_below(wanted.level) & ~bits_below(finest);
    while finer != 0u {
        let level = firstLeadingBit(finer);
        finer &= bits_below(level);
        var other = source(level, depth, ray);
        if other.found.entry >= FIRST_SLOT {
            other.leaving = min(other.leaving, wanted.leaving);
            return other;
        }
    }
    return wanted;
}

// Depth at which the level after this one is wanted: where a voxel's size is as far from one
// level as from the other, in their ratio.
fn depth_of_next(level: u32, ray: vec3f) -> f32 {
    if level + 1u >= frame.level_count {
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

fn trace(pixel: vec2u) -> vec3f {
    let from_middle = (vec2f(pixel) + 0.5) / vec2f(frame.size) * 2.0 - 1.0;
    let ray = frame.forward + from_middle.x * frame.right + from_middle.y * frame.down;
    let nm_per_depth = length(ray);
    let depths = box_depths(frame.low_nm, frame.high_nm, ray);
    let urgency = 1.0 + dot(from_middle, from_middle);
    let sample_at = select(0.5, pixel_noise(pixel), (frame.flags & FLAG_JITTER) != 0u);
    let false_colors = (frame.flags & FLAG_FALSE_COLORS) != 0u;

    var light = vec3f(0.0);
    var transmitted = 1.0;
    var start = depths.x;
    var level = 0u;
    var level_end = -1.0;
    var segments = 0u;
    // What is drawn, found for a sample of some level; holds for more of them.
    var drawn: Source;
    var drawn_for = frame.level_count;
    var missing = false;
    var transparent = false;
    while start < depths.y && transmitted > TERMINATION && frame.level_count > 0u {
        while start >= level_end {
            if level_end >= 0.0 {
                level += 1u;
            }
            level_end = depth_of_next(level, ray);
        }
        finest = min(finest, level);

        let voxels_per_depth = length(ray * frame.levels[level].voxels_per_nm);
        let doublings = min(segments / SEGMENTS_PER_DOUBLING, 64u);
        let step = 0.5 / voxels_per_depth * exp2(f32(doublings));
        let first = min(step, depths.y - start);
        let depth = start + sample_at * first;

        // Depth of the first sample that may need another level, and of the ray's end.
        var until = min(level_end + sample_at * step, depths.y + sample_at * step);
        if (frame.flags & FLAG_OCTREE) != 0u {
            let region = region_at(level, depth, ray);
            until = min(until, region.leaving);
            if region.hidden || region.uniform_ {
                let count = segments_until(until, depth, step);
                if !region.hidden {
                    let color = color_of(region.stored);
                    let thickness = max(min(f32(count) * step, depths.y - start), 0.0);
                    let opacity = opacity_of_length(color.a, thickness * nm_per_depth);
                    light += transmitted * opacity * color.rgb;
                    transmitted *= 1.0 - opacity;
                }
                start += f32(count) * step;
                segments += count;
                continue;
            }
        }

        if level != drawn_for || depth >= drawn.leaving {
            drawn = source(level, depth, ray);
            drawn_for = level;
            missing = drawn.found.entry < EMPTY;
            if missing || drawn.found.stale {
                mark_missed(drawn.found, depth * urgency);
            }
            if missing && (frame.flags & FLAG_SUBSTITUTE) != 0u {
                drawn = substitute(drawn, depth, ray, depth * urgency);
                missing = drawn.found.entry < EMPTY;
            } else if drawn.found.entry == EMPTY && !drawn.found.stale {
                drawn = widened(drawn, depth, ray);
            }
            transparent = true;
            if drawn.found.entry >= FIRST_SLOT {
                let slot = drawn.found.entry - FIRST_SLOT;
                mark_brick_used(slot);
                transparent = is_transparent(slot);
            }
        }
        if transparent {
            // Nothing to sample, as far as this brick goes.
            until = min(level_end + sample_at * step, depths.y + sample_at * step);
        }
        until = min(until, drawn.leaving);
        let count = segments_until(until, depth, step);

        if drawn.found.entry >= FIRST_SLOT {
            let slot = drawn.found.entry - FIRST_SLOT;
            let distance = i32(drawn.level) - i32(level);
            if distance != 0 {
                substituted_levels = max(substituted_levels, u32(abs(distance)));
                substituted += count;
            }
            if !transparent {
                let grid = frame.brick_grid;
                let cell = vec3u(slot % grid.x, slot / grid.x % grid.y, slot / (grid.x * grid.y));
                let corner = vec3f(cell * BRICK_STORED_EDGE + BRICK_BORDER);
                let texel = 1.0 / vec3f(grid * BRICK_STORED_EDGE);
                let voxels = ray * frame.levels[drawn.level].voxels_per_nm;
                let begin = frame.levels[drawn.level].eye - drawn.place.low + depth * voxels;
                for (var i = 0u; i < count && transmitted > TERMINATION; i += 1u) {
                    let segment = min(step, depths.y - start - f32(i) * step);
                    let ahead = f32(i) * step + sample_at * (segment - first);
                    let in_brick = clamp(begin + ahead * voxels, vec3f(0.0), vec3f(f32(BRICK_EDGE)));
                    let at = (corner + in_brick) * texel;
                    let stored = textureSampleLevel(bricks, bricks_sampler, at, 0.0).r;
                    var color = color_of(stored);
                    if color.a > 0.0 {
                        if false_colors && distance != 0 {
                            color = vec4f(mix(color.rgb, substitution_tint(distance), 0.5), color.a);
                        }
                        let opacity = opacity_of_length(color.a, max(segment, 0.0) * nm_per_depth);
                        light += transmitted * opacity * color.rgb;
                        transmitted *= 1.0 - opacity;
                    }
                    samples += 1u;
                }
            }
        } else if missing && false_colors {
            // A thin magenta fog: half the light is gone after 64 voxels.
            let voxels = f32(count) * step * voxels_per_depth;
            let opacity = 1.0 - exp2(-voxels / 64.0);
            light += transmitted * opacity * vec3f(0.6, 0.0, 0.4);
            transmitted *= 1.0 - opacity;
        }
        start += f32(count) * step;
        segments += count;
    }
    return light + transmitted * frame.background;
}

@compute @workgroup_size(WORKGROUP, WORKGROUP)
fn main(
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let pixel = vec2u(id.x, id.y + frame.first_row);
    if all(pixel < frame.size) {
        let color = trace(pixel);
        textureStore(image, pixel, vec4f(srgb_from_linear(color), 1.0));
        atomicAdd(&tallies[COUNT_SAMPLES], samples);
        atomicAdd(&tallies[COUNT_LOOKUPS], lookups);
        atomicAdd(&tallies[COUNT_NODES], nodes_visited);
        atomicAdd(&tallies[COUNT_SUBSTITUTED], substituted);
        atomicMax(&tallies[MOST_SUBSTITUTED_LEVELS], substituted_levels);
        // Counted from the top, since zero means that no ray met the volume.
        atomicMax(&tallies[FINEST_LEVEL], MAX_LEVELS - finest);
    }
    workgroupBarrier();
    if local == 0u {
        atomicAdd(&report[COUNT_SAMPLES], atomicLoad(&tallies[COUNT_SAMPLES]));
        atomicAdd(&report[COUNT_LOOKUPS], atomicLoad(&tallies[COUNT_LOOKUPS]));
        atomicAdd(&report[COUNT_NODES], atomicLoad(&tallies[COUNT_NODES]));
        atomicAdd(&report[COUNT_SUBSTITUTED], atomicLoad(&tallies[COUNT_SUBSTITUTED]));
        atomicMax(&report[MOST_SUBSTITUTED_LEVELS], atomicLoad(&tallies[MOST_SUBSTITUTED_LEVELS]));
        atomicMax(&report[FINEST_LEVEL], atomicLoad(&tallies[FINEST_LEVEL]));
    }
}
