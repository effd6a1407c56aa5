//! 4DGaussians: `deformation_net.grid.grids.{level}.{plane}` [1, C, second axis, first axis], `feature_out.{0, 2, ...}`, and
//! heads `pos_deform.{1, 3}` and so on, as [`crate::motion::hexplane`] has them.
//!
//! Differences: the box's first corner is the upper one, so that axes run backwards; its planes cover [−1, 1] in time, of which
//! t in [0, 1] is the second half; shifts are in scene units.
//! Source: hustvl/4DGaussians (Apache-2.0), scene/deformation.py, scene/hexplane.py, arguments/__init__.py, read for facts.

use super::state::{Map, put};
use super::{Job, Moving, refuse, unsupported};
use crate::motion::hexplane::{Heads, Hexplane, HexplaneSpec};
use crate::nn::hexplane::{AXES, PlaneShape};
use crate::scene::{Params, SH};
use crate::{Error, Result};
use std::sync::Arc;

/// A tensor that only this network has.
pub(super) const KNOWN: &str = "deformation_net.grid.aabb";
/// Prefix of all.
const NET: &str = "deformation_net.";
/// Heads: our name, theirs, the flag that leaves one out, and its default.
const HEADS: [(&str, &str, &str, bool); 5] = [
    ("position", "pos_deform", "no_dx", false),
    ("scale", "scales_deform", "no_ds", false),
    ("rotation", "rotations_deform", "no_dr", false),
    ("opacity", "opacity_deform", "no_do", true),
    ("sh", "shs_deform", "no_dshs", true),
];
/// Plane over x and y, and over x and t.
const XY_XT: [usize; 2] = [0, 2];

pub(super) fn read(job: &Job<'_>, mut params: Params) -> Result<Moving> {
    refuse(&job.settings, "4DGaussians", &["no_grid", "static_mlp", "empty_voxel", "apply_rotation"])?;
    let corners = job.state.numbers(KNOWN, &[2, 3])?;
    let planes = shape_of(job)?;
    let trunk = job.state.maps(&format!("{NET}feature_out."), 2)?;
    let lacks = || Error::input("the network has no map `feature_out.0`").remedy("Save it again.");
    let first = trunk.first().ok_or_else(lacks)?;
    if first.inputs != planes.features() {
        return Err(unsupported(format!("the first map has {} inputs, expected {}", first.inputs, planes.features()))
            .remedy("Train without grid_pe, or export a sequence of .ply files."));
    }
    let on = HEADS.map(|(.., flag, off)| !job.settings.is(flag, off));
    let [position, scale, rotation, opacity, sh] = on;
    let [from, to] = job.clip;
    let spec = HexplaneSpec {
        low: std::array::from_fn(|k| f64::from(corners[k].min(corners[3 + k]))),
        high: std::array::from_fn(|k| f64::from(corners[k].max(corners[3 + k]))),
        clip: [from - (to - from), to],
        planes: planes.clone(),
        net_width: first.outputs,
        defor_depth: trunk.len(),
        heads: Heads { position, scale, rotation, opacity, sh },
        ..HexplaneSpec::default()
    };
    let motion = Hexplane::new(spec.clone(), &mut params)?;
    let backwards: [bool; 4] = std::array::from_fn(|axis| axis < 3 && corners[axis] > corners[3 + axis]);
    for level in 0..planes.multires.len() {
        for plane in 0..AXES.len() {
            let numbers = job.state.numbers(&grid(level, plane), &axes_of(&planes, level, plane))?;
            let ours = turned(&numbers, planes.channels, planes.size(level, plane), AXES[plane].map(|a| backwards[a]));
            put(&mut params, &PlaneShape::name(level, plane), &ours)?;
        }
    }
    for (i, map) in trunk.iter().enumerate() {
        map.put(&mut params, "hexplane.trunk", i)?;
    }
    for ((ours, theirs, ..), _) in HEADS.iter().zip(on).filter(|(_, on)| *on) {
        let [hidden, last] = [1, 3].map(|i| job.state.map(&format!("{NET}{theirs}.{i}")));
        let factor = if *ours == "position" { 1.0 / spec.reach() } else { 1.0 };
        let last: Map = last?.scaled(factor);
        if *ours == "sh" && last.outputs != params[SH].width() {
            return Err(unsupported(format!(
                "the network changes {} numbers of a colour; the Gaussians have {}",
                last.outputs,
                params[SH].width()
            ))
            .remedy("Train with spherical harmonics of degree 3."));
        }
        hidden?.put(&mut params, &format!("hexplane.{ours}"), 0)?;
        last.put(&mut params, &format!("hexplane.{ours}"), 1)?;
    }
    Ok((params, Arc::new(motion)))
}

fn grid(level: usize, plane: usize) -> String {
    format!("{NET}grid.grids.{level}.{plane}")
}

/// Axes of a plane's tensor.
fn axes_of(shape: &PlaneShape, level: usize, plane: usize) -> [usize; 4] {
    let [first, second] = shape.size(level, plane);
    [1, shape.channels, second, first]
}

/// Sizes of the planes, from the planes over x and y, and over x and t.
fn shape_of(job: &Job<'_>) -> Result<PlaneShape> {
    let axes = |level: usize, plane: usize| match job.state.shape(&grid(level, plane)) {
        Some(&[_, channels, second, first]) => Some([channels, second, first]),
        _ => None,
    };
    let bad =
        |what: String| unsupported(what).remedy("Export a sequence of .ply files from the program that trained it.");
    let [Some([channels, _, resolution]), Some([_, time_resolution, _])] = XY_XT.map(|plane| axes(0, plane)) else {
        return Err(Error::input("the network has no feature planes").remedy("Save it again."));
    };
    let mut multires = Vec::new();
    while let Some([_, _, side]) = axes(multires.len(), 0) {
        if resolution == 0 || side % resolution != 0 {
            return Err(bad(format!(
                "the planes of level {} have {side} points, which is not a multiple of {resolution}",
                multires.len()
            )));
        }
        multires.push(side / resolution);
    }
    let shape = PlaneShape { channels, resolution, time_resolution, multires };
    shape.check()?;
    Ok(shape)
}

/// [C, second, first] as [second, first, C], with axes that run backwards turned round.
fn turned(numbers: &[f32], channels: usize, [first, second]: [usize; 2], backwards: [bool; 2]) -> Vec<f32> {
    let place = |i: usize, n: usize, back: bool| if back { n - 1 - i } else { i };
    let mut out = Vec::with_capacity(numbers.len());
    for y in 0..second {
        for x in 0..first {
            let at = place(y, second, backwards[1]) * first + place(x, first, backwards[0]);
            out.extend((0..channels).map(|c| numbers[c * first * second + at]));
        }
    }
    out
}
