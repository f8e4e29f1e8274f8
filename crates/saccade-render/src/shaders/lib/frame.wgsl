// What one frame needs to know. Mirrors `layout.rs`; a test compares the two.

// One level as seen from the eye. Positions count from the corner of an anchor brick near the eye,
// so that f32 is as fine as a voxel needs, however large the volume.
struct Level {
    eye: vec3f,           // the eye [voxels of the level from the anchor's low corner]
    directory_base: u32,  // first entry of the level in the page directory
    anchor: vec3i,        // [bricks of the level]
    voxels_per_nm: vec3f, // voxels of the level per nanometre
    bricks: vec3u,        // bricks per axis
    directory: vec3u,     // directory entries per axis
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
    levels: array<Level, MAX_LEVELS>,
}

// Colours by stored value, and which values are seen at all.
struct Transfer {
    colors: array<vec4f, TABLE_LEN>,       // linear RGB, extinction [1/nm]
    opaque_before: array<u32, 257>,        // entries below that are not transparent
}
