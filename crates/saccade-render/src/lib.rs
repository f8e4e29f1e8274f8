//! GPU virtual memory and the ray-caster.
