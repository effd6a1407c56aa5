//! The parts of a run, built from the recipe's tables: the method of a motion model, and the plan that methods read.

use super::Recipe;
use crate::init::{self, InitSettings};
use crate::maintenance::{DENSE, FINEST, LEAST, operations};
use crate::methods::{CommonSettings, Method, TrainContext, filtered, methods, own};
use crate::{Error, Result};
use splat4d::motion::{BUILT_IN, MODELS};

/// Makes a program with the settings of a recipe.
type Make = fn(&Recipe) -> Box<dyn Method>;

/// The programs by the names of their models, in the order in which `auto` tries them.
pub(crate) const PROGRAMS: [(&str, Make); 8] = methods!(makers);

impl Recipe {
    /// The program of the recipe's motion model, with the losses over time and the filter that the recipe switches on.
    ///
    /// Errors: `auto` has not chosen yet; features for a model that has none.
    pub fn program(&self) -> Result<Box<dyn Method>> {
        let program = self.program_of(self.run.motion.as_str())?;
        if self.spacetime.has_features() && !program.has_features() {
            return Err(Error::input(format!("motion `{}` has no features", self.run.motion))
                .remedy("Use --motion spacetime, or --set features=none"));
        }
        Ok(filtered::wrap(program, &self.filter, &self.transport))
    }

    /// The program of a built-in motion model with the recipe's settings, or of one from outside
    /// ([`OwnMotion`](crate::methods::OwnMotion)), without a filter.
    pub(crate) fn program_of(&self, motion: &str) -> Result<Box<dyn Method>> {
        if let Some(own) = own::program(motion) {
            return Ok(own);
        }
        if let Some((_, make)) = PROGRAMS.into_iter().find(|(name, _)| *name == motion) {
            return Ok(make(self));
        }
        if BUILT_IN.contains(&motion) {
            return Err(Error::input(format!("`{motion}` cannot be chosen: it wraps another motion model"))
                .remedy("Name the motion to be filtered, and add --set filter=geodesic"));
        }
        Err(Error::input(format!("there is no motion model `{motion}`"))
            .remedy(format!("Use one of: {}", MODELS.join(", "))))
    }

    /// All programs with the recipe's settings, in the order in which `auto` tries them.
    pub(crate) fn programs(&self) -> impl Iterator<Item = (&'static str, Box<dyn Method>)> + '_ {
        PROGRAMS.into_iter().map(|(name, make)| (name, make(self)))
    }

    /// Settings of the initial Gaussians, with their number.
    pub(crate) fn initial(&self) -> InitSettings {
        InitSettings { count: self.initial_count(), ..self.init.clone() }
    }

    /// The number of initial Gaussians; without its largest number of Gaussians, the least that it becomes.
    pub(crate) fn initial_count(&self) -> usize {
        let more = if self.crowd() > 1.0 { self.densify.max_cap - LEAST } else { 0 };
        if self.init.count == 0 { init::COUNT + more / 2 } else { self.init.count }
    }

    /// The size above which a Gaussian is split, extents.
    fn percent_dense(&self) -> f64 {
        match self.adc.percent_dense {
            0.0 => (DENSE / self.crowd()).max(FINEST),
            stated => stated,
        }
    }

    /// The recipe's part of a plan, resolved; the capture's part (extent, clip, times, cameras) is still empty.
    pub fn plan(&self) -> TrainContext {
        let mut r = self.resolve();
        r.adc.percent_dense = r.percent_dense();
        macro_rules! common {
            ($($table:ident: $settings:ty,)*) => {
                CommonSettings {
                    appearance: r.appearance,
                    rates: r.rates,
                    life: r.life,
                    loss: r.loss,
                    $($table: r.$table,)*
                }
            };
        }
        TrainContext {
            seed: r.run.seed,
            iterations: r.run.iterations,
            batch_size: r.run.batch_size,
            half_size_until: r.run.half_size_until,
            device_images: r.run.device_images,
            predicted: r.capture.observe < 1.0,
            shell: r.init.shell_at(),
            common: operations! { tables common {} {} },
            ..TrainContext::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn static_scenes_begin_with_half_of_what_exceeds_the_least() {
        let of = |words: &[&str]| Recipe::of(words).unwrap().resolve().initial_count();
        assert_eq!(of(&["motion=still", "max_cap=150000"]), 70_000);
        assert_eq!(of(&["motion=still"]), init::COUNT, "small captures are tuned for as many");
        assert_eq!(of(&["motion=spacetime", "max_cap=150000"]), init::COUNT);
        assert_eq!(of(&["motion=still", "max_cap=150000", "init.count=700"]), 700);
    }

    #[test]
    fn the_size_that_splits_falls_with_the_number_of_gaussians() {
        let of = |words: &[&str]| Recipe::of(words).unwrap().plan().common.adc.percent_dense;
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(near(of(&["motion=still"]), 0.01) && near(of(&["motion=still", "max_cap=100"]), 0.01));
        assert!(near(of(&["motion=still", "max_cap=150000"]), 0.002));
        assert!(near(of(&["motion=still", "max_cap=5000000"]), 0.001), "not without end");
        assert!(near(of(&["motion=spacetime", "max_cap=150000"]), 0.01));
        assert!(near(of(&["motion=still", "max_cap=150000", "adc.percent_dense=0.03"]), 0.03));
    }
}
