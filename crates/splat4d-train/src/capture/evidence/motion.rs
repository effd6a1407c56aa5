//! Whether anything moves in front of moving cameras: matches of frames at different times either agree with one static
//! scene, or are next to their epipolar lines.
//!
//! Wrong matches are spread over the image, moved features are near their lines. Matches near the lines in excess of
//! the expected wrong ones count as moved.

use super::super::{Capture, Timing};
use super::look;
use super::pairs::{self, Match};
use rayon::prelude::*;
use splat4d::math::Se3;

/// Frames that are compared with later ones, evenly chosen.
const STARTS: usize = 12;
/// Parts of the film between a frame and the two that it is compared with: the first shares most of its image, the
/// second gives motion time.
const GAPS: [usize; 2] = [40, 12];
/// Distances from the epipolar line, pixels of the small image: up to the first a match agrees, between the second and
/// the third it is a feature that moved, between the third and the fourth it is a wrong match.
const BANDS: [f64; 4] = [1.5, 3.0, 8.0, 40.0];
/// Fewest matches that agree of a pair that counts, and of all pairs together.
const FEWEST: [usize; 2] = [10, 200];
/// Share of features that moved up to which a scene is static, where the capture states times, as those of moving
/// scenes do, and where they are taken from the names of numbered images, as walks through a building have them.
/// Measured: walks and rooms up to 0.7 %, a moving hand 1.9 % (studies/records/2026-11-26-real-size.md).
const STATIC: [f64; 2] = [0.003, 0.0125];

/// Agreement of matches between frames at different times with one static scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Agreement {
    /// Matches that count: those that agree, and those of features that moved.
    pub matches: usize,
    /// Share of them that agrees, in [0, 1].
    pub share: f64,
    /// Whether the capture states times; they are numbers in image names otherwise.
    pub timed: bool,
}

impl Agreement {
    /// Whether nothing moves.
    pub(crate) fn is_static(&self) -> bool {
        self.share >= 1.0 - STATIC[usize::from(!self.timed)]
    }
}

impl Capture {
    /// Compares training frames of moving cameras over time. `None`: too few features match, or no camera moves.
    pub(crate) fn agreement(&self) -> Option<Agreement> {
        let mut frames: Vec<usize> =
            self.train.iter().copied().filter(|&i| !self.cameras[self.frames[i].camera].fixed).collect();
        frames.sort_by(|&a, &b| self.frames[a].time.0.total_cmp(&self.frames[b].time.0));
        let count = frames.len();
        let mut pairs = Vec::new();
        for k in 0..STARTS.min(count) {
            let from = k * count / STARTS.min(count);
            for gap in GAPS {
                let to = from + count.div_ceil(gap);
                if to < count && self.frames[frames[from]].time != self.frames[frames[to]].time {
                    pairs.push([from, to]);
                }
            }
        }
        pairs.dedup();
        let mut wanted: Vec<usize> = pairs.iter().flatten().map(|&k| frames[k]).collect();
        wanted.sort_unstable();
        wanted.dedup();
        let mut images = look::take(self, &wanted, look::FINE);
        look::describe(&mut images, look::FINE);
        let poses: Vec<Se3> = images.iter().map(|l| self.frames[l.frame].source.cam_from_world).collect();
        let place = |k: usize| images.iter().position(|l| l.frame == frames[k]);
        let pairs: Vec<[usize; 2]> = pairs.iter().filter_map(|&[a, b]| Some([place(a)?, place(b)?])).collect();
        let counts: Vec<[f64; 2]> = pairs
            .par_iter()
            .map(|&[a, b]| {
                let matches = pairs::between([a, b], &images[a].marks, &images[b].marks, pairs::STRICT);
                counts(&matches, |m| pairs::distance(m, &images, &poses))
            })
            .collect();
        let [agree, moved] = counts.iter().fold([0.0; 2], |s, c| [s[0] + c[0], s[1] + c[1]]);
        let all = agree + moved.max(0.0);
        let timed = self.timing == Timing::Told;
        (agree >= FEWEST[1] as f64).then(|| Agreement { matches: all as usize, share: agree / all, timed })
    }
}

/// Matches of one pair that agree with a static scene, and those of features that moved in excess of chance.
fn counts(matches: &[Match], distance: impl Fn(&Match) -> f64) -> [f64; 2] {
    let distances: Vec<f64> = matches.iter().map(distance).collect();
    let within = |low: f64, high: f64| distances.iter().filter(|d| (low..high).contains(*d)).count() as f64;
    let [near, beside, far, end] = BANDS;
    let agree = within(0.0, near);
    if agree < FEWEST[0] as f64 {
        return [0.0; 2];
    }
    // Wrong matches are spread over the image: as many per pixel where features hardly move that far.
    let chance = within(far, end) * (far - beside) / (end - far);
    [agree, within(beside, far) - chance]
}
