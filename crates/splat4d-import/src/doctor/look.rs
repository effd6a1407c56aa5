//! Examined images of a camera: a few images over the recording, and some in a row.

use super::Options;
use crate::Result;
use crate::sync::grey::{Grey, Pyramid};
use crate::sync::median;
use crate::sync::tracks::{APART, LEVELS, PIXELS, Track, Tracker, corners, follow, moving, small};
use crate::video::{Clock, mean_difference};
use splat4d::math::median_by;
use splat4d::scene::{Camera, Planes};
use splat4d_train::capture::{Capture, ImageStore, Rgb8};

/// Images over the recording whose median is the static background.
const SPREAD: usize = 15;
/// From this many on a median gives the static background.
const MEDIAN_FROM: usize = 3;
/// Images of a moving camera that are compared with others.
const STANDS: usize = 16;
/// A value at or above (at or below one minus) this is clipped, of 255.
const CLIPPED: [u8; 2] = [2, 253];
/// Corners that must be found again before a camera is declared to have moved.
const CORNERS: usize = 12;
/// Pixels along a side of the cells that motion is noted in.
pub(super) const CELL: usize = 8;
/// A cell moves from this part of its pixels on.
const MOVING: f64 = 0.25;

/// An image from a position: of the static background, or one of a moving camera.
pub(super) struct Viewpoint {
    /// Its number in the capture; the first of those that a median is of.
    pub(super) frame: usize,
    pub(super) view: Camera,
    pub(super) picture: Rgb8,
}

/// Measurements of a camera.
#[derive(Default)]
pub(super) struct CameraObservations {
    pub(super) viewpoints: Vec<Viewpoint>,
    /// Corners that move, by the camera's clock.
    pub(super) tracks: Vec<Track>,
    pub(super) clock: Clock,
    /// Images that were examined in a row.
    pub(super) row: usize,
    /// Mean of 255 and detail of images in a row.
    pub(super) means: Vec<f64>,
    pub(super) detail: Vec<f64>,
    /// Part of the pixels that is black, and white.
    pub(super) clipped: [f64; 2],
    /// Step across the borders of blocks of 8 pixels over that elsewhere.
    pub(super) blocks: f64,
    /// Pixels that the background moved.
    pub(super) moved: Option<f64>,
    /// Detail of the recording's last third relative to its first.
    pub(super) focus: Option<f64>,
    /// The cells, row by row, in which something moves, of images evenly over the recording.
    pub(super) motion: Vec<Vec<bool>>,
    pub(super) sizes: Vec<[usize; 2]>,
}

/// How often an image of this size is halved.
fn halvings(view: &Camera) -> u32 {
    (0..).find(|k| (view.width >> k) * (view.height >> k) <= PIXELS).unwrap_or(0)
}

/// The view of an examined image.
fn reduced(view: &Camera) -> Camera {
    view.downscaled(1 << halvings(view))
}

fn bytes(color: &Planes<f32>) -> Rgb8 {
    let data = color.interleaved().iter().map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8).collect();
    small(Rgb8 { width: color.width, height: color.height, data }).0
}

/// Numbers evenly among this many, the first and last with them.
fn spread(of: usize, count: usize) -> Vec<usize> {
    match of.min(count) {
        0 => Vec::new(),
        1 => vec![0],
        kept => (0..kept).map(|k| k * (of - 1) / (kept - 1)).collect(),
    }
}

fn median_of(all: &[Rgb8]) -> Rgb8 {
    let mut out = all[all.len() / 2].clone();
    if all.len() >= MEDIAN_FROM {
        let mut values = vec![0; all.len()];
        for (p, v) in out.data.iter_mut().enumerate() {
            values.iter_mut().zip(all).for_each(|(v, a)| *v = a.data[p]);
            *v = median_by(&mut values, u8::cmp).expect("there are images");
        }
    }
    out
}

/// Mean absolute second difference: what blur takes away first.
pub(super) fn detail(g: &Grey) -> f64 {
    let (w, h) = (g.width, g.height);
    if w < 3 || h < 3 {
        return 0.0;
    }
    let mut sum = 0.0;
    for y in 1..h - 1 {
        for x in 1..w - 1 {
            let p = y * w + x;
            let d = 4.0 * g.data[p] - g.data[p - 1] - g.data[p + 1] - g.data[p - w] - g.data[p + w];
            sum += f64::from(d.abs());
        }
    }
    sum / ((w - 2) * (h - 2)) as f64
}

/// How much larger steps are across borders of blocks of 8 pixels than elsewhere.
fn blocks(g: &Grey) -> f64 {
    /// Pixels of a block of JPEG and of most videos.
    const BLOCK: usize = 8;
    let mut sums = [[0.0f64; 2]; 2];
    for row in g.data.chunks_exact(g.width) {
        for x in 2..g.width.saturating_sub(1) {
            // The bend of a step, so that slopes of the image itself count little.
            let step =
                (row[x] - row[x - 1]).abs() - 0.5 * ((row[x - 1] - row[x - 2]).abs() + (row[x + 1] - row[x]).abs());
            let side = usize::from(x % BLOCK == 0);
            sums[side][0] += f64::from(step);
            sums[side][1] += 1.0;
        }
    }
    let mean = |k: usize| sums[k][0] / f64::max(sums[k][1], 1.0);
    255.0 * (mean(1) - mean(0))
}

/// The cells of an image that differ from the static background.
fn cells(picture: &Grey, still: &Grey) -> Vec<bool> {
    let (across, down) = (picture.width.div_ceil(CELL), picture.height.div_ceil(CELL));
    let mut counts = vec![[0usize; 2]; across * down];
    for (p, m) in moving(picture, still).into_iter().enumerate() {
        let count = &mut counts[p / picture.width / CELL * across + p % picture.width / CELL];
        count[0] += usize::from(m);
        count[1] += 1;
    }
    counts.into_iter().map(|[m, all]| m as f64 >= MOVING * all.max(1) as f64).collect()
}

/// How much more detail the last third of images has than the first, relative to their brightness.
fn focus(pictures: &[Rgb8]) -> Option<f64> {
    /// Images of a third.
    const LEAST: usize = 2;
    let third = pictures.len() / 3;
    if third < LEAST {
        return None;
    }
    let fine = |p: &Rgb8| {
        let g = Grey::of(p);
        let mean = g.data.iter().map(|v| f64::from(*v)).sum::<f64>() / g.data.len().max(1) as f64;
        detail(&g) / mean.max(f64::MIN_POSITIVE)
    };
    let of = |part: &[Rgb8]| median(&mut part.iter().map(fine).collect::<Vec<_>>());
    let (first, last) = (of(&pictures[..third]), of(&pictures[pictures.len() - third..]));
    (first > 0.0).then(|| last / first)
}

/// How far the background moved from the first images to the last, pixels: the median of corners next to which
/// nothing
/// moves in either of them. `None` if there are too few.
fn moved(ends: [&[Rgb8]; 2]) -> Option<f64> {
    let still = ends.map(|end| Grey::of(&median_of(end)));
    let across = still[0].width.div_ceil(CELL);
    let restless = [0, 1].map(|k| {
        let seen = ends[k].iter().map(|p| cells(&Grey::of(p), &still[k]));
        seen.reduce(|a, b| a.iter().zip(&b).map(|(a, b)| a | b).collect()).unwrap_or_default()
    });
    // The cell of a position, and those around it, which its window reaches into.
    let rests = |k: usize, p: &[f64; 2]| {
        let [x, y] = p.map(|v| v.max(0.0) as usize / CELL);
        let down = restless[k].len() / across;
        (y.saturating_sub(1)..(y + 2).min(down))
            .all(|y| (x.saturating_sub(1)..(x + 2).min(across)).all(|x| !restless[k][y * across + x]))
    };
    let width = still[0].width;
    let wanted: Vec<bool> =
        (0..still[0].data.len()).map(|i| rests(0, &[(i % width) as f64, (i / width) as f64])).collect();
    let found = corners(&still[0], Some(&wanted), 120, APART, &[]);
    let [a, b] = still.map(|g| Pyramid::new(g, LEVELS));
    let there = follow(&a, &b, &found);
    let way =
        |(p, q): (&[f64; 2], &Option<[f64; 2]>)| q.filter(|q| rests(1, q)).map(|q| (p[0] - q[0]).hypot(p[1] - q[1]));
    let mut ways: Vec<f64> = found.iter().zip(&there).filter_map(way).collect();
    (ways.len() >= CORNERS).then(|| median(&mut ways))
}

pub(super) fn camera(
    capture: &Capture,
    store: &ImageStore,
    camera: usize,
    options: &Options,
) -> Result<CameraObservations> {
    let mut frames: Vec<usize> = (0..capture.frames.len()).filter(|&i| capture.frames[i].camera == camera).collect();
    frames.sort_by(|&i, &j| capture.frames[i].time.0.total_cmp(&capture.frames[j].time.0));
    let fixed = capture.cameras[camera].fixed;
    let load = |i: usize| Ok::<Rgb8, crate::Error>(bytes(&store.load(i)?.to_picture().color));
    let mut seen = CameraObservations::default();
    let size = |i: usize| [capture.frames[i].source.width, capture.frames[i].source.height];
    seen.sizes = frames.iter().map(|&i| size(i)).collect();
    seen.sizes.sort_unstable();
    seen.sizes.dedup();
    let chosen: Vec<usize> =
        spread(frames.len(), if fixed { SPREAD } else { STANDS }).iter().map(|&k| frames[k]).collect();
    let pictures: Vec<Rgb8> = chosen.iter().map(|&i| load(i)).collect::<Result<_>>()?;
    let Some(one) = pictures.first() else { return Ok(seen) };
    let same = pictures.iter().all(|p| (p.width, p.height) == (one.width, one.height));
    let all: Vec<u8> = pictures.iter().flat_map(|p| p.data.iter().copied()).collect();
    let part = |f: &dyn Fn(u8) -> bool| all.iter().filter(|v| f(**v)).count() as f64 / all.len().max(1) as f64;
    seen.clipped = [part(&|v| v <= CLIPPED[0]), part(&|v| v >= CLIPPED[1])];
    if pictures.iter().any(|p| p.width.min(p.height) < 32) {
        return Ok(seen);
    }
    // Blocks of images that were made smaller are no longer of 8 pixels.
    if halvings(&capture.frames[chosen[0]].view) == 0 {
        seen.blocks = blocks(&Grey::of(&pictures[pictures.len() / 2]));
    }
    if fixed && same {
        let third = (pictures.len() / 3).min(3);
        if third > 0 {
            seen.moved = moved([&pictures[..third], &pictures[pictures.len() - third..]]);
        }
        seen.focus = focus(&pictures);
        let picture = median_of(&pictures);
        if pictures.len() >= MEDIAN_FROM {
            let still = Grey::of(&picture);
            seen.motion = pictures.iter().map(|p| cells(&Grey::of(p), &still)).collect();
        }
        seen.viewpoints.push(Viewpoint { frame: chosen[0], view: reduced(&capture.frames[chosen[0]].view), picture });
    } else {
        for (&i, picture) in chosen.iter().zip(pictures) {
            seen.viewpoints.push(Viewpoint { frame: i, view: reduced(&capture.frames[i].view), picture });
        }
    }
    let first = (frames.len() - frames.len().min(options.window)) / 2;
    // Of a moving camera only the darkness is needed, for which a few images suffice.
    let row = if fixed { &frames[first..first + frames.len().min(options.window)] } else { &chosen[..] };
    let still = (fixed && same && frames.len() >= MEDIAN_FROM).then(|| Grey::of(&seen.viewpoints[0].picture));
    let mut tracker = Tracker::new(options.tracks, APART);
    let mut differences = Vec::new();
    let mut last: Option<Rgb8> = None;
    for (k, &i) in row.iter().enumerate() {
        let picture = if fixed { load(i)? } else { seen.viewpoints[k].picture.clone() };
        if let Some(last) = &last {
            differences.push((first + k, mean_difference(last, &picture)));
        }
        let grey = Grey::of(&picture);
        seen.means.push(255.0 * grey.data.iter().map(|v| f64::from(*v)).sum::<f64>() / grey.data.len() as f64);
        seen.detail.push(detail(&grey));
        if let Some(still) = &still {
            let mask = moving(&grey, still);
            tracker.push(capture.frames[i].time.0, grey, Some(&mask));
        }
        last = Some(picture);
    }
    let times: Vec<f64> = frames.iter().map(|&i| capture.frames[i].time.0).collect();
    seen.clock = Clock::of(&times, &differences);
    seen.row = row.len();
    seen.tracks = tracker.finish();
    Ok(seen)
}
