// One ray per pixel, front to back, through whatever bricks are there, for all channels that are seen.
//
// A ray is cut into segments of half a voxel of the finest level drawn at their start, measured along the
// ray, or along the axis along which it passes most voxels; each is sampled once. The residency octree tells which can be skipped; other bricks are
// looked up one by one, and all segments in one are sampled without further lookups. See the crate's documentation for the rules an image follows.
//
// Rays drawn at once wait for each other, and drivers that draw on the CPU run both sides of every
// `if`. So what few need stands in an outer loop, and what all need in an inner one.
// Loops end where their body ends, since rays that are done are drawn along up to there.

@group(0) @binding(9) var image: texture_storage_2d<rgba8unorm, write>;

// Segments of a row of bricks, of the first and of the others.
const FIRST_ROW = 32u;
const ROW = 64u;
// After so many segments a ray's steps double, and again after as many: all rays end.
const SEGMENTS_PER_DOUBLING = 8192u;

// Whether samples lie in the planes that voxels' middles, and their faces, lie in: those across the axis along which a ray passes most, and
// where it crosses others' middles in between, there as well. Where values are summed, that would be no better than anywhere else; where
// single ones count, what is one voxel thin is met in its middle, however it lies and is looked at.
const IN_PLANES = MODE != MODE_EMISSION_ABSORPTION;
// What is so close to a plane, in steps, lies in it.
const IN_PLANE = 0.00390625;

var<private> rays: u32;
var<private> substituted: u32;
var<private> finest: u32 = MAX_LEVELS;

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

// The axis along which a way is longest, the first of those that are equal.
fn main_axis(way: vec3f) -> vec3<bool> {
    let lengths = abs(way);
    let most = largest_of(lengths);
    let is_x = lengths.x == most;
    let is_y = !is_x && lengths.y == most;
    return vec3<bool>(is_x, is_y, !is_x && !is_y);
}

// Where in its segments, of `step` each, a ray is in planes of voxels [0, 1]. The first sample is never where the ray begins: there, at the
// volume's faces, half of a value is seen.
fn at_planes(grid: Grid, start: f32, step: f32) -> f32 {
    let most = largest_of(abs(grid.voxels));
    let axis = select(vec3f(0.0), vec3f(1.0), main_axis(grid.voxels));
    // The middles of voxels are planes at any step.
    let at = dot(grid.eye + start * grid.voxels - 0.5, axis);
    // Numbers of objects change at voxels' faces, where rounding would decide: between the planes they are those of the voxel.
    let aside = select(0.0, 0.5, has_flag(FLAG_NEAREST));
    let along = select(-at, at, dot(grid.voxels, axis) >= 0.0) / (step * most) + aside;
    return min(ceil(along + IN_PLANE) - along, 1.0);
}

// Depth of the sample of a segment that begins at `start`, of a ray that ends at `end`.
fn depth_of_sample(start: f32, end: f32, step: f32, sample_at: f32) -> f32 {
    let rest = end - start;
    if IN_PLANES {
        return start + select(sample_at * step, 0.5 * rest, is_cut_short(rest, step, sample_at));
    }
    return start + sample_at * min(step, rest);
}

// Whether a ray ends before the plane of its last segment, which is so long.
fn is_cut_short(rest: f32, step: f32, sample_at: f32) -> bool {
    return sample_at * step >= rest;
}

// How far before the first sample of a row, at `depth`, it is looked for planes [steps, negative], if that is not as for others: up to where
// the ray, or its level and step, `begin`, and in the last segment up to the sample before. 1 where it is as for others.
fn look_back(start: f32, begin: f32, depth: f32, step: f32, sample_at: f32, is_cut: bool) -> f32 {
    let since_start = (depth - start) / step;
    if start <= begin {
        return -since_start;
    }
    return select(1.0, -(1.0 - sample_at + since_start), is_cut);
}

// Loops, from the outside: look-ups that find no brick at once; stretches of one level and step; regions with
// nothing to see; bricks; samples.

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
    var sample_at = select(0.5, pixel_noise(pixel), has_flag(FLAG_JITTER));
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
    held = 0u;
    missing = 0u;
    transparent = 0u;
    elsewhere = 0u;
    surface_light = 0.0;
    for (var c = 0u; c < channel_count(); c += 1u) {
        largest_seen[c] = 0.0;
        sample_before[c] = -1.0;
        beside_before[c] = 0.0;
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
                    held = 0u;
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
            if SLOTS > 1u {
                texels_of_all = grid.voxels * texel;
            }
            let doublings = min(segments / SEGMENTS_PER_DOUBLING, 64u);
            let per_depth = select(voxels_per_depth, largest_of(abs(grid.voxels)), IN_PLANES);
            let step = 0.5 / per_depth * exp2(f32(doublings));
            if IN_PLANES {
                sample_at = at_planes(grid, start, step);
            }
            // Level and step hold up to here.
            let stretch = min(level_end, depths.y);
            let begin = start;
            let doubling = (segments / SEGMENTS_PER_DOUBLING + 1u) * SEGMENTS_PER_DOUBLING;

            // Region by region.
            loop {
                // Past regions with nothing to see.
                var region = Region(0u, 0u, 3e38);
                var is_seen = true;
                loop {
                    depth = depth_of_sample(start, depths.y, step, sample_at);
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
                    depth = depth_of_sample(start, depths.y, step, sample_at);
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
                        let most = stretch + sample_at * step;
                        for (var index = 0u; index < most_bricks; index += 1u) {
                            let from_ = start + f32(count) * step;
                            let next = depth_of_sample(from_, depths.y, step, sample_at);
                            let holds = held != 0u && next < drawn.leaving;
                            if !holds && found == 0u {
                                let place = place_of(grid, next);
                                if !look_up(0u, grid, place, leaving(grid, place, 0u)) {
                                    if index == 0u {
                                        lost = 1u;
                                    } else {
                                        // The next row begins with it.
                                        forgets = true;
                                    }
                                    break;
                                }
                            }
                            found = 0u;
                            if transparent != 0u {
                                // Where nothing of a brick is seen, it is passed as a whole.
                                if index == 0u {
                                    count = segments_until(min(most, drawn.leaving), next, step);
                                }
                                break;
                            }
                            aim_in_row(index, f32(count), depth);
                            sampled = 1u;
                            count += segments_until(min(min(most, around), drawn.leaving), next, step);
                            if count >= row {
                                count = row;
                                break;
                            }
                            let end = start + f32(count) * step;
                            let last = depth_of_sample(end, depths.y, step, sample_at);
                            if index + 1u >= most_bricks || elsewhere != 0u || end >= stretch || last >= around || segments + count >= doubling {
                                break;
                            }
                        }
                    } else {
                        var until = stretch + sample_at * step;
                        if hidden != 0u {
                            until = min(until, around);
                        }
                        // Where the bricks of all that want the same level are.
                        var place = place_of(grid, depth);
                        var end = leaving(grid, place, 0u);
                        var rest = visible;
                        for (var n = count_of(visible); n > 0u; n -= 1u) {
                            let c = lowest_of(rest);
                            rest &= rest - 1u;
                            let bit = 1u << c;
                            if !LEVELS_ALIKE {
                                let wanted = channel_level(c, level);
                                if wanted != grid.level {
                                    grid = grid_of(wanted, ray);
                                    place = place_of(grid, depth);
                                    end = leaving(grid, place, 0u);
                                }
                            }
                            let holds = (held & bit) != 0u && depth < holds_until[c];
                            if !holds && (found & bit) == 0u && !look_up(c, grid, place, end) {
                                lost |= bit;
                            }
                            // Where nothing of a brick is seen, it is passed as a whole.
                            until = min(until, holds_until[c]);
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
                    nothing_before(everything & ~sampled);
                    if SLOTS == 1u {
                        substituted += select(0u, count, elsewhere != 0u);
                    } else {
                        substituted += count * countOneBits(elsewhere & visible);
                    }
                    var row = Row(sampled, depth, f32(count), step, -LOG2_E * first * nm_per_depth, segments == 0u, false, 1.0, 0.0);
                    if IN_PLANES {
                        let rest = depths.y - start;
                        row.is_cut = is_cut_short(rest, step, sample_at);
                        row.look_back = look_back(start, begin, depth, step, sample_at, row.is_cut);
                        // Where the next level or step begins, or nothing.
                        let next = start + ceil((stretch - start) / step) * step;
                        row.until = (min(depths.y, next) - depth) / step;
                    }
                    var seen = Seen(light, transmitted);
                    var taken = 0.0;
                    // Channels of several levels, which are few, are sampled below.
                    let alike = SLOTS == 1u || (LEVELS_ALIKE && (elsewhere & sampled) == 0u);
                    if sampled != 0u && alike {
                        seen = sample_row(row, seen, true, &taken);
                    }
                    if SLOTS > 1u && sampled != 0u && !alike {
                        seen = sample_row(row, seen, false, &taken);
                    }
                    light = seen.light;
                    transmitted = seen.transmitted;
                    samples += u32(taken) * countOneBits(sampled);
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
                        held = 0u;
                    }
                    depth = depth_of_sample(start, depths.y, step, sample_at);
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
        // What a closer look may find hidden is not asked for.
        let looks_closer = lost != 0u && spared_depths() > 0u;
        vain_looks = select(vain_looks, 0u, looks_closer);
        lost = select(lost, 0u, looks_closer);
        for (var c = 0u; c < channel_count(); c += 1u) {
            let bit = 1u << c;
            if (lost & bit) != 0u {
                look_further(c, channel_level(c, level), depth, ray, depth * urgency * f32(1u + channel_of(c).coarser));
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
