//! Whether a scene gets a far shell: decided once from points and images before training, and stated in the recipe.

use super::open::OpenCapture;
use crate::Result;
use crate::event::Event;
use crate::init::FarShell;
use crate::init::sky::{SHORTEST_SIDE, Sky};
use crate::maintenance::Strategy;
use crate::recipe::Recipe;

/// Distance of a shell that is requested where nothing measures it, extents: the rays of two cameras to one of its
/// Gaussians are at most two degrees apart.
const DISTANCE: f64 = 50.0;

/// The recipe with the decision and the distance; listeners learn both, and why.
///
/// Errors: an image cannot be read.
pub(super) fn decided(opened: &OpenCapture, recipe: Recipe, listen: &mut dyn FnMut(&Event)) -> Result<Recipe> {
    let (asked, stated) = (recipe.init.shell, recipe.init.shell_distance);
    if asked == FarShell::Off {
        return Ok(recipe);
    }
    if let Some(why) = impossible(opened, &recipe)? {
        if asked == FarShell::On {
            listen(&Event::Warning { message: format!("there is no far shell (init.shell): {why}") });
            return Ok(recipe.with(|r| r.init.shell = FarShell::Off));
        }
        return Ok(recipe);
    }
    let large = opened.capture.places().any(|v| v.width.max(v.height) >= SHORTEST_SIDE);
    if (asked, stated > 0.0) == (FarShell::On, true) || asked == FarShell::Auto && !large {
        return Ok(recipe);
    }
    listen(&Event::Phase { name: "far surroundings".into(), done: 0, total: 0 });
    let plan = opened.plan(&recipe);
    let cloud = opened.capture.points.as_ref();
    let still = |(x, t): (&[f64; 3], &Option<f64>)| t.is_none().then_some(*x);
    let points: Vec<[f64; 3]> =
        cloud.map(|c| c.points.iter().zip(&c.times).filter_map(still).collect()).unwrap_or_default();
    let mut sky = Sky::open(opened.frames.as_ref(), &points, plan.center, plan.extent)?;
    let evidence = sky.fit();
    let [near, far] = evidence.errors;
    let measured = format!(
        "{:.0} % of the images has no near points; there they differ by {far:.3} at a far distance, by {near:.3} at a \
         near one",
        100.0 * evidence.open
    );
    let distance = match (stated > 0.0, evidence.is_far()) {
        (true, _) => stated,
        (false, true) => sky.radius / plan.extent,
        (false, false) => DISTANCE * sky.unit / plan.extent,
    };
    let on = asked == FarShell::On || evidence.is_far();
    if on || evidence.is_open() {
        listen(&Event::Shell { distance: on.then_some(distance * plan.extent), why: measured });
    }
    Ok(recipe.with(|r| {
        if on {
            (r.init.shell, r.init.shell_distance) = (FarShell::On, distance);
        }
    }))
}

/// Why this run cannot have one.
fn impossible(opened: &OpenCapture, recipe: &Recipe) -> Result<Option<&'static str>> {
    let reasons = [
        (opened.capture.background.is_some(), "images are cut out of their background"),
        (!recipe.program()?.allows_layers(), "the motion model trains one layer"),
        (
            recipe.densify.strategy == Strategy::Mcmc,
            "densify.strategy = mcmc moves and shrinks Gaussians by the extent",
        ),
        (recipe.spacetime.has_features(), "a network makes the colours"),
    ];
    Ok(reasons.into_iter().find(|(is, _)| *is).map(|(_, why)| why))
}

#[cfg(test)]
mod tests;
