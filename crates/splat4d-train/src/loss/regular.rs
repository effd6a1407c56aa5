//! Regularisers: plain functions of learnable values that return their value and add their gradient.
//!
//! They take the raw (not yet activated) columns and chain through the activation themselves, since raw columns are
//! what an optimiser moves. Sums run in row order, in f64, so that they are the same for any number of threads.

use splat4d::math::Real;
use splat4d::scene::{Planes, Rows, Table};

/// λ · mean_j(o_j · σ_j): makes Gaussians that live long pay for being opaque, which removes blockers early on.
///
/// Shapes: `logits` any table whose column `column` is the opacity logit (o = sigmoid); `life` the value σ ∈ `[0,1]` of
/// the life envelope of row `rows.id(j)` (unitless); the mean is over the listed rows. The gradient goes to o alone: σ
/// is a constant here. Adds to `d` (the shape of `logits`). Panics: `life` is not as long as `rows`.
/// Source: the 4D regularisation of FreeTimeGS 2025 (λ = 1e-2 there).
pub fn living_opacity<F: Real>(
    lambda: f64,
    logits: &Table<F>,
    column: usize,
    rows: Rows<'_>,
    life: &[F],
    d: &mut Table<F>,
) -> f64 {
    let n = rows.len(logits.rows());
    assert_eq!(life.len(), n, "every listed row needs one life value");
    opacity_mean(lambda, logits, column, rows, |j| life[j], d)
}

/// λ · mean(o): lets opacities that nothing holds up sink, so that MCMC can move those Gaussians.
///
/// Shapes: as [`living_opacity`], over every row. Source: Kheradmand 2024 (3DGS as MCMC) §3.4, λ = 0.01.
pub fn opacity<F: Real>(lambda: f64, logits: &Table<F>, column: usize, d: &mut Table<F>) -> f64 {
    opacity_mean(lambda, logits, column, Rows::All, |_| F::ONE, d)
}

fn opacity_mean<F: Real>(
    lambda: f64,
    logits: &Table<F>,
    column: usize,
    rows: Rows<'_>,
    factor: impl Fn(usize) -> F,
    d: &mut Table<F>,
) -> f64 {
    let n = rows.len(logits.rows());
    if n == 0 {
        return 0.0;
    }
    let share = F::of(lambda / n as f64);
    let mut sum = 0.0;
    for j in 0..n {
        let row = rows.id(j);
        let (o, s) = (logits.get(row, column).sigmoid(), factor(j));
        sum += (o * s).f64();
        *d.get_mut(row, column) += share * s * o * (F::ONE - o);
    }
    lambda * sum / n as f64
}

/// λ · mean(s) over the three scales of every row, s = exp(log scale): lets unused Gaussians shrink.
///
/// Shapes: `log_scales` any table whose columns `column..column+3` are log scales; s in scene units. Adds to `d`.
/// Source: Kheradmand 2024 (3DGS as MCMC) §3.4, λ = 0.01.
pub fn scale<F: Real>(lambda: f64, log_scales: &Table<F>, column: usize, d: &mut Table<F>) -> f64 {
    let n = 3 * log_scales.rows();
    if n == 0 {
        return 0.0;
    }
    let share = F::of(lambda / n as f64);
    let mut sum = 0.0;
    for row in 0..log_scales.rows() {
        let s = log_scales.read::<3>(row, column).map(F::exp);
        sum += s.iter().map(|x| x.f64()).sum::<f64>();
        d.add(row, column, s.map(|x| share * x));
    }
    lambda * sum / n as f64
}

/// λ · mean over rows and neighbours of ‖v_i − v_j‖²: neighbours move alike.
///
/// Shapes: `velocities` any table whose columns `column..column+3` are v (scene units a second); `neighbours` `[N,k]`
/// row-major row numbers, as [`crate::init::knn::knn`] makes them. Adds to `d` at both ends of a pair.
/// Panics: `neighbours` is not a whole number of rows or names a row that does not exist.
/// Source: the rigidity and momentum priors of Luiten 2024 §3.3, in their simplest, translation-only form.
pub fn velocity_smoothness<F: Real>(
    lambda: f64,
    velocities: &Table<F>,
    column: usize,
    neighbours: &[u32],
    d: &mut Table<F>,
) -> f64 {
    let rows = velocities.rows();
    if rows == 0 || neighbours.is_empty() {
        return 0.0;
    }
    assert!(neighbours.len().is_multiple_of(rows), "a neighbour list holds k entries for every row");
    let (k, n) = (neighbours.len() / rows, neighbours.len() as f64);
    let share = F::of(2.0 * lambda / n);
    let mut sum = 0.0;
    for (i, list) in neighbours.chunks_exact(k).enumerate() {
        let v = velocities.read::<3>(i, column);
        let mut own = [F::ZERO; 3];
        for &j in list {
            assert!((j as usize) < rows, "neighbour {j} of row {i} does not exist: there are {rows} rows");
            let u = velocities.read::<3>(j as usize, column);
            let diff: [F; 3] = std::array::from_fn(|a| v[a] - u[a]);
            sum += diff.iter().map(|x| (*x * *x).f64()).sum::<f64>();
            let g = diff.map(|x| share * x);
            (0..3).for_each(|a| own[a] += g[a]);
            d.add(j as usize, column, g.map(|x| -x));
        }
        d.add(i, column, own);
    }
    lambda * sum / n
}

/// λ · mean |A − M| over pixels: the render covers the mask and nothing else.
///
/// Shapes: `alpha` `[1,H,W]` the render's coverage 1 − T; `mask` `[1,H,W]` in `[0,1]`; adds to `d_alpha` `[1,H,W]`.
/// Panics: sizes differ. Source: the usual silhouette term.
pub fn alpha_mask<F: Real>(lambda: f64, alpha: &Planes<F>, mask: &Planes<F>, d_alpha: &mut Planes<F>) -> f64 {
    let size = |p: &Planes<F>| (p.channels, p.height, p.width);
    assert_eq!(size(alpha), size(mask), "alpha and mask must have one size");
    assert_eq!(size(alpha), size(d_alpha), "alpha and its gradient must have one size");
    let n = alpha.data.len();
    if n == 0 {
        return 0.0;
    }
    let share = F::of(lambda / n as f64);
    let mut sum = 0.0;
    for ((a, m), d) in alpha.data.iter().zip(&mask.data).zip(&mut d_alpha.data) {
        let diff = *a - *m;
        sum += diff.abs().f64();
        if diff > F::ZERO {
            *d += share;
        } else if diff < F::ZERO {
            *d -= share;
        }
    }
    lambda * sum / n as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    const ROWS: usize = 37;

    fn table() -> Table<f64> {
        let rng = Rng::new(4, "regular", 0);
        let mut t = Table::new(&[("a", 2), ("b", 3)], ROWS);
        for r in 0..ROWS {
            t.write::<5>(r, 0, std::array::from_fn(|c| rng.normal((r * 5 + c) as u64)));
        }
        t
    }

    /// Compares the gradient that `f` adds to a table with finite differences at every entry.
    fn check(f: impl Fn(&Table<f64>, &mut Table<f64>) -> f64) {
        let t = table();
        let mut d = t.zeros_like();
        d.fill(0.25);
        let value = f(&t, &mut d);
        assert!(value > 0.0, "the test must not be about nothing");
        for r in 0..ROWS {
            for c in 0..5 {
                let at = |h: f64| {
                    let mut u = t.clone();
                    *u.get_mut(r, c) += h;
                    f(&u, &mut t.zeros_like())
                };
                let (h, got) = (1e-5, d.get(r, c) - 0.25);
                let fd = (at(h) - at(-h)) / (2.0 * h);
                assert!((fd - got).abs() < 1e-8 * (1.0 + fd.abs()), "row {r} column {c}: {fd} {got}");
            }
        }
    }

    #[test]
    fn opacity_terms() {
        check(|t, d| opacity(0.3, t, 1, d));
        let ids: Vec<u32> = (0..ROWS as u32).step_by(3).collect();
        let life: Vec<f64> = (0..ids.len()).map(|i| 0.1 + 0.05 * i as f64).collect();
        check(|t, d| living_opacity(0.3, t, 1, Rows::Some(&ids), &life, d));
        let t = table();
        let plain = opacity(1.0, &t, 1, &mut t.zeros_like());
        let mean = (0..ROWS).map(|r| 1.0 / (1.0 + (-t.get(r, 1)).exp())).sum::<f64>() / ROWS as f64;
        assert!((plain - mean).abs() < 1e-12);
        let dead = living_opacity(1.0, &t, 1, Rows::All, &[0.0; ROWS], &mut t.zeros_like());
        assert_eq!(dead, 0.0, "what is not alive pays nothing");
    }

    #[test]
    fn scale_term() {
        check(|t, d| scale(0.01, t, 2, d));
        let unit = Table::<f64>::new(&[("log_scales", 3)], 5);
        assert!((scale(2.0, &unit, 0, &mut unit.zeros_like()) - 2.0).abs() < 1e-12, "e^0 = 1");
    }

    #[test]
    fn velocity_term() {
        let neighbours: Vec<u32> = (0..ROWS * 4).map(|i| ((i / 4 + 1 + i % 4 * 7) % ROWS) as u32).collect();
        check(|t, d| velocity_smoothness(0.7, t, 2, &neighbours, d));
        let mut alike = table();
        (0..ROWS).for_each(|r| alike.write(r, 2, [1.0, -2.0, 3.0]));
        let mut d = alike.zeros_like();
        assert_eq!(velocity_smoothness(0.7, &alike, 2, &neighbours, &mut d), 0.0);
        assert_eq!(d, alike.zeros_like());
    }

    #[test]
    fn alpha_term() {
        let (mut a, mut m) = (Planes::<f64>::new(1, 3, 4), Planes::<f64>::new(1, 3, 4));
        for i in 0..12 {
            (a.data[i], m.data[i]) = (0.07 * i as f64, 0.5);
        }
        let mut d = Planes::new(1, 3, 4);
        let value = alpha_mask(2.0, &a, &m, &mut d);
        let want = (0..12).map(|i| (0.07 * i as f64 - 0.5).abs()).sum::<f64>() / 6.0;
        assert!((value - want).abs() < 1e-12);
        for i in 0..12 {
            let at = |h: f64| {
                let mut p = a.clone();
                p.data[i] += h;
                alpha_mask(2.0, &p, &m, &mut Planes::new(1, 3, 4))
            };
            assert!(((at(1e-6) - at(-1e-6)) / 2e-6 - d.data[i]).abs() < 1e-8);
        }
    }

    #[test]
    fn nothing_costs_nothing() {
        let t = Table::<f32>::new(&[("a", 5)], 0);
        let mut d = t.zeros_like();
        assert_eq!(opacity(1.0, &t, 0, &mut d) + scale(1.0, &t, 0, &mut d), 0.0);
        assert_eq!(velocity_smoothness(1.0, &t, 0, &[], &mut d), 0.0);
    }
}
