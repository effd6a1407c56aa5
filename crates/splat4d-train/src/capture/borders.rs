//! Black borders: pixels that no lens recorded. Undistorting an image leaves them along its edges, letterboxing above
//! and below, a fisheye lens around its circle. A scene that was trained on them has black Gaussians in front of its
//! cameras, and no scene can be scored there.
//!
//! A pixel belongs to a border if it is black in all sampled images of one lens and connected to the image's edge by
//! such pixels. That alone would also find the black background of a photographed object. Next to a border there is
//! scene content, next to an object's outline there is background: so a border counts only if the images are mostly
//! bright a few pixels further inside.
//!
//! The same images are examined for every part of a capture: the first image of each fixed camera, and images of moving
//! ones evenly. The parts of one run get what the first of them found ([`Lenses`]).

use super::account::Severity;
use super::account::{Aspect, Remark};
use super::options::{Borders, Lens100};
use super::{Capture, CaptureOptions, Frame, panorama, picture};
use rayon::prelude::*;
use splat4d::scene::Lens;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;

/// Images of a lens that are examined: content that is black by chance is black in all of them hardly ever.
const LOOKED_AT: usize = 16;
/// Pixels that are decoded of one lens at most, where that leaves [`FEWEST`] images: it bounds the time.
const PIXELS: usize = 30_000_000;
/// With fewer views of different places, what is black in all of them may be an object.
const FEWEST: usize = 6;
/// Lenses that are examined, those with the most images first: it bounds the time.
const LENSES: usize = 8;
/// Largest value that counts as black, of 255: JPEG's ringing reaches 30 next to bright content.
const BLACK: u8 = 40;
/// Pixels beyond a border that interpolation and JPEG have mixed with it.
const MIXED: usize = 2;
/// How far behind a border the content is examined, pixels.
const INSIDE: usize = MIXED + 2;
/// Share of the content behind a border that is not black. Chosen between the two kinds: content is bright in most
/// places, and the outline of an object on black is dark in nearly all images. Ten real and synthetic captures are
/// distinguished (studies/records/2026-11-26-real-size.md).
const BRIGHT: f64 = 0.5;
/// Share of each of two opposite edges that is black: an undistorted or letterboxed image has both.
const OF_AN_EDGE: f64 = 0.5;
/// Largest share of an image that borders cover: a circle of full height leaves 41 % of a 4:3 image and 56 % of a 16:9
/// image black.
const LARGEST: f64 = 0.6;

/// Images that are decoded at a time after the first: most lenses have no border, and one image states so.
const AT_ONCE: usize = 4;

/// Finds the borders of a capture's images and gives them to its frames; states so in the account. `firsts`: the first
/// image of cameras of which only a part of the frames is listed.
pub(super) fn find(capture: &mut Capture, options: &CaptureOptions, firsts: &BTreeMap<usize, PathBuf>) {
    if options.borders == Borders::Keep {
        return;
    }
    let (mut images, mut share) = (0, 0.0);
    for (lens, frames) in by_lens(capture).into_iter().take(LENSES) {
        let found = match options.lenses.0.get(&lens) {
            Some(known) => known.clone(),
            None => recorded(&views(capture, &frames, firsts)).map(Arc::new),
        };
        capture.lenses.0.insert(lens, found.clone());
        let Some(recorded) = found else { continue };
        let black = recorded.iter().filter(|p| **p == 0).count() as f64 / recorded.len() as f64;
        images += frames.len();
        share += black * frames.len() as f64;
        frames.iter().for_each(|&i| capture.frames[i].recorded = Some(Arc::clone(&recorded)));
    }
    if images > 0 {
        let what = format!(
            "{images} images have black borders, as undistortion and letterboxing leave them ({:.1} % of their pixels): \
             these pixels are neither trained nor scored (capture.borders=keep uses them).",
            100.0 * share / images as f64
        );
        capture.account.push(Remark { aspect: Aspect::Assumed, severity: Severity::Note, what });
    }
}

/// The frames of every lens, the most first.
fn by_lens(capture: &Capture) -> Vec<(Lens100, Vec<usize>)> {
    let mut lenses: BTreeMap<Lens100, Vec<usize>> = BTreeMap::new();
    for (i, frame) in capture.frames.iter().enumerate() {
        let (source, k) = (&frame.source, &frame.source.intrinsics);
        if matches!(source.lens, Lens::Equirectangular { .. }) {
            continue; // The file's pixels are not those of its views.
        }
        let mut key = vec![source.width as i64, source.height as i64, i64::from(frame.upright)];
        key.extend([k.fx, k.fy, k.cx, k.cy].map(|x| (100.0 * x).round() as i64));
        lenses.entry(key).or_default().push(i);
    }
    let mut lenses: Vec<(Lens100, Vec<usize>)> = lenses.into_iter().collect();
    lenses.sort_by_key(|(_, frames)| (std::cmp::Reverse(frames.len()), frames[0]));
    lenses
}

/// A few frames from different places: the first of each fixed camera, and those of moving ones, evenly.
fn views(capture: &Capture, frames: &[usize], firsts: &BTreeMap<usize, PathBuf>) -> Vec<Frame> {
    let mut seen = BTreeSet::new();
    let rig = |i: usize| capture.frames[i].camera;
    let mut views: Vec<usize> =
        frames.iter().copied().filter(|&i| !capture.cameras[rig(i)].fixed || seen.insert(rig(i))).collect();
    let size = frames.first().map_or(1, |&i| capture.frames[i].source.width * capture.frames[i].source.height);
    let most = (PIXELS / size.max(1)).clamp(FEWEST, LOOKED_AT);
    if views.len() > most {
        views = (0..most).map(|k| views[k * views.len() / most]).collect();
    }
    let first = |i: usize| {
        let frame = capture.frames[i].clone();
        let image = firsts.get(&frame.camera).filter(|_| capture.cameras[frame.camera].fixed).cloned();
        Frame { image: image.unwrap_or_else(|| frame.image.clone()), ..frame }
    };
    views.into_iter().map(first).collect()
}

/// [height · width] what the lens of these frames recorded, 1 or 0; `None`: everything, or undetermined. Decodes no
/// more images than it takes.
fn recorded(views: &[Frame]) -> Option<Vec<u8>> {
    if views.len() < FEWEST {
        return None;
    }
    let (width, height) = (views[0].source.width, views[0].source.height);
    let mut bright: Vec<Vec<bool>> = Vec::new();
    let mut black = vec![true; width * height];
    let mut next = 0;
    while next < views.len() {
        let end = if next == 0 { 1 } else { views.len().min(next + AT_ONCE) };
        // A damaged file is refused when it is trained on.
        let some: Vec<Vec<bool>> = views[next..end].par_iter().filter_map(not_black).collect();
        for image in &some {
            black.iter_mut().zip(image).for_each(|(black, bright)| *black &= !bright);
        }
        bright.extend(some);
        if !has_edges(&black, width, height) {
            return None;
        }
        next = end;
    }
    if bright.len() < FEWEST {
        return None;
    }
    border(&bright, width, height)
}

/// Non-black pixels of an image; `None`: it cannot be read or is transparent in places, so that its colours there mean
/// nothing.
fn not_black(frame: &Frame) -> Option<Vec<bool>> {
    let raster = picture::decode_as(&frame.image, Some(&panorama::stored(&frame.source)), frame.upright).ok()?;
    let colours = if raster.channels < 3 { 1 } else { 3 };
    let least = f32::from(BLACK) / 255.0;
    let pixels = raster.width * raster.height;
    if raster.alpha().is_some_and(|a| (0..pixels).any(|p| raster.get(p, a) < 1.0)) {
        return None;
    }
    Some((0..pixels).map(|p| (0..colours).any(|c| raster.get(p, c) > least)).collect())
}

/// Recorded pixels, 1 or 0, of images of one size that are `bright` in places; `None`: no border is found.
fn border(bright: &[Vec<bool>], width: usize, height: usize) -> Option<Vec<u8>> {
    let mut black = vec![true; width * height];
    for image in bright {
        black.iter_mut().zip(image).for_each(|(black, bright)| *black &= !bright);
    }
    if !has_edges(&black, width, height) {
        return None;
    }
    let outer = from_edges(&black, width, height);
    let mixed = grown(&outer, width, height, MIXED);
    let inside = grown(&outer, width, height, INSIDE);
    let behind: Vec<usize> = (0..width * height).filter(|&p| inside[p] && !mixed[p]).collect();
    let seen = behind.iter().map(|&p| bright.iter().filter(|image| image[p]).count()).sum::<usize>();
    let covered = mixed.iter().filter(|m| **m).count();
    let counts = seen as f64 >= BRIGHT * (behind.len() * bright.len()) as f64
        && !behind.is_empty()
        && covered as f64 <= LARGEST * (width * height) as f64;
    counts.then(|| mixed.iter().map(|&m| u8::from(!m)).collect())
}

/// Whether two opposite edges are mostly of this set, as borders are.
fn has_edges(black: &[bool], width: usize, height: usize) -> bool {
    let share = |edge: &mut dyn Iterator<Item = usize>| {
        let (mut all, mut of) = (0, 0);
        edge.for_each(|p| (all, of) = (all + 1, of + usize::from(black[p])));
        f64::from(of as u32) / f64::from(all as u32)
    };
    let across = [share(&mut (0..width)), share(&mut (width * (height - 1)..width * height))];
    let down = [share(&mut (0..height).map(|y| y * width)), share(&mut (0..height).map(|y| (y + 1) * width - 1))];
    [across, down].iter().any(|[a, b]| a.min(*b) >= OF_AN_EDGE)
}

/// The pixels that are connected to an edge of the image by pixels of the set.
fn from_edges(set: &[bool], width: usize, height: usize) -> Vec<bool> {
    let mut out = vec![false; set.len()];
    let edges = (0..width).flat_map(|x| [x, (height - 1) * width + x]);
    let edges = edges.chain((0..height).flat_map(|y| [y * width, (y + 1) * width - 1]));
    let mut queue: VecDeque<usize> = edges.filter(|&p| set[p]).collect();
    queue.iter().for_each(|&p| out[p] = true);
    while let Some(p) = queue.pop_front() {
        let (x, y) = (p % width, p / width);
        let around = [(x > 0, p.wrapping_sub(1)), (x + 1 < width, p + 1)];
        let around = around.into_iter().chain([(y > 0, p.wrapping_sub(width)), (y + 1 < height, p + width)]);
        for (_, q) in around.filter(|&(is, _)| is) {
            if set[q] && !std::mem::replace(&mut out[q], true) {
                queue.push_back(q);
            }
        }
    }
    out
}

/// The set dilated by this distance, along rows and columns.
fn grown(set: &[bool], width: usize, height: usize, by: usize) -> Vec<bool> {
    let near = |i: usize, end: usize| i.saturating_sub(by)..(i + by + 1).min(end);
    let rows: Vec<bool> = (0..width * height).map(|p| near(p % width, width).any(|x| set[p - p % width + x])).collect();
    (0..width * height).map(|p| near(p / width, height).any(|y| rows[y * width + p % width])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 40;
    const HEIGHT: usize = 30;

    /// Images that are bright where the function states: of image, column and row.
    fn images(count: usize, bright: impl Fn(usize, usize, usize) -> bool) -> Vec<Vec<bool>> {
        (0..count).map(|i| (0..WIDTH * HEIGHT).map(|p| bright(i, p % WIDTH, p / WIDTH)).collect()).collect()
    }

    /// Scene content: a third is dark, at other places in every image.
    fn content(image: usize, x: usize, y: usize) -> bool {
        !(x / 3 + 2 * (y / 3) + image).is_multiple_of(3)
    }

    fn missing(found: &Option<Vec<u8>>, x: usize, y: usize) -> bool {
        found.as_ref().unwrap()[y * WIDTH + x] == 0
    }

    #[test]
    fn borders_of_undistortion_and_letterboxes_are_found() {
        // Curved: one column at the middle of the left and right edges, three at the corners.
        let width = |y: usize| if (8..22).contains(&y) { 1 } else { 3 };
        let curved = images(8, |i, x, y| (width(y)..WIDTH - width(y)).contains(&x) && content(i, x, y));
        let found = border(&curved, WIDTH, HEIGHT);
        assert!(missing(&found, 0, 15) && missing(&found, 2, 15), "and what is mixed with the border");
        assert!(!missing(&found, 3, 15) && missing(&found, 3, 2) && !missing(&found, 20, 0));
        let letterbox = images(8, |i, x, y| (4..26).contains(&y) && content(i, x, y));
        let found = border(&letterbox, WIDTH, HEIGHT);
        assert!(missing(&found, 20, 3) && missing(&found, 20, 29) && !missing(&found, 0, 15));
        let circle = images(8, |i, x, y| {
            let [dx, dy] = [x as f64 - 19.5, y as f64 - 14.5];
            dx * dx + dy * dy < 15.0 * 15.0 && content(i, x, y)
        });
        assert!(missing(&border(&circle, WIDTH, HEIGHT), 1, 1));
    }

    #[test]
    fn black_content_is_no_border() {
        assert_eq!(border(&images(8, content), WIDTH, HEIGHT), None);
        // An object on black, which turns: its outline is another in every image.
        let object = images(8, |i, x, y| {
            let (dx, dy) = (x as f64 - 20.0, y as f64 - 15.0);
            let (sin, cos) = (0.4 * i as f64).sin_cos();
            let (u, v) = (cos * dx + sin * dy, cos * dy - sin * dx);
            (u / 13.0).powi(2) + (v / 5.0).powi(2) < 1.0
        });
        assert_eq!(border(&object, WIDTH, HEIGHT), None);
        // A dark bonnet that moves with its camera touches one edge.
        let bonnet = images(8, |i, x, y| y < 24 && content(i, x, y));
        assert_eq!(border(&bonnet, WIDTH, HEIGHT), None);
        // Black inside the image, connected to no edge.
        let spot = images(8, |i, x, y| !((10..20).contains(&x) && (10..20).contains(&y)) && content(i, x, y));
        assert_eq!(border(&spot, WIDTH, HEIGHT), None);
        assert_eq!(border(&images(8, |_, _, _| false), WIDTH, HEIGHT), None, "all is black");
    }
}
