//! Dynamic 3D Gaussian scenes: tables, motion models and a differentiable renderer.
//!
//! From the bytes of a file to a rendered image:
//!
//! ```
//! use splat4d::prelude::*;
//!
//! # fn main() -> Result<()> {
//! let bytes = std::fs::read("../../examples/knight.s4d").expect("the file is there");
//! let scene = splat4d::open(&bytes)?; // also .ply, .spz, .splatv, SOG and scene.safetensors
//! let pose = Se3::look_at([3.0, 3.0, 1.5], [0.0, 0.0, 0.8], scene.up);
//! let camera = Camera::with_fov_y(pose, 0.8, 160, 120);
//! let image = splat4d::draw(&scene, &camera, Time(0.5))?;
//! assert_eq!(image.color.data.len(), 3 * 160 * 120); // red, then green, then blue, in [0, 1]
//! # assert!(image.alpha.data.iter().any(|a| *a > 0.9), "something is seen");
//! # Ok(())
//! # }
//! ```
//!
//! The chain behind it is `motion.at → render`, and in training also `loss → render.vjp → motion.backward`. A motion
//! model maps a time to [`scene::Splats`]; the renderer does not depend on time, a motion model not on pixels.
//! [`layers::Evaluation`] evaluates a scene at many times at once and backpropagates; [`render::Backend`] is the
//! interface of renderers; [`play::Player`] plays long scenes within a memory budget.
//!
//! This crate reads bytes, not paths; it contains no loss, no optimiser and no data set (those are in `splat4d-train`).
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `error.rs`, `text.rs` | the one error (what, where, what to do); text of files, made safe to print |
//! | `wgsl.rs`, `simd.rs` | shader sources for the GPU renderer and the player; the one dispatch to instruction sets |
//! | `math/` | quaternions, Fourier transforms, symmetric matrices, poses, twists, nearest rotations and neighbours, Wasserstein geometry of covariances (`spd.rs`), eigenvectors (`jacobi.rs`), similarities between sets of cameras (`align.rs`), spherical harmonics, counter-based random numbers, `Real` (f32 and f64) |
//! | `scene/` | `Table`, `Params`, `Grads`, `RowEdit`, `Splats`, lifespans, cameras, planes, time; weights of a pixel head (`head.rs`), label logits (`labels.rs`), feature channels (`features.rs`) |
//! | `nn/` | network parts, each with its backward under its forward: perceptrons over `gemm`, encodings, hash grids, feature planes, state-space scans, vector neurons, local frames |
//! | `motion/` | the trait `Motion`; the list of models, from which `registry.rs` makes `Spec`, names and `build`; capabilities (`Capabilities`, `Polynomial`, `Phase`); one file per model, and `filtered` and `edited`, which wrap any of them; skinning to control nodes (`skin.rs`), dragging them (`arap.rs`), loops over sixteen rows (`lanes.rs`) |
//! | `motion/deform/`, `motion/control/`, `motion/skin/`, `motion/ssm/`, `motion/native4d/`, `motion/filtered/`, `motion/edited/` | parts of the larger models |
//! | `layers/` | `Layer` (model, then lifespan, then frame), `Scene` (sum of layers), `Evaluation` (the scene at several times: queries, results and backward pass); position in the world (`frame.rs`), cross-fades, one time as plain Gaussians (`freeze.rs`), `native4d` to `spacetime` (`convert.rs`), other axes (`rotate.rs`) |
//! | `render/` | project, shade, bin, rasterize, each with its VJP; records of a bin (`gather.rs`), blending forward and backward (`blend.rs`); traits of renderers (`backend.rs`) and of devices that keep a scene's tables (`resident.rs`); pixel networks (`head.rs`); contribution, removal and sensitivity of each splat in one pass (`importance.rs`); the slow f64 definition (`oracle.rs`); lower bounds (`roofline.rs`) and pair counts (`count.rs`) |
//! | `backward.rs` | from the gradients of splats to those of a scene's tables: the end of a differentiable render |
//! | `gpu/` | the same stages in WGSL (feature `gpu`), backward pass in `back.rs`, loss in `compare.rs` on images that `pictures.rs` keeps, kernel constants of a sweep in `tuning.rs`, lower bounds in `roofline.rs`; each kernel is tested against its CPU twin |
//! | `gpu/resident/` | whole steps on tables that stay on the GPU: kernel parameters, ties of poses, camera colours, steps in flight and their repetition, films |
//! | `device.rs`, `device/` | selects the rendering device and reports why; routes unsupported work to the CPU and falls back to it when the GPU fails; which layers a device keeps |
//! | `flow.rs`, `flow/` | velocities, rendered velocity and 2D flow; tracks of Gaussians, queried points and their visibility, lifting of flow to 3D |
//! | `channels.rs` | labels and features as rendered channels |
//! | `format/` | readers and writers of bytes: `scene.safetensors`, .npy; in `mod.rs` the one list of dialects, each a file or folder with a line there; archives (`zip.rs`), fitted temporal opacity (`fade.rs`), formats that are only recognised (`foreign.rs`) |
//! | `format/playback/` | `.s4d`: index, pages of quantised Gaussians, palette (docs/format.md) |
//! | `format/ply/`, `format/spz/`, `format/sog/` | 3DGS, compressed and Spacetime .ply; .spz 2 to 4 with its axes; SOG, zipped or as files, streamed |
//! | `format/research/`, `format/fourdgs/` | networks of research code next to their Gaussians, as the motion models that have their equations; .4dgs: records and streams of bins |
//! | `format/gltf/`, `format/usd/` | glTF with KHR_gaussian_splatting, also with an .spz inside; USD's ParticleField3DGaussianSplat as text or archive, with time samples |
//! | `bake/` | any motion model to linear segments in a tree of time spans, within a byte budget or an error, and the comparison with the model |
//! | `play.rs`, `play/` | plays a scene or file on the CPU: active set, pages within a memory budget |
//! | `edit/` | a list of steps: selections as text (`select.rs`), their evaluation over time (`look.rs`), effects on layers (`act.rs`), time windows and clocks (`clock.rs`), dragging (`drag.rs`) |

#![cfg_attr(docsrs, feature(doc_cfg))] // docs.rs marks what needs a feature

pub mod backward;
pub mod bake;
pub mod channels;
pub mod device;
pub mod edit;
pub mod error;
pub mod flow;
pub mod format;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod layers;
pub mod math;
pub mod motion;
pub mod nn;
pub mod play;
pub mod render;
pub mod scene;
pub mod simd;
pub mod text;
#[cfg(any(test, feature = "gpu"))]
mod wgsl;

pub use error::{Error, ErrorKind, Result};
pub use format::open;
pub use play::draw;

/// The names that most programs need.
pub mod prelude {
    pub use crate::device::{self, Device};
    pub use crate::layers::{Evaluation, Layer, Scene};
    pub use crate::math::Se3;
    pub use crate::motion::{Motion, Spec};
    pub use crate::play::Player;
    pub use crate::render::{Backend, Image, RenderConfig, Shot};
    pub use crate::scene::{Camera, LifeKind, Params, Time};
    pub use crate::{Error, ErrorKind, Result, draw, open};
}
