//! A capture on disk for the trainer: one of its splits, through the image store.

use crate::Result;
use crate::capture::frames::{Depth, Flow, Frames, Picture, Tracked};
use crate::capture::{Agreement, Capture, DepthKind, ImageStore};
use splat4d::scene::{Camera, Planes, Time};
use std::sync::Arc;

/// Some of a capture's frames.
pub struct Dataset {
    capture: Arc<Capture>,
    store: Arc<ImageStore>,
    frames: Vec<usize>,
}

impl Dataset {
    /// The frames with these numbers.
    pub fn new(store: Arc<ImageStore>, frames: Vec<usize>) -> Self {
        Self { capture: store.capture().clone(), store, frames }
    }

    /// The images of all of the capture's frames.
    pub(crate) fn store(&self) -> &Arc<ImageStore> {
        &self.store
    }

    /// The capture whose frames they are.
    pub(crate) fn capture(&self) -> &Arc<Capture> {
        &self.capture
    }
}

impl Frames for Dataset {
    fn len(&self) -> usize {
        self.frames.len()
    }

    fn camera(&self, i: usize) -> &Camera {
        &self.capture.frames[self.frames[i]].view
    }

    fn time(&self, i: usize) -> Time {
        self.capture.frames[self.frames[i]].time
    }

    fn rig(&self, i: usize) -> usize {
        self.capture.frames[self.frames[i]].camera
    }

    fn name(&self, i: usize) -> String {
        let frame = &self.capture.frames[self.frames[i]];
        format!("camera {}, frame {}", self.capture.cameras[frame.camera].name, frame.index)
    }

    fn has_masks(&self) -> bool {
        self.capture.background.is_some() || self.frames.iter().any(|&i| self.capture.frames[i].mask.is_some())
    }

    fn has_depth(&self) -> bool {
        let metric = |&i: &usize| self.capture.frames[i].depth.as_ref().is_some_and(|d| d.kind == DepthKind::Metric);
        self.frames.iter().any(metric)
    }

    fn agreement(&self) -> Option<Agreement> {
        self.capture.agreement()
    }

    fn tracked(&self, i: usize) -> Option<Tracked<'_>> {
        let frame = &self.capture.frames[self.frames[i]];
        Some(Tracked { tracks: frame.tracks.as_deref()?, frame: frame.index, source: &frame.source })
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        let frame = self.frames[i];
        let stored = self.store.load(frame)?;
        stored.color_into(&mut out.color);
        out.shutter = self.capture.frames[frame].shutter;
        fill(&mut out.mask, |plane| stored.mask_into(plane));
        fill(&mut out.weight, |plane| stored.valid_into(plane));
        let mut values = out.depth.take().map(|d| d.values).unwrap_or_default();
        out.depth = stored.depth_into(&mut values).map(|kind| Depth { values, kind });
        fill(&mut out.measured, |plane| stored.measured_into(plane));
        let mut vectors = out.flow.take().map(|f| f.vectors).unwrap_or_default();
        if let (Some(file), true) = (&self.capture.frames[frame].flow, stored.flow_into(&mut vectors)) {
            let to = &self.capture.frames[file.to];
            out.flow = Some(Flow { to: to.time, camera: to.view.clone(), vectors });
        }
        Ok(())
    }

    fn prefetch(&self, frames: &[usize]) {
        let ids: Vec<usize> = frames.iter().map(|&i| self.frames[i]).collect();
        self.store.prefetch(&ids);
    }
}

/// Keeps the plane's allocation when there is something to fill it with.
fn fill(slot: &mut Option<Planes<f32>>, read: impl FnOnce(&mut Planes<f32>) -> bool) {
    let mut plane = slot.take().unwrap_or_default();
    if read(&mut plane) {
        *slot = Some(plane);
    }
}
