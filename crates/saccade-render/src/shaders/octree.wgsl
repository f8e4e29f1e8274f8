// The residency octree: what a region holds, and which levels are there.
//
// A node has a texel per channel: what is known of its values, and the block of its eight children. What it
// says about values holds for some levels only, and it says for which.

// Per channel a row: linear RGB and extinction [1/nm] by stored value.
@group(0) @binding(6) var colors: texture_2d<f32>;
// A texture, since drivers that draw on the CPU read a buffer value by value.
@group(0) @binding(10) var nodes: texture_2d<u32>;
// Per node and channel, levels with a resident brick that overlaps the node, as bits.
@group(0) @binding(11) var<storage, read> residents: array<u32>;

// What is known of the space around a sample, a bit per channel.
struct Region {
    hidden: u32,   // no sample in it is visible
    uniform_: u32, // all samples in it are alike, see `uniform_stored`
    leaving: f32,  // depth up to which this holds
}

// The node visited last and seven above it: the next sample is in one of them, or near. In registers, which an
// array that is addressed by number is not; who climbs higher begins at the root [001 section 9.2.2].
struct Path {
    near: vec4u, // the node, then those above it
    far: vec4u,
}

var<private> path: Path;
// Channels that are hidden in each of them, and in the upper half those of which a closer look tells nothing new.
var<private> path_known: Path;
var<private> path_held: u32;
var<private> path_depth: u32;
var<private> path_level: u32 = 0xffffffffu;
var<private> path_cell: vec3u;
// Of channels that are alike in a region, the value [0, 1].
var<private> uniform_stored: array<f32, SLOTS>;
// Of maximum projections, the largest stored value so far [0, 1].
var<private> largest_seen: array<f32, SLOTS>;

var<private> nodes_visited: u32;

// A ray that came upon nothing to skip in so many regions in a row looks one depth less closely for it, and after some more another
// one: as long as what it passes is seen, looking costs more than it saves. What is hidden is looked at closely from there on.
const VAIN_LOOKS = 8u;
const VAIN_LOOKS_MORE = 4u;
const MOST_SPARED = 3u;

// Regions in a row of which a look as close as the last one's found fewer than half of the channels hidden that a look from farther away
// did not.
var<private> vain_looks: u32;

// Depths of the octree that a ray does not go down to for now.
fn spared_depths() -> u32 {
    let more = vain_looks + VAIN_LOOKS_MORE - min(vain_looks + VAIN_LOOKS_MORE, VAIN_LOOKS);
    return min(more / VAIN_LOOKS_MORE, MOST_SPARED);
}

// The level of a channel that is drawn where `level` is wanted.
fn channel_level(channel: u32, level: u32) -> u32 {
    let here = channel_of(channel);
    return clamp(level + here.coarser, here.first_level, here.last_level);
}

// All channels that are seen, as bits.
fn all_channels() -> u32 {
    return (1u << channel_count()) - 1u;
}

// How many channels are among some, and the first of them. Loops over them take as many turns as a ray needs, and not as
// many as there are channels.
fn count_of(channels: u32) -> u32 {
    return select(countOneBits(channels), 1u, SLOTS == 1u);
}

fn lowest_of(channels: u32) -> u32 {
    return select(firstTrailingBit(channels), 0u, SLOTS == 1u);
}

// The cell of the volume nearest to a place on a ray.
fn cell_at(depth: f32, ray: vec3f) -> vec3u {
    let at = steady.octree_eye + depth * ray * steady.cells_per_nm;
    let steps = clamp(floor(at), vec3f(-1e9), vec3f(1e9));
    return vec3u(clamp(steady.octree_anchor + vec3i(steps), vec3i(0), steady.last_cell));
}

// A number per axis, from a byte each.
fn axes(bytes: u32) -> vec3u {
    return vec3u(bytes & 255u, (bytes >> 8u) & 255u, bytes >> 16u);
}

fn child_index(cell: vec3u, depth: u32) -> u32 {
    let bits = axes(frame.octree.depths[depth].bits);
    let at = (cell >> axes(frame.octree.depths[depth].shift)) & ((vec3u(1u) << bits) - 1u);
    return at.x + (at.y << bits.x) + (at.z << (bits.x + bits.y));
}

// Depth at which a ray leaves the node of some depth that a cell is in.
fn leaving_node(cell: vec3u, depth: u32, ray: vec3f) -> f32 {
    let shift = axes(frame.octree.depths[depth].shift);
    let first = vec3i((cell >> shift) << shift) - steady.octree_anchor;
    let low = vec3f(first);
    let high = low + vec3f(vec3u(1u) << shift);
    return leaving_depth(low, high, steady.octree_eye, ray * steady.cells_per_nm);
}

// Where a stored value, as an integer, is in the colour table [entries].
fn table_position(channel: u32, value: f32) -> f32 {
    let here = channel_of(channel);
    return clamp(value * here.table_scale + here.table_offset, 0.0, f32(TABLE_LEN - 1u));
}

// Whether no value between two stored values, ends included, is visible.
fn is_range_hidden(channel: u32, low: u32, high: u32) -> bool {
    if MODE == MODE_MAXIMUM {
        return f32(high) <= largest_seen[channel] * steady.largest;
    }
    let first = floor(table_position(channel, f32(low)));
    let last = ceil(table_position(channel, f32(high)));
    let here = channel_of(channel);
    return high == 0u || last < here.first_opaque || first > here.last_opaque;
}

fn pushed(path: Path, value: u32) -> Path {
    return Path(vec4u(value, path.near.xyz), vec4u(path.near.w, path.far.xyz));
}

fn popped(path: Path) -> Path {
    return Path(vec4u(path.near.yzw, path.far.x), vec4u(path.far.yzw, 0u));
}

// What a node knows of a channel: NODE_BINS, NODE_RANGE, NODE_VALID and NODE_CHILDREN.
fn node_texel(node: u32, channel: u32) -> vec4u {
    let texel = node * steady.octree_slots + channel_of(channel).octree_slot;
    return textureLoad(nodes, vec2u(texel % NODE_ROW, texel / NODE_ROW), 0);
}

// The largest node around a sample in which each channel is hidden, all alike or nearly all seen, else the
// deepest there, less what is spared. One walk for all channels [001 alg. 7.1].
//
// Starts from the nodes that the sample before was in [001 section 9.4]: those it shares with it
// were not enough.
fn region_at(level: u32, deepest_known: u32, depth: f32, ray: vec3f) -> Region {
    let deepest = deepest_known - min(spared_depths(), deepest_known);
    let cell = cell_at(depth, ray);
    let everything = all_channels();
    var at = 0u;
    var is_new = true;
    if level == path_level {
        at = path_depth;
        let moved = cell ^ path_cell;
        while at > 0u && any((moved >> axes(frame.octree.depths[at].shift)) != vec3u(0u)) {
            at -= 1u;
            path = popped(path);
            if SLOTS > 1u {
                path_known = popped(path_known);
            }
        }
        let climbed = path_depth - at;
        path_held -= min(climbed, path_held);
        at = select(at, 0u, path_held == 0u);
        is_new = climbed == 0u || path_held == 0u;
    } else {
        path_held = 0u;
    }
    path_cell = cell;
    path_level = level;
    if path_held == 0u {
        // The root is node 0.
        path = Path();
        path_known = Path();
        path_held = 1u;
    }
    var node = path.near.x;
    var hidden = 0u;
    var settled = 0u;
    var alike = 0u;
    // With one channel, a node in which it is hidden or settled ends the walk: those above know nothing.
    if SLOTS > 1u {
        hidden = path_known.near.x & 0xffffu;
        settled = path_known.near.x >> 16u;
    }
    loop {
        var children = 0u;
        if is_new {
            nodes_visited += 1u;
            alike = 0u;
            var rest = everything & ~hidden;
            for (var n = count_of(rest); n > 0u; n -= 1u) {
                let c = lowest_of(rest);
                rest &= rest - 1u;
                let bit = 1u << c;
                let known = node_texel(node, c);
                children = known[NODE_CHILDREN];
                if !channel_has(c, CHANNEL_VALUES) {
                    settled |= bit;
                    continue;
                }
                if ((known[NODE_VALID] >> channel_level(c, level)) & 1u) == 0u {
                    continue;
                }
                let range = known[NODE_RANGE];
                let low = range & 0xffffu;
                let high = range >> 16u;
                let bins = known[NODE_BINS];
                let visible = countOneBits(bins & channel_of(c).visible_bins);
                if visible == 0u || is_range_hidden(c, low, high) {
                    hidden |= bit;
                } else if low == high {
                    alike |= bit;
                    settled |= bit;
                    uniform_stored[c] = f32(low) / steady.largest;
                } else if (low > 0u || SLOTS > 1u) && visible * 4u > countOneBits(bins) * 3u {
                    // Where nearly all is seen, a closer look finds little to skip. Bins do not say how much of it is nothing at all;
                    // to look for that costs more the more channels there are.
                    settled |= bit;
                }
            }
            if SLOTS > 1u {
                path_known.near.x = hidden | (settled << 16u);
            }
            if (hidden | settled) == everything {
                break;
            }
        } else {
            children = node_texel(node, 0u)[NODE_CHILDREN];
        }
        if at >= deepest || children == 0u {
            break;
        }
        at += 1u;
        node = children * SIBLINGS + child_index(cell, at);
        path = pushed(path, node);
        path_held = min(path_held + 1u, PATH_HOLDS);
        if SLOTS > 1u {
            path_known = pushed(path_known, path_known.near.x);
        }
        is_new = true;
    }
    path_depth = at;
    var hidden_from_afar = 0u;
    if SLOTS > 1u {
        hidden_from_afar = path_known.near.y & 0xffffu;
    }
    let seen_from_afar = everything & ~hidden_from_afar;
    let newly_hidden = countOneBits(hidden & seen_from_afar);
    vain_looks = select(vain_looks + 1u, 0u, newly_hidden * 2u >= countOneBits(seen_from_afar));
    return Region(hidden, alike, leaving_node(cell, at, ray));
}

// The deepest nodes that know values of the levels drawn where `level` is wanted.
fn deepest_of(level: u32) -> u32 {
    var deepest = 0u;
    for (var c = 0u; c < channel_count(); c += 1u) {
        deepest = max(deepest, frame.levels[channel_level(c, level)].values_depth);
    }
    return deepest;
}

// Levels that may be found around a place, as bits: a brick overlaps the smallest node there, or
// something is known of its voxels. Nodes smaller than a brick leave noting it to larger ones.
fn levels_around(channel: u32, cell: vec3u) -> u32 {
    var node = 0u;
    var at = 0u;
    var levels = 0u;
    loop {
        nodes_visited += 1u;
        let known = node_texel(node, channel);
        let resident = residents[node * steady.octree_slots + channel_of(channel).octree_slot];
        levels |= known[NODE_VALID];
        let children = known[NODE_CHILDREN];
        if children == 0u || at + 1u >= MOST_DEPTHS {
            levels |= resident;
            break;
        }
        levels |= resident & frame.octree.depths[at].residency;
        at += 1u;
        node = children * SIBLINGS + child_index(cell, at);
    }
    return levels;
}
