// Samples: where they lie in the brick cache, what they are worth, and the picture that they become.

@group(0) @binding(7) var bricks: texture_3d<f32>;
@group(0) @binding(8) var bricks_sampler: sampler;

const LOG2_E = 1.4426950408889634;
// Light that is left when a ray ends: less than one step of the picture even on white.
const TERMINATION = 0.000244140625;
// Of a plane that is not crossed.
const NOWHERE = 3e38;
// The largest part of a surface's colour, where it faces the eye, at least.
const SURFACE_LIGHT = 0.5;

var<private> samples: u32;

// Where one channel is seen: the first sample of each brick of a row, its lowest corner, and with which samples the second and the third
// begin.
var<private> first_texel: vec3f;
var<private> first_low: vec3f;
var<private> next_texel: array<vec3f, 2>;
var<private> next_low: array<vec3f, 2>;
var<private> turns: vec2f;
// The way to the next sample per depth, of all channels that are drawn from the level that is wanted.
var<private> texels_of_all: vec3f;
// The sample before, of surfaces [0, 1]; -1 where there is none.
var<private> sample_before: array<f32, SLOTS>;
// Where it was, from its segment's own place [steps].
var<private> beside_before: array<f32, SLOTS>;
// The levels that the largest values were drawn from and wanted at, in false colours.
var<private> largest_from: array<vec2u, SLOTS>;

// The surface that ends a ray: its channel, where it is, and the value that it is of.
var<private> surface: u32;
var<private> surface_at: vec3f;
var<private> surface_value: f32;
// How far ahead of the first sample it is; nothing there is farther.
var<private> hit_at: f32;
// Light that comes through to it; 0 where there is none.
var<private> surface_light: f32;
// Whether the ray began in it: it is cut there. And the normal of the face or plane the ray begins at, 0 at the eye.
var<private> surface_is_cut: bool;
var<private> cut_normal: vec3f;

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

// Puts what was found last into a row of bricks of one channel, whose first sample is at `depth`; it begins with sample `turn`.
fn aim_in_row(index: u32, turn: f32, depth: f32) {
    let corner = corner_of(drawn.entry);
    let low = corner * texel;
    let first = (corner + drawn.eye + depth * drawn.voxels) * texel;
    if index == 0u {
        first_low = low;
        first_texel = first;
        texels_of_all = drawn.voxels * texel;
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

// The way to the next sample of a channel per depth. `alike` where all are drawn from the level that is wanted: what is addressed by number is
// slow to read.
fn way_of(channel: u32, alike: bool) -> vec3f {
    if alike {
        return texels_of_all;
    }
    let is_own = LEVELS_ALIKE && (elsewhere & (1u << channel)) == 0u;
    return select(texels_per_depth[channel], texels_of_all, is_own);
}

// A place in a channel's brick: of a sample, by its number in the row of bricks, so far from the first sample where one channel is seen, and from the
// eye where several are. It is so many voxels outside of it at most: what lies within half a one is known in its border.
fn in_brick(channel: u32, number: f32, along: vec3f, outside: f32) -> vec3f {
    var first = first_texel;
    var low = first_low;
    if SLOTS == 1u {
        first = select(first, next_texel[0], number >= turns.x);
        first = select(first, next_texel[1], number >= turns.y);
        if BOUNDED {
            low = select(low, next_low[0], number >= turns.x);
            low = select(low, next_low[1], number >= turns.y);
        }
    } else {
        first = eye_texel[channel];
        if BOUNDED {
            low = low_texel[channel];
        }
    }
    let at = first + along;
    if BOUNDED {
        return clamp(at, low - outside * texel, low + (f32(BRICK_EDGE) + outside) * texel);
    }
    return at;
}

// Takes a sample of a channel, by its number in the row of bricks, at a place `along` the ray. Linear RGB and extinction of it.
fn color_at(channel: u32, number: f32, along: vec3f) -> vec4f {
    let color = color_of(channel, stored_at(in_brick(channel, number, along, 0.0)));
    if FALSE_COLORS != FALSE_NONE {
        let levels = levels_of[channel];
        return vec4f(false_color(color.rgb, levels.x, levels.y), color.a);
    }
    return color;
}

// Takes a sample where single values count, so many steps `beside` the place of its segment's own, which is so far ahead of the first, and
// keeps what the mode does of it.
fn keep_at(channel: u32, number: f32, along: vec3f, ahead: f32, step: f32, beside: f32, is_first: bool, alike: bool) {
    let way = step * way_of(channel, alike);
    let stored = stored_at(in_brick(channel, number, along + beside * way, 0.5));
    if MODE == MODE_MAXIMUM {
        if FALSE_COLORS != FALSE_NONE && stored > largest_seen[channel] {
            largest_from[channel] = levels_of[channel];
        }
        largest_seen[channel] = max(largest_seen[channel], stored);
        return;
    }
    let iso = channel_of(channel).iso;
    var before = sample_before[channel];
    var from_before = beside - beside_before[channel];
    if before < 0.0 && stored >= iso && !is_first {
        // What was passed as a whole was not sampled: where it ends says where the surface is.
        before = stored_at(in_brick(channel, number, along - way, 0.5));
        from_before = beside + 1.0;
    }
    let apart = clamp(from_before, 0.0, 2.0);
    sample_before[channel] = stored;
    beside_before[channel] = beside;
    if stored >= iso {
        let rise = stored - before;
        // Between numbers there is nothing: the voxel of an object is its surface.
        let is_between = rise > 0.0 && before < iso && !is_first && !has_flag(FLAG_NEAREST);
        let back = select(0.0, (stored - iso) / rise, is_between) * apart;
        let at = ahead + (beside - back) * step;
        // Of those that are met at one place the first counts, be they of different levels.
        if at < hit_at - IN_PLANE * step {
            hit_at = at;
            surface = channel;
            surface_at = in_brick(channel, number, along + (beside - back) * way, 0.0);
            // Objects have the colours of their own numbers.
            surface_value = select(iso, stored, has_flag(FLAG_NEAREST));
            // What begins where the ray does is cut there.
            surface_is_cut = is_first;
        }
    }
}

// Where the samples of a segment lie where single values count, from its own place [steps].
struct Places {
    inner: vec3f,   // front to back, and `NOWHERE`
    begin: f32,     // where the ray begins, or its level; `NOWHERE` if that is not in the segment
    end: f32,       // the same of its end
}

// Places of a segment's samples: its own, and those in planes through voxels' middles that the ray crosses between its own and those of
// its neighbours. A segment's own sample lies in such a plane, across the axis along which the ray passes most voxels, or half way between
// two: then those of other axes stand for it, if there are any.
fn places_of(row: Row, channel: u32, number: f32, along: vec3f, alike: bool) -> Places {
    // [voxels], per step, and from the middle of one.
    let way = row.step * way_of(channel, alike) / texel;
    let most = largest_of(abs(way));
    let at = in_brick(channel, number, along, 0.0) / texel - 0.5;
    let is_main = main_axis(way);
    let from_middle = abs(fract(dot(at, select(vec3f(0.0), vec3f(1.0), is_main)) + 0.5) - 0.5);
    // Coarser levels that stand in have more than two samples a voxel: each looks half way to its neighbours.
    let halves = most > 0.49;
    let is_cut = row.is_cut && number == 0.0;
    let is_instead = halves && (from_middle > 0.25 || is_cut);
    let reach = select(0.5, select(0.0, 1.0, is_instead), halves);
    let looks_back = number == 0.0 && row.look_back <= 0.0;
    let low = select(-reach, row.look_back, looks_back);
    let until = row.until - number;
    let ends = until < 1.0;
    let high = select(reach, until, ends);
    // What lies in a plane but for rounding has been met in the one before.
    let edge = at + (low + IN_PLANE) * way;
    let plane = select(floor(edge), ceil(edge), way >= vec3f(0.0));
    let crossed = (plane - at) / divisible(way);
    let beside = select(vec3f(NOWHERE), crossed, !is_main & (crossed <= vec3f(high)));
    // In order; of three, that of the main axis is nowhere.
    let one = min(beside.x, min(beside.y, beside.z));
    let other = max(min(beside.x, beside.y), min(max(beside.x, beside.y), beside.z));
    let own = select(0.0, NOWHERE, is_instead && one < NOWHERE);
    let inner = vec3f(min(one, own), min(max(one, own), other), max(max(one, own), other));
    let begin = select(NOWHERE, low, looks_back);
    // Numbers of objects are those of whole voxels, and of steps of several the planes between are none of a picture.
    let is_plain = has_flag(FLAG_NEAREST) || most > 0.51;
    return Places(select(inner, vec3f(0.0, NOWHERE, NOWHERE), is_plain), begin, select(NOWHERE, until, ends));
}

// Takes a channel's samples at the places of a segment where single values count.
fn keep_samples(row: Row, places: Places, channel: u32, number: f32, along: vec3f, ahead: f32, alike: bool) {
    beside_before[channel] -= 1.0;
    let is_start = number == 0.0 && row.is_first;
    // Also where the ray begins and ends, be it within a voxel.
    let has_ends = !has_flag(FLAG_NEAREST);
    let begins = has_ends && places.begin < NOWHERE;
    if begins {
        keep_at(channel, number, along, ahead, row.step, places.begin, is_start, alike);
    }
    var next = places.inner;
    for (var n = 0u; n < 3u && next.x < NOWHERE; n += 1u) {
        let is_first = is_start && n == 0u && !begins;
        keep_at(channel, number, along, ahead, row.step, next.x, is_first, alike);
        next = vec3f(next.yz, NOWHERE);
    }
    if has_ends && places.end < NOWHERE {
        keep_at(channel, number, along, ahead, row.step, places.end, false, alike);
    }
}

// What a ray has seen so far.
struct Seen {
    light: vec3f,
    transmitted: f32, // of what lies behind
}

// A row of bricks that is sampled.
struct Row {
    sampled: u32,    // channels, as bits
    depth: f32,      // of the first sample
    segments: f32,
    step: f32,
    halvings: f32,   // of light, in a segment of extinction 1
    is_first: bool,  // of the ray
    // Where single values count:
    is_cut: bool,    // whether the ray ends before the plane of its first sample
    look_back: f32,  // from its first sample, if that is not as for others [steps, negative]
    until: f32,      // from its first sample, where nothing follows any more [steps]
}

// Samples a row until no light is left; also, how many samples it took of each channel. What a ray has seen is handed over and back, since
// drivers that draw on the CPU keep no variable of the module in a register that is changed at each sample.
fn sample_row(row: Row, seen: Seen, alike: bool, taken: ptr<function, f32>) -> Seen {
    let along_row = row.depth * texels_of_all;
    let step = row.step;
    var light = seen.light;
    var transmitted = seen.transmitted;
    var i = 0.0;
    loop {
        let ahead = i * step;
        let way = ahead * texels_of_all;
        var sum = vec4f(0.0);
        hit_at = 3e38;
        if SLOTS == 1u {
            if IN_PLANES {
                keep_samples(row, places_of(row, 0u, i, way, true), 0u, i, way, ahead, true);
            } else {
                sum = color_at(0u, i, way);
            }
        } else {
            let along_of_all = along_row + way;
            var rest = row.sampled;
            // Those of all alike, which rounding would part.
            var places: Places;
            if IN_PLANES {
                places = places_of(row, firstTrailingBit(rest), i, along_of_all, true);
            }
            for (var n = countOneBits(row.sampled); n > 0u; n -= 1u) {
                let c = firstTrailingBit(rest);
                rest &= rest - 1u;
                var along = along_of_all;
                if !alike {
                    let own = way_of(c, false);
                    along = row.depth * own + ahead * own;
                }
                if IN_PLANES {
                    if !alike {
                        places = places_of(row, c, i, along, false);
                    }
                    keep_samples(row, places, c, i, along, ahead, alike);
                } else {
                    let color = color_at(c, i, along);
                    sum += vec4f(color.a * color.rgb, color.a);
                }
            }
        }
        if MODE == MODE_EMISSION_ABSORPTION {
            let through = transmitted * exp2(sum.a * row.halvings);
            let share = select(1.0 / max(sum.a, 1e-30), 1.0, SLOTS == 1u);
            light += (transmitted - through) * share * sum.rgb;
            transmitted = through;
        }
        if MODE == MODE_ISO_SURFACE && hit_at < 3e38 {
            surface_light = transmitted;
            transmitted = 0.0;
        }
        i += 1.0;
        continuing {
            break if i >= row.segments || transmitted <= TERMINATION;
        }
    }
    *taken = i;
    return Seen(light, transmitted);
}

// Channels whose samples do not go on from one place to the next have none before.
fn nothing_before(channels: u32) {
    if MODE == MODE_ISO_SURFACE {
        for (var c = 0u; c < channel_count(); c += 1u) {
            let has_none = ((channels >> c) & 1u) != 0u;
            sample_before[c] = select(sample_before[c], -1.0, has_none);
            beside_before[c] = select(beside_before[c], 0.0, has_none);
        }
    }
}

fn largest_of(color: vec3f) -> f32 {
    return max(color.r, max(color.g, color.b));
}

// The colour of a channel's surface: of a value, but bright enough to be seen; in the hue of the brighter end of the table where
// its own is black.
fn surface_color(channel: u32, stored: f32) -> vec3f {
    let own = color_of(channel, stored).rgb;
    let low = textureLoad(colors, vec2u(1u, channel), 0).rgb;
    let high = textureLoad(colors, vec2u(TABLE_LEN - 1u, channel), 0).rgb;
    let end = select(low, high, largest_of(high) >= largest_of(low));
    let hue = select(end, own, largest_of(own) > 1e-3);
    let bright = hue * (SURFACE_LIGHT / max(largest_of(hue), 1e-6));
    return select(bright, own, largest_of(own) >= SURFACE_LIGHT);
}

// Towards what belongs to objects, from the voxel at a place among their numbers: how these differ says nothing.
fn slope_of_labels(at: vec3f, iso: f32) -> vec3f {
    let middle = (floor(at / texel) + 0.5) * texel;
    var slope = vec3f(0.0);
    for (var n = 0u; n < 27u; n += 1u) {
        let way = vec3f(vec3u(n % 3u, n / 3u % 3u, n / 9u)) - 1.0;
        slope += select(vec3f(0.0), way, stored_at(middle + way * texel) >= iso);
    }
    return slope;
}

// Light from the surface that ended the ray: as bright as it faces the eye.
fn lit_surface(ray: vec3f) -> vec3f {
    let x = vec3f(0.5, 0.0, 0.0) * texel;
    let y = vec3f(0.0, 0.5, 0.0) * texel;
    let z = vec3f(0.0, 0.0, 0.5) * texel;
    let at = surface_at;
    let levels = levels_of[surface];
    var slope = vec3f(
        stored_at(at + x) - stored_at(at - x),
        stored_at(at + y) - stored_at(at - y),
        stored_at(at + z) - stored_at(at - z),
    );
    if has_flag(FLAG_NEAREST) {
        slope = slope_of_labels(at, channel_of(surface).iso);
    }
    let gradient = slope * frame.levels[levels.x].voxels_per_nm;
    // What is cut shows the cut: how values change there is no shape.
    let normal = select(gradient, cut_normal, surface_is_cut);
    let facing = abs(dot(normal, ray)) / max(length(normal) * length(ray), 1e-30);
    // Where values do not change there is no surface to light: as if it faced the eye.
    let diffuse = select(facing, 1.0, length(normal) <= 1e-30);
    let color = surface_color(surface, surface_value);
    return false_color(color, levels.x, levels.y) * (0.15 + 0.85 * diffuse);
}
