//! The networks as their programs define them, evaluated point by point, against the motion models that are made of their files.

use super::*;
use crate::format::mutate::mutants;
use crate::format::samples::gaussians;
use crate::format::torch::tests::saved;
use crate::layers::freeze;
use crate::math::{Rng, quat};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, SH, Time};
use std::collections::BTreeMap;

const ROWS: usize = 9;
/// Largest difference that counts as equal.
const NEAR: f64 = 1e-4;

/// Tensors by name.
#[derive(Clone, Default)]
struct Net(BTreeMap<String, (Vec<usize>, Vec<f32>)>);

impl Net {
    fn add(&mut self, name: &str, shape: &[usize], size: f64) {
        let rng = Rng::new(7, "network", self.0.len() as u64);
        let numbers = (0..shape.iter().product()).map(|i: usize| (size * rng.normal(i as u64)) as f32).collect();
        self.0.insert(name.into(), (shape.to_vec(), numbers));
    }

    fn map(&mut self, name: &str, inputs: usize, outputs: usize, size: f64) {
        self.add(&format!("{name}.weight"), &[outputs, inputs], size / (inputs as f64).sqrt());
        self.add(&format!("{name}.bias"), &[outputs], 0.1 * size);
    }

    fn file(&self) -> Vec<u8> {
        let all: Vec<(&str, &[usize], Vec<f32>)> =
            self.0.iter().map(|(n, (s, x))| (n.as_str(), &s[..], x.clone())).collect();
        saved(None, &all, b"")
    }

    fn get(&self, name: &str, i: usize) -> f64 {
        f64::from(self.0[name].1[i])
    }

    /// y = W x + b
    fn apply(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let (weight, bias) = (format!("{name}.weight"), format!("{name}.bias"));
        let outputs = self.0[&bias].1.len();
        assert_eq!(self.0[&weight].0, [outputs, x.len()], "{name}");
        let row = |o: usize| (0..x.len()).map(|i| self.get(&weight, o * x.len() + i) * x[i]).sum::<f64>();
        (0..outputs).map(|o| row(o) + self.get(&bias, o)).collect()
    }
}

fn relu(x: Vec<f64>) -> Vec<f64> {
    x.into_iter().map(|x| x.max(0.0)).collect()
}

/// [x, sin x, cos x, sin 2x, ...]
fn encoded(x: &[f64], levels: i32) -> Vec<f64> {
    let waves = (0..levels).flat_map(|l| {
        let at = move |x: &f64| x * 2f64.powi(l);
        x.iter().map(move |x| at(x).sin()).chain(x.iter().map(move |x| at(x).cos()))
    });
    x.iter().copied().chain(waves).collect()
}

fn ply_of(params: &Params) -> Vec<u8> {
    let mut bytes = Vec::new();
    ply::write(params, &mut bytes).unwrap();
    bytes
}

/// The Gaussians of the tests: within the planes' box, large enough that residuals leave their scales positive.
fn cloud() -> Params {
    let mut params = gaussians(ROWS, 16);
    for row in 0..ROWS {
        let g = params[GEOMETRY].read::<11>(row, 0);
        params[GEOMETRY].write(row, 0, [0.4 * g[0], 0.3 * g[1], 0.5 * g[2]]);
        params[GEOMETRY].write(row, LOG_SCALE, [-1.0, -0.5, -0.8]);
    }
    params
}

/// A Gaussian at a time: position, unit quaternion up to its sign, scales, alpha, colour coefficients.
struct Seen {
    mean: [f64; 3],
    quat: [f64; 4],
    scale: [f64; 3],
    alpha: f64,
    sh: Vec<f64>,
}

/// Compares a scene with the output of the network for every Gaussian, at ten times.
fn check(scene: &Scene<f32>, expected: impl Fn(usize, f64) -> Seen) {
    let [from, to] = scene.clip;
    for step in 0..10 {
        let share = f64::from(step) / 9.0;
        let now = freeze(scene, Time(from + share * (to - from))).unwrap();
        // Nothing dies, so that rows keep their order.
        assert_eq!(now.len(), ROWS);
        for row in 0..ROWS {
            let seen = expected(row, share);
            let g = now[GEOMETRY].read::<11>(row, 0).map(f64::from);
            let close = |a: f64, b: f64| (a - b).abs() < NEAR * b.abs().max(1.0);
            let moved = (0..3).all(|k| close(g[k], seen.mean[k]));
            // What is the same in both: the covariance.
            let cov = |q: [f64; 4], s: [f64; 3]| {
                crate::math::sym3::from_quat_log_scales(quat::normalize(q).0, s.map(f64::ln))
            };
            let mine =
                cov([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]], std::array::from_fn(|k| g[LOG_SCALE + k].exp()));
            let theirs = cov(seen.quat, seen.scale);
            let shaped = (0..6).all(|k| close(mine[k], theirs[k]));
            let opaque = close(1.0 / (1.0 + (-g[OPACITY]).exp()), seen.alpha);
            let colored = (0..seen.sh.len()).all(|k| close(f64::from(now[SH].get(row, k)), seen.sh[k]));
            let same = [moved, shaped, opaque, colored];
            assert!(same == [true; 4], "row {row} at {share}: {same:?}\n{g:?}\n{:?} {:?}", seen.mean, seen.scale);
        }
    }
}

// 4DGaussians.

const PREFIX: &str = "deformation_net.";
const CHANNELS: usize = 16;
const SIDES: [usize; 2] = [4, 8];
const TIMES: usize = 5;
const AXES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

fn hexplane_net() -> Net {
    let mut net = Net::default();
    // The upper corner comes first; one axis the other way round.
    net.0.insert(format!("{PREFIX}grid.aabb"), (vec![2, 3], vec![1.5, 1.2, -1.4, -1.1, -1.3, 1.6]));
    for (level, side) in SIDES.into_iter().enumerate() {
        for (plane, axes) in AXES.iter().enumerate() {
            let [first, second] = axes.map(|a| if a == 3 { TIMES } else { side });
            let name = format!("{PREFIX}grid.grids.{level}.{plane}");
            net.add(&name, &[1, CHANNELS, second, first], 0.3);
            net.0.get_mut(&name).unwrap().1.iter_mut().for_each(|x| *x += 1.0);
        }
    }
    net.map(&format!("{PREFIX}feature_out.0"), CHANNELS * SIDES.len(), 12, 1.0);
    net.map(&format!("{PREFIX}feature_out.2"), 12, 12, 1.0);
    let heads =
        [("pos_deform", 3), ("scales_deform", 3), ("rotations_deform", 4), ("opacity_deform", 1), ("shs_deform", 48)];
    for (head, outputs) in heads {
        net.map(&format!("{PREFIX}{head}.1"), 12, 12, 1.0);
        net.map(&format!("{PREFIX}{head}.3"), 12, outputs, 0.3);
    }
    net
}

/// torch's grid_sample, bilinear, align_corners, border, of one channel.
fn sampled(net: &Net, name: &str, channel: usize, [x, y]: [f64; 2]) -> f64 {
    let &[_, _, height, width] = &net.0[name].0[..] else { panic!("four axes") };
    let place = |u: f64, n: usize| ((u + 1.0) / 2.0 * (n - 1) as f64).clamp(0.0, (n - 1) as f64);
    let (x, y) = (place(x, width), place(y, height));
    let at = |i: usize, j: usize| net.get(name, (channel * height + j.min(height - 1)) * width + i.min(width - 1));
    let (i, j) = (x.floor() as usize, y.floor() as usize);
    let (u, v) = (x - x.floor(), y - y.floor());
    (1.0 - v) * ((1.0 - u) * at(i, j) + u * at(i + 1, j)) + v * ((1.0 - u) * at(i, j + 1) + u * at(i + 1, j + 1))
}

fn hexplane_says(net: &Net, params: &Params, row: usize, t: f64, all: bool) -> Seen {
    let g = params[GEOMETRY].read::<11>(row, 0).map(f64::from);
    let corner = |i: usize| net.get(&format!("{PREFIX}grid.aabb"), i);
    let mut x: Vec<f64> = (0..3).map(|k| (g[k] - corner(k)) * 2.0 / (corner(3 + k) - corner(k)) - 1.0).collect();
    x.push(t);
    let mut features = Vec::new();
    for level in 0..SIDES.len() {
        for c in 0..CHANNELS {
            let plane = |(p, axes): (usize, &[usize; 2])| {
                sampled(net, &format!("{PREFIX}grid.grids.{level}.{p}"), c, axes.map(|a| x[a]))
            };
            features.push(AXES.iter().enumerate().map(plane).product());
        }
    }
    let hidden = net.apply(&format!("{PREFIX}feature_out.0"), &features);
    let hidden = net.apply(&format!("{PREFIX}feature_out.2"), &relu(hidden));
    let head = |name: &str| {
        let h = net.apply(&format!("{PREFIX}{name}.1"), &relu(hidden.clone()));
        net.apply(&format!("{PREFIX}{name}.3"), &relu(h))
    };
    let (dx, ds, dr) = (head("pos_deform"), head("scales_deform"), head("rotations_deform"));
    let (d_o, d_sh) = (head("opacity_deform"), head("shs_deform"));
    let logit = g[OPACITY] + if all { d_o[0] } else { 0.0 };
    Seen {
        mean: std::array::from_fn(|k| g[k] + dx[k]),
        quat: std::array::from_fn(|k| g[QUAT + k] + dr[k]),
        scale: std::array::from_fn(|k| (g[LOG_SCALE + k] + ds[k]).exp()),
        alpha: 1.0 / (1.0 + (-logit).exp()),
        sh: (0..48).map(|k| f64::from(params[SH].get(row, k)) + if all { d_sh[k] } else { 0.0 }).collect(),
    }
}

#[test]
fn feature_planes_of_4dgaussians_are_evaluated_as_there() {
    let (net, params) = (hexplane_net(), cloud());
    let (ply, network) = (ply_of(&params), net.file());
    for (settings, all) in [("Namespace(no_do=False, no_dshs=False)", true), ("", false)] {
        let files = Trained { gaussians: &ply, network: &network, settings };
        let opened = read_trained(files, Some([2.0, 5.0])).unwrap();
        assert_eq!((opened.scene.clip, opened.scene.up), ([2.0, 5.0], Y_DOWN));
        assert_eq!(opened.warnings.lines().iter().any(|w| w.contains("cfg_args")), settings.is_empty());
        check(&opened.scene, |row, t| hexplane_says(&net, &params, row, t, all));
    }
    for settings in ["Namespace(static_mlp=True)", "Namespace(x=1, apply_rotation=True)"] {
        let error = read_trained(Trained { gaussians: &ply, network: &network, settings }, None).unwrap_err();
        assert!(error.kind() == ErrorKind::Unsupported && error.to_string().contains("=True"), "{error}");
    }
    let mut other = net.clone();
    other.map(&format!("{PREFIX}feature_out.0"), 3 * CHANNELS * SIDES.len(), 12, 1.0);
    let error =
        read_trained(Trained { gaussians: &ply, network: &other.file(), settings: "" }, None).unwrap_err().to_string();
    assert!(error.contains("96 inputs"), "{error}");
}

// Deformable-3D-Gaussians and SC-GS.

/// A perceptron of eight layers of position and time.
fn perceptron(prefix: &str, time_net: bool, heads: &[(&str, usize)]) -> Net {
    let mut net = Net::default();
    let (x_levels, t_levels) = (10, if time_net { 6 } else { 10 });
    let mut seen = 1 + 2 * t_levels;
    if time_net {
        net.map(&format!("{prefix}timenet.0"), seen, 256, 1.0);
        net.map(&format!("{prefix}timenet.2"), 256, 30, 1.0);
        seen = 30;
    }
    let (inputs, width) = (3 + 6 * x_levels + seen, 14);
    for i in 0..8 {
        let of = if i == 0 { inputs } else { width + if i == 5 { inputs } else { 0 } };
        net.map(&format!("{prefix}linear.{i}"), of, width, 1.4);
    }
    for (head, outputs) in heads {
        net.map(&format!("{prefix}{head}"), width, *outputs, 0.05);
    }
    net
}

/// The hidden numbers in front of the heads.
fn hidden_of(net: &Net, prefix: &str, x: [f64; 3], t: f64) -> Vec<f64> {
    let time_net = net.0.contains_key(&format!("{prefix}timenet.0.weight"));
    let mut seen = encoded(&[t], if time_net { 6 } else { 10 });
    if time_net {
        let h = relu(net.apply(&format!("{prefix}timenet.0"), &seen));
        seen = net.apply(&format!("{prefix}timenet.2"), &h);
    }
    let input = [encoded(&x, 10), seen].concat();
    let mut h = input.clone();
    for i in 0..8 {
        h = relu(net.apply(&format!("{prefix}linear.{i}"), &h));
        if i == 4 {
            h = [input.clone(), h].concat();
        }
    }
    h
}

fn unit(q: &[f64]) -> [f64; 4] {
    quat::normalize([q[0], q[1], q[2], q[3]]).0
}

#[test]
fn perceptrons_of_deformable_gaussians_are_evaluated_as_there() {
    let params = cloud();
    let ply = ply_of(&params);
    let heads = [("gaussian_rotation", 4), ("gaussian_scaling", 3)];
    let screw = [("branch_w", 3), ("branch_v", 3), heads[0], heads[1]];
    let shift = [("gaussian_warp", 3), heads[0], heads[1]];
    for (time_net, heads) in [(true, &shift[..]), (false, &shift[..]), (true, &screw[..])] {
        let net = perceptron("", time_net, heads);
        let network = net.file();
        let settings = "Namespace(is_blender=True, sh_degree=3)";
        let opened = read_trained(Trained { gaussians: &ply, network: &network, settings }, None).unwrap();
        assert_eq!((opened.scene.up, opened.scene.clip), (BLENDER_UP, UNKNOWN_CLIP));
        assert!(opened.warnings.lines().iter().any(|w| w.contains("one second")));
        check(&opened.scene, |row, t| {
            let g = params[GEOMETRY].read::<11>(row, 0).map(f64::from);
            let h = hidden_of(&net, "", [g[0], g[1], g[2]], t);
            let (dr, ds) = (net.apply("gaussian_rotation", &h), net.apply("gaussian_scaling", &h));
            let mean = if heads.len() == 4 {
                let [w, v] = ["branch_w", "branch_v"].map(|name| net.apply(name, &h));
                crate::math::twist::move_point([w[0], w[1], w[2]], [v[0], v[1], v[2]], [g[0], g[1], g[2]])
            } else {
                let dx = net.apply("gaussian_warp", &h);
                [0, 1, 2].map(|k| g[k] + dx[k])
            };
            let q = unit(&g[QUAT..QUAT + 4]);
            Seen {
                mean,
                quat: std::array::from_fn(|k| q[k] + dr[k]),
                scale: std::array::from_fn(|k| g[LOG_SCALE + k].exp() + ds[k]),
                alpha: 1.0 / (1.0 + (-g[OPACITY]).exp()),
                sh: Vec::new(),
            }
        });
    }
}

const NODES: usize = 6;
const HYPER: usize = 2;

/// A network of SC-GS.
fn nodes_net(local: bool) -> Net {
    let mut heads = vec![("gaussian_warp", 3), ("gaussian_rotation", 4), ("gaussian_scaling", 3)];
    heads.extend(local.then_some(("local_rotation", 4)));
    let mut net = perceptron("network.", true, &heads);
    net.add("nodes", &[NODES, 3 + HYPER], 0.7);
    net.add("_node_radius", &[NODES], 0.2);
    net.add("_node_weight", &[NODES, 1], 1.0);
    net
}

/// A .ply with features of the Gaussians.
fn ply_with(params: &Params, features: usize, value: impl Fn(usize, usize) -> f32) -> Vec<u8> {
    let plain = ply_of(params);
    let at = plain.windows(11).position(|w| w == b"end_header\n").unwrap();
    let names: String = (0..features).map(|i| format!("property float fea_{i}\n")).collect();
    let mut out = [&plain[..at], names.as_bytes(), b"end_header\n"].concat();
    let stride = (plain.len() - at - 11) / ROWS;
    for (row, bytes) in plain[at + 11..].chunks_exact(stride).enumerate() {
        out.extend(bytes);
        (0..features).for_each(|i| out.extend(value(row, i).to_le_bytes()));
    }
    out
}

#[test]
fn control_nodes_of_sc_gs_are_evaluated_as_there() {
    let params = cloud();
    let feature = |row: usize, i: usize| ((3 * row + 7 * i) as f32).sin() * 0.3;
    for (local, masked) in [(true, false), (false, true)] {
        let net = nodes_net(local);
        let (ply, network) = (ply_with(&params, HYPER + usize::from(masked), feature), net.file());
        let opened =
            read_trained(Trained { gaussians: &ply, network: &network, settings: "Namespace(K=3)" }, None).unwrap();
        check(&opened.scene, |row, t| {
            let g = params[GEOMETRY].read::<11>(row, 0).map(f64::from);
            let place = |k: usize, c: usize| net.get("nodes", k * (3 + HYPER) + c);
            let point: Vec<f64> = (0..3).map(|k| g[k]).chain((0..HYPER).map(|i| f64::from(feature(row, i)))).collect();
            let mut near: Vec<(f64, usize)> =
                (0..NODES).map(|k| ((0..3 + HYPER).map(|c| (place(k, c) - point[c]).powi(2)).sum(), k)).collect();
            near.sort_by(|a, b| a.0.total_cmp(&b.0));
            let weigh = |&(d, k): &(f64, usize)| {
                let r = net.get("_node_radius", k).exp();
                (-d / (2.0 * r * r)).exp() / (1.0 + (-net.get("_node_weight", k)).exp()) + 1e-7
            };
            let sum: f64 = near[..3].iter().map(weigh).sum();
            let mask = if masked { 1.0 / (1.0 + (-f64::from(feature(row, HYPER))).exp()) } else { 1.0 };
            let (mut shift, mut dr, mut ds) = ([0.0; 3], [0.0; 4], [0.0; 3]);
            for pair in &near[..3] {
                let (w, k) = (weigh(pair) / sum * mask, pair.1);
                let node = [0, 1, 2].map(|c| place(k, c));
                let h = hidden_of(&net, "network.", node, t);
                let [d, r, s] = ["gaussian_warp", "gaussian_rotation", "gaussian_scaling"]
                    .map(|name| net.apply(&format!("network.{name}"), &h));
                let mut turn = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
                if local {
                    let u = net.apply("network.local_rotation", &h);
                    turn = quat::to_rotation(unit(&[1.0 + u[0], u[1], u[2], u[3]]));
                }
                for a in 0..3 {
                    let turned: f64 = (0..3).map(|b| turn[a][b] * (g[b] - node[b])).sum();
                    shift[a] += w * (turned + node[a] + d[a] - g[a]);
                    ds[a] += w * s[a];
                }
                (0..4).for_each(|c| dr[c] += w * r[c]);
            }
            Seen {
                mean: [0, 1, 2].map(|k| g[k] + shift[k]),
                quat: std::array::from_fn(|k| g[QUAT + k] + dr[k]),
                scale: std::array::from_fn(|k| g[LOG_SCALE + k].exp() + ds[k]),
                alpha: 1.0 / (1.0 + (-g[OPACITY]).exp()),
                sh: Vec::new(),
            }
        });
    }
    let network = nodes_net(true).file();
    let ply = ply_with(&params, HYPER + 2, feature);
    let error =
        read_trained(Trained { gaussians: &ply, network: &network, settings: "" }, None).unwrap_err().to_string();
    assert!(error.contains("4 features") && error.contains("2 hyper"), "{error}");
    let ply = ply_with(&params, HYPER, feature);
    let settings = "Namespace(use_hash=True)";
    let error = read_trained(Trained { gaussians: &ply, network: &network, settings }, None).unwrap_err().to_string();
    assert!(error.contains("use_hash=True"), "{error}");
}

// All.

#[test]
fn scenes_of_networks_are_written_and_read_again() {
    let (ply, network) = (ply_with(&cloud(), HYPER, |row, i| (row + i) as f32 * 0.1), nodes_net(true).file());
    let opened = read_trained(Trained { gaussians: &ply, network: &network, settings: "" }, None).unwrap();
    let mut bytes = Vec::new();
    crate::format::scene::write(&opened.scene, &mut bytes).unwrap();
    let again = crate::format::scene::read(&bytes).unwrap();
    let [a, b] = [&opened.scene, &again].map(|s| freeze(s, Time(0.37)).unwrap()[GEOMETRY].clone());
    assert_eq!(a.data(), b.data());
}

#[test]
fn hostile_and_damaged_networks_are_refused() {
    let params = cloud();
    let ply = ply_with(&params, HYPER, |_, _| 0.1);
    let refused = |net: &Net| {
        let network = net.file();
        read_trained(Trained { gaussians: &ply, network: &network, settings: "" }, None).unwrap_err().to_string()
    };
    let mut nothing = Net::default();
    nothing.add("weight", &[1], 1.0);
    assert!(refused(&nothing).contains("it has weight"));
    // A function instead of a tensor.
    let call = b"X\x05\0\0\0nodescposix\nsystem\nX\x02\0\0\0ls\x85R";
    let hostile = saved(Some("x"), &[], call);
    assert!(read_trained(Trained { gaussians: &ply, network: &hostile, settings: "" }, None).is_err());
    for (name, shape) in
        [("nodes", vec![NODES * 5]), ("nodes", vec![NODES, 2]), ("nodes", vec![0, 5]), ("_node_radius", vec![2, 3])]
    {
        let mut net = nodes_net(true);
        net.add(name, &shape, 1.0);
        assert!(!refused(&net).is_empty(), "{name} {shape:?}");
    }
    for name in ["network.linear.5", "network.gaussian_scaling", "network.timenet.2"] {
        let mut net = nodes_net(true);
        net.map(name, 3, 2, 1.0);
        assert!(!refused(&net).is_empty(), "{name}");
        net.0.remove(&format!("{name}.bias"));
        assert!(refused(&net).contains("bias"), "{name}");
    }
    for name in ["grid.grids.0.0", "grid.grids.0.2", "grid.grids.1.5", "grid.aabb"] {
        for shape in [vec![], vec![1, 0, 0, 0], vec![1, 16, 3, 5], vec![2, 16, 4, 4]] {
            let mut net = hexplane_net();
            net.add(&format!("{PREFIX}{name}"), &shape, 1.0);
            assert!(!refused(&net).is_empty(), "{name} {shape:?}");
        }
    }
    for net in [hexplane_net(), nodes_net(false), perceptron("", false, &[("gaussian_warp", 3)])] {
        for network in mutants(&net.file(), 60, "research") {
            let _ = read_trained(Trained { gaussians: &ply, network: &network, settings: "" }, None);
        }
    }
}
