//! The share of the space in which something moves that three cameras see.

use super::look::{CELL, CameraObservations};
use splat4d::math::se3::{norm, sub};
use splat4d::scene::Camera;
use splat4d_train::vision::triangulate::{self, PixelObservation};

/// Cells of the cube along each side.
const SIDE: usize = 40;
/// Half the cube's side, of the cameras' median distance from their target: it reaches half way to them.
const HALF: f64 = 0.6;
/// This many cameras bound a position, and this many give it a shape.
const SEES: [usize; 2] = [2, 3];
/// This share of the cameras that see a position must see something move there: noise and shade hide some of it.
const MOVES: f64 = 0.75;
/// Cells in all times that must move before a share means anything.
const LEAST: usize = 60;

/// Target of these cameras, from their image centres.
pub(super) fn target(views: &[&Camera]) -> Option<[f64; 3]> {
    let middle = |v: &&Camera| [0.5 * v.width as f64, 0.5 * v.height as f64];
    let sights: Vec<PixelObservation<'_>> =
        views.iter().map(|v| PixelObservation { camera: v, pixel: middle(v) }).collect();
    triangulate::triangulate(&sights)
}

/// Of the visual hull of dynamic regions (Laurentini 1994; frame by frame, as far as two cameras see it) the part that
/// three see; None where too little moves.
pub(super) fn seen_by_three(seen: &[&CameraObservations], target: [f64; 3]) -> Option<f64> {
    let views: Vec<&Camera> = seen.iter().map(|s| &s.viewpoints[0].view).collect();
    let mut far: Vec<f64> = views.iter().map(|v| norm(sub(v.center(), target))).collect();
    let half = HALF * crate::sync::median(&mut far);
    let moments = seen.iter().map(|s| s.motion.len()).min().unwrap_or(0);
    let (mut known, mut shaped) = (0usize, 0usize);
    for cell in 0..SIDE.pow(3) {
        let place = [cell % SIDE, cell / SIDE % SIDE, cell / (SIDE * SIDE)];
        let at = |k: usize| target[k] + half * (2.0 * (place[k] as f64 + 0.5) / SIDE as f64 - 1.0);
        let place = [at(0), at(1), at(2)];
        let sees: Vec<(usize, usize)> =
            views.iter().enumerate().filter_map(|(c, v)| Some((c, cell_of(v, place)?))).collect();
        if sees.len() < SEES[0] {
            continue;
        }
        for moment in 0..moments {
            let moving = sees.iter().filter(|(c, cell)| seen[*c].motion[moment][*cell]).count();
            if moving >= SEES[0] && moving as f64 >= MOVES * sees.len() as f64 {
                known += 1;
                shaped += usize::from(sees.len() >= SEES[1]);
            }
        }
    }
    (known >= LEAST).then(|| shaped as f64 / known as f64)
}

/// The cell of a camera's image in which a position is seen.
fn cell_of(view: &Camera, place: [f64; 3]) -> Option<usize> {
    let ([u, v], _) = view.project(place)?;
    let inside = u >= 0.0 && v >= 0.0 && u < view.width as f64 && v < view.height as f64;
    let across = view.width.div_ceil(CELL);
    inside.then(|| v as usize / CELL * across + u as usize / CELL)
}
