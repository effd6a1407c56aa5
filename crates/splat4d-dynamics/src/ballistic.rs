//! Baselines without learning: freeze, constant velocity and turn, damped acceleration.

use crate::paths::{Moment, Paths, Pose, exp, turn};
use splat4d::math::quat;
use splat4d::math::se3::{add, scale};

/// Frames from which velocities are estimated (methods of robust finite differences: three to five).
pub(crate) const WINDOW: usize = 5;
/// Share of the acceleration that is left after a frame.
pub(crate) const DAMPING: f64 = 0.9;

/// The last state, constant.
pub(crate) fn freeze(paths: &Paths, horizon: usize) -> Vec<Moment> {
    vec![paths.last().clone(); horizon]
}

/// The last time continues with the velocities and turns of the last frames, and with accelerations that fade by
/// `damping` a frame; without `damping` with none.
pub(crate) fn ballistic(paths: &Paths, horizon: usize, damping: Option<f64>) -> Vec<Moment> {
    let rates: Vec<Rates> = (0..paths.nodes()).map(|k| Rates::of(paths, k, damping.is_some())).collect();
    let step = |h: usize| paths.last().iter().zip(&rates).map(|(p, r)| r.after(p, h, damping.unwrap_or(0.0))).collect();
    (1..=horizon).map(step).collect()
}

/// Motion of a node at the last time, per frame.
struct Rates {
    velocity: [f64; 3],
    acceleration: [f64; 3],
    turn: [f64; 3],
}

impl Rates {
    /// Least squares over the last [`WINDOW`] frames: a line, or a parabola, through the last position.
    fn of(paths: &Paths, k: usize, curved: bool) -> Self {
        let n = paths.len().min(WINDOW);
        let ticks = &paths.moments[paths.len() - n..];
        let last = ticks[n - 1][k];
        // x(s) − x(0) = v s + a s²/2 at s = −1, −2 ...: normal equations of two unknowns.
        let (mut m, mut b) = ([0.0; 3], [[0.0; 3]; 2]);
        for (i, tick) in ticks[..n - 1].iter().enumerate() {
            let s = i as f64 - (n - 1) as f64;
            let (f, g) = (s, 0.5 * s * s);
            m = [m[0] + f * f, m[1] + f * g, m[2] + g * g];
            for c in 0..3 {
                let d = tick[k].x[c] - last.x[c];
                b[0][c] += f * d;
                b[1][c] += g * d;
            }
        }
        let det = m[0] * m[2] - m[1] * m[1];
        // Two frames determine no curve.
        let (velocity, acceleration) = if curved && n > 2 {
            (
                std::array::from_fn(|c| (m[2] * b[0][c] - m[1] * b[1][c]) / det),
                std::array::from_fn(|c| (m[0] * b[1][c] - m[1] * b[0][c]) / det),
            )
        } else if n > 1 {
            (b[0].map(|x| x / m[0]), [0.0; 3])
        } else {
            ([0.0; 3], [0.0; 3])
        };
        let steps = ticks.windows(2).map(|w| turn(w[0][k].q, w[1][k].q));
        let turn = scale(steps.fold([0.0; 3], add), 1.0 / (n.max(2) - 1) as f64);
        Self { velocity, acceleration, turn }
    }

    /// The pose after h frames: x + h v + a Σ_{k<h} (h − k − ½) ρᵏ, which is h²/2 a for ρ = 1.
    fn after(&self, from: &Pose, h: usize, damping: f64) -> Pose {
        let mut reach = 0.0;
        let mut share = 1.0;
        for k in 0..h {
            reach += (h as f64 - k as f64 - 0.5) * share;
            share *= damping;
        }
        let x = add(add(from.x, scale(self.velocity, h as f64)), scale(self.acceleration, reach));
        Pose { x, q: quat::normalize(quat::product(exp(scale(self.turn, h as f64)), from.q)).0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::se3::{norm, sub};

    fn path(f: impl Fn(f64) -> Pose) -> Paths {
        Paths { moments: (0..12).map(|t| vec![f(f64::from(t))]).collect() }
    }

    #[test]
    fn constant_velocity_and_turn_are_exact() {
        let twist = |t: f64| Pose { x: [0.1 * t, 1.0 - 0.3 * t, 2.0], q: exp([0.0, 0.07 * t, 0.01 * t]) };
        for (damping, step) in [(None, 20), (Some(DAMPING), 20)] {
            let out = ballistic(&path(twist), step, damping);
            let (found, truth) = (out[step - 1][0], twist(11.0 + step as f64));
            assert!(norm(sub(found.x, truth.x)) < 1e-9 && norm(turn(found.q, truth.q)) < 1e-9, "{damping:?}");
        }
    }

    #[test]
    fn constant_acceleration_is_exact_where_it_does_not_fade() {
        let fall = |t: f64| Pose::at([0.2 * t, 5.0 - 0.02 * t * t, 0.0]);
        let error = |damping| norm(sub(ballistic(&path(fall), 15, damping)[14][0].x, fall(26.0).x));
        assert!(error(Some(1.0)) < 1e-9, "{}", error(Some(1.0)));
        assert!(error(None) > 4.0 && error(Some(DAMPING)) > 0.5, "what fades falls behind");
    }

    #[test]
    fn errors_on_a_circle_are_those_of_geometry() {
        let (r, delta) = (2.0, 0.05);
        let at = |t: f64| Pose::at([r * (delta * t).cos(), r * (delta * t).sin(), 0.0]);
        let paths = path(at);
        // Freeze: a chord. The velocity of the last frames lags by two of them, a line does not bend.
        for h in [5usize, 20] {
            let theta = h as f64 * delta;
            let truth = at(11.0 + h as f64).x;
            let frozen = norm(sub(freeze(&paths, h)[h - 1][0].x, truth));
            assert!((frozen - 2.0 * r * (theta / 2.0).sin()).abs() < 1e-9);
            let line = norm(sub(ballistic(&paths, h, None)[h - 1][0].x, truth));
            let exact = r * ((1.0 - theta.cos()).powi(2) + (theta - theta.sin()).powi(2)).sqrt();
            let lag = 2.0 * r * delta * theta;
            assert!(line > 0.99 * exact && line < exact + lag && line < frozen, "{line} {exact}");
        }
    }
}
