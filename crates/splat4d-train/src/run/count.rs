//! `densify.max_cap = 0`: the number of Gaussians that a capture needs and that its steps can train.
//!
//! An image of a surface resolves as much as its pixels do. Views from other positions show other surfaces, or the same
//! ones closer, so the count follows the pixels of all distinct views. It never falls below the count that small
//! captures are tuned for ([`LEAST`]), and stays below what the steps can settle and the memory can hold.

use super::memory::{available_memory, memory_estimate};
use super::open::OpenCapture;
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::event::Event;
use crate::maintenance::LEAST;
use crate::methods::still;
use crate::recipe::Recipe;
use std::collections::BTreeSet;

/// Pixels of distinct views for one Gaussian. Source: published recipes give a real room 0.2 to 1.2 million Gaussians
/// for four times the pixels of our copy of it, where 150,000 and 300,000 end 1.5 dB above 30,000 after the same
/// processor time (studies/records/2026-11-26-real-size.md).
const PIXELS: f64 = 350.0;
/// The same for a static scene, whose Gaussians cost less to train. Source: a walk with 17 megapixels in four minutes
/// ends at 22.5 dB (SSIM 0.728) with one for 350 pixels and at 23.0 dB (0.762) with one for 120
/// (studies/records/2026-11-27-real-size.md).
const PIXELS_STATIC: f64 = 120.0;
/// Gaussians that one step can settle. Source: the same room in 480 processor seconds: 32 a step end at 27.58 dB (SSIM
/// 0.843), 100 a step at 27.67 dB (0.849), 4 a step at 26.08 dB (0.788).
const BY_STEP: f64 = 45.0;
/// Share of the memory that is free which training may take.
const MEMORY: f64 = 0.7;
/// Images whose masks are read to find the share of the pixels that show the object.
const LOOKED_AT: usize = 8;
/// Two numbers of Gaussians this close are the same.
const CLOSE: usize = 1000;

impl OpenCapture {
    /// The number of Gaussians for a run of this many steps, and the reason.
    ///
    /// Errors: an image cannot be read.
    pub(super) fn needed(&self, recipe: &Recipe, steps: f64) -> Result<(usize, String)> {
        let views = self.distinct_views();
        let share = self.foreground()?;
        let pixels = share * views.iter().map(|&i| self.pixels(i)).sum::<f64>();
        let (needed, scale) = (pixels / each(recipe), recipe.densify.count_scale);
        let count = number(needed, steps, scale);
        let of = if share < 1.0 { " of the object" } else { "" };
        let mut why = format!("{} distinct views show {:.2} megapixels{of}", views.len(), pixels / 1e6);
        if count < number(needed, f64::INFINITY, scale) {
            why += &format!(", and {steps} steps cannot train more");
        }
        let limit = match recipe.run.memory_limit {
            0 => available_memory().map_or(u64::MAX, |free| (MEMORY * free as f64) as u64),
            limit => limit,
        };
        let fits = |count: usize| {
            let recipe = recipe.clone().with(|r| r.densify.max_cap = count).resolve();
            memory_estimate(&self.capture, &recipe) <= limit
        };
        if fits(count) {
            return Ok((count, why));
        }
        // What does not fit with the fewest is refused, or tried, as if the recipe had stated them.
        let (mut low, mut high) = (CLOSE.min(count), count);
        while high - low > CLOSE {
            let middle = low.midpoint(high);
            if fits(middle) { low = middle } else { high = middle }
        }
        Ok((rounded(low as f64), format!("{why}, and {} MiB of memory do not hold more", limit >> 20)))
    }

    /// The recipe with a number of Gaussians for its steps if it states none; listeners learn which and why.
    pub(super) fn counted(&self, recipe: Recipe, listen: &mut dyn FnMut(&Event)) -> Result<Recipe> {
        if recipe.densify.max_cap > 0 {
            return Ok(recipe);
        }
        let (gaussians, why) = self.needed(&recipe, recipe.run.iterations as f64)?;
        listen(&Event::Counted { gaussians, why });
        Ok(recipe.with(|r| r.densify.max_cap = gaussians))
    }

    /// One training frame of each view: a fixed camera has one view, a moving one as many as it has frames.
    fn distinct_views(&self) -> Vec<usize> {
        let c = &self.capture;
        let mut fixed = BTreeSet::new();
        c.train
            .iter()
            .copied()
            .filter(|&i| !c.cameras[c.frames[i].camera].fixed || fixed.insert(c.frames[i].camera))
            .collect()
    }

    fn pixels(&self, frame: usize) -> f64 {
        let view = &self.capture.frames[frame].view;
        (view.width * view.height) as f64
    }

    /// The share of the pixels that masks keep; 1 without masks.
    fn foreground(&self) -> Result<f64> {
        let (mut kept, mut all, mut picture) = (0.0, 0.0, Picture::default());
        if !self.frames.has_masks() {
            return Ok(1.0);
        }
        let looks = self.frames.len().min(LOOKED_AT);
        for k in 0..looks {
            self.frames.load(k * self.frames.len() / looks, &mut picture)?;
            let Some(mask) = &picture.mask else { continue };
            kept += mask.data.iter().map(|m| f64::from(*m)).sum::<f64>();
            all += mask.data.len() as f64;
        }
        Ok(if all > 0.0 { kept / all } else { 1.0 })
    }
}

/// The most Gaussians, up to `most`, that the steps which fit a time can settle. `steps` returns how many steps fit
/// with a number of Gaussians; `scale` is the recipe's `count_scale`.
pub(super) fn settled(most: usize, scale: f64, steps: impl Fn(usize) -> Result<usize>) -> Result<usize> {
    let settles = |count: usize| steps(count).map(|n| BY_STEP * n as f64 >= count as f64);
    if settles(most)? {
        return Ok(most);
    }
    let (mut low, mut high) = (fewest(scale).min(most), most);
    while high - low > CLOSE {
        let middle = low.midpoint(high);
        if settles(middle)? { low = middle } else { high = middle }
    }
    Ok(rounded(low as f64))
}

/// Pixels of distinct views for one Gaussian.
fn each(recipe: &Recipe) -> f64 {
    if recipe.run.motion == still::NAME { PIXELS_STATIC } else { PIXELS }
}

/// The number of Gaussians for those that distinct views need, and steps.
fn number(needed: f64, steps: f64, scale: f64) -> usize {
    rounded((scale * needed).min(BY_STEP * steps)).max(fewest(scale))
}

/// The fewest that a capture's number becomes when memory suffices.
fn fewest(scale: f64) -> usize {
    ((scale * LEAST as f64) as usize).max(1)
}

/// To thousands where it is large: smaller digits do not matter.
fn rounded(count: f64) -> usize {
    if count >= 10_000.0 { 1000 * (count / 1000.0) as usize } else { count as usize }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::tests::{Place, recipe};

    #[test]
    fn the_number_follows_pixels_steps_and_scale() {
        // Fourteen cameras of 400x300; a room of 256 photos of 800x533; a walk of 600 photos of 4 megapixels.
        let [toy, room, walk] = [14.0 * 120e3, 256.0 * 426.4e3, 600.0 * 4e6].map(|pixels| pixels / PIXELS);
        assert_eq!(number(toy, 7000.0, 1.0), LEAST);
        assert_eq!(number(toy, 100.0, 1.0), LEAST, "few steps are no reason for fewer");
        assert_eq!(number(toy, 7000.0, 0.5), LEAST / 2);
        assert!((300_000..320_000).contains(&number(room, 7000.0, 1.0)));
        assert_eq!(number(room, 1000.0, 1.0), 45_000);
        assert_eq!(number(walk, 7000.0, 1.0), 315_000);
        assert_eq!(number(walk, 20_000.0, 2.0), 900_000);
        // 132 frames of 480x270: the walk that is static, and one in which something moves.
        let of = |motion: &str| number(132.0 * 129.6e3 / each(&recipe(&[&format!("motion={motion}")])), 7000.0, 1.0);
        assert_eq!([of("still"), of("spacetime")], [142_000, 48_000]);
    }

    #[test]
    fn the_count_that_fits_the_minutes_converges() {
        // Steps cost in proportion to the Gaussians: 900 M of both fit.
        let steps = |count: usize| Ok(900_000_000 / count);
        let count = settled(500_000, 1.0, steps).unwrap();
        let balance = (900e6 * BY_STEP).sqrt();
        assert!((count as f64 - balance).abs() < 2.0 * CLOSE as f64, "{count} of {balance}");
        assert_eq!(settled(100_000, 1.0, steps).unwrap(), 100_000);
        assert_eq!(settled(500_000, 1.0, |_| Ok(1)).unwrap(), LEAST);
    }

    #[test]
    fn a_stated_number_stays_and_memory_bounds_the_rest() {
        let place = Place::new();
        let needed = |words: &[&str]| {
            let r = recipe(&[&["densify.max_cap=0"], words].concat());
            let opened = OpenCapture::new(place.open(&r), &r).unwrap();
            let (count, why) = opened.needed(&r, 7000.0).unwrap();
            (count, why, memory_estimate(&opened.capture, &r.with(|r| r.densify.max_cap = count).resolve()))
        };
        let (count, why, memory) = needed(&["densify.count_scale=4"]);
        assert!(count == 4 * LEAST && why.contains("distinct views"), "{count}: {why}");
        let limit = memory * 3 / 4;
        let (count, why, less) = needed(&["densify.count_scale=4", &format!("run.memory_limit={limit}")]);
        assert!(count < 4 * LEAST && why.contains("memory"), "{count}: {why}");
        assert!(less <= limit, "{less} of {limit}");
        let stated = recipe(&["densify.max_cap=77"]);
        let opened = OpenCapture::new(place.open(&stated), &stated).unwrap();
        assert_eq!(opened.counted(stated, &mut |_| panic!("nothing was chosen")).unwrap().densify.max_cap, 77);
    }
}
