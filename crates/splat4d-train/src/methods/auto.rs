//! `--motion auto`: examines the capture and selects the first program that states why it suits.

use super::{Method, TrainContext};
use crate::Result;
use crate::capture::Agreement;
use crate::capture::frames::{Frames, Picture};
use splat4d::scene::Planes;

/// Cameras of the rig that are examined, and pairs of neighbouring frames of each.
const SAMPLED: (usize, usize) = (4, 8);
/// A pixel that changes by more than this from frame to frame (mean of the channels, in [0, 1]) has moved: above the
/// noise of ordinary cameras.
const CHANGED: f32 = 0.06;
/// Times from which on a capture is long.
const LONG: usize = 600;

/// The motion that a capture shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CaptureStats {
    /// Times.
    pub times: usize,
    /// Training images a time.
    pub cameras: f64,
    /// Share of the pixels of fixed cameras that change from one of their frames to the next; none where undetermined.
    pub changing: Option<f64>,
    /// How far matches of frames of a moving camera agree with a static scene; none where cameras are fixed, or too
    /// little matches.
    pub agreement: Option<Agreement>,
    /// Fewest images of fixed cameras at a time.
    pub fewest: usize,
    /// Images have masks.
    pub masks: bool,
    /// Images have metric depth maps, which are read.
    pub depth: bool,
    /// The end of the capture is kept from training, to be predicted.
    pub predicted: bool,
}

impl CaptureStats {
    /// Examines the training frames of a capture.
    pub(crate) fn of(plan: &TrainContext, frames: &dyn Frames) -> Result<Self> {
        let looks = plan.times > 1 && plan.fixed_cameras > 0;
        Ok(Self {
            times: plan.times,
            cameras: frames.len() as f64 / plan.times.max(1) as f64,
            changing: if looks { motion_energy(frames)? } else { None },
            agreement: if plan.times > 1 && plan.fixed_cameras == 0 { frames.agreement() } else { None },
            fewest: plan.moments.iter().map(|m| m.1).min().unwrap_or(0),
            masks: frames.has_masks(),
            depth: frames.has_depth(),
            predicted: plan.predicted,
        })
    }

    /// Whether the capture is a long one.
    pub(crate) fn is_long(&self) -> bool {
        self.times >= LONG
    }

    /// The cameras that record a frame, in words.
    pub(crate) fn cameras_in_words(&self) -> String {
        if self.cameras < 1.5 { "one camera records".to_owned() } else { format!("{:.1} cameras record", self.cameras) }
    }
}

/// A model and the reason for it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Choice {
    /// The model's name.
    pub motion: &'static str,
    /// One sentence.
    pub why: String,
}

/// Chooses for the training frames of a capture: the first of the programs that states why it suits.
pub(crate) fn choose(
    plan: &TrainContext,
    programs: impl IntoIterator<Item = (&'static str, Box<dyn Method>)>,
    frames: &dyn Frames,
) -> Result<Choice> {
    let seen = CaptureStats::of(plan, frames)?;
    let mut programs = programs.into_iter();
    let choice = programs.find_map(|(motion, program)| Some(Choice { motion, why: program.suits(&seen)? }));
    Ok(choice.expect("one program suits whatever no other does"))
}

/// Share of the pixels of fixed cameras that change from one of their frames to the next; `None`: no camera has two.
fn motion_energy(frames: &dyn Frames) -> Result<Option<f64>> {
    let mut rigs: std::collections::BTreeMap<usize, Vec<usize>> = std::collections::BTreeMap::new();
    for i in 0..frames.len() {
        rigs.entry(frames.rig(i)).or_default().push(i);
    }
    let mut rigs: Vec<Vec<usize>> = rigs.into_values().filter(|r| r.len() > 1).collect();
    for rig in &mut rigs {
        rig.sort_by(|&a, &b| frames.time(a).0.total_cmp(&frames.time(b).0));
    }
    let step = rigs.len().div_ceil(SAMPLED.0).max(1);
    let (mut changed, mut pixels) = (0usize, 0usize);
    let mut pair = [Picture::default(), Picture::default()];
    for rig in rigs.iter().step_by(step) {
        let stride = (rig.len() - 1).div_ceil(SAMPLED.1).max(1);
        for n in (0..rig.len() - 1).step_by(stride) {
            for (picture, &i) in pair.iter_mut().zip(&rig[n..n + 2]) {
                frames.load(i, picture)?;
                // Half the size and noise is half as strong.
                picture.halve();
            }
            changed += changes(&pair[0].color, &pair[1].color);
            pixels += pair[0].color.plane(0).len();
        }
    }
    Ok((pixels > 0).then(|| changed as f64 / pixels as f64))
}

fn changes(a: &Planes<f32>, b: &Planes<f32>) -> usize {
    let difference = |i: usize| (0..3).map(|c| (a.plane(c)[i] - b.plane(c)[i]).abs()).sum::<f32>() / 3.0;
    (0..a.plane(0).len().min(b.plane(0).len())).filter(|&i| difference(i) > CHANGED).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::frames::moments;
    use crate::recipe::Recipe;
    use splat4d::math::Se3;
    use splat4d::scene::{Camera, Time};

    /// Grey images with a bright square that moves, or does not.
    struct Made {
        cameras: usize,
        times: usize,
        speed: usize,
        masks: bool,
        depth: bool,
        camera: Camera,
        /// Seconds by which each camera is later than the one before.
        late: f64,
        /// Share of the capture that is seen.
        observe: f64,
    }

    impl Made {
        fn new(cameras: usize, times: usize, speed: usize, masks: bool) -> Self {
            let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
            Self {
                cameras,
                times,
                speed,
                masks,
                depth: false,
                camera: Camera::with_fov_y(pose, 0.9, 64, 48),
                late: 0.0,
                observe: 1.0,
            }
        }

        fn choose(&self, fixed: bool) -> Choice {
            let recipe = Recipe::default().with(|r| r.capture.observe = self.observe);
            let plan = TrainContext {
                extent: 1.0,
                center: [0.0; 3],
                clip: [0.0, 1.0],
                fps: 30.0,
                times: moments((0..self.len()).map(|i| (self.rig(i), self.time(i).0))),
                fixed_cameras: if fixed { self.cameras } else { 0 },
                moments: (0..self.times).map(|t| (t as f64 / 30.0, if fixed { self.cameras } else { 0 })).collect(),
                masks: self.masks,
                ..recipe.plan()
            };
            choose(&plan, recipe.programs(), self).unwrap()
        }
    }

    impl Frames for Made {
        fn len(&self) -> usize {
            self.cameras * self.times
        }
        fn camera(&self, _: usize) -> &Camera {
            &self.camera
        }
        fn time(&self, i: usize) -> Time {
            Time((i / self.cameras) as f64 / 30.0 + self.late * (i % self.cameras) as f64)
        }
        fn rig(&self, i: usize) -> usize {
            i % self.cameras
        }
        fn name(&self, i: usize) -> String {
            i.to_string()
        }
        fn has_masks(&self) -> bool {
            self.masks
        }
        fn has_depth(&self) -> bool {
            self.depth
        }
        fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
            out.color = Planes::new(3, 48, 64);
            out.color.data.fill(0.4);
            let left = 8 + self.speed * (i / self.cameras) % 40;
            for c in 0..3 {
                for y in 10..20 {
                    (left..left + 10).for_each(|x| out.color.plane_mut(c)[64 * y + x] = 0.9);
                }
            }
            Ok(())
        }
    }

    #[test]
    fn auto_selects_by_the_capture_and_states_its_reason() {
        let is = |made: Made, fixed: bool, motion: &str, word: &str| {
            let choice = made.choose(fixed);
            assert!(choice.motion == motion && choice.why.contains(word), "{choice:?}");
        };
        is(Made::new(6, 1, 4, true), true, "still", "the same time");
        is(Made::new(6, 10, 0, true), true, "still", "0.000 %");
        is(Made::new(6, 10, 4, true), true, "spacetime", "6 cameras");
        // Shutters that do not open at once: by little, and by up to a frame.
        is(Made { late: 0.002, ..Made::new(6, 10, 4, true) }, true, "spacetime", "6 cameras");
        is(Made { late: 0.005, ..Made::new(6, 10, 4, true) }, true, "spacetime", "4 cameras");
        // What is to continue needs Gaussians that last, where cameras can follow them.
        is(Made { observe: 0.8, ..Made::new(6, 10, 4, true) }, true, "tracked", "prediction");
        is(Made { observe: 0.8, ..Made::new(2, 10, 4, true) }, true, "control", "2.0 cameras");
        is(Made { observe: 0.8, ..Made::new(1, 50, 4, true) }, false, "control", "one camera");
        is(Made::new(1, 50, 4, true), false, "control", "one camera");
        is(Made::new(1, 50, 4, false), false, "deform-mlp", "one camera");
        is(Made::new(2, 700, 4, true), true, "deform-mlp", "of 700");
        // What depth maps show of every time is where it is, whatever moves the camera.
        is(Made { depth: true, ..Made::new(1, 50, 4, false) }, false, "spacetime", "depth");
        is(Made { depth: true, ..Made::new(2, 700, 4, false) }, true, "spacetime", "depth");
        is(Made { depth: true, observe: 0.8, ..Made::new(1, 50, 4, true) }, false, "control", "one camera");
    }
}
