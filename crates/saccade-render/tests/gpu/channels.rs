//! Several channels, and 16 bit.

use std::collections::HashSet;

use glam::{DVec3, UVec2};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, linear_from_srgb};
use saccade_core::volume::Polarity;
use saccade_render::{
    ChannelError, ChannelView, Fidelity, Gpu, Image, Mode, Renderer, RendererOptions, Traversal,
    View,
};

use crate::harness::{caught_up, frame, gpu, keep, psnr, read, settle};
use crate::oracle::{self, Cut};
use crate::scene::{Scene, ramp, specks, stained, tissue, waves};

/// A picture counts as the oracle's from here on \[dB\].
const SAME: f64 = 45.0;
const SIZE: UVec2 = UVec2::new(72, 56);

fn cameras(scene: &Scene) -> [(&'static str, Camera); 3] {
    let around = Camera::around(&scene.volume);
    let inside = Camera {
        distance_nm: 1e-3,
        target: Point::new(scene.volume.size_nm() * 0.45),
        ..around
    };
    [
        ("corner", around.zoomed(1.3)),
        ("near", around.zoomed(4.0)),
        ("inside", inside),
    ]
}

fn renderer(gpu: &Gpu, scene: &Scene, options: RendererOptions) -> Renderer {
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    renderer
}

fn picture(gpu: &Gpu, scene: &Scene, view: &View, options: RendererOptions) -> Image {
    let mut renderer = renderer(gpu, scene, options);
    let reports = settle(&mut renderer, view, scene);
    assert!(reports.last().unwrap().is_complete());
    read(&renderer)
}

fn view(camera: Camera) -> View {
    View {
        background: [0.1, 0.2, 0.4],
        ..View::new(camera, SIZE)
    }
}

#[test]
fn channels_add_up_as_the_oracle_says() {
    let Some(gpu) = gpu() else { return };
    let scene = stained();
    for (name, camera) in cameras(&scene) {
        let view = view(camera);
        let want = oracle::render(&scene, &view, Cut::HalfVoxels);
        keep(&format!("stained-{name}-oracle"), &want);
        for traversal in [Traversal::ResidencyOctree, Traversal::PageTables] {
            let options = RendererOptions {
                traversal,
                ..RendererOptions::default()
            };
            let got = picture(&gpu, &scene, &view, options);
            keep(&format!("stained-{name}-{traversal:?}"), &got);
            let db = psnr(&got, &want);
            assert!(db >= SAME, "{name}, {traversal:?}: {db:.1} dB");
        }
    }
    // Two of three, or in other places, is another picture.
    let view = view(cameras(&scene)[0].1);
    let want = oracle::render(&scene, &view, Cut::HalfVoxels);
    let mut fewer = stained();
    fewer.others.pop();
    let mut mixed = stained();
    mixed.others.swap(0, 1);
    for (what, other) in [("fewer", &fewer), ("mixed", &mixed)] {
        let got = oracle::render(other, &view, Cut::HalfVoxels);
        let db = psnr(&got, &want);
        match what {
            "fewer" => assert!(db < SAME - 10.0, "{what}: {db:.1} dB"),
            // Light does not depend on the order of channels.
            _ => assert!(db > 80.0, "{what}: {db:.1} dB"),
        }
    }
}

#[test]
fn sixteen_bit_looks_as_eight_bit_does() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in [("waves", waves()), ("stained", stained())] {
        let view = view(Camera::around(&scene.volume).zoomed(1.5));
        let want = oracle::render(&scene, &view, Cut::HalfVoxels);
        // Twelve bits, all sixteen, and so few values that a table over all would have one entry.
        for factor in [16, 257, 1] {
            let deep = match factor {
                1 => waves_of_few_values(),
                _ if name == "waves" => waves().deep(factor),
                _ => stained().deep(factor),
            };
            for split_16_bit in [false, true] {
                let options = RendererOptions {
                    split_16_bit,
                    ..RendererOptions::default()
                };
                let got = picture(&gpu, &deep, &view, options);
                keep(&format!("deep-{name}-{factor}-{split_16_bit}"), &got);
                let db = match factor {
                    1 => psnr(&got, &oracle::render(&waves(), &view, Cut::HalfVoxels)),
                    _ => psnr(&got, &want),
                };
                assert!(db >= SAME, "{name} x {factor}, {split_16_bit}: {db:.1} dB");
            }
        }
    }
}

/// Contrast is a matter of the colour table alone.
#[test]
fn another_contrast_asks_for_nothing() {
    let Some(gpu) = gpu() else { return };
    let scene = waves().deep(16);
    let view = view(Camera::around(&scene.volume).zoomed(1.5));
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    let reports = settle(&mut renderer, &view, &scene);
    let asked = reports.iter().map(|report| report.misses.len());
    assert!(asked.sum::<usize>() > 0, "bricks were never asked for");
    let [own] = scene.views().try_into().unwrap();
    let resident = renderer.memory().bricks_resident;
    let mut pictures = vec![read(&renderer)];
    for step in 1..=5_u8 {
        let mut other = ChannelView::clone(&own);
        let share = f32::from(step) * 0.08;
        other.transfer.window = [
            own.transfer.window[0] + share * own.transfer.window[1],
            own.transfer.window[1] * (1.0 - share),
        ];
        renderer.set_channels(&[other]).unwrap();
        let report = frame(&mut renderer, &view);
        assert!(report.is_complete() && !report.redraw, "window {step}");
        assert_eq!(report.misses, [], "window {step}");
        assert_eq!(report.fidelity.missing, 0, "window {step}");
        assert_eq!(renderer.memory().bricks_resident, resident);
        let picture = read(&renderer);
        assert!(!pictures.contains(&picture), "window {step} looks the same");
        pictures.push(picture);
    }
    renderer.set_channels(&[own]).unwrap();
    assert!(frame(&mut renderer, &view).misses.is_empty());
    assert!(read(&renderer) == pictures[0], "there and back");
}

/// Values of the waves as they are, in 16 bit: 0.4 % of all that there are.
fn waves_of_few_values() -> Scene {
    waves().deep(2)
}

/// Dark structures are inverted in all their bits. Where matter ends, 8 and 16 bit pass through
/// other values on the way to nothing, so the eye is inside.
#[test]
fn dark_structures_of_sixteen_bit_are_inverted() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let middle = scene.volume.size_nm() * DVec3::new(0.3, 0.6, 0.5);
    let camera = Camera {
        distance_nm: 1e-3,
        target: Point::new(middle),
        ..Camera::around(&scene.volume)
    };
    let view = view(camera);
    let want = oracle::render(&scene, &view, Cut::HalfVoxels);
    let got = picture(&gpu, &tissue().deep(257), &view, RendererOptions::default());
    let db = psnr(&got, &want);
    assert!(db >= 40.0, "{db:.1} dB");
    let mut bright = tissue();
    bright.transfer.polarity = Polarity::Bright;
    bright.table = bright.transfer.table();
    let db = psnr(&got, &oracle::render(&bright, &view, Cut::HalfVoxels));
    assert!(db < 35.0, "another polarity: {db:.1} dB");
}

/// Any set of channels gives the picture that a renderer which never had others gives.
#[test]
fn channels_are_exchanged_without_a_trace() {
    let Some(gpu) = gpu() else { return };
    let scene = stained();
    let camera = Camera::around(&scene.volume).zoomed(1.5);
    let view = view(camera);
    let all = scene.views();
    let mut exchanged = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    let mut delivered = HashSet::new();
    let sets: [&[u32]; 8] = [&[0], &[1, 2], &[2], &[0, 1, 2], &[], &[1], &[2, 0], &[0]];
    for set in sets {
        let views: Vec<ChannelView> = set.iter().map(|&c| all[c as usize].clone()).collect();
        // In flight from the set before.
        exchanged.render(&view);
        exchanged.set_channels(&views).unwrap();
        let first = pollster::block_on(exchanged.finish());
        let reports = settle(&mut exchanged, &view, &scene);
        for report in first.iter().chain(&reports) {
            for id in &report.misses {
                assert!(set.contains(&id.channel()), "{id} is wanted by {set:?}");
                delivered.insert(*id);
            }
        }
        let mut fresh = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
        fresh.set_channels(&views).unwrap();
        settle(&mut fresh, &view, &scene);
        let db = psnr(&read(&exchanged), &read(&fresh));
        assert!(db > 60.0, "{set:?}: {db:.1} dB");
    }
    // Everything was seen before: nothing is asked for again.
    exchanged.set_channels(&all).unwrap();
    let report = frame(&mut exchanged, &view);
    assert!(report.misses.is_empty(), "{:?}", report.misses);
    assert_eq!(report.fidelity.missing, 0);
    assert!(delivered.len() > 3);
}

/// With a slot for each of sixteen, one more channel takes the place of another; also in a volume of 64.
#[test]
fn the_octree_makes_room_for_other_channels() {
    let Some(gpu) = gpu() else { return };
    let gray = |from| {
        ramp(
            Polarity::Bright,
            ColorMap::Gray,
            &[(from, 0.0), (0.9, 0.4)],
            40.0,
        )
    };
    let extent = glam::UVec3::new(40, 40, 40);
    let channel = |n: u32| {
        Scene::new(extent, DVec3::splat(4.0), gray(0.2), move |nm| {
            let spot = DVec3::new(f64::from(n % 5), f64::from(n / 5 % 5), f64::from(n / 25)) * 32.0;
            230.0 * (1.0 - (nm - spot).length() / 40.0).max(0.05)
        })
    };
    let scene = Scene::of_channels((0..64).map(channel).collect());
    let view = view(Camera::around(&scene.volume));
    let all = scene.views();
    let mut exchanged = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    for set in [&all[..16], &all[4..20], &all[48..], &all[..3], &all[10..19]] {
        exchanged.set_channels(set).unwrap();
        settle(&mut exchanged, &view, &scene);
        let plain = RendererOptions {
            traversal: Traversal::PageTables,
            ..RendererOptions::default()
        };
        let mut fresh = Renderer::new(&gpu, scene.volume.clone(), plain).unwrap();
        fresh.set_channels(set).unwrap();
        settle(&mut fresh, &view, &scene);
        let db = psnr(&read(&exchanged), &read(&fresh));
        assert!(db > 60.0, "{} channels: {db:.1} dB", set.len());
    }
    let seventeen = exchanged.set_channels(&all[..17]);
    assert_eq!(seventeen, Err(ChannelError::TooMany { got: 17, most: 16 }));
    let twice = [all[3].clone(), all[3].clone()];
    let refused = exchanged.set_channels(&twice);
    assert_eq!(refused, Err(ChannelError::Twice { channel: 3 }));
    let mut beyond = all[0].clone();
    beyond.channel = 64;
    let refused = exchanged.set_channels(&[beyond]);
    let channels = 64;
    assert_eq!(
        refused,
        Err(ChannelError::NoSuchChannel {
            channel: 64,
            channels
        })
    );
    assert_eq!(exchanged.channels().len(), 9, "refused sets change nothing");
}

/// Samples of a frame whose octree knows all that it will.
fn samples(renderer: &mut Renderer, view: &View) -> u64 {
    caught_up(renderer, view).statistics.samples
}

/// What was known of resident bricks is known again when their channel is seen again, or has the bins it had.
#[test]
fn a_channel_that_comes_back_is_skipped_as_before() {
    let Some(gpu) = gpu() else { return };
    let mut scene = specks().deep(16);
    let names = (0..17).map(|n| format!("channel {n}"));
    scene.volume = std::sync::Arc::new(saccade_core::volume::Volume {
        channels: names.collect(),
        ..(*scene.volume).clone()
    });
    let view = view(Camera::around(&scene.volume).zoomed(2.0));
    let own = &scene.views().remove(0);
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    renderer.set_channels(std::slice::from_ref(own)).unwrap();
    settle(&mut renderer, &view, &scene);
    let before = samples(&mut renderer, &view);
    let plain = RendererOptions {
        traversal: Traversal::PageTables,
        ..RendererOptions::default()
    };
    let mut without = Renderer::new(&gpu, scene.volume.clone(), plain).unwrap();
    without.set_channels(std::slice::from_ref(own)).unwrap();
    settle(&mut without, &view, &scene);
    let all = samples(&mut without, &view);
    assert!(2 * before < all, "{before} of {all}: nothing is skipped");

    // Sixteen others take all there is room for.
    let others = (1..17).map(|channel| ChannelView {
        channel,
        ..own.clone()
    });
    renderer.set_channels(&others.collect::<Vec<_>>()).unwrap();
    frame(&mut renderer, &view);
    renderer.set_channels(std::slice::from_ref(own)).unwrap();
    assert_eq!(samples(&mut renderer, &view), before, "exchanged");

    let wider = ChannelView {
        significant_bits: own.significant_bits + 1,
        ..own.clone()
    };
    renderer.set_channels(&[wider]).unwrap();
    let other_bins = samples(&mut renderer, &view);
    assert!(2 * other_bins < all, "{other_bins} of {all}");
    renderer.set_channels(std::slice::from_ref(own)).unwrap();
    assert_eq!(samples(&mut renderer, &view), before, "bins there and back");
}

#[test]
fn a_channel_keeps_to_its_levels() {
    let Some(gpu) = gpu() else { return };
    let scene = stained();
    let view = view(Camera::around(&scene.volume).zoomed(4.0));
    let mut views = scene.views();
    views[0].levels = 1..=1;
    views[1].coarser = 2;
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    renderer.set_channels(&views).unwrap();
    let reports = settle(&mut renderer, &view, &scene);
    let missed: HashSet<_> = reports.iter().flat_map(|r| r.misses.clone()).collect();
    let levels = |channel| {
        let of = missed.iter().filter(|id| id.channel() == channel);
        of.map(|id| id.level()).collect::<HashSet<_>>()
    };
    assert_eq!(levels(0), HashSet::from([1]));
    assert!(levels(2).contains(&0), "{:?}", levels(2));
    assert!(
        !levels(1).contains(&0) && !levels(1).contains(&1),
        "{:?}",
        levels(1)
    );
    let Fidelity { level, .. } = reports.last().unwrap().fidelity;
    assert_eq!(level, Some(0));
}

/// The light of two maxima is that of each alone, also where their channels are drawn from several levels.
#[test]
fn channels_of_several_levels_lie_where_each_alone_does() {
    let Some(gpu) = gpu() else { return };
    let scene = stained();
    let view = View {
        mode: Mode::Maximum,
        background: [0.0; 3],
        ..view(Camera::around(&scene.volume).zoomed(4.0))
    };
    let mut views = scene.views();
    views.truncate(2);
    views[1].levels = 1..=1;
    let light_of = |views: &[ChannelView]| {
        let mut renderer = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
        renderer.set_channels(views).unwrap();
        settle(&mut renderer, &view, &scene);
        let linear = |value: &u8| f64::from(linear_from_srgb(f32::from(*value) / 255.0));
        read(&renderer).rgba.iter().map(linear).collect::<Vec<_>>()
    };
    let [both, first, second] = [&views[..], &views[..1], &views[1..]].map(light_of);
    let (mut most, mut off) = (0.0_f64, 0.0);
    for (pixel, value) in both.iter().enumerate().filter(|(at, _)| at % 4 < 3) {
        let want = (first[pixel] + second[pixel]).min(1.0);
        most = most.max(want);
        off += (value - want).powi(2) / both.len() as f64;
    }
    assert!(most > 0.3, "hardly anything is seen: {most}");
    let off = off.sqrt();
    assert!(off < 0.01, "{off}");
}
