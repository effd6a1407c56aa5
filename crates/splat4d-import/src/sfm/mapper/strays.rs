//! Cameras whose moving objects contradict those of others: they film another time, or another recording.

use super::{Link, Map, Transfer};
use crate::sfm::tracks;
use crate::sync::median;
use rayon::prelude::*;

impl Map<'_> {
    /// Of every sight the matches, and those of them that are on epipolar lines; of the static background and of what
    /// moves.
    pub(super) fn agreement(&self, links: &[Link]) -> Vec<[[usize; 2]; 2]> {
        let known: Vec<Option<tracks::Known>> =
            (0..self.sights.len()).into_par_iter().map(|s| self.undistorted(s)).collect();
        let mut out = vec![[[0; 2]; 2]; self.sights.len()];
        for link in links {
            let [a, b] = link.sights;
            let (Some(p), Some(q)) = (&known[a], &known[b]) else { continue };
            let transfer = Transfer::new(&p.camera, &q.camera);
            for &[i, j] in &link.alike {
                let [u, v] = q.pixels[j];
                let off = transfer.line(p.pixels[i]).map_or(f64::INFINITY, |l| l[0] * u + l[1] * v + l[2]);
                let moves = usize::from(self.sights[a].features[i].moment > 0);
                for s in [a, b] {
                    out[s][moves][0] += 1;
                    out[s][moves][1] += usize::from(off.abs() < self.tolerance(b));
                }
            }
        }
        out
    }
}

/// Cameras whose moving objects contradict the others, from matches and inliers, of the static background and of what
/// moves: a share fits that is small against the other cameras', where the static background fits. It shows another
/// time, or another recording. Of four cameras of the bundled capture, one of them half a second apart, 23 % and 57 to
/// 62 %; together 64 to 73 %.
pub(super) fn of(told: &[[[usize; 2]; 2]]) -> Vec<bool> {
    /// Matches that are needed.
    const TELL: usize = 40;
    /// Of the others' share.
    const LEAST: f64 = 0.5;
    let share = |kind: usize, s: usize| {
        let [all, fit] = told[s][kind];
        (all >= TELL).then(|| fit as f64 / all as f64)
    };
    let against = |kind: usize, s: usize| {
        let mut others: Vec<f64> = (0..told.len()).filter(|&o| o != s).filter_map(|o| share(kind, o)).collect();
        Some(share(kind, s)? / median(&mut others))
    };
    let stray = |s: usize| against(1, s).is_some_and(|m| m < LEAST) && against(0, s).is_some_and(|f| f >= LEAST);
    (0..told.len()).map(stray).collect()
}
