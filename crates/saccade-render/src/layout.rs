//! What Rust and WGSL must agree on. The test below compares the two, without a GPU.

use bytemuck::{Pod, Zeroable};
use glam::{IVec3, UVec2, UVec3, Vec2, Vec3, Vec4};
use saccade_core::brick::MAX_LEVELS;

/// Edge of a workgroup \[pixels\].
pub(crate) const WORKGROUP: u32 = 8;

/// Draw missing bricks from other levels.
pub(crate) const FLAG_SUBSTITUTE: u32 = 1;
/// Sample segments at a place that differs by pixel.
pub(crate) const FLAG_JITTER: u32 = 4;

/// Skip and substitute by the residency octree.
pub(crate) const FLAG_OCTREE: u32 = 8;
/// Values are not mixed between voxels.
pub(crate) const FLAG_NEAREST: u32 = 16;

/// Channels that can be seen at once.
pub(crate) const MOST_CHANNELS: usize = 16;
/// Planes that cut the volume, those of a slab included.
pub(crate) const MOST_PLANES: usize = 6;
/// What the octree says of a channel's values holds.
pub(crate) const CHANNEL_VALUES: u32 = 1;
/// The octree notes every resident brick of the channel: levels it does not name are not there.
pub(crate) const CHANNEL_RESIDENCY: u32 = 2;

/// How samples become a picture: integrated light.
pub(crate) const MODE_EMISSION_ABSORPTION: u32 = 0;
/// The largest value.
pub(crate) const MODE_MAXIMUM: u32 = 1;
/// The first surface.
pub(crate) const MODE_ISO_SURFACE: u32 = 2;

/// Colours are those of values.
pub(crate) const FALSE_NONE: u32 = 0;
/// What is drawn from another level than wanted is tinted, and what is missing lies in fog.
pub(crate) const FALSE_RESIDENCY: u32 = 1;
/// All is tinted by the level it is drawn from.
pub(crate) const FALSE_LEVEL: u32 = 2;

/// The volume is drawn.
pub(crate) const HEAT_NONE: u32 = 0;
/// Page table walks are drawn.
pub(crate) const HEAT_LOOKUPS: u32 = 1;
/// Nodes visited are drawn.
pub(crate) const HEAT_NODES: u32 = 2;
/// Samples taken are drawn.
pub(crate) const HEAT_SAMPLES: u32 = 3;

/// Words at the front of a report.
pub(crate) const COUNTERS: u32 = 16;
/// Distinct entries missed, also those the list had no room for.
pub(crate) const COUNT_MISSES: u32 = 0;
/// Of those, out of date ones.
pub(crate) const COUNT_STALE: u32 = 1;
/// Samples taken: the lower word, see [`COUNT_SAMPLES_HIGH`].
pub(crate) const COUNT_SAMPLES: u32 = 2;
/// Entries read of the page directory and of page tables \[000 fig. 6\].
pub(crate) const COUNT_LOOKUPS: u32 = 3;
/// Segments drawn from another level than wanted.
pub(crate) const COUNT_SUBSTITUTED: u32 = 4;
/// Levels between wanted and drawn, at most.
pub(crate) const MOST_SUBSTITUTED_LEVELS: u32 = 5;
/// [`MAX_LEVELS`] less the finest level wanted; 0 where no ray met the volume.
pub(crate) const FINEST_LEVEL: u32 = 6;

/// Nodes of the residency octree visited.
pub(crate) const COUNT_NODES: u32 = 7;

/// Rays that met the volume.
pub(crate) const COUNT_RAYS: u32 = 8;
/// Entries read by the ray that read the most.
pub(crate) const MOST_LOOKUPS: u32 = 9;
/// `u32::MAX` less the entries read by the ray that read the fewest.
pub(crate) const FEWEST_LOOKUPS: u32 = 10;
/// Samples taken: the higher word.
pub(crate) const COUNT_SAMPLES_HIGH: u32 = 11;

/// Depths that a residency octree can have, its root's included.
pub(crate) const MOST_DEPTHS: usize = 24;
/// Children of a node of the residency octree, kept side by side.
pub(crate) const SIBLINGS: u32 = 8;
/// Texels in a row of the texture of nodes, of which each node has one per channel.
pub(crate) const NODE_ROW: u32 = 4096;
/// Words of a texel.
pub(crate) const NODE_WORDS: u32 = 4;
/// Word of a texel: a bit per eight stored values that samples may have.
pub(crate) const NODE_BINS: u32 = 0;
/// Word of a texel: smallest and largest stored value, 16 bits each.
pub(crate) const NODE_RANGE: u32 = 1;
/// Word of a texel: levels for whose samples bins and range hold, as bits.
pub(crate) const NODE_VALID: u32 = 2;
/// Word of a texel, the same in all of a node: block of its children, 0 where it has none.
pub(crate) const NODE_CHILDREN: u32 = 3;

/// Misses a report has room for. Others are reported by a later frame.
pub(crate) const MISSES: u32 = 4096;

/// One level as seen from the eye.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct LevelUniform {
    pub(crate) eye: Vec3,
    pub(crate) directory_base: u32,
    pub(crate) anchor: IVec3,
    pub(crate) pad_0: u32,
    pub(crate) voxels_per_nm: Vec3,
    pub(crate) values_depth: u32,
    pub(crate) bricks: UVec3,
    pub(crate) pad_2: u32,
    pub(crate) directory: UVec3,
    pub(crate) pad_3: u32,
}

/// Nodes of one depth of the residency octree.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct DepthUniform {
    /// One byte per axis.
    pub(crate) shift: u32,
    /// One byte per axis.
    pub(crate) bits: u32,
    pub(crate) residency: u32,
    pub(crate) pad_0: u32,
}

/// The residency octree as seen from the eye. Fields are explained in `lib/frame.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct OctreeUniform {
    pub(crate) eye: Vec3,
    pub(crate) slots: u32,
    pub(crate) anchor: IVec3,
    pub(crate) pad_0: u32,
    pub(crate) cells_per_nm: Vec3,
    pub(crate) pad_1: u32,
    pub(crate) cells: UVec3,
    pub(crate) pad_2: u32,
    pub(crate) depths: [DepthUniform; MOST_DEPTHS],
}

/// A channel that is seen. Fields are explained in `lib/frame.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ChannelUniform {
    pub(crate) directory_offset: u32,
    pub(crate) octree_slot: u32,
    pub(crate) first_level: u32,
    pub(crate) last_level: u32,
    pub(crate) coarser: u32,
    pub(crate) flags: u32,
    pub(crate) table_scale: f32,
    pub(crate) table_offset: f32,
    pub(crate) first_opaque: f32,
    pub(crate) last_opaque: f32,
    pub(crate) visible_bins: u32,
    pub(crate) iso: f32,
}

/// One frame. Fields are explained in `lib/frame.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct FrameUniform {
    pub(crate) forward: Vec3,
    pub(crate) pixel: f32,
    pub(crate) right: Vec3,
    pub(crate) level_count: u32,
    pub(crate) down: Vec3,
    pub(crate) flags: u32,
    pub(crate) low_nm: Vec3,
    pub(crate) depth: u32,
    pub(crate) high_nm: Vec3,
    pub(crate) block_edge_log2: u32,
    pub(crate) background: Vec3,
    pub(crate) directory_entries: u32,
    pub(crate) brick_grid: UVec3,
    pub(crate) first_row: u32,
    pub(crate) size: UVec2,
    pub(crate) usage_words: u32,
    pub(crate) channel_count: u32,
    pub(crate) combine: Vec2,
    pub(crate) largest: f32,
    pub(crate) heat: u32,
    pub(crate) heat_full: f32,
    pub(crate) pad_0: [u32; 3],
    pub(crate) levels: [LevelUniform; MAX_LEVELS],
    pub(crate) octree: OctreeUniform,
    pub(crate) channels: [ChannelUniform; MOST_CHANNELS],
    pub(crate) planes: [Vec4; MOST_PLANES],
}

/// What a shader is made for: constants, so that compilers leave out what is not needed.
///
/// Drivers that draw on the CPU run both sides of every `if` on numbers, with what does not count masked out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Variant {
    /// Channels it can draw.
    pub(crate) slots: u32,
    /// One of `MODE_`.
    pub(crate) mode: u32,
    /// Whether voxels are two parts that are joined before they are interpolated.
    pub(crate) joined: bool,
    /// One of `FALSE_`.
    pub(crate) false_colors: u32,
    /// Whether samples are kept within their bricks: numbers alone do not where voxels are too far away for f32.
    pub(crate) bounded: bool,
    /// Whether the same level of all channels is wanted everywhere.
    pub(crate) levels_alike: bool,
}

impl Variant {
    /// For so many channels: variants are few, so that showing one channel more rarely compiles.
    pub(crate) fn new(
        channels: usize,
        mode: u32,
        joined: bool,
        false_colors: u32,
        far: bool,
    ) -> Self {
        let channels = u32::try_from(channels).expect("a few channels");
        Self {
            slots: channels.max(1).next_power_of_two(),
            mode,
            joined,
            false_colors,
            // What lies around a surface is sampled as well, up to a voxel further.
            bounded: far || mode == MODE_ISO_SURFACE,
            levels_alike: true,
        }
    }

    /// The same for channels of which different levels are wanted, unless `alike`. One is like itself.
    pub(crate) fn with_levels(self, alike: bool) -> Self {
        Self {
            levels_alike: alike || self.slots == 1,
            ..self
        }
    }
}

impl Variant {
    /// Whether it draws what another does.
    pub(crate) fn stands_in_for(self, other: Self) -> bool {
        let alike = |v: Self| (v.mode, v.joined, v.false_colors);
        let able = |v: Self| (v.slots, v.bounded, !v.levels_alike);
        let (ours, theirs) = (able(self), able(other));
        let draws = ours.0 >= theirs.0 && ours.1 >= theirs.1 && ours.2 >= theirs.2;
        alike(self) == alike(other) && draws
    }

    /// Those that draw, or stand in for those that do, when the camera goes far away, as many channels as there are are
    /// shown, other levels of some are wanted, or what is drawn of values changes.
    pub(crate) fn likely_next(self, channels: usize) -> Vec<Self> {
        let able = Self {
            bounded: true,
            ..self
        };
        let able = able.with_levels(false);
        let most = Self::new(channels.min(MOST_CHANNELS), 0, false, 0, false).slots;
        let all = Self {
            slots: most.max(self.slots),
            ..able
        };
        let modes = [MODE_EMISSION_ABSORPTION, MODE_MAXIMUM, MODE_ISO_SURFACE];
        let modes = modes.map(|mode| Self { mode, ..able });
        let colors = [FALSE_NONE, FALSE_RESIDENCY, FALSE_LEVEL];
        let colors = colors.map(|false_colors| Self {
            false_colors,
            ..able
        });
        let mut next = vec![able, all.with_levels(false)];
        next.extend(modes);
        next.extend(colors);
        next
    }
}

/// How what rays did is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Counting {
    /// For the rays of a workgroup together, which wait for each other.
    ByGroups,
    /// For each ray alone: quicker where a processor draws.
    ByRays,
}

impl Counting {
    const fn source(self) -> &'static str {
        match self {
            Self::ByGroups => include_str!("shaders/counting/by_groups.wgsl"),
            Self::ByRays => include_str!("shaders/counting/by_rays.wgsl"),
        }
    }
}

/// The ray-caster's source.
pub(crate) fn ray_cast(variant: Variant, counting: Counting) -> String {
    let Variant {
        slots,
        mode,
        joined,
        false_colors,
        bounded,
        levels_alike,
    } = variant;
    // With one channel there is nothing to count.
    let count = if slots == 1 {
        "1u"
    } else {
        "frame.channel_count | nothing"
    };
    format!(
        "const SLOTS = {slots}u;\nconst MODE = {mode}u;\nconst JOINED = {joined};\nconst FALSE_COLORS = {false_colors}u;\nconst BOUNDED = {bounded};\n\
         const LEVELS_ALIKE = {levels_alike};\n\
         fn channel_count() -> u32 {{ return {count}; }}\n{RAY_CAST}{}",
        counting.source()
    )
}

/// Shared files first, the entry point last. Without the constants of [`ray_cast`], and without what counts.
const RAY_CAST: &str = concat!(
    include_str!("shaders/lib/constants.wgsl"),
    include_str!("shaders/lib/frame.wgsl"),
    include_str!("shaders/lib/ray.wgsl"),
    include_str!("shaders/lib/color.wgsl"),
    include_str!("shaders/lib/count.wgsl"),
    include_str!("shaders/memory.wgsl"),
    include_str!("shaders/octree.wgsl"),
    include_str!("shaders/bricks_ahead.wgsl"),
    include_str!("shaders/samples.wgsl"),
    include_str!("shaders/ray_cast.wgsl"),
);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::memory::Entry;
    use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE};
    use saccade_core::transfer::TABLE_LEN;
    use std::mem::{offset_of, size_of};

    const VARIANTS: [(usize, u32, bool, u32, bool); 7] = [
        (1, MODE_EMISSION_ABSORPTION, false, FALSE_NONE, false),
        (1, MODE_EMISSION_ABSORPTION, false, FALSE_NONE, true),
        (1, MODE_MAXIMUM, true, FALSE_RESIDENCY, false),
        (1, MODE_ISO_SURFACE, false, FALSE_NONE, false),
        (2, MODE_EMISSION_ABSORPTION, true, FALSE_RESIDENCY, true),
        (4, MODE_EMISSION_ABSORPTION, false, FALSE_LEVEL, false),
        (16, MODE_ISO_SURFACE, false, FALSE_LEVEL, false),
    ];

    fn parsed(source: &str) -> naga::Module {
        naga::front::wgsl::parse_str(source)
            .unwrap_or_else(|e| panic!("{}", e.emit_to_string(source)))
    }

    fn module() -> naga::Module {
        let [joined, far] = [false; 2];
        let variant = Variant::new(1, MODE_EMISSION_ABSORPTION, joined, FALSE_NONE, far);
        parsed(&ray_cast(variant, Counting::ByGroups))
    }

    #[test]
    fn every_shader_is_valid_without_any_optional_feature() {
        let countings = [Counting::ByGroups, Counting::ByRays];
        for ((channels, mode, joined, false_colors, far), counting) in VARIANTS
            .into_iter()
            .flat_map(|variant| countings.map(|counting| (variant, counting)))
        {
            let mut validator = naga::valid::Validator::new(
                naga::valid::ValidationFlags::all(),
                naga::valid::Capabilities::empty(),
            );
            let variant = Variant::new(channels, mode, joined, false_colors, far);
            let variant = variant.with_levels(channels == 4);
            let source = ray_cast(variant, counting);
            let module = parsed(&source);
            validator
                .validate(&module)
                .unwrap_or_else(|e| panic!("{}", e.emit_to_string(&source)));
            let entries = module.entry_points.iter().map(|e| e.name.as_str());
            assert_eq!(entries.collect::<Vec<_>>(), ["main"]);
        }
    }

    #[test]
    fn variants_stand_in_for_those_that_need_less() {
        let few = Variant::new(1, MODE_EMISSION_ABSORPTION, false, FALSE_NONE, false);
        let many = Variant::new(3, MODE_EMISSION_ABSORPTION, false, FALSE_NONE, true);
        assert!(many.stands_in_for(few) && few.stands_in_for(few) && !few.stands_in_for(many));
        let far = Variant {
            bounded: true,
            ..few
        };
        assert!(far.stands_in_for(few) && !few.stands_in_for(far));
        let unlike = many.with_levels(false);
        assert!(unlike.stands_in_for(many) && !many.stands_in_for(unlike));
        assert_eq!(few.with_levels(false), few);
        for other in [
            Variant {
                mode: MODE_MAXIMUM,
                ..many
            },
            Variant {
                joined: true,
                ..many
            },
            Variant {
                false_colors: FALSE_LEVEL,
                ..many
            },
        ] {
            assert!(!other.stands_in_for(few), "{other:?} draws something else");
        }
        // Whatever one of these changes is, something is there that draws it.
        let next = few.likely_next(9);
        let drawn = |wanted: Variant| next.iter().any(|v| v.stands_in_for(wanted));
        let modes = [MODE_EMISSION_ABSORPTION, MODE_MAXIMUM, MODE_ISO_SURFACE];
        for far in [false, true] {
            assert!(
                modes
                    .iter()
                    .all(|m| drawn(Variant::new(1, *m, false, FALSE_NONE, far)))
            );
            for channels in 1..10 {
                let mode = MODE_EMISSION_ABSORPTION;
                let variant = Variant::new(channels, mode, false, FALSE_NONE, far);
                assert!(drawn(variant) && drawn(variant.with_levels(false)));
            }
        }
    }

    #[test]
    fn bindings_stay_within_what_browsers_promise() {
        let module = module();
        let limits = wgpu::Limits::default();
        let of = |wanted: fn(&naga::GlobalVariable, &naga::TypeInner) -> bool| {
            let globals = module.global_variables.iter();
            let globals = globals.filter(|(_, g)| wanted(g, &module.types[g.ty].inner));
            u32::try_from(globals.count()).unwrap()
        };
        let buffers = of(|g, _| matches!(g.space, naga::AddressSpace::Storage { .. }));
        assert!(
            buffers <= limits.max_storage_buffers_per_shader_stage,
            "{buffers}"
        );
        let images = of(|_, ty| {
            matches!(
                ty,
                naga::TypeInner::Image {
                    class: naga::ImageClass::Storage { .. },
                    ..
                }
            )
        });
        assert!(
            images <= limits.max_storage_textures_per_shader_stage,
            "{images}"
        );
    }

    /// Whether a WGSL constant has this value; `None` when there is no such constant.
    fn constant_is(module: &naga::Module, name: &str, value: u32) -> Option<bool> {
        let mut constants = module.constants.iter();
        let (_, constant) = constants.find(|(_, c)| c.name.as_deref() == Some(name))?;
        let value_is = &module.global_expressions[constant.init];
        let expected = naga::Expression::Literal(naga::Literal::U32(value));
        Some(format!("{value_is:?}") == format!("{expected:?}"))
    }

    #[test]
    fn constants_agree() {
        let module = module();
        let [levels, table_len] = [MAX_LEVELS, TABLE_LEN].map(|n| u32::try_from(n).unwrap());
        for (name, value) in [
            ("WORKGROUP", WORKGROUP),
            ("BRICK_EDGE", BRICK_EDGE),
            ("BRICK_BORDER", BRICK_BORDER),
            ("BRICK_STORED_EDGE", BRICK_STORED_EDGE),
            ("MAX_LEVELS", levels),
            ("TABLE_LEN", table_len),
            ("EMPTY", bytemuck::cast(Entry::EMPTY)),
            ("FIRST_SLOT", Entry::FIRST_SLOT),
            ("STALE", Entry::STALE),
            ("FLAG_SUBSTITUTE", FLAG_SUBSTITUTE),
            ("FLAG_JITTER", FLAG_JITTER),
            ("FLAG_OCTREE", FLAG_OCTREE),
            ("FLAG_NEAREST", FLAG_NEAREST),
            ("MOST_CHANNELS", u32::try_from(MOST_CHANNELS).unwrap()),
            ("MOST_PLANES", u32::try_from(MOST_PLANES).unwrap()),
            ("CHANNEL_VALUES", CHANNEL_VALUES),
            ("CHANNEL_RESIDENCY", CHANNEL_RESIDENCY),
            ("MODE_EMISSION_ABSORPTION", MODE_EMISSION_ABSORPTION),
            ("MODE_MAXIMUM", MODE_MAXIMUM),
            ("MODE_ISO_SURFACE", MODE_ISO_SURFACE),
            ("FALSE_NONE", FALSE_NONE),
            ("FALSE_RESIDENCY", FALSE_RESIDENCY),
            ("FALSE_LEVEL", FALSE_LEVEL),
            ("HEAT_NONE", HEAT_NONE),
            ("HEAT_LOOKUPS", HEAT_LOOKUPS),
            ("HEAT_NODES", HEAT_NODES),
            ("HEAT_SAMPLES", HEAT_SAMPLES),
            ("COUNT_RAYS", COUNT_RAYS),
            ("MOST_LOOKUPS", MOST_LOOKUPS),
            ("FEWEST_LOOKUPS", FEWEST_LOOKUPS),
            ("COUNT_SAMPLES_HIGH", COUNT_SAMPLES_HIGH),
            ("MOST_DEPTHS", u32::try_from(MOST_DEPTHS).unwrap()),
            ("SIBLINGS", SIBLINGS),
            ("NODE_ROW", NODE_ROW),
            ("NODE_BINS", NODE_BINS),
            ("NODE_RANGE", NODE_RANGE),
            ("NODE_VALID", NODE_VALID),
            ("NODE_CHILDREN", NODE_CHILDREN),
            ("COUNT_NODES", COUNT_NODES),
            ("COUNTERS", COUNTERS),
            ("COUNT_MISSES", COUNT_MISSES),
            ("COUNT_STALE", COUNT_STALE),
            ("COUNT_SAMPLES", COUNT_SAMPLES),
            ("COUNT_LOOKUPS", COUNT_LOOKUPS),
            ("COUNT_SUBSTITUTED", COUNT_SUBSTITUTED),
            ("MOST_SUBSTITUTED_LEVELS", MOST_SUBSTITUTED_LEVELS),
            ("FINEST_LEVEL", FINEST_LEVEL),
            ("MISSES", MISSES),
        ] {
            assert_eq!(
                constant_is(&module, name, value),
                Some(true),
                "{name} is {value} in Rust"
            );
            assert_eq!(
                constant_is(&module, name, value + 1),
                Some(false),
                "a check that can fail"
            );
        }
    }

    /// `(name, offset)` of each member, and the size, as naga lays the struct out.
    fn wgsl_struct(module: &naga::Module, name: &str) -> (Vec<(String, usize)>, usize) {
        let mut types = module.types.iter();
        let (_, ty) = types
            .find(|(_, ty)| ty.name.as_deref() == Some(name))
            .unwrap();
        let naga::TypeInner::Struct { members, span } = &ty.inner else {
            panic!("{name} is not a struct");
        };
        let members = members
            .iter()
            .map(|m| (m.name.clone().unwrap(), m.offset as usize));
        (members.collect(), *span as usize)
    }

    macro_rules! rust_struct {
        ($ty:ty, $($field:ident),+) => {
            (vec![$((stringify!($field).to_owned(), offset_of!($ty, $field))),+], size_of::<$ty>())
        };
    }

    #[test]
    fn structs_agree() {
        let module = module();
        let level = rust_struct!(
            LevelUniform,
            eye,
            directory_base,
            anchor,
            voxels_per_nm,
            values_depth,
            bricks,
            directory
        );
        assert_eq!(wgsl_struct(&module, "Level"), level);
        let frame = rust_struct!(
            FrameUniform,
            forward,
            pixel,
            right,
            level_count,
            down,
            flags,
            low_nm,
            depth,
            high_nm,
            block_edge_log2,
            background,
            directory_entries,
            brick_grid,
            first_row,
            size,
            usage_words,
            channel_count,
            combine,
            largest,
            heat,
            heat_full,
            levels,
            octree,
            channels,
            planes
        );
        assert_eq!(wgsl_struct(&module, "Frame"), frame);
        let depth = rust_struct!(DepthUniform, shift, bits, residency);
        assert_eq!(wgsl_struct(&module, "Depth"), depth);
        let octree = rust_struct!(
            OctreeUniform,
            eye,
            slots,
            anchor,
            cells_per_nm,
            cells,
            depths
        );
        assert_eq!(wgsl_struct(&module, "Octree"), octree);
        let channel = rust_struct!(
            ChannelUniform,
            directory_offset,
            octree_slot,
            first_level,
            last_level,
            coarser,
            flags,
            table_scale,
            table_offset,
            first_opaque,
            last_opaque,
            visible_bins,
            iso
        );
        assert_eq!(wgsl_struct(&module, "Channel"), channel);
    }
}
