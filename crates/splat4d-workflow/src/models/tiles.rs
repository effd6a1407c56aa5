//! Windows of large images: where they are, and how what a network returns for each is joined without seams.

/// Positions of windows of `side` pixels along `length`, evenly spread, which overlap by `overlap` pixels or more; one at 0 where a window
/// holds all of it.
pub(super) fn starts(length: usize, side: usize, overlap: usize) -> Vec<usize> {
    if length <= side {
        return vec![0];
    }
    let count = (length - overlap).div_ceil(side - overlap).max(2);
    (0..count).map(|i| (i * (length - side) + (count - 1) / 2) / (count - 1)).collect()
}

/// The joined values of windows: [channels, height, width].
pub(super) struct Joined {
    width: usize,
    pub(super) values: Vec<f32>,
    weights: Vec<f32>,
    channels: usize,
}

impl Joined {
    pub(super) fn new(channels: usize, height: usize, width: usize) -> Self {
        Self { width, values: vec![0.0; channels * height * width], weights: vec![0.0; height * width], channels }
    }

    /// Adds a window [channels, h, w] at a position. Its weight rises from its borders over `overlap` pixels. Equal values
    /// stay exactly equal, because a value moves towards the next one by its share of the weights.
    pub(super) fn add(&mut self, window: &[f32], [x0, y0]: [usize; 2], [w, h]: [usize; 2], overlap: usize) {
        let ramp = |at: usize, side: usize| {
            let inside = at.min(side - 1 - at) as f32 + 0.5;
            (inside / (overlap.max(1) as f32)).min(1.0)
        };
        let pixels = self.weights.len();
        let height = pixels / self.width;
        for y in 0..h.min(height.saturating_sub(y0)) {
            for x in 0..w.min(self.width - x0) {
                let at = (y0 + y) * self.width + x0 + x;
                let weight = ramp(x, w) * ramp(y, h);
                let share = weight / (self.weights[at] + weight);
                self.weights[at] += weight;
                for c in 0..self.channels {
                    let value = &mut self.values[c * pixels + at];
                    let new = window[(c * h + y) * w + x];
                    *value = if share == 1.0 { new } else { *value + (new - *value) * share };
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_cover_and_overlap() {
        for (length, side, overlap) in
            [(10, 32, 8), (33, 32, 8), (100, 32, 8), (1000, 128, 64), (56, 32, 8), (40, 32, 0)]
        {
            let found = starts(length, side, overlap);
            assert_eq!(found[0], 0);
            if length > side {
                assert_eq!(found.last().unwrap() + side, length, "{length} {side} {overlap}: {found:?}");
            }
            assert!(found.windows(2).all(|p| p[0] < p[1] && p[0] + side >= p[1] + overlap), "{found:?}");
        }
    }

    #[test]
    fn equal_values_join_exactly() {
        let value = |x: usize, y: usize| ((x * 7 + y * 13) % 101) as f32 * 0.37;
        let (width, height, side, overlap) = (50, 41, 16, 6);
        let mut joined = Joined::new(1, height, width);
        for y in starts(height, side, overlap) {
            for x in starts(width, side, overlap) {
                let window: Vec<f32> = (0..side * side).map(|p| value(x + p % side, y + p / side)).collect();
                joined.add(&window, [x, y], [side, side], overlap);
            }
        }
        let whole: Vec<f32> = (0..width * height).map(|p| value(p % width, p / width)).collect();
        assert_eq!(joined.values, whole);
    }

    #[test]
    fn seams_are_ramps() {
        let mut joined = Joined::new(1, 4, 24);
        joined.add(&[0.0; 64], [0, 0], [16, 4], 8);
        joined.add(&[1.0; 64], [8, 0], [16, 4], 8);
        let row = &joined.values[24..48];
        assert!(row[..8].iter().all(|v| *v == 0.0) && row[16..].iter().all(|v| *v == 1.0), "{row:?}");
        assert!(row[8..16].windows(2).all(|p| p[0] < p[1] && p[1] - p[0] < 0.2), "{row:?}");
    }
}
