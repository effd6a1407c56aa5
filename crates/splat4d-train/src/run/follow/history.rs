//! The Gaussians of a followed capture over time. At every frame a Gaussian either keeps its numbers, which costs
//! nothing, or is replaced. What was replaced is kept as pieces until it is in the playback file.

use super::record::{NEW, ROW, Record};
use splat4d::format::playback::{Node, Primitive};
use splat4d::layers::Layer;
use splat4d::math::{Real, quat, sh};
use splat4d::motion::Still;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LifeKind, Params, SH};
use std::ops::Range;
use std::sync::Arc;

/// Mean and quaternion, the first of them.
const POSE: usize = 7;

/// Mean and quaternion of a Gaussian.
pub(super) type Pose = [f32; POSE];

/// A Gaussian from one frame to another, with the numbers of the first.
#[derive(Clone, Debug)]
struct Piece {
    frames: Range<usize>,
    /// A row of [`GEOMETRY`], then one of [`SH`].
    row: Box<[f32]>,
    /// Where it has moved at the end; none: it stays.
    end: Option<Pose>,
}

/// The present Gaussians and their past.
#[derive(Debug)]
pub(super) struct History {
    /// The present Gaussians.
    pub(super) layer: Layer<f32>,
    /// By row: the frame from which its numbers hold.
    since: Vec<usize>,
    /// By row: its pose one frame before `since`, if it moved then.
    before: Vec<Option<Pose>>,
    past: Vec<Piece>,
    /// The last frame.
    frame: usize,
}

/// A layer of Gaussians that do not move.
pub(super) fn still(params: Params<f32>) -> Layer<f32> {
    Layer::new("followed", params, Arc::new(Still), LifeKind::Infinite)
}

/// Copies rows of some tables into one, in order.
pub(super) fn gathered(parts: &[(&Params<f32>, &[u32])], coefficients: usize) -> Params<f32> {
    let mut out = Params::new(parts.iter().map(|(_, rows)| rows.len()).sum(), coefficients, &[]);
    let mut to = 0;
    for (params, rows) in parts {
        for &from in *rows {
            out[GEOMETRY].write(to, 0, params[GEOMETRY].read::<ROW>(from as usize, 0));
            for k in 0..out[SH].width().min(params[SH].width()) {
                let value = params[SH].get(from as usize, k);
                out[SH].set(to, k, value);
            }
            to += 1;
        }
    }
    out
}

fn pose(params: &Params<f32>, row: usize) -> Pose {
    params[GEOMETRY].read::<POSE>(row, 0)
}

impl History {
    /// The first frame.
    pub(super) fn new(params: Params<f32>, frame: usize) -> Self {
        let rows = params.len();
        Self { layer: still(params), since: vec![frame; rows], before: vec![None; rows], past: Vec::new(), frame }
    }

    /// Number of coefficients of the spherical harmonics.
    pub(super) fn coefficients(&self) -> usize {
        self.layer.params[SH].width() / 3
    }

    /// Frame `record.frame`: the active rows are replaced by the record's, which come last.
    pub(super) fn apply(&mut self, record: &Record) {
        let rows = self.layer.params.len();
        let mut replaced = vec![false; rows];
        record.active.iter().for_each(|&r| replaced[r as usize] = true);
        // The first successor is where a Gaussian moves to.
        let mut first = vec![None; record.active.len()];
        for (row, &origin) in record.origin.iter().enumerate().rev().filter(|(_, o)| **o != NEW) {
            first[origin as usize] = Some(row);
        }
        for (&row, successor) in record.active.iter().zip(&first) {
            let end = successor.map(|s| pose(&record.params, s));
            self.close(row as usize, record.frame, end);
        }
        let kept: Vec<u32> = (0..rows as u32).filter(|&r| !replaced[r as usize]).collect();
        let fresh: Vec<u32> = (0..record.params.len() as u32).collect();
        let mut before: Vec<Option<Pose>> = vec![None; kept.len()];
        before.extend(record.origin.iter().enumerate().map(|(row, &origin)| {
            let parent = (origin != NEW).then(|| record.active[origin as usize])?;
            (first[origin as usize] == Some(row)).then(|| pose(&self.layer.params, parent as usize))
        }));
        let coefficients = self.coefficients();
        let params = gathered(&[(&self.layer.params, &kept), (&record.params, &fresh)], coefficients);
        self.since = kept.iter().map(|&r| self.since[r as usize]).collect();
        self.since.resize(params.len(), record.frame);
        (self.layer.params, self.before, self.frame) = (params, before, record.frame);
    }

    /// Notes the life of a row that ends or changes at `frame`.
    fn close(&mut self, row: usize, frame: usize, end: Option<Pose>) {
        let (since, last) = (self.since[row], self.frame);
        let mut piece = |frames: Range<usize>, end| {
            if !frames.is_empty() {
                self.past.push(Piece { frames, row: numbers(&self.layer.params, row), end });
            }
        };
        match end {
            None => piece(since..frame, None),
            Some(end) => {
                piece(since..last.max(since), None);
                piece(last.max(since)..frame, Some(end));
            }
        }
    }

    /// The pose of a row if it continues the motion of the last frame; none: it did not move.
    pub(super) fn extrapolated(&self, row: usize, cap: f32) -> Option<Pose> {
        let (now, before) =
            (pose(&self.layer.params, row), self.before[row].filter(|_| self.since[row] == self.frame)?);
        let step: [f32; 3] = std::array::from_fn(|k| now[k] - before[k]);
        let length = step.iter().map(|x| x * x).sum::<f32>().sqrt();
        let scale = if length > cap { cap / length } else { 1.0 };
        let sign = if (QUAT..POSE).map(|k| now[k] * before[k]).sum::<f32>() < 0.0 { -1.0 } else { 1.0 };
        Some(std::array::from_fn(|k| match k < QUAT {
            true => now[k] + scale * step[k],
            false => 2.0 * now[k] - sign * before[k],
        }))
    }

    /// Forgets what ends at `frame` or before: it is in the file.
    pub(super) fn forget(&mut self, frame: usize) {
        self.past.retain(|piece| piece.frames.end > frame);
    }

    /// The frames `range` as the nodes of a playback file. `time`: seconds of a frame.
    ///
    /// A piece is in the largest nodes of a binary tree over the frames that it fills, so that a player never needs to
    /// know when a Gaussian begins or ends within a node.
    pub(super) fn nodes(&self, range: Range<usize>, time: &dyn Fn(usize) -> f64) -> Vec<Node> {
        let mut nodes: std::collections::BTreeMap<(usize, usize), Vec<Primitive>> = std::collections::BTreeMap::new();
        let present = (0..self.since.len()).map(|row| Piece {
            frames: self.since[row]..range.end,
            row: numbers(&self.layer.params, row),
            end: None,
        });
        for piece in self.past.iter().cloned().chain(present) {
            let within = piece.frames.start.max(range.start)..piece.frames.end.min(range.end);
            if within.is_empty() {
                continue;
            }
            cover(range.clone(), &within, &mut |node| {
                let span = [time(node.start), time(node.end)];
                let times = [time(piece.frames.start), time(piece.frames.end)];
                nodes.entry((node.start, node.end)).or_default().push(primitive(&piece, times, span));
            });
        }
        nodes.into_iter().map(|((a, b), primitives)| Node { from: time(a), to: time(b), primitives }).collect()
    }
}

fn numbers(params: &Params<f32>, row: usize) -> Box<[f32]> {
    let sh = (0..params[SH].width()).map(|k| params[SH].get(row, k));
    params[GEOMETRY].read::<ROW>(row, 0).into_iter().chain(sh).collect()
}

/// The largest nodes of the binary tree over `node` that the frames `within` fill.
fn cover(node: Range<usize>, within: &Range<usize>, give: &mut dyn FnMut(Range<usize>)) {
    if within.start <= node.start && node.end <= within.end {
        return give(node);
    }
    let middle = node.start + node.len() / 2;
    if within.start < middle {
        cover(node.start..middle, within, give);
    }
    if within.end > middle {
        cover(middle..node.end, within, give);
    }
}

/// A piece that lasts from the first to the second time, in a node.
fn primitive(piece: &Piece, [begin, end]: [f64; 2], [from, to]: [f64; 2]) -> Primitive {
    let row = |k: usize| f64::from(piece.row[k]);
    let (center, seconds) = (0.5 * (from + to), end - begin);
    let mean: [f64; 3] = std::array::from_fn(row);
    let start = quat::normalize::<f64>(std::array::from_fn(|k| row(QUAT + k))).0;
    let (mut at, mut rotation, mut velocity, mut turn) = (mean, start, [0.0; 3], [0.0; 3]);
    if let Some(goal) = piece.end {
        let share = (center - begin) / seconds;
        velocity = std::array::from_fn(|k| (f64::from(goal[k]) - mean[k]) / seconds);
        at = std::array::from_fn(|k| mean[k] + velocity[k] * (center - begin));
        let mut goal = quat::normalize::<f64>(std::array::from_fn(|k| f64::from(goal[QUAT + k]))).0;
        if (0..4).map(|k| goal[k] * start[k]).sum::<f64>() < 0.0 {
            goal = goal.map(|x| -x);
        }
        rotation = quat::normalize::<f64>(std::array::from_fn(|k| (1.0 - share) * start[k] + share * goal[k])).0;
        turn = turning(start, goal, seconds);
    }
    let scales: [f64; 3] = std::array::from_fn(|k| row(LOG_SCALE + k).exp());
    let opacity = row(OPACITY).sigmoid();
    let mut sh_rest = [0.0; 45];
    piece.row[ROW..].iter().skip(3).zip(&mut sh_rest).for_each(|(x, out)| *out = *x);
    Primitive {
        mean: at,
        center,
        half_width: f64::INFINITY,
        softness: seconds.max(f64::MIN_POSITIVE),
        quat: rotation.map(|x| x as f32),
        scales: scales.map(|s| s as f32),
        opacity: opacity as f32,
        velocity: velocity.map(|x| x as f32),
        turn: turn.map(|x| x as f32),
        base_color: std::array::from_fn(|k| sh::dc_to_rgb(piece.row[ROW + k])),
        sh_rest,
        // About the pixels that it covers.
        importance: (opacity * scales.iter().product::<f64>().powf(2.0 / 3.0)) as f32,
        label: None,
        features: Vec::new(),
    }
}

/// The angular velocity, radians a second about the world's axes, that takes a unit quaternion to another one on the
/// same half of the sphere. A file's rotation is q + ½Δ(0, ω)q, normalised, Δ from the middle: it is exact at both ends if
/// ω = 4 tan(θ/4)/s.
fn turning(from: [f64; 4], to: [f64; 4], seconds: f64) -> [f64; 3] {
    let [w, axis @ ..] = quat::product(to, quat::conjugate(from));
    let sine = axis.iter().map(|x| x * x).sum::<f64>().sqrt();
    if sine <= f64::EPSILON {
        return [0.0; 3];
    }
    let angle = 2.0 * sine.atan2(w);
    let rate = 4.0 * (0.25 * angle).tan() / seconds;
    axis.map(|x| x / sine * rate)
}
