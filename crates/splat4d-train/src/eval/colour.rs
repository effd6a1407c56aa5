//! Measures how much of an error is colour: fits an affine colour matrix for each camera, render to truth.
//!
//! A view is a handful of sums (the normal equations of the fit), whatever its size; the squared error after any such
//! matrix is a quadratic form of them. So no image is read twice, and each view needs about 200 bytes. What the matrix
//! makes of a render is not clamped again, which sums could not do: the true error is never above the given one, since
//! the truth is in `[0,1]`.

use splat4d::math::cholesky::Cholesky;
use splat4d::scene::Planes;

/// Colours of a pixel of the render, and 1.
const IN: usize = 4;
/// Colours of a pixel of the truth.
const OUT: usize = 3;
/// A pivot of the normal equations below this share of its diagonal is none: colours of a grey render, or of a single
/// colour, are in a plane but for rounding (f32: 6e-8, squared about 4e-15).
const SINGULAR: f64 = 1e-12;

/// A map of a render's colour r: row c is `[m0, m1, m2, offset]`, and channel c becomes m·r + offset.
pub(crate) type ColourMatrix = [[f64; IN]; OUT];

/// The matrix that changes nothing.
pub(super) const IDENTITY: ColourMatrix = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Sums over the pixels of views: x = (r, g, b, 1) of the render, e = truth − render.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ColourSums {
    /// Σ w x xᵀ
    xx: [[f64; IN]; IN],
    /// Σ w x eᵀ
    xe: [[f64; OUT]; IN],
    /// Σ w e²
    ee: f64,
    /// Pixels times channels, known or not.
    values: usize,
}

impl ColourSums {
    /// The sums of one view, both images clamped to `[0,1]`; pixels in row-major order, in f64. Where a pixel is known
    /// by a share v only, its weight is v²: so much of its error counts in a plain PSNR.
    ///
    /// Shapes: `[3,H,W]` both, `known` `[1,H,W]` or `None` where all of it is. Panics: shapes differ.
    pub(crate) fn of(render: &Planes<f32>, truth: &Planes<f32>, known: Option<&Planes<f32>>) -> Self {
        let size = |p: &Planes<f32>| (p.height, p.width);
        assert!(
            render.channels == OUT && truth.channels == OUT && size(render) == size(truth),
            "colours are fitted to three channels of one size"
        );
        assert!(known.is_none_or(|k| size(k) == size(truth)), "what is known must have the truth's size");
        let mut sums = Self { values: OUT * truth.pixels(), ..Self::default() };
        for p in 0..truth.pixels() {
            let weight = known.map_or(1.0, |k| f64::from(k.data[p]).powi(2));
            let at = |picture: &Planes<f32>, c: usize| f64::from(picture.plane(c)[p].clamp(0.0, 1.0));
            let mut x = [1.0; IN];
            for (c, x) in x.iter_mut().take(OUT).enumerate() {
                *x = at(render, c);
            }
            let e: [f64; OUT] = std::array::from_fn(|c| at(truth, c) - x[c]);
            for i in 0..IN {
                let w = weight * x[i];
                (0..=i).for_each(|j| sums.xx[i][j] += w * x[j]);
                (0..OUT).for_each(|c| sums.xe[i][c] += w * e[c]);
            }
            sums.ee += weight * e.iter().map(|e| e * e).sum::<f64>();
        }
        for i in 0..IN {
            (i + 1..IN).for_each(|j| sums.xx[i][j] = sums.xx[j][i]);
        }
        sums
    }

    /// Adds the pixels of another view.
    pub(crate) fn add(&mut self, other: &Self) {
        for i in 0..IN {
            (0..IN).for_each(|j| self.xx[i][j] += other.xx[i][j]);
            (0..OUT).for_each(|c| self.xe[i][c] += other.xe[i][c]);
        }
        self.ee += other.ee;
        self.values += other.values;
    }

    /// The matrix with the least squared error; `None` where the colours do not determine one (a grey image, a single
    /// colour, NaN).
    ///
    /// Source: FreeTimeGS++ 2026 measures renders with an affine colour correction a camera, to separate colour from
    /// shape.
    pub(crate) fn fit(&self) -> Option<ColourMatrix> {
        // xx Δ = xe; Δ is what differs from the identity.
        let factor = Cholesky::with_pivots(IN, self.xx.as_flattened().to_vec(), SINGULAR)?;
        let mut matrix = IDENTITY;
        for (c, row) in matrix.iter_mut().enumerate() {
            let d = factor.solve(self.xe.iter().map(|e| e[c]).collect());
            row.iter_mut().zip(d).for_each(|(m, d)| *m += d);
        }
        matrix.iter().flatten().all(|m| m.is_finite()).then_some(matrix)
    }

    /// PSNR of these views after `matrix`, dB; infinite without an error, `None` without pixels.
    pub(crate) fn psnr(&self, matrix: &ColourMatrix) -> Option<f64> {
        let mut error = self.ee;
        for (c, (row, own)) in matrix.iter().zip(&IDENTITY).enumerate() {
            let d: [f64; IN] = std::array::from_fn(|i| row[i] - own[i]);
            for i in 0..IN {
                let quadratic: f64 = (0..IN).map(|j| self.xx[i][j] * d[j]).sum();
                error += d[i] * (quadratic - 2.0 * self.xe[i][c]);
            }
        }
        // Rounding may leave less than nothing of an error that is none; NaN stays.
        let mean = if error < 0.0 { 0.0 } else { error / self.values as f64 };
        (self.values > 0).then(|| -10.0 * mean.log10())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::metrics::psnr;
    use splat4d::math::Rng;

    const SIDE: usize = 24;
    const CAST: ColourMatrix = [[0.8, 0.05, 0.0, 0.03], [0.02, 0.9, 0.04, 0.01], [0.1, 0.0, 0.7, 0.05]];

    fn noise(seed: u64) -> Planes<f32> {
        let rng = Rng::new(seed, "colours", 0);
        let mut out = Planes::new(3, SIDE, SIDE);
        out.data.iter_mut().enumerate().for_each(|(i, x)| *x = rng.uniform(i as u64) as f32);
        out
    }

    fn cast(from: &Planes<f32>, matrix: &ColourMatrix) -> Planes<f32> {
        let mut out = from.clone();
        for (c, row) in matrix.iter().enumerate() {
            for p in 0..from.pixels() {
                let x = |i: usize| f64::from(from.plane(i)[p]);
                out.plane_mut(c)[p] = (row[0] * x(0) + row[1] * x(1) + row[2] * x(2) + row[3]) as f32;
            }
        }
        out
    }

    #[test]
    fn a_colour_matrix_per_camera_is_fitted_and_the_remaining_error_reported() {
        let views = [noise(1), noise(2)];
        let error = |seed: u64| noise(seed).data.into_iter().map(|x| 0.02 * (x - 0.5));
        let truths: Vec<Planes<f32>> = views
            .iter()
            .zip([5, 6])
            .map(|(view, seed)| {
                let mut truth = cast(view, &CAST);
                truth.data.iter_mut().zip(error(seed)).for_each(|(t, e)| *t += e);
                truth
            })
            .collect();
        let sums: Vec<ColourSums> = views.iter().zip(&truths).map(|(v, t)| ColourSums::of(v, t, None)).collect();
        let mut all = sums[0].clone();
        all.add(&sums[1]);
        let found = all.fit().unwrap();
        for (found, cast) in found.iter().flatten().zip(CAST.iter().flatten()) {
            assert!((found - cast).abs() < 2e-3, "{found} for {cast}");
        }
        // The error of a view as it is defined: on the corrected image itself.
        for ((view, truth), sums) in views.iter().zip(&truths).zip(&sums) {
            let (computed, drawn) = (sums.psnr(&found).unwrap(), psnr(&cast(view, &found), truth).unwrap());
            assert!((computed - drawn).abs() < 1e-3, "{computed} computed, {drawn} drawn");
            let plain = psnr(view, truth).unwrap();
            assert!((sums.psnr(&IDENTITY).unwrap() - plain).abs() < 1e-6 && computed > plain + 10.0);
            // The best matrix for both views is not the best for one.
            assert!(sums.psnr(&sums.fit().unwrap()) >= Some(computed));
        }
    }

    #[test]
    fn colours_that_determine_no_matrix_get_none() {
        let mut grey = noise(3);
        let (first, rest) = grey.data.split_at_mut(SIDE * SIDE);
        rest.chunks_exact_mut(SIDE * SIDE).for_each(|plane| plane.copy_from_slice(first));
        let mut damaged = noise(3);
        damaged.data[7] = f32::NAN;
        let flat = Planes { data: vec![0.3; 3 * SIDE * SIDE], ..noise(3) };
        for render in [&grey, &flat, &damaged, &Planes { data: vec![0.0; 3 * SIDE * SIDE], ..noise(3) }] {
            assert_eq!(ColourSums::of(render, &noise(4), None).fit(), None);
        }
        let equal = ColourSums::of(&noise(3), &noise(3), None);
        assert_eq!((equal.fit(), equal.psnr(&IDENTITY)), (Some(IDENTITY), Some(f64::INFINITY)));
        assert_eq!(ColourSums::default().psnr(&IDENTITY), None);
        assert!(ColourSums::of(&damaged, &noise(4), None).psnr(&IDENTITY).unwrap().is_nan());
    }

    #[test]
    fn unknown_pixels_do_not_change_colour_matrices() {
        let view = noise(1);
        let (mut truth, mut known) =
            (cast(&view, &CAST), Planes { data: vec![1.0; SIDE * SIDE], ..Planes::new(1, SIDE, SIDE) });
        for p in 0..100 {
            known.data[p] = 0.0;
            (0..3).for_each(|c| truth.plane_mut(c)[p] = 1.0);
        }
        let sums = ColourSums::of(&view, &truth, Some(&known));
        for (found, cast) in sums.fit().unwrap().iter().flatten().zip(CAST.iter().flatten()) {
            assert!((found - cast).abs() < 1e-5, "{found} for {cast}");
        }
    }
}
