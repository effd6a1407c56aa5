//! Agreement of depth and normals: splats are flat on the surface of their rendered depth.

use super::{Channel, ImageTerm, LossGrads, Needs, SEEN, Shown, View, expected_depth_backward, over_rows};
use crate::loss::terms::StepInfo;
use splat4d::math::Real;
use splat4d::math::vec3::{cross, dot};
use splat4d::scene::{Camera, Planes};

/// [`depth_normal`], times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DepthNormal(pub f64);

impl<F: Real> ImageTerm<F> for DepthNormal {
    fn needs(&self, _: &View<'_, F>) -> Needs {
        Needs { depth: true, extra: vec![Channel::Normals] }
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        let (first, normals) = shown.channel(&Channel::Normals).expect("normals are rendered where they are needed");
        let mut d_normals = Planes::new(3, normals.height, normals.width);
        let pictures = [shown.depth, shown.alpha, &normals];
        let value = depth_normal(view.camera, pictures, self.0, [d.depth.add(), d.alpha.add(), &mut d_normals]);
        d.add_extra(first, &d_normals);
        value
    }
}

/// A cross product shorter than this share of the squared depth has no direction.
const DEGENERATE: f64 = 1e-12;

/// Mean over inner pixels that, with their four neighbours, show something of A − ⟨S, N⟩, A held constant: S = Σ α T n
/// blends the splats' normals (their shortest axes, towards the camera, camera axes), N is the unit normal of the
/// expected depth, from central differences of its points. No unit, in \[0, 2\].
///
/// Shapes: `depth` (Σ z α T) and `alpha` [1, h, w], `normals` [3, h, w]. Adds to all three gradients.
/// Source: Huang et al. 2024, "2D Gaussian Splatting", equation 14, with the shortest axis as a Gaussian's normal.
pub(crate) fn depth_normal<F: Real>(
    camera: &Camera,
    [depth, alpha, normals]: [&Planes<F>; 3],
    weight: f64,
    [d_depth, d_alpha, d_normals]: [&mut Planes<F>; 3],
) -> f64 {
    let (w, h, n) = (depth.width, depth.height, depth.pixels());
    assert!([alpha.data.len(), normals.pixels(), d_depth.data.len(), d_alpha.data.len()] == [n; 4], "{n} pixels");
    if w < 3 || h < 3 {
        return 0.0;
    }
    let floor = F::of(SEEN);
    let expected: Vec<F> = depth.data.iter().zip(&alpha.data).map(|(&d, &a)| d / a.max(floor)).collect();
    let k = &camera.intrinsics;
    let ray = |p: usize| {
        let (x, y) = ((p % w) as f64 + 0.5, (p / w) as f64 + 0.5);
        [F::of((x - k.cx) / k.fx), F::of((y - k.cy) / k.fy), F::ONE]
    };
    let point = |p: usize| ray(p).map(|r| r * expected[p]);
    let counts = |p: usize| {
        let (x, y) = (p % w, p / w);
        let inner = x > 0 && y > 0 && x + 1 < w && y + 1 < h;
        inner && [p, p - 1, p + 1, p - w, p + w].iter().all(|&q| alpha.data[q] >= floor)
    };
    let differences = |p: usize| {
        let side = |a: usize, b: usize| {
            let (a, b) = (point(a), point(b));
            [b[0] - a[0], b[1] - a[1], b[2] - a[2]]
        };
        (side(p - 1, p + 1), side(p - w, p + w))
    };
    let count = (0..n).filter(|&p| counts(p)).count();
    if count == 0 {
        return 0.0;
    }
    let scale = weight / count as f64;
    let factor = F::of(scale);
    // Gradients to the two differences of every pixel; its neighbours collect them below.
    let mut d_sides = vec![([F::ZERO; 3], [F::ZERO; 3], [F::ZERO; 3]); n];
    let value = scale
        * over_rows(&mut d_sides, w, |y, row| {
            let mut sum = 0.0;
            for (x, out) in row.iter_mut().enumerate() {
                let p = y * w + x;
                if !counts(p) {
                    continue;
                }
                let (across, down) = differences(p);
                // Down × across points against the viewing direction: x right, y down, z forward.
                let c = cross(down, across);
                let long = dot(c, c).sqrt();
                let s = [0, 1, 2].map(|k| normals.plane(k)[p]);
                sum += alpha.data[p].f64();
                if long <= F::of(DEGENERATE) * expected[p] * expected[p] {
                    continue;
                }
                let unit = c.map(|x| x / long);
                let along = dot(s, unit);
                sum -= along.f64();
                let d_c: [F; 3] = std::array::from_fn(|k| -factor * (s[k] - unit[k] * along) / long);
                *out = (cross(d_c, down), cross(across, d_c), unit);
            }
            sum
        });
    for (k, plane) in d_normals.data.chunks_exact_mut(n).enumerate() {
        plane.iter_mut().zip(&d_sides).for_each(|(d, (_, _, unit))| *d -= factor * unit[k]);
    }
    let mut d_expected = vec![F::ZERO; n];
    over_rows(&mut d_expected, w, |y, row| {
        for (x, d) in row.iter_mut().enumerate() {
            let p = y * w + x;
            let mut g = [F::ZERO; 3];
            let mut add = |by: [F; 3], times: F| (0..3).for_each(|k| g[k] += by[k] * times);
            if x > 0 {
                add(d_sides[p - 1].0, F::ONE);
            }
            if x + 1 < w {
                add(d_sides[p + 1].0, -F::ONE);
            }
            if y > 0 {
                add(d_sides[p - w].1, F::ONE);
            }
            if y + 1 < h {
                add(d_sides[p + w].1, -F::ONE);
            }
            *d = dot(g, ray(p));
        }
        0.0
    });
    expected_depth_backward(&expected, &alpha.data, floor, &d_expected, &mut d_depth.data, &mut d_alpha.data);
    value
}

#[cfg(test)]
mod tests {
    use super::super::check;
    use super::*;
    use splat4d::math::Se3;

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::IDENTITY, 0.8, 8, 6)
    }

    fn run(p: &[Planes<f64>], d: &mut [Planes<f64>]) -> f64 {
        let [depth, alpha, normals] = d else { panic!("three inputs") };
        depth_normal(&camera(), [&p[0], &p[1], &p[2]], 0.7, [depth, alpha, normals])
    }

    fn zeros() -> [Planes<f64>; 3] {
        [Planes::new(1, 6, 8), Planes::new(1, 6, 8), Planes::new(3, 6, 8)]
    }

    #[test]
    fn gradients_equal_finite_differences() {
        let mut alpha = check::planes("alpha", [1, 6, 8], 0.55, 1.0);
        alpha.data[20] = 0.2;
        let inputs =
            [check::planes("depth", [1, 6, 8], 2.0, 3.0), alpha, check::planes("normals", [3, 6, 8], -0.5, 0.5)];
        // A itself is held constant: the value to differentiate leaves the base's in its place.
        let counts = |p: usize| {
            let (x, y) = (p % 8, p / 8);
            x > 0 && y > 0 && x < 7 && y < 5 && [p, p - 1, p + 1, p - 8, p + 8].iter().all(|&q| q != 20)
        };
        let held = |p: &[Planes<f64>]| {
            let all: Vec<f64> = (0..48).filter(|&i| counts(i)).map(|i| p[1].data[i]).collect();
            0.7 * all.iter().sum::<f64>() / all.len() as f64
        };
        let base = held(&inputs);
        let value = check::gradients(&inputs, run, |p| run(p, &mut zeros()) - held(p) + base);
        assert!(value > 0.1);
    }

    #[test]
    fn splats_flat_on_a_plane_have_no_loss() {
        // The plane n·x = 3 with a tilted normal that faces the camera.
        let n = splat4d::math::se3::normalize([0.3, -0.2, -0.9]);
        let c = camera();
        let mut inputs = zeros();
        for p in 0..48 {
            let (x, y) = ((p % 8) as f64 + 0.5, (p / 8) as f64 + 0.5);
            let ray = [(x - c.intrinsics.cx) / c.intrinsics.fx, (y - c.intrinsics.cy) / c.intrinsics.fy, 1.0];
            let z = -3.0 / (0..3).map(|k| n[k] * ray[k]).sum::<f64>();
            inputs[1].data[p] = 0.8;
            inputs[0].data[p] = 0.8 * z;
            (0..3).for_each(|k| inputs[2].plane_mut(k)[p] = 0.8 * n[k]);
        }
        assert!(run(&inputs, &mut zeros()).abs() < 1e-12);
        // Turned the other way they cost the most there is.
        inputs[2].data.iter_mut().for_each(|x| *x = -*x);
        assert!((run(&inputs, &mut zeros()) - 0.7 * 1.6).abs() < 1e-12);
    }
}
