//! The tissue against what it promises.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DVec3, IVec3, UVec3};
use proptest::prelude::*;

use super::*;

fn phantom(nm: f64) -> Phantom {
    Phantom::new(3, DVec3::splat(nm)).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn rows_agree_with_single_voxels(
        seed in 0..5_u64,
        nm in prop::array::uniform3(1.0..50.0),
        at in prop::array::uniform3(0..30_000_u32),
        len in 1..100_usize,
    ) {
        let phantom = Phantom::new(seed, DVec3::from_array(nm)).unwrap();
        let [x, y, z] = at;
        // One sampler that has been elsewhere, and one row at once, and each voxel alone.
        let mut sampler = phantom.sampler();
        let (mut values, mut labels) = (vec![0; len], vec![0; len]);
        sampler.row(x / 2, y / 3, z, &mut values);
        sampler.labels(x, y, z, &mut labels);
        sampler.row(x, y, z, &mut values);
        let mut fresh = vec![0; len];
        phantom.row(x, y, z, &mut fresh);
        prop_assert_eq!(&values, &fresh);
        for (n, x) in (x..).take(len).enumerate() {
            prop_assert_eq!(phantom.value(x, y, z), values[n]);
            prop_assert_eq!(phantom.label(x, y, z), labels[n]);
            prop_assert!(values[n] > 0 && labels[n] > 0);
        }
    }

    /// The candidates that are gathered suffice: the owner and the distance to its border are those
    /// found by looking at everything far and wide.
    #[test]
    fn nearby_candidates_suffice(seed in 0..9_u64, at in prop::array::uniform3(0.0..60_000.0)) {
        let point = DVec3::from_array(at);
        let here = territory::Block::gather(seed, territory::block_of(point)).at(point);
        let all = territory::far_and_wide(seed, point);
        let owner = all.iter().min_by(|a, b| a.distance(point).total_cmp(&b.distance(point))).unwrap();
        prop_assert_eq!(here.territory.id, owner.id);
        let border = all
            .iter()
            .filter(|t| t.id != owner.id)
            .map(|t| (t.distance(point) - owner.distance(point)) / (2.0 * (t.centre - owner.centre).length()))
            .fold(f64::INFINITY, f64::min);
        if border < territory::BORDER_REACH_NM {
            prop_assert!((border - here.border_nm).abs() < 1e-6, "{} or {}", border, here.border_nm);
        } else {
            prop_assert!(here.border_nm.is_infinite());
        }

        let bundle = bundle::Bundle::new(&territory::Territory { centre: point, ..*owner });
        let at = DVec3::from_array(at) * 1e-3 - 20.0;
        let block = bundle.gather(bundle::block_of(at), &mut |_| here);
        let near = bundle.at(&block, at, &mut Vec::new());
        let (owner, border) = bundle.far_and_wide(at);
        prop_assert_eq!(near.site.id, owner);
        if near.border_nm.is_finite() {
            prop_assert!((border - near.border_nm).abs() < 1e-6, "{} or {}", border, near.border_nm);
        } else {
            prop_assert!(border >= 0.15 * bundle.across_nm - 1e-6 || border >= 100.0);
        }
    }
}

#[test]
fn impossible_voxels_are_refused() {
    for bad in [
        DVec3::ZERO,
        DVec3::new(4.0, -4.0, 4.0),
        DVec3::NAN,
        DVec3::INFINITY,
    ] {
        assert!(Phantom::new(1, bad).is_err(), "{bad}");
    }
}

#[test]
fn seeds_differ_and_voxel_sizes_show_the_same_tissue() {
    let fine = phantom(5.0);
    let coarse = phantom(15.0);
    let other = Phantom::new(4, DVec3::splat(5.0)).unwrap();
    let mut same = 0;
    for n in 0..200 {
        // The middle of a coarse voxel is the middle of the fine one in its centre.
        let at = UVec3::new(17 * n + 5, 900 - 3 * n, 40 + n);
        let middle = at * 3 + 1;
        let label = coarse.label(at.x, at.y, at.z);
        assert_eq!(label, fine.label(middle.x, middle.y, middle.z));
        same += usize::from(label == other.label(middle.x, middle.y, middle.z));
    }
    assert_eq!(same, 0);
}

/// A box of labels and values, x fastest.
struct Cube {
    size: UVec3,
    labels: Vec<u64>,
    values: Vec<u8>,
}

impl Cube {
    fn new(phantom: &Phantom, voxels: VoxelBox) -> Self {
        let size = voxels.size();
        let count = usize::try_from(voxels.voxels()).unwrap();
        let (mut labels, mut values) = (vec![0; count], vec![0; count]);
        let mut sampler = phantom.sampler();
        let width = size.x as usize;
        let rows = labels.chunks_mut(width).zip(values.chunks_mut(width));
        for (n, (labels, values)) in (0..).zip(rows) {
            let (y, z) = (voxels.min.y + n % size.y, voxels.min.z + n / size.y);
            sampler.labels(voxels.min.x, y, z, labels);
            sampler.row(voxels.min.x, y, z, values);
        }
        Self {
            size,
            labels,
            values,
        }
    }

    fn index(&self, at: UVec3) -> usize {
        ((at.z * self.size.y + at.y) * self.size.x + at.x) as usize
    }

    /// The voxels up to `reach` away along every axis, itself included.
    fn around(&self, at: UVec3, reach: u32) -> impl Iterator<Item = usize> {
        let inside = VoxelBox::new(at.saturating_sub(UVec3::splat(reach)), at + reach + 1);
        let voxels: Vec<UVec3> = inside
            .intersection(VoxelBox::of_size(self.size))
            .iter()
            .collect();
        voxels.into_iter().map(|at| self.index(at))
    }

    fn voxels(&self) -> impl Iterator<Item = UVec3> + use<> {
        VoxelBox::of_size(self.size).iter()
    }

    fn on_face(&self, at: UVec3) -> bool {
        at.min_element() == 0 || (at + 1).cmpeq(self.size).any()
    }
}

#[test]
fn cells_hang_together() {
    // Wide enough that some cells lie wholly inside.
    let cube = Cube::new(
        &phantom(25.0),
        VoxelBox::new(UVec3::splat(200), UVec3::splat(340)),
    );
    let cut: BTreeSet<u64> = cube
        .voxels()
        .filter(|v| cube.on_face(*v))
        .map(|v| cube.labels[cube.index(v)])
        .collect();
    let mut pieces: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    let mut seen = vec![false; cube.labels.len()];
    for start in cube.voxels() {
        let label = cube.labels[cube.index(start)];
        if seen[cube.index(start)] || cut.contains(&label) {
            continue;
        }
        seen[cube.index(start)] = true;
        let (mut open, mut count) = (vec![start], 0);
        while let Some(at) = open.pop() {
            count += 1;
            let inside = VoxelBox::new(at.saturating_sub(UVec3::ONE), at + 2);
            for next in inside.intersection(VoxelBox::of_size(cube.size)).iter() {
                let index = cube.index(next);
                if !seen[index] && cube.labels[index] == label {
                    seen[index] = true;
                    open.push(next);
                }
            }
        }
        pieces.entry(label).or_default().push(count);
    }
    assert!(pieces.len() > 100, "only {} whole cells", pieces.len());
    let all: usize = pieces.values().flatten().sum();
    let largest: usize = pieces.values().map(|p| p.iter().max().unwrap()).sum();
    // Where a cell is thinner than a voxel, sampling may lose sight of it.
    assert!(
        all - largest <= all / 5_000,
        "{} of {all} voxels lie apart from their cell",
        all - largest
    );
}

#[test]
fn membranes_are_where_labels_change() {
    let cube = Cube::new(
        &phantom(5.0),
        VoxelBox::new(UVec3::new(900, 20, 60), UVec3::new(1150, 240, 110)),
    );
    let (mut border, mut inside) = (Vec::new(), Vec::new());
    for at in cube.voxels().filter(|v| !cube.on_face(*v)) {
        let (label, value) = (cube.labels[cube.index(at)], cube.values[cube.index(at)]);
        let next = [UVec3::X, UVec3::Y, UVec3::Z].map(|axis| cube.labels[cube.index(at + axis)]);
        if next.iter().any(|other| *other != label) {
            border.push(value);
        } else if (at.x + at.y + at.z) % 5 == 0
            && cube.around(at, 6).all(|other| cube.labels[other] == label)
        {
            inside.push(value);
        }
    }
    let share = |values: &[u8], dark: u8| {
        values.iter().filter(|v| **v < dark).count() as f64 / values.len() as f64
    };
    assert!(border.len() > 10_000 && inside.len() > 10_000);
    assert!(
        share(&border, 120) > 0.99,
        "{} of border voxels are dark",
        share(&border, 120)
    );
    assert!(
        share(&inside, 120) < 0.15,
        "{} of inner voxels are dark",
        share(&inside, 120)
    );
    let mean = border.iter().map(|v| f64::from(*v)).sum::<f64>() / border.len() as f64;
    assert!(
        (60.0..90.0).contains(&mean),
        "membranes have a mean of {mean}"
    );
}

#[test]
fn tissue_is_bright_with_dark_membranes() {
    let cube = Cube::new(
        &Phantom::new(1, DVec3::new(4.0, 4.0, 40.0)).unwrap(),
        VoxelBox::new(UVec3::new(0, 0, 5), UVec3::new(1024, 1024, 6)),
    );
    let mean = cube.values.iter().map(|v| f64::from(*v)).sum::<f64>() / cube.values.len() as f64;
    assert!((155.0..175.0).contains(&mean), "mean {mean}");
    let dark = cube.values.iter().filter(|v| **v < 100).count() as f64 / cube.values.len() as f64;
    assert!((0.04..0.2).contains(&dark), "{dark} of the voxels are dark");
}

#[test]
fn synapses_are_dark_and_between_their_cells() {
    let phantom = phantom(4.0);
    let voxels = VoxelBox::new(UVec3::new(1000, 700, 300), UVec3::new(1801, 1503, 849));
    let synapses = phantom.synapses(voxels);
    assert!(synapses.len() > 15, "only {} synapses", synapses.len());
    let (mut darkest, mut elsewhere) = (Vec::new(), Vec::new());
    for synapse in &synapses {
        let at = (synapse.position.xyz / 4.0).floor().as_uvec3();
        assert!(voxels.contains(at));
        assert_ne!(synapse.pre, synapse.post);
        let cube = Cube::new(&phantom, VoxelBox::new(at - 3, at + 4));
        for label in [synapse.pre, synapse.post] {
            assert!(cube.labels.contains(&label), "cell {label} is not at {at}");
        }
        darkest.push(phantom.value(at.x, at.y, at.z));
        let away = at + UVec3::new(71, 53, 0);
        elsewhere.push(phantom.value(away.x, away.y, away.z));
    }
    let darker = |values: &[u8]| values.iter().filter(|v| **v < 75).count();
    assert_eq!(darker(&darkest), synapses.len(), "{darkest:?}");
    assert!(
        darker(&elsewhere) < synapses.len() / 4,
        "elsewhere is brighter: {elsewhere:?}"
    );
}

#[test]
fn boxes_share_out_the_synapses() {
    let phantom = Phantom::new(9, DVec3::new(4.0, 5.0, 40.0)).unwrap();
    let whole = VoxelBox::new(UVec3::new(333, 101, 7), UVec3::new(1333, 902, 78));
    let all = phantom.synapses(whole);
    assert!(all.len() > 10, "only {} synapses", all.len());
    let mut parts = Vec::new();
    for cell in whole.cells(UVec3::new(170, 211, 13)) {
        let min = cell * UVec3::new(170, 211, 13);
        let part = VoxelBox::new(min, min + UVec3::new(170, 211, 13)).intersection(whole);
        parts.extend(phantom.synapses(part));
    }
    let key = |s: &Synapse| s.position.xyz.to_array().map(f64::to_bits);
    parts.sort_by_key(key);
    let mut sorted = all.clone();
    sorted.sort_by_key(key);
    assert_eq!(parts, sorted, "none twice, none missing");
    assert!(phantom.synapses(VoxelBox::EMPTY).is_empty());
}

#[test]
fn bending_can_be_undone() {
    for n in 0..100 {
        let point = IVec3::new(71 * n, 13 * n + 400, 999 - 7 * n).as_dvec3() * 3.0;
        let straight = noise::RowWarp::new(5, point.y, point.z).at(point.x);
        assert!((straight - point).abs().max_element() <= noise::WARP_REACH_NM);
        let back = noise::unwarped(5, straight);
        assert!((back - point).length() < 1e-3, "{point} became {back}");
    }
}
