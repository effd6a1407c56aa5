//! Results of research code, read: Gaussians in a .ply and a network in a file of PyTorch that moves them.
//!
//! | program | network | becomes |
//! |---|---|---|
//! | 4DGaussians (Wu et al. 2024) | `deformation.pth`: feature planes | `hexplane` |
//! | Deformable-3D-Gaussians (Yang et al. 2024) | `deform.pth`: a perceptron | `deform-mlp` |
//! | SC-GS (Huang et al. 2024) | `deform.pth`: control nodes and a perceptron | `warp` |
//!
//! The equations are those of the motion models, so that nothing is sampled: only weights are scaled and reordered. Their
//! clock runs from 0 to 1. Files state no seconds.

mod control_nodes;
mod deform;
mod hexplane;
mod settings;
mod state;
#[cfg(test)]
mod tests;

use super::checkpoint;
use super::dialect::{Opened, Y_DOWN};
use super::ply;
use super::warnings::Warnings;
use crate::layers::{Layer, Scene};
use crate::motion::Motion;
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{LifeKind, Params};
use crate::{Error, ErrorKind, Result};
use settings::Settings;
use state::State;
use std::sync::Arc;

/// Clip of files without seconds.
const UNKNOWN_CLIP: [f64; 2] = [0.0, 1.0];
/// Upwards in Blender's worlds, in which the synthetic captures are.
const BLENDER_UP: [f64; 3] = [0.0, 0.0, 1.0];

/// The files of one training.
#[derive(Clone, Copy)]
struct Trained<'a> {
    /// `point_cloud.ply`.
    gaussians: &'a [u8],
    /// `deformation.pth` or `deform.pth`.
    network: &'a [u8],
    /// `cfg_args`, the settings as Python writes them; empty: the programs' defaults are assumed.
    settings: &'a str,
}

/// Input of a reader.
struct Job<'a> {
    files: Trained<'a>,
    state: State<'a>,
    settings: Settings<'a>,
    clip: [f64; 2],
}

/// Gaussians with the tables of a motion model.
type Moving = (Params, Arc<dyn Motion>);

/// A program: its name, a tensor by which its network is known, and its reader.
struct Program {
    name: &'static str,
    known: &'static str,
    read: fn(&Job<'_>, Params) -> Result<Moving>,
}

/// In the order in which they are tried: SC-GS has the perceptron of Deformable-3D-Gaussians under another name.
const PROGRAMS: [Program; 3] = [
    Program { name: "4DGaussians", known: hexplane::KNOWN, read: hexplane::read },
    Program { name: "SC-GS", known: control_nodes::KNOWN, read: control_nodes::read },
    Program { name: "Deformable-3D-Gaussians", known: deform::KNOWN, read: deform::read },
];

/// Reads what a training left: `gaussians` (`point_cloud.ply`) and the `network` (`deformation.pth`, `deform.pth`) that moves them,
/// with the text of its `cfg_args` (empty: the programs' defaults are assumed). Without `gaussians`, `network` is a checkpoint
/// that holds them. `clip`: first and last second, where these are known.
///
/// Errors: damaged files; networks of other programs, or with parts that are not read (`Unsupported`).
pub fn read(gaussians: &[u8], network: &[u8], settings: &str, clip: Option<[f64; 2]>) -> Result<Opened> {
    if gaussians.is_empty() {
        return checkpoint::open_on(network, clip);
    }
    read_trained(Trained { gaussians, network, settings }, clip)
}

fn read_trained(files: Trained<'_>, clip: Option<[f64; 2]>) -> Result<Opened> {
    let clip = clip.filter(|[from, to]| to > from);
    let state = State::open(files.network)?;
    let Some(program) = PROGRAMS.iter().find(|p| state.shape(p.known).is_some()) else {
        let names = PROGRAMS.map(|p| p.name).join(", ");
        let what = format!("the network is not one that is read; it has {}", state.names());
        return Err(unsupported(what).remedy(format!("Networks of {names} are read. Export a sequence of .ply files.")));
    };
    let mut warnings = Warnings::default();
    let (params, info) = ply::read(files.gaussians)?;
    info.assumed.iter().for_each(|sentence| warnings.add(sentence));
    let settings = Settings(files.settings);
    if files.settings.is_empty() {
        warnings.add(format!("there is no cfg_args: default settings of {} are assumed", program.name));
    }
    if clip.is_none() {
        warnings.add("the files do not state their duration: one second is assumed");
    }
    let up = if settings.is("is_blender", false) { BLENDER_UP } else { Y_DOWN };
    let job = Job { files, state, settings, clip: clip.unwrap_or(UNKNOWN_CLIP) };
    let (params, motion) = (program.read)(&job, params)?;
    let layer = Layer::new(program.name, params, motion, LifeKind::Infinite);
    let scene =
        Scene { layers: vec![layer], clip: job.clip, fps: DEFAULT_FPS, offset: info.offset, ..Scene::default() };
    let opened = Opened { up: Some(up), ..Opened::from((scene, warnings)) };
    Ok(checkpoint::finish(opened))
}

fn unsupported(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::Unsupported, what)
}

/// Refuses settings that change the equations.
fn refuse(settings: &Settings<'_>, program: &str, names: &[&str]) -> Result<()> {
    match names.iter().find(|name| settings.is(name, false)) {
        Some(name) => Err(unsupported(format!("{program} was trained with {name}=True, which is not read"))
            .remedy("Export a sequence of .ply files from the program that trained it.")),
        None => Ok(()),
    }
}
