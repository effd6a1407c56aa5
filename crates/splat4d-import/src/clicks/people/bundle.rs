//! Adjustment of a rig to keypoints of people.

use super::pairs::SCALE;
use super::{Cameras, LEAST, Rig, Seen, Spot, USUAL};
use crate::sfm::adjust::{Bundle, Free, Priors, Settings, Sighting, View, adjust};
use crate::sfm::lens::off;
use splat4d::math::mat3;

/// Deviation of the logarithm of the focal length about that of most cameras ([`USUAL`]), of principal points (of
/// the larger side), and of k1. Errors of joints are the same for seconds: a principal point that is as free as for
/// clicks would follow them.
const FOCAL: f64 = 0.35;
const CENTER: f64 = 0.003;
const K1: f64 = 0.03;
/// Deviation of the logarithm of focal lengths in a rig of equal cameras, and in one of different cameras.
pub(super) const ALIKE: f64 = 0.006;
pub(super) const STRANGERS: f64 = 0.25;
/// Keypoints of a rig that must be before their cameras.
pub(super) const BEFORE: f64 = 0.6;
/// A step that gains less than this share of the loss is the last one.
const GAIN: f64 = 1e-6;
/// Evaluations of a trial.
const STEPS: usize = 15;

/// What is free in an adjustment.
#[derive(Clone, Copy)]
pub(super) struct How {
    pub steps: usize,
    pub focal: bool,
    pub center: bool,
    pub k1: bool,
    /// How alike focal lengths are.
    pub family: f64,
    /// Deviation of time offsets; none: they stay.
    pub clocks: Option<f64>,
}

impl How {
    pub(super) const TRIAL: Self =
        Self { steps: STEPS, focal: false, center: false, k1: false, family: ALIKE, clocks: None };
}

impl Cameras<'_> {
    /// Mean loss of all keypoints that are known, and their number.
    pub(super) fn loss(&self, rig: &Rig, spots: &[Spot]) -> Option<[f64; 2]> {
        let (mut sum, mut count) = (0.0, 0.0);
        for spot in spots {
            let Some(x) = spot.place else { continue };
            for (c, seen) in &spot.seen {
                let off = off(&rig.lenses[*c], rig.poses[*c].as_ref()?, x, seen.pixel);
                sum += (off / SCALE).powi(2).min(1e6).ln_1p();
                count += 1.0;
            }
        }
        (count > 0.0).then(|| [sum / count, count])
    }

    /// Finds where keypoints are; those behind a camera stay open.
    pub(super) fn triangulate(&self, rig: &Rig, spots: &mut [Spot]) {
        for spot in spots {
            let line = |(c, seen): &(usize, Seen)| Some(rig.lenses[*c].line(rig.poses[*c].as_ref()?, seen.pixel));
            let before =
                |x: &[f64; 3]| spot.seen.iter().all(|(c, _)| rig.poses[*c].is_some_and(|pose| pose.apply(*x)[2] > 0.0));
            spot.place = mat3::nearest_to_lines(spot.seen.iter().filter_map(line)).filter(before);
        }
    }

    /// Adjusts a rig to keypoints; none: it does not fit at all. Clocks that are known and the first one stay.
    pub(super) fn adjusted(&self, rig: &mut Rig, spots: &mut [Spot], how: How) -> Option<Vec<f64>> {
        self.triangulate(rig, spots);
        let known = spots.iter().filter(|s| s.place.is_some()).count();
        if known < LEAST || (known as f64) < BEFORE * spots.len() as f64 {
            return None;
        }
        let placed = rig.placed();
        let kept = placed.iter().position(|&c| self.of[c].keep_offset).map_or(placed[0], |k| placed[k]);
        let stays = |c: usize| how.clocks.is_none() || c == kept || self.of[c].keep_offset;
        let mut bundle = Bundle::default();
        for (k, &c) in placed.iter().enumerate() {
            bundle.views.push(View { pose: rig.poses[c].expect("it is placed"), lens: k, tau: 0.0 });
            bundle.lenses.push(rig.lenses[c]);
        }
        for spot in spots.iter() {
            let Some(x) = spot.place else { continue };
            for (c, seen) in &spot.seen {
                let view = placed.iter().position(|p| p == c).expect("only placed cameras are in it");
                let velocity = if stays(*c) { [0.0; 2] } else { seen.velocity };
                bundle.sightings.push(Sighting { view, point: bundle.points.len(), pixel: seen.pixel, velocity });
            }
            bundle.points.push(x);
        }
        let side = placed.iter().map(|&c| self.side(c)).fold(0.0, f64::max);
        let settings = Settings {
            scale: SCALE,
            free: Free { pose: true, focal: how.focal, k1: how.k1, center: how.center, tau: how.clocks.is_some() },
            exact: placed.iter().map(|&c| self.of[c].focal.is_some()).collect(),
            priors: Priors {
                lenses: placed.iter().map(|&c| self.lens(c, USUAL)).collect(),
                focal: FOCAL,
                k1: K1,
                center: CENTER * side,
                family: if placed.iter().any(|&c| self.of[c].focal.is_some()) { f64::INFINITY } else { how.family },
                tau: how.clocks.unwrap_or(f64::INFINITY),
            },
            steps: how.steps,
            gain: GAIN,
        };
        if !adjust(&mut bundle, &settings).after.is_finite() {
            return None;
        }
        let mut taus = vec![0.0; self.of.len()];
        for (&c, (view, lens)) in placed.iter().zip(bundle.views.iter().zip(&bundle.lenses)) {
            (rig.poses[c], rig.lenses[c], taus[c]) = (Some(view.pose), *lens, view.tau);
        }
        let mut places = bundle.points.into_iter();
        spots.iter_mut().filter(|s| s.place.is_some()).for_each(|s| s.place = places.next());
        Some(taus)
    }
}
