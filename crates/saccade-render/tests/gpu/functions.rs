//! The pure functions of `shaders/lib`, one by one, as properties.

use saccade_render::{FalseColors, Gpu, wgpu};

use crate::harness::gpu;

const RAY: &str = include_str!("../../src/shaders/lib/ray.wgsl");
const COLOR: &str = include_str!("../../src/shaders/lib/color.wgsl");
const COUNT: &str = include_str!("../../src/shaders/lib/count.wgsl");

/// The WGSL expression `expr`, a `vec4f`, of each `x: vec4f`, on the device.
fn eval(gpu: &Gpu, lib: &str, expr: &str, inputs: &[[f32; 4]]) -> Vec<[f32; 4]> {
    let source = format!(
        "{lib}
         @group(0) @binding(0) var<storage, read_write> values: array<vec4f>;
         @compute @workgroup_size(1)
         fn main(@builtin(global_invocation_id) id: vec3u) {{
             let x = values[id.x];
             values[id.x] = {expr};
         }}"
    );
    let (device, queue) = (gpu.device(), gpu.queue());
    let bytes = size_of_val(inputs) as u64;
    let buffer = |usage| {
        let descriptor = wgpu::BufferDescriptor {
            label: None,
            size: bytes,
            usage,
            mapped_at_creation: false,
        };
        device.create_buffer(&descriptor)
    };
    let (dst, src) = (wgpu::BufferUsages::COPY_DST, wgpu::BufferUsages::COPY_SRC);
    let values = buffer(wgpu::BufferUsages::STORAGE | dst | src);
    let staging = buffer(wgpu::BufferUsages::MAP_READ | dst);
    queue.write_buffer(&values, 0, bytemuck::cast_slice(inputs));
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(source.into()),
    });
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: None,
        layout: None,
        module: &module,
        entry_point: None,
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    let entry = wgpu::BindGroupEntry {
        binding: 0,
        resource: values.as_entire_binding(),
    };
    let bind_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[entry],
    });
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &bind_group, &[]);
        pass.dispatch_workgroups(inputs.len() as u32, 1, 1);
    }
    encoder.copy_buffer_to_buffer(&values, 0, &staging, 0, bytes);
    queue.submit([encoder.finish()]);
    staging.map_async(wgpu::MapMode::Read, .., |result| result.unwrap());
    device.poll(wgpu::PollType::wait_indefinitely()).unwrap();
    let mapped = staging.get_mapped_range(..).unwrap();
    bytemuck::pod_collect_to_vec(&mapped)
}

#[test]
fn opacity_does_not_depend_on_the_step() {
    let Some(gpu) = gpu() else { return };
    let steps = [0.125, 0.25, 0.5, 1.0, 2.0].map(|step| [step, 0.0, 0.0, 0.0]);
    // 8 / x steps of length x through 8 nm.
    let expr = "vec4f(1.0 - pow(1.0 - opacity_of_length(0.1, x.x), 8.0 / x.x))";
    let want = 1.0 - (-0.8_f32).exp();
    for (step, got) in steps.iter().zip(eval(&gpu, COLOR, expr, &steps)) {
        assert!(
            (got[0] - want).abs() < 1e-5,
            "step {step:?}: {got:?} instead of {want}"
        );
    }
}

/// A legend shows what is drawn.
#[test]
fn levels_have_the_tints_that_are_told() {
    let Some(gpu) = gpu() else { return };
    let levels: Vec<_> = (0..14_u8).map(|n| [f32::from(n), 0.0, 0.0, 0.0]).collect();
    let tints = eval(&gpu, COLOR, "vec4f(level_tint(u32(x.x)), 1.0)", &levels);
    for (level, [rgb @ .., _]) in (0..).zip(&tints) {
        assert_eq!(*rgb, FalseColors::of_level(level), "level {level}");
        let next = FalseColors::of_level(level + 1);
        assert!(rgb != &next, "level {level} and the one after it");
    }
}

/// Sums of two words are those of numbers that have room.
#[test]
fn counters_carry() {
    let Some(gpu) = gpu() else { return };
    // Multiples of 256 are exact in f32.
    let most = 4_294_967_040.0_f32;
    let mut inputs = Vec::new();
    for before in [0.0, 256.0, 2_147_483_648.0, most] {
        for added in [0.0, 256.0, 512.0, 2_147_483_648.0, most] {
            inputs.push([before, added, 0.0, 0.0]);
        }
    }
    let expr = "vec4f(f32(carry_of(u32(x.x), u32(x.y))), 0.0, 0.0, 0.0)";
    let carries = eval(&gpu, COUNT, expr, &inputs);
    for (input, carry) in inputs.iter().zip(&carries) {
        let sum = input[0] as u64 + input[1] as u64;
        assert_eq!(carry[0] as u64, sum >> 32, "{input:?}");
    }
    assert!(carries.iter().any(|c| c[0] > 0.0) && carries.iter().any(|c| c[0] == 0.0));
}

#[test]
fn encoding_keeps_the_ends_and_the_order() {
    let Some(gpu) = gpu() else { return };
    let linear: Vec<_> = (0..=512_u16).map(|n| [f32::from(n) / 512.0; 4]).collect();
    let encoded = eval(&gpu, COLOR, "vec4f(srgb_from_linear(x.xyz), 1.0)", &linear);
    assert_eq!(encoded[0][0], 0.0);
    assert!((encoded[512][0] - 1.0).abs() < 1e-5);
    assert!(encoded.is_sorted_by(|a, b| a[0] < b[0]));
    for (linear, encoded) in linear.iter().zip(&encoded) {
        let back = saccade_core::transfer::linear_from_srgb(encoded[1]);
        assert!(
            (back - linear[1]).abs() < 1e-4,
            "{linear:?} comes back as {back}"
        );
    }
}

#[test]
fn rays_along_faces_and_edges_give_numbers() {
    let Some(gpu) = gpu() else { return };
    let mut rays = Vec::new();
    for x in [-1.0, 0.0, 1.0] {
        for y in [-1.0, -0.0, 1e-30] {
            for z in [-2.0, 0.0, 0.5] {
                rays.push([x, y, z, 0.0]);
            }
        }
    }
    for box_ in [
        "vec3f(0.0), vec3f(1.0)",
        "vec3f(-1.0), vec3f(0.0)",
        "vec3f(-3.0, 0.0, 2.0), vec3f(4.0, 0.0, 9.0)",
    ] {
        let expr = format!("vec4f(box_depths({box_}, x.xyz), 0.0, 0.0)");
        for (ray, got) in rays.iter().zip(eval(&gpu, RAY, &expr, &rays)) {
            assert!(
                got[0] >= 0.0 && !got[1].is_nan(),
                "{box_}, {ray:?}: {got:?}"
            );
        }
    }
    let through =
        "vec4f(box_depths(vec3f(-1.0, -1.0, 2.0), vec3f(1.0, 1.0, 3.0), x.xyz), 0.0, 0.0)";
    let [hit] = eval(&gpu, RAY, through, &[[0.1, 0.0, 0.5, 0.0]])[..] else {
        unreachable!()
    };
    assert!(
        (hit[0] - 4.0).abs() < 1e-5 && (hit[1] - 6.0).abs() < 1e-5,
        "{hit:?}"
    );
    let [miss] = eval(&gpu, RAY, through, &[[0.4, 0.0, -0.5, 0.0]])[..] else {
        unreachable!()
    };
    assert!(miss[0] >= miss[1], "behind the eye: {miss:?}");
}

#[test]
fn voxels_appear_as_large_as_their_shadow() {
    let Some(gpu) = gpu() else { return };
    let expr = "vec4f(projected_size(vec3f(4.0, 4.0, 40.0), x.xyz))";
    let directions = [
        [0.0, 0.0, 7.0, 0.0],
        [-1.0, 0.0, 0.0, 0.0],
        [1.0, 1.0, 0.0, 0.0],
    ];
    let got = eval(&gpu, RAY, expr, &directions);
    let want = [4.0, 160.0_f32.sqrt(), (2.0_f32.sqrt() * 160.0).sqrt()];
    for (got, want) in got.iter().zip(want) {
        assert!((got[0] - want).abs() < 1e-4, "{} instead of {want}", got[0]);
    }
}
