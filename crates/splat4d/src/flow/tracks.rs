//! Tracks: where chosen Gaussians are over time, for any motion model.
//!
//! A track is as long as the lifespan of its Gaussian: models with short lifespans give short tracks, and times at
//! which a Gaussian is not alive have no position.

use crate::layers::{Evaluation, Scene};
use crate::math::Real;
use crate::scene::{Rows, Space, Time};

/// One Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Member {
    /// Number of its layer.
    pub layer: usize,
    /// Its row.
    pub row: u32,
}

/// Positions of some Gaussians at some times.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tracks {
    /// Seconds.
    pub times: Vec<f64>,
    /// In ascending order.
    pub members: Vec<Member>,
    /// [members, times, 3], scene units; `None` where the Gaussian is not alive.
    pub points: Vec<Option<[f32; 3]>>,
}

impl Tracks {
    /// Follows Gaussians over `times`. Panics: there is no such Gaussian.
    pub fn follow<F: Real>(scene: &Scene<F>, members: &[Member], times: &[f64]) -> Self {
        let mut members = members.to_vec();
        members.sort_unstable();
        members.dedup();
        let mut points = vec![None; members.len() * times.len()];
        let mut first = 0;
        for (index, layer) in scene.layers.iter().enumerate() {
            let count = members[first..].iter().take_while(|m| m.layer == index).count();
            let rows: Vec<u32> = members[first..first + count].iter().map(|m| m.row).collect();
            assert!(rows.last().is_none_or(|&r| (r as usize) < layer.params.len()), "layer {index} has no such row");
            let spans = if count > 0 { layer.spans() } else { Vec::new() };
            for (k, &t) in times.iter().enumerate().filter(|_| count > 0) {
                let seen = Evaluation::of_layer(layer, Space::Gaussians, Rows::Some(&rows), Time(t));
                for (j, &row) in rows.iter().enumerate() {
                    let [from, to] = spans[row as usize];
                    let x = seen.tape(0).out().read::<3>(j, 0);
                    if t >= from && t <= to && x.iter().all(|x| x.is_finite()) {
                        points[(first + j) * times.len() + k] = Some(x.map(|x| x.f64() as f32));
                    }
                }
            }
            first += count;
        }
        assert!(first == members.len(), "Gaussians belong to layers of the scene");
        Self { times: times.to_vec(), members, points }
    }

    /// One member's positions, a time each.
    pub fn track(&self, member: usize) -> &[Option<[f32; 3]>] {
        &self.points[member * self.times.len()..(member + 1) * self.times.len()]
    }
}

/// Every n-th Gaussian of a scene. Panics: `every` is 0.
pub fn every<F: Real>(scene: &Scene<F>, every: usize) -> Vec<Member> {
    let of = |(layer, l): (usize, &crate::layers::Layer<F>)| {
        (0..l.params.len() as u32).step_by(every).map(move |row| Member { layer, row })
    };
    scene.layers.iter().enumerate().flat_map(of).collect()
}

/// For every point the `count` Gaussians nearest to it at time t, nearest first, of those alive then with at least
/// `opacity`: [points, count], shorter where there are fewer.
pub fn nearest<F: Real>(
    scene: &Scene<F>,
    t: Time,
    points: &[[f64; 3]],
    count: usize,
    opacity: f64,
) -> Vec<Vec<Member>> {
    let mut instant = Evaluation::default();
    scene.at(t, &mut instant);
    let mut all: Vec<([f64; 3], Member)> = Vec::new();
    for (layer, tape) in instant.tapes().enumerate() {
        for j in 0..tape.out().rows() {
            let row = tape.out().read::<10>(j, 0).map(F::f64);
            if row[crate::scene::splats::SPLAT_OPACITY] >= opacity && row[..3].iter().all(|x| x.is_finite()) {
                all.push(([row[0], row[1], row[2]], Member { layer, row: tape.rows().id(j) as u32 }));
            }
        }
    }
    let near = |p: &[f64; 3]| {
        let square = |x: &[f64; 3]| (0..3).map(|k| (x[k] - p[k]).powi(2)).sum::<f64>();
        let mut order: Vec<(f64, Member)> = all.iter().map(|(x, m)| (square(x), *m)).collect();
        let count = count.min(order.len());
        let by = |a: &(f64, Member), b: &(f64, Member)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if count > 0 && count < order.len() {
            order.select_nth_unstable_by(count - 1, by);
        }
        order.truncate(count);
        order.sort_by(by);
        order.into_iter().map(|o| o.1).collect()
    };
    points.iter().map(near).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::Layer;
    use crate::motion::{SpacetimeSpec, Spec, build};
    use crate::scene::{GEOMETRY, LIFE, LifeKind, Params};

    /// Five Gaussians in a row that drift; the last one lives only around 0.
    fn scene() -> Scene<f32> {
        let mut params = Params::new(5, 1, LifeKind::GaussHalf.columns());
        let motion = build(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
        let key = params.find("velocities").unwrap();
        for r in 0..5 {
            params[GEOMETRY].write(r, 0, [r as f32, 0.0, 0.0, 1.0]);
            params[GEOMETRY].set(r, 10, 2.0);
            params[key].set(r, 1, 0.5);
            params[LIFE].write(r, 0, [0.0, if r == 4 { -2.0 } else { 4.0 }]);
        }
        let layer = Layer::new("a, b", params, motion, LifeKind::GaussHalf);
        Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, ..Scene::default() }
    }

    #[test]
    fn gaussians_are_followed_during_their_lifespans() {
        let s = scene();
        let tracks = Tracks::follow(&s, &every(&s, 2), &[0.0, 1.0]);
        assert_eq!(tracks.members.iter().map(|m| m.row).collect::<Vec<_>>(), [0, 2, 4]);
        assert_eq!(tracks.track(1), [Some([2.0, 0.0, 0.0]), Some([2.0, 0.5, 0.0])]);
        assert_eq!(tracks.track(2), [Some([4.0, 0.0, 0.0]), None], "it is dead by then");
    }

    #[test]
    fn the_nearest_are_chosen_among_active_gaussians() {
        let s = scene();
        let rows = |t: f64, count| -> Vec<u32> {
            nearest(&s, Time(t), &[[3.7, 0.0, 0.0]], count, 0.1)[0].iter().map(|m| m.row).collect()
        };
        assert_eq!(rows(0.0, 2), [4, 3]);
        assert_eq!(rows(1.0, 3), [3, 2, 1]);
        assert_eq!(rows(0.0, 9).len(), 5);
        assert!(nearest(&s, Time(0.0), &[[0.0; 3]], 2, 0.99)[0].is_empty());
    }
}
