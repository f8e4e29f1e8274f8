//! Procedural tissue: any extent, any voxel computable alone.
