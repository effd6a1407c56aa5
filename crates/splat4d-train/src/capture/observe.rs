//! Splits a capture into the observed part and the future. Frames that score a forecast must not influence it.

use super::{Capture, assemble};
use splat4d::{Error, Result};

/// Of the clip's length: frames as near as this to the border belong to what is observed (times are divided by rates).
const SLACK: f64 = 1e-9;

impl Capture {
    /// Keeps the first `share` of the clip, above 0 and below 1, for training and measuring; every later frame becomes
    /// [`future`](Self::future), whatever its purpose was. `near`: as [`CaptureOptions::near`](super::CaptureOptions).
    ///
    /// A frame is observed where its time is at most first + share · (last − first) of the training and held-out
    /// frames. Removing later images also removes their priors: initial points with later times, and optical flow into
    /// the future. A capture's own points without times are taken at their word. Errors: one time, a share that leaves
    /// nothing.
    pub(crate) fn observe(&mut self, share: f64, near: f64) -> Result<()> {
        let place = |e: Error| e.at(format!("{} (capture.observe = {share})", self.root.display()));
        let times = || self.train.iter().chain(&self.held).map(|&i| self.frames[i].time.0);
        let (first, last) = times().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)));
        if last <= first {
            return Err(place(Error::input("all images of the capture have the same time, so there is no future"))
                .remedy("Leave --observe away, or give a capture with motion"));
        }
        if !(share > 0.0 && share < 1.0) {
            return Err(place(Error::input("the observed share leaves nothing to train on, or no future"))
                .remedy("Give a share above 0 and below 1, such as 0.8"));
        }
        let until = first + (share + SLACK) * (last - first);
        let seen = |i: &usize| self.frames[*i].time.0 <= until;
        let mut future: Vec<usize> = self.train.iter().chain(&self.held).copied().filter(|i| !seen(i)).collect();
        future.sort_unstable();
        let [train, held, validation] =
            [&self.train, &self.held, &self.validation].map(|l| l.iter().copied().filter(seen).collect());
        let later: Vec<usize> =
            (0..self.frames.len()).filter(|&i| self.frames[i].flow.as_ref().is_some_and(|f| !seen(&f.to))).collect();
        if Vec::is_empty(&train) {
            return Err(
                place(Error::input("no training frame is left in the observed part")).remedy("Observe a larger share")
            );
        }
        (self.train, self.held, self.validation, self.future) = (train, held, validation, future);
        later.into_iter().for_each(|i| self.frames[i].flow = None);
        if let Some(points) = &mut self.points {
            let kept: Vec<usize> =
                (0..points.points.len()).filter(|&i| points.times[i].is_none_or(|t| t <= until)).collect();
            points.points = kept.iter().map(|&i| points.points[i]).collect();
            points.colors = kept.iter().map(|&i| points.colors[i]).collect();
            points.times = kept.iter().map(|&i| points.times[i]).collect();
        }
        // Where moving cameras will be states how large the scene is.
        let near = assemble::near(self, near);
        self.frames.iter_mut().for_each(|f| f.view.near = near);
        Ok(())
    }
}
