//! The world of cameras that know nothing of it: which way is up in it, and how long its unit is.

use splat4d::math::Se3;
use splat4d::math::se3::normalize;

/// The direction that most cameras hold upwards: the mean of their −y axes.
pub fn up_of(poses: &[Se3]) -> [f64; 3] {
    let sum = poses.iter().fold([0.0; 3], |s, p| std::array::from_fn(|k| s[k] - p.rotation[1][k]));
    normalize(sum)
}

/// The median distance of the cameras from what they look at: of each, the median distance of the points that it sees. With it
/// as the unit, a scene is of a size that is known, where no length is.
pub fn median_distance(distances: &mut [Vec<f64>]) -> Option<f64> {
    let middle = |v: &mut Vec<f64>| {
        let at = v.len() / 2;
        *v.select_nth_unstable_by(at, f64::total_cmp).1
    };
    let mut each: Vec<f64> = distances.iter_mut().filter(|d| !d.is_empty()).map(middle).collect();
    (!each.is_empty()).then(|| middle(&mut each))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_that_were_held_upright_tell_which_way_is_up() {
        let place = |k: usize| [k as f64, (k * k % 5) as f64, (3 * k % 7) as f64];
        let poses: Vec<Se3> = (0..6).map(|k| Se3::look_at(place(k), [2.0, 9.0, 4.0], [0.0, 0.0, 1.0])).collect();
        let up = up_of(&poses);
        assert!(up[2] > 0.5, "{up:?}");
    }
}
