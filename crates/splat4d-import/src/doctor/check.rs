//! The checks. Thresholds are of the project's own study of captures ("Doctor": what is seen in results) where no other source
//! is named: the first of two is a warning, the second is bad. Those of flicker, dark and clipped pictures are chosen by eye.

use super::look::{Seen, Stand, detail};
use super::{CameraReport, Finding, Grade, Options, Report};
use crate::sfm::pictures::{Feature, Sight};
use crate::sfm::tracks::{Pairing, links};
use crate::sync::epipolar::{Range, lag, sampson};
use crate::sync::graph::{Evidence, Kind, solve};
use crate::sync::grey::Grey;
use crate::sync::median;
use rayon::prelude::*;
use splat4d::math::se3::{dot, mat_mul, mat_vec, norm, sub, transpose};
use splat4d::scene::{Camera, Planes};
use splat4d_train::capture::Capture;
use splat4d_train::event::Progress;
use splat4d_train::vision::features::{Limits, find};
use splat4d_train::vision::raster::grey;
use splat4d_train::vision::triangulate::{self, angle_at};

/// Distance of matches from their epipolar lines, pixels of a picture 1920 wide.
const EPIPOLAR: [f64; 2] = [1.0, 2.0];
/// And at least so many of the picture's own: of the bundled capture, whose poses are exact, up to 0.8 were measured.
const OWN_PIXELS: [f64; 2] = [1.0, 2.0];
/// Blur of what moves by a wrong clock, pixels of 1920.
const OFFSET: [f64; 2] = [0.5, 1.5];
/// Standard deviations from which an offset is one, and the least part of a frame: of a hall whose cameras one clock drives up
/// to 0.59 frames were found, other cameras with other settings, so that less than this is no evidence.
const OFFSET_SIGMAS: f64 = 4.0;
const OFFSET_FRAMES: f64 = 0.75;
/// What stands still went so far, pixels of 1920, and at least so many own ones.
const MOVED: [f64; 2] = [0.5, 2.0];
const MOVED_PIXELS: [f64; 2] = [0.35, 1.0];
/// Exposure, and one channel against green, stops.
const EXPOSURE: [f64; 2] = [0.15, 0.5];
/// Sharpness relative to other cameras.
const SHARPNESS: [f64; 2] = [0.6, 0.35];
/// Brightness that jumps from picture to picture, stops.
const FLICKER: [f64; 2] = [0.05, 0.15];
/// Missing and doubled frames, of all.
const FRAMES: [f64; 2] = [0.01, 0.05];
/// Angle to the nearest other camera, degrees.
const ANGLE: [f64; 2] = [25.0, 45.0];
/// Fewer cameras than the first are limited, than the second poor.
const CAMERAS: [usize; 2] = [6, 4];
/// Part of the pixels that is clipped black or white: backgrounds of data sets are, so that only most of a picture tells.
const CLIPPED: f64 = 0.6;
/// Mean below which a picture is too dark, of 255.
const DARK: f64 = 20.0;
/// How much larger steps across blocks are, of 255. Pictures of two takes that look sound have 0.9 to 1.4.
const BLOCKS: [f64; 2] = [2.5, 5.0];
/// sRGB values are this power of light, about.
const GAMMA: f64 = 2.2;
/// Matches that tell something of a pair.
const MATCHES: usize = 12;
/// And of poses: of pairs with fewer many are chance (measured on a hall and on the bundled capture), of cameras whose axes
/// are farther apart most, degrees.
const SURE: usize = 20;
const APART: f64 = 60.0;
/// So many of a camera's pairs must agree on its error at least, of so many that tell it; chance only makes errors larger.
const AGREE: usize = 2;
const TELL: usize = 3;
/// Median over lower quartile of the size of a normal error: 0.6745 / 0.3186.
const QUARTILE_TO_MEDIAN: f64 = 2.117;
/// Cameras with one fault become one finding from this part of all on.
const MOST: f64 = 0.5;
/// Half the side of what is compared for sharpness, pixels.
const PATCH: usize = 8;
/// Neighbours with which a camera's clock is compared.
const NEIGHBOURS: usize = 3;
/// Frames that a clock is looked for within, and the part of those that were looked at: right lags are told by standing out of
/// many.
const WITHIN: f64 = 10.0;
const WITHIN_PART: f64 = 1.0 / 3.0;

fn grade(value: f64, [warning, bad]: [f64; 2]) -> Option<Grade> {
    match value {
        v if v >= bad => Some(Grade::Bad),
        v if v >= warning => Some(Grade::Warning),
        _ => None,
    }
}

fn worse([a, b]: [f64; 2], [c, d]: [f64; 2]) -> [f64; 2] {
    [a.max(c), b.max(d)]
}

/// Pixels of a picture 1920 wide for each of its own.
fn unit(view: &Camera) -> f64 {
    /// The longer side of what thresholds are about.
    const WIDE: f64 = 1920.0;
    WIDE / view.width.max(view.height) as f64
}

/// F with `x_bᵀ F x_a = 0`.
fn fundamental(a: &Camera, b: &Camera) -> [[f64; 3]; 3] {
    let rotation = mat_mul(&b.cam_from_world.rotation, &transpose(&a.cam_from_world.rotation));
    let t = sub(b.cam_from_world.translation, mat_vec(&rotation, a.cam_from_world.translation));
    let cross = [[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]];
    let inverse = |c: &Camera| {
        let k = &c.intrinsics;
        [[1.0 / k.fx, 0.0, -k.cx / k.fx], [0.0, 1.0 / k.fy, -k.cy / k.fy], [0.0, 0.0, 1.0]]
    };
    mat_mul(&transpose(&inverse(b)), &mat_mul(&mat_mul(&cross, &rotation), &inverse(a)))
}

fn planes(stand: &Stand) -> Planes<f32> {
    let values: Vec<f32> = stand.picture.data.iter().map(|v| f32::from(*v) / 255.0).collect();
    Planes::from_interleaved(3, stand.picture.height, stand.picture.width, &values)
}

fn sight(name: &str, number: usize, stand: &Stand, most: usize) -> Sight {
    /// Least contrast of a feature, as structure from motion takes it.
    const CONTRAST: f64 = 0.004;
    let found = find(&grey(&planes(stand)), Limits { contrast: CONTRAST, most }, &|_, _| true);
    let feature = |f: &splat4d_train::vision::features::Feature| Feature {
        pixel: f.pixel,
        velocity: [0.0; 2],
        moment: 0,
        descriptor: f.descriptor,
        color: [0; 3],
    };
    Sight {
        name: name.to_owned(),
        size: [stand.picture.width, stand.picture.height],
        factor: 1.0,
        focal: None,
        lens: number,
        frame: 0.0,
        features: found.iter().map(feature).collect(),
    }
}

/// The mean of a channel around a place, and the patch's detail relative to its brightness.
fn around(stand: &Stand, [u, v]: [f64; 2]) -> Option<([f64; 3], f64)> {
    let p = &stand.picture;
    let (x, y) = (u as usize, v as usize);
    if x < PATCH || y < PATCH || x + PATCH >= p.width || y + PATCH >= p.height {
        return None;
    }
    let side = 2 * PATCH + 1;
    let mut sums = [0.0; 3];
    let mut data = Vec::with_capacity(side * side);
    for row in y - PATCH..=y + PATCH {
        for pixel in p.data[3 * (row * p.width + x - PATCH)..][..3 * side].chunks_exact(3) {
            (0..3).for_each(|c| sums[c] += f64::from(pixel[c]));
            data.push(pixel.iter().map(|v| f32::from(*v)).sum::<f32>() / (3.0 * 255.0));
        }
    }
    let mean = f64::from(data.iter().sum::<f32>()) / data.len() as f64;
    let fine = detail(&Grey { width: side, height: side, data });
    (mean > 0.0).then(|| (sums.map(|s| s / (side * side) as f64), fine / mean))
}

/// What two stands say of each other.
struct Pair {
    stands: [usize; 2],
    /// Pixels of 1920, and own ones.
    off: [f64; 2],
    /// Stops by which the second is brighter.
    gain: [f64; 3],
    /// Logarithm of how much sharper it is.
    sharper: f64,
}

fn pair(
    stands: &[(usize, &Stand)],
    sights: &[Sight],
    [a, b]: [usize; 2],
    matches: &[([usize; 2], f32)],
) -> Option<Pair> {
    /// Values between which ratios of brightness mean something, of 255.
    const EXPOSED: [f64; 2] = [12.0, 240.0];
    let (p, q) = (stands[a].1, stands[b].1);
    let f = fundamental(&p.view, &q.view);
    let (mut off, mut gains, mut sharper) = (Vec::new(), [Vec::new(), Vec::new(), Vec::new()], Vec::new());
    for ([i, j], _) in matches {
        let (x, y) = (sights[a].features[*i].pixel, sights[b].features[*j].pixel);
        off.push(sampson(&f, x, y).abs());
        let (Some(one), Some(two)) = (around(p, x), around(q, y)) else { continue };
        let exposed = |v: f64| (EXPOSED[0]..EXPOSED[1]).contains(&v);
        for c in (0..3).filter(|&c| exposed(one.0[c]) && exposed(two.0[c])) {
            gains[c].push(GAMMA * (two.0[c] / one.0[c]).log2());
        }
        sharper.push((two.1.max(1e-9) / one.1.max(1e-9)).ln());
    }
    let near = dot(p.view.forward(), q.view.forward()) > APART.to_radians().cos();
    if off.len() < SURE || !near {
        return None;
    }
    // Chance matches only add large distances: the lower quartile, as the median that it implies of normal errors.
    off.sort_by(f64::total_cmp);
    let own = QUARTILE_TO_MEDIAN * off[off.len() / 4];
    Some(Pair {
        stands: [a, b],
        off: [own * 0.5 * (unit(&p.view) + unit(&q.view)), own],
        gain: gains.map(|mut g| if g.len() < MATCHES { f64::NAN } else { median(&mut g) }),
        sharper: median(&mut sharper),
    })
}

/// The median over the pairs of a camera of what they say, with its sign as seen from the others.
fn of_camera(
    pairs: &[Pair],
    stands: &[(usize, &Stand)],
    camera: usize,
    f: &dyn Fn(&Pair) -> (f64, bool),
) -> Option<f64> {
    let own = |k: usize| stands[k].0 == camera;
    let mut values: Vec<f64> = pairs
        .iter()
        .filter(|p| own(p.stands[0]) || own(p.stands[1]))
        .map(|p| {
            let (value, signed) = f(p);
            if signed && own(p.stands[0]) { -value } else { value }
        })
        .filter(|v| v.is_finite())
        .collect();
    (!values.is_empty()).then(|| median(&mut values))
}

/// How far what a camera shows lies off, as those of its pairs say that are surest: pixels of 1920, and own ones.
fn poses(pairs: &[Pair], stands: &[(usize, &Stand)], camera: usize) -> Option<(f64, f64)> {
    let mut own: Vec<&Pair> = pairs.iter().filter(|p| p.stands.iter().any(|&k| stands[k].0 == camera)).collect();
    own.sort_by(|p, q| p.off[0].total_cmp(&q.off[0]));
    (own.len() >= TELL).then(|| (own[AGREE - 1].off[0], own[AGREE - 1].off[1]))
}

struct Told<'a> {
    report: &'a mut Report,
}

impl Told<'_> {
    fn add(
        &mut self,
        (grade, check): (Grade, &'static str),
        camera: Option<&str>,
        (amount, unit): (f64, &'static str),
        what: String,
        (looks, remedy): (&'static str, &str),
    ) {
        self.report.findings.push(Finding {
            grade,
            check,
            camera: camera.map(str::to_owned),
            amount: Some(amount),
            unit,
            what,
            looks,
            remedy: remedy.to_owned(),
            alike: Vec::new(),
        });
    }
}

/// Makes all checks and adds what they find.
pub(super) fn all(
    capture: &Capture,
    seen: &[Seen],
    options: &Options,
    report: &mut Report,
    progress: &mut Progress<'_>,
) {
    report.cameras = (capture.cameras.iter().zip(seen))
        .map(|(c, s)| CameraReport {
            name: c.name.clone(),
            fixed: c.fixed,
            picture: s.stands.first().map(|s| s.picture.clone()).unwrap_or_default(),
            ..CameraReport::default()
        })
        .collect();
    between(capture, seen, options, report, progress);
    clocks(capture, seen, report, progress);
    for (camera, s) in seen.iter().enumerate() {
        alone(capture, camera, s, report);
    }
    take(capture, seen, report);
    // Leaving out costs a view: only what no training mends, and only where enough are left.
    let gross = |f: &&Finding| f.grade == Grade::Bad && ["epipolar", "moved", "sharpness"].contains(&f.check);
    let mut out: Vec<String> = report.findings.iter().filter(gross).filter_map(|f| f.camera.clone()).collect();
    out.sort();
    out.dedup();
    gather(report, capture.cameras.len());
    if capture.cameras.len() > 1 && 2 * out.len() < capture.cameras.len() {
        report.leave_out = out;
    }
}

/// Makes one finding of the same fault of most cameras: the worst one's, which says how many there are.
fn gather(report: &mut Report, cameras: usize) {
    let mut out: Vec<Finding> = Vec::new();
    for f in std::mem::take(&mut report.findings) {
        let alike = |g: &&mut Finding| g.check == f.check && g.camera.is_some() && f.camera.is_some();
        let Some(kept) = out.iter_mut().find(alike) else {
            out.push(f);
            continue;
        };
        // Held together behind the first; split again below where they are few.
        kept.alike.push(f);
    }
    for mut first in out {
        let all = first.alike.len() + 1;
        if all < 3 || (all as f64) < MOST * cameras as f64 {
            let rest = std::mem::take(&mut first.alike);
            report.findings.push(first);
            report.findings.extend(rest);
            continue;
        }
        let mut rest = std::mem::take(&mut first.alike);
        rest.push(first);
        let size = |f: &Finding| (f.grade, f.amount.map_or(0.0, f64::abs));
        rest.sort_by(|a, b| size(a).partial_cmp(&size(b)).unwrap_or(std::cmp::Ordering::Equal));
        let mut worst = rest.pop().expect("there are at least three");
        worst.what = format!("{all} of {cameras} cameras ({}), for instance: {}", worst.check, worst.what);
        worst.alike = rest;
        report.findings.push(worst);
    }
}

fn between(capture: &Capture, seen: &[Seen], options: &Options, report: &mut Report, progress: &mut Progress<'_>) {
    let stands: Vec<(usize, &Stand)> =
        seen.iter().enumerate().flat_map(|(c, s)| s.stands.iter().map(move |stand| (c, stand))).collect();
    progress.phase("features", 0, stands.len());
    let name = |c: usize| capture.cameras[c].name.as_str();
    let sights: Vec<Sight> =
        stands.par_iter().enumerate().map(|(k, (c, s))| sight(name(*c), k, s, options.features)).collect();
    let found = links(&sights, Pairing::All, 0, progress);
    let pairs: Vec<Pair> = found.iter().filter_map(|l| pair(&stands, &sights, l.sights, &l.matches)).collect();
    if pairs.is_empty() {
        report
            .left
            .push("No two pictures have enough in common: poses, exposure and sharpness were not compared.".into());
        return;
    }
    let rig = seen.iter().filter(|s| !s.stands.is_empty()).count();
    for camera in 0..seen.len() {
        let (off, own) = poses(&pairs, &stands, camera).unzip();
        let gain = [0, 1, 2].map(|c| of_camera(&pairs, &stands, camera, &move |p| (p.gain[c], true)));
        let sharp = of_camera(&pairs, &stands, camera, &|p| (p.sharper, true)).map(f64::exp);
        let row = &mut report.cameras[camera];
        row.epipolar = off;
        if rig > 1 {
            if let [Some(r), Some(g), Some(b)] = gain {
                row.exposure = Some([r, g, b]);
            }
            row.sharpness = sharp;
        }
        let (exposure, sharpness) = (row.exposure, row.sharpness);
        let mut told = Told { report };
        if let (Some(off), Some(own)) = (off, own)
            && let Some(g) = grade(off, EPIPOLAR).min(grade(own, OWN_PIXELS))
        {
            let what = format!(
                "Camera {}: what it shows lies {off:.1} px (of 1920) beside where its pose and lens say.",
                name(camera)
            );
            let words = (
                "Doubled edges and blur in all views that show the same.",
                "Calibrate again, or refine its pose; else leave it out.",
            );
            told.add((g, "epipolar"), Some(name(camera)), (off, "px"), what, words);
        }
        if let Some([r, green, b]) = exposure {
            if let Some(g) = grade(green.abs(), EXPOSURE) {
                let way = if green > 0.0 { "brighter" } else { "darker" };
                let what = format!("Camera {} is {:.2} stops {way} than the others.", name(camera), green.abs());
                let words = (
                    "Brightness that changes with the view, and fog that explains it.",
                    "Lock exposure, correct its pictures, or keep exposure learnt.",
                );
                told.add((g, "exposure"), Some(name(camera)), (green, "stops"), what, words);
            }
            let tint = if (r - green).abs() > (b - green).abs() { r - green } else { b - green };
            if let Some(g) = grade(tint.abs(), EXPOSURE) {
                let what = format!(
                    "Camera {}: white balance differs by {:.2} stops (red {:+.2}, blue {:+.2} against green).",
                    name(camera),
                    tint.abs(),
                    r - green,
                    b - green
                );
                let words = (
                    "Colours that change with the view.",
                    "Lock white balance, correct its pictures, or keep exposure learnt.",
                );
                told.add((g, "white-balance"), Some(name(camera)), (tint, "stops"), what, words);
            }
        }
        if let Some(sharp) = sharpness
            && let Some(g) = grade(1.0 / sharp, SHARPNESS.map(|s| 1.0 / s))
        {
            let what =
                format!("Camera {} is {sharp:.2} times as sharp as the others at the same places.", name(camera));
            let words = ("Soft texture in the views around it.", "Focus it again; where it is bad, leave it out.");
            told.add((g, "sharpness"), Some(name(camera)), (sharp, "times"), what, words);
        }
    }
    let alone: Vec<usize> = (0..seen.len())
        .filter(|&c| rig > 1 && report.cameras[c].epipolar.is_none() && !seen[c].stands.is_empty())
        .collect();
    for camera in alone {
        report.left.push(format!("Camera {} shares too few features with others to be compared.", name(camera)));
    }
}

pub(super) fn clocks(capture: &Capture, seen: &[Seen], report: &mut Report, progress: &mut Progress<'_>) {
    let ready: Vec<usize> =
        (0..seen.len()).filter(|&c| capture.cameras[c].fixed && seen[c].tracks.len() >= MATCHES).collect();
    if ready.len() < 2 {
        report.left.push(
            "Clocks were not compared: that needs fixed cameras in which something moves over several frames.".into(),
        );
        return;
    }
    let view = |c: usize| &seen[c].stands[0].view;
    let mut chosen: Vec<[usize; 2]> = Vec::new();
    for &a in &ready {
        let far = |b: usize| norm(sub(view(a).center(), view(b).center()));
        let mut others: Vec<usize> = ready.iter().copied().filter(|&b| b != a).collect();
        others.sort_by(|&i, &j| far(i).total_cmp(&far(j)));
        chosen.extend(others.iter().take(NEIGHBOURS).map(|&b| [a.min(b), a.max(b)]));
    }
    chosen.sort_unstable();
    chosen.dedup();
    progress.phase("comparing clocks", 0, chosen.len());
    let interval = ready.iter().map(|&c| seen[c].clock.interval).fold(0.0, f64::max);
    let evidence: Vec<Evidence> = chosen
        .par_iter()
        .filter_map(|&[a, b]| {
            let f = fundamental(view(a), view(b));
            let frames = WITHIN.min(WITHIN_PART * seen[a].row.min(seen[b].row) as f64);
            let range = Range { around: 0.0, within: frames * interval };
            let found = lag(&f, [&seen[a].tracks, &seen[b].tracks], None, range).ok()?;
            Some(Evidence {
                cameras: [a, b],
                lag: found.seconds,
                sigma: found.sigma,
                drift: None,
                kind: Kind::Geometry,
            })
        })
        .collect();
    let mut known: Vec<usize> = evidence.iter().flat_map(|e| e.cameras).collect();
    known.sort_unstable();
    known.dedup();
    let Some(&first) = known.first() else {
        report.left.push("Clocks were not compared: no two cameras show the same motion.".into());
        return;
    };
    // The clock of one that is connected, then of the median: whichever camera is off, it is that one.
    let mut given = vec![None; seen.len()];
    given[first] = Some(0.0);
    let solution = solve(seen.len(), &evidence, &given, 0.5 * interval);
    // A lag alone is not checked by any other; the camera that is the clock has a deviation too.
    let kept = |k: &usize| solution.refused.iter().all(|r| r.evidence != *k);
    let sigma = |c: usize| {
        let own = (0..evidence.len()).filter(kept).filter(|&k| evidence[k].cameras.contains(&c));
        let mut all: Vec<f64> = own.map(|k| evidence[k].sigma).collect();
        (all.len() >= AGREE).then(|| median(&mut all))
    };
    let offsets: Vec<(usize, f64, f64)> = (0..seen.len())
        .filter_map(|c| solution.offsets[c].as_ref().zip(sigma(c)).map(|(o, s)| (c, o.seconds, s)))
        .collect();
    let middle = median(&mut offsets.iter().map(|o| o.1).collect::<Vec<_>>());
    for (c, seconds, sigma) in offsets {
        let off = seconds - middle;
        report.cameras[c].offset = Some([off, sigma]);
        let speeds =
            seen[c].tracks.iter().flat_map(|t| t.samples.windows(2)).map(|w| {
                (w[1].1[0] - w[0].1[0]).hypot(w[1].1[1] - w[0].1[1]) / (w[1].0 - w[0].0).max(f64::MIN_POSITIVE)
            });
        let speed = median(&mut speeds.collect::<Vec<_>>()) * unit(view(c));
        let blur = off.abs() * speed;
        let sure = off.abs() > (OFFSET_SIGMAS * sigma).max(OFFSET_FRAMES * interval);
        if let Some(g) = grade(blur, OFFSET).filter(|_| sure) {
            let name = &capture.cameras[c].name;
            let way = if off > 0.0 { "early" } else { "late" };
            let what = format!(
                "Camera {name}: its clock is {:.1} ± {:.1} ms {way}: what moves is {blur:.1} px (of 1920) off.",
                1e3 * off.abs(),
                1e3 * sigma
            );
            let remedy = format!("Add {:+.4} s to its times.", off);
            Told { report }.add(
                (g, "offset"),
                Some(name),
                (1e3 * off, "ms"),
                what,
                ("Moving things blurred or doubled.", &remedy),
            );
        }
    }
}

/// What a camera's own pictures say.
fn alone(capture: &Capture, camera: usize, s: &Seen, report: &mut Report) {
    let name = capture.cameras[camera].name.clone();
    let who = Some(name.as_str());
    if let (Some(moved), Some(stand)) = (s.moved, s.stands.first()) {
        let far = moved * unit(&stand.view);
        report.cameras[camera].moved = Some(far);
        let limits = worse(MOVED, MOVED_PIXELS.map(|p| p * unit(&stand.view)));
        if let Some(g) = grade(far, limits) {
            let what = format!("Camera {name} moved: what stands still went {far:.1} px (of 1920) from first to last.");
            let words =
                ("Everything it shows is doubled.", "Fasten it; cut the take where it was pushed, or leave it out.");
            Told { report }.add((g, "moved"), who, (far, "px"), what, words);
        }
    }
    let mut told = Told { report };
    let frames = capture.frames.iter().filter(|f| f.camera == camera).count();
    if frames >= 4 && capture.cameras[camera].fixed {
        let missing = s.clock.missing();
        if let Some(g) = grade(missing as f64 / (frames + missing) as f64, FRAMES) {
            let what = format!("Camera {name}: {missing} frames are missing between others.");
            told.add(
                (g, "dropped"),
                who,
                (missing as f64, "frames"),
                what,
                ("Jerks of what moves.", "Record to a faster card, or extract without a rate."),
            );
        }
        let doubled = s.clock.doubled.len();
        if let Some(g) = grade(doubled as f64 / s.row.max(1) as f64, FRAMES) {
            let what = format!("Camera {name}: {doubled} of {} pictures show the one before again.", s.row);
            told.add(
                (g, "doubled"),
                who,
                (doubled as f64, "frames"),
                what,
                ("What moves stops and jumps.", "Remove them; extract frames without changing the rate."),
            );
        }
    }
    let jumps = |w: &[f64]| (GAMMA * (w[1] / (0.5 * (w[0] + w[2])).max(1.0)).max(1e-6).log2()).abs();
    let mut steps: Vec<f64> = s.means.windows(3).map(jumps).collect();
    if steps.len() >= 4 && capture.cameras[camera].fixed {
        let flicker = median(&mut steps);
        if let Some(g) = grade(flicker, FLICKER) {
            let what =
                format!("Camera {name} flickers: brightness jumps by {flicker:.2} stops from picture to picture.");
            told.add(
                (g, "flicker"),
                who,
                (flicker, "stops"),
                what,
                ("A scene that flickers too.", "Lock exposure; choose a shutter that fits the lamps (1/50 or 1/60 s)."),
            );
        }
    }
    if s.detail.len() >= 5 && capture.cameras[camera].fixed {
        let usual = median(&mut s.detail.clone());
        let soft = s.detail.iter().filter(|d| **d < SHARPNESS[0] * usual).count();
        if soft > 0 {
            let what = format!("Camera {name}: {soft} of {} pictures are blurred, against its others.", s.detail.len());
            told.add(
                (Grade::Warning, "blurred"),
                who,
                (soft as f64, "frames"),
                what,
                ("Softness that comes and goes.", "Shorter exposure, fixed focus; leave these pictures out."),
            );
        }
    }
    if let Some(g) = grade(s.blocks, BLOCKS) {
        let what = format!("Camera {name} is compressed hard: its pictures have edges every 8 pixels.");
        told.add(
            (g, "compression"),
            who,
            (s.blocks, "of 255"),
            what,
            ("Texture of blocks, and noise in what is flat.", "Record with a higher rate of bits."),
        );
    }
    let mean = s.means.iter().sum::<f64>() / s.means.len().max(1) as f64;
    let masked = capture.background.is_some() || capture.frames.iter().any(|f| f.mask.is_some());
    if !masked && !s.means.is_empty() && mean < DARK {
        let what = format!("Camera {name} is very dark: {mean:.0} of 255 on average.");
        told.add(
            (Grade::Warning, "dark"),
            who,
            (mean, "of 255"),
            what,
            ("Noise is learnt for texture.", "More light, or longer exposure."),
        );
    }
    for (part, word) in s.clipped.into_iter().zip(["black", "white"]) {
        if !masked && part > CLIPPED {
            let what = format!("Camera {name}: {:.0} % of its values are {word}, cut off.", 100.0 * part);
            told.add(
                (Grade::Warning, "clipped"),
                who,
                (100.0 * part, "%"),
                what,
                ("Flat patches without shape.", "Change the exposure."),
            );
        }
    }
    if s.sizes.len() > 1 {
        let what = format!("Camera {name} has pictures of {} sizes.", s.sizes.len());
        told.add(
            (Grade::Note, "sizes"),
            who,
            (s.sizes.len() as f64, "sizes"),
            what,
            ("", "Check that its lens is told for each of them."),
        );
    }
}

/// What the whole rig says.
fn take(capture: &Capture, seen: &[Seen], report: &mut Report) {
    let fixed: Vec<usize> =
        (0..seen.len()).filter(|&c| capture.cameras[c].fixed && !seen[c].stands.is_empty()).collect();
    if fixed.len() < seen.len() {
        report.left.push(
            "Moving cameras: whether a camera moved, its flicker, frames and clock are told of fixed ones only.".into(),
        );
        return;
    }
    if fixed.len() < CAMERAS[0] {
        let g = if fixed.len() < CAMERAS[1] { Grade::Bad } else { Grade::Warning };
        let word = if g == Grade::Bad { "poor" } else { "limited" };
        let what = format!("{} cameras: what can be learnt is {word}.", fixed.len());
        Told { report }.add(
            (g, "cameras"),
            None,
            (fixed.len() as f64, "cameras"),
            what,
            ("Good pictures only near the cameras.", "Six and more, all round the scene."),
        );
    }
    if fixed.len() < 2 {
        return;
    }
    let views: Vec<&Camera> = fixed.iter().map(|&c| &seen[c].stands[0].view).collect();
    let middles: Vec<triangulate::Sight<'_>> = views
        .iter()
        .map(|&v| triangulate::Sight { camera: v, pixel: [0.5 * v.width as f64, 0.5 * v.height as f64] })
        .collect();
    let Some(target) = triangulate::triangulate(&middles) else {
        report.left.push("Angles between cameras were not judged: they look at no common place.".into());
        return;
    };
    for (k, view) in views.iter().enumerate() {
        let others = views.iter().enumerate().filter(|(j, _)| *j != k);
        let nearest =
            others.map(|(_, o)| angle_at(target, view.center(), o.center()).to_degrees()).fold(f64::MAX, f64::min);
        if let Some(g) = grade(nearest, ANGLE) {
            let name = &capture.cameras[fixed[k]].name;
            let what = format!("Camera {name} stands {nearest:.0}° from its nearest neighbour.");
            Told { report }.add(
                (g.min(Grade::Warning), "angle"),
                Some(name),
                (nearest, "°"),
                what,
                ("Floaters and wrong shape between them.", "A camera in the gap."),
            );
        }
    }
}
