//! Frequencies: amplitude and phase of the image's spectrum, coarse ones first.

use super::fft::Spectrum;
use super::{ImageTerm, LossGrads, Shown, View};
use crate::loss::terms::StepInfo;
use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::scene::Planes;

/// [`Frequency`] of the colours, times a weight.
#[derive(Clone, Debug)]
pub(crate) struct FrequencyTerm<F = f32> {
    weight: f64,
    frequency: Frequency<F>,
}

impl<F: Real> FrequencyTerm<F> {
    /// With this weight.
    pub(crate) fn new(weight: f64) -> Self {
        Self { weight, frequency: Frequency::default() }
    }
}

impl<F: Real> ImageTerm<F> for FrequencyTerm<F> {
    fn eval(&mut self, info: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        self.frequency.loss_and_grad(shown.color, view.truth, info.progress, self.weight, d.color.add())
    }
}

/// The band begins at this share of the highest frequency and reaches all of it at [`FULL`]: fine detail is compared
/// once coarse shape is there.
const FIRST: f64 = 0.125;
/// Share of the stage after which the band holds every frequency.
const FULL: f64 = 0.75;
/// Amplitudes below this are rounding and have no phase.
const SILENT: f64 = 1e-8;

/// Amplitude and phase discrepancy of the spectra of image and truth, over the frequencies up to a radius that grows
/// with training: Σ over channels and band of ||X| − |X*|| + |X|·|∠X − ∠X*|, over their number, X the transform divided
/// by √pixels: in the image's unit. The |X| that weighs a phase is held constant, so that a phase error costs the
/// arc that
/// it spans and its slope stays bounded where there is no amplitude.
///
/// Source: Zhang et al. 2024, "FreGS", equations 5 to 9 (there phases count unweighted, and the band grows linearly
/// too). Images are padded with zeros to the next power of two.
#[derive(Clone, Debug, Default)]
pub(crate) struct Frequency<F> {
    spectrum: Spectrum<F>,
    grads: Spectrum<F>,
}

impl<F: Real> Frequency<F> {
    /// The loss after the share `progress` of the stage; adds `weight` times the gradient to `d`.
    pub(crate) fn loss_and_grad(
        &mut self,
        image: &Planes<F>,
        truth: &Planes<F>,
        progress: f64,
        weight: f64,
        d: &mut Planes<F>,
    ) -> f64 {
        assert!(image.data.len() == truth.data.len() && d.data.len() == image.data.len(), "images of one shape");
        let (w, h) = (image.width, image.height);
        if w == 0 || h == 0 {
            return 0.0;
        }
        let side = w.max(h).next_power_of_two().max(16);
        let radius = (FIRST + (1.0 - FIRST) * progress / FULL).min(1.0) * 0.5 * side as f64;
        let wave = |u: usize| if 2 * u > side { u as f64 - side as f64 } else { u as f64 };
        // Of the two frequencies ±(u, v) of a real image one states all.
        let in_band = |u: usize, v: usize| wave(u).hypot(wave(v)) <= radius * std::f64::consts::SQRT_2;
        let count: usize =
            (0..side).into_par_iter().map(|u| (0..side).filter(|&v| in_band(u, v)).count()).sum::<usize>();
        let scale = weight / (count * image.channels).max(1) as f64;
        let unit = 1.0 / ((w * h) as f64).sqrt();
        let mut value = 0.0;
        // The gradients of two channels are backpropagated by one transform: what belongs to a real image is symmetric.
        for pair in (0..image.channels).step_by(2) {
            self.grads.reset(side);
            for (part, c) in (pair..(pair + 2).min(image.channels)).enumerate() {
                // Image and truth share a transform as its real and imaginary part.
                self.spectrum.reset(side);
                for y in 0..h {
                    let (to, from) = (y * side, y * w);
                    self.spectrum.re[to..to + w].copy_from_slice(&image.plane(c)[from..from + w]);
                    self.spectrum.im[to..to + w].copy_from_slice(&truth.plane(c)[from..from + w]);
                }
                self.spectrum.forward();
                let (re, im) = (&self.spectrum.re, &self.spectrum.im);
                let rows = self.grads.re.par_chunks_mut(side).zip(self.grads.im.par_chunks_mut(side));
                let sums: Vec<f64> = rows
                    .enumerate()
                    .map(|(u, (g_re, g_im))| {
                        let mut sum = 0.0;
                        for v in (0..side).filter(|&v| in_band(u, v)) {
                            let (p, q) = (u * side + v, (side - u) % side * side + (side - v) % side);
                            let half = F::of(0.5 * unit);
                            let x = [(re[p] + re[q]) * half, (im[p] - im[q]) * half];
                            let t = [(im[p] + im[q]) * half, (re[q] - re[p]) * half];
                            let (cost, g) = discrepancy(x, t);
                            sum += cost.f64();
                            let mut g = g.map(|g| g * F::of(scale * unit));
                            if p == q {
                                // Its own mirror is real: an imaginary slope would end up in the other channel.
                                g[1] = F::ZERO;
                            }
                            // i·(a + ib) = −b + ia for the second channel.
                            if part == 0 {
                                g_re[v] += g[0];
                                g_im[v] -= g[1];
                            } else {
                                g_re[v] += g[1];
                                g_im[v] += g[0];
                            }
                        }
                        sum
                    })
                    .collect();
                value += scale * sums.iter().sum::<f64>();
            }
            // dL/dx_n = Σ_k Re(conj(G_k) e^(−iθ)) with G = dL/dRe + i dL/dIm: a forward transform of conj(G).
            self.grads.forward();
            for (part, c) in (pair..(pair + 2).min(image.channels)).enumerate() {
                let from = if part == 0 { &self.grads.re } else { &self.grads.im };
                for y in 0..h {
                    let row = &mut d.plane_mut(c)[y * w..(y + 1) * w];
                    row.iter_mut().zip(&from[y * side..]).for_each(|(d, g)| *d += *g);
                }
            }
        }
        value
    }
}

/// Amplitude and phase cost of a frequency, and its gradient to the two parts of X.
fn discrepancy<F: Real>(x: [F; 2], t: [F; 2]) -> (F, [F; 2]) {
    let [a, b] = [x, t].map(|z| (z[0] * z[0] + z[1] * z[1]).sqrt());
    let e = a - b;
    if a <= F::of(SILENT) {
        return (e.abs(), [F::ZERO; 2]);
    }
    let sign = if e > F::ZERO { F::ONE } else { -F::ONE };
    let unit = [x[0] / a, x[1] / a];
    let mut g = unit.map(|u| sign * u);
    let mut cost = e.abs();
    if b > F::of(SILENT) {
        // The angle from t to x, in (−π, π].
        let (sine, cosine) = (x[1] * t[0] - x[0] * t[1], x[0] * t[0] + x[1] * t[1]);
        let angle = F::of(sine.f64().atan2(cosine.f64()));
        cost += a * angle.abs();
        let sign = if angle > F::ZERO {
            F::ONE
        } else if angle < F::ZERO {
            -F::ONE
        } else {
            F::ZERO
        };
        // d angle/dX = (−Im, Re)/a², times the held a.
        g[0] -= sign * unit[1];
        g[1] += sign * unit[0];
    }
    (cost, g)
}

#[cfg(test)]
mod tests {
    use super::super::check;
    use super::*;

    fn run(p: &Planes<f64>, truth: &Planes<f64>, progress: f64, d: &mut Planes<f64>) -> f64 {
        Frequency::default().loss_and_grad(p, truth, progress, 0.7, d)
    }

    /// By the definition, in plain sums, with the amplitudes that weigh phases given.
    fn slow(p: &Planes<f64>, truth: &Planes<f64>, held: &[f64]) -> (f64, Vec<f64>) {
        let side = 16;
        let spectrum = |p: &Planes<f64>, c: usize, u: usize, v: usize| {
            let mut sum = [0.0; 2];
            for y in 0..p.height {
                for x in 0..p.width {
                    let angle = -std::f64::consts::TAU * (u * y + v * x) as f64 / side as f64;
                    let z = p.get(c, y, x) / (p.pixels() as f64).sqrt();
                    sum[0] += z * angle.cos();
                    sum[1] += z * angle.sin();
                }
            }
            sum
        };
        let (mut sum, mut amplitudes) = (0.0, Vec::new());
        for c in 0..p.channels {
            for k in 0..side * side {
                let (a, b) = (spectrum(p, c, k / side, k % side), spectrum(truth, c, k / side, k % side));
                let (la, lb) = (a[0].hypot(a[1]), b[0].hypot(b[1]));
                let angle =
                    (a[1].atan2(a[0]) - b[1].atan2(b[0])).sin().atan2((a[1].atan2(a[0]) - b[1].atan2(b[0])).cos());
                sum += (la - lb).abs() + held.get(amplitudes.len()).copied().unwrap_or(la) * angle.abs();
                amplitudes.push(la);
            }
        }
        (0.7 * sum / (p.channels * side * side) as f64, amplitudes)
    }

    #[test]
    fn value_and_gradient_are_those_of_the_definition() {
        let shape = [3, 5, 9];
        let (image, truth) = (check::planes("image", shape, 0.0, 1.0), check::planes("truth", shape, 0.0, 1.0));
        let (value, held) = slow(&image, &truth, &[]);
        let got = run(&image, &truth, 1.0, &mut Planes::new(3, 5, 9));
        assert!((got - value).abs() < 1e-12, "{got} {value}");
        // The weight of a phase is held where the base has it.
        check::gradients(&[image], |p, d| run(&p[0], &truth, 1.0, &mut d[0]), |p| slow(&p[0], &truth, &held).0);
    }

    #[test]
    fn equal_images_have_no_loss_and_the_band_grows() {
        let truth = check::planes("truth", [1, 16, 16], 0.0, 1.0);
        assert!(run(&truth, &truth, 1.0, &mut Planes::new(1, 16, 16)) < 1e-12);
        // A chequerboard is the highest frequency there is: only the whole band sees it.
        let mut fine = truth.clone();
        (0..256).for_each(|i| fine.data[i] += if (i / 16 + i % 16) % 2 == 0 { 0.1 } else { -0.1 });
        assert!(run(&fine, &truth, 0.0, &mut Planes::new(1, 16, 16)) < 1e-12);
        assert!(run(&fine, &truth, 1.0, &mut Planes::new(1, 16, 16)) > 1e-4);
        // A brighter image is seen at once.
        let mut bright = truth.clone();
        bright.data.iter_mut().for_each(|x| *x += 0.1);
        assert!(run(&bright, &truth, 0.0, &mut Planes::new(1, 16, 16)) > 1e-4);
    }
}
