// Virtual memory: from (channel, level, brick) to a slot of the brick cache, and what was met on the way.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> directory: array<u32>;
@group(0) @binding(2) var<storage, read> tables: array<u32>;
@group(0) @binding(3) var<storage, read> slot_ranges: array<u32>;
// A bit per physical entry: the directory's, then those of the page table cache.
@group(0) @binding(4) var<storage, read_write> missed: array<atomic<u32>>;
// Counters; a bit per brick slot, then per page table block, in use; (entry, urgency) of misses.
@group(0) @binding(5) var<storage, read_write> report: array<atomic<u32>>;

// 0, which compilers cannot know. Mesa's drivers compile a shader anew, before each frame, for the values of uniforms that
// alone decide an `if` or end a loop; what is combined with this does not.
var<private> nothing: u32;

// What the frame says of all rays alike. Read once, before they part: where some rays may not be drawn along, drivers
// that draw on the CPU read a uniform for each ray anew.
struct Steady {
    flags: u32,
    level_count: u32,
    block_edge_log2: u32,
    depth: u32,
    directory_entries: u32,
    bricks: u32,        // slots of the brick cache
    brick_grid: vec3f,  // the same per axis
    largest: f32,
    octree_slots: u32,
    octree_eye: vec3f,
    octree_anchor: vec3i,
    cells_per_nm: vec3f,
    last_cell: vec3i,
}

var<private> steady: Steady;
// The channel that is seen, if one is.
var<private> only: Channel;

fn read_steady() {
    let grid = frame.brick_grid;
    steady = Steady(
        frame.flags | nothing,
        frame.level_count | nothing,
        frame.block_edge_log2,
        frame.depth,
        frame.directory_entries,
        grid.x * grid.y * grid.z,
        vec3f(grid),
        frame.largest,
        frame.octree.slots,
        frame.octree.eye,
        frame.octree.anchor,
        frame.octree.cells_per_nm,
        vec3i(frame.octree.cells) - 1,
    );
    only = frame.channels[0];
}

fn channel_of(channel: u32) -> Channel {
    if SLOTS == 1u {
        return only;
    }
    return frame.channels[channel];
}

fn has_flag(flag: u32) -> bool {
    return (steady.flags & flag) != 0u;
}

fn channel_has(channel: u32, flag: u32) -> bool {
    return ((channel_of(channel).flags | nothing) & flag) != 0u;
}

fn level_count() -> u32 {
    return steady.level_count;
}

// Where the way to a brick ended.
struct Found {
    entry: u32,     // without its stale bit
    stale: bool,
    physical: u32,  // number of the entry
    span_log2: u32, // edge of what lies under the entry [log2 of bricks]
}

// The place of the page table block used last, which most bricks along a ray share, all channels' as well: its level, one more than
// it; 0 is none. Of which channels the entry that leads there is known, as bits; and these entries.
var<private> last_at: vec3u;
var<private> last_level: u32;
var<private> last_known: u32;
var<private> last_block: array<u32, SLOTS>;

// Entries read, of the directory and of page tables.
var<private> lookups: u32;
var<private> misses_left: u32 = max(MISSES_PER_RAY, MISSES_PER_CHANNEL * SLOTS);

fn mark_used(slot: u32) {
    let word = COUNTERS + slot / 32u;
    let bit = 1u << (slot % 32u);
    // Most bits are set already; reading is cheaper than writing.
    if (atomicLoad(&report[word]) & bit) == 0u {
        atomicOr(&report[word], bit);
    }
}

fn mark_brick_used(slot: u32) {
    mark_used(slot);
}

fn mark_block_used(block: u32) {
    mark_used(steady.bricks + block);
}

// Reports an entry once a frame. A small `urgency` is urgent.
fn mark_missed(found: Found, urgency: f32) {
    if misses_left == 0u {
        return;
    }
    misses_left -= 1u;
    let word = found.physical / 32u;
    let bit = 1u << (found.physical % 32u);
    if (atomicLoad(&missed[word]) & bit) != 0u || (atomicOr(&missed[word], bit) & bit) != 0u {
        return;
    }
    if found.stale {
        atomicAdd(&report[COUNT_STALE], 1u);
    }
    let n = atomicAdd(&report[COUNT_MISSES], 1u);
    if n < MISSES {
        let at = COUNTERS + frame.usage_words + 2u * n;
        atomicStore(&report[at], found.physical);
        atomicStore(&report[at + 1u], bitcast<u32>(max(urgency, 0.0)));
    }
}

fn found_at(value: u32, physical: u32, span_log2: u32) -> Found {
    return Found(value & ~STALE, (value & STALE) != 0u, physical, span_log2);
}

// `base` is the level's first entry of the channel in the page directory, which has `size` of them per axis.
fn find(channel: u32, level: u32, brick: vec3u, base: u32, size: vec3u) -> Found {
    let edge = steady.block_edge_log2;
    let inside = vec3u((1u << edge) - 1u);
    let block_at = brick >> vec3u(edge);
    let bit = 1u << channel;
    let is_near = level + 1u == last_level && all(block_at == last_at);
    last_known = select(0u, last_known, is_near);
    last_at = block_at;
    last_level = level + 1u;
    let is_last = (last_known & bit) != 0u;
    var span = edge;
    var value = last_block[channel];
    var physical = 0u;
    if !is_last {
        span = edge * (steady.depth - 1u);
        let cell = brick >> vec3u(span);
        physical = base + (cell.z * size.y + cell.y) * size.x + cell.x;
        value = directory[physical];
        lookups += 1u;
    }
    if (value & ~STALE) >= FIRST_SLOT && span > 0u {
        loop {
            let slot = value & ~STALE;
            if span == edge {
                last_block[channel] = value;
                last_known |= bit;
            }
            let block = slot - FIRST_SLOT;
            if !is_last {
                mark_block_used(block);
            }
            span -= edge;
            let at = (brick >> vec3u(span)) & inside;
            let entry = (block << (3u * edge)) + ((((at.z << edge) + at.y) << edge) + at.x);
            physical = steady.directory_entries + entry;
            value = tables[entry];
            lookups += 1u;
            continuing {
                break if span == 0u || (value & ~STALE) < FIRST_SLOT;
            }
        }
    }
    return found_at(value, physical, span);
}
