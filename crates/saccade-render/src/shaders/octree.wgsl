// The residency octree: what a region holds, and which levels are there.
//
// Nodes are words: the block of their eight children, then what is known per channel. What a node
// says about values holds for some levels only, and it says for which.

@group(0) @binding(6) var<storage, read> transfer: Transfer;
@group(0) @binding(10) var<storage, read> nodes: array<u32>;

// What is known of the space around a sample.
struct Region {
    hidden: bool,   // no sample of the level in it is visible
    uniform_: bool, // all samples of the level in it are `stored`
    stored: f32,    // [0, 1]
    leaving: f32,   // depth up to which this holds
}

// Nodes from the root to the one visited last: the next sample is in one of them, or near.
var<private> path: array<u32, MOST_DEPTHS>;
var<private> path_depth: u32;
var<private> path_level: u32 = 0xffffffffu;
var<private> path_cell: vec3u;

var<private> nodes_visited: u32;

// The cell of the volume nearest to a place on a ray.
fn cell_at(depth: f32, ray: vec3f) -> vec3u {
    let at = frame.octree.eye + depth * ray * frame.octree.cells_per_nm;
    let steps = clamp(floor(at), vec3f(-1e9), vec3f(1e9));
    let last = vec3i(frame.octree.cells) - 1;
    return vec3u(clamp(frame.octree.anchor + vec3i(steps), vec3i(0), last));
}

fn child_index(cell: vec3u, depth: u32) -> u32 {
    let bits = frame.octree.depths[depth].bits;
    let at = (cell >> frame.octree.depths[depth].shift) & ((vec3u(1u) << bits) - 1u);
    return at.x + (at.y << bits.x) + (at.z << (bits.x + bits.y));
}

// Depth at which a ray leaves the node of some depth that a cell is in.
fn leaving_node(cell: vec3u, depth: u32, ray: vec3f) -> f32 {
    let shift = frame.octree.depths[depth].shift;
    let first = vec3i((cell >> shift) << shift) - frame.octree.anchor;
    let low = vec3f(first);
    let high = low + vec3f(vec3u(1u) << shift);
    return leaving_depth(low, high, frame.octree.eye, ray * frame.octree.cells_per_nm);
}

// Whether no value between two stored values, ends included, is visible.
fn is_range_hidden(low: u32, high: u32) -> bool {
    return transfer.opaque_before[high + 1u] == transfer.opaque_before[low];
}

// The largest node around a sample of a level that is hidden, all alike or nearly all seen, else the
// deepest there.
//
// Starts from the nodes that the sample before was in [001 section 9.4]: those it shares with it
// were neither.
fn region_at(level: u32, depth: f32, ray: vec3f) -> Region {
    let cell = cell_at(depth, ray);
    let deepest = frame.levels[level].values_depth;
    var at = 0u;
    var is_new = true;
    if level == path_level {
        at = path_depth;
        let moved = cell ^ path_cell;
        while at > 0u && any((moved >> frame.octree.depths[at].shift) != vec3u(0u)) {
            at -= 1u;
        }
        is_new = at == path_depth;
    }
    path_cell = cell;
    path_level = level;
    var node = path[at];
    var hidden = false;
    var low = 0u;
    var high = 1u;
    loop {
        let first = node * frame.octree.node_words;
        if is_new {
            nodes_visited += 1u;
            let known = first + NODE_CHANNEL;
            if ((nodes[known + NODE_VALID] >> level) & 1u) != 0u {
                let range = nodes[known + NODE_RANGE];
                low = range & 0xffffu;
                high = range >> 16u;
                let bins = nodes[known + NODE_BINS];
                let visible = countOneBits(bins & transfer.visible_bins);
                hidden = visible == 0u || is_range_hidden(low, high);
                // Where nearly all is seen, a closer look finds little to skip.
                if hidden || low == high || visible * 4u > countOneBits(bins) * 3u {
                    break;
                }
            }
        }
        let children = nodes[first + NODE_CHILDREN];
        if at >= deepest || children == 0u {
            break;
        }
        at += 1u;
        node = children * SIBLINGS + child_index(cell, at);
        path[at] = node;
        is_new = true;
    }
    path_depth = at;
    let stored = f32(low) / f32(TABLE_LEN - 1u);
    return Region(hidden, low == high, stored, leaving_node(cell, at, ray));
}

// Levels that may be found around a place, as bits: a brick overlaps the smallest node there, or
// something is known of its voxels. Nodes smaller than a brick leave noting it to larger ones.
fn levels_around(cell: vec3u) -> u32 {
    var node = 0u;
    var at = 0u;
    var levels = 0u;
    loop {
        nodes_visited += 1u;
        let first = node * frame.octree.node_words;
        let known = first + NODE_CHANNEL;
        let resident = nodes[known + NODE_RESIDENT];
        levels |= nodes[known + NODE_VALID];
        let children = nodes[first + NODE_CHILDREN];
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
