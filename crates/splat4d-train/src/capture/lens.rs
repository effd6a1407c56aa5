//! Lens distortion, forwards and backwards, on normalised image coordinates (x/z, y/z).
//!
//! Radial polynomials fold back beyond some radius; rays beyond it never reach the sensor, so both directions return
//! `None` there instead of inventing a pixel.

use splat4d::scene::Lens;

/// Widest pinhole ray examined, x/z: 84° off the axis.
const MAX_RADIUS: f64 = 10.0;
/// Widest fisheye ray, radians.
const MAX_ANGLE: f64 = std::f64::consts::PI;
/// Samples when searching for the first fold; real lenses fold once, far out.
const FOLD_SAMPLES: usize = 4096;
/// Newton steps; ten suffice for real lenses, bisection-guarded ones need a few more at the fold.
const MAX_STEPS: usize = 60;
/// Accepted residual, in normalised coordinates: 10⁻⁷ px at a focal length of 1000.
const TOLERANCE: f64 = 1e-10;

/// A lens with the radius at which its radial map stops growing.
///
/// Sources: OpenCV's camera model (Brown 1966; rational and thin-prism terms); Kannala and Brandt 2006; COLMAP's
/// `sensor/models.h` for the others, with which the tests' numbers were made (pycolmap 4.2.1).
#[derive(Clone, Copy, Debug)]
pub struct Distortion {
    lens: Lens,
    /// Largest x/z-radius or angle in radians (fisheyes) that is still imaged.
    limit: f64,
    /// A lens before it, k1 and k2 of r² and r⁴, and the radius up to which it does not fold; `None`: there is none.
    before: Option<([f64; 2], f64)>,
}

impl Distortion {
    /// Prepares a lens: finds where it folds.
    pub fn new(lens: Lens) -> Self {
        let limit = match lens {
            Lens::Brown { k, .. } => first_fold(MAX_RADIUS, |r| brown_slope(&k, r)),
            Lens::Fisheye { k } | Lens::ThinPrismFisheye { k, .. } => {
                first_fold(MAX_ANGLE, |theta| fisheye_slope(&k, theta))
            }
            Lens::RadTanThinPrismFisheye { k, .. } => first_fold(MAX_ANGLE, |theta| even(&k, theta).1),
            Lens::Fov { .. } | Lens::Division { .. } | Lens::Eucm { .. } => {
                first_fold(MAX_RADIUS, |r| radial(&lens, r).1)
            }
            _ => f64::INFINITY,
        };
        Self { lens, limit, before: None }
    }

    /// A lens that images rays which another one of two coefficients has bent: (x, y) (1 + k1 r² + k2 r⁴).
    pub(crate) fn after(lens: Lens, [k1, k2]: [f64; 2]) -> Self {
        let slope = |r: f64| 1.0 + r * r * (3.0 * k1 + 5.0 * k2 * r * r);
        let before = ([k1, k2] != [0.0; 2]).then(|| ([k1, k2], first_fold(MAX_RADIUS, slope)));
        Self { before, ..Self::new(lens) }
    }

    /// Whether this lens bends nothing.
    pub(crate) fn is_pinhole(&self) -> bool {
        matches!(self.lens, Lens::Pinhole) && self.before.is_none()
    }

    /// Projection of the ray (x, y, 1) to the normalised sensor; `None` beyond the fold.
    pub fn distort(&self, ray: [f64; 2]) -> Option<[f64; 2]> {
        let Some(([k1, k2], limit)) = self.before else { return self.stated(ray) };
        let r2 = ray[0] * ray[0] + ray[1] * ray[1];
        let bent = ray.map(|v| v * (1.0 + r2 * (k1 + r2 * k2)));
        (r2 <= limit * limit).then(|| self.stated(bent)).flatten()
    }

    /// The same of the lens itself.
    fn stated(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let r = x.hypot(y);
        match self.lens {
            Lens::Brown { k, p, s } => {
                if r > self.limit {
                    return None;
                }
                let (out, jacobian) = brown(&k, &p, &s, [x, y]);
                (det(&jacobian) > 0.0).then_some(out)
            }
            Lens::Fisheye { k } => {
                let theta = r.atan();
                let scale = if r > 1e-12 { fisheye_radius(&k, theta) / r } else { 1.0 };
                (theta <= self.limit).then_some([x * scale, y * scale])
            }
            Lens::ThinPrismFisheye { k, p, s } => {
                let theta = r.atan();
                let flat = along([x, y], theta);
                let (out, jacobian) = bend(fisheye_ratio(&k), &p, &[s[0], 0.0, s[1], 0.0], flat);
                (theta <= self.limit && det(&jacobian) > 0.0).then_some(out)
            }
            Lens::RadTanThinPrismFisheye { k, p, s } => {
                let theta = r.atan();
                let flat = along([x, y], even(&k, theta).0);
                let (out, jacobian) = bend(|_| (1.0, 0.0), &swapped(p), &s, flat);
                (theta <= self.limit && det(&jacobian) > 0.0).then_some(out)
            }
            Lens::Fov { .. } | Lens::Division { .. } | Lens::Eucm { .. } => {
                (r <= self.limit).then(|| along([x, y], radial(&self.lens, r).0))
            }
            _ => Some([x, y]),
        }
    }

    /// The ray (x, y, 1) that lands on a point of the normalised sensor; `None` where no ray before the fold does (for
    /// fisheyes also where the ray is 90° or more off the axis).
    pub fn undistort(&self, target: [f64; 2]) -> Option<[f64; 2]> {
        let ray = self.straightened(target)?;
        let Some(([k1, k2], limit)) = self.before else { return Some(ray) };
        let radius = |r: f64| {
            let r2 = r * r;
            (r * (1.0 + r2 * (k1 + r2 * k2)), 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2))
        };
        Some(along(ray, invert(limit, length(ray), radius)?))
    }

    /// The same of the lens itself.
    fn straightened(&self, target: [f64; 2]) -> Option<[f64; 2]> {
        match self.lens {
            Lens::Brown { k, p, s } => {
                // The radial part alone is solved safely first; the tangential rest is small, so that Newton converges.
                let start = invert(self.limit, length(target), |r| (r * brown_factor(&k, r * r), brown_slope(&k, r)));
                solve(target, start.unwrap_or(self.limit), self.limit, |ray| brown(&k, &p, &s, ray))
            }
            Lens::ThinPrismFisheye { k, p, s } => {
                let radius = |t: f64| (fisheye_radius(&k, t), fisheye_slope(&k, t));
                let start = invert(self.limit, length(target), radius).unwrap_or(self.limit);
                let s = [s[0], 0.0, s[1], 0.0];
                let flat = solve(target, start, self.limit, |at| bend(fisheye_ratio(&k), &p, &s, at))?;
                ahead(flat, length(flat))
            }
            Lens::RadTanThinPrismFisheye { k, p, s } => {
                let most = even(&k, self.limit).0;
                let flat =
                    solve(target, length(target).min(most), most, |at| bend(|_| (1.0, 0.0), &swapped(p), &s, at))?;
                ahead(flat, invert(self.limit, length(flat), |t| even(&k, t))?)
            }
            Lens::Fov { .. } | Lens::Division { .. } | Lens::Eucm { .. } => {
                let radius = invert(self.limit, length(target), |r| radial(&self.lens, r))?;
                Some(along(target, radius))
            }
            Lens::Fisheye { k } => {
                let radius = target[0].hypot(target[1]);
                let theta = invert(self.limit, radius, |t| (fisheye_radius(&k, t), fisheye_slope(&k, t)))?;
                ahead(target, theta)
            }
            _ => Some(target),
        }
    }
}

fn length([x, y]: [f64; 2]) -> f64 {
    x.hypot(y)
}

/// The point in the direction of `at` whose distance from the axis is `radius`.
fn along(at: [f64; 2], radius: f64) -> [f64; 2] {
    let own = length(at);
    let scale = if own > 1e-12 { radius / own } else { 1.0 };
    at.map(|v| v * scale)
}

/// The ray (x, y, 1) at the angle `theta` in the direction of `at`; none from 90 degrees on.
fn ahead(at: [f64; 2], theta: f64) -> Option<[f64; 2]> {
    (theta < std::f64::consts::FRAC_PI_2).then(|| along(at, theta.tan()))
}

/// RAD_TAN_THIN_PRISM_FISHEYE numbers its tangential terms in the opposite order to Brown.
fn swapped([p0, p1]: [f64; 2]) -> [f64; 2] {
    [p1, p0]
}

/// Newton's method for the point within `limit` of the axis that `map` takes to `target`, from the radius `start`.
fn solve(
    target: [f64; 2],
    start: f64,
    limit: f64,
    map: impl Fn([f64; 2]) -> ([f64; 2], [[f64; 2]; 2]),
) -> Option<[f64; 2]> {
    let radius = length(target);
    let scale = if radius > 1e-12 { start / radius } else { 1.0 };
    let mut ray = [target[0] * scale, target[1] * scale];
    for _ in 0..MAX_STEPS {
        let (image, j) = map(ray);
        let miss = [image[0] - target[0], image[1] - target[1]];
        let d = det(&j);
        if miss[0].hypot(miss[1]) < TOLERANCE {
            return (ray[0].hypot(ray[1]) <= limit && d > 0.0).then_some(ray);
        }
        if d.abs() <= 1e-12 || d.is_nan() {
            return None;
        }
        ray[0] -= (j[1][1] * miss[0] - j[0][1] * miss[1]) / d;
        ray[1] -= (j[0][0] * miss[1] - j[1][0] * miss[0]) / d;
        let r = ray[0].hypot(ray[1]);
        if r > limit {
            ray = ray.map(|v| v * limit / r);
        }
    }
    None
}

/// The first place in (0, end] where the slope is no longer positive; `end` if there is none.
fn first_fold(end: f64, slope: impl Fn(f64) -> f64) -> f64 {
    let at = |i: usize| end * i as f64 / FOLD_SAMPLES as f64;
    // NaN counts as a fold.
    let folded = |x: f64| {
        let slope = slope(x);
        slope <= 0.0 || slope.is_nan()
    };
    let Some(i) = (1..=FOLD_SAMPLES).find(|&i| folded(at(i))) else { return end };
    let (mut low, mut high) = (at(i - 1), at(i));
    for _ in 0..MAX_STEPS {
        let middle = 0.5 * (low + high);
        *(if folded(middle) { &mut high } else { &mut low }) = middle;
    }
    low
}

/// Solves f(x) = y for x in [0, end] by Newton guarded with bisection; f(0) = 0 and f grows up to `end`.
fn invert(end: f64, y: f64, f: impl Fn(f64) -> (f64, f64)) -> Option<f64> {
    let most = f(end).0;
    if y > most || most.is_nan() || y.is_nan() {
        return None;
    }
    let (mut low, mut high) = (0.0, end);
    let mut x = y.min(end);
    for _ in 0..MAX_STEPS {
        let (value, slope) = f(x);
        if (value - y).abs() < 1e-15 * (1.0 + y) {
            break;
        }
        *(if value < y { &mut low } else { &mut high }) = x;
        let newton = x - (value - y) / slope;
        x = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
    }
    Some(x)
}

/// ρ = (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶)
fn brown_factor(k: &[f64; 6], r2: f64) -> f64 {
    (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))
}

/// dρ/d(r²)
fn brown_factor_slope(k: &[f64; 6], r2: f64) -> f64 {
    let n = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
    let d = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
    let dn = k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[2]);
    let dd = k[3] + r2 * (2.0 * k[4] + r2 * 3.0 * k[5]);
    (dn - n * dd / d) / d
}

/// d(rρ)/dr; not positive as well where the denominator has passed zero.
fn brown_slope(k: &[f64; 6], r: f64) -> f64 {
    let r2 = r * r;
    let d = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
    if d <= 0.0 { -1.0 } else { brown_factor(k, r2) + 2.0 * r2 * brown_factor_slope(k, r2) }
}

/// The distorted point and ∂(x_d, y_d)/∂(x, y).
fn brown(k: &[f64; 6], p: &[f64; 2], s: &[f64; 4], at: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
    bend(|r2| (brown_factor(k, r2), brown_factor_slope(k, r2)), p, s, at)
}

/// Radial, tangential and thin-prism terms; `radial`: the factor ρ and dρ/d(r²) at r². The point and its Jacobian.
fn bend(radial: impl Fn(f64) -> (f64, f64), p: &[f64; 2], s: &[f64; 4], [x, y]: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
    let r2 = x * x + y * y;
    let (rho, slope) = radial(r2);
    let out = [
        rho * x + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x) + s[0] * r2 + s[1] * r2 * r2,
        rho * y + p[0] * (r2 + 2.0 * y * y) + 2.0 * p[1] * x * y + s[2] * r2 + s[3] * r2 * r2,
    ];
    let prism = [s[0] + 2.0 * s[1] * r2, s[2] + 2.0 * s[3] * r2];
    let cross = 2.0 * slope * x * y;
    let jacobian = [
        [
            rho + 2.0 * slope * x * x + 2.0 * p[0] * y + 6.0 * p[1] * x + 2.0 * x * prism[0],
            cross + 2.0 * p[0] * x + 2.0 * p[1] * y + 2.0 * y * prism[0],
        ],
        [
            cross + 2.0 * p[0] * x + 2.0 * p[1] * y + 2.0 * x * prism[1],
            rho + 2.0 * slope * y * y + 6.0 * p[0] * y + 2.0 * p[1] * x + 2.0 * y * prism[1],
        ],
    ];
    (out, jacobian)
}

fn det(j: &[[f64; 2]; 2]) -> f64 {
    j[0][0] * j[1][1] - j[0][1] * j[1][0]
}

/// r(θ) = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)
fn fisheye_radius(k: &[f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
}

/// dr/dθ
fn fisheye_slope(k: &[f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
}

/// 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ and its derivative by r².
fn fisheye_ratio(k: &[f64; 4]) -> impl Fn(f64) -> (f64, f64) {
    move |r2| {
        let ratio = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * k[3])));
        (ratio, k[0] + r2 * (2.0 * k[1] + r2 * (3.0 * k[2] + r2 * 4.0 * k[3])))
    }
}

/// r(θ) = θ (1 + Σ kᵢ θ^(2i+2)) and dr/dθ.
fn even(k: &[f64; 6], theta: f64) -> (f64, f64) {
    let t2 = theta * theta;
    let (mut ratio, mut slope, mut power) = (1.0, 1.0, 1.0);
    for (i, k) in k.iter().enumerate() {
        power *= t2;
        ratio += k * power;
        slope += (2 * i + 3) as f64 * k * power;
    }
    (theta * ratio, slope)
}

/// The radius on the sensor of a ray at the radius r, and its derivative, for lenses that are nothing but that.
fn radial(lens: &Lens, r: f64) -> (f64, f64) {
    match *lens {
        Lens::Fov { omega } => {
            let wide = 2.0 * (0.5 * omega).tan();
            ((r * wide).atan() / omega, wide / (1.0 + r * r * wide * wide) / omega)
        }
        Lens::Division { k } => {
            // The smaller root of k r r_d² − r_d + r = 0; NaN beyond the last ray.
            let out = 2.0 * r / (1.0 + (1.0 - 4.0 * k * r * r).sqrt());
            (out, (1.0 + k * out * out) / (1.0 - 2.0 * k * r * out))
        }
        Lens::Eucm { alpha, beta } => {
            let d = (beta * r * r + 1.0).sqrt();
            let below = alpha * d + 1.0 - alpha;
            (r / below, (below - alpha * beta * r * r / d) / (below * below))
        }
        _ => (r, 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lens_before_a_pinhole_is_browns_and_is_inverted_before_another() {
        let brown = |k1, k2| Lens::Brown { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 4] };
        let (plain, both) =
            (Distortion::after(Lens::Pinhole, [-0.1, 0.03]), Distortion::after(brown(0.2, -0.05), [-0.1, 0.03]));
        assert!(!plain.is_pinhole() && Distortion::after(Lens::Pinhole, [0.0; 2]).is_pinhole());
        for ray in [[0.0, 0.0], [0.3, -0.2], [-0.6, 0.5]] {
            let known = Distortion::new(brown(-0.1, 0.03)).distort(ray).unwrap();
            let got = plain.distort(ray).unwrap();
            assert!((0..2).all(|k| (got[k] - known[k]).abs() < 1e-15), "{got:?} {known:?}");
            let back = both.undistort(both.distort(ray).unwrap()).unwrap();
            assert!((0..2).all(|k| (back[k] - ray[k]).abs() < 1e-9), "{back:?} {ray:?}");
        }
        assert_eq!(Distortion::after(Lens::Pinhole, [-0.4, 0.0]).distort([1.0, 0.0]), None, "it folds before");
    }

    /// Pixels of five rays by pycolmap 4.2.1 (`Camera.img_from_cam`), f = (300, 310), c = (320, 240).
    const RAYS: [[f64; 2]; 5] = [[0.1, -0.2], [0.7, 0.3], [-1.1, 0.9], [0.0, 1.6], [-2.5, -1.2]];

    #[test]
    fn lenses_project_as_colmap_does() {
        let thin =
            Lens::ThinPrismFisheye { k: [0.03, -0.012, 0.004, -0.001], p: [0.0011, -0.0007], s: [0.0021, -0.0013] };
        let rad_tan = Lens::RadTanThinPrismFisheye {
            k: [0.03, -0.012, 0.004, -0.001, 0.0006, -0.0002],
            p: [0.0011, -0.0007],
            s: [0.0021, -0.0013, 0.0004, -0.0009],
        };
        let known: [(Lens, [[f64; 2]; 5]); 6] = [
            (
                Lens::Fov { omega: 0.9 },
                [
                    [351.716282319, 174.453016541],
                    [514.347072483, 326.067989243],
                    [77.1470808198, 445.321104398],
                    [320.0, 583.268653351],
                    [-44.6819907219, 59.1177326019],
                ],
            ),
            (
                thin,
                [
                    [349.560002795, 178.948333693],
                    [501.545087259, 320.293478127],
                    [93.099142254, 432.103158926],
                    [320.430307972, 561.112373359],
                    [-19.4814501988, 71.2117494028],
                ],
            ),
            (
                rad_tan,
                [
                    [349.616750912, 178.881267736],
                    [501.935511432, 320.327242736],
                    [94.3159093177, 430.937077473],
                    [320.580647631, 559.734160776],
                    [-19.6074103315, 70.4357543562],
                ],
            ),
            (
                Lens::Division { k: -0.1 },
                [
                    [349.851481509, 178.306938216],
                    [519.056382315, 328.15354074],
                    [38.5043596811, 477.991768633],
                    [320.0, 649.464991393],
                    [-176.86797659, -6.44651638863],
                ],
            ),
            (
                Lens::Eucm { alpha: 0.6, beta: 1.1 },
                [
                    [349.519448252, 178.99314028],
                    [499.808953869, 319.62967957],
                    [96.5735047131, 428.896946015],
                    [320.0, 555.506559063],
                    [-14.0267373715, 74.3227382638],
                ],
            ),
            (
                Lens::Fisheye { k: [0.0; 4] },
                [
                    [349.514484301, 179.003399111],
                    [499.473041622, 319.480918433],
                    [97.6436201795, 427.99221203],
                    [320.0, 553.78107355],
                    [-11.2289988994, 75.7104165459],
                ],
            ),
        ];
        for (lens, pixels) in known {
            let lens = Distortion::new(lens);
            for (ray, pixel) in RAYS.into_iter().zip(pixels) {
                let [x, y] = lens.distort(ray).unwrap_or_else(|| panic!("{lens:?} loses {ray:?}"));
                let own = [300.0 * x + 320.0, 310.0 * y + 240.0];
                assert!((0..2).all(|k| (own[k] - pixel[k]).abs() < 1e-6), "{lens:?} {ray:?}: {own:?}, not {pixel:?}");
                let back = lens.undistort([x, y]).unwrap_or_else(|| panic!("{lens:?} loses {pixel:?}"));
                assert!((0..2).all(|k| (back[k] - ray[k]).abs() < 1e-8), "{lens:?} {ray:?}: {back:?}");
            }
        }
        let end = Distortion::new(Lens::Division { k: 0.25 });
        assert!(end.distort([0.9, 0.0]).is_some() && end.distort([1.1, 0.0]).is_none(), "1/(2√k) is the last ray");
    }

    #[test]
    fn distort_and_undistort_are_inverse() {
        let lenses = [
            Lens::Brown { k: [-0.28, 0.07, 0.002, 0.0, 0.0, 0.0], p: [1e-3, -2e-3], s: [0.0; 4] },
            Lens::Brown { k: [0.4, 0.1, 0.01, 0.7, 0.2, 0.03], p: [1e-3, 5e-4], s: [1e-3, 0.0, -1e-3, 1e-4] },
            Lens::Fisheye { k: [0.05, -0.01, 0.003, -0.001] },
        ];
        for lens in lenses {
            let lens = Distortion::new(lens);
            let mut checked = 0;
            for i in 0..400 {
                let (radius, angle) = (f64::from(i) / 400.0, f64::from(i) * 2.4);
                let ray = [radius * angle.cos(), radius * angle.sin()];
                let Some(point) = lens.distort(ray) else { continue };
                let back = lens.undistort(point).unwrap_or_else(|| panic!("{lens:?} lost the ray {ray:?}"));
                assert!((back[0] - ray[0]).abs() < 1e-8 && (back[1] - ray[1]).abs() < 1e-8, "{ray:?} {back:?}");
                checked += 1;
            }
            assert!(checked > 300, "{checked}");
        }
    }

    #[test]
    fn fisheye_without_terms_is_equidistant() {
        let lens = Distortion::new(Lens::Fisheye { k: [0.0; 4] });
        for degrees in [0.0f64, 1e-7, 10.0, 45.0, 80.0] {
            let theta = degrees.to_radians();
            let [x, y] = lens.distort([0.6 * theta.tan(), 0.8 * theta.tan()]).unwrap();
            assert!((x.hypot(y) - theta).abs() < 1e-12, "r must be θ");
        }
        assert!(lens.undistort([1.6, 0.0]).is_none(), "a ray behind 90° has no place in a pinhole picture");
    }

    #[test]
    fn rays_beyond_the_fold_have_no_pixel() {
        // d(r + k1 r³)/dr = 0 at r = √(1/(3·0.3)).
        let lens = Distortion::new(Lens::Brown { k: [-0.3, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 4] });
        let fold = (1.0f64 / 0.9).sqrt();
        assert!((lens.limit - fold).abs() < 1e-9);
        assert!(lens.distort([fold * 0.999, 0.0]).is_some() && lens.distort([fold * 1.001, 0.0]).is_none());
        assert!(lens.undistort([fold, 0.0]).is_none(), "the sensor ends at 2/3 of the fold");
        let nan = Distortion::new(Lens::Fisheye { k: [f64::NAN; 4] });
        assert!(nan.distort([0.1, 0.1]).is_none());
    }
}
