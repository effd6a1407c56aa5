//! Removal of floaters: Gaussians that at most one camera sees and that are close to another camera.
//!
//! Images of one camera do not determine depth, so Gaussians that only one camera sees drift along its rays. Some stay
//! close to other cameras, where they cover every view between the cameras. Their content is learnt again where others
//! see it, or farther away. A Gaussian in front of the camera that sees it may be correct and is kept, as are those
//! that two cameras see.

use super::{At, Change, Context, DensifySettings, Every, Maintenance, RunOrder};
use crate::Result;
use crate::capture::frames::Frames;
use crate::settings::settings;
use crate::train_state::TrainState;
use rayon::prelude::*;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::se3::{norm, sub};
use splat4d::scene::splats::SPLAT_OPACITY;
use splat4d::scene::{Camera, RowEdit, Rows, Space, Time};

settings! {
    /// Removal of floaters: Gaussians close to a camera that does not see them.
    #[derive(Copy)]
    pub struct FloaterSettings
    when (On("floaters.interval")) {
        /// Iterations between removals of Gaussians that at most one camera sees and that are close to another one; 0:
        /// never.
        interval: usize = 100 => any().unit("iterations").switch();
        /// Distance below which a Gaussian is close to a camera that does not see it, share of the median viewing
        /// distance.
        distance: f64 = 0.4 => positive();
    }
}

/// Of fewer places most of a scene is seen from one alone: nothing is removed (of four real cameras it cost 0.4 to 1.5
/// dB).
const FEWEST: usize = 8;
/// Times, evenly over the clip, at which Gaussians are examined; each counts where it is most visible.
const MOMENTS: usize = 5;

/// Rows in a task.
const NEIGHBOURS: usize = 1024;

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Floaters {
    /// How.
    pub settings: FloaterSettings,
    /// When: while the cloud grows, which closes the holes.
    pub steps: Every,
}

impl Floaters {
    /// With these settings; `None`: never.
    pub(crate) fn of(settings: FloaterSettings, densify: &DensifySettings) -> Option<Self> {
        let steps = Every { interval: settings.interval, ..densify.steps() };
        (settings.interval > 0).then_some(Self { settings, steps })
    }
}

impl Maintenance for Floaters {
    fn name(&self) -> &str {
        "floaters"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Remove
    }

    fn due(&self, at: &At) -> bool {
        self.steps.is_due(at.step)
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.steps)
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let places = Places::of(c.frames);
        if places.cameras.len() < FEWEST {
            return Ok(Change::default());
        }
        let before = train_state.scene().len();
        for layer in 0..train_state.scene().layers.len() {
            let keep = places.supported(train_state.scene(), layer, self.settings.distance);
            // A layer without rows could never grow again.
            if keep.contains(&false) && keep.contains(&true) {
                train_state.apply(layer, &RowEdit::prune(Space::Gaussians, keep.into_iter()), &c.rng("floaters"));
            }
        }
        Ok(Change { removed: before - train_state.scene().len(), ..Change::default() })
    }
}

/// From where images were taken, each place once.
struct Places<'a> {
    cameras: Vec<(&'a Camera, [f64; 3])>,
}

impl<'a> Places<'a> {
    fn of(frames: &'a dyn Frames) -> Self {
        let mut cameras: Vec<(&Camera, [f64; 3])> = Vec::new();
        let mut last = std::collections::BTreeMap::new();
        for i in 0..frames.len() {
            let camera = frames.camera(i);
            // A camera is static, or is elsewhere in every image: comparing it with its last place is enough.
            if last.insert(frames.rig(i), camera).is_none_or(|l| l.cam_from_world != camera.cam_from_world) {
                cameras.push((camera, camera.cam_from_world.inverse().translation));
            }
        }
        Self { cameras }
    }

    /// The median distance at which cameras see these; `None`: they see none.
    fn depth(&self, points: &[[f64; 3]]) -> Option<f64> {
        /// Samples of the median.
        const AMONG: usize = 1000;
        let some = points.iter().step_by(points.len().div_ceil(AMONG).max(1));
        let mut all: Vec<f64> =
            some.flat_map(|&x| self.cameras.iter().filter_map(move |(camera, _)| seen(camera, x))).collect();
        let middle = all.len() / 2;
        (!all.is_empty()).then(|| *all.select_nth_unstable_by(middle, f64::total_cmp).1)
    }

    /// For each Gaussian of a layer whether it stays.
    fn supported(&self, scene: &Scene<f32>, layer: usize, distance: f64) -> Vec<bool> {
        let layer = &scene.layers[layer];
        let rows = layer.params.len();
        let mut most = vec![(f32::NEG_INFINITY, [0.0f64; 3]); rows];
        for k in 0..MOMENTS {
            let share = k as f64 / (MOMENTS - 1) as f64;
            let t = Time(scene.clip[0] + share * (scene.clip[1] - scene.clip[0]));
            let now = Evaluation::of_layer(layer, Space::Gaussians, Rows::All, t);
            let out = now.tape(0).out();
            for (r, best) in most.iter_mut().enumerate() {
                let opacity = out.get(r, SPLAT_OPACITY);
                if opacity > best.0 {
                    *best = (opacity, out.read::<3>(r, 0).map(f64::from));
                }
            }
        }
        let points: Vec<[f64; 3]> = most.into_iter().map(|(_, x)| x).collect();
        let Some(depth) = self.depth(&points) else { return vec![true; rows] };
        let stays = |hint: &mut [usize; 2], x: [f64; 3]| {
            if hint[0] != hint[1] && hint.iter().all(|&k| seen(self.cameras[k].0, x).is_some()) {
                return true;
            }
            let (mut views, mut veils) = (0, false);
            for (k, (camera, place)) in self.cameras.iter().enumerate() {
                if seen(camera, x).is_some() {
                    hint[views] = k;
                    views += 1;
                    if views > 1 {
                        return true;
                    }
                } else {
                    veils |= norm(sub(x, *place)) < distance * depth;
                }
            }
            !veils
        };
        // Rows are neighbours: two cameras that see one of them mostly see the next one, and the others are not tested.
        let rows = points.par_chunks(NEIGHBOURS).flat_map_iter(|points| {
            let mut hint = [0; 2];
            points.iter().map(move |&x| stays(&mut hint, x))
        });
        rows.collect()
    }
}

/// The depth at which a camera sees a point; `None`: it does not.
fn seen(camera: &Camera, x: [f64; 3]) -> Option<f64> {
    let ([u, v], z) = camera.project(x)?;
    let inside = (0.0..camera.width as f64).contains(&u) && (0.0..camera.height as f64).contains(&v);
    inside.then_some(z)
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, scene};
    use super::*;
    use crate::step::tests::Made;
    use splat4d::scene::GEOMETRY;

    #[test]
    fn floaters_before_a_camera_are_removed() {
        let frames = Made::new(8, 1, 16);
        let places = Places::of(&frames);
        assert_eq!(places.cameras.len(), 8);
        // Where one camera alone looks, as near to another one as can be found; right before a camera that sees it; all
        // else.
        let near = |x: [f64; 3]| {
            let unseen = |(camera, _): &&(&Camera, [f64; 3])| seen(camera, x).is_none();
            let to = |(_, place): &(&Camera, [f64; 3])| norm(sub(x, *place));
            places.cameras.iter().filter(unseen).map(to).fold(f64::INFINITY, f64::min)
        };
        let views = |x: [f64; 3]| places.cameras.iter().filter(|(camera, _)| seen(camera, x).is_some()).count();
        let mut s = scene(60);
        let depth = 4.0;
        let grid = (0..40usize.pow(3)).map(|k| [k % 40, k / 40 % 40, k / 1600].map(|v| (v as f64 - 19.5) * 0.25));
        let floater = grid.filter(|&x| views(x) == 1).min_by(|a, b| near(*a).total_cmp(&near(*b))).unwrap();
        let ahead = {
            let (camera, place) = places.cameras[0];
            let forward = camera.forward();
            std::array::from_fn(|k| place[k] + 0.1 * depth * forward[k])
        };
        let g = &mut s.layers[0].params[GEOMETRY];
        (0..60).for_each(|r| {
            let x: [f32; 3] = g.read(r, 0);
            g.write(r, 0, x.map(|v| 0.2 * v));
        });
        g.write(3, 0, floater.map(|v| v as f32));
        g.write(4, 0, ahead.map(|v: f64| v as f32));
        let c = Context { frames: &frames, ..context(Limits { cap: 60, extent: 4.0, min_opacity: 0.005 }, 0, 0) };
        let settings = FloaterSettings { interval: 10, distance: 1.1 * near(floater) / depth };
        let mut train_state = TrainState::new(s);
        let change = Floaters { settings, steps: Every::NEVER }.run(&mut train_state, &c).unwrap();
        assert_eq!((change.removed, train_state.scene().len()), (1, 59));
        let g = &train_state.scene().layers[0].params[GEOMETRY];
        let left: Vec<[f32; 3]> = (0..59).map(|r| g.read(r, 0)).collect();
        assert!(!left.contains(&floater.map(|v| v as f32)) && left.contains(&ahead.map(|v| v as f32)));
        let again = Floaters { settings, steps: Every::NEVER }.run(&mut train_state, &c).unwrap();
        assert_eq!(again.removed, 0);
    }
}
