//! Gaussians to render around each key time: the temporal filter of 4DGS-1K (Yuan et al. 2025, §4.2), united with the
//! lifespans that no key time meets.

use super::temporal::Spatial;
use super::weighing::Weighing;
use crate::capture::frames::Frames;
use crate::sampler::Timeline;
use crate::{Error, Result};
use splat4d::layers::Scene;
use splat4d::render::Antialias;
use splat4d::scene::{KeyMasks, Time};
use std::sync::Arc;

/// Settings of masks.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct MaskConfig {
    /// Frames of the clip between key times (0 counts as 1); the last gap may be shorter.
    pub interval: usize,
    /// As the scene was trained.
    pub antialias: Antialias,
}

impl Default for MaskConfig {
    /// A key every fifth frame.
    fn default() -> Self {
        Self { interval: 5, antialias: Antialias::Off }
    }
}

/// Key times this many frames apart, for training frames at `times` (rising) of a clip of `fps` frames a second: always
/// times of training frames, the first and the last among them.
pub(super) fn keys(interval: usize, times: &[f64], fps: f64) -> Vec<f64> {
    let [Some(&first), Some(&last)] = [times.first(), times.last()] else { return Vec::new() };
    let frames = interval.max(1) as f64;
    let (gap, mut keys, mut next) = (frames / fps, Vec::new(), first);
    // Every key is the time of a frame, so that there are never more keys than times.
    for &t in times {
        if t >= next - 0.5 / fps {
            keys.push(t);
            next = first + (((t - first) / gap + 0.5 / frames).floor() + 1.0) * gap;
        }
    }
    keys.extend([first, last]);
    keys.sort_by(f64::total_cmp);
    keys.dedup();
    keys
}

/// Gives every layer of `scene` masks: at a key time, the Gaussians that any training view of that time shows (weight
/// above 0, behind what hides them). One whose lifespan is between two key times and meets none is admitted at both;
/// one that is alive only before or after all training frames at none. Existing masks of the layers are ignored.
/// `progress` is called with the finished and the total number of views.
///
/// Errors: there is no frame.
pub(crate) fn key_masks(
    scene: &mut Scene<f32>,
    frames: &dyn Frames,
    config: &MaskConfig,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<()> {
    if frames.is_empty() {
        return Err(Error::input("there are no training views to see Gaussians in")
            .remedy("Hold out fewer views with --hold-out"));
    }
    let timeline = Timeline::new(frames);
    let times: Vec<f64> = (0..timeline.times()).map(|k| frames.time(timeline.at(k)[0] as usize).0).collect();
    let fps = if scene.fps > 0.0 { scene.fps } else { splat4d::scene::time::DEFAULT_FPS };
    let keys = keys(config.interval, &times, fps);
    scene.layers.iter_mut().for_each(|l| l.masks = None);
    let mut masks: Vec<KeyMasks> = scene.layers.iter().map(|l| KeyMasks::new(keys.clone(), l.params.len())).collect();

    let at: Vec<usize> = keys.iter().map(|k| times.partition_point(|t| t < k)).collect();
    let total = at.iter().map(|&k| timeline.at(k).len()).sum();
    let (mut weighing, mut done) = (Weighing::new(Spatial::Share, config.antialias), 0);
    for (key, &k) in at.iter().enumerate() {
        weighing.at(scene, Time(times[k]));
        for &frame in timeline.at(k) {
            weighing.add(scene, frames.camera(frame as usize));
            done += 1;
            progress(done, total);
        }
        for (layer, masks) in masks.iter_mut().enumerate() {
            let seen = weighing.layer(layer).iter().enumerate().filter(|(_, s)| **s > 0.0);
            seen.for_each(|(row, _)| masks.set(key, row));
        }
    }
    for (layer, mut masks) in scene.layers.iter_mut().zip(masks) {
        for (row, [from, to]) in layer.spans().into_iter().enumerate().filter(|(_, [from, to])| from <= to) {
            // The keys around its first time; it meets none if it is over before the later one.
            let [l, r] = masks.keys_at(from);
            if l != r && to < keys[r] {
                masks.set(l, row);
                masks.set(r, row);
            }
        }
        layer.masks = Some(Arc::new(masks));
    }
    Ok(())
}
