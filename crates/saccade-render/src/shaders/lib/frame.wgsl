// What one frame needs to know. Mirrors `layout.rs`; a test compares the two.

// One level as seen from the eye. Positions count from the corner of an anchor brick near the eye,
// so that f32 is as fine as a voxel needs, however large the volume.
struct Level {
    eye: vec3f,           // the eye [voxels of the level from the anchor's low corner]
    directory_base: u32,  // first entry of the level in the page directory
    anchor: vec3i,        // [bricks of the level]
    voxels_per_nm: vec3f, // voxels of the level per nanometre
    values_depth: u32,    // deepest nodes of the octree that know values of the level
    bricks: vec3u,        // bricks per axis
    directory: vec3u,     // directory entries per axis
}

// Nodes of one depth of the residency octree; the root's depth is 0.
struct Depth {
    shift: u32,              // edge of a node [log2 of cells], a byte per axis
    bits: u32,               // how often each axis was halved since the depth above, a byte per axis
    @size(8) residency: u32, // levels whose bricks are noted at this depth, as bits
}

// The residency octree as seen from the eye, in cells from the low corner of the anchor cell.
struct Octree {
    eye: vec3f,
    slots: u32,          // texels of a node, one per channel
    anchor: vec3i,       // cell near the eye
    cells_per_nm: vec3f,
    cells: vec3u,        // cells that the volume touches, per axis
    @align(16) depths: array<Depth, MOST_DEPTHS>,
}

// A channel that is seen.
struct Channel {
    directory_offset: u32, // entries of the page directory before the channel's
    octree_slot: u32,      // which of a node's channels it is
    first_level: u32,      // finest level that is drawn
    last_level: u32,       // coarsest level that is drawn
    coarser: u32,          // levels coarser than wanted that suffice
    flags: u32,            // CHANNEL_: what the octree says of it holds
    table_scale: f32,      // to entries of the colour table from stored values
    table_offset: f32,
    first_opaque: f32,     // entries from here to
    last_opaque: f32,      // here may be seen, all others are transparent
    visible_bins: u32,     // a bit per bin of stored values: any that is not transparent
    iso: f32,              // stored value of the surface [0, 1]
}

struct Frame {
    forward: vec3f,         // ray through the middle of the picture, 1 nm of depth [nm]
    pixel: f32,             // size that a voxel is to have, per depth
    right: vec3f,           // change of the ray from the middle to the right edge [nm]
    level_count: u32,
    down: vec3f,            // change of the ray from the middle to the lower edge [nm]
    flags: u32,
    low_nm: vec3f,          // low corner of the volume, from the eye [nm]
    depth: u32,             // steps from directory to brick: 2 or 3
    high_nm: vec3f,         // high corner of the volume, from the eye [nm]
    block_edge_log2: u32,   // of page table blocks
    background: vec3f,      // linear RGB
    directory_entries: u32,
    brick_grid: vec3u,      // slots of the brick cache per axis
    first_row: u32,         // of this band
    size: vec2u,            // of the picture [pixels]
    usage_words: u32,       // words of slot usage in the report
    channel_count: u32,     // channels that are seen
    combine: vec2f,         // to a stored value from 0 to 1, of a texel's two parts
    largest: f32,           // stored value that is 1
    heat: u32,              // HEAT_: what is counted and drawn instead of the volume
    heat_full: f32,         // count that is drawn as hot as can be
    levels: array<Level, MAX_LEVELS>,
    octree: Octree,
    channels: array<Channel, MOST_CHANNELS>,
    planes: array<vec4f, MOST_PLANES>, // what is seen has dot(xyz, position from the eye [nm]) + w >= 0
}
