//! `Corrections`: learnt corrections of camera poses, focal lengths, lenses and time offsets.
//!
//! A correction of a pose is a twist ξ = (ρ, θ) in the camera's axes, `exp(ξ)·cam_from_world`; all frames of a fixed
//! camera share one. A correction of a focal length is a share of it, of a camera. A correction of a lens is the shares
//! by which r² and r⁴ move its image corners outwards. A correction of a clock is a shift of all times of a camera. Images do not determine the absolute position, scale and start time of the scene, so the
//! cameras' mean motion, mean scale and median time offset are fixed. The median is used because a single wrong offset
//! must not shift the correct ones.

use crate::capture::Frame;
use crate::optim::step_row;
use crate::settings::settings;
use serde_json::{Value, json};
use splat4d::math::Se3;
use splat4d::math::se3::{cross, dot, mat_vec, norm, sub, transpose};
use splat4d::scene::{Camera, Intrinsics, Lens, Table, Time};

settings! {
    /// Refinement of cameras during training: poses, focal lengths, lenses and time offsets.
    pub struct RefineSettings {
        /// Learn a correction of every training camera's pose, one for all frames of a fixed camera. The cameras' mean
        /// motion and scale stay fixed. Held-out views are also measured aligned.
        poses: bool = false;
        /// Find the time offset of every training camera: searched first, then learned; the median of all offsets stays
        /// fixed. Held-out views are also measured aligned.
        times: bool = false => any().when(IsNot("run.motion", &["still", "tracked"]));
        /// Learn a correction of every training camera's focal length, with a prior to the stated one.
        focal: bool = false;
        /// Learn the radial distortion (k1, k2) that remains of every lens: training cameras whose files state the same
        /// size, focal lengths and distortion have one lens.
        lens: bool = false;
        /// Rate of rotations at the start; 50 views per camera suffice for half a degree. Three times as much is as
        /// exact (studies/records/2026-11-26-refine.md).
        rotation_init: f64 = 1e-3 => positive().unit("radians").when(On("refine.poses"));
        /// Rate of rotations at the end. 1e-5 left 1.5 times the error (studies/records/2026-11-26-refine.md).
        rotation_final: f64 = 1e-4 => positive().unit("radians").when(On("refine.poses"));
        /// Rate of positions at the start.
        position_init: f64 = 1e-3 => positive().unit("extents").when(On("refine.poses"));
        /// Rate of positions at the end.
        position_final: f64 = 1e-4 => positive().unit("extents").when(On("refine.poses"));
        /// Searches of time offsets: each compares every camera's images with the scene at shifted times. 4 to 20 are
        /// equally exact (studies/records/2026-11-26-refine.md).
        searches: usize = 8 => any().when(On("refine.times"));
        /// Rate of focal lengths at the start, relative.
        focal_init: f64 = 1e-3 => positive().when(On("refine.focal"));
        /// Rate of focal lengths at the end.
        focal_final: f64 = 1e-5 => positive().when(On("refine.focal"));
        /// Rate of distortion at the start, share by which corners of the image move. Our choice, half of the focal
        /// lengths': a lens has the images of several cameras.
        lens_init: f64 = 5e-4 => positive().when(On("refine.lens"));
        /// Rate of distortion at the end.
        lens_final: f64 = 1e-5 => positive().when(On("refine.lens"));
        /// Rate of time offsets at the start, after the last search.
        time_init: f64 = 0.05 => positive().unit("frames").when(On("refine.times"));
        /// Rate of time offsets at the end.
        time_final: f64 = 1e-3 => positive().unit("frames").when(On("refine.times"));
        /// Largest time offset, and range of the first searches.
        time_limit: f64 = 4.0 => positive().unit("frames").when(On("refine.times"));
        /// Share of the run after which poses, focal lengths and lenses are learned.
        poses_from: f64 = 0.1 => share().when(Any(&[On("refine.poses"), On("refine.focal"), On("refine.lens")]));
        /// Share of the run after which time offsets are searched; the searches are spread up to half of the run.
        times_from: f64 = 0.1 => share().when(On("refine.times"));
        /// Share of the run after which cameras are fixed, so that the scene converges.
        until: f64 = 0.8 => share().when(Any(&[On("refine.poses"), On("refine.focal"), On("refine.lens"), On("refine.times")]));
        /// Steps to align every held-out camera before its second measurement.
        align_steps: usize = 100 => any().unit("iterations").when(Any(&[On("refine.poses"), On("refine.focal"), On("refine.times")]));
    }
}

impl RefineSettings {
    /// Whether anything is learnt of cameras.
    pub(crate) fn any(&self) -> bool {
        self.poses || self.focal || self.lens || self.times
    }
}

/// Terms of the exponential's series: twists are small, and below one radian the next term is lost in rounding.
const TERMS: usize = 16;
/// Share of a frame by which cameras' times differ at least. Views at one time share one gradient to it; at times that
/// are hardly different each has its own.
const APART: f64 = 1e-6;

/// Share by which a correction of a focal length or a lens falls back in every step: changes without support in the images decay.
/// Our choice, not swept.
const PULL: f64 = 1e-4;
/// Largest correction of a focal length, a share of it.
const FOCAL_LIMIT: f64 = 0.2;
/// Largest correction of a lens, the same.
const LENS_LIMIT: f64 = 0.2;
/// Share of the run by which clocks were searched: then the scene is sharp enough for gradients to continue. Not swept.
const SEARCHED: f64 = 0.5;
/// Searches over the whole range of time offsets, in frames; later ones search locally in halves.
const WIDE_SEARCHES: usize = 3;
/// Reach and distance of shifts of the later searches, frames.
const NARROW: [f64; 2] = [1.5, 0.5];

/// Names of the tables in a checkpoint.
const TABLES: [&str; 4] = ["refine.poses", "refine.focal", "refine.lens", "refine.times"];
/// Columns of a table of numbers with their moments.
const POSE: usize = 6;
/// And coefficients of a lens.
const LENS: usize = 2;

/// Data of a corrected frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Origin<'a> {
    /// The number of its camera.
    pub rig: usize,
    /// Whether that camera has one pose.
    pub fixed: bool,
    /// As in the capture.
    pub camera: &'a Camera,
    /// Its image file's lens.
    pub lens: Lens,
}

impl<'a> Origin<'a> {
    /// Of a capture's frame; `fixed`: its camera has one pose.
    pub(crate) fn of(frame: &'a Frame, fixed: bool) -> Self {
        Self { rig: frame.camera, fixed, camera: &frame.view, lens: frame.source.lens }
    }

    /// Whether two images are of one lens, as far as is stated.
    pub(crate) fn alike(&self, other: &Self) -> bool {
        let of = |o: &Self| (o.camera.width, o.camera.height, o.camera.intrinsics.fx, o.camera.intrinsics.fy, o.lens);
        of(self) == of(other)
    }
}

/// The scale of a capture, in which rates are stated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scale {
    /// The rig's radius, scene units.
    pub extent: f64,
    /// Seconds between two frames.
    pub frame: f64,
}

/// The gradients of some frames to what is corrected.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StepGrads<'a> {
    /// To left perturbations of poses.
    pub d_cameras: &'a [[f64; 6]],
    /// To logarithms of focal lengths.
    pub d_focals: &'a [f64],
    /// To coefficients of lenses.
    pub d_lenses: &'a [[f64; LENS]],
    /// To times.
    pub d_times: &'a [f64],
}

/// Gradients to what is learnt: the number of a row and its gradient.
#[derive(Clone, Debug, Default)]
pub(crate) struct Gradients {
    /// To twists, by row.
    pub poses: Vec<(usize, [f64; POSE])>,
    /// To shares of focal lengths, by camera.
    pub focal: Vec<(usize, [f64; 1])>,
    /// To shares of corners, by lens.
    pub lens: Vec<(usize, [f64; LENS])>,
    /// To shifts of clocks, by camera.
    pub times: Vec<(usize, [f64; 1])>,
}

/// A search of clocks that is due.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SearchDue {
    /// Which of them.
    pub round: usize,
    /// Largest shift and distance of shifts, seconds.
    pub reach: f64,
    pub step: f64,
}

/// See the module's documentation.
#[derive(Clone, Debug)]
pub struct Corrections {
    settings: RefineSettings,
    scale: Scale,
    /// By frame: the row of its pose.
    rows: Vec<usize>,
    /// By frame: its camera.
    rigs: Vec<usize>,
    /// By frame: its lens, and the squared radius of its image corners.
    lenses: Vec<(usize, f64)>,
    /// By row: the capture's pose, and a frame with it.
    origins: Vec<(Se3, usize)>,
    /// Values 6, moments 12, steps 1; by row.
    poses: Option<Table<f32>>,
    /// Values 1, moments 2, steps 1; by camera.
    focal: Option<Table<f32>>,
    /// Values 2, moments 4, steps 1; by lens.
    lens: Option<Table<f32>>,
    /// As of focal lengths.
    times: Option<Table<f32>>,
    /// Whether the mean of all stays nothing: not where the scene is frozen.
    gauge: bool,
}

impl Corrections {
    /// None for every frame, of `cameras` cameras. `gauge`: the scene learns too.
    pub(crate) fn new(
        settings: &RefineSettings,
        scale: Scale,
        frames: &[Origin<'_>],
        cameras: usize,
        gauge: bool,
    ) -> Self {
        let (mut of_rig, mut origins, mut rows) = (vec![None; cameras], Vec::new(), Vec::new());
        for (i, frame) in frames.iter().enumerate() {
            let known = of_rig[frame.rig].filter(|_| frame.fixed);
            rows.push(known.unwrap_or_else(|| {
                origins.push((frame.camera.cam_from_world, i));
                origins.len() - 1
            }));
            of_rig[frame.rig] = Some(rows[i]);
        }
        let mut known: Vec<usize> = Vec::new();
        let mut lenses = Vec::new();
        for (i, frame) in frames.iter().enumerate() {
            let lens = known.iter().position(|&other| frame.alike(&frames[other])).unwrap_or_else(|| {
                known.push(i);
                known.len() - 1
            });
            lenses.push((lens, corner(frame.camera)));
        }
        let table = |width, rows| Table::new(&[("values", width), ("moments", 2 * width), ("steps", 1)], rows);
        let first = frames.first().map(|f| f.rig);
        // A single camera is its own mean.
        let poses = settings.poses && !(gauge && origins.len() < 2);
        let times = settings.times && !(gauge && frames.iter().all(|f| Some(f.rig) == first));
        Self {
            settings: settings.clone(),
            scale,
            poses: poses.then(|| table(POSE, origins.len())),
            focal: settings.focal.then(|| table(1, cameras)),
            lens: settings.lens.then(|| table(LENS, known.len())),
            lenses,
            times: times.then(|| table(1, cameras)),
            rigs: frames.iter().map(|f| f.rig).collect(),
            rows,
            origins,
            gauge,
        }
    }

    /// All that a checkpoint holds of it.
    pub(crate) fn tables(&self) -> impl Iterator<Item = (&'static str, &Table<f32>)> {
        let all = [&self.poses, &self.focal, &self.lens, &self.times];
        TABLES.into_iter().zip(all).filter_map(|(name, table)| Some((name, table.as_ref()?)))
    }

    /// The same, to read it.
    pub(crate) fn tables_mut(&mut self) -> impl Iterator<Item = (&'static str, &mut Table<f32>)> {
        let all = [&mut self.poses, &mut self.focal, &mut self.lens, &mut self.times];
        TABLES.into_iter().zip(all).filter_map(|(name, table)| Some((name, table.as_mut()?)))
    }

    /// The camera of frame `i`, corrected. Its lens is what remains after images were undistorted.
    pub(crate) fn camera(&self, i: usize, stated: &Camera) -> Camera {
        let moved = self.twist(self.rows[i]).map(|twist| exp(twist).after(&stated.cam_from_world));
        let zoomed = zoomed(&stated.intrinsics, self.zoom(self.rigs[i]));
        let lens = self.coefficients(i).map_or(stated.lens, |[k1, k2]| Lens::Brown {
            k: [k1, k2, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
            s: [0.0; 4],
        });
        Camera { cam_from_world: moved.unwrap_or(stated.cam_from_world), intrinsics: zoomed, lens, ..stated.clone() }
    }

    /// k1 and k2 of the lens of frame `i`, of what remains; `None`: lenses are not learnt.
    fn coefficients(&self, i: usize) -> Option<[f64; LENS]> {
        let (lens, r2) = self.lenses[i];
        let [a, b] = self.lens.as_ref()?.read::<LENS>(lens, 0).map(f64::from);
        Some([a / r2, b / (r2 * r2)])
    }

    /// The share by which the focal lengths of a camera are longer than stated.
    fn zoom(&self, rig: usize) -> f64 {
        self.focal.as_ref().map_or(0.0, |t| f64::from(t.get(rig, 0)))
    }

    /// The time of frame `i`, corrected.
    pub(crate) fn time(&self, i: usize, stated: Time) -> Time {
        let Some(times) = &self.times else { return stated };
        let rig = self.rigs[i];
        Time(stated.0 + f64::from(times.get(rig, 0)) + APART * self.scale.frame * rig as f64)
    }

    fn twist(&self, row: usize) -> Option<[f64; POSE]> {
        self.poses.as_ref().map(|p| p.read::<POSE>(row, 0).map(f64::from))
    }

    /// The gradients to what is learnt, of those of some frames to their cameras, focal lengths and times: the
    /// backward pass of
    /// [`camera`](Self::camera) and [`time`](Self::time).
    pub(crate) fn gradients(&self, frames: &[usize], report: &StepGrads<'_>) -> Gradients {
        let mut out = Gradients::default();
        for (&i, &d) in frames.iter().zip(report.d_cameras) {
            let Some(twist) = self.twist(self.rows[i]) else { continue };
            add(&mut out.poses, self.rows[i], to_twist(twist, d));
        }
        for (&i, &d) in frames.iter().zip(report.d_focals) {
            // To the share, of that to the logarithm.
            add(&mut out.focal, self.rigs[i], [d / (1.0 + self.zoom(self.rigs[i]))]);
        }
        for (&i, d) in frames.iter().zip(report.d_lenses).filter(|_| self.lens.is_some()) {
            let (lens, r2) = self.lenses[i];
            add(&mut out.lens, lens, [d[0] / r2, d[1] / (r2 * r2)]);
        }
        for (&i, &d) in frames.iter().zip(report.d_times) {
            add(&mut out.times, self.rigs[i], [d]);
        }
        out
    }

    /// One step of Adam with the gradients of some frames; `progress`: of the run. Frames whose gradient is not finite
    /// rest.
    pub(crate) fn step(&mut self, frames: &[usize], report: &StepGrads<'_>, progress: f64, scale: f64) {
        let s = self.settings.clone();
        let share = |from: f64| {
            let done = (progress - from) / (s.until - from).max(f64::EPSILON);
            (0.0..1.0).contains(&done).then_some(done)
        };
        let rate = |ends: [f64; 2], done: f64, unit: f64| scale * unit * ends[0] * (ends[1] / ends[0]).powf(done);
        let Gradients { poses: d_poses, focal: d_focal, lens: d_lens, times: d_times } = self.gradients(frames, report);
        if let (Some(done), Some(poses)) = (share(s.poses_from), &mut self.poses) {
            let place = rate([s.position_init, s.position_final], done, self.scale.extent);
            let turn = rate([s.rotation_init, s.rotation_final], done, 1.0);
            for (row, d) in d_poses {
                step_row(poses, row, d, [place, place, place, turn, turn, turn]);
            }
            if self.gauge {
                self.fix_poses();
            }
        }
        if let (Some(done), Some(focal)) = (share(s.poses_from), &mut self.focal) {
            let step = rate([s.focal_init, s.focal_final], done, 1.0);
            for (rig, d) in d_focal {
                step_row(focal, rig, d, [step]);
                let kept = f64::from(focal.get(rig, 0)) * (1.0 - PULL);
                focal.set(rig, 0, kept.clamp(-FOCAL_LIMIT, FOCAL_LIMIT) as f32);
            }
        }
        if let (Some(done), Some(lenses)) = (share(s.poses_from), &mut self.lens) {
            let step = rate([s.lens_init, s.lens_final], done, 1.0);
            for (lens, d) in d_lens {
                step_row(lenses, lens, d, [step; LENS]);
                let kept = lenses.read::<LENS>(lens, 0).map(|x| f64::from(x) * (1.0 - PULL));
                lenses.write(lens, 0, kept.map(|x| x.clamp(-LENS_LIMIT, LENS_LIMIT) as f32));
            }
        }
        if let (Some(done), Some(times)) = (share(self.searched()), &mut self.times) {
            let step = rate([s.time_init, s.time_final], done, self.scale.frame);
            let limit = (s.time_limit * self.scale.frame) as f32;
            for (rig, d) in d_times {
                step_row(times, rig, d, [step]);
                times.set(rig, 0, times.get(rig, 0).clamp(-limit, limit));
            }
            self.fix_times();
        }
    }

    /// The share of the run after which no clock is searched any more.
    fn searched(&self) -> f64 {
        let s = &self.settings;
        if s.searches > 0 && self.gauge {
            SEARCHED.clamp(s.times_from, s.until.max(s.times_from))
        } else {
            s.times_from
        }
    }

    /// The search of clocks that is due between two shares of the run.
    pub(crate) fn search_due(&self, before: f64, after: f64) -> Option<SearchDue> {
        self.times.as_ref()?;
        let (from, rounds) = (self.settings.times_from, self.settings.searches);
        let at = |round: usize| from + (self.searched() - from) * round as f64 / rounds as f64;
        let round = (0..rounds).rev().find(|&k| (before..after).contains(&at(k)))?;
        Some(self.search(round))
    }

    /// The search of this number.
    pub(crate) fn search(&self, round: usize) -> SearchDue {
        let [reach, step] = if round < WIDE_SEARCHES { [self.settings.time_limit, 1.0] } else { NARROW };
        SearchDue { round, reach: reach * self.scale.frame, step: step * self.scale.frame }
    }

    /// Shifts the clocks of cameras by this many seconds. Their earlier gradients no longer apply.
    pub(crate) fn shift(&mut self, shifts: &[(usize, f64)]) {
        let limit = (self.settings.time_limit * self.scale.frame) as f32;
        let Some(times) = &mut self.times else { return };
        for &(rig, shift) in shifts {
            let value = times.get(rig, 0) + shift as f32;
            times.clear_row(rig);
            times.set(rig, 0, value.clamp(-limit, limit));
        }
        self.fix_times();
    }

    /// Takes the median of all cameras' shifts out of them.
    fn fix_times(&mut self) {
        let (Some(times), true) = (&mut self.times, self.gauge) else { return };
        let mut rigs = self.rigs.clone();
        rigs.sort_unstable();
        rigs.dedup();
        let mut all: Vec<f32> = rigs.iter().map(|&rig| times.get(rig, 0)).collect();
        all.sort_by(f32::total_cmp);
        let median = 0.5 * (all[(all.len() - 1) / 2] + all[all.len() / 2]);
        rigs.iter().for_each(|&rig| times.set(rig, 0, times.get(rig, 0) - median));
    }

    /// Takes the motion and growth that all cameras have in common out of the twists.
    fn fix_poses(&mut self) {
        let Some(poses) = &mut self.poses else { return };
        let n = self.origins.len() as f64;
        let centers: Vec<[f64; 3]> = self.origins.iter().map(|(pose, _)| pose.inverse().translation).collect();
        let mean: [f64; 3] = std::array::from_fn(|k| centers.iter().map(|c| c[k]).sum::<f64>() / n);
        // To first order a camera turns by −Rᵀθ and its centre moves by −Rᵀρ.
        let moved: Vec<[[f64; 3]; 2]> = (self.origins.iter().enumerate())
            .map(|(row, (pose, _))| {
                let x = poses.read::<POSE>(row, 0).map(|x| -f64::from(x));
                let world = transpose(&pose.rotation);
                [mat_vec(&world, [x[0], x[1], x[2]]), mat_vec(&world, [x[3], x[4], x[5]])]
            })
            .collect();
        let of_all =
            |part: usize| -> [f64; 3] { std::array::from_fn(|k| moved.iter().map(|m| m[part][k]).sum::<f64>() / n) };
        let (shift, turn) = (of_all(0), of_all(1));
        let arms: Vec<[f64; 3]> = centers.iter().map(|&c| sub(c, mean)).collect();
        let (along, squares) =
            arms.iter().zip(&moved).fold((0.0, 0.0), |(a, s), (r, m)| (a + dot(*r, m[0]), s + dot(*r, *r)));
        let growth = if squares > 0.0 { along / squares } else { 0.0 };
        for (row, ((pose, _), (arm, own))) in self.origins.iter().zip(arms.iter().zip(&moved)).enumerate() {
            let swing = cross(turn, *arm);
            let center = std::array::from_fn(|k| own[0][k] - shift[k] - swing[k] - growth * arm[k]);
            let (p, r) = (mat_vec(&pose.rotation, center), mat_vec(&pose.rotation, sub(own[1], turn)));
            poses.write(row, 0, [p[0], p[1], p[2], r[0], r[1], r[2]].map(|x| -x as f32));
        }
    }

    /// The learnt values, one row per camera (or image of a moving one), as plain data. `name` returns of a frame: its
    /// camera's name, and its number where that camera moves.
    pub(crate) fn report(&self, name: &dyn Fn(usize) -> (String, Option<usize>)) -> Value {
        let row = |(row, (_, frame)): (usize, &(Se3, usize))| {
            let (camera, index) = name(*frame);
            let twist = self.twist(row).unwrap_or_default();
            let offset = self.times.as_ref().map_or(0.0, |t| f64::from(t.get(self.rigs[*frame], 0)));
            let [p, r] = [0, 3].map(|k| norm([twist[k], twist[k + 1], twist[k + 2]]));
            json!({
                "camera": camera, "frame": index, "twist": twist, "offset": offset, "degrees": r.to_degrees(),
                "share": p / self.scale.extent, "frames": offset / self.scale.frame,
                "focal": self.zoom(self.rigs[*frame]), "lens": self.coefficients(*frame).unwrap_or_default(),
            })
        };
        json!({
            "poses": self.poses.is_some(), "focal": self.focal.is_some(), "lens": self.lens.is_some(), "times": self.times.is_some(),
            "cameras": self.origins.iter().enumerate().map(row).collect::<Vec<_>>(),
        })
    }

    /// Sets the share by which a camera's focal lengths are longer, to make one up.
    #[cfg(test)]
    pub(crate) fn set_zoom(&mut self, rig: usize, share: f32) {
        self.focal.as_mut().expect("focal lengths are learnt").set(rig, 0, share);
    }

    /// Sets the shares by which a lens moves its corners.
    #[cfg(test)]
    pub(crate) fn set_lens(&mut self, lens: usize, shares: [f32; LENS]) {
        self.lens.as_mut().expect("lenses are learnt").write(lens, 0, shares);
    }

    /// Sets values, to make some up.
    #[cfg(test)]
    pub(crate) fn set(&mut self, row: usize, twist: [f32; 6], offset: f32) {
        if let Some(poses) = &mut self.poses {
            poses.write(row, 0, twist);
        }
        if let Some(times) = &mut self.times {
            times.set(row, 0, offset);
        }
    }
}

/// Intrinsics of which both focal lengths are longer by a share of them.
pub(crate) fn zoomed(stated: &Intrinsics, share: f64) -> Intrinsics {
    Intrinsics { fx: stated.fx * (1.0 + share), fy: stated.fy * (1.0 + share), ..*stated }
}

/// The squared radius of the image corner that is farthest from a camera's axis, of the ray (x, y, 1).
pub(crate) fn corner(camera: &Camera) -> f64 {
    let k = &camera.intrinsics;
    let far = |size: usize, center: f64, focal: f64| (center.max(size as f64 - center) / focal).powi(2);
    far(camera.width, k.cx, k.fx) + far(camera.height, k.cy, k.fy)
}

/// A pose moved by a twist (ρ, θ) from the left.
pub fn moved(pose: &Se3, twist: [f64; 6]) -> Se3 {
    exp(twist).after(pose)
}

/// The rigid motion of a twist, by the series of the exponential: it rounds alike on every machine, as sines do not.
fn exp(twist: [f64; 6]) -> Se3 {
    let (rho, w) = ([twist[0], twist[1], twist[2]], [twist[3], twist[4], twist[5]]);
    let mut out = Se3 { rotation: Se3::IDENTITY.rotation, translation: rho };
    // Columns of [w]ⁿ/n! and [w]ⁿρ/(n + 1)!.
    let (mut columns, mut shift) = (Se3::IDENTITY.rotation, rho);
    for n in 1..TERMS {
        columns = columns.map(|c| cross(w, c).map(|x| x / n as f64));
        shift = cross(w, shift).map(|x| x / (n + 1) as f64);
        for k in 0..3 {
            (0..3).for_each(|j| out.rotation[k][j] += columns[j][k]);
            out.translation[k] += shift[k];
        }
    }
    out
}

/// The gradient to a twist ξ of that to a perturbation from the left of exp(ξ): Jᵀd with the left Jacobian
/// J = Σ adⁿ/(n + 1)!. Source: Barfoot 2017, §7.1.5.
fn to_twist(twist: [f64; 6], d: [f64; 6]) -> [f64; 6] {
    let (rho, w) = ([twist[0], twist[1], twist[2]], [twist[3], twist[4], twist[5]]);
    let (mut sum, mut term) = (d, d);
    for n in 1..TERMS {
        // ad = [[w, ρ], [0, w]] of cross products: its transpose turns their order.
        let (a, b) = ([term[0], term[1], term[2]], [term[3], term[4], term[5]]);
        let (top, low, more) = (cross(a, w), cross(a, rho), cross(b, w));
        term = std::array::from_fn(|k| if k < 3 { top[k] } else { low[k - 3] + more[k - 3] } / (n + 1) as f64);
        (0..6).for_each(|k| sum[k] += term[k]);
    }
    sum
}

/// Adds to the sum of a row.
fn add<const N: usize>(sums: &mut Vec<(usize, [f64; N])>, row: usize, d: [f64; N]) {
    match sums.iter_mut().find(|(known, _)| *known == row) {
        Some((_, sum)) => (0..N).for_each(|k| sum[k] += d[k]),
        None => sums.push((row, d)),
    }
}

#[cfg(test)]
mod tests;
