//! Offsets of all cameras from lags of pairs: robust least squares on the graph. Lags that contradict the rest are left
//! out and named.

use serde::{Deserialize, Serialize};
use splat4d::math::cholesky::Cholesky;

/// Standard deviations that a lag may be off before it contradicts.
const SIGMAS: f64 = 4.0;
/// The least uncertainty of a lag, seconds.
const LEAST_SIGMA: f64 = 1e-5;
/// How the tolerance narrows from step to step (Yang et al. 2020, graduated non-convexity: 1.4).
const NARROWER: f64 = 1.4;
/// Steps at most.
const STEPS: usize = 100;
/// Ridge that keeps the equations regular for unconnected cameras, relative to the least certain lag's weight.
const RIDGE: f64 = 1e-9;

/// Source of a lag, the most trusted first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Kind {
    /// Given by the user.
    Given,
    /// Epipolar geometry.
    Geometry,
    /// Sound.
    Sound,
    /// Motion energy: a guess, used only where there is nothing else.
    Motion,
}

impl Kind {
    /// Its name in reports and in the file of corrections.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Given => "told",
            Self::Geometry => "geometry",
            Self::Sound => "sound",
            Self::Motion => "motion",
        }
    }
}

/// A lag of two cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// The cameras a and b.
    pub cameras: [usize; 2],
    /// Seconds by which b is late: `t_b − t_a` of one event.
    pub lag: f64,
    /// Its standard deviation, seconds.
    pub sigma: f64,
    /// Seconds by which it grows each second, where that is known.
    pub drift: Option<f64>,
    /// Its source.
    pub kind: Kind,
}

/// Correction of a camera's times: an event at t is at `t·(1 + rate) + seconds` on the clock of all.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Offset {
    /// Seconds.
    pub seconds: f64,
    /// Its standard deviation, seconds; 0 for the camera that is the clock and for given offsets.
    pub sigma: f64,
    /// Drift of the clock, seconds a second.
    pub rate: f64,
    /// The kinds of evidence about this camera that were used, the most trusted first.
    pub kinds: Vec<Kind>,
    /// Whether other evidence would have contradicted a wrong offset: the camera hangs on more than one lag.
    pub checked: bool,
}

impl Offset {
    /// The camera's time on the clock of all.
    pub(crate) fn global(&self, time: f64) -> f64 {
        time * (1.0 + self.rate) + self.seconds
    }
}

/// Evidence that was not used.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Refused {
    /// Its number.
    pub evidence: usize,
    /// By how many seconds it contradicts what was used; None: it was not needed, or leads to no known camera.
    pub off: Option<f64>,
}

/// The clock of all.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Solution {
    /// Per camera; None: nothing connects it with camera 0 or one whose offset is given.
    pub offsets: Vec<Option<Offset>>,
    /// Rejected lags.
    pub refused: Vec<Refused>,
}

/// Offsets of this many cameras, camera 0's being 0 unless `given` states otherwise; where it gives an offset, it is
/// kept. Lags that are off by more than `tolerance` seconds (half a frame) and more than four standard deviations
/// contradict.
pub(crate) fn solve(cameras: usize, evidence: &[Evidence], given: &[Option<f64>], tolerance: f64) -> Solution {
    let mut known: Vec<Option<f64>> = (0..cameras).map(|c| given.get(c).copied().flatten()).collect();
    let told: Vec<bool> = known.iter().map(Option::is_some).collect();
    if known.iter().all(Option::is_none) && cameras > 0 {
        known[0] = Some(0.0);
    }
    let sound = |e: &Evidence| {
        e.cameras.iter().all(|&c| c < cameras)
            && e.cameras[0] != e.cameras[1]
            && e.lag.is_finite()
            && e.sigma.is_finite()
            && e.sigma >= 0.0
    };
    let measured: Vec<usize> =
        (0..evidence.len()).filter(|&k| sound(&evidence[k]) && evidence[k].kind != Kind::Motion).collect();
    let guessed: Vec<usize> =
        (0..evidence.len()).filter(|&k| sound(&evidence[k]) && evidence[k].kind == Kind::Motion).collect();
    let graph = Graph { cameras, evidence, tolerance };
    let mut used = graph.agree(&measured, &known);
    let reached = graph.reached(&used, &known, None);
    // Guesses count only where they lead to cameras that nothing else leads to.
    let needed = |&k: &usize| evidence[k].cameras.iter().any(|&c| !reached[c]);
    let guesses: Vec<usize> = guessed.into_iter().filter(needed).collect();
    if !guesses.is_empty() {
        let mut fixed = known.clone();
        let values = graph.least_squares(&used, &known).0;
        (0..cameras).filter(|&c| reached[c]).for_each(|c| fixed[c] = Some(values[c]));
        used.extend(graph.agree(&guesses, &fixed));
    }
    let (values, variances) = graph.least_squares(&used, &known);
    let inflation = graph.inflation(&used, &values, &known);
    let rates = graph.rates(&used, &known);
    let reached = graph.reached(&used, &known, None);
    let offset = |c: usize| {
        reached[c].then(|| {
            let about = |k: &&usize| evidence[**k].cameras.contains(&c);
            let mut kinds: Vec<Kind> = used.iter().filter(about).map(|&k| evidence[k].kind).collect();
            if told[c] {
                kinds.push(Kind::Given);
            }
            kinds.sort();
            kinds.dedup();
            // A guess checks nothing.
            let measured: Vec<usize> = used.iter().copied().filter(|&k| evidence[k].kind != Kind::Motion).collect();
            let checked = known[c].is_some()
                || measured.iter().all(|&k| graph.reached(&measured, &known, Some(k))[c])
                    && graph.reached(&measured, &known, None)[c];
            let sigma = if known[c].is_some() { 0.0 } else { (variances[c] * inflation).sqrt() };
            Offset { seconds: values[c], sigma, rate: rates[c], kinds, checked }
        })
    };
    let offsets: Vec<Option<Offset>> = (0..cameras).map(offset).collect();
    let off = |k: usize| {
        let [a, b] = evidence[k].cameras;
        let both = if sound(&evidence[k]) { reached[a] && reached[b] } else { false };
        both.then(|| evidence[k].lag - (values[a] - values[b]))
    };
    let refused = (0..evidence.len())
        .filter(|k| !used.contains(k))
        .map(|k| Refused {
            evidence: k,
            off: off(k).filter(|o| evidence[k].kind != Kind::Motion || o.abs() > graph.allowed(k)),
        })
        .collect();
    Solution { offsets, refused }
}

struct Graph<'a> {
    cameras: usize,
    evidence: &'a [Evidence],
    tolerance: f64,
}

impl Graph<'_> {
    fn sigma(&self, k: usize) -> f64 {
        self.evidence[k].sigma.max(LEAST_SIGMA)
    }

    /// How far off a lag may be.
    fn allowed(&self, k: usize) -> f64 {
        self.tolerance.max(SIGMAS * self.sigma(k))
    }

    /// How much more a lag counts than a guess when witnesses contradict each other.
    fn trust(&self, k: usize) -> f64 {
        match self.evidence[k].kind {
            Kind::Given | Kind::Geometry => 4.0,
            Kind::Sound => 2.0,
            Kind::Motion => 1.0,
        }
    }

    fn residual(&self, k: usize, values: &[f64]) -> f64 {
        let [a, b] = self.evidence[k].cameras;
        values[a] - values[b] - self.evidence[k].lag
    }

    /// The largest set of lags found that agree, in order: truncated least squares by graduated non-convexity, then
    /// rejected trusted lags are restored if they alone connect a camera.
    fn agree(&self, edges: &[usize], known: &[Option<f64>]) -> Vec<usize> {
        if edges.is_empty() {
            return Vec::new();
        }
        let at = |k: usize| edges.iter().position(|&e| e == k).expect("it is one of the edges");
        // Here all lags of a kind weigh alike: an echo has a small sigma, too.
        let fit = |weights: &[f64]| {
            let weight = |k: usize| weights[at(k)] * self.trust(k) / self.allowed(k).powi(2);
            let terms: Vec<Term> =
                edges.iter().map(|&k| (self.evidence[k].cameras, self.evidence[k].lag, weight(k))).collect();
            weighted(self.cameras, &terms, known).0
        };
        let mut weights = vec![1.0; edges.len()];
        let mut values = fit(&weights);
        let ratio = |k: usize, values: &[f64]| (self.residual(k, values) / self.allowed(k)).powi(2);
        let worst = edges.iter().map(|&k| ratio(k, &values)).fold(0.0, f64::max);
        // Nothing is narrowed where all agree at once.
        let mut control = if worst > 1.0 { 1.0 / (2.0 * worst - 1.0) } else { f64::INFINITY };
        for _ in 0..STEPS {
            if !control.is_finite() {
                break;
            }
            for (w, &k) in weights.iter_mut().zip(edges) {
                let r = ratio(k, &values);
                *w = if r <= control / (control + 1.0) {
                    1.0
                } else if r >= (control + 1.0) / control {
                    0.0
                } else {
                    (control * (control + 1.0) / r).sqrt() - control
                };
            }
            values = fit(&weights);
            if weights.iter().all(|w| *w == 0.0 || *w == 1.0) {
                break;
            }
            control *= NARROWER;
        }
        let mut used: Vec<usize> = edges.iter().copied().filter(|&k| weights[at(k)] > 0.5).collect();
        // The most trusted and certain first.
        let mut rest: Vec<usize> = edges.iter().copied().filter(|k| !used.contains(k)).collect();
        rest.sort_by(|&i, &j| {
            let key = |k: usize| (self.evidence[k].kind, self.sigma(k));
            let ((x, s), (y, t)) = (key(i), key(j));
            x.cmp(&y).then(s.total_cmp(&t)).then(i.cmp(&j))
        });
        for k in rest {
            let reached = self.reached(&used, known, None);
            let [a, b] = self.evidence[k].cameras;
            let leads = reached[a] != reached[b] || !(reached[a] || self.joined(&used, a, b));
            let values = self.least_squares(&used, known).0;
            if leads || self.residual(k, &values).abs() <= self.allowed(k) {
                used.push(k);
            }
        }
        used.sort_unstable();
        used
    }

    /// Whether two cameras are joined by lags.
    fn joined(&self, used: &[usize], a: usize, b: usize) -> bool {
        let mut from = vec![None; self.cameras];
        from[a] = Some(0.0);
        self.reached(used, &from, None)[b]
    }

    /// Which cameras are joined to a known one by lags, `without` one of them.
    fn reached(&self, used: &[usize], known: &[Option<f64>], without: Option<usize>) -> Vec<bool> {
        let mut reached: Vec<bool> = known.iter().map(Option::is_some).collect();
        for _ in 0..self.cameras {
            for &k in used.iter().filter(|&&k| Some(k) != without) {
                let [a, b] = self.evidence[k].cameras;
                let either = reached[a] || reached[b];
                (reached[a], reached[b]) = (either, either);
            }
        }
        reached
    }

    /// Offsets that fit the lags best, and their variances. Known ones stay; cameras that nothing joins get 0.
    fn least_squares(&self, used: &[usize], known: &[Option<f64>]) -> (Vec<f64>, Vec<f64>) {
        let term = |&k: &usize| (self.evidence[k].cameras, self.evidence[k].lag, 1.0 / self.sigma(k).powi(2));
        weighted(self.cameras, &used.iter().map(term).collect::<Vec<Term>>(), known)
    }

    /// By how much lags differ more than they claim: the reduced χ², at least 1.
    fn inflation(&self, used: &[usize], values: &[f64], known: &[Option<f64>]) -> f64 {
        let unknown = known.iter().filter(|k| k.is_none()).count();
        let sum: f64 = used.iter().map(|&k| (self.residual(k, values) / self.sigma(k)).powi(2)).sum();
        (sum / used.len().saturating_sub(unknown).max(1) as f64).max(1.0)
    }

    /// Drifts of the clocks that fit the drifts of the lags best.
    fn rates(&self, used: &[usize], known: &[Option<f64>]) -> Vec<f64> {
        let term = |&k: &usize| self.evidence[k].drift.map(|d| (self.evidence[k].cameras, d, 1.0));
        let terms: Vec<Term> = used.iter().filter_map(term).collect();
        let fixed: Vec<Option<f64>> = known.iter().map(|k| k.map(|_| 0.0)).collect();
        if terms.is_empty() { vec![0.0; self.cameras] } else { weighted(self.cameras, &terms, &fixed).0 }
    }
}

/// Cameras a and b, the measured difference `value_a − value_b`, and its weight.
type Term = ([usize; 2], f64, f64);

/// Weighted least squares of differences: values and variances.
fn weighted(cameras: usize, terms: &[Term], known: &[Option<f64>]) -> (Vec<f64>, Vec<f64>) {
    let unknown: Vec<usize> = (0..cameras).filter(|&c| known[c].is_none()).collect();
    let place = |c: usize| unknown.binary_search(&c).ok();
    let n = unknown.len();
    let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
    let least = terms.iter().map(|t| t.2).filter(|w| *w > 0.0).fold(f64::INFINITY, f64::min);
    let ridge = if least.is_finite() { RIDGE * least } else { 1.0 };
    (0..n).for_each(|i| matrix[i * n + i] = ridge);
    for &([a, b], lag, w) in terms {
        let fixed = |c: usize| known[c].unwrap_or(0.0);
        for (own, other, sign) in [(a, b, 1.0), (b, a, -1.0)] {
            let Some(i) = place(own) else { continue };
            matrix[i * n + i] += w;
            right[i] += w * sign * lag;
            match place(other) {
                Some(j) => matrix[i * n + j] -= w,
                None => right[i] += w * fixed(other),
            }
        }
    }
    let factor = Cholesky::new(n, matrix).expect("weights are positive, and a ridge is below them");
    let solved = factor.solve(right);
    let mut values: Vec<f64> = known.iter().map(|k| k.unwrap_or(0.0)).collect();
    let mut variances = vec![0.0; cameras];
    for (i, &c) in unknown.iter().enumerate() {
        values[c] = solved[i];
        let mut unit = vec![0.0; n];
        unit[i] = 1.0;
        variances[c] = factor.solve(unit)[i];
    }
    (values, variances)
}
