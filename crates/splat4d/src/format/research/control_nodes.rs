//! SC-GS: `nodes` [M, 3 + h], `_node_radius` [M] (logarithms), `_node_weight` [M, 1] (logits), a perceptron `network.` as that of
//! Deformable-3D-Gaussians; the Gaussians' hyper coordinates and motion mask are `fea_*` of the .ply.
//!
//! The K nearest nodes in space and hyper coordinates pull a Gaussian by exp(−d²/2r²)·sigmoid(weight), normalised. Neither they nor
//! the canonical Gaussians change with time, so that the weights are computed here, once.
//! Source: yihua7/SC-GS (MIT), utils/time_utils.py, scene/gaussian_model.py, read for facts.

use super::deform::Trunk;
use super::state::{Map, put};
use super::{Job, Moving, refuse, unsupported};
use crate::format::ply;
use crate::motion::warp::{NETWORKS, TABLES, Warp, WarpSpec};
use crate::scene::{GEOMETRY, Params};
use crate::{Error, Result};
use rayon::prelude::*;
use std::sync::Arc;

/// A tensor that only this network has.
pub(super) const KNOWN: &str = "nodes";
/// Neighbours without a setting.
const NEIGHBOURS: usize = 3;
/// Most nodes: every Gaussian is compared with every one.
const MOST_NODES: usize = 1 << 13;
/// Most hyper coordinates.
const MOST_HYPER: usize = 32;
/// Added to weights.
const LEAST_WEIGHT: f64 = 1e-7;

/// The nodes.
struct Nodes {
    count: usize,
    /// Numbers of a node.
    width: usize,
    /// [count, width]: position, hyper coordinates.
    places: Vec<f32>,
    radii: Vec<f64>,
    shares: Vec<f64>,
}

pub(super) fn read(job: &Job<'_>, mut params: Params) -> Result<Moving> {
    let flags = ["skinning", "use_hash", "pred_opacity", "pred_color", "progressive_brand_time", "is_scene_static"];
    refuse(&job.settings, "SC-GS", &flags)?;
    if !job.settings.is("d_rot_as_res", true) || job.settings.number("max_d_scale").is_some_and(|x| x > 0.0) {
        return Err(unsupported("SC-GS was trained with d_rot_as_res=False or max_d_scale, which are not read")
            .remedy("Export a sequence of .ply files from the program that trained it."));
    }
    let nodes = Nodes::read(job)?;
    let neighbours = job.settings.number("K").map_or(NEIGHBOURS, |k| k as usize).min(nodes.count);
    let features = Features::read(job, nodes.width - 3)?;
    let trunk = Trunk::read(&job.state, "network.")?;
    let local = job.state.shape("network.local_rotation.weight").is_some();
    let mut heads = vec![("gaussian_warp", 3), ("gaussian_rotation", 4), ("gaussian_scaling", 3)];
    heads.extend(local.then_some(("local_rotation", 4)));
    let last = heads.iter().map(|&(name, outputs)| match job.state.map(&format!("network.{name}"))? {
        map if map.outputs == outputs => Ok(map),
        map => Err(Error::input(format!("map `network.{name}` has {} outputs, expected {outputs}", map.outputs))
            .remedy("The network's file is damaged; save it again.")),
    });
    let last = Map::stacked(last.collect::<Result<_>>()?)?;
    let spec = WarpSpec {
        clip: job.clip,
        nodes: nodes.count,
        neighbours,
        width: trunk.width,
        layers: trunk.maps.len(),
        skip: Some(trunk.skip),
        levels: trunk.levels,
        time_net: trunk.time.is_some(),
        local,
    };
    let motion = Warp::new(spec, &mut params)?;
    let positions: Vec<f32> = nodes.places.chunks_exact(nodes.width).flat_map(|n| n[..3].to_vec()).collect();
    put(&mut params, TABLES[0], &positions)?;
    for (i, map) in trunk.time.iter().flatten().enumerate() {
        map.put(&mut params, NETWORKS[0], i)?;
    }
    for (i, map) in trunk.maps.iter().enumerate() {
        // Theirs has the input in front of the hidden numbers.
        let input = map.inputs - if i == 0 { 0 } else { trunk.width };
        let order = if i == 0 { (0..input).chain(0..0) } else { (input..map.inputs).chain(0..input) };
        map.with_inputs(order).put(&mut params, NETWORKS[1], i)?;
    }
    last.put(&mut params, NETWORKS[1], trunk.maps.len())?;
    bind(&nodes, &features, neighbours, &mut params);
    Ok((params, Arc::new(motion)))
}

impl Nodes {
    fn read(job: &Job<'_>) -> Result<Self> {
        let &[count, width] = job.state.shape(KNOWN).expect("the program is known by it") else {
            return Err(Error::input("tensor `nodes` is not a matrix").remedy("Save the network again."));
        };
        if !(1..=MOST_NODES).contains(&count) || !(3..=3 + MOST_HYPER).contains(&width) {
            return Err(unsupported(format!("{count} control nodes of {width} numbers"))
                .remedy(format!("1 to {MOST_NODES} nodes with up to {MOST_HYPER} hyper coordinates are read.")));
        }
        let radii = job.state.numbers("_node_radius", &[count])?;
        let shares = match job.state.shape("_node_weight") {
            Some(_) => job.state.numbers("_node_weight", &[count, 1])?.iter().map(|w| sigmoid(f64::from(*w))).collect(),
            None => vec![1.0; count],
        };
        let radii = radii.iter().map(|r| f64::from(*r).exp()).collect();
        Ok(Self { count, width, places: job.state.numbers(KNOWN, &[count, width])?, radii, shares })
    }

    /// The nearest nodes of a point, with weights whose sum is 1.
    fn nearest(&self, point: &[f32], neighbours: usize) -> Vec<(usize, f64)> {
        let mut found: Vec<(f32, usize)> = Vec::with_capacity(neighbours + 1);
        for (k, node) in self.places.chunks_exact(self.width).enumerate() {
            let square: f32 = node.iter().zip(point).map(|(a, b)| (a - b) * (a - b)).sum();
            let place = found.partition_point(|(other, _)| *other <= square);
            if place < neighbours {
                found.insert(place, (square, k));
                found.truncate(neighbours);
            }
        }
        let weigh = |(square, k): (f32, usize)| {
            let spread = 2.0 * self.radii[k] * self.radii[k];
            (k, (-f64::from(square) / spread).exp() * self.shares[k] + LEAST_WEIGHT)
        };
        let weights: Vec<(usize, f64)> = found.into_iter().map(weigh).collect();
        let sum: f64 = weights.iter().map(|w| w.1).sum();
        weights.into_iter().map(|(k, w)| (k, w / sum)).collect()
    }
}

/// Per-Gaussian inputs of skinning.
struct Features {
    /// [rows, hyper]
    hyper: Vec<f32>,
    width: usize,
    /// How far a Gaussian follows, from 0 to 1; empty: all the way.
    mask: Vec<f64>,
}

impl Features {
    fn read(job: &Job<'_>, hyper: usize) -> Result<Self> {
        let (all, width) = ply::numbered(job.files.gaussians, "fea_")?;
        if width != hyper && width != hyper + 1 {
            let what =
                format!("the Gaussians have {width} features (fea_0 ...) and the nodes {hyper} hyper coordinates");
            return Err(Error::input(what).remedy("Give the .ply and the network of one training."));
        }
        let rows = all.chunks_exact(width.max(1));
        let mask = rows.clone().filter(|_| width > hyper).map(|row| sigmoid(f64::from(row[hyper]))).collect();
        Ok(Self { hyper: rows.flat_map(|row| row[..hyper].to_vec()).collect(), width: hyper, mask })
    }
}

/// Fills the tables of links and weights.
fn bind(nodes: &Nodes, features: &Features, neighbours: usize, params: &mut Params) {
    let links: Vec<Vec<(usize, f64)>> = (0..params.len())
        .into_par_iter()
        .map(|row| {
            let mut point = params[GEOMETRY].read::<3>(row, 0).to_vec();
            point.extend(&features.hyper[row * features.width..(row + 1) * features.width]);
            nodes.nearest(&point, neighbours)
        })
        .collect();
    let [to, by] = [TABLES[1], TABLES[2]].map(|name| params.find(name).expect("the model has made it"));
    for (row, links) in links.iter().enumerate() {
        let share = features.mask.get(row).copied().unwrap_or(1.0);
        for (k, (node, weight)) in links.iter().enumerate() {
            params[to].set(row, k, *node as f32);
            params[by].set(row, k, (weight * share) as f32);
        }
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}
