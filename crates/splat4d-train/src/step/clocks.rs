//! Search of time offsets with an unfinished scene: a camera's images are compared with renders at shifted times, and
//! the shift with the smallest difference is selected.
//!
//! Gradients alone do not find shifts of whole frames: their reach is the width of edges. The scene was trained with
//! wrong offsets, but compared with any one camera it mostly follows the other cameras; so the search is repeated while
//! it learns, as points and their partners are in ICP (Besl and McKay 1992).

use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::train_state::{Corrections, Exposure, SearchDue};
use rayon::prelude::*;
use splat4d::device;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Image, RenderConfig, Shot};
use splat4d::scene::{Planes, Time};
use std::collections::BTreeMap;

/// Images of a camera that are examined, spread over the capture.
const IMAGES: usize = 6;
/// Neighbouring searches use different images: this many positions between two of them, in turn.
const TURNS: usize = 3;
/// Images are halved until their longer side is at most so long, pixels: that is quick, and a shift shows farther.
const SIDE: usize = 160;
/// A search covers at most this share of the clip: beyond its ends there is no scene to compare with.
const FARTHEST: f64 = 0.25;

/// The images from which time offsets are found, and the known data of their cameras.
#[derive(Clone, Copy)]
pub(crate) struct OffsetImages<'a> {
    pub frames: &'a dyn Frames,
    pub corrections: &'a Corrections,
    pub exposure: Option<&'a Exposure>,
    pub antialias: Antialias,
}

impl OffsetImages<'_> {
    /// By how many seconds to shift each camera's clock from where it is now, so that its images suit the scene best.
    /// Errors: images that cannot be read.
    pub(crate) fn shifts(&self, scene: &Scene<f32>, due: SearchDue) -> Result<Vec<(usize, f64)>> {
        let reach = due.reach.min(FARTHEST * (scene.clip[1] - scene.clip[0]));
        let sides = (reach / due.step).floor() as i64;
        let shifts: Vec<f64> = (-sides..=sides).map(|k| k as f64 * due.step).collect();
        let mut rigs: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        (0..self.frames.len()).for_each(|i| rigs.entry(self.frames.rig(i)).or_default().push(i));
        let rigs: Vec<(usize, Vec<usize>)> = rigs.into_iter().collect();
        rigs.par_iter()
            .map(|(rig, frames)| Ok((*rig, least(&shifts, &self.costs(scene, frames, &shifts, due.round)?))))
            .collect()
    }

    /// The difference of a camera's images from the scene at shifted times; nothing where none of them can be
    /// shifted so
    /// far within the clip.
    fn costs(&self, scene: &Scene<f32>, frames: &[usize], shifts: &[f64], round: usize) -> Result<Vec<f64>> {
        let mut costs = vec![0.0; shifts.len()];
        let ends = [shifts[0], shifts[shifts.len() - 1]];
        let time = |i: usize| self.corrections.time(i, self.frames.time(i)).0;
        let within = |i: &usize| time(*i) + ends[0] >= scene.clip[0] && time(*i) + ends[1] <= scene.clip[1];
        let mut frames: Vec<usize> = frames.iter().copied().filter(within).collect();
        frames.sort_by(|&a, &b| time(a).total_cmp(&time(b)));
        let looks = IMAGES.min(frames.len());
        let mut backend = device::cpu(RenderConfig { antialias: self.antialias, ..RenderConfig::default() });
        let (mut instant, mut image, mut picture) = (Evaluation::default(), Image::default(), Picture::default());
        for k in 0..looks {
            let place = (2 * (TURNS * k + round % TURNS) + 1) * frames.len() / (2 * TURNS * looks);
            let i = frames[place];
            self.frames.load(i, &mut picture)?;
            let mut camera = self.corrections.camera(i, self.frames.camera(i));
            while camera.width.max(camera.height) > SIDE && camera.width.min(camera.height) > 1 {
                camera = camera.downscaled(2);
                picture.halve();
            }
            for (cost, shift) in costs.iter_mut().zip(shifts) {
                scene.at(Time(time(i) + shift), &mut instant);
                let splats = scene.splats(&instant);
                backend.render(&Shot::new(&splats, &camera, scene.background), &mut image)?;
                if let Some(exposure) = self.exposure {
                    exposure.respond(self.frames.rig(i), Time(time(i)), &mut image.color);
                }
                *cost += difference(&image.color, &picture);
            }
        }
        Ok(costs)
    }
}

/// Mean absolute difference of colours over the pixels that count. What does not move costs the same at every shift.
fn difference(drawn: &Planes<f32>, picture: &Picture) -> f64 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for p in 0..drawn.pixels() {
        let weight = picture.weight.as_ref().map_or(1.0, |w| f64::from(w.data[p]));
        let apart = |c: usize| f64::from((drawn.plane(c)[p] - picture.color.plane(c)[p]).abs());
        sum += weight * (apart(0) + apart(1) + apart(2)) / 3.0;
        weights += weight;
    }
    if weights > 0.0 { sum / weights } else { 0.0 }
}

/// The shift of evenly spaced ones that costs least: the vertex of the parabola through it and its neighbours. None
/// where all cost the same.
fn least(shifts: &[f64], costs: &[f64]) -> f64 {
    let order =
        |&a: &usize, &b: &usize| costs[a].total_cmp(&costs[b]).then(shifts[a].abs().total_cmp(&shifts[b].abs()));
    let best = (0..shifts.len()).min_by(order).expect("no shift is one of them");
    if !costs[best].is_finite() {
        return 0.0;
    }
    if best == 0 || best + 1 == shifts.len() {
        return shifts[best];
    }
    let [before, at, after] = [costs[best - 1], costs[best], costs[best + 1]];
    let bend = before - 2.0 * at + after;
    let vertex = if bend > 0.0 { 0.5 * (before - after) / bend } else { 0.0 };
    shifts[best] + vertex * (shifts[1] - shifts[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_shift_is_a_parabolas_vertex_and_zero_for_equal_costs() {
        let shifts: Vec<f64> = (-4..=4).map(|k| 0.5 * f64::from(k)).collect();
        let costs = |f: &dyn Fn(f64) -> f64| shifts.iter().map(|&s| f(s)).collect::<Vec<_>>();
        let found = least(&shifts, &costs(&|s| 3.0 + (s - 0.63).powi(2)));
        assert!((found - 0.63).abs() < 1e-12, "{found}");
        assert_eq!(least(&shifts, &costs(&|_| 0.2)), 0.0);
        assert_eq!(least(&shifts, &costs(&|s| -s)), 2.0, "beyond its reach it goes as far as that");
        assert_eq!(least(&shifts, &costs(&|_| f64::NAN)), 0.0);
    }
}
