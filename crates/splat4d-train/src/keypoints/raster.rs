//! Grey images: halving, blurring, reading between pixels.

use splat4d::scene::Planes;

/// The mean of the three channels.
pub fn grey(color: &Planes<f32>) -> Planes<f32> {
    let mut out = Planes::new(1, color.height, color.width);
    let [r, g, b] = [0, 1, 2].map(|c| color.plane(c));
    out.data.iter_mut().enumerate().for_each(|(i, v)| *v = (r[i] + g[i] + b[i]) / 3.0);
    out
}

/// Twice the size, linearly between pixels.
pub(crate) fn doubled(from: &Planes<f32>) -> Planes<f32> {
    let mut out = Planes::new(1, 2 * from.height, 2 * from.width);
    for y in 0..out.height {
        for x in 0..out.width {
            // In steps of a quarter pixel from the nearest one.
            let [u, v] = [x, y].map(|k| 0.5 * (k as f32 + 0.5));
            out.data[y * 2 * from.width + x] = sample(from, u, v);
        }
    }
    out
}

/// Every second pixel of every second row.
pub(crate) fn every_second(from: &Planes<f32>) -> Planes<f32> {
    let mut out = Planes::new(1, from.height / 2, from.width / 2);
    for y in 0..out.height {
        for x in 0..out.width {
            out.data[y * out.width + x] = from.data[2 * y * from.width + 2 * x];
        }
    }
    out
}

/// The value at pixel position (u, v), linearly between pixel centres; the border continues outside.
pub fn sample(from: &Planes<f32>, u: f32, v: f32) -> f32 {
    let x = (u - 0.5).clamp(0.0, from.width as f32 - 1.0);
    let y = (v - 0.5).clamp(0.0, from.height as f32 - 1.0);
    let (left, top) = (x as usize, y as usize);
    let (right, below) = ((left + 1).min(from.width - 1), (top + 1).min(from.height - 1));
    let (fx, fy) = (x - left as f32, y - top as f32);
    let at = |x: usize, y: usize| from.data[y * from.width + x];
    let upper = at(left, top) + fx * (at(right, top) - at(left, top));
    let lower = at(left, below) + fx * (at(right, below) - at(left, below));
    upper + fy * (lower - upper)
}

/// Blurred by a Gaussian, rows then columns; the border continues outside.
pub fn blurred(from: &Planes<f32>, sigma: f64) -> Planes<f32> {
    /// Of σ: what is beyond weighs a thousandth.
    const REACH: f64 = 3.5;
    let reach = (REACH * sigma).ceil() as usize;
    let bell = |k: usize| (-0.5 * ((k as f64 - reach as f64) / sigma).powi(2)).exp();
    let sum: f64 = (0..=2 * reach).map(bell).sum();
    let kernel: Vec<f32> = (0..=2 * reach).map(|k| (bell(k) / sum) as f32).collect();
    let (w, h) = (from.width, from.height);
    let mut rows = Planes::<f32>::new(1, h, w);
    let mut padded = vec![0.0; w + 2 * reach];
    for y in 0..h {
        let row = &from.data[y * w..(y + 1) * w];
        padded[..reach].fill(row[0]);
        padded[reach..reach + w].copy_from_slice(row);
        padded[reach + w..].fill(row[w - 1]);
        let out = &mut rows.data[y * w..(y + 1) * w];
        for (k, weight) in kernel.iter().enumerate() {
            out.iter_mut().zip(&padded[k..]).for_each(|(o, v)| *o += weight * v);
        }
    }
    let mut out = Planes::<f32>::new(1, h, w);
    for y in 0..h {
        let to = &mut out.data[y * w..(y + 1) * w];
        for (k, weight) in kernel.iter().enumerate() {
            let row = (y + k).saturating_sub(reach).min(h - 1);
            to.iter_mut().zip(&rows.data[row * w..]).for_each(|(o, v)| *o += weight * v);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_stays_a_ramp_when_sampled_doubled_and_blurred() {
        let mut ramp = Planes::<f32>::new(1, 24, 32);
        for i in 0..ramp.data.len() {
            ramp.data[i] = (i % 32) as f32 + 0.5 + 2.0 * ((i / 32) as f32 + 0.5);
        }
        for (u, v) in [(12.0f32, 9.0f32), (12.3, 9.9)] {
            let truth = u + 2.0 * v;
            assert!((sample(&ramp, u, v) - truth).abs() < 1e-4);
            assert!((sample(&doubled(&ramp), 2.0 * u, 2.0 * v) - truth).abs() < 1e-4);
            assert!((sample(&blurred(&ramp, 1.6), u, v) - truth).abs() < 1e-3);
        }
        assert_eq!(every_second(&ramp).get(0, 3, 5), ramp.get(0, 6, 10));
    }
}
