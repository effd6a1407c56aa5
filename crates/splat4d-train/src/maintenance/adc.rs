//! Adaptive density control: clone small and split large Gaussians whose screen position still needs to move; prune the
//! transparent. Source: Kerbl et al. 2023 §5.2 and appendix B; the clone's opacity as revised by Bulò 2024.
//!
//! Gaussians with a lifespan and a path of their own that leave their own place within that life are split in time
//! instead: the two halves follow the same path one after the other. Rotation and acceleration need shorter lifespans,
//! which parts next to each other do not bring. So are those whose loss changes much if their lifespan shifts by its width:
//! some of their times need them and others need them gone, as where an object appears or vanishes, and only shorter
//! lifespans do both. Gaussians of four dimensions (Yang et al. 2024) split in time as well: at random, and by a threshold of
//! their gradient in time.
//!
//! The original also removes Gaussians larger than a tenth of the extent. The extent is the spread of the cameras, and
//! a wall before a forward-facing rig needs larger ones: removal cost 1.3 dB in a kitchen, 0.3 to 1.6 dB on four other
//! captures and nothing on an object (docs/suite.md).

use super::{
    At, Change, Context, DensifySettings, Every, Limits, Maintenance, RunOrder, Strategy, covariances, grow, is_dead,
    logit, opacity, sample,
};
use crate::Result;
use crate::settings::settings;
use crate::train_state::TrainState;
use rayon::prelude::*;
use splat4d::layers::{Layer, Scene};
use splat4d::math::{Rng, sym3};
use splat4d::scene::life::{CENTER, LOG_WIDTH};
use splat4d::scene::params::OPACITY;
use splat4d::scene::{Born, GEOMETRY, LIFE, LifeKind, RowEdit, Space, Table};

/// A split's parts are this much smaller than their parent, in space or in time.
const SPLIT_SHRINK: f64 = 1.6;
/// How far from the centre of the parent's life those of a split in time begin, in widths of the parent's: with
/// [`SPLIT_SHRINK`] mean and variance of the two lifespans together are the parent's, √(1 − 1/1.6²).
const TIME_SHIFT: f64 = 0.78;
/// Address of the random numbers of [`retime`]; those of splits are addressed by row.
const RETIME: u64 = u64::MAX;

/// About how much a densification by gradients adds on real captures, until the cap.
const GROWTH: f64 = 1.2;

settings! {
    /// Settings of adaptive density control (Kerbl et al. 2023).
    #[derive(Copy)]
    pub struct AdcSettings
    when (Is("densify.strategy", &["adc"])) {
        /// Whether the centre of a clone's lifespan is resampled from the clip (STG).
        retime_clones: bool = false;
        /// Mean 2D gradient above which a Gaussian is cloned or split (NDC units).
        grad_threshold: f64 = 2e-4;
        /// Gaussians larger than this share of the extent are split, smaller ones cloned; 0: 0.01, and less in
        /// proportion for static scenes of more than 30,000 Gaussians.
        percent_dense: f64 = 0.0 => any().unit("extents");
        /// Share of densification after which the cap may be reached: the number of Gaussians grows along a parabola
        /// (Mallick et al. 2024), largest gradients first; 0: no limit before the cap.
        full_at: f64 = 0.5 => share();
        /// A Gaussian that moves further than this within its lifespan is split in time; 0: never.
        split_in_time: f64 = 1.0 => any().unit("own sizes");
        /// Change of the loss (root mean square over views) if a lifespan shifts by its width, above which a Gaussian is
        /// split in time; 0: never.
        life_threshold: f64 = LIFE_THRESHOLD;
    }
}

/// At this threshold nearly half of what was left of a vanished object is gone and scores stay; at 7e-5 a hall lost 0.2 dB
/// (studies/records/2026-11-28-lifespans.md).
const LIFE_THRESHOLD: f64 = 1e-4;

/// [`AdcSettings::percent_dense`] where it is 0, for few Gaussians (Kerbl et al. 2023).
pub(crate) const DENSE: f64 = 0.01;
/// The lowest that it becomes with many (Ren et al. 2026, FastGS). More Gaussians are smaller, and one that is large
/// among them blurs what a copy in its place blurs as well (studies/records/2026-11-27-real-size.md).
pub(crate) const FINEST: f64 = 1e-3;

/// Adaptive density control (Kerbl et al. 2023).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Adc {
    /// How.
    pub settings: AdcSettings,
    /// When.
    pub steps: Every,
}

impl Maintenance for Adc {
    fn name(&self) -> &str {
        "adc"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Grow
    }

    fn due(&self, at: &At) -> bool {
        self.steps.is_due(at.step)
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let settings = self.settings;
        let share = self.share(&c.at);
        Ok(grow(train_state, c, |train_state, layer, spare, rng| {
            settings.layer(train_state, &c.limits, layer, (spare, share), rng)
        }))
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.steps)
    }

    fn grown(&self, at: &At, count: f64, cap: f64) -> f64 {
        if self.due(at) { (count * GROWTH).min(count + (cap - count).max(0.0) * self.share(at)) } else { count }
    }
}

impl Adc {
    /// The share of the free number below the cap that may be used now: of the initial one a share (1 − x)² is left
    /// when the share x of the time until the cap has passed.
    fn share(&self, at: &At) -> f64 {
        let Every { first, last, interval } = self.steps;
        if last == usize::MAX {
            return 1.0; // Without an end there is no schedule.
        }
        let full = first as f64 + last.saturating_sub(first) as f64 * self.settings.full_at;
        let left = ((full - at.step as f64) / interval as f64).max(0.0) + 1.0;
        1.0 - ((left - 1.0) / left).powi(2)
    }

    /// With these settings; `None`: another strategy.
    pub(crate) fn of(settings: AdcSettings, densify: &DensifySettings) -> Option<Self> {
        let some = || Self { settings, steps: densify.steps() };
        (densify.strategy == Strategy::Adc).then(some)
    }
}

impl AdcSettings {
    /// Width of a row's lifespan, seconds, at most half the clip; none: it cannot be split in time.
    fn width(scene: &Scene<f32>, layer: usize, row: usize) -> Option<f64> {
        let Layer { motion, params, life, .. } = &scene.layers[layer];
        motion.polynomial().filter(|_| *life != LifeKind::Infinite)?;
        // A lifespan that is longer than the clip counts as the clip.
        let clip = 0.5 * (scene.clip[1] - scene.clip[0]);
        Some(f64::from(params[LIFE].get(row, LOG_WIDTH)).exp().min(clip))
    }

    /// Whether a row leaves its own place within its life.
    fn leaves(&self, scene: &Scene<f32>, layer: usize, row: usize, size: f64, width: f64) -> bool {
        let Layer { motion, params, .. } = &scene.layers[layer];
        let path = motion.polynomial().expect("a row with a width has a path");
        let goes = path.travel(params, row, width).iter().map(|x| x * x).sum::<f64>().sqrt();
        self.split_in_time > 0.0 && goes > self.split_in_time * size
    }

    fn layer(
        &self,
        train_state: &mut TrainState,
        limits: &Limits,
        layer: usize,
        (spare, share): (&mut usize, f64),
        rng: Rng,
    ) -> Change {
        let (scene, stats) = (train_state.scene(), train_state.stats());
        let rows = scene.layers[layer].params.len();
        let covs = covariances(scene, layer);
        let spans = scene.layers[layer].spans();
        let sizes: Vec<f64> = covs.par_iter().map(|&c| sym3::largest(c).max(0.0).sqrt()).collect();
        let keep: Vec<bool> = (0..rows).map(|r| !is_dead(scene, layer, r, limits.min_opacity, spans[r])).collect();
        let removed = keep.iter().filter(|k| !**k).count();
        *spare += removed;
        let moments = &train_state.moments()[layer];
        // Shares of the two thresholds that a row reaches.
        let needs: Vec<[f64; 2]> = (0..rows)
            .map(|r| {
                let gradient = f64::from(stats.gradient(layer, r));
                let own = if gradient >= self.grad_threshold { (gradient / self.grad_threshold).max(1.0) } else { 0.0 };
                let width = Self::width(scene, layer, r).filter(|_| self.life_threshold > 0.0);
                [own, width.map_or(0.0, |width| width * moments.rms(LIFE, r, CENTER) / self.life_threshold)]
            })
            .collect();
        // Those that need it most come first when the cap leaves no room for all.
        let mut wanting: Vec<(f64, u32)> = (0..rows)
            .map(|r| (needs[r][0].max(needs[r][1]), r as u32))
            .filter(|&(need, r)| keep[r as usize] && need >= 1.0)
            .collect();
        wanting.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        wanting.truncate((*spare as f64 * share).ceil() as usize);
        *spare -= wanting.len();
        let mut grows = vec![false; rows];
        wanting.iter().for_each(|&(_, r)| grows[r as usize] = true);
        // How far from the centre of a row's lifespan those of its halves lie, seconds; 0: no split in time.
        let apart = |r: usize| {
            let width = Self::width(scene, layer, r).filter(|_| grows[r])?;
            let parted = needs[r][1] >= 1.0 || self.leaves(scene, layer, r, sizes[r], width);
            parted.then_some(TIME_SHIFT * width)
        };
        let parted: Vec<f64> = (0..rows).map(|r| apart(r).unwrap_or(0.0)).collect();
        let dense = if self.percent_dense == 0.0 { DENSE } else { self.percent_dense };
        let large = |r: usize| sizes[r] > dense * limits.extent;
        let splits: Vec<bool> = (0..rows).map(|r| grows[r] && (parted[r] > 0.0 || large(r))).collect();
        let mut edit = RowEdit { space: Space::Gaussians, parent: Vec::new(), born: Vec::new() };
        for r in (0..rows).filter(|&r| keep[r]) {
            edit.push(r as u32, if splits[r] { Born::Split } else { Born::Kept });
        }
        for r in (0..rows).filter(|&r| grows[r]) {
            edit.push(r as u32, if splits[r] { Born::Split } else { Born::Clone });
        }
        let old_opacity: Vec<f64> = edit.parent.iter().map(|&r| opacity(scene, layer, r as usize)).collect();
        train_state.apply(layer, &edit, &rng);
        let scene = train_state.scene_mut();
        let clip = scene.clip;
        let layer = &mut scene.layers[layer];
        if self.retime_clones {
            retime(&mut layer.params[LIFE], &edit, clip, rng.fork(RETIME));
        }
        let mut kept = vec![false; rows];
        for (j, (&parent, born)) in edit.parent.iter().zip(&edit.born).enumerate() {
            let r = parent as usize;
            if parted[r] > 0.0 {
                let later = std::mem::replace(&mut kept[r], true);
                shorten(layer, j, if later { parted[r] } else { -parted[r] }, clip);
            } else if *born == Born::Split {
                let offset = sample(covs[r], rng.fork(j as u64));
                layer.params[GEOMETRY].add(j, 0, offset.map(|x| x as f32));
                layer.resize(j, 1.0 / SPLIT_SHRINK);
            }
            if grows[r] && !splits[r] {
                // Two halves in one place are as opaque as the whole: 1 − √(1 − o) each. Parts of a split are smaller
                // and are next to each other; as faint as this they let training views fall by up to 2 dB
                // (docs/suite.md).
                layer.params[GEOMETRY].set(j, OPACITY, logit(1.0 - (1.0 - old_opacity[j]).sqrt()));
            }
        }
        Change { added: wanting.len(), moved: 0, removed }
    }
}

/// Makes a row one half of its lifespan: its centre `shift` seconds later, but within the clip, and shorter.
fn shorten(layer: &mut Layer<f32>, row: usize, shift: f64, [first, last]: [f64; 2]) {
    let path = layer.motion.polynomial().expect("a model with a reach has a path");
    let center = f64::from(layer.params[LIFE].get(row, CENTER));
    path.recentre(&mut layer.params, row, (center + shift).clamp(first, last) - center);
    layer.params[LIFE].set(row, LOG_WIDTH, (shift.abs() / TIME_SHIFT / SPLIT_SHRINK).ln() as f32);
}

/// Draws the centre of every clone's lifespan from the clip, uniformly.
fn retime(life: &mut Table, edit: &RowEdit, [first, last]: [f64; 2], rng: Rng) {
    if life.width() == 0 {
        return;
    }
    for (row, _) in edit.born.iter().enumerate().filter(|(_, b)| **b == Born::Clone) {
        life.set(row, CENTER, (first + (last - first) * rng.uniform(row as u64)) as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{context, scene};
    use super::*;
    use splat4d::layers::Evaluation;
    use splat4d::motion::{SpacetimeSpec, Spec, build};
    use splat4d::scene::{Rows, Time};

    /// Runs it on a scene whose rows `seen` have the gradient 0.5, 1, ….
    fn run(s: Scene<f32>, settings: AdcSettings, seen: std::ops::Range<usize>, limits: Limits) -> (Change, Scene<f32>) {
        let mut train_state = TrainState::new(s);
        for (k, row) in seen.enumerate() {
            train_state.stats_mut().tables[0].write(row, 0, [1.0 + k as f32, 2.0, 5.0]);
        }
        let mut adc = Adc { settings, steps: Every::NEVER };
        let change = adc.run(&mut train_state, &context(limits, 1, 0)).unwrap();
        (change, train_state.into_scene())
    }

    #[test]
    fn clones_the_small_splits_the_large_prunes_the_dead_under_the_cap() {
        let mut s = scene(20);
        {
            let g = &mut s.layers[0].params[GEOMETRY];
            (0..20).for_each(|r| g.write(r, 7, [-6.0f32; 3])); // small: clone
            g.write(1, 7, [-1.0f32; 3]); // large: split
            g.set(2, OPACITY, -9.0); // dead
        }
        let settings =
            AdcSettings { grad_threshold: 0.1, percent_dense: 0.05, retime_clones: false, ..AdcSettings::default() };
        let limits = Limits { cap: 100, extent: 4.0, min_opacity: 0.005 };
        let (change, all) = run(s.clone(), settings, 0..4, limits);
        assert_eq!((change.added, change.removed, all.len()), (3, 1, 22));
        let g = &all.layers[0].params[GEOMETRY];
        assert!((g.get(1, 7) - (-1.0 - 1.6f32.ln())).abs() < 1e-5, "the split parent shrinks");
        let [before, clone, half] =
            [s.layers[0].params[GEOMETRY].get(0, OPACITY), g.get(0, OPACITY), g.get(1, OPACITY)];
        assert!(clone < before && half == before, "clones share their opacity, halves keep it");
        let (change, capped) = run(s, settings, 0..4, Limits { cap: 21, ..limits });
        assert_eq!((change.added, capped.len()), (2, 21));
    }

    #[test]
    fn gaussians_that_move_beyond_their_size_are_split_in_time() {
        let mut s = scene(4);
        s.clip = [0.0, 4.0];
        let layer = &mut s.layers[0];
        let spec = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, ..SpacetimeSpec::default() });
        layer.motion = build(&spec, &mut layer.params).unwrap();
        layer.life = LifeKind::GaussHalf;
        layer.params[LIFE] = Table::new(LifeKind::GaussHalf.columns(), 4);
        let velocities = layer.params.find("velocities").unwrap();
        let size = (-2.0f32).exp();
        // Row 0 goes three times its size in a width of its lifespan and row 1 half of it; row 2 lives longer than the
        // clip; row 3 is fast, but no rule splits it.
        for (row, [life, way]) in [[0.5, 3.0], [0.5, 0.5], [50.0, 3.0], [0.5, 3.0]].into_iter().enumerate() {
            layer.params[LIFE].write(row, 0, [2.5, f32::ln(life)]);
            layer.params[velocities].write(row, 0, [way * size / life.min(2.0), 0.0, 0.0, 0.0, 0.01, 0.0]);
        }
        let settings = AdcSettings { grad_threshold: 0.1, percent_dense: 1.0, ..AdcSettings::default() };
        let limits = Limits { cap: 100, extent: 4.0, min_opacity: 0.005 };
        let (change, all) = run(s.clone(), settings, 0..3, limits);
        assert_eq!((change.added, all.len()), (3, 7));
        let life = |row| all.layers[0].params[LIFE].read::<2>(row, 0);
        let near = |[center, log_width]: [f32; 2], [c, w]: [f64; 2]| {
            assert!((f64::from(center) - c).abs() < 1e-5, "{center} is not {c}");
            assert!((f64::from(log_width).exp() - w).abs() < 1e-5 * w, "{} is not {w}", log_width.exp());
        };
        near(life(0), [2.5 - 0.39, 0.5 / 1.6]);
        near(life(4), [2.5 + 0.39, 0.5 / 1.6]);
        near(life(2), [2.5 - 1.56, 2.0 / 1.6]);
        near(life(6), [4.0, 2.0 / 1.6]); // not beyond the clip
        [1, 3, 5].into_iter().for_each(|row| near(life(row), [2.5, 0.5]));
        for t in [0.3, 2.2, 3.9] {
            let [before, after] = [&s, &all].map(|s| {
                let seen = Evaluation::of_layer(&s.layers[0], Space::Gaussians, Rows::All, Time(t));
                (0..s.len()).map(|r| seen.tape(0).out().read::<9>(r, 0)).collect::<Vec<_>>()
            });
            for (row, parent) in [(0, 0), (4, 0), (2, 2), (6, 2)] {
                let close = (0..9).all(|c| (after[row][c] - before[parent][c]).abs() < 1e-4);
                assert!(close, "row {row} at {t} leaves its parent's path: {:?} {:?}", after[row], before[parent]);
            }
        }
        let opacities = |s: &Scene<f32>, r: usize| s.layers[0].params[GEOMETRY].get(r, OPACITY);
        assert!(opacities(&all, 0) == opacities(&s, 0) && opacities(&all, 4) == opacities(&s, 0));
        let never = AdcSettings { split_in_time: 0.0, ..settings };
        let (_, all) = run(s, never, 0..3, limits);
        assert!((0..7).all(|r| all.layers[0].params[LIFE].get(r, CENTER) == 2.5), "0: nothing is split in time");
    }

    #[test]
    fn gaussians_that_some_times_need_and_others_do_not_are_split_in_time() {
        let mut s = scene(3);
        s.clip = [0.0, 4.0];
        let layer = &mut s.layers[0];
        layer.motion = build(&Spec::Spacetime(SpacetimeSpec::default()), &mut layer.params).unwrap();
        layer.life = LifeKind::GaussHalf;
        layer.params[LIFE] = Table::new(LifeKind::GaussHalf.columns(), 3);
        (0..3).for_each(|row| layer.params[LIFE].write(row, 0, [2.0, 0.5f32.ln()]));
        let splits = |settings: AdcSettings| {
            let mut train_state = TrainState::new(s.clone());
            // A shift by the width of half a second changes the loss by 2 and by half of the threshold; row 2 has learnt
            // nothing yet.
            for (row, rms) in [4e-4f32, 1e-4].into_iter().enumerate() {
                let moments = &mut train_state.tables_mut().1[0];
                moments.table_mut(LIFE).write(row, 0, [0.0, 0.0, rms * rms, 0.0, 1e4]);
            }
            let limits = Limits { cap: 100, extent: 4.0, min_opacity: 0.005 };
            let change = Adc { settings, steps: Every::NEVER }.run(&mut train_state, &context(limits, 1, 0)).unwrap();
            let life = train_state.scene().layers[0].params[LIFE].clone();
            (change.added, (0..life.rows()).map(|row| life.get(row, CENTER)).collect::<Vec<_>>())
        };
        let (added, centers) = splits(AdcSettings::default());
        assert_eq!(added, 1);
        assert!((centers[0] - 1.61).abs() < 1e-5 && (centers[3] - 2.39).abs() < 1e-5, "{centers:?}");
        assert_eq!(centers[1..3], [2.0; 2]);
        assert_eq!(splits(AdcSettings { life_threshold: 0.0, ..AdcSettings::default() }), (0, vec![2.0; 3]));
        let other = AdcSettings { grad_threshold: 0.0, life_threshold: 0.0, ..AdcSettings::default() };
        assert_eq!(splits(other).0, 3, "without a threshold in space all grow");
    }

    #[test]
    fn the_cloud_grows_along_a_parabola_to_its_cap() {
        let steps = Every { first: 100, last: 300, interval: 10 };
        let counts = |full_at: f64| {
            let adc = Adc { settings: AdcSettings { full_at, ..AdcSettings::default() }, steps };
            let mut count = 1000.0;
            (1..=300)
                .map(|step| {
                    let at = At { step, steps: 400 };
                    if adc.due(&at) {
                        count += (9000.0 - count) * adc.share(&at);
                    }
                    count
                })
                .collect::<Vec<f64>>()
        };
        let half = counts(0.5);
        assert_eq!((half[98], half[199], half[299]), (1000.0, 9000.0, 9000.0));
        // Eleven times until it is full, and (k/11)² of the room is left when k of them are to come.
        for k in 0..11 {
            let left = 9000.0 - half[199 - 10 * k];
            assert!(
                (left - 8000.0 * (k as f64 / 11.0).powi(2)).abs() < 1e-6,
                "{k} times before the cap {left} are left"
            );
        }
        assert_eq!(counts(0.0)[99], 9000.0, "at once");
        let adc = Adc { settings: AdcSettings::default(), steps: Every { last: usize::MAX, ..steps } };
        assert_eq!(adc.share(&At { step: 100, steps: 400 }), 1.0, "without an end there is no schedule");
        let adc = Adc { settings: AdcSettings::default(), steps };
        let at = |step| At { step, steps: 400 };
        assert_eq!(adc.grown(&at(105), 1000.0, 9000.0), 1000.0);
        assert!(adc.grown(&at(100), 1000.0, 1e9) == 1200.0, "gradients ask for a fifth more");
        assert!((adc.grown(&at(100), 8000.0, 9000.0) - 8173.6).abs() < 0.1);
        assert_eq!(adc.grown(&at(250), 8900.0, 9000.0), 9000.0);
    }

    #[test]
    fn a_share_of_the_free_count_goes_to_the_largest_gradients() {
        let mut train_state = TrainState::new(scene(20));
        (0..20).for_each(|row| train_state.stats_mut().tables[0].write(row, 0, [1.0 + row as f32, 2.0, 5.0]));
        let settings = AdcSettings { grad_threshold: 0.1, percent_dense: 1.0, ..AdcSettings::default() };
        let mut adc = Adc { settings, steps: Every { first: 1, last: 9, interval: 1 } };
        let limits = Limits { cap: 45, extent: 4.0, min_opacity: 0.005 };
        // The first of five: 1 − (4/5)² of the room for 25.
        let change = adc.run(&mut train_state, &context(limits, 1, 0)).unwrap();
        assert_eq!(change.added, 9);
        let s = train_state.into_scene();
        let opacity = |r: usize| s.layers[0].params[GEOMETRY].get(r, OPACITY);
        assert!((0..20).all(|r| (opacity(r) < 0.0) == (r >= 11)), "clones share what their parent had");
    }

    #[test]
    fn clones_are_born_anywhere_in_the_clip_and_no_other_row_moves_in_time() {
        let mut s = scene(400);
        s.clip = [2.0, 3.0];
        let layer = &mut s.layers[0];
        layer.life = LifeKind::GaussHalf;
        layer.params[LIFE] = Table::new(LifeKind::GaussHalf.columns(), 400);
        (0..400).for_each(|r| layer.params[LIFE].write(r, 0, [2.5, 0.0]));
        (0..400).for_each(|r| layer.params[GEOMETRY].write(r, 7, [-6.0f32; 3]));
        let settings =
            AdcSettings { grad_threshold: 0.1, percent_dense: 0.05, retime_clones: true, ..AdcSettings::default() };
        let (change, s) = run(s, settings, 0..400, Limits { cap: 800, extent: 4.0, min_opacity: 0.005 });
        assert_eq!(change.added, 400);
        let life = &s.layers[0].params[LIFE];
        assert!((0..400).all(|r| life.get(r, 0) == 2.5), "those that were there keep their time");
        let times: Vec<f32> = (400..800).map(|r| life.get(r, 0)).collect();
        assert!(times.iter().all(|t| (2.0..=3.0).contains(t)));
        for quarter in 0..4 {
            let from = 2.0 + 0.25 * quarter as f32;
            let count = times.iter().filter(|t| (from..from + 0.25).contains(*t)).count();
            assert!((60..140).contains(&count), "{count} of 400 in a quarter of the clip");
        }
    }
}
