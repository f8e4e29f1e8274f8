// Light.

// Opacity of a length [nm] of a matter of some extinction [1/nm].
fn opacity_of_length(extinction: f32, length_nm: f32) -> f32 {
    return 1.0 - exp(-extinction * length_nm);
}

// sRGB-encoded from linear light, both in [0, 1].
fn srgb_from_linear(linear: vec3f) -> vec3f {
    let l = clamp(linear, vec3f(0.0), vec3f(1.0));
    return select(1.055 * pow(l, vec3f(1.0 / 2.4)) - 0.055, l * 12.92, l <= vec3f(0.0031308));
}

// What is drawn `levels` coarser than wanted: green, then yellow, orange, red. Finer: blue.
fn substitution_tint(levels: i32) -> vec3f {
    if levels < 0 {
        return vec3f(0.1, 0.3, 1.0);
    }
    let t = clamp(f32(levels - 1) / 3.0, 0.0, 1.0);
    return vec3f(min(2.0 * t + 0.1, 1.0), min(2.0 - 2.0 * t, 1.0), 0.0);
}

// What is drawn from a level: red, yellow, green, cyan, blue, magenta in turn, from the finest on.
fn level_tint(level: u32) -> vec3f {
    switch level % 6u {
        case 0u: {
            return vec3f(0.9, 0.1, 0.1);
        }
        case 1u: {
            return vec3f(0.9, 0.7, 0.05);
        }
        case 2u: {
            return vec3f(0.15, 0.7, 0.1);
        }
        case 3u: {
            return vec3f(0.05, 0.7, 0.8);
        }
        case 4u: {
            return vec3f(0.1, 0.2, 1.0);
        }
        default: {
            return vec3f(0.8, 0.15, 0.8);
        }
    }
}

// From black through red and yellow to white, linear, for a share of 0 to 1.
fn heat_color(share: f32) -> vec3f {
    return clamp(vec3f(3.0 * share, 3.0 * share - 1.0, 3.0 * share - 2.0), vec3f(0.0), vec3f(1.0));
}
