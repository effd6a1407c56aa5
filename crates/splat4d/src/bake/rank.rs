//! Ranks primitives by the change of images without them, so that a part of a file looks like the whole.
//!
//! The area of a primitive is a poor measure: a large one behind a wall, or one of its neighbours' colour, is not
//! missed. Renders of the baked scene at times spread over the clip measure what the removal of each primitive changes.
//! A short lifespan lies between two renders or on one by chance; therefore the change is measured for each unit of
//! squared opacity, and then weighed by the time for which the primitive is there. A static primitive and one that is
//! there for a tenth of the clip then count by what they add to the mean squared error of all frames.

use super::Options;
use crate::format::playback::{Node, Primitive, as_layers};
use crate::layers::{Evaluation, Scene};
use crate::render::{Importance, RenderConfig, Shot};
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::{Camera, Time};

/// Renders a second of the clip: a lifespan of 0.1 s is sampled twice.
const A_SECOND: f64 = 20.0;
/// Fewest renders, and most products of renders and Gaussians: some seconds of one core.
const FEWEST: usize = 12;
const WORK: usize = 2_000_000;
/// Longer side of these renders, pixels: half of a Gaussian's rank is settled by less.
const SIDE: usize = 240;
/// A Gaussian fainter than this states nothing of what its removal changes.
const FAINT: f64 = 0.02;
/// Share of what its size alone suggests that is kept where no render shows the Gaussian: another view may.
const UNSEEN: f64 = 0.02;
/// Steps of the golden ratio through the cameras visit all of them evenly, whatever the number of renders, and never in
/// step with time.
const GOLDEN: f64 = 0.618_033_988_749_894_9;

/// Share of the primitives that a round of [`peel`] keeps, most rounds, and how few are not ranked again.
const KEPT: f64 = 0.7;
const ROUNDS: usize = 6;
const FEW: usize = 64;

/// Measurements of one primitive.
#[derive(Clone, Copy, Default)]
struct ImageChange {
    /// Change of the image, mean squared error, and squared opacity, over the renders at whose time it is there.
    change: f64,
    squares: f64,
}

/// Replaces the importance of all primitives by what images lack without them. Without cameras nothing changes.
pub(super) fn rank(nodes: &mut [Node], scene: &Scene<f32>, options: &Options) {
    let shots = shots(scene.clip, options, nodes.iter().map(|n| n.primitives.len()).sum());
    if shots.is_empty() {
        return;
    }
    let (layers, places) = as_layers(nodes);
    let baked = Scene { layers, clip: scene.clip, fps: scene.fps, background: scene.background, ..Scene::default() };
    let mut seen: Vec<Vec<ImageChange>> =
        nodes.iter().map(|n| vec![ImageChange::default(); n.primitives.len()]).collect();
    let (mut importance, mut instant) = (Importance::new(RenderConfig::default()), Evaluation::default());
    let mut changes = Vec::new();
    for (time, camera) in shots {
        let camera = camera.downscaled(camera.width.max(camera.height).div_ceil(SIDE).max(1));
        let pixels = (camera.width * camera.height) as f64;
        baked.at(Time(time), &mut instant);
        let splats = baked.splats(&instant);
        importance.removals(&Shot::new(&splats, &camera, baked.background), &mut changes);
        let mut first = 0;
        for (tape, &(node, row)) in instant.tapes().zip(&places) {
            let (rows, table) = (tape.rows(), tape.out());
            for j in 0..table.rows() {
                let opacity = f64::from(table.get(j, SPLAT_OPACITY));
                if opacity >= FAINT {
                    let seen = &mut seen[node][row + rows.id(j)];
                    seen.change += f64::from(changes[first + j]) / pixels;
                    seen.squares += opacity * opacity;
                }
            }
            first += table.rows();
        }
    }
    for (node, seen) in nodes.iter_mut().zip(seen) {
        weigh(node, &seen);
    }
}

/// Ranks as [`rank`], then leaves out the least important ones and ranks the rest again by what images of it alone lack,
/// round after round: a part of the file is seen without what was left out of it, and what replaces that counts more.
pub(super) fn peel(nodes: &mut [Node], scene: &Scene<f32>, options: &Options) {
    let guesses: Vec<Vec<f32>> = nodes.iter().map(|n| n.primitives.iter().map(|p| p.importance).collect()).collect();
    rank(nodes, scene, options);
    let mut left: Vec<Vec<usize>> = nodes.iter().map(|n| (0..n.primitives.len()).collect()).collect();
    for _ in 0..ROUNDS {
        let value = |node: &Node, i: usize| f64::from(node.primitives[i].importance) * (node.to - node.from);
        let mut values: Vec<f64> =
            nodes.iter().zip(&left).flat_map(|(n, rows)| rows.iter().map(|&i| value(n, i))).collect();
        let kept = (KEPT * values.len() as f64) as usize;
        if kept < FEW {
            return;
        }
        let (_, least, _) = values.select_nth_unstable_by(kept - 1, |a, b| b.total_cmp(a));
        let least = *least;
        for (node, rows) in nodes.iter().zip(&mut left) {
            rows.retain(|&i| value(node, i) >= least);
        }
        let part = |((node, rows), guesses): ((&Node, &Vec<usize>), &Vec<f32>)| {
            let one = |&i: &usize| Primitive { importance: guesses[i], ..node.primitives[i].clone() };
            Node { from: node.from, to: node.to, primitives: rows.iter().map(one).collect() }
        };
        let mut parts: Vec<Node> = nodes.iter().zip(&left).zip(&guesses).map(part).collect();
        rank(&mut parts, scene, options);
        for ((node, rows), part) in nodes.iter_mut().zip(&left).zip(parts) {
            let floor = (least / (node.to - node.from)) as f32;
            for (&i, p) in rows.iter().zip(part.primitives) {
                // What was kept stays above what was left out.
                node.primitives[i].importance = p.importance.max(floor);
            }
        }
    }
}

/// Times and cameras: those that are static at times spread over the clip, and those of a path at their own.
fn shots(clip: [f64; 2], options: &Options, gaussians: usize) -> Vec<(f64, &Camera)> {
    let [from, to] = clip;
    let most = (WORK / gaussians.max(1)).max(FEWEST);
    let count = ((A_SECOND * (to - from)) as usize).clamp(FEWEST, most);
    let Options { cameras, path, .. } = options;
    let still = if cameras.is_empty() { 0 } else { count };
    let camera = |i: usize| &cameras[((i as f64 * GOLDEN).fract() * cameras.len() as f64) as usize % cameras.len()];
    let spread = (0..still).map(|i| (from + (to - from) * (i as f64 + 0.5) / still as f64, camera(i)));
    let stride = path.len().div_ceil(count).max(1);
    spread.chain(path.iter().step_by(stride).map(|(t, camera)| (*t, camera))).collect()
}

/// Sets the importance of a node's primitives from what renders measured.
fn weigh(node: &mut Node, seen: &[ImageChange]) {
    let guesses: Vec<f64> = node.primitives.iter().map(|p| f64::from(p.importance.max(0.0))).collect();
    let measured: Vec<f64> = node
        .primitives
        .iter()
        .zip(seen)
        .map(|(p, s)| if s.squares > 0.0 { s.change / s.squares * presence(p, node.from, node.to) } else { 0.0 })
        .collect();
    let of_measured: f64 = guesses.iter().zip(seen).filter(|(_, s)| s.squares > 0.0).map(|(g, _)| g).sum();
    let unit = measured.iter().sum::<f64>() / of_measured;
    // A node that no camera sees keeps its guesses.
    if !(unit > 0.0 && unit.is_finite()) {
        return;
    }
    for (((p, guess), value), s) in node.primitives.iter_mut().zip(guesses).zip(measured).zip(seen) {
        let share = if s.squares > 0.0 { UNSEEN } else { 1.0 };
        let importance = (value + share * unit * guess) as f32;
        p.importance = if importance.is_finite() { importance } else { 0.0 };
    }
}

/// Mean over the node's time of the squared opacity: in the middle of the lifespan 1, Gaussian tails on both sides.
fn presence(p: &Primitive, from: f64, to: f64) -> f64 {
    let opacity = f64::from(p.opacity);
    let life = if p.half_width.is_finite() {
        let tails = p.softness.max(0.0) * std::f64::consts::PI.sqrt();
        ((2.0 * p.half_width + tails) / (to - from)).min(1.0)
    } else {
        1.0
    };
    opacity * opacity * life
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Se3;

    /// One with a lifespan of `half` seconds about the middle of a second.
    fn primitive(mean: [f64; 3], size: f32, half: f64, color: f32) -> Primitive {
        Primitive {
            mean,
            center: 0.5,
            half_width: half,
            softness: 0.01,
            quat: [1.0, 0.0, 0.0, 0.0],
            scales: [size; 3],
            opacity: 0.9,
            velocity: [0.0; 3],
            turn: [0.0; 3],
            base_color: [color; 3],
            sh_rest: [0.0; 45],
            importance: size * size,
            label: None,
            features: Vec::new(),
        }
    }

    #[test]
    fn gaussians_with_the_largest_image_error_rank_first() {
        let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.8, 64, 48);
        let options = Options { cameras: vec![camera], ..Options::default() };
        // A white wall, a large hidden one behind it, one of its colour before it, a small black one, and that for a
        // tenth of the time.
        let primitives = vec![
            primitive([0.0, 0.0, 0.0], 2.0, f64::INFINITY, 1.0),
            primitive([0.0, 0.0, 6.0], 1.5, f64::INFINITY, 0.0),
            primitive([0.5, 0.0, -1.0], 0.3, f64::INFINITY, 1.0),
            primitive([-0.5, 0.0, -1.0], 0.1, f64::INFINITY, 0.0),
            primitive([-0.5, 0.5, -1.0], 0.1, 0.05, 0.0),
        ];
        let mut nodes = vec![Node { from: 0.0, to: 1.0, primitives }];
        let scene = Scene { clip: [0.0, 1.0], background: [0.0; 3], ..Scene::default() };
        let before = nodes.clone();
        rank(&mut nodes, &scene, &Options::default());
        assert_eq!(nodes, before, "without cameras it stays as it was");
        rank(&mut nodes, &scene, &options);
        let mut order: Vec<usize> = (0..5).collect();
        let importance = |i: usize| nodes[0].primitives[i].importance;
        order.sort_by(|&a, &b| importance(b).total_cmp(&importance(a)));
        let all = [0, 1, 2, 3, 4].map(importance);
        assert_eq!(order[0], 0, "the wall fills the image: {all:?}");
        assert!(all[3] > all[2], "nine times the area of the wall's colour is missed less than a black dot: {all:?}");
        assert!(all[1] < 0.01 * all[0], "a hidden one, of half the wall's area, is hardly missed: {all:?}");
        let ratio = importance(3) / importance(4);
        assert!((5.0..20.0).contains(&ratio), "a tenth of the time counts a tenth: {ratio}");
    }

    #[test]
    fn rounds_rank_again_what_is_left() {
        let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.8, 64, 48);
        let options = Options { cameras: vec![camera], ..Options::default() };
        let scene = Scene { clip: [0.0, 1.0], background: [0.0; 3], ..Scene::default() };
        let rng = crate::math::Rng::new(3, "peel", 0);
        let cloud = |i: u64| {
            let r = rng.fork(i);
            let mean = [1.2 * r.normal(0), 0.9 * r.normal(1), 0.8 * r.normal(2)];
            let size = (-2.2 + 0.6 * r.normal(3)).exp() as f32;
            primitive(mean, size, f64::INFINITY, r.uniform(4) as f32)
        };
        let whole = vec![Node { from: 0.0, to: 1.0, primitives: (0..800).map(cloud).collect() }];
        let (mut once, mut peeled) = (whole.clone(), whole);
        rank(&mut once, &scene, &options);
        peel(&mut peeled, &scene, &options);
        let least = |nodes: &[Node]| {
            let mut all: Vec<f32> = nodes[0].primitives.iter().map(|p| p.importance).collect();
            all.sort_by(f32::total_cmp);
            (all[0], all[400])
        };
        assert!(least(&once).0 >= 0.0 && least(&peeled).1.is_finite());
        // The lowest ones are left out in the first round: they keep what they had.
        assert_eq!(least(&once).0, least(&peeled).0);
        assert_ne!(once, peeled, "those that are left are seen without them");
    }
}
