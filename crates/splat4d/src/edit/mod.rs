//! Edits in time: a list of steps that is replayed on a scene of any motion model.
//!
//! A [`Step`] is plain data: an operation and a selection as text ([`Expr`]). [`replay`] runs the steps in order on the
//! trained scene: leaving a step out undoes it, and the same list works after another training. Nothing here reads a
//! path: the caller provides cameras, masks and other scenes ([`Context`]).

mod act;
mod clock;
mod drag;
mod limits;
mod look;
mod parts;
mod select;
#[cfg(test)]
mod tests;

pub use drag::{DragHandle, DragKey, Dragging};
pub use look::{Selected, mask_fits, select};
pub use select::{Expr, Lasso, Surface, within};

use crate::layers::Scene;
use crate::motion::edited::FadeKey;
use crate::scene::{Camera, Time};
use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// The version of the list of steps that this library reads and writes.
pub(crate) const VERSION: u32 = 1;
/// Most steps: a bound for files.
const MOST_STEPS: usize = 10_000;

/// A list of steps, as in `edits.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edits {
    /// `VERSION`.
    pub version: u32,
    /// Title of the scene that they were made for; none: any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<String>,
    /// The steps, the first first.
    #[serde(default, rename = "edit")]
    pub steps: Vec<Step>,
}

impl Default for Edits {
    fn default() -> Self {
        Self { version: VERSION, scene: None, steps: Vec::new() }
    }
}

impl Edits {
    /// Refuses lists of unsupported versions and those for another scene.
    pub fn check(&self, title: &str) -> Result<()> {
        if self.version != VERSION {
            let what = format!("the edits have version {}, this splat4d supports {VERSION}", self.version);
            return Err(Error::new(ErrorKind::Unsupported, what).remedy("Install a newer splat4d"));
        }
        if let Some(scene) = self.scene.as_ref().filter(|s| *s != title) {
            return Err(Error::input(format!("the edits were made for `{scene}`, this scene is `{title}`"))
                .remedy("Give the scene that they belong to, or remove `scene` from the edits"));
        }
        if self.steps.len() > MOST_STEPS {
            return Err(
                Error::input(format!("{} steps", self.steps.len())).remedy(format!("{MOST_STEPS} are possible"))
            );
        }
        Ok(())
    }
}

/// A similarity as people write it: turned and scaled about a point, then shifted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Place {
    /// Scene units.
    pub shift: [f64; 3],
    /// Axis and degrees, right-handed.
    pub turn: Option<[f64; 4]>,
    /// Scale factor.
    pub scale: Option<f64>,
    /// The fixed point of turning and scaling, scene units; the origin unless stated.
    pub about: Option<[f64; 3]>,
}

/// A position at a time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlaceKey {
    /// Seconds of the scene.
    pub t: f64,
    /// Scene units.
    pub shift: [f64; 3],
    /// Axis and degrees, right-handed.
    pub turn: Option<[f64; 4]>,
    /// Scale factor.
    pub scale: Option<f64>,
    /// Whether the motion eases in and out.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub ease: bool,
}

/// One step. `select` is a selection in words, see [`Expr`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Step {
    /// Deletes them.
    Delete {
        /// What.
        select: String,
    },
    /// Deletes all others.
    Crop {
        /// The selection to keep.
        select: String,
    },
    /// They are not seen for from ≤ t < to.
    Hide {
        /// What.
        select: String,
        /// Seconds.
        from: f64,
        /// Seconds.
        to: f64,
    },
    /// Other colours: saturation, then tint and exposure, then the curve.
    Recolor {
        /// What.
        select: String,
        /// Stops: 1 doubles the brightness.
        #[serde(default)]
        exposure: f64,
        /// Factors of red, green and blue.
        #[serde(default)]
        tint: Option<[f64; 3]>,
        /// 0 is grey, 1 changes nothing.
        #[serde(default)]
        saturation: Option<f64>,
        /// Corners [in, out] of a broken line, 0 to 1; none: no curve.
        #[serde(default)]
        curve: Vec<[f64; 2]>,
    },
    /// Opacity times a factor.
    Opacity {
        /// What.
        select: String,
        /// 0 to 1, at all times.
        #[serde(default)]
        factor: Option<f64>,
        /// Or at key times, along broken lines.
        #[serde(default)]
        keys: Vec<FadeKey>,
    },
    /// Elsewhere, turned, larger: at all times, or by keys over time.
    Move {
        /// What.
        select: String,
        /// The transform, at all times.
        #[serde(default)]
        to: Option<Place>,
        /// Or at key times.
        #[serde(default)]
        keys: Vec<PlaceKey>,
        /// The fixed point of the keys' turning and scaling, scene units.
        #[serde(default)]
        about: Option<[f64; 3]>,
    },
    /// The same again, as layers of another name.
    Duplicate {
        /// What.
        select: String,
        /// Name of the copy.
        name: String,
    },
    /// A layer of their own.
    Split {
        /// What.
        select: String,
        /// Its name.
        name: String,
    },
    /// The clip becomes from..to; Gaussians visible only outside of it are deleted.
    Cut {
        /// Seconds.
        from: f64,
        /// Seconds.
        to: f64,
    },
    /// A part of the clip runs `rate` times as fast, backwards below zero; the rest is shifted in time.
    Retime {
        /// Factor of speed, not zero.
        rate: f64,
        /// Seconds; the clip's start unless stated.
        #[serde(default)]
        from: Option<f64>,
        /// Seconds; the clip's end unless stated.
        #[serde(default)]
        to: Option<f64>,
    },
    /// Another scene next to this one.
    Merge {
        /// File, relative to the list of edits.
        scene: String,
        /// Its layers' names begin with this and a slash.
        name: String,
        /// The second at which its clip starts here; that of its own clock unless stated.
        #[serde(default)]
        at: Option<f64>,
        /// Its placement.
        #[serde(default)]
        to: Place,
    },
    /// Control nodes are pulled by handles over time; everything between follows as rigidly as possible.
    Drag {
        /// The selection to deform.
        select: String,
        /// Second at which the positions below are meant.
        at: f64,
        /// Nodes; 0: those that the model has.
        #[serde(default = "drag::usual_nodes")]
        nodes: usize,
        /// The pulled points and their targets.
        handles: Vec<DragHandle>,
        /// Spheres [x, y, z, radius] whose nodes stay.
        #[serde(default)]
        pins: Vec<[f64; 4]>,
    },
    /// Gaussians that few training views support, and without which held-out views are no worse.
    Floaters {
        /// 0 finds none, 1 the most.
        strength: f64,
    },
}

impl Step {
    /// Its name in files.
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Step::Delete { .. } => "delete",
            Step::Crop { .. } => "crop",
            Step::Hide { .. } => "hide",
            Step::Recolor { .. } => "recolor",
            Step::Opacity { .. } => "opacity",
            Step::Move { .. } => "move",
            Step::Duplicate { .. } => "duplicate",
            Step::Split { .. } => "split",
            Step::Cut { .. } => "cut",
            Step::Retime { .. } => "retime",
            Step::Merge { .. } => "merge",
            Step::Drag { .. } => "drag",
            Step::Floaters { .. } => "floaters",
        }
    }

    /// Its selection, where it has one.
    pub fn selection(&self) -> Option<&str> {
        match self {
            Step::Delete { select }
            | Step::Crop { select }
            | Step::Hide { select, .. }
            | Step::Recolor { select, .. }
            | Step::Opacity { select, .. }
            | Step::Move { select, .. }
            | Step::Duplicate { select, .. }
            | Step::Split { select, .. }
            | Step::Drag { select, .. } => Some(select),
            Step::Cut { .. } | Step::Retime { .. } | Step::Merge { .. } | Step::Floaters { .. } => None,
        }
    }
}

/// A mask image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mask {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Row by row.
    pub white: Vec<bool>,
}

/// Data that edits name and a scene does not contain. The methods of the trait itself have nothing: they return errors.
pub trait Context {
    /// The camera of that name.
    fn camera(&self, name: &str) -> Result<Camera> {
        Err(missing(&format!("camera `{name}`"), "Give a run folder, or a file with cameras"))
    }

    /// The mask image of that name, for images of `camera`: of another size it need not be decoded.
    fn mask(&self, name: &str, _camera: &Camera) -> Result<Mask> {
        Err(missing(&format!("mask `{name}`"), "Give a file that can be read"))
    }

    /// The subject from the masks of a capture: by camera and time.
    fn subject(&self) -> Result<Vec<(Camera, Time, Mask)>> {
        Err(missing("subject", "Give the run of a capture with masks"))
    }

    /// The scene of that name.
    fn scene(&self, name: &str) -> Result<Scene<f32>> {
        Err(missing(&format!("scene `{name}`"), "Give a file that can be read"))
    }

    /// Bytes of memory that are available; `None`: unknown.
    fn memory(&self) -> Option<u64> {
        None
    }

    /// Gaussians of `scene` that float before cameras.
    fn floaters(&self, _scene: &Scene<f32>, _strength: f64) -> Result<Selected> {
        Err(missing("training view", "Give the run folder of a capture that is still there"))
    }

    /// Positions at all `times` of nodes that are at `start` at `times[first]`, `[times][nodes]`: carried by the
    /// Gaussians `among`.
    fn follow(
        &self,
        scene: &Scene<f32>,
        among: &Selected,
        start: &[[f64; 3]],
        times: &[f64],
        first: usize,
    ) -> Result<Vec<Vec<[f64; 3]>>>;
}

fn missing(what: &str, remedy: &str) -> Error {
    Error::input(format!("there is no {what}")).remedy(remedy.to_owned())
}

/// Effect of a step.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Done {
    /// The step's name.
    pub step: &'static str,
    /// Gaussians that it was about.
    pub selected: usize,
    /// Gaussians of the scene after it.
    pub gaussians: usize,
}

/// Runs the steps on a scene, in order. The scene is what is left of it; on an error it is lost, so that callers keep
/// theirs.
///
/// Errors: a step's, with its number and name: selections that cannot be read or select nothing, names that there are
/// not, numbers out of range, numbers that overflow, more Gaussians than memory holds, what a pixel head cannot show.
pub fn replay(
    steps: &[Step],
    scene: Scene<f32>,
    context: &dyn Context,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<(Scene<f32>, Vec<Done>)> {
    replay_after(Vec::new(), steps, scene, context, progress)
}

/// The same, on a scene on which others were run before; their steps are listed first.
///
/// Errors: as [`replay`].
pub fn replay_after(
    mut done: Vec<Done>,
    steps: &[Step],
    mut scene: Scene<f32>,
    context: &dyn Context,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<(Scene<f32>, Vec<Done>)> {
    scene.check_finite()?;
    limits::check_growth(done.len(), steps, &scene, context)?;
    for (i, step) in steps.iter().enumerate() {
        progress(i, steps.len());
        let at = |e: Error| e.at(format!("edit {} ({})", done.len() + 1, step.name()));
        let selected =
            act::run(step, &mut scene, context).and_then(|n| limits::check_sound(&scene).map(|()| n)).map_err(at)?;
        done.push(Done { step: step.name(), selected, gaussians: scene.len() });
    }
    if scene.is_empty() {
        return Err(Error::input("the edits leave nothing of the scene").remedy("Take one of them back"));
    }
    Ok((scene, done))
}

/// How many Gaussians a selection holds, and of them how many can be seen at each of `times`.
pub fn count(expr: &Expr, scene: &Scene<f32>, times: &[f64], context: &dyn Context) -> Result<(usize, Vec<usize>)> {
    let selected = select(expr, scene, context)?;
    let over_time = seen(&selected, scene, times);
    Ok((selected.iter().flatten().filter(|s| **s).count(), over_time))
}

/// Whether a drag of the selected can take the nodes that their model has (`nodes = 0`).
pub fn has_nodes(scene: &Scene<f32>, selected: &Selected) -> bool {
    drag::own_nodes(scene, selected).is_some()
}

/// How many of the selected can be seen at each of `times`.
pub fn seen(selected: &Selected, scene: &Scene<f32>, times: &[f64]) -> Vec<usize> {
    let mut ids = Vec::new();
    let mut alive = |t: f64| {
        let of = |(layer, selected): (&crate::layers::Layer, &Vec<bool>)| {
            let all = layer.active(Time(t), &mut ids);
            let chosen = |i: &&u32| selected[**i as usize];
            if all { selected.iter().filter(|s| **s).count() } else { ids.iter().filter(chosen).count() }
        };
        scene.layers.iter().zip(selected).map(of).sum()
    };
    times.iter().map(|&t| alive(t)).collect()
}
