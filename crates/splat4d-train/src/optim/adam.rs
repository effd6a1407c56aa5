//! The update of sixteen rows at a time.
//!
//! m ← β₁m + (1 − β₁)g, v ← β₂v + (1 − β₂)g², x ← x − r·(m c₁) / (√(v c₂) + ε), c = 1/(1 − βⁿ) after the row's n steps.
//! Source: Kingma and Ba 2015, algorithm 1.

use super::Floor;
use splat4d::math::Real;
use splat4d::scene::table::TableMut;
use splat4d::scene::{BLOCK, Key, Table};
use splat4d::simd::{Kernel, each};

/// Decays of the moments of Gaussians and exposures. Kingma and Ba use 0.9 and 0.999, for longer runs: a Gaussian that is visible in a third of
/// 3,000 steps would never forget the gradients of its first position (studies/records/2026-11-27-optimiser.md).
pub(crate) const GAUSSIANS: [f64; 2] = [0.8, 0.99];
/// Those of networks, nodes and cameras, which take a step nearly every time (Kingma and Ba 2015).
pub(crate) const OTHERS: [f64; 2] = [0.9, 0.999];
/// Added to the root of the second moment (Kerbl et al. 2023 use 1e-15: gradients of single Gaussians are tiny).
const EPSILON: f64 = 1e-15;

type Lane<F> = [F; BLOCK];

/// c₁ and c₂ by step count, up to the count from which both are exactly 1 (with 0.999 some 17,000 in f32: 130 kB).
pub(crate) fn corrections<F: Real>(betas: [f64; 2]) -> Vec<[F; 2]> {
    let correction = |beta: f64, n: i32| F::of(1.0 / (1.0 - beta.powi(n)));
    // A row that has taken no step is not active; its entry is never used.
    let mut out = vec![[F::ONE; 2]];
    loop {
        let n = out.len() as i32;
        out.push(betas.map(|beta| correction(beta, n)));
        if out[out.len() - 1] == [F::ONE; 2] {
            return out;
        }
    }
}

/// Rates and rules of one table's step.
pub(super) struct Rule<'a, F> {
    /// A rate a column; 0: frozen.
    pub rates: &'a [f64],
    /// Lower bounds; those of `key` count.
    pub floors: &'a [Floor],
    /// The table.
    pub key: Key,
    /// The rows that take part; `None`: all.
    pub active: Option<&'a [bool]>,
    /// See [`corrections`].
    pub corrections: &'a [[F; 2]],
    /// Decays of the moments.
    pub betas: [F; 2],
}

/// Some blocks of parameters [W], moments [2W + 1] and gradients [W]; returns the number of blocks with a number that
/// is not finite.
pub(super) struct Step<'a, F> {
    pub rule: &'a Rule<'a, F>,
    pub views: [TableMut<'a, F>; 3],
}

impl<F: Real> Kernel for Step<'_, F> {
    type Out = f64;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> f64 {
        let [p, m, d] = self.views;
        let (width, rule) = (p.width, self.rule);
        let mut faults = 0.0;
        let blocks = p.data.chunks_exact_mut(width * BLOCK).zip(m.data.chunks_exact_mut((2 * width + 1) * BLOCK));
        for (b, ((p_block, m_block), d_block)) in blocks.zip(d.data.chunks_exact_mut(width * BLOCK)).enumerate() {
            let rows = (p.rows - b * BLOCK).min(BLOCK);
            let mut live = [false; BLOCK];
            match rule.active {
                None => live[..rows].fill(true),
                Some(active) => live[..rows].copy_from_slice(&active[p.first + b * BLOCK..][..rows]),
            }
            let (all, any) = live.iter().fold((true, false), |(all, any), &one| (all & one, any | one));
            let finite = if all {
                step_block::<F, true>(rule, p_block, m_block, d_block, &live)
            } else if any {
                step_block::<F, false>(rule, p_block, m_block, d_block, &live)
            } else {
                continue;
            };
            if finite {
                d_block.fill(F::ZERO);
            } else {
                faults += 1.0;
            }
        }
        faults
    }
}

/// Sixteen rows, of which some are `live`: all of them if `FULL`.
#[inline(always)]
fn step_block<F: Real, const FULL: bool>(
    rule: &Rule<'_, F>,
    p: &mut [F],
    m: &mut [F],
    d: &[F],
    live: &[bool; BLOCK],
) -> bool {
    let width = rule.rates.len();
    let (first, rest) = m.split_at_mut(width * BLOCK);
    let (second, steps) = rest.split_at_mut(width * BLOCK);
    let mut correct1 = [F::ONE; BLOCK];
    let mut correct2 = [F::ONE; BLOCK];
    for l in 0..BLOCK {
        steps[l] += if FULL || live[l] { F::ONE } else { F::ZERO };
        let n = (steps[l].i32() as usize).min(rule.corrections.len() - 1);
        [correct1[l], correct2[l]] = rule.corrections[n];
    }
    let (first, second) = (first.as_chunks_mut::<BLOCK>().0, second.as_chunks_mut::<BLOCK>().0);
    let (p, d) = (p.as_chunks_mut::<BLOCK>().0, d.as_chunks::<BLOCK>().0);
    let mut checked = [F::ZERO; BLOCK];
    for c in 0..width {
        let rate = F::of(rule.rates[c]);
        if rate == F::ZERO {
            continue;
        }
        let [m1, m2, x] = step_lanes([first[c], second[c], p[c], d[c]], rate, rule.betas, &correct1, &correct2);
        if FULL {
            (first[c], second[c], p[c]) = (m1, m2, x);
        } else {
            (first[c], second[c]) = (choose(live, m1, first[c]), choose(live, m2, second[c]));
            p[c] = choose(live, x, p[c]);
        }
        for l in 0..BLOCK {
            // 0·x is 0 for finite x and NaN otherwise; padding lanes are finite zeros.
            checked[l] += F::ZERO * p[c][l];
        }
    }
    // After the check, because a maximum would hide a NaN.
    for floor in rule.floors.iter().filter(|f| f.key == rule.key) {
        let (x, least) = (&mut p[floor.column], F::of(floor.least));
        let lifted = each(|l| if x[l] < least { least } else { x[l] });
        *x = if FULL { lifted } else { choose(live, lifted, *x) };
    }
    checked.iter().all(|x| *x == F::ZERO)
}

/// First moment, second moment and parameter after the step. All are passed by value: through references, LLVM would
/// check at run time whether they overlap.
#[inline(always)]
fn step_lanes<F: Real>(
    [m1, m2, p, d]: [Lane<F>; 4],
    rate: F,
    [beta1, beta2]: [F; 2],
    c1: &Lane<F>,
    c2: &Lane<F>,
) -> [Lane<F>; 3] {
    let epsilon = F::of(EPSILON);
    let mut out = [[F::ZERO; BLOCK]; 3];
    for l in 0..BLOCK {
        let a = beta1 * m1[l] + (F::ONE - beta1) * d[l];
        let b = beta2 * m2[l] + (F::ONE - beta2) * d[l] * d[l];
        out[0][l] = a;
        out[1][l] = b;
        out[2][l] = p[l] - rate * (a * c1[l]) / ((b * c2[l]).sqrt() + epsilon);
    }
    out
}

/// The step of one row [N values, N first moments, N second moments, steps], computed in f64; a gradient that is not
/// finite leaves it as it was.
pub(crate) fn step_row<const N: usize>(table: &mut Table<f32>, row: usize, d: [f64; N], rates: [f64; N]) {
    if d.iter().any(|x| !x.is_finite()) {
        return;
    }
    let steps = table.get(row, 3 * N) + 1.0;
    table.set(row, 3 * N, steps);
    let [beta1, beta2] = OTHERS;
    let unbias = OTHERS.map(|beta| 1.0 / (1.0 - beta.powi(steps as i32)));
    for k in 0..N {
        let old = |col| f64::from(table.get(row, col));
        let first = beta1 * old(N + k) + (1.0 - beta1) * d[k];
        let second = beta2 * old(2 * N + k) + (1.0 - beta2) * d[k] * d[k];
        let value = old(k) - rates[k] * first * unbias[0] / ((second * unbias[1]).sqrt() + EPSILON);
        table.set(row, k, value as f32);
        table.set(row, N + k, first as f32);
        table.set(row, 2 * N + k, second as f32);
    }
}

#[inline(always)]
fn choose<F: Real>(live: &[bool; BLOCK], new: Lane<F>, old: Lane<F>) -> Lane<F> {
    each(|l| if live[l] { new[l] } else { old[l] })
}
