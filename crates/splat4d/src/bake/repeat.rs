//! A clip played many times over: the static background is stored once with an infinite lifespan, all else once per
//! round.

use super::fit::LEVEL_PIXELS;
use super::sampling::Viewpoints;
use crate::format::playback::{Node, Primitive};

/// Repetition of a clip.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rounds {
    /// First second of the clip.
    pub first: f64,
    /// Seconds of a round: from the first frame to one frame behind the last.
    pub length: f64,
    pub count: usize,
}

impl Rounds {
    /// The nodes of all rounds from those of one; the first node must be the root.
    pub(super) fn spread(&self, nodes: Vec<Node>, sampling: &Viewpoints, tolerance: f64) -> Vec<Node> {
        let end = self.first + self.length * self.count as f64;
        let mut root = Node { from: self.first, to: end, primitives: Vec::new() };
        let mut round = nodes;
        for node in round.iter_mut().filter(|n| n.from <= self.first && n.to >= self.first + self.length) {
            let all = std::mem::take(&mut node.primitives);
            for primitive in all {
                match self.still(&primitive, sampling, tolerance) {
                    Some(still) => root.primitives.push(still),
                    None => node.primitives.push(primitive),
                }
            }
        }
        let mut out = vec![root];
        for i in 0..self.count {
            let shift = self.length * i as f64;
            for node in &round {
                let moved = |p: &Primitive| Primitive { center: p.center + shift, ..p.clone() };
                let primitives = node.primitives.iter().map(moved).collect();
                // The very number that the next round begins with, so that no time is shown twice or never.
                let border = |t: f64| {
                    if t >= self.first + self.length {
                        self.first + self.length * (i + 1) as f64
                    } else if t <= self.first {
                        self.first + shift
                    } else {
                        t + shift
                    }
                };
                out.push(Node { from: border(node.from), to: border(node.to), primitives });
            }
        }
        out.retain(|n| !n.primitives.is_empty());
        out
    }

    /// The primitive as one with an infinite lifespan, where that stays within the tolerance.
    fn still(&self, p: &Primitive, sampling: &Viewpoints, tolerance: f64) -> Option<Primitive> {
        let ends = [self.first, self.first + self.length];
        let middle = 0.5 * (ends[0] + ends[1]);
        let mean: [f64; 3] = std::array::from_fn(|k| p.mean[k] + f64::from(p.velocity[k]) * (middle - p.center));
        // A lifespan is highest at one time and falls from there: its extremes are at the ends or at the centre.
        let mut sigma = [1.0f64, 0.0];
        if p.half_width == f64::INFINITY {
            sigma = [1.0, 1.0];
        } else {
            for t in [ends[0], ends[1], p.center.clamp(ends[0], ends[1])] {
                let over = ((t - p.center).abs() - p.half_width).max(0.0) / p.softness;
                let value = (-0.5 * over * over).exp();
                sigma = [sigma[0].min(value), sigma[1].max(value)];
            }
        }
        let opacity = f64::from(p.opacity);
        let level = 0.5 * opacity * (sigma[1] - sigma[0]);
        let speed = p.velocity.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        let spin = p.turn.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        let size = p.scales.iter().fold(0.0f32, |a, &b| a.max(b));
        let shift = 0.5 * self.length * (speed + spin * f64::from(size)) * sampling.pixels(mean) * opacity;
        if !(shift <= tolerance && LEVEL_PIXELS * level <= tolerance) {
            return None;
        }
        Some(Primitive {
            mean,
            center: self.first + 0.5 * self.length * self.count as f64,
            half_width: f64::INFINITY,
            softness: 1.0,
            opacity: (opacity * 0.5 * (sigma[0] + sigma[1])) as f32,
            velocity: [0.0; 3],
            turn: [0.0; 3],
            ..p.clone()
        })
    }
}
