// An octree whose nodes are bricks, each with a pointer to its brick and the bounds of its values per channel, entered
// anew for every channel [000 section 8, 001 section 9.2.2]. A node can be drawn only when all above it are there.
//
// With STACK = 0 each search begins at the top (kd-restart). Otherwise it begins at the lowest of the
// STACK nodes above the last one that holds the place, and at the top where none does (kd-shortstack).

const NODE_WORDS = 1u + 2u * SLOTS;
const STACK_SIZE = max(STACK, 1u);

// Of the last search: the brick it ended in, its level, and the nodes on the way, by level modulo STACK.
var<private> last_brick: array<vec3u, SLOTS>;
var<private> last_level: array<u32, SLOTS>; // one more; 0 is none
var<private> stack: array<array<u32, STACK_SIZE>, SLOTS>;
// The highest level of which the stack holds a node.
var<private> stack_top: array<u32, SLOTS>;

// The brick of a level that a brick of a finer one lies in.
fn above(brick: vec3u, level: u32, coarser: u32) -> vec3u {
    return brick >> (frame.levels[coarser].down - frame.levels[level].down);
}

fn find(channel: u32, wanted: u32, depth: f32, ray: vec3f) -> Spot {
    let place = brick_at(wanted, depth, ray);
    var level = max(frame.start_level, wanted);
    let top = above(place, wanted, level);
    let across = frame.levels[level].bricks;
    var node = (top.z * across.y + top.y) * across.x + top.x;
    var is_restart = true;
    if STACK > 0u && last_level[channel] > 0u {
        let deepest = last_level[channel] - 1u;
        for (var k = 0u; k < STACK; k += 1u) {
            let at = deepest + k;
            if at > stack_top[channel] {
                break;
            }
            if at >= wanted && at <= level && all(above(place, wanted, at) == above(last_brick[channel], deepest, at)) {
                node = stack[channel][at % STACK_SIZE];
                level = at;
                is_restart = false;
                break;
            }
        }
    }
    if STACK > 0u && is_restart {
        stack_top[channel] = level;
    }
    var here = Spot(EMPTY, level, above(place, wanted, level), 0.0);
    loop {
        work += 1u;
        let first = node * NODE_WORDS;
        if STACK > 0u {
            stack[channel][level % STACK_SIZE] = node;
            stack_top[channel] = min(stack_top[channel], level + STACK - 1u);
        }
        let entry = index[first + 1u + 2u * channel];
        mark_used(channel, entry);
        if entry == MISSING {
            mark_missed(channel, level, above(place, wanted, level));
            here.entry = MISSING;
            break;
        }
        here = Spot(entry, level, above(place, wanted, level), 0.0);
        if is_range_hidden(channel, index[first + 2u + 2u * channel]) {
            here.entry = EMPTY;
            break;
        }
        if level == wanted {
            break;
        }
        let children = index[first];
        if children == 0u {
            // What is needed below is not there: the lower resolution ends the ray's search.
            mark_missed(channel, level - 1u, above(place, wanted, level - 1u));
            here.entry = MISSING;
            break;
        }
        let bits = frame.levels[level].down - frame.levels[level - 1u].down;
        let at = above(place, wanted, level - 1u) & ((vec3u(1u) << bits) - 1u);
        level -= 1u;
        node = children + at.x + (at.y << bits.x) + (at.z << (bits.x + bits.y));
    }
    last_brick[channel] = here.brick;
    last_level[channel] = here.level + 1u;
    here.leaving = leaving_box(here.level, here.brick, 1u, ray);
    return here;
}
