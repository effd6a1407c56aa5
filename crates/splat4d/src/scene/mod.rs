//! Parts of a scene: tables of Gaussians, their state at one time, and cameras.

pub mod camera;
pub mod features;
pub mod head;
pub mod labels;
pub mod life;
pub(crate) mod masks;
pub mod offset;
pub mod params;
pub(crate) mod planes;
pub(crate) mod rows;
pub mod splats;
pub mod table;
pub mod time;

pub use camera::{Camera, Intrinsics, Lens};
pub use head::{HeadGrads, HeadKeys, HeadWeights};
pub use life::LifeKind;
pub use masks::KeyMasks;
pub use params::{Born, GEOMETRY, Grads, Key, LIFE, ParamInfo, Params, RowEdit, SH, Space};
pub use planes::Planes;
pub use rows::Rows;
pub use splats::{Color, Part, SplatGrads, Splats};
pub use table::{BLOCK, Column, Table};
pub use time::Time;
