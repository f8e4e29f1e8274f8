// The shortest ray-caster that reads one dense 3D texture: what a chip's texture units give to compute kernels.
// Rays, steps and ends are those of benches/src/dense.wgsl; the colour table is left out.

struct Rays {
    float4 eye;            // [voxels]
    float4 forward;        // ray through the middle of the picture, 1 nm of depth [nm]
    float4 right;          // change of the ray to the right edge [nm]
    float4 down;           // change of the ray to the lower edge [nm]
    float4 extent;         // [voxels]
    float4 voxels_per_nm;
    uint4 size;            // [pixels]
    float4 step;           // [voxels], then extinction of the brightest [1/nm]
};

extern "C" __global__ void march(cudaTextureObject_t volume, Rays r, float *image, unsigned *samples) {
    unsigned x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
    if (x >= r.size.x || y >= r.size.y) return;
    float u = (x + 0.5f) / r.size.x * 2.0f - 1.0f, v = (y + 0.5f) / r.size.y * 2.0f - 1.0f;
    float nm[3] = {r.forward.x + u * r.right.x + v * r.down.x, r.forward.y + u * r.right.y + v * r.down.y,
                   r.forward.z + u * r.right.z + v * r.down.z};
    float scale[3] = {r.voxels_per_nm.x, r.voxels_per_nm.y, r.voxels_per_nm.z};
    float eye[3] = {r.eye.x, r.eye.y, r.eye.z}, extent[3] = {r.extent.x, r.extent.y, r.extent.z};
    float ray[3], enters = 0.0f, leaves = 1e30f;
    for (int axis = 0; axis < 3; axis++) {
        ray[axis] = nm[axis] * scale[axis];
        float inverse = 1.0f / (fabsf(ray[axis]) < 1e-20f ? 1e-20f : ray[axis]);
        float a = -eye[axis] * inverse, b = (extent[axis] - eye[axis]) * inverse;
        enters = fmaxf(enters, fminf(a, b));
        leaves = fminf(leaves, fmaxf(a, b));
    }
    float step = r.step.x / sqrtf(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
    float thick = r.step.y * sqrtf(nm[0] * nm[0] + nm[1] * nm[1] + nm[2] * nm[2]);
    float light = 0.0f, transmitted = 1.0f;
    unsigned taken = 0;
    for (float start = enters; start < leaves && transmitted > 0.000244140625f; start += step) {
        float segment = fminf(step, leaves - start), at = start + 0.5f * segment;
        float value = tex3D<float>(volume, (eye[0] + at * ray[0]) / extent[0], (eye[1] + at * ray[1]) / extent[1],
                                   (eye[2] + at * ray[2]) / extent[2]);
        float opacity = 1.0f - __expf(-value * thick * segment);
        light += transmitted * opacity * value;
        transmitted *= 1.0f - opacity;
        taken++;
    }
    image[y * r.size.x + x] = light;
    samples[y * r.size.x + x] = taken;
}
