//! An image as planes: every channel is one contiguous [height, width] array.

use crate::math::{Real, image};

/// Channels first, rows from the top, linear in memory: `data[(c·height + y)·width + x]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planes<F = f32> {
    /// Number of channels.
    pub channels: usize,
    /// Rows.
    pub height: usize,
    /// Pixels in a row.
    pub width: usize,
    /// All values, `channels·height·width` of them.
    pub data: Vec<F>,
}

impl<F: Real> Planes<F> {
    /// All zero.
    pub fn new(channels: usize, height: usize, width: usize) -> Self {
        Self { channels, height, width, data: vec![F::ZERO; channels * height * width] }
    }

    /// Makes this an all-zero image of the given size, keeping the allocation.
    pub fn reset(&mut self, channels: usize, height: usize, width: usize) {
        (self.channels, self.height, self.width) = (channels, height, width);
        self.data.clear();
        self.data.resize(channels * height * width, F::ZERO);
    }

    /// Halves the image: the mean of 2×2 boxes; an odd last row or column is left out.
    pub fn halve(&mut self) {
        image::halve(&mut self.data, [self.channels, self.height, self.width]);
        (self.height, self.width) = (self.height / 2, self.width / 2);
    }

    /// Pixels in one plane.
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// One channel.
    pub fn plane(&self, c: usize) -> &[F] {
        let n = self.pixels();
        &self.data[c * n..(c + 1) * n]
    }

    /// One channel, to write.
    pub fn plane_mut(&mut self, c: usize) -> &mut [F] {
        let n = self.pixels();
        &mut self.data[c * n..(c + 1) * n]
    }

    /// The value of one channel of one pixel.
    pub fn get(&self, c: usize, y: usize, x: usize) -> F {
        self.data[(c * self.height + y) * self.width + x]
    }

    /// Interleaved copy [height, width, channels].
    pub fn interleaved(&self) -> Vec<F> {
        let n = self.pixels();
        let mut out = Vec::with_capacity(self.data.len());
        for p in 0..n {
            for c in 0..self.channels {
                out.push(self.data[c * n + p]);
            }
        }
        out
    }

    /// From interleaved [height, width, channels]. Panics: length is not channels·height·width.
    pub fn from_interleaved(channels: usize, height: usize, width: usize, data: &[F]) -> Self {
        assert_eq!(data.len(), channels * height * width, "interleaved data must hold channels·height·width values");
        let mut out = Self::new(channels, height, width);
        let n = out.pixels();
        for p in 0..n {
            for c in 0..channels {
                out.data[c * n + p] = data[p * channels + c];
            }
        }
        out
    }
}
