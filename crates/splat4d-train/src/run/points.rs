//! Points that a capture's own pictures show, where it brings too few: found once, kept beside the run as `points.ply`,
//! and from then on the capture's own.

use super::checkpoint::write_atomically;
use super::identity::fingerprint;
use super::open::{OpenCapture, training_frames};
use crate::Result;
use crate::capture::{Capture, PointCloud, read_points};
use crate::event::{Event, Progress};
use crate::init::{self, Source};
use crate::methods::{Plan, program_of};
use crate::recipe::Recipe;
use crate::vision;
use std::path::Path;
use std::sync::Arc;

/// The file beside the run.
const FILE: &str = "points.ply";
/// Of the initial Gaussians: with fewer points of its own, a capture's pictures are searched for more.
const FEW: f64 = 0.05;
/// Of the initial Gaussians, the points that are looked for: what lies between them is laid along surfaces.
const WANTED: f64 = 0.5;

/// The capture with points from its pictures, where it brings too few and the recipe lets them be looked for.
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
    let moments = moments(&plan)?;
    let count = (WANTED * recipe.init.count as f64) as usize;
    let mark = format!("comment of {} {} {count} {moments:?}", fingerprint(capture), env!("CARGO_PKG_VERSION"));
    let kept = std::fs::read(run.join(FILE)).is_ok_and(|bytes| bytes.windows(mark.len()).any(|w| w == mark.as_bytes()));
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
    let own = capture.points.as_ref().map_or(0, |p| p.points.len());
    match recipe.init.source {
        Source::Pictures => true,
        // Objects that are cut out of their background are carved from their masks.
        Source::Auto => capture.background.is_none() && (own as f64) < FEW * recipe.init.count as f64,
        _ => false,
    }
}

/// The moments at which moving points are wanted.
fn moments(plan: &Plan) -> Result<Vec<f64>> {
    let program = program_of(&plan.recipe)?;
    let mut first = program.first(plan);
    if !program.capabilities(plan).moves || plan.times < 2 {
        return Ok(Vec::new());
    }
    if program.one_moment(plan) {
        first.recipe.init.keyframes = 1;
    }
    Ok(init::keyframes(&first))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Place, recipe};
    use super::super::{TrainOptions, open_run, train};
    use super::*;
    use std::sync::atomic::AtomicBool;

    #[test]
    fn points_are_looked_for_once_and_belong_to_the_run() {
        let (place, recipe) = (Place::new(), recipe(&["init=auto", "motion=still"]));
        let run = place.run("own");
        let train = || {
            let mut looked = false;
            let mut listen = |e: &Event| {
                looked |= matches!(e, Event::Phase { name, .. } if name == "points from pictures");
            };
            let options = TrainOptions::default();
            train(place.open(&recipe), recipe.clone(), &run, &options, &AtomicBool::new(false), &mut listen).unwrap();
            std::fs::remove_dir_all(run.join("checkpoints")).unwrap();
            looked
        };
        assert!(train(), "the capture has no points");
        assert!(!train(), "what was found is still there");
        // The file is taken at its word as long as it is of the same capture and wish.
        let file = run.join(FILE);
        let text = String::from_utf8_lossy(&std::fs::read(&file).unwrap()).into_owned();
        let mark = text.lines().find(|l| l.starts_with("comment")).unwrap().to_owned();
        let cloud = PointCloud { points: vec![[0.1, 0.2, 0.3]; 9], colors: vec![[0.5; 3]; 9], times: vec![None; 9] };
        std::fs::write(&file, cloud.to_ply(&mark)).unwrap();
        assert!(!train());
        assert_eq!(open_run(&run).unwrap().1.points, Some(cloud.clone()));
        std::fs::write(&file, cloud.to_ply("comment of another capture")).unwrap();
        assert!(train(), "they are another capture's");
        assert_ne!(open_run(&run).unwrap().1.points, Some(cloud));
    }

    #[test]
    fn only_who_has_few_points_and_no_cut_out_object_is_looked_at() {
        let place = Place::new();
        let wants = |sets: &[&str], points: usize, background: Option<[f32; 3]>| {
            let recipe = recipe(sets);
            let mut capture = Capture::clone(&place.open(&recipe));
            capture.background = background;
            let few = PointCloud { points: vec![[0.0; 3]; points], ..PointCloud::default() };
            capture.points = Some(few).filter(|_| points > 0);
            wanted(&capture, &recipe)
        };
        assert!(wants(&["init=auto", "num_pts=1000"], 0, None) && wants(&["init=auto", "num_pts=1000"], 49, None));
        assert!(!wants(&["init=auto", "num_pts=1000"], 50, None) && !wants(&["init=auto"], 0, Some([1.0; 3])));
        assert!(wants(&["init=pictures"], 5000, Some([1.0; 3])));
        assert!(["points", "hull", "random", "x.ply"].iter().all(|s| !wants(&[&format!("init={s}")], 0, None)));
    }
}
