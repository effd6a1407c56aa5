//! [`Batch`]: the pictures of one step.

use super::chain::View;
use crate::Result;
use crate::capture::frames::{FlowTruth, Frames, Picture};
use crate::learner::Corrections;
use splat4d::scene::{Camera, Time};

/// Frames of one step, loaded; memory is reused from step to step.
#[derive(Default)]
pub(super) struct Batch {
    seen: Vec<usize>,
    pictures: Vec<Picture>,
    cameras: Vec<Camera>,
    times: Vec<Time>,
}

impl Batch {
    /// Loads the frames `seen`, at half their size where `half` says so, from where and when `corrections` say.
    pub(super) fn load(
        &mut self,
        frames: &dyn Frames,
        seen: Vec<usize>,
        half: bool,
        corrections: Option<&Corrections>,
    ) -> Result<()> {
        self.pictures.resize_with(seen.len(), Picture::default);
        self.cameras.clear();
        self.times.clear();
        for (&i, picture) in seen.iter().zip(&mut self.pictures) {
            frames.load(i, picture)?;
            let stated = frames.camera(i);
            let camera = corrections.map_or_else(|| stated.clone(), |c| c.camera(i, stated));
            let time = frames.time(i);
            self.times.push(corrections.map_or(time, |c| c.time(i, time)));
            self.cameras.push(match half && camera.width > 1 && camera.height > 1 {
                true => {
                    picture.halve();
                    camera.downscaled(2)
                }
                false => camera,
            });
        }
        self.seen = seen;
        Ok(())
    }

    /// The views that the scene is compared with, at times that are `shift` seconds later than they were.
    pub(super) fn views(&self, frames: &dyn Frames, shift: f64, background: [f32; 3]) -> Vec<View<'_, f32>> {
        let views = self.seen.iter().zip(&self.pictures).zip(self.cameras.iter().zip(&self.times));
        views
            .map(|((&i, picture), (camera, time))| View {
                camera,
                t: Time(time.0 + shift),
                background,
                truth: &picture.color,
                mask: picture.mask.as_ref(),
                weight: picture.weight.as_ref(),
                flow: picture.flow.as_ref().map(|f| FlowTruth { to: Time(f.to.0 + shift), ..f.truth() }),
                frame: i,
                rig: frames.rig(i),
            })
            .collect()
    }

    /// The frames' numbers.
    pub(super) fn seen(&self) -> &[usize] {
        &self.seen
    }

    /// The frames' names, for messages.
    pub(super) fn names(&self, frames: &dyn Frames) -> String {
        self.seen.iter().map(|&i| frames.name(i)).collect::<Vec<_>>().join(", ")
    }
}
