// Page tables alone [000 fig. 4, 001 section 9.2.1]: two steps, of which the first is left out where the entry is
// the one read last.

@group(0) @binding(8) var<storage, read> directory: array<u32>;
@group(0) @binding(9) var<storage, read> blocks: array<u32>;

const BLOCK_LOG2 = 5u;

var<private> last_entry: array<u32, SLOTS>; // one more than the directory entry read last
var<private> last_value: array<u32, SLOTS>;

fn find(channel: u32, depth: f32) -> Spot {
    let brick = brick_at(depth);
    let size = grid.directory;
    let cell = brick >> vec3u(BLOCK_LOG2);
    let base = channel * steady.directory_entries + grid.directory_base;
    let entry = base + (cell.z * size.y + cell.y) * size.x + cell.x;
    if last_entry[channel] != entry + 1u {
        work += 1u;
        last_entry[channel] = entry + 1u;
        last_value[channel] = directory[entry];
    }
    var here = Spot(MISSING, brick, leaving_box(brick, vec3u(0u)));
    if last_value[channel] >= FIRST_SLOT {
        work += 1u;
        let at = brick & vec3u((1u << BLOCK_LOG2) - 1u);
        let block = (last_value[channel] - FIRST_SLOT) << (3u * BLOCK_LOG2);
        here.entry = blocks[block + (((at.z << BLOCK_LOG2) + at.y) << BLOCK_LOG2) + at.x];
    }
    if here.entry == MISSING {
        lose(channel, grid.level, brick);
    }
    if HIDES && here.entry >= FIRST_SLOT && is_range_hidden(channel, ranges[here.entry - FIRST_SLOT]) {
        here.entry = EMPTY;
    }
    mark_used(channel, here.entry);
    return here;
}
