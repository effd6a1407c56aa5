//! `tracked`: positions and rotations of the same Gaussians at every frame; all else is shared by all frames.
//!
//! Frame 0 is the layer's geometry itself; frame k has a page of 7 numbers per Gaussian (28 bytes), `means@k` and
//! `quats@k`. Between frames, u = (t − t_k)/(t_{k+1} − t_k): μ = (1 − u) μ_k + u μ_{k+1}, and q = (1 − u) q̂_k ± u
//! q̂_{k+1} with the sign that makes the two quaternions neighbours. Before the first frame and after the last one
//! nothing moves. On a frame itself, where the slopes of both sides differ, dL/dt is 0 and only that frame is read.
//! Source: Luiten et al. 2024 (Dynamic 3D Gaussians) §3; interpolation between frames is ours.

#[cfg(test)]
mod tests;

use super::lanes::{Batch, Lane, Work, fill, scatter};
use super::still::{activate_backward_lanes, activate_lanes};
use super::{At, Cache, Capabilities, Model, Motion, Spec, Tape, fill_rows};
use crate::math::{Real, quat};
use crate::scene::params::{QUAT, page_name};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Grads, Key, Params, Space, SplatGrads, Table, Time};
use crate::simd::each;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Numbers of a pose: position 3, raw quaternion 4. The first this many columns of the geometry are frame 0's.
pub const POSE: usize = 7;
/// Columns of a page.
const PAGE: [(&str, usize); 2] = [("means", 3), ("quats", 4)];
/// Name of the pages' tables.
const PAGES: &str = "poses";
/// Name of the table, and of its only column group, that states who is foreground: a logit.
pub const FOREGROUND: &str = "foreground_logits";
/// Cameras that must see every time: with two, what moves along a line between them is not seen to move.
pub const LEAST_CAMERAS: usize = 3;
/// Most frames of a file that is accepted: some nine hours at 30 a second.
const MAX_FRAMES: usize = 1 << 20;
/// Numbers of pages that are made and not loaded, at most: a gigabyte. A file whose specification requests more has
/// lost its arrays.
const MAX_MADE: usize = 1 << 28;

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackedSpec {
    /// Seconds of every frame that has been tracked, strictly increasing. Frame 0 is the geometry, the others have
    /// pages.
    pub times: Vec<f64>,
    /// Whether Gaussians have a [`FOREGROUND`] logit: what masks show about them. No image depends on it.
    pub foreground: bool,
}

/// The table whose first [`POSE`] columns are frame `frame`'s poses, if that frame has been tracked.
pub fn page_of<F: Real>(p: &Params<F>, frame: usize) -> Option<Key> {
    if frame == 0 { Some(GEOMETRY) } else { p.find(&page_name(PAGES, u32::try_from(frame).ok()?)) }
}

impl Model for TrackedSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Tracked::new(self, p)?))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { causal: true, fixed_cameras: LEAST_CAMERAS, ..Capabilities::default() }
    }
}

/// See the module's documentation.
#[derive(Clone, Debug)]
pub struct Tracked {
    spec: TrackedSpec,
    /// Frame k's table; frame 0's is the geometry.
    pages: Vec<Key>,
}

impl Tracked {
    /// Pages that are not loaded start as frame 0. Errors: times that do not increase; pages that are missing or have
    /// another shape.
    pub fn new<F: Real>(spec: &TrackedSpec, p: &mut Params<F>) -> Result<Self> {
        let times = &spec.times;
        let increase = times.windows(2).all(|w| w[0] < w[1]) && times.iter().all(|t| t.is_finite());
        let damaged = |what: String| {
            Error::input(what).remedy("The file is damaged or was written by another program; export it again")
        };
        if times.is_empty() || times.len() > MAX_FRAMES || !increase {
            return Err(damaged(format!("the {} times of tracked frames do not increase", times.len())));
        }
        let count = times.len() as u32;
        let there = |k: u32| PAGE.iter().any(|(c, _)| p.unclaimed().iter().any(|a| a.name == page_name(c, k)));
        let loaded = if p.unclaimed().is_empty() { 0 } else { (1..count).filter(|&k| there(k)).count() };
        if loaded > 0 && loaded + 1 < times.len() {
            return Err(damaged(format!("{} of {} tracked frames are missing", times.len() - 1 - loaded, times.len())));
        }
        if loaded == 0 && p.len().saturating_mul(POSE).saturating_mul(times.len() - 1) > MAX_MADE {
            return Err(damaged(format!("the pages of {} tracked frames are missing", times.len())));
        }
        let first = TrackedSpec { times: times[..1].to_vec(), foreground: spec.foreground };
        let mut model = Self { spec: first, pages: vec![GEOMETRY] };
        if spec.foreground {
            let rows = p.len();
            p.entry(FOREGROUND, Space::Gaussians, &[(FOREGROUND, 1)], rows, |_| {})?;
        }
        for &t in &times[1..] {
            model.push(p, t, |p, row| p[GEOMETRY].read::<POSE>(row, 0))?;
        }
        Ok(model)
    }

    /// Seconds of every frame.
    #[cfg(test)]
    pub(crate) fn times(&self) -> &[f64] {
        &self.spec.times
    }

    /// The table whose first [`POSE`] columns are frame k's poses. Panics: there is no such frame.
    pub fn page(&self, k: usize) -> Key {
        self.pages[k]
    }

    /// Adds a frame whose poses are `pose(p, row)` unless they were loaded.
    fn push<F: Real>(
        &mut self,
        p: &mut Params<F>,
        t: f64,
        pose: impl Fn(&Params<F>, usize) -> [F; POSE] + Sync,
    ) -> Result<()> {
        let (frame, rows) = (self.pages.len() as u32, p.len());
        let wanted = p.unclaimed().iter().any(|a| a.name == page_name(PAGE[0].0, frame));
        let key = p.page(PAGES, frame, Space::Gaussians, &PAGE, rows, |_| {})?;
        if !wanted {
            let mut page = std::mem::take(&mut p[key]);
            fill_rows(&mut page, crate::scene::Rows::All, |row| pose(p, row));
            p[key] = page;
        }
        self.pages.push(key);
        self.spec.times.push(t);
        Ok(())
    }

    /// The model with one frame more at second t, where every Gaussian continues as it went: x + (x − x') and
    /// normalize(q̂ ± (q̂ − q̂')), scaled by the durations, no further than `cap` scene units. The first step after
    /// after frame 0 there is no velocity and the state stays.
    ///
    /// Source: Luiten et al. 2024 §3.3 (forward propagation); aligned signs, durations and the cap are ours: the
    /// overshoot at a bounce is bounded by it. Panics: t is not after the last frame.
    pub fn propagate<F: Real>(&self, p: &mut Params<F>, t: f64, cap: f64) -> Result<Self> {
        let n = self.pages.len();
        let last = self.spec.times[n - 1];
        assert!(t > last, "frame at {t} s must come after the one at {last} s");
        let mut next = self.clone();
        let now = self.pages[n - 1];
        if n == 1 {
            next.push(p, t, |p, row| p[now].read::<POSE>(row, 0))?;
            return Ok(next);
        }
        let (before, share) = (self.pages[n - 2], (t - last) / (last - self.spec.times[n - 2]));
        next.push(p, t, |p, row| go_on(p[before].read(row, 0), p[now].read(row, 0), share, cap))?;
        Ok(next)
    }

    /// The frames around t and the share of the later one; the same frame twice where only one counts.
    fn around(&self, t: f64) -> (usize, usize, f64) {
        let times = &self.spec.times;
        let after = times.partition_point(|&x| x <= t);
        // NaN is not before anything, so that it lands on frame 0.
        if after == 0 || after == times.len() || times[after - 1] == t {
            let k = after.saturating_sub(1);
            return (k, k, 0.0);
        }
        (after - 1, after, (t - times[after - 1]) / (times[after] - times[after - 1]))
    }

    fn reader<'a, F: Real>(&self, q: &At<'a, F>) -> Reader<'a, F> {
        let (a, b, share) = self.around(q.t.0);
        let p = q.p;
        let seconds = self.spec.times[b] - self.spec.times[a];
        let rate = if a == b { 0.0 } else { 1.0 / seconds };
        Reader {
            geometry: &p[GEOMETRY],
            from: &p[self.pages[a]],
            to: (a != b).then(|| &p[self.pages[b]]),
            share: F::of(share),
            rate: F::of(rate),
        }
    }
}

/// The pose after `before` and `now` at a constant velocity; `share`: the next duration, of the last one.
fn go_on<F: Real>(before: [F; POSE], now: [F; POSE], share: f64, cap: f64) -> [F; POSE] {
    let step: [F; 3] = std::array::from_fn(|k| F::of(share) * (now[k] - before[k]));
    let length = (step[0] * step[0] + step[1] * step[1] + step[2] * step[2]).sqrt().f64();
    let shorter = F::of(if length > cap { cap / length } else { 1.0 });
    let unit = |pose: [F; POSE]| quat::normalize::<F>(std::array::from_fn(|k| pose[QUAT + k])).0;
    let (old, new) = (unit(before), unit(now));
    let sign = align(old, new);
    let turned = quat::normalize(std::array::from_fn(|k| new[k] + F::of(share) * (new[k] - sign * old[k]))).0;
    std::array::from_fn(|k| if k < QUAT { now[k] + shorter * step[k] } else { turned[k - QUAT] })
}

/// The sign that makes two quaternions neighbours.
#[inline(always)]
fn align<F: Real>(a: [F; 4], b: [F; 4]) -> F {
    let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    if dot < F::ZERO { -F::ONE } else { F::ONE }
}

impl<F: Real> Motion<F> for Tracked {
    fn spec(&self) -> Spec {
        Spec::Tracked(self.spec.clone())
    }

    /// On a frame, and outside of the clip; between two frames both count.
    fn pose_table(&self, t: Time) -> Option<Key> {
        let (a, b, _) = self.around(t.0);
        (a == b).then_some(self.pages[a])
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        fill(&Forward(self.reader(q)), [&mut tape.out], q.rows);
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        _cache: &Cache,
        _tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        _d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        let (a, b, _) = self.around(q.t.0);
        let work = Backward { reader: self.reader(q), d_out: d_out.out };
        match [self.pages[a], self.pages[b]] {
            [GEOMETRY, GEOMETRY] => scatter(&work, d.of([GEOMETRY]), q.rows),
            [GEOMETRY, page] => scatter(&work, d.of([GEOMETRY, page]), q.rows),
            [one, page] if one == page => scatter(&work, d.of([GEOMETRY, page]), q.rows),
            [from, to] => scatter(&work, d.of([GEOMETRY, from, to]), q.rows),
        }
    }

    /// The slope of the line that t is on; on a frame the mean of both sides. Outside the clip nothing moves.
    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        *out = Table::new(&[("velocity", 3)], q.len());
        let times = &self.spec.times;
        let (a, b, _) = self.around(q.t.0);
        let (from, to) = match (a == b, a.checked_sub(1), a + 1 < times.len()) {
            (true, Some(before), true) if times[a] == q.t.0 => (before, a + 1),
            (true, Some(before), false) if times[a] == q.t.0 => (before, a),
            (true, None, true) if times[a] == q.t.0 => (a, a + 1),
            _ => (a, b),
        };
        if from == to {
            return;
        }
        let rate = F::of(1.0 / (times[to] - times[from]));
        let (from, to) = (&q.p[self.pages[from]], &q.p[self.pages[to]]);
        fill_rows(out, q.rows, |id| {
            let (x, y) = (from.read::<3>(id, 0), to.read::<3>(id, 0));
            [0, 1, 2].map(|k| rate * (y[k] - x[k]))
        });
    }
}

/// One query's parameters, read sixteen rows at a time.
struct Reader<'a, F> {
    geometry: &'a Table<F>,
    from: &'a Table<F>,
    /// The frame after t, where t is between two.
    to: Option<&'a Table<F>>,
    share: F,
    /// du/dt, 1/s
    rate: F,
}

type Pose<F> = [Lane<F>; POSE];

impl<F: Real> Reader<'_, F> {
    /// The learnable rows at t.
    #[inline(always)]
    fn rows(&self, batch: &Batch) -> [Lane<F>; 11] {
        let mut g: [Lane<F>; 11] = batch.ids.read(self.geometry, 0);
        let from: Pose<F> = batch.ids.read(self.from, 0);
        g[..POSE].copy_from_slice(&from);
        let Some(to) = self.to else { return g };
        let to: Pose<F> = batch.ids.read(to, 0);
        for l in 0..BLOCK {
            for k in 0..QUAT {
                g[k][l] = from[k][l] + self.share * (to[k][l] - from[k][l]);
            }
            let (a, b) = (unit(&from, l).0, unit(&to, l).0);
            let sign = align(a, b);
            for k in 0..4 {
                g[QUAT + k][l] = (F::ONE - self.share) * a[k] + self.share * sign * b[k];
            }
        }
        g
    }

    /// The VJP of [`rows`](Self::rows) between two frames: gradients to both poses, and to t.
    #[inline(always)]
    fn backward(&self, batch: &Batch, to: &Table<F>, d: &[Lane<F>; 11]) -> (Pose<F>, Pose<F>, Lane<F>) {
        let (from, to): (Pose<F>, Pose<F>) = (batch.ids.read(self.from, 0), batch.ids.read(to, 0));
        let mut d_from = [[F::ZERO; BLOCK]; POSE];
        let mut d_to = [[F::ZERO; BLOCK]; POSE];
        let mut d_time = [F::ZERO; BLOCK];
        for l in 0..BLOCK {
            let mut d_share = F::ZERO;
            for k in 0..QUAT {
                d_from[k][l] = (F::ONE - self.share) * d[k][l];
                d_to[k][l] = self.share * d[k][l];
                d_share += d[k][l] * (to[k][l] - from[k][l]);
            }
            let ((a, a_norm), (b, b_norm)) = (unit(&from, l), unit(&to, l));
            let sign = align(a, b);
            let d_q: [F; 4] = each(|k| d[QUAT + k][l]);
            for k in 0..4 {
                d_share += d_q[k] * (sign * b[k] - a[k]);
            }
            let d_a = quat::normalize_backward(a, a_norm, each(|k| (F::ONE - self.share) * d_q[k]));
            let d_b = quat::normalize_backward(b, b_norm, each(|k| self.share * sign * d_q[k]));
            for k in 0..4 {
                (d_from[QUAT + k][l], d_to[QUAT + k][l]) = (d_a[k], d_b[k]);
            }
            d_time[l] = d_share * self.rate;
        }
        (d_from, d_to, d_time)
    }
}

#[inline(always)]
fn unit<F: Real>(pose: &Pose<F>, l: usize) -> ([F; 4], F) {
    quat::normalize(each(|k| pose[QUAT + k][l]))
}

struct Forward<'a, F>(Reader<'a, F>);

impl<F: Real> Work<F, 1> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        batch.write(out, 0, &activate_lanes(&self.0.rows(batch)));
        0.0
    }
}

/// How many tables it adds to depends on the frames around t: the geometry, and their pages.
struct Backward<'a, F> {
    reader: Reader<'a, F>,
    d_out: &'a Table<F>,
}

impl<F: Real> Backward<'_, F> {
    /// Gradients to the learnable rows at t.
    #[inline(always)]
    fn rows(&self, batch: &Batch) -> [Lane<F>; 11] {
        activate_backward_lanes(&self.reader.rows(batch), &batch.at.read(self.d_out, 0))
    }
}

/// On frame 0.
impl<F: Real> Work<F, 1> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry]: &mut [TableMut<'_, F>; 1]) -> f64 {
        batch.add(d_geometry, 0, &self.rows(batch));
        0.0
    }
}

/// On another frame, or between frame 0 and the next.
impl<F: Real> Work<F, 2> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry, d_page]: &mut [TableMut<'_, F>; 2]) -> f64 {
        let d = self.rows(batch);
        let (pose, rest) = parts(&d);
        batch.add(d_geometry, POSE, &rest);
        let Some(to) = self.reader.to else {
            batch.add(d_page, 0, &pose);
            return 0.0;
        };
        let (d_from, d_to, d_time) = self.reader.backward(batch, to, &d);
        batch.add(d_geometry, 0, &d_from);
        batch.add(d_page, 0, &d_to);
        batch.sum(d_time)
    }
}

/// Between two other frames.
impl<F: Real> Work<F, 3> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry, d_from, d_to]: &mut [TableMut<'_, F>; 3]) -> f64 {
        let d = self.rows(batch);
        batch.add(d_geometry, POSE, &parts(&d).1);
        let to = self.reader.to.expect("three tables are added to where t lies between two frames");
        let (d_first, d_second, d_time) = self.reader.backward(batch, to, &d);
        batch.add(d_from, 0, &d_first);
        batch.add(d_to, 0, &d_second);
        batch.sum(d_time)
    }
}

/// The pose and what all frames share.
#[inline(always)]
fn parts<F: Real>(d: &[Lane<F>; 11]) -> (Pose<F>, [Lane<F>; 11 - POSE]) {
    let mut pose = [[F::ZERO; BLOCK]; POSE];
    let mut rest = [[F::ZERO; BLOCK]; 11 - POSE];
    pose.copy_from_slice(&d[..POSE]);
    rest.copy_from_slice(&d[POSE..]);
    (pose, rest)
}
