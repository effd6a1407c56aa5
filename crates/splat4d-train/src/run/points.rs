//! Points found in the images of a capture that has too few: computed once, stored in the run as `points.ply`, and then
//! used like points of the capture.

use super::checkpoint::write_atomically;
use super::identity::fingerprint;
use super::open::{OpenCapture, training_frames};
use crate::Result;
use crate::capture::{Capture, PointCloud, read_points};
use crate::event::{Event, Progress};
use crate::init::{self, Source};
use crate::methods::TrainContext;
use crate::recipe::Recipe;
use crate::vision;
use splat4d::scene::Camera;
use std::path::Path;
use std::sync::Arc;

/// The file next to the run.
const FILE: &str = "points.ply";
/// Of the initial Gaussians: with fewer points of its own, a capture's images are searched for more.
const FEW: f64 = 0.05;
/// A capture whose points leave out more than this share of what a camera sees (the median of its cameras) has too few
/// as well, however many: a sky, a far background. Of eight captures the bundled one, a kitchen, a hall and five
/// synthetic rooms have 0 to 0.06, one before a far background has 0.34 (docs/suite.md).
const BARE: f64 = 0.2;
/// Cells along an image's longer side in which that is counted; of a rig at most this many views.
const CELLS: f64 = 16.0;
const VIEWS: usize = 64;
/// Of the initial Gaussians, the points that are searched for: the others are placed between them along surfaces.
const WANTED: f64 = 0.5;

/// The capture with points from its images, where it brings too few and the recipe lets them be searched for.
pub(super) fn complete(
    opened: OpenCapture,
    recipe: &Recipe,
    run: &Path,
    listen: &mut dyn FnMut(&Event),
) -> Result<OpenCapture> {
    let (capture, plan) = (&opened.capture, opened.plan(recipe));
    if !wanted(capture, recipe) {
        return Ok(opened);
    }
    let moments = moments(recipe, &plan)?;
    let count = (WANTED * recipe.initial_count() as f64) as usize;
    let mark = format!("comment of {} {} {count} {moments:?}", fingerprint(capture), env!("CARGO_PKG_VERSION"));
    let kept =
        crate::files::read(&run.join(FILE)).is_ok_and(|bytes| bytes.windows(mark.len()).any(|w| w == mark.as_bytes()));
    if !kept {
        let mut cloud = PointCloud::default();
        for p in vision::points(opened.frames.as_ref(), &moments, count, &mut Progress(listen))? {
            cloud.points.push(p.place);
            cloud.colors.push(p.color);
            cloud.times.push(p.time);
        }
        write_atomically(&run.join(FILE), &cloud.to_ply(&mark))?;
    }
    let completed = with_found(Capture::clone(capture), recipe, run)?;
    Ok(OpenCapture::with(training_frames(Arc::new(completed), recipe)?).on(opened.device))
}

/// The capture with the points that were found for the run in this folder, if any were. Errors: they cannot be read.
pub fn with_found(mut capture: Capture, recipe: &Recipe, run: &Path) -> Result<Capture> {
    let file = run.join(FILE);
    if file.is_file() && wanted(&capture, recipe) {
        let found = read_points(&file)?;
        if recipe.init.source == Source::Pictures {
            capture.points = None;
        }
        capture.add_points(found, recipe.capture.near);
    }
    Ok(capture)
}

fn wanted(capture: &Capture, recipe: &Recipe) -> bool {
    let own = capture.points.as_ref().map_or(&[][..], |p| &p.points);
    match recipe.init.source {
        Source::Pictures => true,
        // Objects that are cut out of their background are carved from their masks; depth maps show all that there is.
        Source::Auto if capture.background.is_some() => false,
        Source::Auto if (own.len() as f64) < FEW * recipe.initial_count() as f64 => true,
        Source::Auto => !capture.frames.iter().any(|f| f.depth.is_some()) && bare(capture, own) > BARE,
        _ => false,
    }
}

/// The share of a camera's image in which there are no points nearby, the median of the training cameras.
fn bare(capture: &Capture, points: &[[f64; 3]]) -> f64 {
    let views: Vec<&Camera> = capture.places().collect();
    let mut shares: Vec<f64> =
        views.iter().step_by(views.len().div_ceil(VIEWS).max(1)).map(|v| uncovered(v, points)).collect();
    shares.sort_by(f64::total_cmp);
    shares.get(shares.len() / 2).copied().unwrap_or(0.0)
}

/// The share of the cells of an image without a point in them or in the eight around.
fn uncovered(camera: &Camera, points: &[[f64; 3]]) -> f64 {
    let side = camera.width.max(camera.height) as f64 / CELLS;
    let [columns, rows] = [camera.width, camera.height].map(|n| (n as f64 / side).round().max(1.0) as usize);
    let mut covered = vec![false; columns * rows];
    for &x in points {
        let Some(([u, v], _)) = camera.project(x) else { continue };
        let cell = |p: f64, size: usize, n: usize| (p / size as f64 * n as f64).floor();
        let (column, row) = (cell(u, camera.width, columns), cell(v, camera.height, rows));
        if !(0.0..columns as f64).contains(&column) || !(0.0..rows as f64).contains(&row) {
            continue;
        }
        let around = |at: f64, n: usize| (at as usize).saturating_sub(1)..=(at as usize + 1).min(n - 1);
        for y in around(row, rows) {
            around(column, columns).for_each(|x| covered[y * columns + x] = true);
        }
    }
    covered.iter().filter(|c| !**c).count() as f64 / covered.len() as f64
}

/// The times at which moving points are needed.
fn moments(recipe: &Recipe, plan: &TrainContext) -> Result<Vec<f64>> {
    let program = recipe.program()?;
    let mut settings = recipe.init.clone();
    if !program.capabilities(plan).moves || plan.times < 2 {
        return Ok(Vec::new());
    }
    if program.one_time(plan) {
        settings.keyframes = 1;
    }
    Ok(init::keyframes(&program.first(plan), &settings))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Place, recipe};
    use super::super::{TrainOptions, open_run, train};
    use super::*;
    use std::sync::atomic::AtomicBool;

    #[test]
    fn points_are_searched_once_and_stored_with_the_run() {
        let (place, recipe) = (Place::new(), recipe(&["init=auto", "motion=still"]));
        let run = place.run("own");
        let train = || {
            let mut looked = false;
            let mut listen = |e: &Event| {
                looked |= matches!(e, Event::Phase { name, .. } if name == "points from images");
            };
            let options = TrainOptions::default();
            train(place.open(&recipe), recipe.clone(), &run, &options, &AtomicBool::new(false), &mut listen).unwrap();
            std::fs::remove_dir_all(run.join("checkpoints")).unwrap();
            looked
        };
        assert!(train(), "the capture has no points");
        assert!(!train(), "what was found is still there");
        // The file is trusted if it is of the same capture and settings.
        let file = run.join(FILE);
        let text = String::from_utf8_lossy(&std::fs::read(&file).unwrap()).into_owned();
        let mark = text.lines().find(|l| l.starts_with("comment")).unwrap().to_owned();
        let (points, colors) = (vec![[0.1, 0.2, 0.3]; 9], vec![[0.5; 3]; 9]);
        let cloud = PointCloud { points, colors, times: vec![None; 9], left_out: 0 };
        std::fs::write(&file, cloud.to_ply(&mark)).unwrap();
        assert!(!train());
        assert_eq!(open_run(&run).unwrap().1.points, Some(cloud.clone()));
        std::fs::write(&file, cloud.to_ply("comment of another capture")).unwrap();
        assert!(train(), "they are another capture's");
        assert_ne!(open_run(&run).unwrap().1.points, Some(cloud));
    }

    /// Points before every training camera, `side` a row and as many rows, over this share of the image's height.
    fn spread(capture: &Capture, side: usize, height: f64) -> Vec<[f64; 3]> {
        let part = |k: usize| (k as f64 + 0.5) / side as f64;
        let place = |v: &Camera, k: usize| {
            let at = [part(k % side) * v.width as f64, part(k / side) * height * v.height as f64];
            v.unproject(at, 3.0)
        };
        capture.places().flat_map(|v| (0..side * side).map(move |k| place(v, k))).collect()
    }

    #[test]
    fn points_are_searched_for_sparse_or_partial_clouds_but_not_for_cut_out_objects() {
        let place = Place::new();
        let wants = |sets: &[&str], spread: &dyn Fn(&Capture) -> Vec<[f64; 3]>, background: Option<[f32; 3]>| {
            let recipe = recipe(sets);
            let mut capture = Capture::clone(&place.open(&recipe));
            capture.background = background;
            let points = spread(&capture);
            capture.points = Some(PointCloud { points, ..PointCloud::default() }).filter(|p| !p.points.is_empty());
            wanted(&capture, &recipe)
        };
        let first = |n: usize| move |c: &Capture| spread(c, 12, 1.0)[..n].to_vec();
        let all = |c: &Capture| spread(c, 12, 1.0);
        let (auto, white) = (&["init=auto", "num_pts=1000"][..], Some([1.0; 3]));
        assert!(wants(auto, &first(0), None) && wants(auto, &first(49), None));
        assert!(!wants(auto, &all, None) && !wants(auto, &first(0), white));
        // A sky of a third of the image; the cells next to the last points count as theirs.
        assert!(wants(auto, &|c| spread(c, 12, 0.6), None) && !wants(auto, &|c| spread(c, 12, 0.9), None));
        assert!(!wants(auto, &|c| spread(c, 12, 0.6), white));
        assert!(wants(&["init=pictures"], &all, white));
        let others = ["points", "hull", "random", "x.ply"];
        assert!(others.iter().all(|s| !wants(&[&format!("init={s}")], &first(0), None)));
    }

    #[test]
    fn pixels_without_a_near_point_are_uncovered() {
        let place = Place::new();
        let capture = Capture::clone(&place.open(&recipe(&[])));
        let camera = capture.places().next().unwrap();
        let at = |u: f64, v: f64| camera.unproject([u * camera.width as f64, v * camera.height as f64], 2.0);
        assert_eq!(uncovered(camera, &[]), 1.0);
        let cells = (1.0 - uncovered(camera, &[at(0.5, 0.5)])).recip();
        assert!(
            (cells - 16.0 * (16.0 * camera.height as f64 / camera.width as f64).round() / 9.0).abs() < 1e-9,
            "{cells}"
        );
        // In a corner four cells, outside of the image or behind the camera none.
        assert!((1.0 - uncovered(camera, &[at(0.001, 0.001)]) - 4.0 / (9.0 * cells)).abs() < 1e-9);
        let behind = camera.unproject([0.5 * camera.width as f64, 0.5 * camera.height as f64], -2.0);
        assert_eq!(uncovered(camera, &[at(1.2, 0.5), at(0.5, -0.3), behind]), 1.0);
    }
}
