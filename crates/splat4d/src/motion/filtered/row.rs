//! One Gaussian: what is predicted from two earlier states, and how prediction and observation become one.

use crate::math::Real;
use crate::math::spd::{
    Geodesic, IDENTITY, Lifted, Mat3, STRETCH_MIN, apply, inner, inverse, mix, mul, outer, pack, pack_gradient,
    sandwich, symmetric, unpack, unpack_gradient,
};
use crate::scene::splats::COV;
use serde::{Deserialize, Serialize};

/// N(μ, Σ), or a gradient to one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Normal {
    /// μ
    pub mean: [f64; 3],
    /// Σ
    pub cov: Mat3,
}

impl Normal {
    /// No gradient.
    pub const ZERO: Self = Self { mean: [0.0; 3], cov: [[0.0; 3]; 3] };

    /// The first nine numbers of a splat.
    pub fn of_splat<F: Real>(row: [F; 9]) -> Self {
        let [x, y, z, c @ ..] = row;
        Self { mean: [x, y, z].map(F::f64), cov: unpack(c) }
    }

    /// A gradient to the first nine numbers of a splat.
    pub(crate) fn of_gradient<F: Real>(row: [F; 9]) -> Self {
        let [x, y, z, c @ ..] = row;
        Self { mean: [x, y, z].map(F::f64), cov: unpack_gradient(c) }
    }

    /// As the first nine numbers of a splat.
    pub fn splat<F: Real>(&self) -> [F; 9] {
        self.row(pack(&self.cov))
    }

    /// As a gradient to the first nine numbers of a splat.
    pub fn gradient<F: Real>(&self) -> [F; 9] {
        self.row(pack_gradient(&self.cov))
    }

    fn row<F: Real>(&self, cov: [F; 6]) -> [F; 9] {
        std::array::from_fn(|k| if k < COV { F::of(self.mean[k]) } else { cov[k - COV] })
    }

    fn add(&mut self, other: &Self) {
        self.mean = std::array::from_fn(|k| self.mean[k] + other.mean[k]);
        self.cov = mix(1.0, &self.cov, 1.0, &other.cov);
    }
}

/// Prediction of a Gaussian's shape. Means continue at constant velocity in all of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Predictor {
    /// The six numbers of the covariance continue in a straight line; what leaves the space of covariances is lifted
    /// back.
    Euclidean,
    /// At constant velocity in Wasserstein geometry: Exp(−Log).
    #[default]
    Wasserstein,
    /// Shapes stay as they were last: neither log nor exp.
    Hold,
}

impl Predictor {
    /// All, by the names that recipes and files use.
    pub const ALL: [(&'static str, Self); 3] =
        [("euclidean", Self::Euclidean), ("wasserstein", Self::Wasserstein), ("hold", Self::Hold)];
}

/// A prediction one frame ahead, and what its gradient needs.
#[derive(Clone, Copy, Debug)]
pub struct Prediction {
    /// The predicted Gaussian.
    pub point: Normal,
    share: f64,
    shape: Shape,
}

#[derive(Clone, Copy, Debug)]
#[allow(clippy::large_enum_variant)] // lives on the stack for one row
enum Shape {
    Held,
    Straight(Lifted),
    Curved(Geodesic),
}

impl Prediction {
    /// From the state one frame ago and the one `baseline` frames before that.
    pub fn new(predictor: Predictor, last: &Normal, before: &Normal, baseline: usize) -> Self {
        let share = 1.0 / baseline as f64;
        let mean = std::array::from_fn(|k| last.mean[k] + share * (last.mean[k] - before.mean[k]));
        let (cov, shape) = match predictor {
            Predictor::Hold => (last.cov, Shape::Held),
            Predictor::Wasserstein => {
                let g = Geodesic::new(&last.cov, &before.cov, -share);
                (g.point, Shape::Curved(g))
            }
            Predictor::Euclidean => {
                let straight = mix(1.0 + share, &last.cov, -share, &before.cov);
                // As much as the clamp of Exp lets an axis shrink; a constant to the gradient.
                let least =
                    crate::math::spd::Eigen::of_covariance(&last.cov).values.into_iter().fold(f64::MAX, f64::min);
                let lifted = Lifted::new(&straight, STRETCH_MIN * STRETCH_MIN * least);
                (lifted.matrix, Shape::Straight(lifted))
            }
        };
        Self { point: Normal { mean, cov }, share, shape }
    }

    /// VJP: gradients to the last state and the one before.
    pub fn backward(&self, d: &Normal) -> (Normal, Normal) {
        let s = self.share;
        let (last, before) = match &self.shape {
            Shape::Held => (d.cov, [[0.0; 3]; 3]),
            Shape::Curved(g) => {
                let (a, b, _) = g.backward(&d.cov);
                (a, b)
            }
            Shape::Straight(lifted) => {
                let g = lifted.backward(&d.cov);
                (mix(1.0 + s, &g, 0.0, &g), mix(-s, &g, 0.0, &g))
            }
        };
        (
            Normal { mean: d.mean.map(|x| (1.0 + s) * x), cov: last },
            Normal { mean: d.mean.map(|x| -s * x), cov: before },
        )
    }
}

/// Fusion of prediction and observation into one state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fusion {
    /// Not at all: the observation is the state, and the filter costs nothing.
    #[default]
    Off,
    /// Between the two by one learnt share a Gaussian: means in a straight line, shapes on the geodesic. No splat
    /// becomes thinner by being certain.
    Geodesic,
    /// Kalman's formulas with the covariances as uncertainties, as published: shapes shrink (to half where both agree).
    Literal,
}

impl Fusion {
    /// All, by the names that recipes and files use.
    pub const ALL: [(&'static str, Self); 3] =
        [("off", Self::Off), ("geodesic", Self::Geodesic), ("literal", Self::Literal)];
}

/// ε of Kalman's gain, scene units²: below every splat.
const EPSILON: f64 = 1e-12;

/// Prediction and observation as one, and what its gradient needs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fused {
    /// The state.
    pub point: Normal,
    /// Weight of the prediction: `trust` times the gate.
    pub open: f64,
    gain: f64,
    trust: f64,
    /// Of the gate: its value and its slope by the squared innovation.
    gate: [f64; 2],
    delta: [f64; 3],
    /// S⁻¹ of the innovation's covariance S, and S⁻¹δ.
    precision: Mat3,
    weighed: [f64; 3],
    rule: Rule,
}

#[derive(Clone, Copy, Debug)]
#[allow(clippy::large_enum_variant)] // lives on the stack for one row
enum Rule {
    /// The prediction counts for nothing.
    Closed,
    /// The observation's share κ, and the shapes' path.
    Share(f64, Geodesic),
    /// K = Σₚ S⁻¹ and the state before trust is applied.
    Kalman(Mat3, Normal),
}

/// Gradients of a fusion.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FusedGrads {
    /// To the observation.
    pub seen: Normal,
    /// To the prediction.
    pub predicted: Normal,
    /// To the gain.
    pub gain: f64,
    /// To the trust.
    pub trust: f64,
}

impl Fused {
    /// `gain`: share of the observation in [0, 1] (geodesic); `trust`: how far predictions count, in [0, 1]; `gate`:
    /// squared Mahalanobis distance at which nothing of the prediction is left (it fades from half of that); 0: no
    /// gate.
    pub(crate) fn new(fusion: Fusion, seen: &Normal, predicted: &Normal, gain: f64, trust: f64, gate: f64) -> Self {
        let delta: [f64; 3] = std::array::from_fn(|k| seen.mean[k] - predicted.mean[k]);
        let sum = mix(1.0, &seen.cov, 1.0, &predicted.cov);
        let precision = inverse(&mix(1.0, &sum, EPSILON, &IDENTITY));
        let weighed = apply(&precision, delta);
        let innovation: f64 = (0..3).map(|k| delta[k] * weighed[k]).sum();
        let gate = gate_of(innovation, gate);
        let open = trust * gate[0];
        let mut out = Self { point: *seen, open, gain, trust, gate, delta, precision, weighed, rule: Rule::Closed };
        if open <= 0.0 {
            return out;
        }
        match fusion {
            Fusion::Off => {}
            Fusion::Geodesic => {
                let share = 1.0 - open * (1.0 - gain);
                let path = Geodesic::new(&predicted.cov, &seen.cov, share);
                let mean = std::array::from_fn(|k| predicted.mean[k] + share * delta[k]);
                out.point = Normal { mean, cov: path.point };
                out.rule = Rule::Share(share, path);
            }
            Fusion::Literal => {
                let k = mul(&predicted.cov, &precision);
                let step = apply(&predicted.cov, weighed);
                let mean = std::array::from_fn(|i| predicted.mean[i] + step[i]);
                // (I − K)Σₚ = Σₚ − Σₚ S⁻¹ Σₚ is already symmetric.
                let cov = mix(1.0, &predicted.cov, -1.0, &sandwich(&predicted.cov, &precision));
                let state = Normal { mean, cov };
                out.point = Normal {
                    mean: std::array::from_fn(|i| seen.mean[i] + open * (mean[i] - seen.mean[i])),
                    cov: mix(1.0 - open, &seen.cov, open, &cov),
                };
                out.rule = Rule::Kalman(k, state);
            }
        }
        out
    }

    /// VJP. `seen` as it was given to [`new`](Self::new).
    pub(crate) fn backward(&self, seen: &Normal, d: &Normal) -> FusedGrads {
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let mut out = FusedGrads { seen: *d, predicted: Normal::ZERO, gain: 0.0, trust: 0.0 };
        let d_open = match &self.rule {
            Rule::Closed => return out,
            Rule::Share(share, path) => {
                let (d_from, d_to, d_s) = path.backward(&d.cov);
                out.seen = Normal { mean: d.mean.map(|x| share * x), cov: d_to };
                out.predicted = Normal { mean: d.mean.map(|x| (1.0 - share) * x), cov: d_from };
                let d_share = dot(d.mean, self.delta) + d_s;
                out.gain = self.open * d_share;
                -(1.0 - self.gain) * d_share
            }
            Rule::Kalman(k, state) => {
                let open = self.open;
                out.seen = Normal { mean: d.mean.map(|x| (1.0 - open) * x), cov: mix(1.0 - open, &d.cov, 0.0, &d.cov) };
                let g = Normal { mean: d.mean.map(|x| open * x), cov: mix(open, &d.cov, 0.0, &d.cov) };
                let transposed: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| k[j][i]));
                let to_mean = apply(&transposed, g.mean);
                // dS from the mean (S⁻¹ in the gain) and from the covariance.
                let d_s = mix(1.0, &symmetric(&mul(&mul(&transposed, &g.cov), k)), -1.0, &outer(to_mean, self.weighed));
                let own = mix(-2.0, &symmetric(&mul(&g.cov, k)), 1.0, &outer(g.mean, self.weighed));
                out.seen.add(&Normal { mean: to_mean, cov: d_s });
                out.predicted = Normal {
                    mean: std::array::from_fn(|i| g.mean[i] - to_mean[i]),
                    cov: mix(1.0, &mix(1.0, &g.cov, 1.0, &own), 1.0, &d_s),
                };
                let mean: [f64; 3] = std::array::from_fn(|i| state.mean[i] - seen.mean[i]);
                dot(d.mean, mean) + inner(&d.cov, &mix(1.0, &state.cov, -1.0, &seen.cov))
            }
        };
        out.trust = d_open * self.gate[0];
        // The innovation's square is δᵀS⁻¹δ.
        let d_innovation = d_open * self.trust * self.gate[1];
        if d_innovation != 0.0 {
            let d_mean = self.weighed.map(|x| 2.0 * d_innovation * x);
            let d_s = mix(-d_innovation, &outer(self.weighed, self.weighed), 0.0, &self.precision);
            out.seen.add(&Normal { mean: d_mean, cov: d_s });
            out.predicted.add(&Normal { mean: d_mean.map(|x| -x), cov: d_s });
        }
        out
    }
}

/// Value of the gate for a squared innovation, and its slope.
fn gate_of(innovation: f64, gate: f64) -> [f64; 2] {
    if gate <= 0.0 {
        return [1.0, 0.0];
    }
    let open = 2.0 * (1.0 - innovation / gate);
    // What is not a number closes the gate: the observation is all there is.
    if open >= 1.0 {
        [1.0, 0.0]
    } else if open > 0.0 {
        [open, -2.0 / gate]
    } else {
        [0.0, 0.0]
    }
}
