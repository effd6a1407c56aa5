//! Sightings of a map whose cameras are fixed: made exact, and found in cameras whose detectors missed them.

use super::Map;
use crate::sfm::overlay::{self, Eye, ImagePoint};
use crate::sfm::pictures::{CameraView, Feature};
use crate::sfm::tracks::Track;
use rayon::prelude::*;

/// Of a camera with fewer sightings whose windows agree, the others stay too.
const LEFT: usize = 100;

/// Images in which a point is searched for next to those that show it, at most: a walk has hundreds.
const LOOKED_IN: usize = 32;

/// Findings of windows around a track's point.
struct Laid {
    /// How far each of its sightings is off, by its place in the track; none where windows do not agree.
    offs: Vec<(usize, Option<[f64; 2]>)>,
    /// Further sights of it, and the positions there.
    found: Vec<(usize, Feature)>,
}

impl Map<'_> {
    /// Sights and tracks with features where windows about the points agree best, also in cameras that did not find
    /// them. Sightings whose windows do not agree are removed, except in cameras that would be left with few.
    pub(super) fn overlaid(&self) -> (Vec<CameraView>, Vec<Track>) {
        let laid: Vec<Option<Laid>> = (0..self.tracks.len()).into_par_iter().map(|t| self.laid(t)).collect();
        let mut left = vec![0; self.sights.len()];
        for (t, laid) in laid.iter().enumerate() {
            let Some(laid) = laid else { continue };
            let kept = laid.offs.iter().filter(|(_, off)| off.is_some()).map(|(k, _)| self.tracks[t].seen[*k].0);
            kept.chain(laid.found.iter().map(|f| f.0)).for_each(|s| left[s] += 1);
        }
        // Without the images, which are many bytes.
        let bare =
            |s: &CameraView| CameraView { name: s.name.clone(), features: s.features.clone(), shown: Vec::new(), ..*s };
        let mut sights: Vec<CameraView> = self.sights.iter().map(bare).collect();
        let mut tracks = self.tracks.to_vec();
        for (t, laid) in laid.into_iter().enumerate() {
            let Some(laid) = laid else { continue };
            let mut gone = Vec::new();
            for (k, off) in laid.offs {
                let (sight, feature) = self.tracks[t].seen[k];
                match off {
                    Some(off) => {
                        let pixel = &mut sights[sight].features[feature].pixel;
                        (0..2).for_each(|a| pixel[a] += off[a]);
                    }
                    None if left[sight] >= LEFT => gone.push((sight, feature)),
                    None => {}
                }
            }
            tracks[t].seen.retain(|s| !gone.contains(s));
            for (sight, feature) in laid.found {
                tracks[t].seen.push((sight, sights[sight].features.len()));
                sights[sight].features.push(feature);
            }
            tracks[t].seen.sort_unstable();
        }
        (sights, tracks)
    }

    /// Positions where the windows of a track agree; none for a track without a point.
    fn laid(&self, t: usize) -> Option<Laid> {
        let (spot, track) = (self.spots[t].as_ref()?, &self.tracks[t]);
        let eye = |s: usize| Some(Eye { lens: self.lens(s), pose: self.poses[s].as_ref()? });
        let feature = |k: usize| &self.sights[track.seen[k].0].features[track.seen[k].1];
        let like = feature(spot.seen[0]);
        let shown = |s: usize| self.sights[s].shown.get(like.moment).and_then(Option::as_ref);
        let at = |s: usize, f: &Feature| {
            let later = shown(s).map_or(0.0, |w| w.later);
            let place = std::array::from_fn(|a| f.pixel[a] - f.velocity[a] * later);
            Some(ImagePoint { shown: shown(s), place, eye: eye(s)? })
        };
        let seen: Option<Vec<ImagePoint<'_>>> = spot.seen.iter().map(|&k| at(track.seen[k].0, feature(k))).collect();
        let seen = seen?;
        let velocities: Vec<[f64; 2]> = spot.seen.iter().map(|&k| feature(k).velocity).collect();
        let speed = overlay::speed(spot.place, &seen, &velocities)?;
        let guess = |s: usize| {
            let (pixel, velocity) = eye(s)?.moving(spot.place, speed)?;
            let pixel = std::array::from_fn(|a| pixel[a] - velocity[a] * self.taus[s]);
            Some((s, Feature { pixel, velocity, ..like.clone() }))
        };
        let others = (0..self.sights.len()).filter(|s| track.seen.iter().all(|(other, _)| other != s));
        let guesses: Vec<(usize, Feature)> = others.filter(|&s| shown(s).is_some()).filter_map(guess).collect();
        let step = guesses.len().div_ceil(LOOKED_IN).max(1);
        let guesses: Vec<(usize, Feature)> = guesses.into_iter().step_by(step).collect();
        let more: Vec<ImagePoint<'_>> = guesses.iter().filter_map(|(s, f)| at(*s, f)).collect();
        let mut offs = overlay::aligned(spot.place, &seen, &more);
        let found = offs.split_off(seen.len());
        let found = guesses.into_iter().zip(found).filter_map(|((s, mut f), off)| {
            let off = off?;
            (0..2).for_each(|a| f.pixel[a] += off[a]);
            Some((s, f))
        });
        Some(Laid { offs: spot.seen.iter().copied().zip(offs).collect(), found: found.collect() })
    }
}
