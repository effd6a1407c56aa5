//! Poses, focal lengths, time offsets and points of a rig from a few points that were clicked.
//!
//! Essential matrices of two cameras start it (five points, every plausible focal length), other cameras follow by the
//! points that are known (three points), and bundle adjustment decides among the starts. Everything is tried in a fixed
//! order with fixed random numbers, so the same clicks give the same bits.

use crate::sfm::adjust::{Bundle, Free, Priors, Settings, Sighting, View, adjust};
use crate::sfm::lens::{Lens, unit};
use crate::sfm::resection::{Known, place};
use crate::sfm::two_view::{Pair, depths, essential_of, five, motions, polish_motion, sampson};
use splat4d::math::align::turn_between;
use splat4d::math::se3::{add, dot, norm, normalize, scale, sub};
use splat4d::math::sym3::eigen;
use splat4d::math::{Rng, Se3, mat3, median};

/// Error of a click, pixels of an image 1920 across: a finger or a mouse on an enlarged image.
const NOISE: f64 = 1.5;
/// Clicks farther from their points than this many times the error hardly count (Cauchy's loss): a wrong corner must not
/// bend the rig.
const SCALE: f64 = 3.0;
/// Points that two cameras must share before they start a rig: five determine it up to ten solutions.
pub(crate) const PAIR: usize = 6;
/// Known points from which on a further camera is placed: three give up to four poses.
const PLACE: usize = 4;
/// Focal lengths that are tried, of the larger side of the image: from wide action cameras to a short telephoto lens.
const FOCALS: [f64; 7] = [0.55, 0.68, 0.83, 1.0, 1.25, 1.55, 1.95];
/// The focal length of most cameras (a telephone's video), of the larger side, and the deviation of its logarithm.
const USUAL: f64 = 0.9;
const USUAL_SPREAD: f64 = 0.35;
/// Deviation of the logarithm of focal lengths in a rig of equal cameras, and in one of different cameras.
const ALIKE: f64 = 0.006;
const STRANGERS: f64 = 0.25;
/// Loss per camera that a rig of different cameras must save (half a likelihood ratio) before it is believed.
const DIFFERENT: f64 = 4.0;
/// Deviations of principal point (of the larger side) and k1.
const CENTER: f64 = 0.006;
const K1: f64 = 0.03;
/// Numbers of clicks for one unknown, from which on distortion is searched for.
const RICH: f64 = 1.5;
/// Pairs of cameras, samples of five points, motions of a pair, and rigs that are tried.
const PAIRS: usize = 4;
const SAMPLES: usize = 40;
const MOTIONS: usize = 3;
const RIGS: usize = 4;
/// Evaluations of a trial and of the last adjustment.
const FIRST_STEPS: usize = 12;
const LAST_STEPS: usize = 80;
/// Distance within which a trial takes a click for right, of the larger side: its focal length is still wrong.
const ROUGH: f64 = 0.03;
/// Two rigs whose relative rotations differ by more are different ones, radians (3 degrees).
const DISTINCT: f64 = 0.05;
/// A second rig whose loss exceeds the first one's by less than this cannot be excluded.
const AMBIGUOUS: f64 = 6.0;
/// Rounds of time offsets and poses.
const ROUNDS: usize = 5;
/// Error of a marked event, frames; an offset stays within this many of them.
const EVENT: f64 = 0.6;
const EVENT_MOST: f64 = 2.0;
/// Error of an offset without an event, seconds.
const OPEN: f64 = 0.1;
/// Clicks of a moving point farther apart belong to different motions, seconds; two that are farther apart than the
/// second value give no velocity, because people accelerate.
const FAR: f64 = 0.6;
const NEAR: f64 = 0.1;

/// What is known of a camera.
#[derive(Clone, Debug)]
pub(crate) struct Camera {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// The focal length, pixels, where it is known; then nothing of the lens is searched for.
    pub focal: Option<f64>,
    /// Seconds between two frames.
    pub interval: f64,
    /// Seconds that are added to its clock, as far as known.
    pub offset: Option<f64>,
    /// Whether the offset is exact and stays.
    pub keep_offset: bool,
}

/// A click.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sight {
    pub camera: usize,
    /// Pixels of a camera without distortion, or of one whose lens is searched for.
    pub pixel: [f64; 2],
    /// Second of the frame on the camera's own clock.
    pub time: f64,
}

/// A point, or the position of a moving one at a time.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Point {
    /// Positions of one moving point share a number; none: it is static.
    pub track: Option<usize>,
    /// At most one of each camera.
    pub sights: Vec<Sight>,
}

/// The rig, as far as it is determined.
#[derive(Clone, Debug)]
pub(crate) struct Solution {
    /// Pose and lens of each camera, or what is missing. The unit is the median distance of cameras from points.
    pub cameras: Vec<Result<(Se3, Lens), String>>,
    /// Seconds that are added to each camera's clock.
    pub offsets: Vec<f64>,
    /// Of each point, where two cameras that have a pose show it.
    pub points: Vec<Option<[f64; 3]>>,
    /// For each click its distance from where the point is seen, pixels.
    pub residuals: Vec<Vec<Option<f64>>>,
    /// Their median.
    pub error: Option<f64>,
    /// Numbers of clicks without those that are unknown: with 0, residuals are 0 even for wrong clicks.
    pub spare: usize,
    /// Whether another rig fits about as well.
    pub ambiguous: bool,
}

/// A click among all, in units of its error.
struct Click {
    point: usize,
    camera: usize,
    pixel: [f64; 2],
    velocity: [f64; 2],
}

/// A rig on trial. Lengths of images are in units of the error of a click.
#[derive(Clone)]
struct Rig {
    poses: Vec<Option<Se3>>,
    lenses: Vec<Lens>,
    taus: Vec<f64>,
    points: Vec<Option<[f64; 3]>>,
    loss: f64,
    /// How alike its focal lengths are; see [`ALIKE`].
    family: f64,
}

/// How a rig is adjusted.
#[derive(Clone, Copy)]
struct How {
    steps: usize,
    family: f64,
    /// Whether principal points are free, and distortion.
    center: bool,
    k1: bool,
    /// Deviation of time offsets; none: they stay.
    clocks: Option<f64>,
}

struct Problem<'a> {
    cameras: &'a [Camera],
    points: &'a [Point],
    clicks: Vec<Click>,
}

/// Finds the rig. Cameras without enough clicks are left open, with the reason.
pub(crate) fn solve(cameras: &[Camera], points: &[Point]) -> Solution {
    let mut offsets: Vec<f64> = cameras.iter().map(|c| c.offset.unwrap_or(0.0)).collect();
    let mut problem = Problem { cameras, points, clicks: Vec::new() };
    problem.set(&offsets);
    let mut rigs = problem.started();
    for rig in &mut rigs {
        problem.finish(rig);
    }
    rigs.sort_by(|a, b| b.rank().cmp(&a.rank()).then(a.loss.total_cmp(&b.loss)));
    let ambiguous = rigs.len() > 1
        && rigs[1..]
            .iter()
            .any(|r| r.rank() == rigs[0].rank() && r.loss < rigs[0].loss + AMBIGUOUS && r.differs(&rigs[0]));
    let Some(mut best) = rigs.into_iter().next() else { return problem.open(offsets) };
    problem.synchronise(&mut best, &mut offsets);
    problem.solution(&best, offsets, ambiguous)
}

/// Pixels of a camera for one unit: the error of a click.
fn error_of(camera: &Camera) -> f64 {
    NOISE * unit(larger(camera))
}

fn larger(camera: &Camera) -> f64 {
    camera.size[0].max(camera.size[1]) as f64
}

/// A camera's lens of a focal length in pixels, in units of the error of a click.
fn lens_of(camera: &Camera, focal: f64) -> Lens {
    Lens::plain(focal, camera.size[0], camera.size[1]).scaled(1.0 / error_of(camera))
}

impl Problem<'_> {
    /// Brings clicks of moving points to the times that their points have by these offsets.
    fn set(&mut self, offsets: &[f64]) {
        self.clicks.clear();
        for (p, point) in self.points.iter().enumerate() {
            let global = |s: &Sight| s.time + offsets[s.camera];
            let mean = point.sights.iter().map(global).sum::<f64>() / point.sights.len().max(1) as f64;
            for s in &point.sights {
                let error = error_of(&self.cameras[s.camera]);
                let (pixel, velocity) = match point.track {
                    None => (s.pixel, [0.0; 2]),
                    Some(track) => self.moved(track, s, mean - offsets[s.camera]),
                };
                self.clicks.push(Click {
                    point: p,
                    camera: s.camera,
                    pixel: pixel.map(|v| v / error),
                    velocity: velocity.map(|v| v / error),
                });
            }
        }
    }

    /// Where a camera shows a moving point at a second of its clock, near to a click of it, and pixels a second: of the
    /// parabola through the click and the two that are nearest in time. Of two clicks only neighbouring frames give a
    /// velocity; a line through distant ones serves to bring the click to the time.
    fn moved(&self, track: usize, s: &Sight, time: f64) -> ([f64; 2], [f64; 2]) {
        let own = self.points.iter().filter(|p| p.track == Some(track)).flat_map(|p| &p.sights);
        let mut others: Vec<&Sight> =
            own.filter(|o| o.camera == s.camera && o.time != s.time && (o.time - s.time).abs() <= FAR).collect();
        others.sort_by(|a, b| (a.time - s.time).abs().total_cmp(&(b.time - s.time).abs()));
        others.dedup_by(|a, b| a.time == b.time);
        let dt = (time - s.time).clamp(-FAR, FAR);
        let slope = |o: &Sight, a: usize| (o.pixel[a] - s.pixel[a]) / (o.time - s.time);
        let of = |a: usize| match others[..] {
            [] => (s.pixel[a], 0.0),
            [o] => {
                let near = (o.time - s.time).abs() <= NEAR;
                (s.pixel[a] + dt * slope(o, a), if near { slope(o, a) } else { 0.0 })
            }
            [b, c, ..] => {
                let bend = (slope(c, a) - slope(b, a)) / (c.time - b.time);
                let speed = slope(c, a) - bend * (c.time - s.time);
                (s.pixel[a] + dt * (speed + bend * dt), speed + 2.0 * bend * dt)
            }
        };
        let [x, y] = [of(0), of(1)];
        ([x.0, y.0], [x.1, y.1])
    }

    fn seen(&self, camera: usize, point: usize) -> Option<&Click> {
        self.clicks.iter().find(|c| c.camera == camera && c.point == point)
    }

    /// Points that two cameras show.
    fn common(&self, [a, b]: [usize; 2]) -> Vec<usize> {
        (0..self.points.len()).filter(|&p| self.seen(a, p).is_some() && self.seen(b, p).is_some()).collect()
    }

    /// Rigs of all starts, the best first.
    fn started(&self) -> Vec<Rig> {
        let n = self.cameras.len();
        let mut pairs: Vec<([usize; 2], Vec<usize>)> = (0..n)
            .flat_map(|a| (a + 1..n).map(move |b| [a, b]))
            .map(|pair| (pair, self.common(pair)))
            .filter(|(_, common)| common.len() >= PAIR)
            .collect();
        pairs.sort_by_key(|(_, common)| std::cmp::Reverse(common.len()));
        pairs.truncate(PAIRS);
        let known = self.cameras.iter().all(|c| c.focal.is_some());
        let focals = if known { &FOCALS[..1] } else { &FOCALS[..] };
        let mut rigs: Vec<Rig> = Vec::new();
        for (k, (pair, common)) in pairs.iter().enumerate() {
            for focal in focals {
                let lens = |c: &Camera| lens_of(c, c.focal.unwrap_or(focal * larger(c)));
                let lenses: Vec<Lens> = self.cameras.iter().map(lens).collect();
                for motion in self.motions(*pair, common, &lenses, k as u64) {
                    rigs.extend(self.chained(*pair, motion, &lenses));
                }
            }
        }
        rigs.sort_by(|a, b| b.rank().cmp(&a.rank()).then(a.loss.total_cmp(&b.loss)));
        // Starts that lead to the same rig count once.
        let mut distinct: Vec<Rig> = Vec::new();
        for rig in rigs {
            if distinct.len() < RIGS && distinct.iter().all(|d| rig.differs(d)) {
                distinct.push(rig);
            }
        }
        distinct
    }

    /// Motions of a pair that fit its common points best.
    fn motions(&self, [a, b]: [usize; 2], common: &[usize], lenses: &[Lens], number: u64) -> Vec<Se3> {
        let ray = |c: usize, p: usize| {
            let [x, y, _] = lenses[c].ray(self.seen(c, p).expect("it is common").pixel);
            [x, y]
        };
        let rays: Vec<Pair> = common.iter().map(|&p| [ray(a, p), ray(b, p)]).collect();
        let focal = (lenses[a].focal * lenses[b].focal).sqrt();
        let loss = |m: &Se3| {
            let e = essential_of(m);
            rays.iter().map(|r| (sampson(&e, r) * focal * focal / SCALE.powi(2)).ln_1p()).sum::<f64>()
        };
        let mut found: Vec<(f64, Se3)> = Vec::new();
        for sample in samples(rays.len(), number) {
            for e in five(&sample.map(|k| rays[k])) {
                let fit = polish_motion(&motions(&e)[0], &rays);
                let loss = loss(&fit);
                // Of the four motions of the matrix that of most points before both cameras.
                let before = |m: &Se3| rays.iter().filter(|r| depths(m, r).iter().all(|z| *z > 0.0)).count();
                let all = motions(&essential_of(&fit));
                let best = all.into_iter().max_by_key(|m| before(m)).expect("there are four");
                let same = |o: &(f64, Se3)| {
                    turn_between(&o.1.rotation, &best.rotation) + norm(sub(o.1.translation, best.translation))
                        < DISTINCT
                };
                if loss.is_finite() && 10 * before(&best) >= 9 * rays.len() && !found.iter().any(same) {
                    found.push((loss, best));
                }
            }
        }
        found.sort_by(|x, y| x.0.total_cmp(&y.0));
        found.into_iter().take(MOTIONS).map(|(_, m)| m).collect()
    }

    /// A pair, and all cameras that follow.
    fn chained(&self, [a, b]: [usize; 2], motion: Se3, lenses: &[Lens]) -> Option<Rig> {
        let n = self.cameras.len();
        let mut rig = Rig {
            poses: vec![None; n],
            lenses: lenses.to_vec(),
            taus: vec![0.0; n],
            points: vec![None; self.points.len()],
            loss: f64::INFINITY,
            family: ALIKE,
        };
        (rig.poses[a], rig.poses[b]) = (Some(Se3::IDENTITY), Some(motion));
        let how = How { steps: FIRST_STEPS, family: ALIKE, center: false, k1: false, clocks: None };
        self.triangulate(&mut rig);
        self.adjust(&mut rig, how)?;
        let mut failed = vec![false; n];
        loop {
            self.triangulate(&mut rig);
            let known =
                |c: usize| self.clicks.iter().filter(|k| k.camera == c && rig.points[k.point].is_some()).count();
            let next = (0..n).filter(|&c| rig.poses[c].is_none() && !failed[c] && known(c) >= PLACE);
            // Of equals the first.
            let Some(c) = next.min_by_key(|&c| std::cmp::Reverse(known(c))) else { break };
            let shown: Vec<Known> = self
                .clicks
                .iter()
                .filter(|k| k.camera == c)
                .filter_map(|k| Some(Known { point: rig.points[k.point]?, pixel: k.pixel }))
                .collect();
            let tolerance = ROUGH * larger(&self.cameras[c]) / error_of(&self.cameras[c]);
            let lens = match self.cameras[c].focal {
                Some(_) => lenses[c],
                // The placed cameras' focal length has adapted.
                None => Lens { focal: rig.lenses[a].focal, ..lenses[c] },
            };
            let rng = Rng::new(0, "clicks", c as u64);
            let Some(found) = place(&shown, &[lens], false, tolerance, rng).filter(|f| f.inliers.len() >= PLACE) else {
                failed[c] = true;
                continue;
            };
            (rig.poses[c], rig.lenses[c]) = (Some(found.model.pose), found.model.lens);
            self.triangulate(&mut rig);
            self.adjust(&mut rig, how)?;
        }
        Some(rig)
    }

    /// Adjusts to the end: once for a rig of equal cameras, and where the clicks contradict that, for different ones.
    fn finish(&self, rig: &mut Rig) {
        self.triangulate(rig);
        let how = self.last(rig, None);
        if self.adjust(rig, how).is_none() {
            return;
        }
        let placed = rig.placed();
        if placed < 3 {
            return;
        }
        let mut other = rig.clone();
        if self.adjust(&mut other, How { family: STRANGERS, ..how }).is_some()
            && rig.loss - other.loss > DIFFERENT * placed as f64
        {
            *rig = Rig { family: STRANGERS, ..other };
        }
    }

    /// How a rig is adjusted to the end. Principal points are near the middle, but rarely in it: fixed there, they turn
    /// cameras by up to a degree. Distortion needs many clicks.
    fn last(&self, rig: &Rig, clocks: Option<f64>) -> How {
        let [clicks, unknown] = self.counts(rig);
        let rich = clicks as f64 >= RICH * (unknown + 3 * rig.placed()) as f64;
        How { steps: LAST_STEPS, family: rig.family, center: rig.placed() >= 3, k1: rich, clocks }
    }

    /// Numbers of clicks that count, and unknown ones with focal lengths.
    fn counts(&self, rig: &Rig) -> [usize; 2] {
        let counted = |c: &&Click| rig.poses[c.camera].is_some() && rig.points[c.point].is_some();
        let clicks = 2 * self.clicks.iter().filter(counted).count();
        let points = 3 * rig.points.iter().flatten().count();
        let placed = rig.placed();
        let focals = (0..self.cameras.len()).filter(|&c| rig.poses[c].is_some() && self.cameras[c].focal.is_none());
        // Equal cameras have one focal length.
        let focals = usize::from(focals.count() > 0);
        [clicks, (6 * placed).saturating_sub(7) + points + focals]
    }

    /// Finds points that two placed cameras show and that are not known yet; forgets those that are behind a camera.
    fn triangulate(&self, rig: &mut Rig) {
        for p in 0..self.points.len() {
            let (mut lines, mut poses) = (Vec::new(), Vec::new());
            for click in self.clicks.iter().filter(|c| c.point == p) {
                let Some(pose) = rig.poses[click.camera] else { continue };
                lines.push(rig.lenses[click.camera].line(&pose, click.pixel));
                poses.push(pose);
            }
            let before = |x: &[f64; 3]| poses.iter().all(|pose| pose.apply(*x)[2] > 0.0);
            if lines.len() < 2 {
                rig.points[p] = None;
            } else if rig.points[p].filter(before).is_none() {
                rig.points[p] = mat3::nearest_to_lines(lines).filter(before);
            }
        }
    }

    /// Adjusts what is placed; none: too little is.
    fn adjust(&self, rig: &mut Rig, how: How) -> Option<()> {
        let mut bundle = Bundle::default();
        let mut number = vec![usize::MAX; self.cameras.len()];
        let placed: Vec<usize> = (0..self.cameras.len()).filter(|&c| rig.poses[c].is_some()).collect();
        for (k, &c) in placed.iter().enumerate() {
            number[c] = k;
            let pose = rig.poses[c].expect("it is placed");
            bundle.views.push(View { pose, lens: k, tau: rig.taus[c] });
            bundle.lenses.push(rig.lenses[c]);
        }
        let mut back = Vec::new();
        for (p, place) in rig.points.iter().enumerate() {
            let Some(place) = place else { continue };
            let seen = self.clicks.iter().filter(|c| c.point == p && number[c.camera] != usize::MAX);
            for c in seen {
                let (view, velocity) = (number[c.camera], c.velocity);
                bundle.sightings.push(Sighting { view, point: back.len(), pixel: c.pixel, velocity });
            }
            bundle.points.push(*place);
            back.push(p);
        }
        if placed.len() < 2 || back.len() < PLACE {
            return None;
        }
        let usual = |&c: &usize| {
            let camera = &self.cameras[c];
            lens_of(camera, camera.focal.unwrap_or(USUAL * larger(camera)))
        };
        let side = placed.iter().map(|&c| larger(&self.cameras[c]) / error_of(&self.cameras[c])).fold(0.0, f64::max);
        let settings = Settings {
            scale: SCALE,
            free: Free { pose: true, focal: true, k1: how.k1, center: how.center, tau: how.clocks.is_some() },
            exact: placed.iter().map(|&c| self.cameras[c].focal.is_some()).collect(),
            priors: Priors {
                lenses: placed.iter().map(usual).collect(),
                focal: USUAL_SPREAD,
                k1: K1,
                center: CENTER * side,
                // Known lenses have a place of their own.
                family: if self.cameras.iter().any(|c| c.focal.is_some()) { f64::INFINITY } else { how.family },
                tau: how.clocks.unwrap_or(f64::INFINITY),
            },
            steps: how.steps,
            gain: 1e-9,
        };
        rig.loss = adjust(&mut bundle, &settings).after;
        for (&c, (view, lens)) in placed.iter().zip(bundle.views.iter().zip(&bundle.lenses)) {
            (rig.poses[c], rig.lenses[c], rig.taus[c]) = (Some(view.pose), *lens, view.tau);
        }
        back.iter().zip(&bundle.points).for_each(|(&p, place)| rig.points[p] = Some(*place));
        rig.loss.is_finite().then_some(())
    }

    /// Refines time offsets by moving points, and the rig with them.
    fn synchronise(&mut self, rig: &mut Rig, offsets: &mut [f64]) {
        let moves = |c: usize, clicks: &[Click]| clicks.iter().any(|k| k.camera == c && k.velocity != [0.0; 2]);
        let open: Vec<usize> = (0..self.cameras.len())
            .filter(|&c| rig.poses[c].is_some() && !self.cameras[c].keep_offset && moves(c, &self.clicks))
            .collect();
        let fixed = (0..self.cameras.len()).find(|&c| rig.poses[c].is_some() && self.cameras[c].keep_offset);
        let Some(zero) = fixed.or_else(|| open.first().copied()) else { return };
        if open.iter().all(|&c| c == zero) {
            return;
        }
        let begun = offsets.to_vec();
        let marked = self.cameras.iter().all(|c| c.offset.is_some());
        let frame = self.cameras.iter().map(|c| c.interval).fold(0.0, f64::max);
        let how = self.last(rig, Some(if marked { EVENT * frame } else { OPEN }));
        // Near to an event one round suffices, and keeps what is known of it.
        for _ in 0..if marked { 1 } else { ROUNDS } {
            rig.taus.fill(0.0);
            if self.adjust(rig, how).is_none() {
                return;
            }
            for &c in open.iter().filter(|&&c| c != zero) {
                let next = offsets[c] - (rig.taus[c] - rig.taus[zero]);
                let most = if marked { EVENT_MOST * EVENT * frame } else { f64::INFINITY };
                offsets[c] = next.clamp(begun[c] - most, begun[c] + most);
            }
            self.set(offsets);
        }
        rig.taus.fill(0.0);
        self.adjust(rig, How { clocks: None, ..how });
    }

    /// Nothing is determined.
    fn open(&self, offsets: Vec<f64>) -> Solution {
        Solution {
            cameras: (0..self.cameras.len()).map(|c| Err(self.reason(c, None))).collect(),
            offsets,
            points: vec![None; self.points.len()],
            residuals: self.points.iter().map(|p| vec![None; p.sights.len()]).collect(),
            error: None,
            spare: 0,
            ambiguous: false,
        }
    }

    /// What a camera lacks.
    fn reason(&self, camera: usize, rig: Option<&Rig>) -> String {
        let Some(rig) = rig else {
            let most = (0..self.cameras.len()).filter(|&c| c != camera).map(|c| self.common([camera, c]).len()).max();
            return match most.unwrap_or(0) {
                shared if shared >= PAIR => "no pose fits the clicked points: check them".into(),
                shared => format!(
                    "{shared} clicked points are shared with another camera: click {} more (two cameras with {PAIR} \
                     start the rig)",
                    PAIR - shared
                ),
            };
        };
        let known = self.clicks.iter().filter(|k| k.camera == camera && rig.points[k.point].is_some()).count();
        if known < PLACE {
            format!("{known} clicked points are known from other cameras: click {} more", PLACE - known)
        } else {
            format!("no pose fits its {known} clicked points: check them")
        }
    }

    fn solution(&self, rig: &Rig, offsets: Vec<f64>, ambiguous: bool) -> Solution {
        // In a unit of its own: the median distance of cameras from their points.
        let distances = |c: usize| {
            let center = rig.poses[c]?.inverse().translation;
            let shown = self.clicks.iter().filter(|k| k.camera == c).filter_map(|k| rig.points[k.point]);
            median(&mut shown.map(|x| norm(sub(x, center))).collect::<Vec<_>>())
        };
        let mut all: Vec<f64> = (0..self.cameras.len()).filter_map(distances).collect();
        let by = 1.0 / median(&mut all).filter(|d| *d > 0.0).unwrap_or(1.0);
        let residual = |k: &Click| {
            let (pose, x) = (rig.poses[k.camera]?, rig.points[k.point]?);
            let [u, v] = rig.lenses[k.camera].project(pose.apply(x))?;
            Some(error_of(&self.cameras[k.camera]) * (u - k.pixel[0]).hypot(v - k.pixel[1]))
        };
        let of_point = |p: usize| self.clicks.iter().filter(|k| k.point == p).map(residual).collect::<Vec<_>>();
        let residuals: Vec<Vec<Option<f64>>> = (0..self.points.len()).map(of_point).collect();
        let error = median(&mut residuals.iter().flatten().flatten().copied().collect::<Vec<f64>>());
        let camera = |c: usize| match rig.poses[c] {
            Some(pose) => {
                let pose = Se3 { rotation: pose.rotation, translation: scale(pose.translation, by) };
                Ok((pose, rig.lenses[c].scaled(error_of(&self.cameras[c]))))
            }
            None => Err(self.reason(c, Some(rig))),
        };
        let [clicks, unknown] = self.counts(rig);
        Solution {
            cameras: (0..self.cameras.len()).map(camera).collect(),
            offsets,
            points: rig.points.iter().map(|x| x.map(|x| scale(x, by))).collect(),
            residuals,
            error,
            spare: clicks.saturating_sub(unknown),
            ambiguous,
        }
    }
}

impl Rig {
    fn placed(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Cameras and points that it explains.
    fn rank(&self) -> [usize; 2] {
        [self.placed(), self.points.iter().flatten().count()]
    }

    /// Whether a relative rotation, or the direction between two cameras, is another one.
    fn differs(&self, other: &Self) -> bool {
        let both: Vec<(&Se3, &Se3)> =
            self.poses.iter().zip(&other.poses).filter_map(|(a, b)| Some((a.as_ref()?, b.as_ref()?))).collect();
        if both.len() < 2 || self.rank() != other.rank() {
            return true;
        }
        let first = both[0];
        both[1..].iter().any(|(a, b)| {
            let (x, y) = (a.after(&first.0.inverse()), b.after(&first.1.inverse()));
            turn_between(&x.rotation, &y.rotation) > DISTINCT
                || dot(normalize(x.translation), normalize(y.translation)) < DISTINCT.cos()
        })
    }
}

/// Five of `n`: all samples where they are few, else a fixed choice.
fn samples(n: usize, number: u64) -> Vec<[usize; 5]> {
    let mut all = Vec::new();
    if n <= 7 {
        for mask in 0u32..1 << n {
            if mask.count_ones() == 5 {
                let mut of = (0..n).filter(|k| mask >> k & 1 == 1);
                all.push(std::array::from_fn(|_| of.next().expect("there are five")));
            }
        }
        return all;
    }
    let rng = Rng::new(0, "samples of clicks", number);
    for k in 0..SAMPLES {
        let order = rng.fork(k as u64).permutation(n);
        all.push(std::array::from_fn(|i| order[i] as usize));
    }
    all
}

/// The floor through points: its unit normal and the mean of the points; the normal is on the side of `above`.
pub(crate) fn plane(points: &[[f64; 3]], above: [f64; 3]) -> Option<([f64; 3], [f64; 3])> {
    if points.len() < super::FLOOR {
        return None;
    }
    let mean = points.iter().fold([0.0; 3], |m, p| add(m, scale(*p, 1.0 / points.len() as f64)));
    let mut cov = [0.0; 6];
    for p in points {
        let [x, y, z] = sub(*p, mean);
        [x * x, x * y, x * z, y * y, y * z, z * z].iter().zip(&mut cov).for_each(|(v, c)| *c += v);
    }
    let (values, vectors) = eigen(cov);
    /// Of the largest spread: points on a line span no plane.
    const LINE: f64 = 1e-4;
    if values[1] <= LINE * values[0] {
        return None;
    }
    let normal: [f64; 3] = std::array::from_fn(|k| vectors[k][2]);
    let normal = if dot(normal, sub(above, mean)) < 0.0 { scale(normal, -1.0) } else { normal };
    Some((normal, mean))
}
