//! Periodic relocation, next to any strategy: the faintest Gaussians are moved to positions with large image gradients,
//! a few at a time, also after densification has ended.
//!
//! Source: Wang et al. 2025 (FreeTimeGS) §3.3: every 100 steps, below a threshold of opacity, to positions drawn from ½
//! gradient and ½ opacity; the correction of opacity and scale is that of 3DGS as MCMC (Kheradmand et al. 2024).

use super::mcmc::{Places, join};
use super::{At, Change, Context, DensifySettings, Every, Maintenance, RunOrder, is_dead, opacity};
use crate::Result;
use crate::settings::settings;
use crate::train_state::TrainState;

settings! {
    /// Settings of the relocation of the faintest Gaussians, with any strategy.
    #[derive(Copy)]
    pub struct RelocateSettings
    when (On("relocate.interval")) {
        /// Iterations between relocations of the faintest Gaussians (FreeTimeGS uses 100), with any strategy; 0: never.
        interval: usize = 0 => any().unit("iterations").switch();
        /// First iteration that relocates; 0: iterations/15.
        from: usize = 0 => any().unit("iterations");
        /// Opacity below which a Gaussian is relocated.
        threshold: f64 = 0.02 => share();
        /// Largest share of the Gaussians relocated at once.
        share: f64 = 0.015 => share();
        /// Weight of the 2D gradient (against opacity) in the choice of targets (FreeTimeGS).
        gradient_share: f64 = 0.5
            => share().switch().when(Any(&[On("relocate.interval"), Is("densify.strategy", &["mcmc"])]));
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Relocate {
    /// How, and when.
    pub settings: RelocateSettings,
    /// When statistics begin again with densification; from its last time on they do so here.
    pub densification: Every,
}

impl Relocate {
    /// With these settings; `None`: never.
    pub(crate) fn of(settings: RelocateSettings, densify: &DensifySettings) -> Option<Self> {
        let some = || Self { settings, densification: densify.steps() };
        (settings.interval > 0).then(some)
    }
}

impl Maintenance for Relocate {
    fn name(&self) -> &str {
        "relocate"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Place
    }

    /// Not in the last interval: what moved then would learn nothing any more.
    fn due(&self, at: &At) -> bool {
        let s = &self.settings;
        at.step >= s.from && at.step.is_multiple_of(s.interval) && at.steps.saturating_sub(at.step) >= s.interval
    }

    /// Moves rows of every layer; their number stays.
    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let settings = &self.settings;
        let mut moved = 0;
        for layer in train_state.learning() {
            let scene = train_state.scene();
            let rows = scene.layers[layer].params.len();
            let spans = scene.layers[layer].spans();
            let faint = |r: usize| is_dead(scene, layer, r, settings.threshold, spans[r]);
            let (mut moves, live): (Vec<usize>, Vec<usize>) = (0..rows).partition(|&r| faint(r));
            if live.is_empty() {
                continue;
            }
            // The faintest first; equal ones in their order.
            moves.sort_by(|&a, &b| opacity(scene, layer, a).total_cmp(&opacity(scene, layer, b)).then(a.cmp(&b)));
            moves.truncate((rows as f64 * settings.share) as usize);
            moves.sort_unstable();
            let moves: Vec<u32> = moves.into_iter().map(|r| r as u32).collect();
            if moves.is_empty() {
                continue;
            }
            moved += moves.len();
            let places = Places::new(train_state, layer, live, settings.gradient_share);
            join(train_state, &c.limits, &places, &moves, 0, c.rng("relocate").fork(layer as u64));
        }
        if self.densification.interval == 0 || c.at.step >= self.densification.last {
            train_state.clear_stats();
        }
        Ok(Change { added: 0, moved, removed: 0 })
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.densification)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, due_steps, scene};
    use super::*;
    use splat4d::layers::{Evaluation, Scene};
    use splat4d::math::Se3;
    use splat4d::render::{Image, RenderConfig, Renderer, Shot};
    use splat4d::scene::params::{LOG_SCALE, OPACITY};
    use splat4d::scene::{Camera, GEOMETRY, Time};

    const RELOCATE: Relocate = Relocate {
        settings: RelocateSettings { from: 10, interval: 5, threshold: 0.02, share: 0.1, gradient_share: 0.5 },
        densification: Every::NEVER,
    };

    fn picture(s: &Scene<f32>) -> Vec<f32> {
        let pose = Se3::look_at([0.0, 0.5, -6.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.8, 64, 64);
        let (mut instant, mut image) = (Evaluation::default(), Image::default());
        s.at(Time(0.5), &mut instant);
        Renderer::new(RenderConfig::default()).render(&Shot::new(&s.splats(&instant), &camera, [0.1; 3]), &mut image);
        image.color.data
    }

    #[test]
    fn the_faintest_move_a_few_at_a_time_and_the_image_stays() {
        let mut s = scene(200);
        let g = &mut s.layers[0].params[GEOMETRY];
        for r in 0..200 {
            g.write(r, LOG_SCALE, [-1.5f32; 3]);
            // Relocated ones are fainter than what is rendered, so that only their arrival could be visible.
            g.set(r, OPACITY, if r < 30 { -6.0 - 0.1 * r as f32 } else { -1.0 });
        }
        let before = picture(&s);
        let mut train_state = TrainState::new(s);
        // Row 150 alone has a gradient: half of all samples are its.
        train_state.stats_mut().tables[0].write(150, 0, [1.0, 1.0, 3.0]);
        let limits = Limits { cap: 300, extent: 4.0, min_opacity: 0.005 };
        let mut relocate = RELOCATE;
        let change = relocate.run(&mut train_state, &context(limits, 1, 7)).unwrap();
        let s = train_state.into_scene();
        assert_eq!((change, s.len()), (Change { added: 0, moved: 20, removed: 0 }, 200));
        let opaque = |r: usize| opacity(&s, 0, r);
        assert!((0..10).all(|r| opaque(r) < 0.02), "the less faint stay");
        assert!((10..30).all(|r| opaque(r) > 0.01));
        let at = |r: usize| s.layers[0].params[GEOMETRY].get(r, 0);
        let drawn = (10..30).filter(|&r| at(r) == at(150)).count();
        assert!((5..=15).contains(&drawn), "{drawn} of 20 followed the gradient");
        let after = picture(&s);
        let mut sorted: Vec<f32> = before.iter().zip(&after).map(|(a, b)| (a - b).abs()).collect();
        sorted.sort_by(f32::total_cmp);
        assert!(before.iter().filter(|x| (**x - 0.1).abs() > 0.05).count() > 500, "the test must look at something");
        let mean = sorted.iter().sum::<f32>() / sorted.len() as f32;
        assert!(mean < 1.0 / 255.0, "mean change {mean}");
    }

    #[test]
    fn it_is_due_at_its_interval_but_not_at_the_end() {
        assert_eq!(due_steps(&RELOCATE, 30), [10, 15, 20, 25]);
    }
}
