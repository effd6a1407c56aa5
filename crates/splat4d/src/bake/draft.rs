//! Stand-in for the playback file's types until they land.
#![allow(missing_docs)]
/// One.
#[derive(Clone, Debug, PartialEq)]
pub struct Primitive {
    pub mean: [f64; 3],
    pub center: f64,
    pub half_width: f64,
    pub softness: f64,
    pub quat: [f32; 4],
    pub scales: [f32; 3],
    pub opacity: f32,
    pub velocity: [f32; 3],
    pub turn: [f32; 3],
    pub base_color: [f32; 3],
    pub sh_rest: [f32; 45],
    pub importance: f32,
}
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    pub from: f64,
    pub to: f64,
    pub primitives: Vec<Primitive>,
}
