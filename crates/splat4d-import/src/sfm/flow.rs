//! Where a place of one picture is in the next: least squares of the differences of small windows, coarse to fine (Lucas and
//! Kanade 1981; Bouguet 2000).

use splat4d::scene::Planes;
use splat4d_train::vision::raster::{blurred, every_second, sample};

/// Half the window, pixels.
const REACH: isize = 7;
/// Pictures of falling size; motion of up to some 30 pixels is followed.
const LEVELS: usize = 4;
/// Steps on a level, at most.
const STEPS: usize = 12;
/// Steps shorter than this change nothing, pixels.
const STILL: f32 = 0.01;
/// Blur before every second pixel is taken, pixels.
const HALVING_BLUR: f64 = 1.0;
/// The least eigenvalue of a window's gradients, a pixel: less has no corner to follow (of pictures in [0, 1]).
const CORNER: f32 = 1e-5;
/// There and back must end this near, pixels (methods of optical flow: forward-backward check).
const ROUND_TRIP: f64 = 0.7;

/// A grey picture at falling sizes.
pub(crate) struct Pyramid(Vec<Planes<f32>>);

impl Pyramid {
    pub(crate) fn new(grey: Planes<f32>) -> Self {
        let mut levels = vec![grey];
        while levels.len() < LEVELS {
            let last = &levels[levels.len() - 1];
            if last.width.min(last.height) < 8 * REACH as usize {
                break;
            }
            levels.push(every_second(&blurred(last, HALVING_BLUR)));
        }
        Self(levels)
    }
}

/// Where `place` of the first picture is in the second; nothing where it cannot be followed.
fn follow(from: &Pyramid, to: &Pyramid, place: [f64; 2]) -> Option<[f64; 2]> {
    const SIDE: usize = 2 * REACH as usize + 1;
    let mut moved = [0.0f32; 2];
    for level in (0..from.0.len().min(to.0.len())).rev() {
        let (a, b) = (&from.0[level], &to.0[level]);
        // Every second pixel is kept, the first one too: pixel centres p become (p − 0.5)/2 + 0.5.
        let scale = (level as f64).exp2();
        let at = place.map(|p| ((p - 0.5) / scale + 0.5) as f32);
        moved = moved.map(|m| 2.0 * m);
        let mut window = [(0.0f32, 0.0f32, 0.0f32); SIDE * SIDE];
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (k, w) in window.iter_mut().enumerate() {
            let x = at[0] + (k % SIDE) as f32 - REACH as f32;
            let y = at[1] + (k / SIDE) as f32 - REACH as f32;
            let dx = 0.5 * (sample(a, x + 1.0, y) - sample(a, x - 1.0, y));
            let dy = 0.5 * (sample(a, x, y + 1.0) - sample(a, x, y - 1.0));
            *w = (sample(a, x, y), dx, dy);
            xx += dx * dx;
            xy += dx * dy;
            yy += dy * dy;
        }
        let half = 0.5 * (xx + yy);
        let least = half - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        if least < CORNER * (SIDE * SIDE) as f32 {
            if level == 0 {
                return None;
            }
            continue;
        }
        let det = xx * yy - xy * xy;
        for _ in 0..STEPS {
            let (mut gx, mut gy) = (0.0, 0.0);
            for (k, (value, dx, dy)) in window.iter().enumerate() {
                let x = at[0] + moved[0] + (k % SIDE) as f32 - REACH as f32;
                let y = at[1] + moved[1] + (k / SIDE) as f32 - REACH as f32;
                let off = value - sample(b, x, y);
                gx += off * dx;
                gy += off * dy;
            }
            let step = [(yy * gx - xy * gy) / det, (xx * gy - xy * gx) / det];
            if !step.iter().all(|s| s.is_finite()) {
                return None;
            }
            (0..2).for_each(|k| moved[k] += step[k]);
            if step[0].abs().max(step[1].abs()) < STILL {
                break;
            }
        }
    }
    let out = [place[0] + f64::from(moved[0]), place[1] + f64::from(moved[1])];
    let inside = (0.0..from.0[0].width as f64).contains(&out[0]) && (0.0..from.0[0].height as f64).contains(&out[1]);
    inside.then_some(out)
}

/// As [`follow`], where the way back leads to the start.
pub(crate) fn surely(from: &Pyramid, to: &Pyramid, place: [f64; 2]) -> Option<[f64; 2]> {
    let there = follow(from, to, place)?;
    let back = follow(to, from, there)?;
    ((back[0] - place[0]).hypot(back[1] - place[1]) < ROUND_TRIP).then_some(there)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn a_shifted_picture_is_followed_and_a_blank_one_is_not() {
        let rng = Rng::new(1, "noise", 0);
        let mut noise = Planes::<f32>::new(1, 160, 200);
        noise.data.iter_mut().enumerate().for_each(|(k, v)| *v = rng.uniform(k as u64) as f32);
        let base = blurred(&noise, 2.0);
        let shift = [7.3, -4.6];
        let mut moved = base.clone();
        for y in 0..160 {
            for x in 0..200 {
                let (u, v) = (x as f32 + 0.5 - shift[0] as f32, y as f32 + 0.5 - shift[1] as f32);
                moved.data[y * 200 + x] = sample(&base, u, v);
            }
        }
        let (a, b) = (Pyramid::new(base), Pyramid::new(moved));
        for k in 0..30 {
            let place = [40.0 + 4.0 * f64::from(k), 50.0 + 2.0 * f64::from(k)];
            let there = surely(&a, &b, place).unwrap();
            assert!((0..2).all(|i| (there[i] - place[i] - shift[i]).abs() < 0.05), "{place:?} {there:?}");
        }
        let blank = Pyramid::new(Planes::new(1, 160, 200));
        assert!(surely(&blank, &a, [80.0, 80.0]).is_none());
    }
}
