// Mirrors `layout.rs`; a test compares the two.

const WORKGROUP = 8u;
const BRICK_EDGE = 32u;
const BRICK_BORDER = 1u;
const BRICK_STORED_EDGE = 34u;
const MAX_LEVELS = 32u;
const TABLE_LEN = 256u;

const EMPTY = 1u;
const FIRST_SLOT = 2u;
const STALE = 0x80000000u;

const FLAG_SUBSTITUTE = 1u;
const FLAG_JITTER = 4u;
const FLAG_OCTREE = 8u;
const FLAG_NEAREST = 16u;

const MOST_CHANNELS = 16u;
const MOST_PLANES = 6u;
const CHANNEL_VALUES = 1u;
const CHANNEL_RESIDENCY = 2u;

const MODE_EMISSION_ABSORPTION = 0u;
const MODE_MAXIMUM = 1u;
const MODE_ISO_SURFACE = 2u;

const FALSE_NONE = 0u;
const FALSE_RESIDENCY = 1u;
const FALSE_LEVEL = 2u;

const HEAT_NONE = 0u;
const HEAT_LOOKUPS = 1u;
const HEAT_NODES = 2u;
const HEAT_SAMPLES = 3u;

const COUNTERS = 16u;
const COUNT_MISSES = 0u;
const COUNT_STALE = 1u;
const COUNT_SAMPLES = 2u;
const COUNT_LOOKUPS = 3u;
const COUNT_SUBSTITUTED = 4u;
const MOST_SUBSTITUTED_LEVELS = 5u;
const FINEST_LEVEL = 6u;
const COUNT_NODES = 7u;
const COUNT_RAYS = 8u;
const MOST_LOOKUPS = 9u;
const FEWEST_LOOKUPS = 10u;
const TALLIES = 11u;
const COUNT_SAMPLES_HIGH = 11u;

const MOST_DEPTHS = 24u;
const SIBLINGS = 8u;
const NODE_ROW = 4096u;
const PATH_HOLDS = 8u;
const NODE_BINS = 0u;
const NODE_RANGE = 1u;
const NODE_VALID = 2u;
const NODE_CHILDREN = 3u;

const MISSES = 4096u;
const MISSES_PER_RAY = 4u;
const MISSES_PER_CHANNEL = 2u;
