//! Deformable-3D-Gaussians: `linear.{0..}` of γ(x) and γ(t), whose input comes again in the middle, `timenet.{0, 2}` for
//! synthetic captures, and the heads `gaussian_warp` (or the screw `branch_w`, `branch_v`), `gaussian_rotation` and
//! `gaussian_scaling`, as [`crate::motion::deform`] has them.
//!
//! Differences: positions are in scene units, heads have no gains, the input precedes the hidden numbers. Its screws
//! add 1e-5 to unit vectors, which is not repeated.
//! Source: ingra14m/Deformable-3D-Gaussians (MIT), utils/time_utils.py, read for facts.

use super::state::{Map, State, put};
use super::{Job, Moving, unsupported};
use crate::motion::deform::{BOUNDS, Deform, DeformSpec, GAINS, Input, TIME_OUTPUTS, TIME_WIDTH};
use crate::nn::encoding::encoded;
use crate::scene::Params;
use crate::{Error, Result};
use std::sync::Arc;

/// A tensor by which it is known.
pub(super) const KNOWN: &str = "linear.0.weight";
/// Levels of γ(t) where the network of time does not state them.
const TIME_LEVELS: usize = 10;

/// A perceptron of position and time.
pub(super) struct Trunk {
    pub(super) maps: Vec<Map>,
    pub(super) width: usize,
    /// Levels of position and time.
    pub(super) levels: [usize; 2],
    /// γ(t) → what the trunk gets, if it is not γ(t) itself.
    pub(super) time: Option<[Map; 2]>,
    /// Numbers of position and of time that go in.
    pub(super) inputs: [usize; 2],
    /// The hidden layer after which the input is appended again.
    pub(super) skip: usize,
}

impl Trunk {
    /// The networks below `prefix`. Errors: maps of other shapes.
    pub(super) fn read(state: &State<'_>, prefix: &str) -> Result<Self> {
        let maps = state.maps(&format!("{prefix}linear."), 1)?;
        let time = match state.shape(&format!("{prefix}timenet.0.weight")) {
            Some(_) => Some([state.map(&format!("{prefix}timenet.0"))?, state.map(&format!("{prefix}timenet.2"))?]),
            None => None,
        };
        let other = |what: String| {
            unsupported(what).remedy("Export a sequence of .ply files from the program that trained it.")
        };
        let Some(first) = maps.first() else {
            return Err(Error::input("the network has no map `linear.0`").remedy("Save it again."));
        };
        let (width, skip) = (first.outputs, maps.len() / 2);
        let (seen, t_levels) = match &time {
            Some([a, b]) if a.outputs == TIME_WIDTH && b.outputs == TIME_OUTPUTS && a.inputs % 2 == 1 => {
                (b.outputs, a.inputs / 2)
            }
            Some([a, b]) => {
                return Err(other(format!("the network of time has {} and {} outputs", a.outputs, b.outputs)));
            }
            None => (encoded(1, TIME_LEVELS), TIME_LEVELS),
        };
        let of_position = first.inputs.checked_sub(seen).filter(|n| n % 6 == 3);
        let of_position = of_position.ok_or_else(|| other(format!("the network has {} inputs", first.inputs)))?;
        for (i, map) in maps.iter().enumerate().skip(1) {
            let expected = width + if i == skip + 1 { first.inputs } else { 0 };
            if (map.inputs, map.outputs) != (expected, width) {
                return Err(other(format!(
                    "map `linear.{i}` is {} to {}, expected {expected} to {width}",
                    map.inputs, map.outputs
                )));
            }
        }
        if skip + 1 >= maps.len() {
            return Err(other(format!("the network has {} hidden layers", maps.len())));
        }
        let levels = [of_position / 6, t_levels];
        Ok(Self { width, levels, inputs: [of_position, seen], skip, time, maps })
    }
}

pub(super) fn read(job: &Job<'_>, mut params: Params) -> Result<Moving> {
    if job.settings.value("deform_type").is_some() {
        return Err(unsupported("SC-GS without control nodes (deform_type) is not read")
            .remedy("Train with deform_type node, or export a sequence of .ply files."));
    }
    let trunk = Trunk::read(&job.state, "")?;
    let rigid = job.state.shape("branch_w.weight").is_some();
    let [gain_v, gain_w, gain_q, gain_s] = GAINS;
    let mut heads: Vec<(&str, usize, f64)> = match rigid {
        true => vec![("branch_w", 3, gain_w), ("branch_v", 3, gain_v)],
        false => vec![("gaussian_warp", 3, gain_v)],
    };
    heads.extend([("gaussian_rotation", 4, gain_q), ("gaussian_scaling", 3, gain_s)]);
    let last = heads.iter().map(|&(name, outputs, gain)| {
        let map = job.state.map(name)?;
        if map.outputs != outputs {
            return Err(Error::input(format!("map `{name}` has {} outputs, expected {outputs}", map.outputs))
                .remedy("The network's file is damaged; save it again."));
        }
        Ok(map.scaled(1.0 / gain))
    });
    let last = Map::stacked(last.collect::<Result<_>>()?)?;
    let Trunk { maps, width, levels: [x_levels, t_levels], time, inputs: [of_position, of_time], skip } = trunk;
    let spec = DeformSpec {
        seed: 0,
        clip: job.clip,
        input: Input::Encoded { x_levels, t_levels, time_net: time.is_some() },
        width,
        layers: maps.len(),
        skip: Some(skip),
        rigid,
    };
    let motion = Deform::new(spec, &mut params)?;
    put(&mut params, BOUNDS, &[0.0, 0.0, 0.0, 1.0])?;
    for (i, map) in time.iter().flatten().enumerate() {
        map.put(&mut params, "deform_time", i)?;
    }
    let all = of_position + of_time;
    for (i, map) in maps.iter().enumerate() {
        let hidden = if i == 0 { 0..0 } else { map.inputs - width..map.inputs };
        let again = if i == 0 || i == skip + 1 { 0..of_position } else { 0..0 };
        map.with_inputs(hidden.chain(again)).put(&mut params, "deform_trunk", i)?;
        if i == 0 || i == skip + 1 {
            let name = if i == 0 { "deform_enter" } else { "deform_again" };
            map.with_inputs(of_position..all).without_bias().put(&mut params, name, 0)?;
        }
    }
    last.put(&mut params, "deform_trunk", maps.len())?;
    Ok((params, Arc::new(motion)))
}
