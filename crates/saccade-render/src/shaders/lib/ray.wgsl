// Rays and boxes. Rays start at the eye; a depth `t` is counted along the viewing direction.

// Components away from zero, so that dividing by them gives a large number and never NaN.
fn divisible(v: vec3f) -> vec3f {
    return select(v, select(vec3f(-1e-20), vec3f(1e-20), v >= vec3f(0.0)), abs(v) < vec3f(1e-20));
}

// Depths at which a ray enters and leaves a box; it misses where the first is not smaller.
fn box_depths(low: vec3f, high: vec3f, ray: vec3f) -> vec2f {
    let inverse = 1.0 / divisible(ray);
    let a = low * inverse;
    let b = high * inverse;
    let near = min(a, b);
    let far = max(a, b);
    return vec2f(max(max(near.x, near.y), max(near.z, 0.0)), min(far.x, min(far.y, far.z)));
}

// The axis of the face through which a ray enters a box; none if it starts inside.
fn entered_face(low: vec3f, high: vec3f, ray: vec3f) -> vec3f {
    let inverse = 1.0 / divisible(ray);
    let near = min(low * inverse, high * inverse);
    let first = max(max(near.x, near.y), near.z);
    let face = select(select(vec3f(0.0, 0.0, 1.0), vec3f(0.0, 1.0, 0.0), near.y == first), vec3f(1.0, 0.0, 0.0), near.x == first);
    return select(vec3f(0.0), face, first > 0.0);
}

// The part of `depths` on the side of a plane where dot(plane.xyz, position) + plane.w >= 0.
fn clipped_depths(depths: vec2f, plane: vec4f, ray: vec3f) -> vec2f {
    let approach = dot(plane.xyz, ray);
    if approach == 0.0 {
        return select(depths, vec2f(1.0, 0.0), plane.w < 0.0);
    }
    let at = -plane.w / approach;
    if approach > 0.0 {
        return vec2f(max(depths.x, at), depths.y);
    }
    return vec2f(depths.x, min(depths.y, at));
}

// Depth at which a ray, at `from` when its depth is 0, leaves a box it is in.
fn leaving_depth(low: vec3f, high: vec3f, from_: vec3f, ray: vec3f) -> f32 {
    let bound = select(low, high, ray >= vec3f(0.0));
    let depths = (bound - from_) / divisible(ray);
    return min(depths.x, min(depths.y, depths.z));
}

// Size in which a box of edges `edges` appears from a direction: the root of its shadow's area.
fn projected_size(edges: vec3f, direction: vec3f) -> f32 {
    return sqrt(dot(abs(normalize(direction)), edges.yzx * edges.zxy));
}

// A fixed number in [0, 1) per pixel, with neighbours far apart (interleaved gradient noise).
fn pixel_noise(pixel: vec2u) -> f32 {
    return fract(52.9829189 * fract(dot(vec2f(pixel), vec2f(0.06711056, 0.00583715))));
}
