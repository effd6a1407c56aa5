//! A dynamic scene with the same Gaussians in the same order at every time: what programs need that interpolate between
//! frames, blur by motion or encode differences. Outside its lifespan, a Gaussian stays at its first or last position.

use super::{Layer, Scene, freeze_rows};
use crate::Result;
use crate::math::quat;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH, Time};

/// Opacity (logit) of a Gaussian that is not alive: alpha 2·10⁻⁹, far below what is rendered.
pub(crate) const HIDDEN: f32 = -20.0;

/// The frames of a scene as rows that are the same Gaussian in all of them.
pub struct Constant<'a> {
    scene: &'a Scene<f32>,
    times: Vec<f64>,
    /// By layer: for each row its place among the kept ones; [`u32::MAX`]: never alive.
    places: Vec<Vec<u32>>,
    /// Every kept row at the first time at which it is alive, its opacity hidden.
    first: Params<f32>,
    /// The rows at the last time that was queried for.
    now: Params<f32>,
}

impl<'a> Constant<'a> {
    /// Finds the Gaussians that are alive at one of `times`, which rise. Errors: the scene has a head.
    pub fn new(scene: &'a Scene<f32>, times: Vec<f64>) -> Result<Self> {
        scene.without_head("plain Gaussians")?;
        let mut places: Vec<Vec<u32>> = scene.layers.iter().map(|l| vec![u32::MAX; l.params.len()]).collect();
        for (layer, places) in scene.layers.iter().zip(&mut places) {
            for &t in &times {
                alive(layer, t).into_iter().for_each(|row| places[row as usize] = 0);
            }
        }
        let mut count = 0;
        for place in places.iter_mut().flatten().filter(|p| **p == 0) {
            *place = count;
            count += 1;
        }
        let coefficients = scene.layers.iter().map(|l| l.params[SH].width() / 3).max().unwrap_or(1).max(1);
        let mut first = Params::new(count as usize, coefficients, &[]);
        let mut known = vec![false; count as usize];
        for (layer, places) in scene.layers.iter().zip(&places) {
            for &t in &times {
                let mut rows = alive(layer, t);
                rows.retain(|row| !known[places[*row as usize] as usize]);
                copy(layer, &rows, t, places, &mut first, |place| known[place] = true);
            }
        }
        (0..first.len()).for_each(|row| first[GEOMETRY].set(row, OPACITY, HIDDEN));
        Ok(Self { scene, times, places, now: first.clone(), first })
    }

    /// Gaussians of every frame.
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// Whether no Gaussian is ever alive.
    pub fn is_empty(&self) -> bool {
        self.first.is_empty()
    }

    /// The times of the frames, seconds.
    pub(crate) fn times(&self) -> &[f64] {
        &self.times
    }

    /// Frame `i`, whose opacities are `HIDDEN` where a Gaussian is not alive. Frames are requested one after the other;
    /// frame 0 begins again. Rotations keep the sign and the order of axes that are nearest to the frame before.
    pub fn frame(&mut self, i: usize) -> &Params<f32> {
        if i == 0 {
            self.now = self.first.clone();
        }
        (0..self.now.len()).for_each(|row| self.now[GEOMETRY].set(row, OPACITY, HIDDEN));
        let t = self.times[i];
        for (layer, places) in self.scene.layers.iter().zip(&self.places) {
            copy(layer, &alive(layer, t), t, places, &mut self.now, |_| {});
        }
        &self.now
    }
}

/// Rows of a layer that are alive at a time.
fn alive(layer: &Layer<f32>, t: f64) -> Vec<u32> {
    let mut rows = Vec::new();
    if layer.active(Time(t), &mut rows) {
        rows.extend(0..layer.params.len() as u32);
    }
    rows
}

/// Writes rows of a layer at a time to their positions.
fn copy(
    layer: &Layer<f32>,
    rows: &[u32],
    t: f64,
    places: &[u32],
    out: &mut Params<f32>,
    mut written: impl FnMut(usize),
) {
    if rows.is_empty() {
        return;
    }
    let seen = freeze_rows(layer, rows, Time(t));
    let [geometry, sh] = out.get_mut([GEOMETRY, SH]);
    let turns = Turns::new();
    for (from, &row) in rows.iter().enumerate() {
        let place = places[row as usize] as usize;
        let own = seen[GEOMETRY].read::<11>(from, 0);
        let before = geometry.read::<11>(place, 0);
        // A row that was not written yet has no rotation at all.
        let is_new = before[QUAT..LOG_SCALE].iter().all(|x| *x == 0.0);
        let (q, s) = if is_new { shape(&own) } else { turns.nearest(shape(&own), shape(&before)) };
        geometry.write(place, 0, [own[0], own[1], own[2]]);
        geometry.write(place, QUAT, q.map(|x| x as f32));
        geometry.write(place, LOG_SCALE, s);
        geometry.set(place, OPACITY, own[OPACITY]);
        (0..seen[SH].width()).for_each(|k| sh.set(place, k, seen[SH].get(from, k)));
        written(place);
    }
}

/// A unit quaternion and log scales.
type Shape = ([f64; 4], [f32; 3]);

fn shape(row: &[f32; 11]) -> Shape {
    let (q, _) = quat::normalize(std::array::from_fn(|k| f64::from(row[QUAT + k])));
    (q, std::array::from_fn(|k| row[LOG_SCALE + k]))
}

/// Cosine of half the angle above which a rotation needs no other form: a tenth of a radian.
const NEAR: f64 = 0.99875;

/// The 24 rotations that take axes to axes: the other forms of one ellipsoid.
struct Turns(Vec<([f64; 4], [usize; 3])>);

impl Turns {
    fn new() -> Self {
        let signs = [-1.0, 0.0, 1.0];
        let all = (0..81).map(|i| [i / 27, i / 9 % 3, i / 3 % 3, i % 3].map(|d: usize| signs[d]));
        // Of q and −q the one whose first part that is not zero is positive; one, two or four parts, of one length.
        let first = |q: &[f64; 4]| q.iter().find(|x| **x != 0.0).is_some_and(|x| *x > 0.0);
        let parts = |q: &[f64; 4]| [1, 2, 4].contains(&q.iter().filter(|x| **x != 0.0).count());
        let turn = |q: [f64; 4]| {
            let q = quat::normalize(q).0;
            let matrix = quat::to_rotation(q);
            // Column k points along the axis whose scale becomes the k-th.
            let axis = |k: usize| (0..3).find(|r| matrix[*r][k].abs() > 0.5).expect("axes go to axes");
            (q, std::array::from_fn(axis))
        };
        Self(all.filter(|q| first(q) && parts(q)).map(turn).collect())
    }

    /// The form of a shape that is nearest to another one: of 24 pairs of rotation and scales, with both signs.
    fn nearest(&self, (q, s): Shape, (before, scales): Shape) -> Shape {
        let dot = |a: [f64; 4]| a.iter().zip(before).map(|(a, b)| a * b).sum::<f64>();
        let signed = |q: [f64; 4]| if dot(q) < 0.0 { q.map(|x| -x) } else { q };
        if dot(q).abs() > NEAR {
            return (signed(q), s);
        }
        // Squares of the angle and of what the logarithms of the scales change by.
        let cost = |q: [f64; 4], s: [f32; 3]| {
            let angle = 2.0 * dot(q).abs().min(1.0).acos();
            angle * angle + s.iter().zip(scales).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
        };
        let forms = self.0.iter().map(|(turn, axes)| (quat::product(q, *turn), axes.map(|a| s[a])));
        let best = forms.min_by(|a, b| cost(a.0, a.1).total_cmp(&cost(b.0, b.1))).expect("there are 24 forms");
        // The unchanged shape where a conversion would only add rounding.
        let (q, s) = if cost(best.0, best.1) < cost(q, s) - 1e-6 { best } else { (q, s) };
        (signed(q), s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::freeze;
    use crate::math::{Rng, sym3};
    use crate::motion::{SpacetimeSpec, Spec, build};
    use crate::scene::{LIFE, LifeKind};

    /// Gaussians that fly, spin and have lifespans of a part of a second.
    fn moving() -> Scene<f32> {
        let life = LifeKind::GaussHalf;
        let mut params = Params::new(60, 4, life.columns());
        let spec = SpacetimeSpec { order: 2, rotation: true, detach: false, origin: 0.5, features: None };
        let motion = build(&Spec::Spacetime(spec), &mut params).unwrap();
        let rng = Rng::new(5, "constant", 0);
        for key in params.keys().collect::<Vec<_>>() {
            for row in 0..60 {
                for col in 0..params[key].width() {
                    let n = rng.fork(u64::from(key.0)).fork(row as u64).normal(col as u64) as f32;
                    let x = match (key, col) {
                        (LIFE, 0) => 0.5 + 0.4 * n,
                        (LIFE, _) => (0.1f32).ln() + 0.2 * n,
                        (GEOMETRY, LOG_SCALE..OPACITY) => n - 3.0,
                        (GEOMETRY, OPACITY) => 1.0 + n,
                        _ => n,
                    };
                    params[key].set(row, col, x);
                }
            }
        }
        Scene { layers: vec![Layer::new("a", params, motion, life)], clip: [0.0, 1.0], fps: 8.0, ..Scene::default() }
    }

    #[test]
    fn every_form_is_the_same_ellipsoid() {
        let turns = Turns::new();
        assert_eq!(turns.0.len(), 24);
        let (q, s) = (quat::normalize([0.3, -0.8, 0.4, 0.2]).0, [-1.0f32, -2.0, -3.5]);
        let cov = |q: [f64; 4], s: [f32; 3]| sym3::from_quat_log_scales(q, s.map(f64::from));
        for (turn, axes) in &turns.0 {
            let form = (quat::product(q, *turn), axes.map(|a| s[a]));
            let apart = cov(q, s).iter().zip(cov(form.0, form.1)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(apart < 1e-12, "{turn:?}: {apart}");
            // Whatever sign or order of axes it has in this frame, it is written as in the frame before.
            let (back, scales) = turns.nearest(form, (q, s));
            assert!(scales == s && back.iter().zip(q).all(|(a, b)| (a - b).abs() < 1e-9), "{turn:?}: {back:?}");
        }
    }

    #[test]
    fn rows_keep_their_gaussian_and_hide_it_outside_its_lifespan() {
        let scene = moving();
        let times: Vec<f64> = (0..8).map(|i| scene.clip[0] + f64::from(i) / scene.fps).collect();
        let mut constant = Constant::new(&scene, times.clone()).unwrap();
        let (count, mut ever) = (constant.len(), 0);
        let mut before: Option<Params<f32>> = None;
        for (i, &t) in times.iter().enumerate() {
            let now = constant.frame(i).clone();
            let plain = freeze(&scene, Time(t)).unwrap();
            let shown: Vec<usize> = (0..count).filter(|&r| now[GEOMETRY].get(r, OPACITY) > HIDDEN).collect();
            assert_eq!((now.len(), shown.len()), (count, plain.len()), "frame {i}");
            ever = ever.max(shown.len());
            for (row, &kept) in shown.iter().enumerate() {
                let (a, b) = (now[GEOMETRY].read::<3>(kept, 0), plain[GEOMETRY].read::<3>(row, 0));
                assert_eq!(a, b, "frame {i}, row {row}");
                assert_eq!(now[GEOMETRY].get(kept, OPACITY), plain[GEOMETRY].get(row, OPACITY));
            }
            if let Some(before) = &before {
                let q = |p: &Params<f32>, row: usize| shape(&p[GEOMETRY].read::<11>(row, 0)).0;
                let same =
                    (0..count).all(|r| q(before, r).iter().zip(q(&now, r)).map(|(a, b)| a * b).sum::<f64>() >= 0.0);
                assert!(same, "a sign flips at frame {i}");
            }
            before = Some(now);
        }
        assert!(count > ever, "some Gaussians live for a part of the clip: {count}, {ever}");
        assert_eq!(Constant::new(&scene, times).unwrap().frame(0), constant.frame(0));
    }
}
