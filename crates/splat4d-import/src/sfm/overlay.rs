//! Places of features made exact: the windows about one point in all its images are laid over each other.
//!
//! A detector finds the middle of a blob, which is another point of the object from every side, some tenths of a pixel
//! off. For poses, all images must locate the same point: the window of one image, warped as a small plane at the point
//! would be seen from the other camera, is moved over the other image until they agree best (Lucas and Kanade 1981,
//! with an affine warp and gain and offset of brightness; features are adjusted before bundle adjustment as by
//! Lindenberger et al. 2021).

use super::lens::Lens;
use splat4d::math::Se3;
use splat4d::math::cholesky::Cholesky;
use splat4d::math::mat3::solve;
use splat4d::math::se3::{dot, mat_vec, normalize, sub, transpose};
use splat4d::scene::Planes;

/// Part of an image as features were taken from it, grey.
#[derive(Clone, Debug)]
pub(crate) struct Shown {
    /// Pixel of the whole image at which it begins.
    pub corner: [usize; 2],
    pub width: usize,
    pub height: usize,
    /// Row by row.
    pub grey: Vec<u8>,
    /// How much later than the image its features' places are, seconds.
    pub later: f64,
}

impl Shown {
    /// Of a grey image in [0, 1].
    pub(crate) fn new(grey: &Planes<f32>, corner: [usize; 2], later: f64) -> Self {
        let bytes = grey.plane(0).iter().map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8).collect();
        Self { corner, width: grey.width, height: grey.height, grey: bytes, later }
    }

    /// Value and gradient at a pixel of the whole image, between pixels; `None` outside.
    fn at(&self, [u, v]: [f64; 2]) -> Option<[f64; 3]> {
        let x = u - 0.5 - self.corner[0] as f64;
        let y = v - 0.5 - self.corner[1] as f64;
        if !(x >= 1.0 && y >= 1.0 && x < self.width as f64 - 2.0 && y < self.height as f64 - 2.0) {
            return None;
        }
        let (left, top) = (x as usize, y as usize);
        let (fx, fy) = (x - left as f64, y - top as f64);
        let (wx, wy) = (cubic(fx), cubic(fy));
        let (dx, dy) = (cubic_slope(fx), cubic_slope(fy));
        let mut out = [0.0; 3];
        for j in 0..4 {
            let row = (top + j - 1) * self.width + left - 1;
            let (mut value, mut slope) = (0.0, 0.0);
            for i in 0..4 {
                let pixel = f64::from(self.grey[row + i]);
                value += wx[i] * pixel;
                slope += dx[i] * pixel;
            }
            out[0] += wy[j] * value;
            out[1] += wy[j] * slope;
            out[2] += dy[j] * value;
        }
        Some(out)
    }
}

/// Weights of four neighbours at a position between the middle two (Catmull and Rom 1974): linear ones blur, by how
/// much depends on the position, and bias positions to pixel centres.
fn cubic(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t + 2.0 * t2 - t3), 0.5 * (2.0 - 5.0 * t2 + 3.0 * t3), 0.5 * (t + 4.0 * t2 - 3.0 * t3), 0.5 * (t3 - t2)]
}

/// Their slopes.
fn cubic_slope(t: f64) -> [f64; 4] {
    let t2 = t * t;
    [
        0.5 * (-1.0 + 4.0 * t - 3.0 * t2),
        0.5 * (-10.0 * t + 9.0 * t2),
        0.5 * (1.0 + 8.0 * t - 9.0 * t2),
        0.5 * (3.0 * t2 - 2.0 * t),
    ]
}

/// A placed camera.
#[derive(Clone, Copy)]
pub(super) struct Eye<'a> {
    pub lens: &'a Lens,
    pub pose: &'a Se3,
}

impl Eye<'_> {
    fn center(&self) -> [f64; 3] {
        self.pose.inverse().translation
    }

    /// Direction in the world that is seen at a pixel.
    fn ray(&self, pixel: [f64; 2]) -> [f64; 3] {
        mat_vec(&transpose(&self.pose.rotation), self.lens.ray(pixel))
    }

    fn pixel(&self, x: [f64; 3]) -> Option<[f64; 2]> {
        self.lens.project(self.pose.apply(x))
    }

    /// How the pixel of a point changes with its place.
    fn slopes(&self, x: [f64; 3]) -> Option<[[f64; 3]; 2]> {
        Some(
            self.lens.project_by(self.pose.apply(x))?.by_place.map(|row| mat_vec(&transpose(&self.pose.rotation), row)),
        )
    }

    /// Image position and velocity of a moving point.
    pub(super) fn moving(&self, x: [f64; 3], speed: [f64; 3]) -> Option<([f64; 2], [f64; 2])> {
        Some((self.pixel(x)?, self.slopes(x)?.map(|row| dot(row, speed))))
    }
}

/// A point in a camera's image.
#[derive(Clone, Copy)]
pub(super) struct ImagePoint<'a> {
    /// The image.
    pub shown: Option<&'a Shown>,
    /// Position in it.
    pub place: [f64; 2],
    /// From where.
    pub eye: Eye<'a>,
}

/// How fast a point moves that these see moving so fast (pixels a second); `None`: undetermined.
pub(super) fn speed(x: [f64; 3], seen: &[ImagePoint<'_>], velocities: &[[f64; 2]]) -> Option<[f64; 3]> {
    if velocities.iter().all(|v| *v == [0.0; 2]) {
        return Some([0.0; 3]);
    }
    let (mut normal, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
    for (s, v) in seen.iter().zip(velocities) {
        for (row, v) in s.eye.slopes(x)?.into_iter().zip(v) {
            for i in 0..3 {
                right[i] += row[i] * v;
                (0..3).for_each(|j| normal[i][j] += row[i] * row[j]);
            }
        }
    }
    solve(normal, right)
}

/// Half the window, pixels, and the spread of its weights.
const REACH: isize = 7;
const SPREAD: f64 = 4.0;
const SIDE: usize = 2 * REACH as usize + 1;
/// Steps at most; it rests at steps shorter than this many pixels.
const STEPS: usize = 20;
const STILL: f64 = 0.003;
/// Farthest that a position may move, pixels.
const FARTHEST: f64 = 1.5;
/// Windows whose correlation is less do not show one object from both sides.
const ALIKE: f64 = 0.9;
/// Standard deviation of grey values in a window, of 255: less has nothing to lay over.
const FLAT: f64 = 4.0;
/// How far the warp may differ from a plane's that faces the cameras: slanted planes are up to twice as narrow.
const SLANT: f64 = 1.0;

/// The position of every sighting that agrees with the most central one's, by number, as offsets in pixels; those that
/// do not agree have none. The most central one itself stays. All `None`: nothing can be determined. Then the same of
/// `more` cameras, whose places are guesses.
pub(super) fn aligned(x: [f64; 3], seen: &[ImagePoint<'_>], more: &[ImagePoint<'_>]) -> Vec<Option<[f64; 2]>> {
    let toward: Vec<[f64; 3]> = seen.iter().map(|s| normalize(sub(s.eye.center(), x))).collect();
    let central = |k: usize| toward.iter().map(|t| dot(*t, toward[k])).sum::<f64>();
    let normal = normalize(std::array::from_fn(|k| toward.iter().map(|t| t[k]).sum()));
    let mut out = vec![None; seen.len() + more.len()];
    let pictured = (0..seen.len()).filter(|&k| seen[k].shown.is_some());
    let Some(main) = pictured.max_by(|&a, &b| central(a).total_cmp(&central(b)).then(b.cmp(&a))) else { return out };
    let Some(template) = Template::new(&seen[main]) else { return out };
    out[main] = Some([0.0; 2]);
    for (k, other) in seen.iter().chain(more).enumerate().filter(|(k, _)| *k != main) {
        out[k] = warp(x, normal, &seen[main], other).and_then(|w| template.over(other, w));
    }
    out
}

/// How pixels about a point in one image are in another one, if it is on a plane with this normal.
fn warp(x: [f64; 3], normal: [f64; 3], from: &ImagePoint<'_>, to: &ImagePoint<'_>) -> Option<[[f64; 2]; 2]> {
    /// Pixels over which the slope is taken.
    const STEP: f64 = 2.0;
    let middle = from.eye.pixel(x)?;
    let eye = from.eye.center();
    let moved = |by: [f64; 2]| {
        let ray = from.eye.ray([middle[0] + by[0], middle[1] + by[1]]);
        let along = dot(normal, sub(x, eye)) / dot(normal, ray);
        to.eye.pixel(std::array::from_fn(|k| eye[k] + along * ray[k]))
    };
    let slope = |by: [f64; 2]| {
        let (there, back) = (moved(by)?, moved(by.map(|v| -v))?);
        Some([0, 1].map(|k| (there[k] - back[k]) / (2.0 * STEP)))
    };
    let (across, down) = (slope([STEP, 0.0])?, slope([0.0, STEP])?);
    let out = [[across[0], down[0]], [across[1], down[1]]];
    out.as_flattened().iter().all(|v| v.is_finite()).then_some(out)
}

/// The window of the most central sighting.
struct Template {
    /// Grey value and weight of every pixel.
    values: [(f64, f64); SIDE * SIDE],
}

impl Template {
    fn new(of: &ImagePoint<'_>) -> Option<Self> {
        let (window, place) = (of.shown?, of.place);
        let mut values = [(0.0, 0.0); SIDE * SIDE];
        for (k, v) in values.iter_mut().enumerate() {
            let [dx, dy] = offset(k);
            let weight = (-0.5 * (dx * dx + dy * dy) / (SPREAD * SPREAD)).exp();
            *v = (window.at([place[0] + dx, place[1] + dy])?[0], weight);
        }
        let total: f64 = values.iter().map(|v| v.1).sum();
        let mean = values.iter().map(|v| v.0 * v.1).sum::<f64>() / total;
        let variance = values.iter().map(|v| v.1 * (v.0 - mean).powi(2)).sum::<f64>() / total;
        (variance.sqrt() > FLAT).then_some(Self { values })
    }

    /// How far the position of another sighting is from where its window agrees with this one.
    fn over(&self, other: &ImagePoint<'_>, start: [[f64; 2]; 2]) -> Option<[f64; 2]> {
        /// Shift, warp, gain, offset.
        const N: usize = 8;
        let (window, place) = (other.shown?, other.place);
        let (mut shift, mut a, mut gain, mut lift) = ([0.0; 2], start, 1.0, 0.0);
        let mut alike = 0.0;
        for _ in 0..STEPS {
            let (mut normal, mut right) = ([0.0; N * N], [0.0; N]);
            // Weighted sums of both windows: their correlation.
            let mut sums = [0.0; 6];
            for (k, (value, weight)) in self.values.iter().enumerate() {
                let [dx, dy] = offset(k);
                let [wx, wy] = [a[0][0] * dx + a[0][1] * dy, a[1][0] * dx + a[1][1] * dy];
                let [there, gx, gy] = window.at([place[0] + shift[0] + wx, place[1] + shift[1] + wy])?;
                let row = [gx, gy, gx * dx, gx * dy, gy * dx, gy * dy, -value, -1.0];
                let off = there - gain * value - lift;
                for i in 0..N {
                    right[i] -= weight * row[i] * off;
                    for j in 0..=i {
                        normal[i * N + j] += weight * row[i] * row[j];
                    }
                }
                let terms = [1.0, *value, there, value * value, there * there, value * there];
                sums.iter_mut().zip(terms).for_each(|(s, t)| *s += weight * t);
            }
            let [n, s, t, ss, tt, st] = sums;
            alike = (n * st - s * t) / ((n * ss - s * s) * (n * tt - t * t)).sqrt();
            for i in 0..N {
                normal[i * N + i] *= 1.0 + 1e-6;
                normal[i * N + i] += 1e-9;
            }
            let step = Cholesky::new(N, normal.to_vec())?.solve(right.to_vec());
            shift[0] += step[0];
            shift[1] += step[1];
            for k in 0..4 {
                a[k / 2][k % 2] += step[2 + k];
            }
            gain += step[6];
            lift += step[7];
            let far = shift[0].hypot(shift[1]);
            if far > FARTHEST || far.is_nan() {
                return None;
            }
            if step[0].hypot(step[1]) < STILL {
                break;
            }
        }
        let off = |k: usize| (a[k / 2][k % 2] - start[k / 2][k % 2]).powi(2);
        let slanted = (0..4).map(off).sum::<f64>().sqrt();
        (alike > ALIKE && slanted < SLANT && gain > 0.0).then_some(shift)
    }
}

fn offset(k: usize) -> [f64; 2] {
    [(k % SIDE) as f64 - REACH as f64, (k / SIDE) as f64 - REACH as f64]
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;
    use splat4d_train::vision::raster::{blurred, sample};

    /// A camera's image of a textured wall z = 0, brightened.
    fn wall(eye: Eye<'_>, texture: &Planes<f32>, gain: f32) -> Shown {
        let (width, height) = (160, 120);
        let mut grey = Planes::<f32>::new(1, height, width);
        for y in 0..height {
            for x in 0..width {
                let (ray, from) = (eye.ray([x as f64 + 0.5, y as f64 + 0.5]), eye.center());
                let along = -from[2] / ray[2];
                let [u, v] = [0, 1].map(|k| ((from[k] + along * ray[k]) * 60.0) as f32 + 150.0);
                grey.data[y * width + x] = gain * sample(texture, u, v) + 0.02;
            }
        }
        Shown::new(&grey, [0, 0], 0.0)
    }

    fn noise(seed: u64) -> Planes<f32> {
        let rng = Rng::new(seed, "texture", 0);
        let mut out = Planes::<f32>::new(1, 300, 300);
        out.data.iter_mut().enumerate().for_each(|(k, v)| *v = rng.uniform(k as u64) as f32);
        let mut out = blurred(&out, 2.5);
        out.data.iter_mut().for_each(|v| *v = (0.5 + 4.0 * (*v - 0.5)).clamp(0.0, 1.0));
        out
    }

    #[test]
    fn patches_of_one_point_align_to_hundredths_of_a_pixel_and_others_are_left_out() {
        let lens = Lens { k1: -0.01, ..Lens::plain(150.0, 160, 120) };
        let eyes = [[-0.9, -0.2, -2.0], [0.0, 0.1, -2.2], [0.8, 0.3, -1.9], [0.3, -0.5, -2.1]];
        let poses = eyes.map(|e| Se3::look_at(e, [0.0; 3], [0.0, -1.0, 0.0]));
        let eye = |k: usize| Eye { lens: &lens, pose: &poses[k] };
        let (texture, other) = (noise(1), noise(2));
        // The fourth camera sees another wall.
        let shown: Vec<Shown> =
            (0..4).map(|k| wall(eye(k), if k == 3 { &other } else { &texture }, [1.0, 0.8, 0.9, 1.0][k])).collect();
        let x = [0.05, -0.08, 0.0];
        let true_places: Vec<[f64; 2]> = (0..4).map(|k| eye(k).pixel(x).unwrap()).collect();
        // Those of the middle camera are right; the others are off as features are.
        let off = [[0.45, -0.3], [0.0, 0.0], [-0.35, 0.5], [0.2, 0.2]];
        let seen: Vec<ImagePoint<'_>> = (0..4)
            .map(|k| ImagePoint {
                shown: Some(&shown[k]),
                place: [true_places[k][0] + off[k][0], true_places[k][1] + off[k][1]],
                eye: eye(k),
            })
            .collect();
        let found = aligned(x, &seen[..2], &seen[2..]);
        // Which of them is the middle one follows from their directions: all agree with it.
        let main = found.iter().position(|f| *f == Some([0.0; 2])).unwrap();
        for k in 0..3 {
            let moved = found[k].unwrap();
            let left: [f64; 2] = std::array::from_fn(|a| off[k][a] + moved[a]);
            assert!((0..2).all(|a| (left[a] - off[main][a]).abs() < 0.06) || main != 1, "{k} {left:?}");
        }
        assert!(found[3].is_none());
        let flat = Shown::new(&Planes::new(1, 120, 160), [0, 0], 0.0);
        let blank: Vec<ImagePoint<'_>> = seen.iter().map(|s| ImagePoint { shown: Some(&flat), ..*s }).collect();
        assert!(aligned(x, &blank, &[]).iter().all(Option::is_none));
    }

    #[test]
    fn the_speed_of_a_point_follows_from_its_pixels() {
        let lens = Lens::plain(150.0, 160, 120);
        let poses = [[-0.9, -0.2, -2.0], [0.8, 0.3, -1.9]].map(|e| Se3::look_at(e, [0.0; 3], [0.0, -1.0, 0.0]));
        let eyes = poses.each_ref().map(|pose| Eye { lens: &lens, pose });
        let (x, v) = ([0.1, 0.2, 0.3], [0.5, -0.4, 0.7]);
        let velocities: Vec<[f64; 2]> = eyes.iter().map(|e| e.moving(x, v).unwrap().1).collect();
        let h = 1e-6;
        let there = eyes[0].pixel(std::array::from_fn(|k| x[k] + h * v[k])).unwrap();
        let here = eyes[0].pixel(x).unwrap();
        assert!((0..2).all(|k| ((there[k] - here[k]) / h - velocities[0][k]).abs() < 1e-3));
        let seen: Vec<ImagePoint<'_>> =
            eyes.iter().map(|&eye| ImagePoint { shown: None, place: [0.0; 2], eye }).collect();
        let found = speed(x, &seen, &velocities).unwrap();
        assert!((0..3).all(|k| (found[k] - v[k]).abs() < 1e-9), "{found:?}");
        assert_eq!(speed(x, &seen, &[[0.0; 2]; 2]), Some([0.0; 3]));
    }
}
