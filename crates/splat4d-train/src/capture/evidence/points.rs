//! Initial points: which part is in front of the cameras and in their images, and whether their colours are those
//! there.

use super::super::account::Severity;
use super::super::lens::Distortion;
use super::super::preflight::Finding;
use super::super::{Aspect, Capture, DepthFile, DepthKind, Frame, PointCloud, depth};
use super::look::{SmallImage, Trial, pixel_of};
use super::pairs;
use rayon::prelude::*;
use splat4d::Error;
use splat4d::math::Se3;
use splat4d::math::se3::{norm, sub};
use std::collections::BTreeSet;

/// Cameras and points that are sampled, at most, evenly chosen.
const CAMERAS: usize = 24;
const POINTS: usize = 400;
/// Share of points in images, and gain of colours, from which poses are right.
pub(super) const CONVINCES: (f64, f64) = (0.03, MISFIT);
/// Gain of colours below which points do not fit their images, if that many were compared: chance gives 0, exchanged
/// images of one scene 0.14, and real captures 0.38 and more (studies/records, 26 November 2026).
const MISFIT: f64 = 0.2;
pub(super) const MANY: usize = 200;
/// The same where at least this share of the matches between images fits: poses are right then, and points are of
/// another world or hidden. Parts of real captures gain 0.14 and more, points in another unit 0.07 and less (studies/records, 27
/// November 2026).
const MISFIT_OF_MATCHED: f64 = 0.1;
const MATCHED: f64 = 0.75;
/// Gain of colours from which points alone show that poses and intrinsics are right; below, matches are compared too.
pub(super) const GOOD: f64 = 0.3;
/// Share of points in images below which, of that many points, they are of another scene.
const APART: f64 = 0.05;
const FEW: usize = 100;
/// Share of points that another convention shows at least, and how many times that of the poses as read.
const SHOWN: (f64, f64) = (0.25, 4.0);
/// The same without informative colours.
const ALONE: f64 = 10.0;
/// By how much another convention's colours fit better at least, where points in images already indicate it; else
/// alone.
pub(super) const BETTER: f64 = 0.05;
const COLOURS_ALONE: f64 = 0.15;
/// Sum of the differences of three channels below which colours are one.
const ONE_COLOUR: f64 = 0.02;
/// Colours that are compared at least.
const ENOUGH: usize = 60;

/// Evidence of points for one convention.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Measure {
    /// Points that were sampled.
    pub(super) asked: usize,
    /// Part of (camera, point) in front and inside.
    pub(super) seen: f64,
    /// How much nearer colours are to the image there than to that at other points: 0 by chance, 1 at best.
    pub(super) gain: Option<f64>,
    /// Colours that were compared.
    pub(super) compared: usize,
}

impl Measure {
    /// The finding where points fit neither poses nor images. `None`: there is no evidence against them.
    pub(super) fn doubt(&self, pairs: &pairs::Measure) -> Option<Finding> {
        if self.asked > 0 && self.seen == 0.0 {
            return Some(self.elsewhere());
        }
        let matched = pairs.convinces() && pairs.share() >= MATCHED;
        let misfit = if matched { MISFIT_OF_MATCHED } else { MISFIT };
        let colours = self.gain.filter(|gain| *gain < misfit && self.compared >= MANY);
        let apart = self.asked >= FEW && self.seen < APART && !self.convinces() && !pairs.convinces();
        if colours.is_none() && !apart {
            return None;
        }
        let fit = colours.map_or_else(String::new, |gain| {
            format!(
                ", and colours of points fit these by {:.0} %, where those of good captures do by 35 % and more",
                100.0 * gain
            )
        });
        let matches = match pairs.matches {
            0 => String::new(),
            n => format!(" {} of {n} matches between images fit the poses.", pairs.fitting),
        };
        Some(Finding {
            severity: Severity::Warning,
            aspect: Some(Aspect::Assumed),
            what: format!(
                "Initial points and images do not fit: {:.0} % of {} points are in front of the cameras and in their \
                 images{fit}.{matches}",
                100.0 * self.seen,
                self.asked
            ),
            remedy: "Check that images are not exchanged, that intrinsics are for these images, and that points and poses are of \
                     one export; or find points in the images: --set init=pictures."
                .into(),
        })
    }

    /// The finding where no camera sees a point.
    fn elsewhere(&self) -> Finding {
        Finding {
            severity: Severity::Warning,
            aspect: Some(Aspect::Assumed),
            what: format!(
                "Initial points and poses do not fit: none of {} points is in front of a camera and inside its image, and no \
                 other convention of poses fits either. One of the two is wrong, or in another unit.",
                self.asked
            ),
            remedy:
                "Export poses and points from one program together, or find points in the images: --set init=pictures."
                    .into(),
        }
    }

    /// Whether poses are right by this.
    pub(super) fn convinces(&self) -> bool {
        self.seen >= CONVINCES.0 && self.gain.is_some_and(|g| g >= CONVINCES.1)
    }

    /// Whether nothing else need be compared.
    pub(super) fn suffices(&self) -> bool {
        self.convinces() && self.gain.is_some_and(|g| g >= GOOD)
    }
}

/// The training frames whose cameras are sampled.
pub(super) fn frames(capture: &Capture) -> Vec<usize> {
    let step = capture.train.len().div_ceil(CAMERAS).max(1);
    capture.train.iter().step_by(step).copied().collect()
}

/// Measures one convention: `spread` are frames with their poses in it, `images` are images with theirs.
pub(super) fn measure(
    capture: &Capture,
    (frames, poses): (&[usize], &[Se3]),
    (images, look_poses): (&[SmallImage], &[Se3]),
) -> Measure {
    let Some(cloud) = &capture.points else { return Measure::default() };
    let chosen: Vec<usize> = (0..cloud.points.len()).step_by(step(cloud)).collect();
    let mut seen = 0;
    for (&i, pose) in frames.iter().zip(poses) {
        let camera = &capture.frames[i].source;
        let lens = Distortion::new(camera.lens);
        seen += chosen.iter().filter(|&&p| pixel_of(camera, &lens, pose, cloud.points[p]).is_some()).count();
    }
    let share = seen as f64 / (chosen.len() * frames.len()).max(1) as f64;
    let (gain, compared) = gain(capture, &chosen, images, look_poses, Trial::AS_READ).unzip();
    Measure { asked: chosen.len(), seen: share, gain, compared: compared.unwrap_or(0) }
}

/// Stride of the sampled points.
fn step(cloud: &PointCloud) -> usize {
    cloud.points.len().div_ceil(POINTS).max(1)
}

/// The points that a frame's camera has in its image: their pixels of the file, and how far in front of it they are.
fn in_image<'a>(frame: &Frame, points: impl Iterator<Item = &'a [f64; 3]>) -> Vec<([f64; 2], f64)> {
    let (camera, pose) = (&frame.source, &frame.source.cam_from_world);
    let lens = Distortion::new(camera.lens);
    points.filter_map(|&p| Some((pixel_of(camera, &lens, pose, p)?, pose.apply(p)[2]))).collect()
}

/// Part of the points that a camera has in its image in the middle, from which one that has none is remarkable, and
/// part of the cameras that have none at most.
const USUAL: f64 = 0.1;
const EXCEPTIONS: f64 = 0.2;

/// The training frames of cameras that have none of the points in their images, where most cameras have many.
pub(super) fn blind(capture: &Capture) -> Vec<usize> {
    let Some(cloud) = capture.points.as_ref().filter(|c| c.points.len() >= FEW) else { return Vec::new() };
    let mut known = BTreeSet::new();
    let new = |&i: &usize| {
        let camera = capture.frames[i].camera;
        !capture.cameras[camera].fixed || known.insert(camera)
    };
    let frames: Vec<usize> = capture.train.iter().copied().filter(new).collect();
    let chosen: Vec<[f64; 3]> = cloud.points.iter().step_by(step(cloud)).copied().collect();
    let counts: Vec<usize> = frames.par_iter().map(|&i| in_image(&capture.frames[i], chosen.iter()).len()).collect();
    let mut sorted = counts.clone();
    sorted.sort_unstable();
    let usual = sorted.get(sorted.len() / 2).copied().unwrap_or(0) as f64 / chosen.len() as f64;
    let none: Vec<usize> = frames.iter().zip(&counts).filter(|(_, c)| **c == 0).map(|(i, _)| *i).collect();
    if usual < USUAL || none.len() as f64 > EXCEPTIONS * frames.len() as f64 {
        return Vec::new();
    }
    none.into_iter().filter(|&i| in_image(&capture.frames[i], cloud.points.iter()).is_empty()).collect()
}

/// Depth maps that are compared with points, points in one at least, and by how much their unit may be off.
const MAPS: usize = 3;
const IN_MAP: usize = 30;
const SAME_UNIT: f64 = 2.0;
/// Between the quarters of the ratios: where they are farther apart than this factor, they determine no unit.
const STEADY: f64 = 3.0;

/// Views with metric depth that are compared, evenly chosen.
fn with_depth(capture: &Capture) -> Vec<&Frame> {
    let metric = |f: &&Frame| f.depth.as_ref().is_some_and(|d| d.kind == DepthKind::Metric);
    let frames: Vec<&Frame> = capture.train.iter().map(|&i| &capture.frames[i]).filter(metric).collect();
    frames.iter().step_by(frames.len().div_ceil(MAPS).max(1)).copied().collect()
}

/// Correlation of the logarithms of stored and true depths below which maps hold inverse depths: where ratios are steady, and
/// where they are not.
const INVERSE: [f64; 2] = [-0.7, -0.5];

/// What points indicate of metric depth maps.
enum ByPoints {
    /// How many times as far away points are.
    Ratio(f64),
    /// Maps hold inverse depths, by this correlation.
    Inverse(f64),
}

/// Compares metric depth maps with points. `None`: undetermined.
fn by_points(capture: &Capture) -> Option<ByPoints> {
    let cloud = capture.points.as_ref()?;
    let (mut ratios, mut logarithms) = (Vec::new(), Vec::new());
    for frame in with_depth(capture) {
        let seen = in_image(frame, cloud.points.iter().step_by(step(cloud)));
        let pixels: Vec<[f64; 2]> = seen.iter().map(|(pixel, _)| *pixel).collect();
        // A map that cannot be read has an error of its own.
        let Ok(depths) = depth::at(frame.depth.as_ref()?, &frame.source, &pixels) else { continue };
        let known = seen.iter().zip(depths).filter(|(_, d)| *d > 0.0).map(|((_, z), d)| (*z, f64::from(d)));
        for (z, d) in known {
            ratios.push(z / d);
            logarithms.push([z.ln(), d.ln()]);
        }
    }
    if ratios.len() < IN_MAP {
        return None;
    }
    ratios.sort_by(f64::total_cmp);
    let quarter = |k: usize| ratios[k * ratios.len() / 4];
    let (steady, correlation) = (quarter(3) <= STEADY * quarter(1), correlation(&logarithms));
    if correlation <= INVERSE[usize::from(!steady)] {
        return Some(ByPoints::Inverse(correlation));
    }
    steady.then(|| ByPoints::Ratio(quarter(2)))
}

/// Pearson's correlation; 0 where one of the two is constant.
fn correlation(pairs: &[[f64; 2]]) -> f64 {
    let n = pairs.len().max(1) as f64;
    let mean = [0, 1].map(|k| pairs.iter().map(|p| p[k]).sum::<f64>() / n);
    let moment = |a: usize, b: usize| pairs.iter().map(|p| (p[a] - mean[a]) * (p[b] - mean[b])).sum::<f64>();
    let spread = (moment(0, 0) * moment(1, 1)).sqrt();
    if spread > 0.0 { moment(0, 1) / spread } else { 0.0 }
}

/// Candidate factors of stored depths: powers of two and ten over this range.
const FACTORS: [f64; 2] = [1e-5, 1e5];
/// Pixels of a map that another map is compared with, along each side.
const GRID: usize = 24;
/// Two maps agree at a pixel within this share of the depth; and how many pixels agree in one unit, of those that both
/// show, and how many times as many as in another.
const AGREE: f64 = 0.03;
const UNIT: (f64, f64) = (0.4, 1.5);

/// Lookups in a depth map: pixels, and for each the querying unit and its expected depth.
struct DepthLookup<'a> {
    frame: &'a Frame,
    pixels: Vec<[f64; 2]>,
    expected: Vec<(usize, f64)>,
}

/// The factor at which metric depth maps of neighbouring views agree with each other; `None`: with none, or with
/// several. Factors next to 1 are within what is right.
fn by_views(capture: &Capture) -> Option<f64> {
    let metric = |i: &&usize| capture.frames[**i].depth.as_ref().is_some_and(|d| d.kind == DepthKind::Metric);
    let all: Vec<usize> = capture.train.iter().filter(metric).copied().collect();
    let mut samples = Vec::new();
    for &i in all.iter().step_by(all.len().div_ceil(MAPS).max(1)) {
        let frame = &capture.frames[i];
        // The nearest camera of the same time sees most of the same.
        let other = (all.iter().map(|&k| &capture.frames[k]))
            .filter(|f| f.time == frame.time && f.image != frame.image)
            .map(|f| (norm(sub(f.source.center(), frame.source.center())), f))
            .filter(|(apart, _)| *apart > 0.0)
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((_, other)) = other else { continue };
        let (camera, file) = (&frame.source, frame.depth.as_ref()?);
        let pixels: Vec<[f64; 2]> = (0..GRID * GRID)
            .map(|k| {
                let [x, y] = [k % GRID, k / GRID].map(|v| (v as f64 + 0.5) / GRID as f64);
                [x * camera.width as f64, y * camera.height as f64]
            })
            .collect();
        let Ok(depths) = depth::at(file, camera, &pixels) else { continue };
        let lens = Distortion::new(camera.lens);
        let k = &camera.intrinsics;
        for ([u, v], d) in pixels.into_iter().zip(depths).filter(|(_, d)| *d > 0.0) {
            if let Some([x, y]) = lens.undistort([(u - k.cx) / k.fx, (v - k.cy) / k.fy]) {
                samples.push((frame, other, [x, y, 1.0].map(|v| v * f64::from(d))));
            }
        }
    }
    // The stated unit first.
    let mut factors = vec![1.0];
    let mut power = FACTORS[0];
    while power <= FACTORS[1] * 1.001 {
        factors.extend([power, 2.0 * power, 5.0 * power].into_iter().filter(|f| f.max(1.0 / f) >= SAME_UNIT));
        power *= 10.0;
    }
    // By map: pixels that any unit requests, with the unit and the depth that it expects there. Every map is decoded
    // once.
    let mut asked: Vec<DepthLookup<'_>> = Vec::new();
    for (frame, other, ray) in &samples {
        let (camera, pose) = (&other.source, &other.source.cam_from_world);
        let (lens, world_from_cam) = (Distortion::new(camera.lens), frame.source.cam_from_world.inverse());
        let at = asked.iter().position(|a| std::ptr::eq(a.frame, *other)).unwrap_or_else(|| {
            asked.push(DepthLookup { frame: other, pixels: Vec::new(), expected: Vec::new() });
            asked.len() - 1
        });
        for (unit, factor) in factors.iter().enumerate() {
            let world = world_from_cam.apply(ray.map(|v| v * factor));
            if let Some(pixel) = pixel_of(camera, &lens, pose, world) {
                asked[at].pixels.push(pixel);
                asked[at].expected.push((unit, pose.apply(world)[2] / factor));
            }
        }
    }
    let mut counts = vec![(0u32, 0u32); factors.len()];
    for DepthLookup { frame, pixels, expected } in asked {
        let Some(Ok(depths)) = frame.depth.as_ref().map(|d| depth::at(d, &frame.source, &pixels)) else { continue };
        for (d, (unit, z)) in depths.iter().zip(expected).filter(|(d, _)| **d > 0.0) {
            counts[unit].0 += u32::from((z / f64::from(*d) - 1.0).abs() <= AGREE);
            counts[unit].1 += 1;
        }
    }
    let share =
        |(agree, seen): (u32, u32)| if (seen as usize) < IN_MAP { 0.0 } else { f64::from(agree) / f64::from(seen) };
    let stated = share(counts[0]);
    let mut best = (1.0, 0.0);
    for (factor, found) in factors.iter().zip(counts.iter().map(|c| share(*c))).skip(1) {
        if found > best.1 {
            best = (*factor, found);
        }
    }
    match () {
        () if stated.max(best.1) < UNIT.0 => None,
        () if best.1 >= UNIT.1 * stated => Some(best.0),
        () if stated >= UNIT.1 * best.1 => Some(1.0),
        () => None,
    }
}

/// Findings about the unit of metric depth maps.
pub(super) enum Unit<'a> {
    /// There are no such maps, or it is right.
    Right,
    /// Ratio of true to stated depths, the evidence, and a map's file.
    Wrong(f64, &'static str, &'a DepthFile),
    /// They hold inverse depths: the correlation with the depths of points, and a map's file.
    Inverse(f64, &'a DepthFile),
    /// Neither points nor other maps determine it.
    Unknown,
}

/// Compares metric depth maps with initial points, else with each other.
pub(super) fn depth_unit(capture: &Capture) -> Unit<'_> {
    let frames = with_depth(capture);
    let Some(file) = frames.first().and_then(|f| f.depth.as_ref()) else { return Unit::Right };
    let by_points = match by_points(capture) {
        Some(ByPoints::Inverse(correlation)) => return Unit::Inverse(correlation, file),
        Some(ByPoints::Ratio(ratio)) => Some((ratio, "initial points")),
        None => None,
    };
    match by_points.or_else(|| Some((by_views(capture)?, "depth maps of other views"))) {
        Some((ratio, by)) if ratio.max(1.0 / ratio) > SAME_UNIT => Unit::Wrong(ratio, by, file),
        Some(_) => Unit::Right,
        None => Unit::Unknown,
    }
}

/// Why a depth map cannot be read: the first of some.
pub(super) fn unreadable_depth(capture: &Capture) -> Option<Error> {
    let frames: Vec<&Frame> = capture.train.iter().map(|&i| &capture.frames[i]).filter(|f| f.depth.is_some()).collect();
    let some = frames.iter().step_by(frames.len().div_ceil(MAPS).max(1));
    some.filter_map(|f| depth::at(f.depth.as_ref()?, &f.source, &[]).err()).next()
}

/// How much nearer colours of some points are to the images there than to those at other points.
pub(super) fn gain_of(capture: &Capture, images: &[SmallImage], poses: &[Se3]) -> Option<f64> {
    gain_if(capture, images, poses, Trial::AS_READ).map(|(gain, _)| gain)
}

/// [`gain_of`] images with their poses as read.
pub(super) fn gain_of_all(capture: &Capture, images: &[SmallImage]) -> Option<f64> {
    let poses: Vec<Se3> = images.iter().map(|l| capture.frames[l.frame].source.cam_from_world).collect();
    gain_of(capture, images, &poses)
}

/// The same with other intrinsics, and how many colours were compared.
pub(super) fn gain_if(capture: &Capture, images: &[SmallImage], poses: &[Se3], trial: Trial) -> Option<(f64, usize)> {
    let cloud = capture.points.as_ref()?;
    let chosen: Vec<usize> = (0..cloud.points.len()).step_by(step(cloud)).collect();
    gain(capture, &chosen, images, poses, trial)
}

/// Points that are sampled for single images.
const OF_ONE: usize = 4 * POINTS;

/// [`gain_if`] of one image, by more points.
pub(super) fn gain_of_one(capture: &Capture, look: &SmallImage, trial: Trial) -> Option<f64> {
    let cloud = capture.points.as_ref()?;
    let chosen: Vec<usize> = (0..cloud.points.len()).step_by(cloud.points.len().div_ceil(OF_ONE).max(1)).collect();
    let pose = capture.frames[look.frame].source.cam_from_world;
    gain(capture, &chosen, std::slice::from_ref(look), &[pose], trial).map(|(gain, _)| gain)
}

/// Pixels of the small image by which a trial moves the points that [`gain_of_moved`] compares.
const MOVED: f64 = 3.0;
/// Points that are searched for such, at most: few are near the edges of images.
const OF_MOVED: usize = 8 * POINTS;
/// Such points, at least.
const FEW_MOVED: usize = 120;

/// Gains as read and with other intrinsics, of those points that these move and that both have in the image, and how many those are.
/// `None`: too few.
pub(super) fn gain_of_moved(
    capture: &Capture,
    images: &[SmallImage],
    poses: &[Se3],
    trial: Trial,
) -> Option<([f64; 2], usize)> {
    let cloud = capture.points.as_ref()?;
    let step = cloud.points.len().div_ceil(OF_MOVED).max(1);
    let mut sums = [[0.0; 2]; 2];
    let mut count = 0;
    for (look, pose) in images.iter().zip(poses) {
        let cameras = [look.tried(Trial::AS_READ), look.tried(trial)];
        let both = |p: usize| {
            let at = cameras.each_ref().map(|(camera, lens)| pixel_of(camera, lens, pose, cloud.points[p]));
            let [Some(a), Some(b)] = at else { return None };
            let moved = (a[0] - b[0]).hypot(a[1] - b[1]) >= MOVED * look.factor() as f64;
            let [a, b] = [look.color_at(a), look.color_at(b)];
            moved.then_some((cloud.colors[p], [a?, b?]))
        };
        let seen: Vec<([f32; 3], [[f32; 3]; 2])> = (0..cloud.points.len()).step_by(step).filter_map(both).collect();
        let n = seen.len();
        if n < 2 {
            continue;
        }
        for (i, (color, there)) in seen.iter().enumerate() {
            for (k, [own, other]) in sums.iter_mut().enumerate() {
                *own += apart(color, &there[k]);
                for shift in [n / 4, n / 2, 3 * n / 4] {
                    *other += apart(color, &seen[(i + shift.max(1)) % n].1[k]) / 3.0;
                }
            }
        }
        count += n;
    }
    let informative = sums.iter().all(|[_, other]| *other > 1e-3 * count as f64);
    (count >= FEW_MOVED && informative).then(|| (sums.map(|[own, other]| 1.0 - own / other), count))
}

/// Sum of the differences of three channels.
fn apart(a: &[f32; 3], b: &[f32; 3]) -> f64 {
    a.iter().zip(b).map(|(x, y)| f64::from((x - y).abs())).sum()
}

/// How much nearer colours are to the image there than to that at other points, and how many were compared, with
/// these intrinsics. `None`: points have one colour, or too few are in images.
fn gain(
    capture: &Capture,
    chosen: &[usize],
    images: &[SmallImage],
    poses: &[Se3],
    trial: Trial,
) -> Option<(f64, usize)> {
    let cloud = capture.points.as_ref()?;
    let (mut own, mut other, mut count) = (0.0, 0.0, 0);
    // Points of one colour, such as those that have none, carry no information.
    let first = chosen.first().map(|&p| cloud.colors[p])?;
    if chosen.iter().all(|&p| apart(&cloud.colors[p], &first) < ONE_COLOUR) {
        return None;
    }
    for (look, pose) in images.iter().zip(poses) {
        let camera = look.tried(trial);
        let there = |p: usize| look.color_of(&camera, pose, cloud.points[p]);
        let pairs: Vec<([f32; 3], [f32; 3])> =
            chosen.iter().filter_map(|&p| Some((cloud.colors[p], there(p)?))).collect();
        let n = pairs.len();
        if n < 2 {
            continue;
        }
        for (i, (color, there)) in pairs.iter().enumerate() {
            own += apart(color, there);
            // Every point is compared with what is at several others.
            for shift in [n / 4, n / 2, 3 * n / 4] {
                other += apart(color, &pairs[(i + shift.max(1)) % n].1) / 3.0;
            }
        }
        count += n;
    }
    (count >= ENOUGH && other > 1e-3 * count as f64).then(|| (1.0 - own / other, count))
}

/// Whether points indicate that poses are written in the convention of `m`, and not as `stated`.
pub(super) fn prefers(m: &Measure, stated: &Measure, pairs: &pairs::Measure) -> bool {
    if m.asked == 0 || pairs.contradicts() {
        return false;
    }
    let gain = |m: &Measure| m.gain.unwrap_or(0.0);
    let shown = m.seen >= SHOWN.0 && m.seen >= SHOWN.1 * stated.seen;
    let better = gain(m) >= gain(stated) + BETTER;
    let without_colours = m.gain.is_none() && m.seen >= ALONE * stated.seen;
    let by_colours = gain(m) >= COLOURS_ALONE && gain(stated) <= 0.4 * gain(m) && m.seen >= 0.5 * stated.seen;
    shown && (better || without_colours) || by_colours
}
