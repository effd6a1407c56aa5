//! [`Batch`]: the images of one step.

use super::chain::View;
use super::emphasis::Emphasis;
use crate::Result;
use crate::capture::frames::{Depth, Flow, FlowTruth, Frames, Picture};
use crate::train_state::Corrections;
use splat4d::math::Rng;
use splat4d::scene::{Camera, Planes, Time};
use std::collections::BTreeMap;

/// Frames of one step, loaded; memory is reused from step to step.
#[derive(Default)]
pub(super) struct Batch {
    /// Which pixels weigh more.
    pub(super) emphasis: Option<Emphasis>,
    seen: Vec<usize>,
    /// Whether each was halved.
    halved: Vec<bool>,
    pictures: Vec<Picture>,
    tracks: Vec<Option<Flow>>,
    cameras: Vec<Camera>,
    times: Vec<Time>,
    /// Frames in whole or half size whose images a device kept after a step, and whether they have weights.
    kept: BTreeMap<(usize, bool), bool>,
}

/// Whether a frame's image in a size (width, height), with or without weights, need not be loaded.
pub(super) type Holds<'a> = &'a mut dyn FnMut(usize, [usize; 2], bool) -> bool;

/// Whether a view has only the shape of its image, because a device holds it.
pub(super) fn left_out(view: &View<'_, f32>) -> bool {
    view.truth.data.is_empty() && view.truth.pixels() > 0
}

impl Batch {
    /// Loads the frames `seen`, at half their size where `half` states so, with poses and times corrected by
    /// `corrections`. `rng` draws the frames to which points are followed. Images that were `kept` and that `holds`
    /// confirms are left out.
    pub(super) fn load(
        &mut self,
        frames: &dyn Frames,
        seen: Vec<usize>,
        half: bool,
        corrections: Option<&Corrections>,
        rng: Rng,
        holds: Holds<'_>,
    ) -> Result<()> {
        self.pictures.resize_with(seen.len(), Picture::default);
        self.cameras.clear();
        self.times.clear();
        self.tracks.clear();
        self.halved.clear();
        for (&i, picture) in seen.iter().zip(&mut self.pictures) {
            let stated = frames.camera(i);
            let camera = corrections.map_or_else(|| stated.clone(), |c| c.camera(i, stated));
            let time = frames.time(i);
            self.times.push(corrections.map_or(time, |c| c.time(i, time)));
            let half = half && camera.width > 1 && camera.height > 1;
            let camera = if half { camera.downscaled(2) } else { camera };
            let size = [camera.width, camera.height];
            self.cameras.push(camera);
            self.halved.push(half);
            if let Some(&weighted) = self.kept.get(&(i, half))
                && holds(i, size, weighted)
            {
                leave_out(picture, size, weighted);
                self.tracks.push(None);
                continue;
            }
            frames.load(i, picture)?;
            if let Some(emphasis) = &mut self.emphasis {
                emphasis.apply(frames.rig(i), picture);
            }
            self.tracks.push(tracks(frames, i, half, rng.fork(i as u64)));
            if half {
                picture.halve();
            }
        }
        self.seen = seen;
        Ok(())
    }

    /// The views that the scene is compared with, at times that are `shift` seconds later than they were.
    pub(super) fn views(&self, frames: &dyn Frames, shift: f64, background: [f32; 3]) -> Vec<View<'_, f32>> {
        let later = |f: &Flow| -> Time { Time(f.to.0 + shift) };
        let views = self.seen.iter().zip(&self.pictures).zip(self.cameras.iter().zip(&self.times));
        let views = views.zip(&self.tracks);
        views
            .map(|(((&i, picture), (camera, time)), tracks)| View {
                camera,
                t: Time(time.0 + shift),
                background,
                truth: &picture.color,
                mask: picture.mask.as_ref(),
                weight: picture.weight.as_ref(),
                depth: picture.depth.as_ref().map(Depth::truth),
                measured: picture.measured(),
                flow: picture.flow.as_ref().map(|f| FlowTruth { to: later(f), ..f.truth() }),
                tracks: tracks.as_ref().map(|f| FlowTruth { to: later(f), ..f.truth() }),
                frame: i,
                rig: frames.rig(i),
                shutter: picture.shutter,
            })
            .collect()
    }

    /// Remembers which images a device kept in the step that used them.
    pub(super) fn remember(&mut self, holds: Holds<'_>) {
        for ((&i, &half), picture) in self.seen.iter().zip(&self.halved).zip(&self.pictures) {
            let (color, weighted) = (&picture.color, picture.weight.is_some());
            if holds(i, [color.width, color.height], weighted) {
                self.kept.insert((i, half), weighted);
            }
        }
    }

    /// Whether a frame's image was kept.
    pub(super) fn is_kept(&self, frame: usize, half: bool) -> bool {
        self.kept.contains_key(&(frame, half))
    }

    /// Lets every image be loaded again: another loss may need more of them.
    pub(super) fn forget(&mut self) {
        self.kept.clear();
    }

    /// The frames' numbers.
    pub(super) fn seen(&self) -> &[usize] {
        &self.seen
    }
}

/// Gives an image its shape, and nothing else.
fn leave_out(picture: &mut Picture, [width, height]: [usize; 2], weighted: bool) {
    let mut color = std::mem::take(&mut picture.color);
    color.data.clear();
    (color.channels, color.width, color.height) = (3, width, height);
    let weight = weighted.then(|| Planes { channels: 1, height, width, data: Vec::new() });
    *picture = Picture { color, weight, ..Picture::default() };
}

/// The displacements of the tracked points in frame i, to another training frame of its camera that sees some of them:
/// flow that is known in their pixels alone. `None`: no such points.
fn tracks(frames: &dyn Frames, i: usize, half: bool, rng: Rng) -> Option<Flow> {
    let own = frames.tracked(i)?;
    let others = (0..frames.len()).filter(|&j| {
        let other = || frames.tracked(j).is_some_and(|o| own.tracks.shares(own.frame, o.frame));
        frames.rig(j) == frames.rig(i) && other()
    });
    let others: Vec<usize> = others.collect();
    let to = *others.get(rng.below(0, others.len().max(1)))?;
    let [here, there] = [i, to].map(|k| match half {
        true => frames.camera(k).downscaled(2),
        false => frames.camera(k).clone(),
    });
    let then = frames.tracked(to)?;
    let mut vectors = Planes::new(3, here.height, here.width);
    for [from, arrives] in own.tracks.pairs(own.frame, then.frame) {
        let start = own.tracks.in_view(from, own.source, &here);
        let (Some(p), Some(q)) = (start, own.tracks.in_view(arrives, then.source, &there)) else { continue };
        if !(0.0..here.width as f64).contains(&p[0]) || !(0.0..here.height as f64).contains(&p[1]) {
            continue;
        }
        let way = [q[0] - p[0], q[1] - p[1], 1.0];
        let pixel = p[1] as usize * here.width + p[0] as usize;
        way.iter().enumerate().for_each(|(c, w)| vectors.plane_mut(c)[pixel] = *w as f32);
    }
    Some(Flow { to: frames.time(to), camera: there, vectors })
}
