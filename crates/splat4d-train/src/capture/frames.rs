//! Posed images by number, the input of initialisation and training. Captures on disk and synthetic ones in tests both
//! serve.

use super::depth::{self, DepthKind};
use super::evidence::Agreement;
use super::shutter::Shutter;
use super::tracks::Tracks;
use crate::Result;
use splat4d::scene::{Camera, Planes, Time};

/// One image, loaded.
#[derive(Clone, Debug, Default)]
pub struct Picture {
    /// 3 channels in [0, 1].
    pub color: Planes<f32>,
    /// 1 channel, 1 = foreground.
    pub mask: Option<Planes<f32>>,
    /// 1 channel, 0 = a pixel that the lens never filled and that must not count.
    pub weight: Option<Planes<f32>>,
    /// Its depth, where known.
    pub depth: Option<Depth>,
    /// Depth of the capture's measured geometry, [1, h, w]; 0: not measured.
    pub measured: Option<Planes<f32>>,
    /// Its optical flow, where known.
    pub flow: Option<Flow>,
    /// Its shutter, where that is not ideal.
    pub shutter: Option<Shutter>,
}

/// Known depth of an image, for a loss.
#[derive(Clone, Copy, Debug)]
pub struct DepthTruth<'a, F = f32> {
    /// [1, h, w]; 0: not known.
    pub values: &'a Planes<F>,
    /// Their kind.
    pub kind: DepthKind,
}

/// Known depth of an image.
#[derive(Clone, Debug)]
pub struct Depth {
    /// [1, h, w]; 0: not known.
    pub values: Planes<f32>,
    /// Their kind.
    pub kind: DepthKind,
}

impl Depth {
    /// As losses take it.
    pub(crate) fn truth(&self) -> DepthTruth<'_> {
        DepthTruth { values: &self.values, kind: self.kind }
    }
}

/// Halves a depth map: means of four pixels on one surface.
fn halve_depth(map: &mut Planes<f32>) {
    map.data = depth::reduce(&map.data, map.width, map.height, 2);
    (map.width, map.height) = (map.width / 2, map.height / 2);
}

/// Known optical flow of an image, for a loss.
#[derive(Clone, Copy, Debug)]
pub struct FlowTruth<'a, F = f32> {
    /// When the pixels arrive.
    pub to: Time,
    /// From where they are seen then.
    pub camera: &'a Camera,
    /// [3, h, w]: u right, v down in pixels, and 1 where they are known.
    pub vectors: &'a Planes<F>,
}

/// The tracks of a frame's camera.
#[derive(Clone, Copy, Debug)]
pub struct Tracked<'a> {
    /// All of them.
    pub tracks: &'a Tracks,
    /// The frame's number in the capture.
    pub frame: usize,
    /// The camera of the image file, in whose pixels they are.
    pub source: &'a Camera,
}

/// Known optical flow of an image.
#[derive(Clone, Debug)]
pub struct Flow {
    /// When the pixels arrive.
    pub to: Time,
    /// From where they are seen then.
    pub camera: Camera,
    /// [3, h, w]: u right, v down in pixels, and 1 where they are known.
    pub vectors: Planes<f32>,
}

impl Flow {
    /// As losses take it.
    pub(crate) fn truth(&self) -> FlowTruth<'_> {
        FlowTruth { to: self.to, camera: &self.camera, vectors: &self.vectors }
    }

    /// At half the size, pixels are twice as large.
    fn halve(&mut self) {
        self.vectors.halve();
        self.camera = self.camera.downscaled(2);
        let n = self.vectors.pixels();
        self.vectors.data[..2 * n].iter_mut().for_each(|v| *v *= 0.5);
    }
}

impl Picture {
    /// The measured depth, as losses take it.
    pub(crate) fn measured(&self) -> Option<DepthTruth<'_>> {
        self.measured.as_ref().map(|values| DepthTruth { values, kind: DepthKind::Metric })
    }

    /// Half the size: the mean of 2x2 boxes, an odd last row or column left out (as `Camera::downscaled`).
    pub(crate) fn halve(&mut self) {
        self.color.halve();
        self.mask.as_mut().map(Planes::halve);
        self.weight.as_mut().map(Planes::halve);
        let maps = self.depth.as_mut().map(|d| &mut d.values).into_iter().chain(&mut self.measured);
        maps.for_each(halve_depth);
        self.flow.as_mut().map(Flow::halve);
    }
}

/// The images a scene is trained on.
pub trait Frames: Send + Sync {
    /// Count.
    fn len(&self) -> usize;
    /// Whether there is none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// From where frame i was taken.
    fn camera(&self, i: usize) -> &Camera;
    /// When.
    fn time(&self, i: usize) -> Time;
    /// By which camera of the rig.
    fn rig(&self, i: usize) -> usize;
    /// The frame's name in messages.
    fn name(&self, i: usize) -> String;
    /// Whether frames have foreground masks.
    fn has_masks(&self) -> bool {
        false
    }
    /// Whether frames have metric depth maps.
    fn has_depth(&self) -> bool {
        false
    }
    /// Agreement of matches between frames of moving cameras with a static scene; `None`: undetermined.
    fn agreement(&self) -> Option<Agreement> {
        None
    }
    /// The tracks of the camera of frame i.
    fn tracked(&self, _i: usize) -> Option<Tracked<'_>> {
        None
    }
    /// Reads frame i.
    fn load(&self, i: usize, out: &mut Picture) -> Result<()>;
    /// These will be requested soon; must not change any result.
    fn prefetch(&self, _frames: &[usize]) {}
}

/// Half the time between two images of a camera, seconds: the median over the frames (camera, time); 0 where no camera
/// has two.
pub(crate) fn half_frame(frames: impl Iterator<Item = (usize, f64)>) -> f64 {
    let mut all: Vec<(usize, f64)> = frames.collect();
    all.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut gaps: Vec<f64> = all.windows(2).filter(|w| w[0].0 == w[1].0).map(|w| w[1].1 - w[0].1).collect();
    gaps.sort_by(f64::total_cmp);
    0.5 * gaps.get(gaps.len() / 2).copied().unwrap_or(0.0)
}

/// Times of a rig whose shutters do not open at once: times less than half a frame apart are one.
pub(crate) fn moments(frames: impl Iterator<Item = (usize, f64)> + Clone) -> usize {
    let half = half_frame(frames.clone());
    let mut times: Vec<f64> = frames.map(|(_, t)| t).collect();
    times.sort_by(f64::total_cmp);
    let (mut count, mut first) = (0, f64::NEG_INFINITY);
    for t in times {
        if t - first > half {
            (count, first) = (count + 1, t);
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shutters_that_do_not_open_at_once_share_their_times() {
        let rig = |late: f64| (0..12).map(move |i| (i % 3, (i / 3) as f64 + late * (i % 3) as f64));
        assert_eq!([moments(rig(0.0)), moments(rig(0.2)), moments(rig(1.0))], [4, 4, 6]);
        assert_eq!((half_frame(rig(0.2)), half_frame([(0, 1.0), (1, 3.0)].into_iter())), (0.5, 0.0));
    }

    #[test]
    fn half_an_image_is_the_mean_of_its_boxes() {
        let mut p = Planes::from_interleaved(1, 3, 5, &(0..15).map(|x| x as f32).collect::<Vec<_>>());
        p.halve();
        assert_eq!((p.height, p.width, p.data), (1, 2, vec![3.0, 5.0]));
    }
}
