// Page tables alone [000 fig. 4, 001 section 9.2.1]: two steps, of which the first is left out where the entry is
// the one read last.

const BLOCK_LOG2 = 5u;

var<private> last_entry: array<u32, SLOTS>; // one more than the directory entry read last
var<private> last_value: array<u32, SLOTS>;

fn find(channel: u32, level: u32, depth: f32, ray: vec3f) -> Spot {
    let brick = brick_at(level, depth, ray);
    let size = frame.levels[level].directory;
    let cell = brick >> vec3u(BLOCK_LOG2);
    let base = channel * frame.directory_entries + frame.levels[level].directory_base;
    let entry = base + (cell.z * size.y + cell.y) * size.x + cell.x;
    if last_entry[channel] != entry + 1u {
        work += 1u;
        last_entry[channel] = entry + 1u;
        last_value[channel] = index[entry];
    }
    var here = Spot(MISSING, level, brick, leaving_box(level, brick, 1u, ray));
    if last_value[channel] >= FIRST_SLOT {
        work += 1u;
        let at = brick & vec3u((1u << BLOCK_LOG2) - 1u);
        let block = (last_value[channel] - FIRST_SLOT) << (3u * BLOCK_LOG2);
        here.entry = blocks[block + (((at.z << BLOCK_LOG2) + at.y) << BLOCK_LOG2) + at.x];
    }
    if here.entry == MISSING {
        mark_missed(channel, level, brick);
    }
    if HIDES && here.entry >= FIRST_SLOT && is_range_hidden(channel, ranges[here.entry - FIRST_SLOT]) {
        here.entry = EMPTY;
    }
    mark_used(channel, here.entry);
    return here;
}
