//! How much moves: coverage of the dynamic region and how badly a motionless image describes it.

/// A channel further than this from the camera's temporal mean (of 1) makes a pixel dynamic.
const DYNAMIC_THRESHOLD: f64 = 0.05;

/// One camera's figures, or the sum over several.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Motion {
    pixels: u64,
    dynamic: u64,
    squares: f64,
}

impl Motion {
    /// Measures a camera's frames (sRGB codes, three per pixel, all of one size).
    pub(crate) fn of_frames(frames: &[&[u8]]) -> Motion {
        let length = frames.first().map_or(0, |f| f.len());
        let mean: Vec<f64> = (0..length)
            .map(|i| frames.iter().map(|f| f64::from(f[i])).sum::<f64>() / (255.0 * frames.len() as f64))
            .collect();
        let mut motion = Motion::default();
        for frame in frames {
            for (pixel, mean) in frame.chunks_exact(3).zip(mean.chunks_exact(3)) {
                let off: [f64; 3] = std::array::from_fn(|c| f64::from(pixel[c]) / 255.0 - mean[c]);
                motion.pixels += 1;
                if off.iter().any(|d| d.abs() > DYNAMIC_THRESHOLD) {
                    motion.dynamic += 1;
                    motion.squares += off.iter().map(|d| d * d).sum::<f64>();
                }
            }
        }
        motion
    }

    /// The figures of both.
    pub(crate) fn plus(self, o: Motion) -> Motion {
        Motion { pixels: self.pixels + o.pixels, dynamic: self.dynamic + o.dynamic, squares: self.squares + o.squares }
    }

    /// Share of dynamic pixels, percent.
    pub(crate) fn coverage(&self) -> f64 {
        100.0 * self.dynamic as f64 / self.pixels as f64
    }

    /// PSNR of the temporal mean within the dynamic region, dB.
    pub(crate) fn mean_psnr(&self) -> f64 {
        -10.0 * (self.squares / (3 * self.dynamic) as f64).log10()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blinking_pixel_is_half_the_region_of_two() {
        let (a, b) = ([0u8, 0, 0, 90, 90, 90], [0u8, 0, 0, 192, 90, 90]);
        let motion = Motion::of_frames(&[&a, &b]);
        assert!((motion.coverage() - 50.0).abs() < 1e-12);
        // One channel of three is 0.2 away from the mean.
        assert!((motion.mean_psnr() + 10.0 * (0.04f64 / 3.0).log10()).abs() < 1e-9);
    }
}
