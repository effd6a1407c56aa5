//! The world of uncalibrated cameras: up direction, walls and floor, and unit of length.

use super::algebra::Mat3;
use rayon::prelude::*;
use splat4d::math::se3::{cross, dot, mat_mul, mat_vec, norm, normalize, sub};
use splat4d::math::{Se3, median};

/// The direction that most cameras hold upwards: the mean of their −y axes.
pub(crate) fn up_of(poses: &[Se3]) -> [f64; 3] {
    let sum = poses.iter().fold([0.0; 3], |s, p| std::array::from_fn(|k| s[k] - p.rotation[1][k]));
    normalize(sum)
}

/// The median distance of the cameras from their targets: of each, the median distance of the points that it sees. With
/// it as the unit, a scene is of a size that is known, where no length is.
pub(crate) fn median_distance(distances: &mut [Vec<f64>]) -> Option<f64> {
    let mut each: Vec<f64> = distances.iter_mut().filter_map(|d| median(d)).collect();
    median(&mut each)
}

/// The frame along which a scene is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Axes {
    /// Rows: x, y and, upwards, z of the frame in the world.
    pub rotation: Mat3,
    /// Whether floor and walls determine the up direction; else z is what cameras hold upwards.
    pub upright: bool,
    /// Whether walls determine the heading; else any is as good.
    pub along: bool,
}

/// Largest error of the cameras' mean up direction, degrees: hands and tripods point downwards.
const TILT: f64 = 16.0;
/// Steps of the first search, degrees: tilt, heading.
const COARSE: [f64; 2] = [4.0, 3.0];
/// Steps of the last one, degrees; walls of matched points allow no finer ones.
const FINE: f64 = 0.05;
/// Width of a bin, of the points' median distance from their middle: of the bundled capture's 650 points widths from
/// 0.01 to 0.04 find the axes to 0.4 degrees.
const BIN: f64 = 0.03;
/// Points farther from the middle than this many medians are left out.
const FAR: f64 = 3.0;
/// Points that are examined, at most, evenly chosen.
const MOST: usize = 3000;
/// Of fewer points no frame is searched for.
const FEWEST: usize = 60;
/// Degrees off an upright frame at which entropy must have grown by [`CLEAR`] in every direction.
const PROBE: f64 = 12.0;
/// Nats, of all three projections. Clouds without structure (normal, on a sphere; 600 to 5,000 points) grow by 0.04 at
/// most, the bundled capture's by 0.5; by 0.04 and 0.3 over the mean of headings.
const CLEAR: f64 = 0.15;

/// The frame whose three projections of the points have the least entropy, near to `up`: points of walls and floor then
/// fall together. With `fixed`, `up` is kept and the heading alone is searched for.
///
/// (Entropy of projections as a measure of structure: Huber 1985, "Projection pursuit"; aligned with a room's axes in
/// Coughlan and Yuille's "Manhattan world", 1999.)
pub(crate) fn axes(points: &[[f64; 3]], up: [f64; 3], fixed: bool) -> Axes {
    let level = about(up);
    let Some((points, bin)) = gathered(points) else {
        return Axes { rotation: level, upright: false, along: false };
    };
    let score = |r: &Mat3| entropy(&points, r, bin);
    let turned = |by: [f64; 3], r: &Mat3| mat_mul(&rotation(by), r);
    let steps = |to: f64, step: f64| -> Vec<f64> {
        let n = (to / step) as i32;
        (-n..=n).map(|k| f64::from(k) * step).collect()
    };
    let tilts = if fixed { vec![0.0] } else { steps(TILT, COARSE[0]) };
    let tilts: Vec<[f64; 2]> = tilts.iter().flat_map(|a| tilts.iter().map(move |b| [*a, *b])).collect();
    let headings = (90.0 / COARSE[1]) as usize;
    let trials: Vec<Mat3> = (0..headings)
        .flat_map(|h| {
            let straight = turned([0.0, 0.0, h as f64 * COARSE[1]], &level);
            tilts.iter().map(move |&[a, b]| turned([a, b, 0.0], &straight))
        })
        .collect();
    let least = |trials: &[Mat3]| {
        let scores: Vec<f64> = trials.par_iter().map(score).collect();
        let best = (0..trials.len()).min_by(|&a, &b| scores[a].total_cmp(&scores[b])).expect("there are some");
        (scores[best], trials[best])
    };
    let refined = |(mut now, mut best): (f64, Mat3), axes: &[usize]| {
        let mut step = COARSE[1] / 2.0;
        while step > FINE {
            let near: Vec<Mat3> = axes
                .iter()
                .flat_map(|&k| [-step, step].map(|s| std::array::from_fn(|i| if i == k { s } else { 0.0 })))
                .map(|by| turned(by, &best))
                .collect();
            let (score, found) = least(&near);
            if score < now { (now, best) = (score, found) } else { step /= 2.0 }
        }
        (now, best)
    };
    let mut upright = fixed;
    let mut best = None;
    if !fixed {
        let free = refined(least(&trials), &[0, 1, 2]);
        let off = |k: usize| {
            let angle = std::f64::consts::TAU * k as f64 / 12.0;
            score(&turned([PROBE * angle.cos(), PROBE * angle.sin(), 0.0], &free.1))
        };
        let up_stays = dot(free.1[2], up) >= (TILT + COARSE[0]).to_radians().cos();
        if up_stays && (0..12).all(|k| off(k) > free.0 + CLEAR) {
            upright = true;
            best = Some(free);
        }
    }
    let (now, best) = best.unwrap_or_else(|| {
        let straight: Vec<Mat3> = (0..headings).map(|h| turned([0.0, 0.0, h as f64 * COARSE[1]], &level)).collect();
        refined(least(&straight), &[2])
    });
    let around = (0..headings).map(|h| score(&turned([0.0, 0.0, h as f64 * COARSE[1]], &best)));
    let mean = around.sum::<f64>() / headings as f64;
    Axes { rotation: best, upright, along: mean > now + CLEAR }
}

/// A frame whose z is `up`.
fn about(up: [f64; 3]) -> Mat3 {
    let z = normalize(up);
    let least = (0..3).min_by(|&a, &b| z[a].abs().total_cmp(&z[b].abs())).expect("three axes");
    let mut other = [0.0; 3];
    other[least] = 1.0;
    let x = normalize(cross(other, z));
    [x, cross(z, x), z]
}

/// The rotation by an axis times an angle in degrees (Rodrigues).
fn rotation(by: [f64; 3]) -> Mat3 {
    let angle = norm(by).to_radians();
    if angle == 0.0 {
        return Se3::IDENTITY.rotation;
    }
    let k = normalize(by);
    let column = |i: usize| {
        let mut e = [0.0; 3];
        e[i] = 1.0;
        let (turned, along) = (cross(k, e), (1.0 - angle.cos()) * k[i]);
        std::array::from_fn::<f64, 3, _>(|j| e[j] * angle.cos() + turned[j] * angle.sin() + along * k[j])
    };
    let columns = [column(0), column(1), column(2)];
    std::array::from_fn(|i| std::array::from_fn(|j| columns[j][i]))
}

/// Points about their middle without those that are far out, and the width of a bin; none of too few.
fn gathered(points: &[[f64; 3]]) -> Option<(Vec<[f64; 3]>, f64)> {
    if points.len() < FEWEST {
        return None;
    }
    let middle: [f64; 3] = std::array::from_fn(|k| {
        let mut all: Vec<f64> = points.iter().map(|p| p[k]).collect();
        let at = all.len() / 2;
        *all.select_nth_unstable_by(at, f64::total_cmp).1
    });
    let about: Vec<[f64; 3]> = points.iter().map(|p| sub(*p, middle)).collect();
    let mut far: Vec<f64> = about.iter().map(|p| norm(*p)).collect();
    let at = far.len() / 2;
    let median = *far.select_nth_unstable_by(at, f64::total_cmp).1;
    let near: Vec<[f64; 3]> = about.into_iter().filter(|p| norm(*p) <= FAR * median).collect();
    let kept = near.len().min(MOST);
    let chosen = (0..kept).map(|k| near[k * near.len() / kept]).collect();
    (median > 0.0 && median.is_finite()).then_some((chosen, BIN * median))
}

/// The entropy of the points' three projections, nats; each point is shared by the two bins that it is between.
fn entropy(points: &[[f64; 3]], frame: &Mat3, bin: f64) -> f64 {
    let half = (FAR / BIN).ceil() as usize + 1;
    let mut bins = vec![[0.0f64; 3]; 2 * half + 2];
    for p in points {
        for (k, v) in mat_vec(frame, *p).into_iter().enumerate() {
            let at = v / bin + half as f64;
            let (low, share) = (at as usize, at.fract());
            bins[low][k] += 1.0 - share;
            bins[low + 1][k] += share;
        }
    }
    let count = points.len() as f64;
    bins.iter().flatten().filter(|n| **n > 0.0).map(|n| -(n / count) * (n / count).ln()).sum()
}

/// How high a floor is along `up`: the lowest height with many points, and with hardly any below.
///
/// None: no such height.
pub(crate) fn floor(points: &[[f64; 3]], up: [f64; 3]) -> Option<f64> {
    /// Shares of all points: at least on a floor, and at most below it (outliers).
    const ON: f64 = 0.08;
    const BELOW: f64 = 0.05;
    let (_, bin) = gathered(points)?;
    let mut heights: Vec<f64> = points.iter().map(|p| dot(*p, up)).collect();
    heights.sort_by(f64::total_cmp);
    let n = heights.len();
    let within = |k: usize| heights.partition_point(|h| *h <= heights[k] + bin) - k;
    // The fullest window that begins low.
    let low = (BELOW * n as f64) as usize;
    let best = (0..=low).max_by_key(|&k| (within(k), n - k))?;
    let count = within(best);
    (count as f64 >= ON * n as f64).then(|| heights[best + count / 2])
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn upright_cameras_determine_the_up_direction() {
        let place = |k: usize| [k as f64, (k * k % 5) as f64, (3 * k % 7) as f64];
        let poses: Vec<Se3> = (0..6).map(|k| Se3::look_at(place(k), [2.0, 9.0, 4.0], [0.0, 0.0, 1.0])).collect();
        let up = up_of(&poses);
        assert!(up[2] > 0.5, "{up:?}");
    }

    /// A floor, two walls and objects, in a rotated world.
    fn room(turn: &Mat3, noise: f64) -> Vec<[f64; 3]> {
        let rng = Rng::new(4, "room", 0);
        let at = |k: usize| {
            let u = |j: u64| 2.0 * rng.uniform(8 * k as u64 + j) - 1.0;
            let off = noise * rng.normal(8 * k as u64 + 7);
            let p = match k % 6 {
                0 | 1 => [u(0), 1.5 * u(1), off],
                2 => [1.0 + off, 1.5 * u(1), 1.0 + u(2)],
                3 => [u(0), 1.5 + off, 1.0 + u(2)],
                _ => [0.6 * u(0), 0.6 * u(1), 0.8 + 0.8 * u(2)],
            };
            mat_vec(turn, p)
        };
        (0..600).map(at).collect()
    }

    /// Degrees between an axis of the room and the nearest of the frame.
    fn off(found: &Mat3, turn: &Mat3) -> f64 {
        let column = |k: usize| [turn[0][k], turn[1][k], turn[2][k]];
        let nearest = |k: usize| (0..3).map(|i| dot(found[i], column(k)).abs()).fold(0.0, f64::max).min(1.0);
        (0..3).map(|k| nearest(k).acos().to_degrees()).fold(0.0, f64::max)
    }

    #[test]
    fn walls_and_floor_give_the_axes() {
        let turn = rotation([20.0, -70.0, 35.0]);
        let points = room(&turn, 0.005);
        let true_up = [turn[0][2], turn[1][2], turn[2][2]];
        // What cameras hold upwards is 10 degrees off.
        let up = mat_vec(&rotation([6.0, -8.0, 0.0]), true_up);
        let found = axes(&points, up, false);
        assert!(found.upright && found.along, "{found:?}");
        assert!(off(&found.rotation, &turn) < 0.5, "{} degrees", off(&found.rotation, &turn));
        assert!(dot(found.rotation[2], true_up) > 0.99, "upwards stays upwards");
        let told = axes(&points, true_up, true);
        assert!(told.along && dot(told.rotation[2], true_up) > 1.0 - 1e-12, "what is told stays");
        assert!(off(&told.rotation, &turn) < 0.5);
    }

    #[test]
    fn without_walls_the_up_direction_of_cameras_is_kept() {
        let rng = Rng::new(5, "cloud", 0);
        let points: Vec<[f64; 3]> = (0..800).map(|k| std::array::from_fn(|j| rng.normal(3 * k + j as u64))).collect();
        let up = normalize([0.2, 0.9, -0.3]);
        let found = axes(&points, up, false);
        assert!(!found.upright && !found.along);
        assert!(dot(found.rotation[2], up) > 1.0 - 1e-9);
        assert!(!axes(&points[..20], up, false).along, "few points tell nothing");
    }

    #[test]
    fn a_floor_is_the_lowest_level_that_many_points_share() {
        let turn = rotation([0.0, 40.0, 10.0]);
        let up = [turn[0][2], turn[1][2], turn[2][2]];
        let mut points = room(&turn, 0.005);
        // Wrong ones below.
        points.extend((0..12).map(|k| mat_vec(&turn, [0.1 * f64::from(k), 0.3, -0.4 - 0.05 * f64::from(k)])));
        let height = floor(&points, up).expect("there is a floor");
        assert!(height.abs() < 0.02, "{height}");
        let rng = Rng::new(6, "cloud", 0);
        let cloud: Vec<[f64; 3]> = (0..800).map(|k| std::array::from_fn(|j| rng.normal(3 * k + j as u64))).collect();
        assert_eq!(floor(&cloud, [0.0, 0.0, 1.0]), None);
    }
}
