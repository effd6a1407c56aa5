//! A model whose covariance is not a quaternion and scales: Σ = L Lᵀ + b bᵀ, a Cholesky factor and the half-distance of
//! two lobes. A split gives each part one lobe.

use super::*;
use splat4d::motion::{At, Cache, Tape};
use splat4d::scene::splats::{COV, SPLAT_OPACITY};
use splat4d::scene::{Born, RowEdit, SplatGrads};

/// Factor: columns log L00, L10, log L11, L20, L21, log L22; lobe: b 3.
#[derive(Clone, Copy)]
pub(super) struct Lobes {
    pub(super) factor: Key,
    pub(super) lobe: Key,
}

impl Lobes {
    pub(super) fn new<F: Real>(p: &mut Params<F>) -> Self {
        let rows = p.len();
        let start = |t: &mut Table<F>| {
            let (l, z) = (F::of(-1.7), F::ZERO);
            (0..rows).for_each(|r| t.write(r, 0, [l, z, l, z, z, l]));
        };
        let factor = p.entry("factor", Space::Gaussians, &[("factor", 6)], rows, start).unwrap();
        let lobe = p.entry("lobe", Space::Gaussians, &[("lobe", 3)], rows, |_| {}).unwrap();
        Self { factor, lobe }
    }
}

/// L, with its diagonal exponentiated.
fn lower<F: Real>(f: [F; 6]) -> [[F; 3]; 3] {
    let z = F::ZERO;
    [[f[0].exp(), z, z], [f[1], f[2].exp(), z], [f[3], f[4], f[5].exp()]]
}

impl<F: Real> Motion<F> for Lobes {
    fn spec(&self) -> Spec {
        Spec::Custom("lobes".into())
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, _: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        for j in 0..q.len() {
            let id = q.rows.id(j);
            let (l, b) = (lower(q.p[self.factor].read::<6>(id, 0)), q.p[self.lobe].read::<3>(id, 0));
            let cov = |r: usize, c: usize| (0..3).map(|k| l[r][k] * l[c][k]).sum::<F>() + b[r] * b[c];
            let [x, y, z] = q.p[GEOMETRY].read::<3>(id, 0);
            let o = q.p[GEOMETRY].get(id, OPACITY).sigmoid();
            let row = [x, y, z, cov(0, 0), cov(0, 1), cov(0, 2), cov(1, 1), cov(1, 2), cov(2, 2), o];
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
        let [d_geometry, d_factor, d_lobe] = d.of([GEOMETRY, self.factor, self.lobe]);
        for j in 0..q.len() {
            let id = q.rows.id(j);
            let g = d_out.out.read::<10>(j, 0);
            let (l, b) = (lower(q.p[self.factor].read::<6>(id, 0)), q.p[self.lobe].read::<3>(id, 0));
            let o = q.p[GEOMETRY].get(id, OPACITY).sigmoid();
            d_geometry.add(id, 0, [g[0], g[1], g[2]]);
            d_geometry.add(id, OPACITY, [g[SPLAT_OPACITY] * o * (F::ONE - o)]);
            // The six numbers are the upper triangle: twice the symmetric gradient is 2·diagonal, 1·off-diagonal.
            let c: [F; 6] = std::array::from_fn(|k| g[COV + k]);
            let twice = [[F::TWO * c[0], c[1], c[2]], [c[1], F::TWO * c[3], c[4]], [c[2], c[4], F::TWO * c[5]]];
            let by = |r: usize, k: usize| (0..3).map(|i| twice[r][i] * l[i][k]).sum::<F>();
            d_factor.add(
                id,
                0,
                [by(0, 0) * l[0][0], by(1, 0), by(1, 1) * l[1][1], by(2, 0), by(2, 1), by(2, 2) * l[2][2]],
            );
            d_lobe.add(id, 0, [0, 1, 2].map(|r| (0..3).map(|i| twice[r][i] * b[i]).sum::<F>()));
        }
        0.0
    }

    /// Two parts at μ ± b without a lobe have together the parent's mean and covariance.
    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, _: &Rng) {
        if edit.space != Space::Gaussians {
            return;
        }
        let mut seen = std::collections::BTreeSet::new();
        for (row, (&parent, _)) in
            edit.parent.iter().zip(&edit.born).enumerate().filter(|(_, (_, b))| **b == Born::Split)
        {
            let sign = if seen.insert(parent) { F::ONE } else { -F::ONE };
            let b = p[self.lobe].read::<3>(row, 0);
            p[GEOMETRY].add(row, 0, b.map(|x| sign * x));
            p[self.lobe].write(row, 0, [F::ZERO; 3]);
        }
    }

    fn resize(&self, p: &mut Params<F>, row: usize, factor: f64) {
        let [l00, l10, l11, l20, l21, l22] = p[self.factor].read::<6>(row, 0);
        let (f, log) = (F::of(factor), F::of(factor.ln()));
        p[self.factor].write(row, 0, [l00 + log, l10 * f, l11 + log, l20 * f, l21 * f, l22 + log]);
        let lobe = p[self.lobe].read::<3>(row, 0).map(|x| x * f);
        p[self.lobe].write(row, 0, lobe);
    }
}

pub(super) fn lobes_scene<F: Real>(rows: usize) -> (Scene<F>, Lobes) {
    let mut p = cloud::<F>(rows, LifeKind::Infinite, 11);
    let model = Lobes::new(&mut p);
    shake(&mut p, model.factor, 0.1, 1);
    shake(&mut p, model.lobe, 0.1, 2);
    (one_layer(p, Arc::new(model), LifeKind::Infinite), model)
}

/// Activated (mean 3, covariance 6) of every row.
fn shapes(scene: &Scene<f64>) -> Vec<[f64; 9]> {
    let layer = &scene.layers[0];
    let mut tape = splat4d::layers::LayerTape::default();
    tape.request(Space::Gaussians, splat4d::scene::Rows::All, Time(0.0));
    layer.at(&Cache::default(), &mut tape);
    (0..layer.params.len()).map(|r| tape.out().read::<9>(r, 0)).collect()
}

#[test]
fn gradients_of_a_factor_and_lobes() {
    let (scene, _) = lobes_scene(10);
    let reached = check_gradients(&scene, &shots(&[(0, 0.0), (1, 0.1)]), &Vec::new());
    assert_reached(&reached[0], &["geometry", "sh", "factor", "lobe"]);
}

#[test]
fn a_split_keeps_mean_and_covariance_of_the_pair() {
    let (mut scene, _) = lobes_scene::<f64>(5);
    let before = shapes(&scene)[2];
    let mut edit = RowEdit::identity(Space::Gaussians, 5);
    edit.born[2] = Born::Split;
    edit.push(2, Born::Split);
    scene.layers[0].edit(&edit, &Rng::new(0, "edit", 0));
    let after = shapes(&scene);
    let (a, b) = (after[2], after[5]);
    assert_ne!(a[..3], b[..3]);
    let pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
    for k in 0..3 {
        assert!((0.5 * (a[k] + b[k]) - before[k]).abs() < 1e-14);
    }
    for (i, (r, c)) in pairs.into_iter().enumerate() {
        let spread = |x: &[f64; 9]| x[3 + i] + (x[r] - before[r]) * (x[c] - before[c]);
        assert!((0.5 * (spread(&a) + spread(&b)) - before[3 + i]).abs() < 1e-14);
    }
}

#[test]
fn relocation_resizes_the_tables_of_the_model() {
    let (mut scene, _) = lobes_scene::<f64>(3);
    let before = shapes(&scene)[1];
    scene.layers[0].resize(1, 0.5);
    let after = shapes(&scene)[1];
    assert!((3..9).all(|k| (after[k] - 0.25 * before[k]).abs() < 1e-14));
    assert!((0..3).all(|k| after[k] == before[k]));
}

#[test]
fn lobes_learn_while_they_are_split_and_relocated() {
    let columns = [("means", 0.01), ("opacity_logits", 0.05), ("sh", 0.02), ("factor", 0.02), ("lobe", 0.01)];
    for (name, densify) in layers::STRATEGIES {
        let mut stage =
            Stage { batch: 4, sampler: Sampler::Frame(1), groups: groups(&columns), ..Stage::new("lobes", 30) };
        densify(&mut stage, crate::maintenance::Every { first: 5, last: 15, interval: 5 });
        let mut t = trainer(lobes_scene(60).0, vec![stage], 90);
        let losses = finish_stage(&mut t);
        assert_falls(&losses, 0.85, name);
        assert!(t.scene().len() > 60 && t.scene().len() <= 90, "{name}: {}", t.scene().len());
    }
}
