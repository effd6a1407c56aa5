//! Densification as Markov chain Monte Carlo: dead Gaussians are moved onto live ones so that the picture stays the same,
//! the cloud grows by 5 % a time up to the cap, and positions are shaken while a Gaussian is nearly transparent.
//!
//! Where they go is drawn in space-time from opacity and screen gradient (FreeTimeGS): a row carries its life with it.
//! Source: Kheradmand et al. 2024 (3DGS as MCMC) §3; Wang et al. 2025 (FreeTimeGS) §3.3.

use super::{Change, Limits, Stats, apply, is_dead, logit, opacity};
use crate::optim::Moments;
use splat4d::layers::{Layer, Scene};
use splat4d::math::{Real, Rng, sym3};
use splat4d::motion::for_rows;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Born, GEOMETRY, RowEdit, Rows, Space};

/// More copies than this on one place are not told apart (as in gsplat).
const MAX_COPIES: usize = 51;
/// Opaque Gaussians get less than a ten-thousandth of the noise: not worth three normal numbers.
const LEAST_GATE: f64 = 1e-4;
/// Slope of the sigmoid that ends the noise above the dead opacity (Kheradmand et al. 2024).
const NOISE_SLOPE: f64 = 100.0;

/// The strategy's settings.
#[derive(Clone, Debug, PartialEq)]
pub struct Mcmc {
    /// Growth a densification.
    pub growth: f64,
    /// Share of the 2D gradient, against opacity, in where Gaussians go.
    pub gradient_share: f64,
    /// Strength of the position noise (times the rate of positions).
    pub noise_lr: f64,
}

/// Opacity and scale factor of each of `copies` Gaussians that together look like one of opacity `o`.
///
/// o' = 1 − (1−o)^{1/N}; s'/s = o / Σ_{i=1..N} Σ_{k=0..i−1} C(i−1,k) (−1)^k o'^{k+1} / √(k+1): along every line through
/// the centre the integrated alpha is the same.
pub fn relocated(o: f64, copies: usize) -> (f64, f64) {
    let n = copies.clamp(1, MAX_COPIES);
    let each = 1.0 - (1.0 - o).powf(1.0 / n as f64);
    // Σ_i C(i−1,k) over i = k+1..N is C(N,k+1): one sum instead of two.
    let mut sum = 0.0;
    let mut term = 1.0; // C(N, k+1)·o'^{k+1}, built up factor by factor
    for k in 0..n {
        term *= each * (n - k) as f64 / (k + 1) as f64;
        let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
        sum += sign * term / ((k + 1) as f64).sqrt();
    }
    (each, o / sum)
}

impl Mcmc {
    pub(super) fn run(
        &self,
        scene: &mut Scene<f32>,
        moments: &mut [Moments<f32>],
        stats: &mut Stats,
        limits: &Limits,
        layer: usize,
        spare: &mut usize,
        rng: Rng,
    ) -> Change {
        let rows = scene.layers[layer].params.len();
        let spans = scene.layers[layer].spans();
        let dead: Vec<bool> = (0..rows).map(|r| is_dead(scene, layer, r, limits.min_opacity, spans[r])).collect();
        let live: Vec<usize> = (0..rows).filter(|&r| !dead[r]).collect();
        if live.is_empty() {
            return Change::default();
        }
        let grown = ((rows as f64 * self.growth).ceil() as usize).saturating_sub(rows);
        let added = grown.min(*spare);
        *spare -= added;
        let places = Places::new(scene, stats, layer, live, self.gradient_share);
        let moves: Vec<u32> = (0..rows as u32).filter(|&r| dead[r as usize]).collect();
        join(scene, moments, stats, layer, limits, &places, &moves, added, rng);
        Change { added, moved: moves.len(), removed: 0 }
    }
}

/// Where Gaussians go: rows drawn in proportion to share·gradient + (1 − share)·opacity, each over its mean.
pub(super) struct Places {
    live: Vec<usize>,
    cumulative: Vec<f64>,
}

impl Places {
    /// The `live` rows of a layer; where nothing was seen to have a gradient, opacity alone counts.
    pub(super) fn new(scene: &Scene<f32>, stats: &Stats, layer: usize, live: Vec<usize>, share: f64) -> Self {
        let mean = |f: &dyn Fn(usize) -> f64| (live.iter().map(|&r| f(r)).sum::<f64>() / live.len() as f64).max(1e-30);
        let gradient = |r: usize| f64::from(stats.gradient(layer, r));
        let opaque = |r: usize| opacity(scene, layer, r);
        let (mean_gradient, mean_opacity) = (mean(&gradient), mean(&opaque));
        let share = if mean_gradient > 1e-29 { share } else { 0.0 };
        let mut total = 0.0;
        let cumulative = live
            .iter()
            .map(|&r| {
                total += share * gradient(r) / mean_gradient + (1.0 - share) * opaque(r) / mean_opacity;
                total
            })
            .collect();
        Self { live, cumulative }
    }

    /// The i-th draw.
    fn draw(&self, rng: Rng, i: u64) -> usize {
        let u = rng.uniform(i) * self.cumulative.last().expect("somebody is alive");
        self.live[self.cumulative.partition_point(|&c| c <= u).min(self.live.len() - 1)]
    }
}

/// Moves the rows `moves` (increasing) onto drawn places and adds `added` more there; whoever shares a place then looks,
/// with the others, as its one Gaussian did: [`relocated`].
pub(super) fn join(
    scene: &mut Scene<f32>,
    moments: &mut [Moments<f32>],
    stats: &mut Stats,
    layer: usize,
    limits: &Limits,
    places: &Places,
    moves: &[u32],
    added: usize,
    rng: Rng,
) {
    let rows = scene.layers[layer].params.len();
    let mut copies = vec![1usize; rows];
    let mut draws = 0;
    let mut next = |copies: &mut Vec<usize>| {
        let r = places.draw(rng.fork(1), draws);
        draws += 1;
        copies[r] += 1;
        r as u32
    };
    let mut edit = RowEdit::identity(Space::Gaussians, rows);
    for &r in moves {
        edit.parent[r as usize] = next(&mut copies);
        edit.born[r as usize] = Born::Moved;
    }
    for _ in 0..added {
        edit.push(next(&mut copies), Born::Clone);
    }
    // The one that is joined changes as well: its moments start anew.
    for j in 0..rows {
        if copies[edit.parent[j] as usize] > 1 && edit.born[j] == Born::Kept {
            edit.born[j] = Born::Moved;
        }
    }
    let old: Vec<f64> = (0..rows).map(|r| opacity(scene, layer, r)).collect();
    apply(scene, moments, stats, layer, &edit, &rng);
    let layer = &mut scene.layers[layer];
    for (j, &parent) in edit.parent.iter().enumerate() {
        let n = copies[parent as usize];
        if n > 1 {
            let (o, factor) = relocated(old[parent as usize], n);
            // Never below the dead opacity, or it would be moved again at once.
            layer.params[GEOMETRY].set(j, OPACITY, logit(o.max(limits.min_opacity * 1.001)));
            layer.resize(j, factor);
        }
    }
}

/// Shakes the means of the active rows: Σ·ε·σ(−100(o − o_dead))·`strength`, ε ~ N(0, I).
pub fn add_noise(layer: &mut Layer<f32>, active: &[bool], strength: f64, min_opacity: f64, rng: Rng) {
    if strength == 0.0 {
        return;
    }
    let [geometry] = layer.params.get_mut([GEOMETRY]);
    // The opacity, and its logit, from which the gate is below the least one: most Gaussians are told by one number.
    let opaque = min_opacity + (1.0 / LEAST_GATE - 1.0).ln() / NOISE_SLOPE;
    let limit = if opaque < 1.0 { (opaque / (1.0 - opaque)).ln() as f32 } else { f32::INFINITY };
    for_rows([geometry], Rows::All, |_, row, [geometry]| {
        if !active[row] || geometry.read::<1>(row, OPACITY)[0] > limit {
            return 0.0;
        }
        let g = geometry.read::<11>(row, 0);
        let gate = (-NOISE_SLOPE * (f64::from(g[OPACITY]).sigmoid() - min_opacity)).sigmoid();
        let c = sym3::from_quat_log_scales(
            [g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]],
            [g[LOG_SCALE], g[LOG_SCALE + 1], g[LOG_SCALE + 2]],
        )
        .map(f64::from);
        let e: [f64; 3] = std::array::from_fn(|k| rng.fork(row as u64).normal(k as u64) * gate * strength);
        let shift = [
            c[0] * e[0] + c[1] * e[1] + c[2] * e[2],
            c[1] * e[0] + c[3] * e[1] + c[4] * e[2],
            c[2] * e[0] + c[4] * e[1] + c[5] * e[2],
        ];
        geometry.add(row, 0, shift.map(|x| x as f32));
        0.0
    });
}

#[cfg(test)]
mod tests {
    use super::super::tests::scene;
    use super::*;
    use crate::densify::Densify;

    #[test]
    fn one_copy_is_the_identity_and_copies_keep_center_alpha_and_line_integral() {
        let (o, s) = relocated(0.7, 1);
        assert!((o - 0.7).abs() < 1e-12 && (s - 1.0).abs() < 1e-12);
        for n in [2usize, 3, 5] {
            let (o, s) = relocated(0.7, n);
            assert!((1.0 - (1.0 - o).powi(n as i32) - 0.7).abs() < 1e-12);
            let h = 1e-3;
            let integral = |f: &dyn Fn(f64) -> f64| (-20_000..=20_000).map(|i| f(f64::from(i) * h) * h).sum::<f64>();
            let one = integral(&|x| 0.7 * (-0.5 * x * x).exp());
            let many = integral(&|x| 1.0 - (1.0 - o * (-0.5 * x * x / (s * s)).exp()).powi(n as i32));
            assert!((one - many).abs() < 1e-6, "{n}: {one} {many}");
        }
    }

    #[test]
    fn the_dead_move_counts_are_conserved_and_the_cap_holds() {
        let mut s = scene(100);
        (0..10).for_each(|r| s.layers[0].params[GEOMETRY].set(r, OPACITY, -9.0));
        let mut moments: Vec<_> = s.layers.iter().map(|l| Moments::new(&l.params)).collect();
        let mut stats = Stats::new(&s);
        let mcmc = Densify::Mcmc(Mcmc { growth: 1.05, gradient_share: 0.5, noise_lr: 5e5 });
        let limits = Limits { cap: 103, extent: 1.0, min_opacity: 0.005 };
        let change = mcmc.run(&mut s, &mut moments, &mut stats, &limits, 7, 0);
        assert_eq!((change.added, change.moved, s.len()), (3, 10, 103));
        assert_eq!(moments[0].table(GEOMETRY).rows(), 103);
        assert!((0..103).all(|r| opacity(&s, 0, r) > 0.005));
        let again = mcmc.run(&mut s, &mut moments, &mut stats, &limits, 7, 1);
        assert_eq!(again, Change::default());
    }

    #[test]
    fn noise_spares_the_opaque_and_the_resting() {
        let mut s = scene(20);
        (0..20).for_each(|r| s.layers[0].params[GEOMETRY].set(r, OPACITY, if r < 10 { -5.5 } else { 2.0 }));
        let before = s.layers[0].params[GEOMETRY].clone();
        let active: Vec<bool> = (0..20).map(|r| r % 2 == 0).collect();
        add_noise(&mut s.layers[0], &active, 1.0, 0.005, Rng::new(0, "noise", 0));
        for r in 0..20 {
            let moved = s.layers[0].params[GEOMETRY].get(r, 0) != before.get(r, 0);
            assert_eq!(moved, r < 10 && r % 2 == 0, "row {r}");
        }
    }
}
