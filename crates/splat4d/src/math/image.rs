//! Smaller images.

use super::Real;

/// Halves planes of `height`·`width` values in place: the mean of 2×2 boxes; an odd last row or column is left out.
pub fn halve<F: Real>(data: &mut Vec<F>, [channels, height, width]: [usize; 3]) {
    let quarter = F::HALF * F::HALF;
    let (rows, columns) = (height / 2, width / 2);
    for c in 0..channels {
        for y in 0..rows {
            let (from, to) = ((c * height + 2 * y) * width, (c * rows + y) * columns);
            for x in 0..columns {
                // A pixel of the half image is written before those that later ones read.
                let [a, b] = [from + 2 * x, from + width + 2 * x];
                data[to + x] = quarter * (data[a] + data[a + 1] + data[b] + data[b + 1]);
            }
        }
    }
    data.truncate(channels * rows * columns);
}

/// Means of k×k boxes of a plane; rows and columns that fill no box are left out.
pub fn box_means(plane: &[f32], width: usize, height: usize, k: usize) -> Vec<f32> {
    if k == 1 {
        return plane.to_vec();
    }
    let scale = 1.0 / (k * k) as f32;
    let mut out = Vec::with_capacity((width / k) * (height / k));
    for y in 0..height / k {
        for x in 0..width / k {
            let rows = (0..k).map(|j| (y * k + j) * width + x * k);
            out.push(scale * rows.map(|start| plane[start..start + k].iter().sum::<f32>()).sum::<f32>());
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_are_averaged_and_partial_boxes_dropped() {
        let plane: Vec<f32> = (0..15).map(|i| i as f32).collect();
        let mut half = plane.iter().chain(&plane).copied().collect();
        halve(&mut half, [2, 3, 5]);
        assert_eq!(half, [3.0, 5.0, 3.0, 5.0]);
        assert_eq!(box_means(&plane, 5, 3, 2), [3.0, 5.0]);
        assert_eq!(box_means(&plane, 5, 3, 3), [6.0]);
        assert_eq!(box_means(&plane, 5, 3, 1), plane);
    }
}
