//! Which Gaussians a scene shows when: how many rest at a time, and how much the sets of two frames have in common, which
//! is the argument for active sets (4DGS-1K, Yuan et al. 2025).

use crate::measure::frames;
use serde::{Deserialize, Serialize};
use splat4d::layers::Scene;
use splat4d::scene::Time;

/// A scene's Gaussians over time. A Gaussian is active where its opacity times its life is visible and masks admit it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Activity {
    /// Seconds of the frames.
    pub times: Vec<f64>,
    /// Share of the Gaussians that is inactive at each.
    pub inactive: Vec<f64>,
    /// [seconds between two frames, mean intersection over union of their active sets].
    pub overlap: Vec<[f64; 2]>,
}

impl Activity {
    /// Examines a scene; `None` where nothing changes: one frame, or all Gaussians active at all times.
    pub fn of(scene: &Scene<f32>) -> Option<Self> {
        let times = frames(scene.clip, scene.fps);
        let total = scene.len();
        if times.len() < 2 || total == 0 {
            return None;
        }
        let mut ids = Vec::new();
        if scene.layers.iter().all(|layer| times.iter().all(|t| layer.active(*t, &mut ids))) {
            return None;
        }
        let sets: Vec<Set> = times.iter().map(|t| Set::at(scene, *t)).collect();
        if sets.iter().all(|s| s.count == total) {
            return None;
        }
        let step = (times[times.len() - 1].0 - times[0].0) / (times.len() - 1) as f64;
        Some(Self {
            inactive: sets.iter().map(|s| 1.0 - s.count as f64 / total as f64).collect(),
            overlap: distances(times.len()).map(|d| [d as f64 * step, mean_overlap(&sets, d)]).collect(),
            times: times.into_iter().map(|t| t.0).collect(),
        })
    }

    /// Mean share that is inactive.
    pub fn mean_inactive(&self) -> f64 {
        self.inactive.iter().sum::<f64>() / self.inactive.len().max(1) as f64
    }

    /// In a sentence.
    pub fn sentence(&self) -> String {
        let percent = |x: f64| format!("{:.0} %", 100.0 * x);
        let mut out = format!("{} of the Gaussians rest in a frame", percent(self.mean_inactive()));
        if let (Some(near), Some(far)) = (self.overlap.first(), self.overlap.last()) {
            let part = |[seconds, share]: &[f64; 2]| format!("{seconds:.2} s apart share {}", percent(*share));
            out += &format!("; active sets {}, those {}", part(near), part(far));
        }
        out
    }
}

/// The rows that are active at a time, as bits over all layers.
struct Set {
    bits: Vec<u64>,
    count: usize,
}

impl Set {
    fn at(scene: &Scene<f32>, time: Time) -> Self {
        let mut bits = vec![0u64; scene.len().div_ceil(64)];
        let (mut first, mut count, mut ids) = (0, 0, Vec::new());
        for layer in &scene.layers {
            let rows = layer.params.len();
            if layer.active(time, &mut ids) {
                ids.extend(0..rows as u32);
            }
            count += ids.len();
            for row in ids.iter().map(|id| first + *id as usize) {
                bits[row / 64] |= 1 << (row % 64);
            }
            first += rows;
        }
        Self { bits, count }
    }

    /// Intersection over union; two empty sets are equal.
    fn overlap(&self, other: &Self) -> f64 {
        let both: u32 = self.bits.iter().zip(&other.bits).map(|(a, b)| (a & b).count_ones()).sum();
        let any = self.count + other.count - both as usize;
        if any == 0 { 1.0 } else { f64::from(both) / any as f64 }
    }
}

/// Distances of frames: doubled from one to the whole clip.
fn distances(frames: usize) -> impl Iterator<Item = usize> {
    let last = frames - 1;
    let powers = (0..usize::BITS).map(|k| 1usize << k).take_while(move |d| *d < last);
    powers.chain([last])
}

fn mean_overlap(sets: &[Set], distance: usize) -> f64 {
    let pairs = sets.len() - distance;
    (0..pairs).map(|i| sets[i].overlap(&sets[i + distance])).sum::<f64>() / pairs as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::Layer;
    use splat4d::motion::Still;
    use splat4d::scene::params::{OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params};
    use std::sync::Arc;

    #[test]
    fn distances_double_up_to_the_whole_clip() {
        assert_eq!(distances(2).collect::<Vec<_>>(), [1]);
        assert_eq!(distances(9).collect::<Vec<_>>(), [1, 2, 4, 8]);
        assert_eq!(distances(8).collect::<Vec<_>>(), [1, 2, 4, 7]);
    }

    #[test]
    fn half_of_a_scene_rests_in_each_half_of_its_clip() {
        let mut params = Params::new(4, 1, LifeKind::Interval.columns());
        for row in 0..4 {
            let [geometry, lives] = params.get_mut([GEOMETRY, LIFE]);
            geometry.write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
            geometry.write(row, OPACITY, [3.0]);
            // Two live in the first half of ten frames, two in the second, edges far within a frame.
            lives.write(row, 0, [if row < 2 { 0.2 } else { 0.7 }, 0.22f32.ln(), 0.001f32.ln()]);
        }
        let layer = Layer::new("all", params, Arc::new(Still), LifeKind::Interval);
        let scene = Scene { layers: vec![layer], clip: [0.0, 0.9], fps: 10.0, ..Scene::default() };
        let found = Activity::of(&scene).unwrap();
        assert_eq!(found.inactive, vec![0.5; 10]);
        assert_eq!(found.overlap.first().unwrap()[1], 8.0 / 9.0, "one pair of nine differs");
        assert_eq!(found.overlap.last().unwrap()[1], 0.0);
        assert!((found.mean_inactive() - 0.5).abs() < 1e-12);
        assert_eq!(
            found.sentence(),
            "50 % of the Gaussians rest in a frame; active sets 0.10 s apart share 89 %, those 0.90 s apart share 0 %"
        );
        let still = Scene { clip: [0.0, 0.0], ..scene };
        assert_eq!(Activity::of(&still), None);
    }
}
