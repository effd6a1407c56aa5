//! Angles between neighbouring cameras, and where a camera is missing.

use super::poses::Solved;
use serde::Serialize;
use splat4d::math::se3::{dot, norm, sub};

/// Largest angle between neighbours that features survive in most scenes, degrees (docs/filming.md).
pub(super) const FAR: f64 = 20.0;

/// Two neighbours along the rig.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gap {
    /// Their names.
    pub cameras: [String; 2],
    /// The angle between them, seen from the middle of the scene, degrees.
    pub degrees: f64,
}

impl Gap {
    /// Advice; none: they are near enough.
    pub(crate) fn advice(&self) -> Option<String> {
        let more = (self.degrees / FAR).ceil() as usize - 1;
        let [a, b] = &self.cameras;
        let cameras = if more == 1 { "a camera".to_owned() } else { format!("{more} cameras") };
        (self.degrees > FAR)
            .then(|| format!("Add {cameras} between {a} and {b}: they are {:.0} degrees apart.", self.degrees))
    }
}

/// The neighbours of a rig of fixed cameras: the tree of least angles that joins all placed ones.
pub(super) fn gaps(solved: &Solved, names: &[&str]) -> Vec<Gap> {
    let Some(middle) = middle(solved) else { return Vec::new() };
    let center = |k: usize| {
        let stand = solved.cameras[k].as_ref().ok().filter(|s| s.fixed)?;
        let ray = sub(stand.poses.first().copied().flatten()?.inverse().translation, middle);
        (norm(ray) > 0.0).then_some((k, ray))
    };
    let rays: Vec<(usize, [f64; 3])> = (0..solved.cameras.len()).filter_map(center).collect();
    tree(&rays.iter().map(|r| r.1).collect::<Vec<_>>())
        .into_iter()
        .map(|(a, b, degrees)| Gap { cameras: [a, b].map(|i| names[rays[i].0].to_owned()), degrees })
        .collect()
}

/// The median of the points.
fn middle(solved: &Solved) -> Option<[f64; 3]> {
    let n = solved.points.len();
    let median = |k: usize| {
        let mut values: Vec<f64> = solved.points.iter().map(|(x, _)| x[k]).collect();
        values.sort_by(f64::total_cmp);
        values[n / 2]
    };
    (n > 0).then(|| std::array::from_fn(median))
}

/// Edges of the minimum spanning tree over angles (Prim 1957): two rays and the degrees between them.
fn tree(rays: &[[f64; 3]]) -> Vec<(usize, usize, f64)> {
    let degrees = |a: [f64; 3], b: [f64; 3]| (dot(a, b) / (norm(a) * norm(b))).clamp(-1.0, 1.0).acos().to_degrees();
    let (mut inside, mut outside, mut edges) = (vec![0], (1..rays.len()).collect::<Vec<_>>(), Vec::new());
    while !outside.is_empty() {
        let pairs = inside.iter().flat_map(|&a| outside.iter().map(move |&b| (a, b)));
        let best = pairs.map(|(a, b)| (a, b, degrees(rays[a], rays[b]))).min_by(|x, y| x.2.total_cmp(&y.2));
        let Some(edge) = best else { break };
        inside.push(edge.1);
        outside.retain(|&i| i != edge.1);
        edges.push(edge);
    }
    edges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_on_an_arc_are_joined_and_wide_gaps_get_cameras() {
        let at = |degrees: f64| [degrees.to_radians().sin(), 0.0, degrees.to_radians().cos()];
        // Not in the order of the arc.
        let edges = tree(&[at(0.0), at(60.0), at(15.0)]);
        let rounded: Vec<(usize, usize, i64)> = edges.iter().map(|e| (e.0, e.1, e.2.round() as i64)).collect();
        assert_eq!(rounded, [(0, 2, 15), (2, 1, 45)]);
        let gap = |degrees: f64| Gap { cameras: ["a".into(), "b".into()], degrees };
        assert_eq!(gap(15.0).advice(), None);
        assert!(gap(31.0).advice().unwrap().contains("a camera between a and b"));
        assert!(gap(45.0).advice().unwrap().contains("2 cameras"));
        assert!(tree(&[]).is_empty() && tree(&[at(1.0)]).is_empty());
    }
}
