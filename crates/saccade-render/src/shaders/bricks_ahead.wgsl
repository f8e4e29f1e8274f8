// Which brick of a channel is drawn at a place on a ray: the one that is wanted, or what is there instead.

// Levels finer than wanted that may stand in, when no coarser one does.
const FINER_SUBSTITUTES = 2u;
// A substitute so many levels away is too coarse: the level this far away is asked for as well.
const PREVIEW_LEVELS = 2u;
// Whether the levels that channels are drawn from are asked for while samples are taken.
const KEEPS_LEVELS = FALSE_COLORS != FALSE_NONE || MODE == MODE_ISO_SURFACE;

var<private> substituted_levels: u32;

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

// What is drawn for a stretch of the ray.
struct Source {
    level: u32,
    entry: u32,
    eye: vec3f,     // [voxels of the level from the brick's low corner]
    voxels: vec3f,  // along the ray, per depth
    leaving: f32,   // depth up to which it holds
}

fn find_at(channel: u32, grid: Grid, place: Place) -> Found {
    let entry = channel_of(channel).directory_offset + grid.directory_base;
    return find(channel, grid.level, place.brick, entry, grid.directory);
}

fn source(grid: Grid, place: Place, found: Found) -> Source {
    return Source(grid.level, found.entry, grid.eye - place.low, grid.voxels, leaving(grid, place, found.span_log2));
}

// What was found last.
var<private> drawn: Source;
// Where the last look-up ended.
var<private> sought: Found;
// A bit per channel: what is drawn was found for a sample of the level that is wanted, and holds up to some depth; nothing is known of the
// brick; nothing of it is seen; another level than wanted stands in.
var<private> held: u32;
var<private> missing: u32;
var<private> transparent: u32;
var<private> elsewhere: u32;
// Of each channel, where several are seen, as the sampler counts: where the eye is, and the way to the next sample per depth, which is the
// same for all channels that are not drawn from elsewhere; the brick's lowest corner; and up to which depth it holds.
var<private> eye_texel: array<vec3f, SLOTS>;
var<private> texels_per_depth: array<vec3f, SLOTS>;
var<private> low_texel: array<vec3f, SLOTS>;
var<private> holds_until: array<f32, SLOTS>;
// The levels that channels are drawn from and wanted at, where it is asked for.
var<private> levels_of: array<vec2u, SLOTS>;
// What a voxel is, as the sampler counts.
var<private> texel: vec3f;

// Lowest corner of a brick [texels].
fn corner_of(entry: u32) -> vec3f {
    // Whole numbers below 2^22: exact, and quicker than dividing integers.
    let grid = steady.brick_grid;
    let slot = f32(entry - FIRST_SLOT) + 0.5;
    let row = floor(slot / grid.x);
    let layer = floor(slot / (grid.x * grid.y));
    let cell = vec3f(floor(slot) - row * grid.x, row - layer * grid.y, layer);
    return cell * f32(BRICK_STORED_EDGE) + f32(BRICK_BORDER);
}

// Draws a channel from what was found where level `wanted` is wanted, if it is that level's own or another one's.
fn draw_from(channel: u32, wanted: u32, is_own: bool, found: Source) {
    let bit = 1u << channel;
    let is_there = found.entry >= FIRST_SLOT;
    var unseen = true;
    if is_there {
        let slot = found.entry - FIRST_SLOT;
        mark_brick_used(slot);
        unseen = is_transparent(channel, slot);
    }
    held |= bit;
    transparent = select(transparent & ~bit, transparent | bit, unseen);
    if is_own {
        missing &= ~bit;
        elsewhere &= ~bit;
    } else {
        let distance = select(0u, u32(abs(i32(found.level) - i32(wanted))), is_there);
        missing = select(missing & ~bit, missing | bit, found.entry < EMPTY);
        elsewhere = select(elsewhere & ~bit, elsewhere | bit, distance != 0u);
        substituted_levels = max(substituted_levels, distance);
    }
    if KEEPS_LEVELS {
        levels_of[channel] = vec2u(found.level, wanted);
    }
    if SLOTS > 1u {
        let corner = corner_of(found.entry);
        eye_texel[channel] = (corner + found.eye) * texel;
        if !(is_own && LEVELS_ALIKE) {
            texels_per_depth[channel] = found.voxels * texel;
        }
        if BOUNDED {
            low_texel[channel] = corner * texel;
        }
        holds_until[channel] = found.leaving;
    }
    drawn = found;
}

// Looks up the brick of a channel at a place, from which a ray goes up to `end`, and draws it; whether that is all there is
// to it.
fn look_up(channel: u32, grid: Grid, place: Place, end: f32) -> bool {
    let found = find_at(channel, grid, place);
    sought = found;
    let is_there = found.entry >= FIRST_SLOT && !found.stale;
    if is_there {
        let own = Source(grid.level, found.entry, grid.eye - place.low, grid.voxels, end);
        draw_from(channel, grid.level, true, own);
    }
    return is_there;
}

// The rest of a look-up: reports what is missing or stale and draws the nearest level that is there instead,
// coarser ones first [001 alg. 7.2]; passes in one step what coarser levels know to be empty as well.
fn look_further(channel: u32, level: u32, depth: f32, ray: vec3f, urgency: f32) {
    let grid = grid_of(level, ray);
    let place = place_of(grid, depth);
    var found = sought;
    if SLOTS > 1u {
        found = find_at(channel, grid, place);
    }
    let lacks = found.entry < EMPTY;
    if lacks || found.stale {
        mark_missed(found, urgency);
    }
    let widens = found.entry == EMPTY && !found.stale;
    let first_level = channel_of(channel).first_level;
    let coarsest = channel_of(channel).last_level;
    let preview = min(level + PREVIEW_LEVELS, coarsest);
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
        coarser = (there | asked_for) & bits_below(coarsest + 1u) & ~bits_below(level + 1u);
        let finest = max(level - min(level, FINER_SUBSTITUTES), first_level);
        finer = there & bits_below(level) & ~bits_below(finest);
    } else if widens {
        coarser = bits_below(level_count()) & ~bits_below(level + 1u);
    }
    let wanted = source(grid, place, found);
    var best = wanted;
    while (coarser | finer) != 0u {
        let is_coarser = coarser != 0u;
        let next = select(firstLeadingBit(finer), firstTrailingBit(coarser), is_coarser);
        if is_coarser {
            coarser &= coarser - 1u;
        } else {
            finer &= bits_below(next);
        }
        let next_grid = grid_of(next, ray);
        let next_place = place_of(next_grid, depth);
        let there = find_at(channel, next_grid, next_place);
        let other = source(next_grid, next_place, there);
        if widens {
            if there.entry != EMPTY || there.stale {
                break;
            }
            best.leaving = max(best.leaving, other.leaving);
        } else if there.entry >= FIRST_SLOT || (is_coarser && there.entry >= EMPTY) {
            best = other;
            best.leaving = min(other.leaving, wanted.leaving);
            break;
        } else if is_coarser && (next == coarsest || next == preview) {
            // Few bricks, soon there: before all others, and the one that shows everything first.
            mark_missed(there, urgency * select(1e-3, 1e-6, next == coarsest));
        }
    }
    draw_from(channel, level, false, best);
}

// Bits below one.
fn bits_below(bit: u32) -> u32 {
    return select((1u << bit) - 1u, 0xffffffffu, bit >= 32u);
}
