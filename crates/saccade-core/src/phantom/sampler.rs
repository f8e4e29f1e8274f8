//! Walks along rows of voxels, remembering which candidates are near.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DVec3, IVec3};

use super::Phantom;
use super::bundle::{self, Bundle, Neurite};
use super::noise::RowWarp;
use super::paint::RowPaint;
use super::territory::{self, Here, Territory, Tissue};

/// Blocks remembered before the memory is emptied; about 40 MB.
const REMEMBERED: usize = 30_000;

/// Reads voxels of a phantom quickly, as long as they are near each other.
///
/// Answers are those of [`Phantom::value`] and [`Phantom::label`]; only the time differs. Uses up
/// to some tens of megabytes.
#[derive(Debug)]
pub struct Sampler {
    phantom: Phantom,
    blocks: HashMap<IVec3, Arc<territory::Block>>,
    bundles: HashMap<u64, Arc<Bundle>>,
    bundle_blocks: HashMap<(u64, IVec3), Arc<bundle::Block>>,
}

/// Everything known about one point of the tissue.
pub(super) struct Spot<'a> {
    /// Where it is in the straight geometry \[nm\].
    pub(super) straight: DVec3,
    pub(super) here: Here,
    pub(super) neurite: Option<InBundle<'a>>,
    pub(super) label: u64,
    /// Distance to the nearest border between cells \[nm\]; infinite if beyond reach.
    pub(super) border_nm: f64,
}

/// A point inside a bundle.
pub(super) struct InBundle<'a> {
    pub(super) bundle: &'a Bundle,
    pub(super) block: &'a bundle::Block,
    /// Where it is in the bundle's lattice space.
    pub(super) at: DVec3,
    pub(super) neurite: Neurite,
}

impl Sampler {
    pub(super) fn new(phantom: Phantom) -> Self {
        let (blocks, bundles) = (HashMap::new(), HashMap::new());
        Self {
            phantom,
            blocks,
            bundles,
            bundle_blocks: HashMap::new(),
        }
    }

    /// Writes the values of the voxels from (`x0`, `y`, `z`) along x.
    pub fn row(&mut self, x0: u32, y: u32, z: u32, values: &mut [u8]) {
        let row = self.phantom.row_nm(y, z);
        let mut paint = RowPaint::new(&self.phantom, y, z);
        let mut slots = values.iter_mut();
        let len = slots.len();
        self.walk(x0, row, len, |x, x_nm, spot| {
            if let Some(slot) = slots.next() {
                *slot = paint.value(x, x_nm, spot);
            }
        });
    }

    /// Writes the labels of the voxels from (`x0`, `y`, `z`) along x.
    pub fn labels(&mut self, x0: u32, y: u32, z: u32, labels: &mut [u64]) {
        let row = self.phantom.row_nm(y, z);
        let mut slots = labels.iter_mut();
        let len = slots.len();
        self.walk(x0, row, len, |_, _, spot| {
            if let Some(slot) = slots.next() {
                *slot = spot.label;
            }
        });
    }

    fn walk(
        &mut self,
        x0: u32,
        (y_nm, z_nm): (f64, f64),
        len: usize,
        mut each: impl FnMut(u32, f64, &Spot<'_>),
    ) {
        let mut warp = RowWarp::new(self.phantom.warp_seed(), y_nm, z_nm);
        // What the last step found near; the next step mostly finds the same.
        let mut block: Option<(IVec3, Arc<territory::Block>)> = None;
        let mut bundle: Option<Arc<Bundle>> = None;
        let mut bundle_block: Option<(u64, IVec3, Arc<bundle::Block>)> = None;
        let mut distances = Vec::new();
        for (x, _) in (x0..).zip(0..len) {
            let x_nm = self.phantom.x_nm(x);
            let straight = warp.at(x_nm);
            let id = territory::block_of(straight);
            let block = match &mut block {
                Some((known, block)) if *known == id => block,
                stale => &mut stale.insert((id, self.block(id))).1,
            };
            let here = block.at(straight);
            if here.territory.tissue != Tissue::Bundle {
                let (label, border_nm) = (here.territory.id, here.border_nm);
                each(
                    x,
                    x_nm,
                    &Spot {
                        straight,
                        here,
                        neurite: None,
                        label,
                        border_nm,
                    },
                );
                continue;
            }
            let bundle = match &mut bundle {
                Some(bundle) if bundle.id == here.territory.id => bundle,
                stale => stale.insert(self.bundle(&here.territory)),
            };
            let at = bundle.lattice(straight);
            let id = bundle::block_of(at);
            let block = match &mut bundle_block {
                Some((owner, known, block)) if (*owner, *known) == (bundle.id, id) => block,
                stale => {
                    &mut stale
                        .insert((bundle.id, id, self.bundle_block(bundle, id)))
                        .2
                }
            };
            let neurite = bundle.at(block, at, &mut distances);
            let label = bundle.label(neurite.site.id);
            let border_nm = here.border_nm.min(neurite.border_nm);
            let neurite = Some(InBundle {
                bundle,
                block,
                at,
                neurite,
            });
            each(
                x,
                x_nm,
                &Spot {
                    straight,
                    here,
                    neurite,
                    label,
                    border_nm,
                },
            );
        }
    }

    pub(super) fn bundle(&mut self, territory: &Territory) -> Arc<Bundle> {
        remembered(&mut self.bundles, territory.id, || Bundle::new(territory))
    }

    pub(super) fn block(&mut self, id: IVec3) -> Arc<territory::Block> {
        let seed = self.phantom.territory_seed();
        remembered(&mut self.blocks, id, || territory::Block::gather(seed, id))
    }

    pub(super) fn territory_at(&mut self, straight: DVec3) -> Here {
        self.block(territory::block_of(straight)).at(straight)
    }

    fn bundle_block(&mut self, bundle: &Bundle, id: IVec3) -> Arc<bundle::Block> {
        if let Some(block) = self.bundle_blocks.get(&(bundle.id, id)) {
            return Arc::clone(block);
        }
        let block = bundle.gather(id, &mut |straight| self.territory_at(straight));
        remembered(&mut self.bundle_blocks, (bundle.id, id), || block)
    }
}

fn remembered<K: std::hash::Hash + Eq, V>(
    memory: &mut HashMap<K, Arc<V>>,
    key: K,
    make: impl FnOnce() -> V,
) -> Arc<V> {
    if let Some(value) = memory.get(&key) {
        return Arc::clone(value);
    }
    if memory.len() >= REMEMBERED {
        memory.clear();
    }
    let value = Arc::new(make());
    memory.insert(key, Arc::clone(&value));
    value
}
