//! Images on demand: decoded, composited, undistorted and downscaled, in a byte budget shared by all threads.
//!
//! An image is a pure function of its files and the capture's options, so neither the order of loads nor the prefetch
//! thread nor eviction can change a result. Plain 8-bit images stay 8 bits per sample, exactly as in the file; whatever
//! was composited, resampled or averaged is kept in 16 bits, whose rounding (1/131070) is far below the half 8-bit step
//! (1/510) that an 8-bit copy would lose, at half the memory of f32.

use super::geometry::DepthMap;
use super::lens::Distortion;
use super::picture::{self, Raster, Samples};
use super::{Capture, DepthKind, Frame, Split, depth, flow, panorama, vignetting};
use rayon::prelude::*;
use splat4d::Result;
use splat4d::math::image::box_means;
use splat4d::scene::{Camera, Lens, Planes};
use splat4d::simd::{Pass, Simd, dispatch_pass};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;

/// A loaded image in floating point.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// [3, height, width] sRGB values from 0 to 1, composited on the capture's background.
    pub color: Planes<f32>,
    /// [1, height, width] foreground weight from 0 to 1, from the mask file, else from the image's alpha.
    pub mask: Option<Planes<f32>>,
    /// [1, height, width] part of the pixel that the original image covers, where undistortion left borders. Colour
    /// there is meaningless; losses and measurements must leave those pixels out.
    pub valid: Option<Planes<f32>>,
    /// [1, height, width] depths of pixels, 0 where unknown, and their kind.
    pub depth: Option<(Planes<f32>, DepthKind)>,
    /// [3, height, width] optical flow to the next frame of its camera: u right, v down in pixels, and 1 where they are
    /// known.
    pub flow: Option<Planes<f32>>,
}

/// A loaded image in memory: planes of 8 or 16 bits.
#[derive(PartialEq)]
pub struct StoredPicture {
    width: usize,
    height: usize,
    color: Samples,
    mask: Option<Vec<u8>>,
    valid: Option<Vec<u8>>,
    /// As [`depth::read`] gives it.
    depth: Option<(Vec<f32>, DepthKind)>,
    /// As [`flow::read`] gives it.
    flow: Option<Vec<u16>>,
    /// Depth of the capture's geometry; images that are not trained on have none.
    measured: Option<Arc<DepthMap>>,
}

impl StoredPicture {
    /// Bytes of the samples.
    pub(crate) fn bytes(&self) -> usize {
        let color = match &self.color {
            Samples::Eight(s) => s.len(),
            Samples::Sixteen(s) => 2 * s.len(),
        };
        let weights = [&self.mask, &self.valid].into_iter().flatten().map(Vec::len).sum::<usize>();
        let depth = self.depth.as_ref().map_or(0, |(d, _)| 4 * d.len());
        let measured = self.measured.as_ref().map_or(0, |m| m.bytes());
        color + weights + depth + measured + self.flow.as_ref().map_or(0, |f| 2 * f.len())
    }

    /// Writes the colour as [3, height, width] sRGB values from 0 to 1, reusing `out`'s memory.
    pub(crate) fn color_into(&self, out: &mut Planes<f32>) {
        match &self.color {
            Samples::Eight(s) => self.convert(s, 255.0, 3, out),
            Samples::Sixteen(s) => self.convert(s, 65535.0, 3, out),
        }
    }

    /// Writes the mask as [1, height, width] from 0 to 1; false (and `out` untouched) if there is none.
    pub(crate) fn mask_into(&self, out: &mut Planes<f32>) -> bool {
        self.weights_into(self.mask.as_deref(), out)
    }

    /// Writes the validity as [1, height, width] from 0 to 1; false (and `out` untouched) if all pixels are valid.
    pub(crate) fn valid_into(&self, out: &mut Planes<f32>) -> bool {
        self.weights_into(self.valid.as_deref(), out)
    }

    /// Writes the depth as [1, height, width] and returns its kind; `None` (and `out` untouched) if there is none.
    pub(crate) fn depth_into(&self, out: &mut Planes<f32>) -> Option<DepthKind> {
        let (values, kind) = self.depth.as_ref()?;
        (out.channels, out.height, out.width) = (1, self.height, self.width);
        out.data.clone_from(values);
        Some(*kind)
    }

    /// Writes the flow as [3, height, width]; false (and `out` untouched) if there is none.
    pub(crate) fn flow_into(&self, out: &mut Planes<f32>) -> bool {
        let Some(codes) = &self.flow else { return false };
        flow::decode_into(codes, self.width, self.height, out);
        true
    }

    /// Writes the measured depth as [1, height, width]; false (and `out` untouched) if there is none.
    pub(crate) fn measured_into(&self, out: &mut Planes<f32>) -> bool {
        let Some(map) = &self.measured else { return false };
        map.write_into(out);
        true
    }

    fn weights_into(&self, weights: Option<&[u8]>, out: &mut Planes<f32>) -> bool {
        let Some(weights) = weights else { return false };
        self.convert(weights, 255.0, 1, out);
        true
    }

    /// Samples over their largest value.
    fn convert<S: Copy + Sync + Into<f32>>(&self, samples: &[S], largest: f32, channels: usize, out: &mut Planes<f32>) {
        (out.channels, out.height, out.width) = (channels, self.height, self.width);
        out.data.resize(samples.len(), 0.0);
        let simd = Simd::detect();
        let chunks = out.data.par_chunks_mut(CONVERT_SAMPLES).zip(samples.par_chunks(CONVERT_SAMPLES));
        chunks.for_each(|(out, samples)| dispatch_pass(simd, &Convert { samples, largest }, &mut (), out));
    }

    /// Everything in floating point.
    pub fn to_picture(&self) -> Picture {
        let mut color = Planes::default();
        self.color_into(&mut color);
        let plane = |weights: &Option<Vec<u8>>| {
            let mut out = Planes::default();
            self.weights_into(weights.as_deref(), &mut out).then_some(out)
        };
        let mut distances = Planes::default();
        let depth = self.depth_into(&mut distances).map(|kind| (distances, kind));
        let mut vectors = Planes::default();
        let flow = self.flow_into(&mut vectors).then_some(vectors);
        Picture { color, mask: plane(&self.mask), valid: plane(&self.valid), depth, flow }
    }
}

/// Samples that a task converts: about ten microseconds of work.
const CONVERT_SAMPLES: usize = 1 << 16;

struct Convert<'a, S> {
    samples: &'a [S],
    largest: f32,
}

impl<S: Copy + Into<f32>> Pass for Convert<'_, S> {
    type Scratch = ();
    type Into = [f32];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, (): &mut (), out: &mut [f32]) {
        out.iter_mut().zip(self.samples).for_each(|(o, &v)| *o = v.into() / self.largest);
    }
}

impl std::fmt::Debug for StoredPicture {
    /// Size and kind; not the millions of samples.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (mask, valid) = (self.mask.is_some(), self.valid.is_some());
        let (depth, flow) = (self.depth.is_some(), self.flow.is_some());
        write!(
            f,
            "StoredPicture {{ {}x{}, {} bytes, mask: {mask}, valid: {valid}, depth: {depth}, flow: {flow} }}",
            self.width,
            self.height,
            self.bytes()
        )
    }
}

/// A cache of decoded images that never exceeds its byte budget.
///
/// The least recently used image is evicted first. Images in use by callers (their `Arc`s) and the one being decoded
/// are not counted; an image larger than the whole budget is handed out without being kept.
pub struct ImageStore {
    shared: Arc<Shared>,
    worker: Mutex<Option<JoinHandle<()>>>,
}

struct Shared {
    capture: Arc<Capture>,
    budget: usize,
    state: Mutex<State>,
    /// Woken when a load ends and when the prefetch queue changes.
    changed: Condvar,
}

#[derive(Default)]
struct State {
    kept: BTreeMap<usize, CachedImages>,
    bytes: usize,
    peak: usize,
    clock: u64,
    loads: usize,
    loading: BTreeSet<usize>,
    queue: VecDeque<usize>,
    closed: bool,
}

struct CachedImages {
    picture: Arc<StoredPicture>,
    used: u64,
}

impl ImageStore {
    /// A store for the images of `capture` that keeps at most `budget_bytes` of them decoded.
    pub fn new(capture: Arc<Capture>, budget_bytes: usize) -> Self {
        let state = Mutex::new(State::default());
        let shared = Shared { capture, budget: budget_bytes, state, changed: Condvar::new() };
        Self { shared: Arc::new(shared), worker: Mutex::new(None) }
    }

    /// The capture whose images these are.
    pub fn capture(&self) -> &Arc<Capture> {
        &self.shared.capture
    }

    /// The image of a frame; decodes it unless it is kept. Errors name the file. Panics: `frame` out of range.
    pub fn load(&self, frame: usize) -> Result<Arc<StoredPicture>> {
        assert!(frame < self.shared.capture.frames.len(), "frame {frame} must be one of the capture's frames");
        self.shared.load(frame)
    }

    /// Decodes these frames in the background, in this order; replaces what an earlier call left undone. Stops at half
    /// the budget so that it cannot push out what it just brought. Errors are reported by [`Self::load`].
    /// Panics: a frame out of range.
    pub(crate) fn prefetch(&self, frames: &[usize]) {
        let count = self.shared.capture.frames.len();
        assert!(frames.iter().all(|&f| f < count), "prefetched frames must be the capture's frames");
        let mut state = self.shared.lock();
        let State { queue, kept, loading, .. } = &mut *state;
        queue.clear();
        queue.extend(frames.iter().copied().filter(|f| !kept.contains_key(f) && !loading.contains(f)));
        if queue.is_empty() {
            // Once everything is kept, no thread is woken for nothing.
            return;
        }
        drop(state);
        self.shared.changed.notify_all();
        let mut worker = self.worker.lock().unwrap_or_else(|e| e.into_inner());
        if worker.is_none() {
            let shared = Arc::clone(&self.shared);
            // Without a thread (because of a process limit, for example) images are simply decoded when they are
            // requested.
            *worker = std::thread::Builder::new().name("prefetch".into()).spawn(move || shared.work()).ok();
        }
    }

    /// Bytes of the images kept now.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        self.shared.lock().bytes
    }

    /// Peak bytes of images in memory; at most the budget.
    #[cfg(test)]
    pub(crate) fn peak_bytes(&self) -> usize {
        self.shared.lock().peak
    }

    /// Number of decoded images.
    #[cfg(test)]
    pub(crate) fn decoded(&self) -> usize {
        self.shared.lock().loads
    }
}

impl Drop for ImageStore {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        state.closed = true;
        state.queue.clear();
        drop(state);
        self.shared.changed.notify_all();
        if let Some(worker) = self.worker.get_mut().unwrap_or_else(|e| e.into_inner()).take() {
            // A panic of the worker was already printed; there is nothing left to save.
            let _ = worker.join();
        }
    }
}

/// Takes a frame off the list of those being decoded, also when decoding panics: others wait for it.
struct Loading<'a>(&'a Shared, usize);

impl Drop for Loading<'_> {
    fn drop(&mut self) {
        self.0.lock().loading.remove(&self.1);
        self.0.changed.notify_all();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        // Every change of the state is complete before its lock is released, so a poisoned lock is harmless.
        self.state.lock().unwrap_or_else(|e| e.into_inner())
    }

    fn load(&self, frame: usize) -> Result<Arc<StoredPicture>> {
        let mut state = self.lock();
        loop {
            state.clock += 1;
            let now = state.clock;
            if let Some(kept) = state.kept.get_mut(&frame) {
                kept.used = now;
                return Ok(Arc::clone(&kept.picture));
            }
            if state.loading.insert(frame) {
                break;
            }
            state = self.changed.wait(state).unwrap_or_else(|e| e.into_inner());
        }
        drop(state);
        let _loading = Loading(self, frame);
        // On this thread alone: one that shared the work with others could be given a job that waits for this very
        // image.
        let mut picture = prepare(&self.capture.frames[frame], &self.capture)?;
        picture.measured = self.measured(frame)?;
        let picture = Arc::new(picture);
        self.keep(frame, &picture);
        Ok(picture)
    }

    /// Depth of the capture's geometry in a training image.
    fn measured(&self, number: usize) -> Result<Option<Arc<DepthMap>>> {
        let (capture, frame) = (&self.capture, &self.capture.frames[number]);
        let Some(geometry) = capture.geometry.as_ref().filter(|_| capture.split(number) == Split::Train) else {
            return Ok(None);
        };
        let camera = &capture.cameras[frame.camera];
        let place = |e: splat4d::Error| e.at(format!("camera {}, frame {}", camera.name, frame.index));
        geometry.depth(frame, camera.fixed).map_err(place)
    }

    fn keep(&self, frame: usize, picture: &Arc<StoredPicture>) {
        let mut state = self.lock();
        state.loads += 1;
        let bytes = picture.bytes();
        if bytes > self.budget {
            return;
        }
        while state.bytes + bytes > self.budget {
            let oldest = state.kept.iter().min_by_key(|(_, k)| k.used).map(|(&f, _)| f);
            let Some(gone) = oldest.and_then(|f| state.kept.remove(&f)) else { break };
            state.bytes -= gone.picture.bytes();
        }
        state.bytes += bytes;
        state.peak = state.peak.max(state.bytes);
        state.clock += 1;
        let used = state.clock;
        state.kept.insert(frame, CachedImages { picture: Arc::clone(picture), used });
    }

    /// The prefetch thread.
    fn work(&self) {
        // Bytes decoded ahead of their use since the queue was last empty.
        let mut ahead = 0;
        loop {
            let mut state = self.lock();
            while state.queue.is_empty() && !state.closed {
                ahead = 0;
                state = self.changed.wait(state).unwrap_or_else(|e| e.into_inner());
            }
            if state.closed {
                return;
            }
            let Some(frame) = state.queue.pop_front() else { continue };
            if state.kept.contains_key(&frame) || state.loading.contains(&frame) {
                continue;
            }
            if ahead > self.budget / 2 {
                state.queue.clear();
                continue;
            }
            drop(state);
            if let Ok(picture) = self.load(frame) {
                ahead += picture.bytes();
            }
        }
    }
}

/// White: the replacement where an image has alpha although the capture's first images had none.
const WHITE: [f32; 3] = [1.0; 3];

/// Decodes a frame's image, mask, depth and flow and brings them to the frame's view.
fn prepare(frame: &Frame, capture: &Capture) -> Result<StoredPicture> {
    let place = |e: splat4d::Error| {
        let camera = &capture.cameras[frame.camera].name;
        e.at(format!("camera {camera}, frame {}", frame.index))
    };
    let stored = panorama::stored(&frame.source);
    let raster = picture::decode_as(&frame.image, Some(&stored), frame.upright).map_err(place)?;
    let background = capture.background.unwrap_or(WHITE);
    let mask = frame.mask.as_deref().map(|m| read_mask(m, &stored, frame.upright)).transpose().map_err(place)?;
    let mask = mask.or_else(|| raster.alpha().map(|_| picture::mask_values(&raster, true)));
    let depth = frame.depth.as_ref();
    let depth = depth.map(|d| Ok((depth::read(d, frame, capture.downscale)?, d.kind))).transpose().map_err(place)?;
    let flow = frame.flow.as_ref().map(|f| flow::read(f, frame, capture)).transpose().map_err(place)?;
    let lens = frame.distortion();
    let opaque = raster.alpha().is_none_or(|a| (0..raster.width * raster.height).all(|p| raster.get(p, a) >= 1.0));
    let unchanged = opaque && lens.is_pinhole() && frame.vignetting.is_none();
    if let (true, 1, Samples::Eight(samples)) = (unchanged, capture.downscale, &raster.samples) {
        let mask = mask.map(|m| m.iter().map(|&v| to_byte(v)).collect());
        let color = Samples::Eight(planar(samples, raster.channels));
        let valid = frame.recorded.as_ref().map(|r| r.iter().map(|&v| v * u8::MAX).collect());
        let (width, height) = (raster.width, raster.height);
        return Ok(StoredPicture { width, height, color, mask, valid, depth, flow, measured: None });
    }
    let (stored_width, stored_height) = (raster.width, raster.height);
    let mut planes = composite(&raster, background);
    drop(raster);
    if let Some(k) = &frame.vignetting {
        vignetting::remove(k, &mut planes, stored_width, stored_height);
    }
    planes.extend(mask);
    let mut valid: Option<Vec<f32>> = frame.recorded.as_ref().map(|r| r.iter().map(|&v| f32::from(v)).collect());
    if !lens.is_pinhole() {
        let map = UndistortMap::new(&lens, &frame.source);
        let undistort = |plane: &Vec<f32>| map.apply(plane, stored_width, stored_height);
        planes = planes.iter().map(undistort).collect();
        // Outside of the image it is 0 as well.
        valid = valid.as_ref().map(undistort).or_else(|| map.valid());
    }
    let (k, width, height) = (capture.downscale, frame.source.width, frame.source.height);
    planes.iter_mut().chain(&mut valid).for_each(|p| *p = box_means(p, width, height, k));
    let bytes = |plane: Vec<f32>| plane.iter().map(|&v| to_byte(v)).collect();
    let mask = (planes.len() == 4).then(|| planes.pop()).flatten().map(bytes);
    // Any doubt about a pixel must not round to certainty.
    let valid = valid.map(|plane| plane.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0) as u8).collect());
    let color = planes.iter().flatten().map(|&v| (v.clamp(0.0, 1.0) * 65535.0).round() as u16).collect();
    let color = Samples::Sixteen(color);
    let measured = None;
    Ok(StoredPicture { width: width / k, height: height / k, color, mask, valid, depth, flow, measured })
}

fn to_byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// A mask's values in the size of its image; one of another size, but the same shape, is resampled (nearest pixel).
fn read_mask(path: &Path, camera: &Camera, upright: bool) -> Result<Vec<f32>> {
    let (width, height) = (camera.width, camera.height);
    let raster = picture::decode_as(path, None, upright)?;
    let size = (raster.width, raster.height);
    let values = picture::mask_values(&raster, false);
    if size == (width, height) {
        return Ok(values);
    }
    if !picture::is_resized(size, camera) {
        picture::check_companion(path, "mask", size, camera)?;
    }
    let near = |i: usize, from: usize, to: usize| ((2 * i + 1) * from / (2 * to)).min(from - 1);
    let at = |p: usize| values[near(p / width, size.1, height) * size.0 + near(p % width, size.0, width)];
    Ok((0..width * height).map(at).collect())
}

/// Interleaved samples to three planes; grey becomes three equal ones, alpha is dropped.
fn planar(samples: &[u8], channels: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(samples.len() / channels * 3);
    for c in 0..3 {
        let c = if channels < 3 { 0 } else { c };
        out.extend(samples.iter().skip(c).step_by(channels));
    }
    out
}

/// Three planes of colour·α + background·(1 − α), in the image's own (sRGB) values as the papers do.
fn composite(raster: &Raster, background: [f32; 3]) -> Vec<Vec<f32>> {
    let n = raster.width * raster.height;
    (0..3)
        .map(|c| {
            let channel = if raster.channels < 3 { 0 } else { c };
            let pixel = |p: usize| match raster.alpha() {
                None => raster.get(p, channel),
                Some(a) => {
                    let alpha = raster.get(p, a);
                    raster.get(p, channel) * alpha + background[c] * (1.0 - alpha)
                }
            };
            (0..n).map(pixel).collect()
        })
        .collect()
}

/// For every pixel of the pinhole image, where it is in the distorted one.
struct UndistortMap {
    /// Pixel positions minus one half (so that whole numbers are pixel centres); NaN where the image does not reach.
    positions: Vec<[f32; 2]>,
}

impl UndistortMap {
    fn new(lens: &Distortion, camera: &Camera) -> Self {
        let k = &camera.intrinsics;
        let (width, height) = (camera.width as f64, camera.height as f64);
        let at = |i: usize| {
            let (x, y) = ((i % camera.width) as f64 + 0.5, (i / camera.width) as f64 + 0.5);
            let outside = [f32::NAN; 2];
            if let Lens::Equirectangular { turn, size } = &camera.lens {
                let [u, v] = panorama::pixel(turn, *size, [(x - k.cx) / k.fx, (y - k.cy) / k.fy]);
                return [(u - 0.5) as f32, (v - 0.5) as f32];
            }
            let Some([x, y]) = lens.distort([(x - k.cx) / k.fx, (y - k.cy) / k.fy]) else { return outside };
            let (u, v) = (k.fx * x + k.cx, k.fy * y + k.cy);
            let inside = (0.0..=width).contains(&u) && (0.0..=height).contains(&v);
            if inside { [(u - 0.5) as f32, (v - 0.5) as f32] } else { outside }
        };
        Self { positions: (0..camera.width * camera.height).map(at).collect() }
    }

    /// 1 where the original image reaches, else 0; `None` if it reaches everywhere.
    fn valid(&self) -> Option<Vec<f32>> {
        let reaches: Vec<f32> = self.positions.iter().map(|p| if p[0].is_nan() { 0.0 } else { 1.0 }).collect();
        reaches.contains(&0.0).then_some(reaches)
    }

    /// Bilinear samples; 0 where the image does not reach.
    fn apply(&self, plane: &[f32], width: usize, height: usize) -> Vec<f32> {
        let sample = |&[x, y]: &[f32; 2]| {
            if x.is_nan() {
                return 0.0;
            }
            let (x, y) = (x.clamp(0.0, (width - 1) as f32), y.clamp(0.0, (height - 1) as f32));
            let (x0, y0) = (x as usize, y as usize);
            let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
            let (fx, fy) = (x - x0 as f32, y - y0 as f32);
            let row = |y: usize| plane[y * width + x0] * (1.0 - fx) + plane[y * width + x1] * fx;
            row(y0) * (1.0 - fy) + row(y1) * fy
        };
        self.positions.iter().map(sample).collect()
    }
}
