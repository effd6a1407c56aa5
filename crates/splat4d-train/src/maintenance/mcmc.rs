//! Densification as Markov chain Monte Carlo: dead Gaussians are moved onto live ones so that the image stays the same,
//! the cloud grows by 5 % a time up to the cap, and positions get noise while a Gaussian is nearly transparent.
//!
//! Their targets are drawn in space-time from opacity and screen gradient (FreeTimeGS): a row carries its lifespan with
//! it.
//! Source: Kheradmand et al. 2024 (3DGS as MCMC) §3; Wang et al. 2025 (FreeTimeGS) §3.3.

use super::{
    At, Change, Context, DensifySettings, Every, Limits, Maintenance, RunOrder, Strategy, grow, is_dead, logit, opacity,
};
use crate::Result;
use crate::settings::settings;
use crate::train_state::TrainState;
use splat4d::math::Rng;
use splat4d::scene::params::OPACITY;
use splat4d::scene::{Born, GEOMETRY, RowEdit, Space};

/// More copies than this at one position are not distinguished (as in gsplat).
const MAX_COPIES: usize = 51;

settings! {
    /// Settings of MCMC (Kheradmand et al. 2024).
    #[derive(Copy)]
    pub struct McmcSettings
    when (Is("densify.strategy", &["mcmc"])) {
        /// Growth per densification, up to the cap.
        growth: f64 = 1.05 => positive();
        /// Strength of the position noise, for an extent of 4.4 scene units; inversely proportional to its square.
        noise_lr: f64 = 5e5;
        /// Weight of the mean opacity.
        opacity_reg: f64 = 0.01;
        /// Weight of the mean scale, for an extent of 4.4 scene units; inversely proportional to it.
        scale_reg: f64 = 0.01;
    }
}

/// Markov chain Monte Carlo (Kheradmand et al. 2024), relocation in space-time. Its noise on positions is part of the
/// step: [`Noise`](crate::optim::Noise).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mcmc {
    /// How.
    pub settings: McmcSettings,
    /// Share of the 2D gradient, against opacity, in the choice of targets.
    pub gradient_share: f64,
    /// When.
    pub steps: Every,
}

impl Mcmc {
    /// With these settings; `None`: another strategy.
    pub(crate) fn of(settings: McmcSettings, gradient_share: f64, densify: &DensifySettings) -> Option<Self> {
        let some = || Self { settings, gradient_share, steps: densify.steps() };
        (densify.strategy == Strategy::Mcmc).then(some)
    }
}

impl Maintenance for Mcmc {
    fn name(&self) -> &str {
        "mcmc"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Grow
    }

    fn due(&self, at: &At) -> bool {
        self.steps.is_due(at.step)
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let this = *self;
        Ok(grow(train_state, c, |train_state, layer, spare, rng| this.layer(train_state, &c.limits, layer, spare, rng)))
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.steps)
    }

    fn grown(&self, at: &At, count: f64, cap: f64) -> f64 {
        if self.due(at) { (count * self.settings.growth).min(cap) } else { count }
    }
}

/// Opacity and scale factor of each of `copies` Gaussians that together render like one of opacity `o`.
///
/// o' = 1 − (1−o)^{1/N}; s'/s = o / Σ_{i=1..N} Σ_{k=0..i−1} C(i−1,k) (−1)^k o'^{k+1} / √(k+1): along every line through
/// the centre the integrated alpha is the same.
pub(crate) fn relocated(o: f64, copies: usize) -> (f64, f64) {
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
    fn layer(
        &self,
        train_state: &mut TrainState,
        limits: &Limits,
        layer: usize,
        spare: &mut usize,
        rng: Rng,
    ) -> Change {
        let scene = train_state.scene();
        let rows = scene.layers[layer].params.len();
        let spans = scene.layers[layer].spans();
        let dead: Vec<bool> = (0..rows).map(|r| is_dead(scene, layer, r, limits.min_opacity, spans[r])).collect();
        let live: Vec<usize> = (0..rows).filter(|&r| !dead[r]).collect();
        if live.is_empty() {
            return Change::default();
        }
        let grown = ((rows as f64 * self.settings.growth).ceil() as usize).saturating_sub(rows);
        let added = grown.min(*spare);
        *spare -= added;
        let places = Places::new(train_state, layer, live, self.gradient_share);
        let moves: Vec<u32> = (0..rows as u32).filter(|&r| dead[r as usize]).collect();
        join(train_state, limits, &places, &moves, added, rng);
        Change { added, moved: moves.len(), removed: 0 }
    }
}

/// Targets of Gaussians: rows drawn in proportion to share·gradient + (1 − share)·opacity, each over its mean.
pub(super) struct Places {
    layer: usize,
    live: Vec<usize>,
    cumulative: Vec<f64>,
}

impl Places {
    /// The `live` rows of a layer; where no gradient was recorded, only opacity counts.
    pub(super) fn new(train_state: &TrainState, layer: usize, live: Vec<usize>, share: f64) -> Self {
        let mean = |f: &dyn Fn(usize) -> f64| (live.iter().map(|&r| f(r)).sum::<f64>() / live.len() as f64).max(1e-30);
        let gradient = |r: usize| f64::from(train_state.stats().gradient(layer, r));
        let opaque = |r: usize| opacity(train_state.scene(), layer, r);
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
        Self { layer, live, cumulative }
    }

    /// The i-th sample.
    fn draw(&self, rng: Rng, i: u64) -> usize {
        let u = rng.uniform(i) * self.cumulative.last().expect("a live row is there to be drawn");
        self.live[self.cumulative.partition_point(|&c| c <= u).min(self.live.len() - 1)]
    }
}

/// Moves the rows `moves` (increasing) onto sampled positions of the same layer and adds `added` more there; those that
/// share a position then render together as the one Gaussian before: [`relocated`].
pub(super) fn join(
    train_state: &mut TrainState,
    limits: &Limits,
    places: &Places,
    moves: &[u32],
    added: usize,
    rng: Rng,
) {
    let (scene, layer) = (train_state.scene(), places.layer);
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
    // The one that is joined changes as well: its moments start again.
    for j in 0..rows {
        if copies[edit.parent[j] as usize] > 1 && edit.born[j] == Born::Kept {
            edit.born[j] = Born::Moved;
        }
    }
    let old: Vec<f64> = (0..rows).map(|r| opacity(scene, layer, r)).collect();
    train_state.apply(layer, &edit, &rng);
    let layer = &mut train_state.scene_mut().layers[layer];
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

#[cfg(test)]
mod tests {
    use super::super::tests::{context, scene};
    use super::*;

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
    fn dead_gaussians_are_relocated_and_the_count_stays_under_the_cap() {
        let mut s = scene(100);
        (0..10).for_each(|r| s.layers[0].params[GEOMETRY].set(r, OPACITY, -9.0));
        let mut train_state = TrainState::new(s);
        let mut mcmc = Mcmc { settings: McmcSettings::default(), gradient_share: 0.5, steps: Every::NEVER };
        let limits = Limits { cap: 103, extent: 1.0, min_opacity: 0.005 };
        let change = mcmc.run(&mut train_state, &context(limits, 7, 0)).unwrap();
        assert_eq!((change.added, change.moved, train_state.scene().len()), (3, 10, 103));
        assert_eq!(train_state.moments()[0].table(GEOMETRY).rows(), 103);
        assert!((0..103).all(|r| opacity(train_state.scene(), 0, r) > 0.005));
        let again = mcmc.run(&mut train_state, &context(limits, 7, 1)).unwrap();
        assert_eq!(again, Change::default());
    }
}
