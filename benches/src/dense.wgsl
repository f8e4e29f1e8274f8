// The simplest ray-caster there is: one dense texture, a sample every step, from where the ray
// enters until it leaves or nothing is seen through. No bricks, no tables, no tree.

struct Frame {
    eye: vec3f,          // [voxels]
    forward: vec3f,      // ray through the middle of the picture, 1 nm of depth [nm]
    right: vec3f,        // change of the ray to the right edge [nm]
    down: vec3f,         // change of the ray to the lower edge [nm]
    extent: vec3f,       // [voxels]
    voxels_per_nm: vec3f,
    size: vec2u,         // [pixels]
    step: f32,           // [voxels]
}

@group(0) @binding(0) var<uniform> frame: Frame;
// Linear RGB, extinction [1/nm].
@group(0) @binding(1) var colors: texture_2d<f32>;
@group(0) @binding(2) var volume: texture_3d<f32>;
@group(0) @binding(3) var trilinear: sampler;
@group(0) @binding(4) var image: texture_storage_2d<rgba8unorm, write>;

fn encoded(linear: vec3f) -> vec3f {
    let l = clamp(linear, vec3f(0.0), vec3f(1.0));
    return select(1.055 * pow(l, vec3f(1.0 / 2.4)) - 0.055, l * 12.92, l <= vec3f(0.0031308));
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    if any(id.xy >= frame.size) {
        return;
    }
    let at = (vec2f(id.xy) + 0.5) / vec2f(frame.size) * 2.0 - 1.0;
    let nm = frame.forward + at.x * frame.right + at.y * frame.down;
    let ray = nm * frame.voxels_per_nm;
    let inverse = 1.0 / select(ray, vec3f(1e-20), abs(ray) < vec3f(1e-20));
    let a = -frame.eye * inverse;
    let b = (frame.extent - frame.eye) * inverse;
    let enters = max(max(min(a.x, b.x), min(a.y, b.y)), max(min(a.z, b.z), 0.0));
    let leaves = min(min(max(a.x, b.x), max(a.y, b.y)), max(a.z, b.z));
    let step = frame.step / length(ray);
    var light = vec3f(0.0);
    var transmitted = 1.0;
    for (var start = enters; start < leaves && transmitted > 0.000244140625; start += step) {
        let segment = min(step, leaves - start);
        let position = (frame.eye + (start + 0.5 * segment) * ray) / frame.extent;
        let stored = textureSampleLevel(volume, trilinear, position, 0.0).r * 255.0;
        let entry = min(u32(stored), 254u);
        let low = textureLoad(colors, vec2u(entry, 0u), 0);
        let high = textureLoad(colors, vec2u(entry + 1u, 0u), 0);
        let color = mix(low, high, stored - f32(entry));
        let opacity = 1.0 - exp(-color.a * segment * length(nm));
        light += transmitted * opacity * color.rgb;
        transmitted *= 1.0 - opacity;
    }
    textureStore(image, id.xy, vec4f(encoded(light), 1.0));
}
