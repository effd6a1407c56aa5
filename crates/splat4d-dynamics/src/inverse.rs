//! Inverse dynamics: the actions that led from one observed state to the next, by the gradient of a trained network's
//! rollouts to its actions.
//!
//! All groups of frames are optimised at once, each from its own observed start, so that errors of one group do not
//! enter the next. Memory of a network (`warm_up`) is filled with the current estimate of earlier actions.

#[cfg(test)]
mod tests;

use crate::actions::Actions;
use crate::learnt::{Action, Learnt, Network, rollout_loss};
use crate::paths::Paths;
use crate::{Error, Result};
use splat4d::scene::Grads;

/// Steps of Adam from no action at all. Actions are scaled to a size of about 1.
const STEPS: usize = 150;
/// Rate of the first step, of the scaled action; it falls to zero (cosine).
const RATE: f64 = 0.2;
/// Adam's decays, as in training (CONVENTIONS.md), and its guard against division by zero.
const DECAYS: [f64; 2] = [0.8, 0.99];
const EPSILON: f64 = 1e-15;

/// `known`, continued to the last but one tick of `paths` by the actions with which the network follows the paths best;
/// each is constant over `hold` frames.
///
/// Errors: the network was trained without these actions; `hold` is 0; too few rows are known for its memory.
pub(crate) fn infer<N: Network>(model: &Learnt<N>, paths: &Paths, known: &Actions, hold: usize) -> Result<Actions> {
    let (first, ticks, columns) = (known.rows.len(), paths.len(), known.columns());
    if model.units.is_empty() || model.columns != columns {
        return Err(Error::input("the model was not trained with these actions")
            .remedy("Fit it with a table of the same columns"));
    }
    if hold == 0 {
        return Err(Error::input("an action is held for one frame at least").remedy("Set 1 or more"));
    }
    let need = 1 + model.warm_up(paths);
    if first < need {
        return Err(Error::input(format!("{first} rows of known actions are too few: {need} are needed"))
            .remedy("Give the actions of more frames"));
    }
    let frames = (ticks - 1).saturating_sub(first);
    let width = 3 * columns.0.len() + columns.1.len();
    let mut free = vec![vec![0.0; width]; frames.div_ceil(hold)];
    let (full, rest) = (frames / hold, frames % hold);
    // Groups of one length are optimised side by side.
    let batches = [(0..full, hold), (full..free.len(), rest)].map(|(groups, horizon)| {
        let starts: Vec<usize> = groups.clone().map(|g| first + g * hold).collect();
        (groups, starts, horizon)
    });
    let mut moments = vec![[0.0; 2]; width * free.len()];
    let mut unused = Grads::new(&model.params);
    for step in 0..STEPS {
        let mut slopes = vec![vec![0.0; width]; free.len()];
        let action = |tick: usize| -> Action<f32> {
            match tick.checked_sub(first) {
                Some(later) => free[later / hold].iter().map(|x| *x as f32).collect(),
                None => model.action(Some(known), tick),
            }
        };
        for (groups, starts, horizon) in batches.iter().filter(|b| !b.1.is_empty()) {
            let window = model.window(paths, starts, *horizon, action);
            unused.clear(&model.params);
            let (_, _, d_actions) = rollout_loss(&model.net, &model.params, &window, Some(&mut unused));
            for d_actions in &d_actions {
                for (slope, d) in slopes[groups.clone()].iter_mut().zip(d_actions) {
                    slope.iter_mut().zip(d).for_each(|(s, d)| *s += f64::from(*d));
                }
            }
        }
        let rate = 0.5 * RATE * (1.0 + (std::f64::consts::PI * step as f64 / STEPS as f64).cos());
        let unbiased = DECAYS.map(|d| 1.0 - d.powi(step as i32 + 1));
        let free = free.iter_mut().flatten();
        for ((x, slope), [mean, square]) in free.zip(slopes.iter().flatten()).zip(&mut moments) {
            *mean += (1.0 - DECAYS[0]) * (slope - *mean);
            *square += (1.0 - DECAYS[1]) * (slope * slope - *square);
            *x -= rate * (*mean / unbiased[0]) / ((*square / unbiased[1]).sqrt() + EPSILON);
        }
    }
    let mut out = known.clone();
    out.rows.extend((0..frames).map(|f| model.unscaled(&free[f / hold], known.names.len())));
    Ok(out)
}
