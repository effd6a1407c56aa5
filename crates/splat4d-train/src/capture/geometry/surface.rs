//! A measured surface as files hold it, and the cloud that is kept of it.

use crate::capture::pose::FARTHEST;
use splat4d::math::Rng;
use std::collections::BTreeMap;

/// Points of a file that are kept in memory while it is read: a random share of more. The surface that they show is
/// thinned to [`MOST_POINTS`] afterwards.
const MOST_READ: u64 = 6_000_000;
/// Points of a placed cloud: a pixel of a training image needs one, and searches of neighbours stay below two seconds.
const MOST_POINTS: usize = 400_000;
/// Cells along the longest side of the grid that thins: three numbers fit one key.
const MAX_CELLS: f64 = (1u64 << 20) as f64;

/// Points, or the triangles between them, in the coordinates of their file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Surface {
    pub(super) points: Vec<[f64; 3]>,
    /// sRGB from 0 to 1, one per point; empty: the file has none.
    pub(super) colors: Vec<[f32; 3]>,
    /// Empty: a cloud.
    pub(super) triangles: Vec<[u32; 3]>,
    /// Points with coordinates that cannot be computed with.
    pub(super) left_out: usize,
}

/// Takes the points of a cloud from its reader, and keeps a random share of large ones.
pub(super) struct Sink {
    out: Surface,
    share: f64,
    rng: Rng,
    seen: u64,
    colored: bool,
}

impl Sink {
    /// For about this many points; `colored`: they have colours.
    pub(super) fn new(points: u64, colored: bool) -> Self {
        let share = (MOST_READ as f64 / points.max(1) as f64).min(1.0);
        Self { out: Surface::default(), share, rng: Rng::new(0, "geometry", 0), seen: 0, colored }
    }

    pub(super) fn push(&mut self, point: [f64; 3], color: [f32; 3]) {
        self.seen += 1;
        if !point.iter().all(|v| v.abs() <= FARTHEST) {
            self.out.left_out += 1;
        } else if self.share >= 1.0 || self.rng.uniform(self.seen) < self.share {
            self.out.points.push(point);
            if self.colored {
                self.out.colors.push(color.map(|c| if c.is_finite() { c.clamp(0.0, 1.0) } else { 0.5 }));
            }
        }
    }

    pub(super) fn finish(self) -> Surface {
        self.out
    }
}

impl Surface {
    /// A cloud of at most [`MOST_POINTS`]: means of the cells of a grid that is as fine as that allows. Meshes stay.
    pub(super) fn thinned(self) -> Self {
        if !self.triangles.is_empty() || self.points.len() <= MOST_POINTS {
            return self;
        }
        let (low, side) = self.bounds();
        // A surface of n cells is about √n cells wide.
        let mut per_side = (MOST_POINTS as f64).sqrt();
        loop {
            let cells = self.cells(low, per_side / side);
            let mut starts = vec![0];
            starts.extend((1..cells.len()).filter(|&i| cells[i].0 != cells[i - 1].0));
            if starts.len() <= MOST_POINTS || per_side < 2.0 {
                return self.means(&cells, &starts);
            }
            per_side *= (0.9 * MOST_POINTS as f64 / starts.len() as f64).sqrt();
        }
    }

    fn bounds(&self) -> ([f64; 3], f64) {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in &self.points {
            (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(p[k]), high[k].max(p[k])));
        }
        (low, (0..3).map(|k| high[k] - low[k]).fold(f64::MIN_POSITIVE, f64::max))
    }

    /// The cell of every point, sorted by cell and then by point.
    fn cells(&self, low: [f64; 3], per_unit: f64) -> Vec<(u64, u32)> {
        let cell = |p: &[f64; 3], k: usize| ((p[k] - low[k]) * per_unit).clamp(0.0, MAX_CELLS) as u64;
        let key = |p: &[f64; 3]| cell(p, 0) << 42 | cell(p, 1) << 21 | cell(p, 2);
        let mut cells: Vec<(u64, u32)> = self.points.iter().zip(0..).map(|(p, i)| (key(p), i)).collect();
        cells.sort_unstable();
        cells
    }

    fn means(&self, cells: &[(u64, u32)], starts: &[usize]) -> Self {
        let mut out = Self { left_out: self.left_out, ..Self::default() };
        for (k, &start) in starts.iter().enumerate() {
            let members = &cells[start..starts.get(k + 1).copied().unwrap_or(cells.len())];
            let share = 1.0 / members.len() as f64;
            let (mut point, mut color) = ([0.0; 3], [0.0f64; 3]);
            for &(_, i) in members {
                (0..3).for_each(|k| point[k] += share * self.points[i as usize][k]);
                if let Some(c) = self.colors.get(i as usize) {
                    (0..3).for_each(|k| color[k] += share * f64::from(c[k]));
                }
            }
            out.points.push(point);
            if !self.colors.is_empty() {
                out.colors.push(color.map(|c| c as f32));
            }
        }
        out
    }

    /// Points on it with their colours, if it has any: those of a cloud, and about `count` of a mesh, at random by
    /// area.
    pub(super) fn samples(&self, count: usize) -> (Vec<[f64; 3]>, Vec<[f32; 3]>) {
        if self.triangles.is_empty() {
            return (self.points.clone(), self.colors.clone());
        }
        let corners = |t: &[u32; 3]| t.map(|i| self.points[i as usize]);
        let areas: Vec<f64> = self.triangles.iter().map(|t| area(corners(t))).collect();
        let whole = areas.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let rng = Rng::new(0, "mesh", 0);
        let (mut points, mut colors, mut due, mut drawn) = (Vec::new(), Vec::new(), 0.5, 0u64);
        for (t, area) in self.triangles.iter().zip(&areas) {
            due += count as f64 * area / whole;
            while due >= 1.0 {
                due -= 1.0;
                let [a, b] = [rng.uniform(2 * drawn), rng.uniform(2 * drawn + 1)];
                drawn += 1;
                // Uniform in a triangle: the other half of the parallelogram is folded back.
                let [a, b] = if a + b > 1.0 { [1.0 - a, 1.0 - b] } else { [a, b] };
                let shares = [1.0 - a - b, a, b];
                let p = corners(t);
                points.push(std::array::from_fn(|k| (0..3).map(|c| shares[c] * p[c][k]).sum()));
                if !self.colors.is_empty() {
                    let c = t.map(|i| self.colors[i as usize]);
                    colors.push(std::array::from_fn(|k| (0..3).map(|i| shares[i] as f32 * c[i][k]).sum()));
                }
            }
        }
        (points, colors)
    }
}

fn area(p: [[f64; 3]; 3]) -> f64 {
    use splat4d::math::se3::{cross, norm, sub};
    0.5 * norm(cross(sub(p[1], p[0]), sub(p[2], p[0])))
}

/// The points of scans of several times that most of them share, which do not move, once each; and the others, each
/// with its time. Two are one point in a cell of `side`.
pub(super) fn apart(scans: &[(f64, Vec<[f64; 3]>)], side: f64) -> Vec<(usize, usize, Option<f64>)> {
    /// Of the scans, from which on a cell is static.
    const SHARED: f64 = 0.8;
    let cell = |p: &[f64; 3]| p.map(|v| (v / side).floor() as i64);
    let mut cells: BTreeMap<[i64; 3], (usize, usize)> = BTreeMap::new();
    for (s, (_, points)) in scans.iter().enumerate() {
        for p in points {
            let (count, last) = cells.entry(cell(p)).or_insert((0, usize::MAX));
            if *last != s {
                (*count, *last) = (*count + 1, s);
            }
        }
    }
    let still = |p: &[f64; 3]| scans.len() > 1 && cells[&cell(p)].0 as f64 >= SHARED * scans.len() as f64;
    let mut taken: BTreeMap<[i64; 3], usize> = BTreeMap::new();
    let mut out = Vec::new();
    for (s, (time, points)) in scans.iter().enumerate() {
        for (i, p) in points.iter().enumerate() {
            if !still(p) {
                out.push((s, i, (scans.len() > 1).then_some(*time)));
            } else if *taken.entry(cell(p)).or_insert(s) == s {
                out.push((s, i, None));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_clouds_are_thinned_to_means_and_meshes_are_sampled_by_area() {
        let n = MOST_POINTS + 50_000;
        let mut sink = Sink::new(n as u64, true);
        let rng = Rng::new(1, "plane", 0);
        (0..n as u64).for_each(|i| sink.push([rng.uniform(2 * i), rng.uniform(2 * i + 1), 3.0], [0.2, 0.4, 0.6]));
        sink.push([f64::NAN, 0.0, 0.0], [0.0; 3]);
        let thin = sink.finish().thinned();
        assert!((MOST_POINTS / 2..=MOST_POINTS).contains(&thin.points.len()), "{}", thin.points.len());
        assert!(thin.points.iter().all(|p| (p[2] - 3.0).abs() < 1e-9) && (thin.colors[7][1] - 0.4).abs() < 1e-5);
        assert_eq!(thin.left_out, 1);
        let mesh = Surface {
            points: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 3.0]],
            triangles: vec![[0, 1, 2], [0, 1, 3]],
            ..Surface::default()
        };
        let (points, colors) = mesh.samples(4000);
        let flat = points.iter().filter(|p| p[2] == 0.0).count();
        assert!((3990..4010).contains(&points.len()) && (990..1010).contains(&flat), "{flat} of {}", points.len());
        assert!(colors.is_empty() && points.iter().all(|p| p.iter().sum::<f64>() <= 3.0 + 1e-9));
    }

    #[test]
    fn what_most_scans_share_is_static() {
        let wall: Vec<[f64; 3]> = (0..10).map(|i| [f64::from(i), 0.0, 0.0]).collect();
        let with = |ball: f64| [wall.clone(), vec![[ball, 5.0, 0.0]]].concat();
        let found = apart(&[(0.0, with(1.0)), (0.1, with(4.0)), (0.2, with(7.0))], 0.5);
        assert_eq!(found.iter().filter(|f| f.2.is_none()).count(), 10, "the wall, once");
        let moving: Vec<f64> = found.iter().filter_map(|f| f.2).collect();
        assert_eq!(moving, [0.0, 0.1, 0.2]);
        assert!(apart(&[(0.0, wall)], 0.5).iter().all(|f| f.2.is_none()), "a single scan has no times");
    }
}
