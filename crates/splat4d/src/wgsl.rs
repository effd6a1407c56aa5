//! The shaders as text, shared by the native renderer (feature `gpu`) and the browser's player.
//!
//! No feature and no dependency: a shader is the concatenation of the files it names. Each file's header
//! names its twin in Rust, its buffers and what a thread owns.

/// `struct View`, `Cov`, `Ellipse`; `covariance`, `project`: twin of `render::project`. No bindings.
pub(crate) const PROJECT: &str = include_str!("render/project.wgsl");
/// `sh_basis`: twin of `math::sh::basis`. No bindings.
pub(crate) const SHADE: &str = include_str!("render/shade.wgsl");
/// One stable pass of a radix sort over (key, value) pairs: `histogram`, `scan`, `scatter`. Bindings in its header.
pub(crate) const SORT: &str = include_str!("gpu/sort.wgsl");
/// The last dispatch of such a pass with subgroups: `scatter_subgroup`. After `SORT`.
pub(crate) const SORT_SUBGROUP: &str = include_str!("gpu/sort_subgroup.wgsl");
/// A row of a scene's tables → shape, colour, mark. After `PROJECT` and `SHADE`.
pub(crate) const SPLATS: &str = include_str!("gpu/splats.wgsl");
/// Exclusive sums, and the sizes of later dispatches.
pub(crate) const SCAN: &str = include_str!("gpu/scan.wgsl");
/// Visible splats as (depth, number) pairs.
pub(crate) const COMPACT: &str = include_str!("gpu/compact.wgsl");
/// `project_back`: twin of `render::project`'s VJP. After `PROJECT`. No bindings.
pub(crate) const PROJECT_BACK: &str = include_str!("render/project_back.wgsl");
/// (tile, splat) pairs: `count`, `emit`. After `PROJECT`.
pub(crate) const TILES: &str = include_str!("gpu/tiles.wgsl");
/// Start and end of each tile's list.
pub(crate) const RANGES: &str = include_str!("gpu/ranges.wgsl");
/// Blends to colour, alpha and depth. After `PROJECT`.
pub(crate) const RASTERIZE: &str = include_str!("gpu/rasterize.wgsl");
/// Planes → 8 bits per channel. After `PROJECT`.
pub(crate) const BYTES: &str = include_str!("gpu/bytes.wgsl");
/// Shared code of both backward passes of the blend. After `PROJECT`.
pub(crate) const BLEND_BACK: &str = include_str!("gpu/blend_back.wgsl");
/// Sums over subgroups. After `BLEND_BACK`.
pub(crate) const SUBGROUP_SUMS: &str = include_str!("gpu/subgroup_sums.wgsl");
/// The blend's backward pass with subgroups. After `SUBGROUP_SUMS`.
pub(crate) const RASTERIZE_BACK_SUBGROUP: &str = include_str!("gpu/rasterize_back_subgroup.wgsl");
/// The same with pixels in vectors. After `SUBGROUP_SUMS`.
pub(crate) const RASTERIZE_BACK_VECTOR: &str = include_str!("gpu/rasterize_back_vector.wgsl");
/// The same with a lane per splat. After `BLEND_BACK`.
pub(crate) const RASTERIZE_BACK_LANES: &str = include_str!("gpu/rasterize_back_lanes.wgsl");
/// The blend's backward pass: a record a (tile, splat) pair. After `BLEND_BACK`.
pub(crate) const RASTERIZE_BACK: &str = include_str!("gpu/rasterize_back.wgsl");
/// An image compared with its truth: L1, D-SSIM and their gradient: `moments`, `gradient`.
pub(crate) const LOSS: &str = include_str!("gpu/loss.wgsl");
/// Learnable rows at time t, and their lifespans. Reads `params`, which the including shader binds.
pub(crate) const LEARNT: &str = include_str!("gpu/learnt.wgsl");
/// Writes a row's gradients. After `LEARNT`.
pub(crate) const PUT: &str = include_str!("gpu/put.wgsl");
/// Cosines, logarithms, random numbers. No bindings.
pub(crate) const NUMBERS: &str = include_str!("gpu/numbers.wgsl");
/// A Gaussian of space and time, sliced. After `LEARNT` and `NUMBERS`.
pub(crate) const SLICE: &str = include_str!("gpu/slice.wgsl");
/// Rows of such Gaussians → splats. After `SLICE`.
pub(crate) const SLICE_ANSWER: &str = include_str!("gpu/slice_answer.wgsl");
/// Gradients of splats → those of such rows. After `SLICE` and `PUT`.
pub(crate) const SLICE_BACK: &str = include_str!("gpu/slice_back.wgsl");
/// Losses on rows: `count_rows`, `row_losses`. After `LEARNT` and `NUMBERS`.
pub(crate) const ROW_LOSSES: &str = include_str!("gpu/row_losses.wgsl");
/// Ties of the poses of a tracked frame: `turns_of`, `hold`. After `LEARNT`.
pub(crate) const TIES: &str = include_str!("gpu/ties.wgsl");
/// Noise on positions. After `LEARNT` and `NUMBERS`.
pub(crate) const SHAKE: &str = include_str!("gpu/shake.wgsl");
/// Rows that stay on the GPU → splats. After `LEARNT`.
pub(crate) const ANSWER: &str = include_str!("gpu/answer.wgsl");
/// Gradients of splats → those of rows. After `LEARNT` and `PUT`.
pub(crate) const ANSWER_BACK: &str = include_str!("gpu/answer_back.wgsl");
/// Gradients of colours → those of SH and means, and statistics. After `PROJECT`, `SHADE` and `LEARNT`.
pub(crate) const COLORS_BACK: &str = include_str!("gpu/colors_back.wgsl");
/// Record of a step: `view_sums`, `cameras`, `record`.
pub(crate) const RECORD: &str = include_str!("gpu/record.wgsl");
/// A step of Adam on one table.
pub(crate) const ADAM: &str = include_str!("gpu/adam.wgsl");
/// A splat's records added up.
pub(crate) const GATHER: &str = include_str!("gpu/gather.wgsl");
/// Those sums → gradients of Gaussians and pose. After `PROJECT` and `PROJECT_BACK`.
pub(crate) const SPLATS_BACK: &str = include_str!("gpu/splats_back.wgsl");

/// The blend's arithmetic alone, to measure.
pub(crate) const ROOFLINE: &str = include_str!("gpu/roofline.wgsl");
/// A copy, to measure.
pub(crate) const COPY: &str = include_str!("gpu/copy.wgsl");

#[cfg(test)]
mod tests {
    use super::*;
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    /// WebGPU's default limits that shaders can break.
    const STORAGE_BUFFERS: usize = 8;
    const WORKGROUP_BYTES: u32 = 16 << 10;
    const INVOCATIONS: u32 = 256;
    /// Those that need more than WebGPU's core.
    const SUBGROUPS: [&str; 4] = [
        "rasterize, backward, with subgroups",
        "sort with subgroups",
        "rasterize, backward, with subgroups and vectors",
        "rasterize, backward, with a lane per splat",
    ];

    #[test]
    fn every_shader_is_valid_within_webgpus_default_limits() {
        let shaders: [(&str, &[&str]); 29] = [
            ("project and shade", &[PROJECT, SHADE]),
            ("sort", &[SORT]),
            ("splats", &[PROJECT, SHADE, SPLATS]),
            ("scan", &[SCAN]),
            ("compact", &[COMPACT]),
            ("tiles", &[PROJECT, TILES]),
            ("ranges", &[RANGES]),
            ("rasterize", &[PROJECT, RASTERIZE]),
            ("rasterize, backward", &[PROJECT, BLEND_BACK, RASTERIZE_BACK]),
            (SUBGROUPS[0], &[PROJECT, BLEND_BACK, SUBGROUP_SUMS, RASTERIZE_BACK_SUBGROUP]),
            (SUBGROUPS[2], &[PROJECT, BLEND_BACK, SUBGROUP_SUMS, RASTERIZE_BACK_VECTOR]),
            (SUBGROUPS[3], &[PROJECT, BLEND_BACK, RASTERIZE_BACK_LANES]),
            (SUBGROUPS[1], &[SORT, SORT_SUBGROUP]),
            ("record", &[RECORD]),
            ("bytes", &[PROJECT, BYTES]),
            ("loss", &[LOSS]),
            ("answer", &[LEARNT, ANSWER]),
            ("answer, backward", &[LEARNT, PUT, ANSWER_BACK]),
            ("slice", &[LEARNT, NUMBERS, SLICE, SLICE_ANSWER]),
            ("slice, backward", &[LEARNT, PUT, NUMBERS, SLICE, SLICE_BACK]),
            ("losses on rows", &[LEARNT, NUMBERS, ROW_LOSSES]),
            ("ties", &[LEARNT, TIES]),
            ("shake", &[LEARNT, NUMBERS, SHAKE]),
            ("colours, backward", &[PROJECT, SHADE, LEARNT, COLORS_BACK]),
            ("adam", &[ADAM]),
            ("gather", &[GATHER]),
            ("roofline", &[ROOFLINE]),
            ("copy", &[COPY]),
            ("splats, backward", &[PROJECT, PROJECT_BACK, SPLATS_BACK]),
        ];
        for (name, files) in shaders {
            let text = files.join("\n");
            let module =
                naga::front::wgsl::parse_str(&text).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&text)));
            let needs = if SUBGROUPS.contains(&name) { Capabilities::SUBGROUP } else { Capabilities::empty() };
            Validator::new(ValidationFlags::all(), needs)
                .validate(&module)
                .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&text)));
            let mut layouter = naga::proc::Layouter::default();
            layouter.update(module.to_ctx()).expect("a valid module has a layout");
            let (mut buffers, mut shared) = (0, 0);
            for (_, variable) in module.global_variables.iter() {
                match variable.space {
                    naga::AddressSpace::Storage { .. } => buffers += 1,
                    naga::AddressSpace::WorkGroup => shared += layouter[variable.ty].size,
                    _ => (),
                }
            }
            assert!(buffers <= STORAGE_BUFFERS, "{name} binds {buffers} storage buffers");
            assert!(shared <= WORKGROUP_BYTES, "{name} shares {shared} bytes");
            for entry in &module.entry_points {
                assert!(entry.workgroup_size.iter().product::<u32>() <= INVOCATIONS, "{name}: {}", entry.name);
            }
        }
    }
}
