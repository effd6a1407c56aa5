//! A surface in the capture's coordinates, ready to be rendered: the triangles of a mesh, or a disc at every point of a
//! cloud, as large as its neighbours are far.

use super::surface::Surface;
use splat4d::math::sym3;

/// Neighbours of a point that give its normal and its size.
const NEIGHBOURS: usize = 12;
/// Points in a leaf of the tree.
const LEAF: usize = 8;
/// Of the distance of the farthest of these neighbours, the radius of a disc: on a regular grid of spacing s they reach
/// to 2 s, and discs of 1.2 s cover it without holes.
const RADIUS: f32 = 0.6;
/// Neighbours lie on a surface if the smallest of their variances is below this share of the middle one.
const FLAT: f64 = 0.25;

/// See the module's documentation.
#[derive(Clone, Debug)]
pub(super) enum Placed {
    Mesh { points: Vec<[f32; 3]>, triangles: Vec<[u32; 3]> },
    Discs(Vec<Disc>),
}

/// A point of a cloud and the surface around it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Disc {
    pub(super) center: [f32; 3],
    /// Unit; zero where neighbours lie on no surface.
    pub(super) normal: [f32; 3],
    pub(super) radius: f32,
}

impl Placed {
    /// Takes about a second for the largest clouds. It uses no other threads: images are loaded on all of them.
    pub(super) fn new(surface: &Surface) -> Self {
        let points: Vec<[f32; 3]> = surface.points.iter().map(|p| p.map(|v| v as f32)).collect();
        if surface.triangles.is_empty() {
            Self::Discs(discs(&points))
        } else {
            Self::Mesh { points, triangles: surface.triangles.clone() }
        }
    }
}

fn discs(points: &[[f32; 3]]) -> Vec<Disc> {
    let tree = Tree::new(points);
    let mut near = Vec::with_capacity(NEIGHBOURS + 1);
    let disc = |i: usize| {
        tree.nearest(i, &mut near);
        let farthest = near.last().map_or(0.0, |n| n.0.sqrt());
        Disc { center: points[i], normal: normal(points, &near), radius: RADIUS * farthest }
    };
    (0..points.len()).map(disc).collect()
}

/// The direction in which the neighbours vary least, if they lie on a surface.
fn normal(points: &[[f32; 3]], near: &[(f32, u32)]) -> [f32; 3] {
    if near.len() < 4 {
        return [0.0; 3];
    }
    let first = points[near[0].1 as usize];
    // Relative to one of them: coordinates may be large.
    let all: Vec<[f64; 3]> =
        near.iter().map(|n| std::array::from_fn(|k| f64::from(points[n.1 as usize][k] - first[k]))).collect();
    let share = 1.0 / all.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| all.iter().map(|p| p[k]).sum::<f64>() * share);
    let moment = |a: usize, b: usize| all.iter().map(|p| (p[a] - mean[a]) * (p[b] - mean[b])).sum::<f64>() * share;
    let cov = [moment(0, 0), moment(0, 1), moment(0, 2), moment(1, 1), moment(1, 2), moment(2, 2)];
    let (values, vectors) = sym3::eigen(cov);
    let flat = values[2].max(0.0) <= FLAT * values[1];
    if flat && values[1] > 0.0 { std::array::from_fn(|k| vectors[k][2] as f32) } else { [0.0; 3] }
}

/// A balanced k-d tree: the middle of a range splits it on its axis.
struct Tree<'a> {
    points: &'a [[f32; 3]],
    order: Vec<u32>,
    axes: Vec<u8>,
}

impl<'a> Tree<'a> {
    fn new(points: &'a [[f32; 3]]) -> Self {
        let mut tree = Self { points, order: (0..points.len() as u32).collect(), axes: vec![0; points.len()] };
        let mut ranges = vec![(0, points.len())];
        while let Some((from, to)) = ranges.pop() {
            if to - from <= LEAF {
                continue;
            }
            let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
            for &i in &tree.order[from..to] {
                let p = points[i as usize];
                (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(p[k]), high[k].max(p[k])));
            }
            let axis = (1..3).fold(0, |best, k| if high[k] - low[k] > high[best] - low[best] { k } else { best });
            let middle = from + (to - from) / 2;
            let by = |a: &u32, b: &u32| points[*a as usize][axis].total_cmp(&points[*b as usize][axis]).then(a.cmp(b));
            tree.order[from..to].select_nth_unstable_by(middle - from, by);
            tree.axes[middle] = axis as u8;
            ranges.extend([(from, middle), (middle + 1, to)]);
        }
        tree
    }

    /// The nearest points to point `i` with their squared distances, nearest first; itself among them.
    fn nearest(&self, i: usize, near: &mut Vec<(f32, u32)>) {
        near.clear();
        self.visit(self.points[i], (0, self.order.len()), near);
    }

    fn visit(&self, at: [f32; 3], (from, to): (usize, usize), near: &mut Vec<(f32, u32)>) {
        let mut take = |i: u32| {
            let p = self.points[i as usize];
            let found = ((0..3).map(|k| (p[k] - at[k]).powi(2)).sum::<f32>(), i);
            let place = near.partition_point(|n| (n.0, n.1) < found);
            if place <= NEIGHBOURS {
                near.truncate(NEIGHBOURS);
                near.insert(place, found);
            }
        };
        if to - from <= LEAF {
            self.order[from..to].iter().for_each(|&i| take(i));
            return;
        }
        let middle = from + (to - from) / 2;
        take(self.order[middle]);
        let axis = usize::from(self.axes[middle]);
        let beyond = at[axis] - self.points[self.order[middle] as usize][axis];
        let (first, second) =
            if beyond < 0.0 { ((from, middle), (middle + 1, to)) } else { ((middle + 1, to), (from, middle)) };
        self.visit(at, first, near);
        if near.len() <= NEIGHBOURS || beyond * beyond <= near[near.len() - 1].0 {
            self.visit(at, second, near);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn neighbours_are_the_nearest_and_discs_lie_on_the_surface() {
        let rng = Rng::new(2, "placed", 0);
        // A tilted plane z = 0.5 x.
        let points: Vec<[f32; 3]> = (0..900u64)
            .map(|i| {
                let (x, y) = (rng.uniform(2 * i) as f32, rng.uniform(2 * i + 1) as f32);
                [x, y, 0.5 * x]
            })
            .collect();
        let tree = Tree::new(&points);
        let mut near = Vec::new();
        for i in [0, 17, 450, 899] {
            tree.nearest(i, &mut near);
            let mut all: Vec<(f32, u32)> = (0..900u32)
                .map(|j| ((0..3).map(|k| (points[j as usize][k] - points[i][k]).powi(2)).sum(), j))
                .collect();
            all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            assert_eq!(near, all[..=NEIGHBOURS]);
        }
        let Placed::Discs(discs) =
            Placed::new(&Surface { points: points.iter().map(|p| p.map(f64::from)).collect(), ..Surface::default() })
        else {
            panic!("a cloud")
        };
        for d in &discs {
            // The normal is along (-0.5, 0, 1).
            assert!(d.normal[1].abs() < 1e-3 && (d.normal[0] + 0.5 * d.normal[2]).abs() < 1e-3, "{d:?}");
            assert!((0.02..0.2).contains(&d.radius), "{d:?}");
        }
        // A line and a lone point are no surface.
        let line: Vec<[f32; 3]> = (0..20).map(|i| [i as f32, 0.0, 0.0]).collect();
        assert_eq!(super::discs(&line)[3].normal, [0.0; 3]);
        assert_eq!(super::discs(&[[1.0; 3]])[0].radius, 0.0);
    }
}
