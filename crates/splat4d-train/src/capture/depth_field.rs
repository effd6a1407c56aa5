//! A smooth field over an image: relative errors of a depth map that no scale and shift removes.

/// Nodes in a row and in a column: as many as a few hundred points determine. Errors of networks change over a fifth of an
/// image or more.
const NODES: [usize; 2] = [6, 5];
/// All nodes.
pub(crate) const COUNT: usize = NODES[0] * NODES[1];
/// Largest error that is believed: half of the depth.
const LARGEST: f64 = 0.5;

/// Relative errors at nodes, between which they are bilinear.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Field([f64; COUNT]);

impl Field {
    /// No errors.
    pub(crate) const ZERO: Self = Self([0.0; COUNT]);

    pub(crate) const fn new(nodes: [f64; COUNT]) -> Self {
        Self(nodes)
    }

    /// The error at a place, each coordinate from 0 to 1 over the image.
    pub(crate) fn at(&self, place: [f64; 2]) -> f64 {
        weights(place).iter().map(|(node, w)| w * self.0[*node]).sum()
    }

    /// Whether all errors are finite and believed.
    pub(crate) fn is_small(&self) -> bool {
        self.0.iter().all(|e| e.abs() <= LARGEST)
    }
}

/// The nodes around a place and their weights.
pub(crate) fn weights(place: [f64; 2]) -> [(usize, f64); 4] {
    let [(i, x), (j, y)] = [0, 1].map(|axis| {
        let at = place[axis].clamp(0.0, 1.0) * (NODES[axis] - 1) as f64;
        let cell = (at as usize).min(NODES[axis] - 2);
        (cell, at - cell as f64)
    });
    let node = |di: usize, dj: usize| (j + dj) * NODES[0] + i + di;
    [(node(0, 0), (1.0 - x) * (1.0 - y)), (node(1, 0), x * (1.0 - y)), (node(0, 1), (1.0 - x) * y), (node(1, 1), x * y)]
}

/// The matrix of the sum of squared second differences, as of a bent plate: along rows, along columns, and twice the mixed
/// ones.
pub(crate) fn roughness() -> Vec<f64> {
    let mut out = vec![0.0; COUNT * COUNT];
    let mut add = |weight: f64, terms: &[(usize, f64)]| {
        for ((i, a), (j, b)) in terms.iter().flat_map(|a| terms.iter().map(move |b| (a, b))) {
            out[i * COUNT + j] += weight * a * b;
        }
    };
    for (i, j) in (0..NODES[1]).flat_map(|j| (0..NODES[0]).map(move |i| (i, j))) {
        let at = j * NODES[0] + i;
        for (inside, step) in [(0 < i && i + 1 < NODES[0], 1), (0 < j && j + 1 < NODES[1], NODES[0])] {
            if inside {
                add(1.0, &[(at - step, 1.0), (at, -2.0), (at + step, 1.0)]);
            }
        }
        if i + 1 < NODES[0] && j + 1 < NODES[1] {
            let (right, down) = (at + 1, at + NODES[0]);
            add(2.0, &[(at, 1.0), (right, -1.0), (down, -1.0), (down + 1, 1.0)]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_are_exact_and_not_rough() {
        let plane = |[u, v]: [f64; 2]| 0.1 + 0.2 * u - 0.3 * v;
        let place = |node: usize| {
            [(node % NODES[0]) as f64 / (NODES[0] - 1) as f64, (node / NODES[0]) as f64 / (NODES[1] - 1) as f64]
        };
        let field = Field::new(std::array::from_fn(|node| plane(place(node))));
        for at in [[0.0, 0.0], [0.33, 0.71], [1.0, 0.2], [1.0, 1.0]] {
            assert!((field.at(at) - plane(at)).abs() < 1e-12, "{at:?}");
        }
        let rough = roughness();
        let energy = |field: &Field| -> f64 {
            (0..COUNT * COUNT).map(|k| field.0[k / COUNT] * rough[k] * field.0[k % COUNT]).sum()
        };
        assert!(energy(&field).abs() < 1e-12);
        let bent = Field::new(std::array::from_fn(|node| place(node)[0].powi(2)));
        assert!(energy(&bent) > 1e-3);
        assert!(field.is_small() && !Field::new([f64::NAN; COUNT]).is_small());
    }
}
