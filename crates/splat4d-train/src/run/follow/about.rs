//! What a run of a followed capture states about itself, and what it refuses: settings, cameras that change.

use super::{Following, RECIPE};
use crate::capture::Capture;
use crate::methods::still;
use crate::path_text::to_text;
use crate::recipe::{MotionName, Recipe};
use crate::run::checkpoint::write_atomically;
use crate::run::identity::file_print;
use crate::run::info::{ELSEWHERE, read_text};
use crate::run::peak_memory;
use crate::{Error, ErrorKind, Result};
use serde_json::{Value, json};
use std::path::Path;

/// The verb that made the run.
const MADE_BY: &str = "train --follow";
/// The motion model of the pages of a playback file, which become the run's scene.
const PLAYED: &str = "spacetime";

impl Following {
    /// Errors: the cameras of a frame are not those of the first one, or it has images of other frames.
    pub(super) fn check_rig(&mut self, capture: &Capture) -> Result<()> {
        let whole = capture.frames.len() == capture.cameras.len() && capture.fixed_cameras();
        if !whole || capture.train.is_empty() {
            return Err(Error::input("its frames cannot be read one by one").at(self.root.display()).remedy(
                "Use at least two fixed cameras, and hold out cameras as a whole (option `hold_out` camera=0).",
            ));
        }
        let rig: String = capture
            .frames
            .iter()
            .map(|f| format!("{} {:?}\n", capture.cameras[f.camera].name, (&f.view.cam_from_world, &f.view.intrinsics)))
            .collect();
        let rig = file_print(rig.as_bytes());
        match &self.rig {
            Some(first) if *first != rig => Err(Error::input("its cameras are not those of the first frame")
                .at(self.root.join("capture.json").display())
                .remedy("Put them back, or follow the capture into another folder.")),
            _ => {
                self.rig = Some(rig);
                Ok(())
            }
        }
    }

    /// Writes what makes the folder a run on the frames that were followed: `recipe.toml` and `run.json`.
    /// `finished`: whether all is done.
    pub fn write_info(&self, seconds: f64, finished: bool) -> Result<()> {
        let frames = self.next - self.first();
        let recipe = self.recipe.clone().with(|r| {
            r.capture.max_frames = frames.max(1);
            r.run.motion = MotionName::of(PLAYED);
        });
        write_atomically(&self.run.join(RECIPE), recipe.to_toml().as_bytes())?;
        let follow = &self.recipe.follow;
        let steps = follow.first_steps + follow.frame_steps * frames.saturating_sub(1);
        let info = json!({
            "version": env!("CARGO_PKG_VERSION"), "made_by": MADE_BY, "capture": to_text(&self.root),
            "capture_name": self.facts["name"], ELSEWHERE: self.facts[ELSEWHERE], "motion": "followed",
            "seed": self.recipe.run.seed, "frames": frames, "iteration": steps, "seconds": seconds,
            "gaussians": self.state.as_ref().map_or(0, |s| s.history.layer.params.len()),
            "finished": finished, "peak_memory": peak_memory(),
        });
        write_atomically(&self.run.join("run.json"), format!("{info:#}\n").as_bytes())
    }
}

/// The file of what is followed.
pub(super) fn read_plan(file: &Path) -> Result<Value> {
    serde_json::from_str(&read_text(file)?).map_err(|e| {
        Error::input(format!("it is not JSON: {e}")).at(file.display()).remedy("Follow the capture into another folder")
    })
}

/// Errors: settings that a followed capture cannot have.
pub(super) fn check(recipe: &Recipe) -> Result<()> {
    recipe.check()?;
    let refined = recipe.refine.any();
    let other = !recipe.run.motion.is_auto() && recipe.run.motion != still::NAME;
    let (what, remedy) = if other && recipe.run.motion != PLAYED {
        (format!("motion `{}`", recipe.run.motion), "Leave option `motion` out: Gaussians move from frame to frame.")
    } else if refined {
        ("cameras that are refined".to_owned(), "Refine them on an earlier capture of the same rig.")
    } else if recipe.capture.observe < 1.0 {
        ("an unobserved future (option `observe`)".to_owned(), "Leave option `observe` out.")
    } else {
        return Ok(());
    };
    Err(Error::new(ErrorKind::Unsupported, format!("a capture cannot be followed with {what}")).remedy(remedy))
}
