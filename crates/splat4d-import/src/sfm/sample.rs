//! Models that most of the data agree on: locally optimised sample consensus (Chum, Matas and Kittler 2003) with the
//! score of MSAC (Torr and Zisserman 2000).

use splat4d::math::Rng;

/// Data of the search for a model.
pub(crate) trait Data {
    /// The model.
    type Model: Clone;
    /// Data that a model is made of.
    const SAMPLE: usize;
    /// How many there are.
    fn len(&self) -> usize;
    /// The models that fit a sample exactly.
    fn fit(&self, sample: &[usize]) -> Vec<Self::Model>;
    /// Squared distance of a datum from the model, pixels²; infinite where it cannot belong to it.
    fn error(&self, model: &Self::Model, k: usize) -> f64;
    /// A better model by all of these data.
    fn polish(&self, model: &Self::Model, inliers: &[usize]) -> Option<Self::Model>;
}

/// Number of trials, and the inlier threshold.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Search {
    /// Data nearer than this to a model agree with it, pixels.
    pub tolerance: f64,
    /// Samples, at most.
    pub most: usize,
    /// It ends when a better model is left with no more than this chance.
    pub missed: f64,
}

/// A model and who agrees.
#[derive(Clone, Debug)]
pub(crate) struct Consensus<M> {
    pub model: M,
    /// Ascending.
    pub inliers: Vec<usize>,
    /// Σ min(error, tolerance²): less is better.
    pub cost: f64,
}

/// Times that a better model is polished by those who agree with it.
const POLISHES: usize = 4;

/// The best model found; the same for the same random numbers. `None`: no sample gave any.
pub(crate) fn consensus<D: Data>(data: &D, search: Search, rng: Rng) -> Option<Consensus<D::Model>> {
    let n = data.len();
    if n < D::SAMPLE {
        return None;
    }
    let limit = search.tolerance * search.tolerance;
    let cost = |model: &D::Model, enough: f64| {
        let mut sum = 0.0;
        for k in 0..n {
            sum += data.error(model, k).min(limit);
            if sum >= enough {
                return f64::INFINITY;
            }
        }
        sum
    };
    let inliers = |model: &D::Model| (0..n).filter(|&k| data.error(model, k) < limit).collect::<Vec<usize>>();
    let mut best: Option<Consensus<D::Model>> = None;
    let mut most = search.most;
    let mut trial = 0;
    let mut sample = vec![0; D::SAMPLE];
    while trial < most {
        let draws = rng.fork(trial as u64);
        trial += 1;
        let mut draw = 0;
        for k in 0..D::SAMPLE {
            sample[k] = loop {
                let at = draws.below(draw, n);
                draw += 1;
                if !sample[..k].contains(&at) {
                    break at;
                }
            };
        }
        for model in data.fit(&sample) {
            let least = best.as_ref().map_or(f64::INFINITY, |b| b.cost);
            let first = cost(&model, least);
            if first >= least || first.is_nan() {
                continue;
            }
            let mut found = Consensus { inliers: inliers(&model), model, cost: first };
            for _ in 0..POLISHES {
                if found.inliers.len() <= D::SAMPLE {
                    break;
                }
                let Some(better) = data.polish(&found.model, &found.inliers) else { break };
                let next = cost(&better, found.cost);
                if next >= found.cost || next.is_nan() {
                    break;
                }
                found = Consensus { inliers: inliers(&better), model: better, cost: next };
            }
            let share = found.inliers.len() as f64 / n as f64;
            let clean = share.powi(D::SAMPLE as i32).clamp(1e-12, 1.0 - 1e-12);
            let needed = (search.missed.ln() / (1.0 - clean).ln()).ceil();
            most = most.min((needed as usize).max(1)).max(trial);
            best = Some(found);
        }
    }
    best
}
