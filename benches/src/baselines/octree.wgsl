// An octree whose nodes are bricks, each with a pointer to its brick and the bounds of its values per channel, entered
// anew for every channel [000 section 8, 001 section 9.2.2]. A node can be drawn only when all above it are there.
//
// With STACK = 0 each search begins at the top (kd-restart). Otherwise it begins at the lowest of the
// STACK nodes above the last one that holds the place, and at the top where none does (kd-shortstack).

// A texel per node and channel, as the product's nodes: children, the entry of the brick, the bounds of its values.
@group(0) @binding(8) var nodes: texture_2d<u32>;

const NODE_ROW = 4096u;

// Of the last search: the node it ended in and those above it, in registers; how many of them; and where that was.
var<private> stack: array<vec4u, SLOTS>;
var<private> held: array<u32, SLOTS>;
var<private> last_brick: array<vec3u, SLOTS>; // of its level
var<private> last_level: array<u32, SLOTS>;

fn down_of(level: u32) -> vec3u {
    return axes(frame.levels[level].down);
}

fn find(channel: u32, depth: f32) -> Spot {
    let wanted = grid.level;
    let place = brick_at(depth);
    let wanted_down = axes(grid.down);
    var level = max(steady.start_level, wanted);
    var way = vec4u(0u);
    var ways = 0u;
    if STACK > 0u {
        way = stack[channel];
        ways = held[channel];
        let deepest = last_level[channel];
        let deepest_down = down_of(deepest);
        var at = deepest;
        loop {
            if ways == 0u {
                break;
            }
            let down = down_of(at);
            let is_above = at >= wanted && at <= level;
            if is_above && all((place >> (down - wanted_down)) == (last_brick[channel] >> (down - deepest_down))) {
                break;
            }
            at += 1u;
            ways -= 1u;
            way = vec4u(way.yzw, 0u);
        }
        level = select(level, at, ways > 0u);
    }
    var down = down_of(level);
    if ways == 0u {
        let top = place >> (down - wanted_down);
        let across = select(steady.start_bricks, grid.bricks, wanted > steady.start_level);
        way = vec4u((top.z * across.y + top.y) * across.x + top.x, 0u, 0u, 0u);
        ways = 1u;
    }
    var entry = EMPTY;
    loop {
        work += 1u;
        let texel = way.x * SLOTS + channel;
        let node = textureLoad(nodes, vec2u(texel % NODE_ROW, texel / NODE_ROW), 0);
        entry = node.y;
        mark_used(channel, entry);
        if entry == MISSING {
            lose(channel, level, place >> (down - wanted_down));
            break;
        }
        if is_range_hidden(channel, node.z) {
            entry = EMPTY;
            break;
        }
        if level == wanted {
            break;
        }
        level -= 1u;
        let bits = down - down_of(level);
        down -= bits;
        let child = place >> (down - wanted_down);
        if node.x == 0u {
            // What is needed below is not there: the lower resolution ends the ray's search.
            lose(channel, level, child);
            entry = MISSING;
            break;
        }
        let at = child & ((vec3u(1u) << bits) - 1u);
        way = vec4u(node.x + at.x + (at.y << bits.x) + (at.z << (bits.x + bits.y)), way.xyz);
        ways = min(ways + 1u, STACK);
    }
    let span = down - wanted_down;
    if STACK > 0u {
        stack[channel] = way;
        held[channel] = ways;
        last_level[channel] = level;
        last_brick[channel] = place >> span;
    }
    return Spot(entry, place, leaving_box(place, span));
}
