//! A static warm-up; then a stage that replaces the cloud by Gaussians skinned to nodes; then tracking frame by frame,
//! everything frozen but the newest page of node poses.

use super::*;
use splat4d::motion::still::{activate, activate_backward};
use splat4d::motion::{At, Cache, Tape};
use splat4d::scene::params::page_name;
use splat4d::scene::splats::{COV, SPLAT_OPACITY};
use splat4d::scene::{RowEdit, SplatGrads};

/// Nodes that pull each Gaussian.
const PULLS: usize = 2;
/// Seconds between two pages.
const PAGE_SECONDS: f64 = 0.1;
/// Opacity with which nodes are rendered as splats.
const NODE_OPACITY: f64 = 0.5;

/// μ = Σ w_b (c_b + A_b (μ₀ − c_b) + τ_b), Σ = A Σ₀ Aᵀ, A = Σ w_b (I + [ω_b]×): a linear blend, not a rotation. Poses
/// (τ, ω) stand in one page a frame and are interpolated in between.
#[derive(Clone)]
pub(super) struct Skinned {
    nodes: Key,
    skin: Key,
    pages: Vec<Key>,
}

impl Skinned {
    /// Makes nodes at `centers` and fixed weights to the nearest ones; one page of poses, at rest.
    pub(super) fn new<F: Real>(p: &mut Params<F>, centers: &[[F; 3]]) -> Self {
        let (rows, count) = (p.len(), centers.len());
        let columns = [("node_centers", 3), ("node_log_radius", 1)];
        let fill = |t: &mut Table<F>| {
            for (b, c) in centers.iter().enumerate() {
                t.write(b, 0, [c[0], c[1], c[2], F::of(-1.5)]);
            }
        };
        let nodes = p.entry("nodes", Space::Nodes, &columns, count, fill).unwrap();
        let near: Vec<[F; 2 * PULLS]> = (0..rows).map(|r| nearest(p[GEOMETRY].read::<3>(r, 0), centers)).collect();
        let fill = |t: &mut Table<F>| near.iter().enumerate().for_each(|(r, n)| t.write(r, 0, *n));
        let columns = [("skin_nodes", PULLS), ("skin_weights", PULLS)];
        let skin = p.entry("skin", Space::Gaussians, &columns, rows, fill).unwrap();
        p.info_mut(skin).trainable = false;
        let mut model = Self { nodes, skin, pages: Vec::new() };
        model.add_page(p);
        model
    }

    /// A page that starts as a copy of the last.
    pub(super) fn add_page<F: Real>(&mut self, p: &mut Params<F>) {
        let (frame, rows) = (self.pages.len() as u32, p[self.nodes].rows());
        let last = self.pages.last().map(|&k| p[k].column_to_rows(0, 6));
        let fill = |t: &mut Table<F>| {
            if let Some(values) = last {
                t.column_from_rows(0, 6, &values);
            }
        };
        let columns = [("node_shift", 3), ("node_turn", 3)];
        self.pages.push(p.page("poses", frame, Space::Nodes, &columns, rows, fill).unwrap());
    }

    /// The pages around t, and the share of the second.
    fn pages_at(&self, t: Time) -> (Key, Key, f64, bool) {
        let last = self.pages.len() - 1;
        let u = t.0 / PAGE_SECONDS;
        let inside = u > 0.0 && u < last as f64;
        let u = u.clamp(0.0, last as f64);
        let low = (u.floor() as usize).min(last);
        (self.pages[low], self.pages[(low + 1).min(last)], u - low as f64, inside)
    }

    fn pose<F: Real>(&self, p: &Params<F>, t: Time, node: usize) -> ([F; 6], [F; 6]) {
        let (low, high, share, inside) = self.pages_at(t);
        let (a, b) = (p[low].read::<6>(node, 0), p[high].read::<6>(node, 0));
        let slope = F::of(if inside { 1.0 / PAGE_SECONDS } else { 0.0 });
        let pose = std::array::from_fn(|k| a[k] + F::of(share) * (b[k] - a[k]));
        (pose, std::array::from_fn(|k| slope * (b[k] - a[k])))
    }

    /// Spreads dL/d pose over the two pages.
    fn pose_backward<F: Real>(&self, d: &mut Grads<F>, t: Time, node: usize, d_pose: [F; 6]) {
        let (low, high, share, _) = self.pages_at(t);
        d.of([low])[0].add(node, 0, d_pose.map(|x| x * F::of(1.0 - share)));
        d.of([high])[0].add(node, 0, d_pose.map(|x| x * F::of(share)));
    }
}

/// Numbers and weights of the nearest nodes.
fn nearest<F: Real>(x: [F; 3], centers: &[[F; 3]]) -> [F; 2 * PULLS] {
    let mut order: Vec<(f64, usize)> =
        (0..centers.len()).map(|b| ((0..3).map(|k| (x[k] - centers[b][k]).f64().powi(2)).sum::<f64>(), b)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let weights: Vec<f64> = order.iter().take(PULLS).map(|o| (-o.0 / 0.2).exp()).collect();
    let sum: f64 = weights.iter().sum();
    std::array::from_fn(|i| F::of(if i < PULLS { order[i].1 as f64 } else { weights[i - PULLS] / sum }))
}

type Matrix<F> = [[F; 3]; 3];

fn product<F: Real>(a: &Matrix<F>, b: &Matrix<F>) -> Matrix<F> {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

fn transposed<F: Real>(a: &Matrix<F>) -> Matrix<F> {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

fn full<F: Real>(c: [F; 6]) -> Matrix<F> {
    [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]]
}

/// dL/dΣ as a symmetric matrix, from the gradient to six numbers of which an off-diagonal represents two positions.
fn full_gradient<F: Real>(c: [F; 6]) -> Matrix<F> {
    let h = F::HALF;
    full([c[0], h * c[1], h * c[2], c[3], h * c[4], c[5]])
}

impl<F: Real> Motion<F> for Skinned {
    fn spec(&self) -> Spec {
        Spec::Custom("skinned".into())
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, _: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        for j in 0..q.len() {
            let id = q.rows.id(j);
            if q.of == Space::Nodes {
                let [x, y, z, log_radius] = q.p[self.nodes].read::<4>(id, 0);
                let (pose, _) = self.pose(q.p, q.t, id);
                let v = (F::TWO * log_radius).exp();
                let (o, n) = (F::of(NODE_OPACITY), F::ZERO);
                tape.out.write(j, 0, [x + pose[0], y + pose[1], z + pose[2], v, n, n, v, n, v, o]);
                continue;
            }
            let mut row = activate(q.p[GEOMETRY].read::<11>(id, 0));
            let (mean, a, _) = self.blend(q, id);
            let cov = product(&product(&a, &full(std::array::from_fn(|k| row[COV + k]))), &transposed(&a));
            row[..3].copy_from_slice(&mean);
            row[COV..SPLAT_OPACITY]
                .copy_from_slice(&[cov[0][0], cov[0][1], cov[0][2], cov[1][1], cov[1][2], cov[2][2]]);
            tape.out.write(j, 0, row);
        }
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        _: &Cache,
        _: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        _: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        // Gaussians pull on nodes: a learner of poses must state that nodes take part.
        d.activate(Space::Nodes, splat4d::scene::Rows::All);
        let mut d_time = 0.0;
        for j in 0..q.len() {
            let id = q.rows.id(j);
            let g = d_out.out.read::<10>(j, 0);
            if q.of == Space::Nodes {
                let v = (F::TWO * q.p[self.nodes].get(id, 3)).exp();
                let d_radius = F::TWO * v * (g[COV] + g[COV + 3] + g[COV + 5]);
                d.of([self.nodes])[0].add(id, 0, [g[0], g[1], g[2], d_radius]);
                let (_, speed) = self.pose(q.p, q.t, id);
                d_time += (0..3).map(|k| (g[k] * speed[k]).f64()).sum::<f64>();
                self.pose_backward(d, q.t, id, [g[0], g[1], g[2], F::ZERO, F::ZERO, F::ZERO]);
                continue;
            }
            let raw = q.p[GEOMETRY].read::<11>(id, 0);
            let rest = activate(raw);
            let (_, a, pulls) = self.blend(q, id);
            let (cov, d_cov) =
                (full(std::array::from_fn(|k| rest[COV + k])), full_gradient::<F>(std::array::from_fn(|k| g[COV + k])));
            // Σ = A Σ₀ Aᵀ: dΣ₀ = Aᵀ G A, dA = 2 G A Σ₀.
            let d_rest = product(&product(&transposed(&a), &d_cov), &a);
            let d_a = product(&product(&d_cov, &a), &cov).map(|r| r.map(|x| F::TWO * x));
            let mut d_mean0 = [F::ZERO; 3];
            for (node, w, pose, speed) in pulls {
                let c = q.p[self.nodes].read::<3>(node, 0);
                let arm: [F; 3] = std::array::from_fn(|k| raw[k] - c[k]);
                let turn = linear(&pose);
                // μ gets w (c + A_b (μ₀ − c) + τ).
                let by_arm: [F; 3] = std::array::from_fn(|k| (0..3).map(|i| w * g[i] * turn[i][k]).sum());
                (0..3).for_each(|k| d_mean0[k] += by_arm[k]);
                d.of([self.nodes])[0].add(node, 0, std::array::from_fn::<F, 3, _>(|k| w * g[k] - by_arm[k]));
                let mut d_turn = d_a.map(|r| r.map(|x| w * x));
                for i in 0..3 {
                    for k in 0..3 {
                        d_turn[i][k] += w * g[i] * arm[k];
                    }
                }
                let d_pose = [
                    w * g[0],
                    w * g[1],
                    w * g[2],
                    d_turn[2][1] - d_turn[1][2],
                    d_turn[0][2] - d_turn[2][0],
                    d_turn[1][0] - d_turn[0][1],
                ];
                d_time += (0..6).map(|k| (d_pose[k] * speed[k]).f64()).sum::<f64>();
                self.pose_backward(d, q.t, node, d_pose);
            }
            // Off-diagonals represent both their places again.
            let m = d_rest;
            let d_row = [
                d_mean0[0],
                d_mean0[1],
                d_mean0[2],
                m[0][0],
                m[0][1] + m[1][0],
                m[0][2] + m[2][0],
                m[1][1],
                m[1][2] + m[2][1],
                m[2][2],
                g[SPLAT_OPACITY],
            ];
            d.of([GEOMETRY])[0].add(id, 0, activate_backward(raw, d_row));
        }
        d_time
    }

    /// Skins name nodes by number: an edit of the nodes renumbers them.
    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, _: &Rng) {
        if edit.space != Space::Nodes {
            return;
        }
        for r in 0..p[self.skin].rows() {
            let old = p[self.skin].read::<PULLS>(r, 0);
            let new = old.map(|b| {
                let found = edit.parent.iter().position(|&parent| f64::from(parent) == b.f64());
                F::of(found.unwrap_or(0) as f64)
            });
            p[self.skin].write(r, 0, new);
        }
    }
}

type Pull<F> = (usize, F, [F; 6], [F; 6]);

impl Skinned {
    /// Mean, blended linear map, and the pulls of a Gaussian.
    fn blend<F: Real>(&self, q: &At<'_, F>, id: usize) -> ([F; 3], Matrix<F>, [Pull<F>; PULLS]) {
        let x = q.p[GEOMETRY].read::<3>(id, 0);
        let skin = q.p[self.skin].read::<{ 2 * PULLS }>(id, 0);
        let pulls: [Pull<F>; PULLS] = std::array::from_fn(|i| {
            let node = skin[i].f64() as usize;
            let (pose, speed) = self.pose(q.p, q.t, node);
            (node, skin[PULLS + i], pose, speed)
        });
        let (mut mean, mut a) = ([F::ZERO; 3], [[F::ZERO; 3]; 3]);
        for (node, w, pose, _) in &pulls {
            let c = q.p[self.nodes].read::<3>(*node, 0);
            let turn = linear(pose);
            for i in 0..3 {
                let turned: F = (0..3).map(|k| turn[i][k] * (x[k] - c[k])).sum();
                mean[i] += *w * (c[i] + turned + pose[i]);
                (0..3).for_each(|k| a[i][k] += *w * turn[i][k]);
            }
        }
        (mean, a, pulls)
    }
}

/// I + [ω]×
fn linear<F: Real>(pose: &[F; 6]) -> Matrix<F> {
    let [_, _, _, x, y, z] = *pose;
    [[F::ONE, -z, y], [z, F::ONE, -x], [-y, x, F::ONE]]
}

/// Pulls nodes towards where the object is known to be: a loss on nodes, which are evaluated as splats.
struct Anchors {
    at: Vec<([f64; 3], Time)>,
}

impl<F: Real> ProbeLoss<F> for Anchors {
    fn name(&self) -> &str {
        "anchors"
    }

    fn probes(&self, _: &Scene<F>, _: &StepInfo) -> Vec<crate::step::chain::Probe> {
        let times = self.at.iter().map(|a| a.1).collect();
        vec![crate::step::chain::Probe { layer: 0, of: Space::Nodes, rows: None, times }]
    }

    fn eval(
        &self,
        _: &Scene<F>,
        _: &[crate::step::chain::Probe],
        seen: &[Vec<Table<F>>],
        d: &mut [Vec<Table<F>>],
    ) -> f64 {
        let mut sum = 0.0;
        for (k, (target, _)) in self.at.iter().enumerate() {
            let n = seen[0][k].rows();
            for r in 0..n {
                for axis in 0..3 {
                    let e = seen[0][k].get(r, axis) - F::of(target[axis]);
                    sum += 0.02 * (e * e).f64() / n as f64;
                    d[0][k].add(r, axis, [e * F::of(0.04 / n as f64)]);
                }
            }
        }
        sum
    }
}

pub(super) fn skinned_scene(pages: usize) -> (Scene<f64>, Skinned) {
    let mut p = cloud::<f64>(12, LifeKind::Infinite, 3);
    let centers: Vec<[f64; 3]> = (0..4).map(|b| p[GEOMETRY].read::<3>(3 * b, 0)).collect();
    let mut model = Skinned::new(&mut p, &centers);
    (1..pages).for_each(|_| model.add_page(&mut p));
    let pages = model.pages.clone();
    pages.iter().enumerate().for_each(|(i, &k)| shake(&mut p, k, 0.15, i as u64));
    (one_layer(p, Arc::new(model.clone()), LifeKind::Infinite), model)
}

#[test]
fn gradients_reach_skinned_gaussians_nodes_and_every_page() {
    let (scene, _) = skinned_scene(3);
    let shots = shots(&[(0, 0.03), (1, 0.13), (2, 0.13)]);
    let reached = check_gradients(&scene, &shots, &Vec::new());
    assert_reached(&reached[0], &["geometry", "sh", "nodes", "poses@0", "poses@1", "poses@2"]);
    let anchors: Probes = vec![Box::new(Anchors { at: vec![([0.1, 0.2, 0.0], Time(0.03)), ([0.3; 3], Time(0.17))] })];
    check_gradients(&scene, &shots, &anchors);
}

#[test]
fn an_edit_of_nodes_keeps_every_gaussian_on_its_nodes() {
    let (mut scene, _) = skinned_scene(2);
    let shots = shots(&[(0, 0.05)]);
    let before = value(&scene, &shots, &Vec::new());
    // Nodes in reverse order: nothing may be seen of it, in any page.
    let mut edit = RowEdit::identity(Space::Nodes, 4);
    edit.parent.reverse();
    scene.layers[0].edit(&edit, &Rng::new(0, "edit", 0));
    assert!((value(&scene, &shots, &Vec::new()) - before).abs() < 1e-15);
    assert_eq!(scene.layers[0].params.len(), 12);
}

#[test]
fn warm_up_then_nodes_then_frame_by_frame_tracking() {
    let motion = build_as(&Spec::Still, &mut Params::<f32>::new(0, 1, &[])).unwrap();
    let scene = one_layer(cloud::<f32>(90, LifeKind::Infinite, 1), motion, LifeKind::Infinite);
    let warm_up =
        Stage { sampler: Sampler::Frame(0), batch: 4, groups: groups(&ORDINARY), ..Stage::new("warm-up", 20) };
    // Every third Gaussian becomes a node; two new ones a node replace the cloud.
    let replace: Hook = Box::new(|scene, _| {
        let old = &scene.layers[0].params;
        let centers: Vec<[f32; 3]> = (0..old.len()).step_by(3).map(|r| old[GEOMETRY].read::<3>(r, 0)).collect();
        let mut edit = RowEdit { space: Space::Gaussians, parent: Vec::new(), born: Vec::new() };
        (0..2 * centers.len()).for_each(|i| edit.push(3 * (i as u32 / 2), splat4d::scene::Born::Clone));
        let mut params = old.clone();
        params.apply(&edit);
        let model = Skinned::new(&mut params, &centers);
        let layer = Layer::new("skinned", params, Arc::new(model), LifeKind::Infinite);
        scene.layers = vec![layer];
        Ok(())
    });
    let anchors = Anchors { at: vec![(Made::new(1, 1, 4).object_at(0.0), Time(0.0))] };
    let nodes = Stage {
        sampler: Sampler::Frame(0),
        batch: 4,
        groups: groups(&[("node_centers", 0.01), ("means", 0.01), ("sh", 0.02), ("log_scales", 0.02)]),
        probes: vec![Box::new(anchors)],
        start: Some(replace),
        ..Stage::new("nodes", 20)
    };
    let mut stages = vec![warm_up, nodes];
    for frame in 1..3u32 {
        let track: Hook = Box::new(move |scene, _| {
            let layer = &mut scene.layers[0];
            // The model is plain keys: find them again, add a page, put the new model in place.
            let key = |name: &str| layer.params.find(name).expect("the node stage made it");
            let pages = (0..frame).map(|f| key(&page_name("poses", f))).collect();
            let mut model = Skinned { nodes: key("nodes"), skin: key("skin"), pages };
            model.add_page(&mut layer.params);
            layer.motion = Arc::new(model);
            Ok(())
        });
        stages.push(Stage {
            sampler: Sampler::Frame(frame as usize),
            batch: 4,
            groups: groups(&[(&page_name("node_shift", frame), 0.02), (&page_name("node_turn", frame), 0.01)]),
            start: Some(track),
            ..Stage::new("tracking", 15)
        });
    }
    let mut t = trainer(scene, stages, 200);
    assert_falls(&finish_stage(&mut t), 0.8, "warm-up");
    assert_eq!(t.scene().layers[0].params.len(), 90);
    let before = t.scene().layers[0].params.clone();
    assert_falls(&finish_stage(&mut t), 0.9, "nodes");
    assert_eq!(t.scene().layers[0].params.len(), 60, "the cloud was replaced");
    let nodes = t.scene().layers[0].params.find("nodes").unwrap();
    let moved = (0..30).any(|b| t.scene().layers[0].params[nodes].get(b, 0) != before[GEOMETRY].get(3 * b, 0));
    assert!(moved, "nodes learn");
    for frame in 1..3 {
        let before = t.scene().layers[0].params.clone();
        assert_falls(&finish_stage(&mut t), 0.97, "tracking");
        let after = &t.scene().layers[0].params;
        for key in before.keys() {
            assert_eq!(before[key], after[key], "`{}` is frozen in frame {frame}", after.info(key).name);
        }
        let page = after.find(&page_name("poses", frame)).unwrap();
        assert_eq!(after.info(page).page, Some(frame));
        let last = before.find(&page_name("poses", frame - 1)).unwrap();
        assert_ne!(after[page].data(), before[last].data(), "the new page learnt");
    }
    assert!(t.is_done());
}
