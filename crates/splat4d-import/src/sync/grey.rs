//! Grey images in ever smaller sizes.

use splat4d::math::image::box_means;
use splat4d_train::capture::Rgb8;

/// A grey image, values from 0 to 1, rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Grey {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// width·height values.
    pub data: Vec<f32>,
}

impl Grey {
    /// The luma of an image (BT.601's weights).
    pub(crate) fn of(picture: &Rgb8) -> Self {
        let luma = |p: &[u8]| (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])) / 255.0;
        Self { width: picture.width, height: picture.height, data: picture.data.chunks_exact(3).map(luma).collect() }
    }

    /// The means of boxes of k×k pixels; what is left over at the edges is dropped.
    pub(super) fn reduced(&self, k: usize) -> Self {
        let data = box_means(&self.data, self.width, self.height, k);
        Self { width: self.width / k, height: self.height / k, data }
    }

    /// Half the size, after a binomial blur, so that fine texture does not flicker.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let at = |x: isize, y: isize| {
            let x = x.clamp(0, self.width as isize - 1) as usize;
            let y = y.clamp(0, self.height as isize - 1) as usize;
            self.data[y * self.width + x]
        };
        // 1 3 3 1, whose centre is that of the two pixels that become one.
        const WEIGHTS: [f32; 4] = [0.125, 0.375, 0.375, 0.125];
        let mut rows = vec![0.0; width * self.height];
        for y in 0..self.height {
            for x in 0..width {
                let tap = |(k, w): (usize, &f32)| w * at(2 * x as isize + k as isize - 1, y as isize);
                rows[y * width + x] = WEIGHTS.iter().enumerate().map(tap).sum();
            }
        }
        let mut data = vec![0.0; width * height];
        for y in 0..height {
            for x in 0..width {
                let row = |k: usize| (2 * y as isize + k as isize - 1).clamp(0, self.height as isize - 1) as usize;
                let tap = |(k, w): (usize, &f32)| w * rows[row(k) * width + x];
                data[y * width + x] = WEIGHTS.iter().enumerate().map(tap).sum();
            }
        }
        Self { width, height, data }
    }

    /// The value at a pixel position (the first pixel's centre is at (0.5, 0.5)), bilinear, edges continued.
    pub(super) fn sample(&self, x: f64, y: f64) -> f32 {
        let x = (x - 0.5).clamp(0.0, (self.width - 1) as f64);
        let y = (y - 0.5).clamp(0.0, (self.height - 1) as f64);
        let (i, j) = ((x as usize).min(self.width.max(2) - 2), (y as usize).min(self.height.max(2) - 2));
        let (u, v) = ((x - i as f64) as f32, (y - j as f64) as f32);
        let (right, below) = (usize::from(self.width > 1), self.width * usize::from(self.height > 1));
        let p = j * self.width + i;
        let d = &self.data;
        let (top, bottom) =
            (d[p] + u * (d[p + right] - d[p]), d[p + below] + u * (d[p + below + right] - d[p + below]));
        top + v * (bottom - top)
    }
}

/// An image, half of it, a quarter of it and so on.
#[derive(Clone, Debug)]
pub struct Pyramid {
    pub(super) levels: Vec<Grey>,
}

impl Pyramid {
    /// At most `levels` sizes, none smaller than 16 pixels.
    pub(crate) fn new(picture: Grey, levels: usize) -> Self {
        /// Shorter side of the smallest level: the tracked window must fit.
        const SMALLEST: usize = 32;
        let mut all = vec![picture];
        while all.len() < levels {
            let last = &all[all.len() - 1];
            if last.width.min(last.height) < SMALLEST {
                break;
            }
            let next = last.halved();
            all.push(next);
        }
        Self { levels: all }
    }
}
