//! The shaders as text, shared by the native renderer (feature `gpu`) and the browser's player.
//!
//! No feature and no dependency: whoever needs a shader puts the files it names one after the other. Each file's header
//! names its twin in Rust, its buffers and what a thread owns.

/// `struct View`, `Cov`, `Ellipse`; `covariance`, `project`: twin of `render::project`. No bindings.
pub const PROJECT: &str = include_str!("render/project.wgsl");
/// `sh_basis`: twin of `math::sh::basis`. No bindings.
pub const SHADE: &str = include_str!("render/shade.wgsl");
/// One stable pass of a radix sort over (key, value) pairs: `histogram`, `scan`, `scatter`. Bindings in its header.
pub const SORT: &str = include_str!("gpu/sort.wgsl");
