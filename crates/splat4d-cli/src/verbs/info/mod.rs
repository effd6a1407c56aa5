//! `info`: what a capture, a run or a file contains, and whether it looks healthy.

use crate::console::Console;
use crate::storage::{self, StorageArgs};
use serde_json::json;
use splat4d::Error;
use splat4d::text::in_line;
use splat4d_train::recipe::Recipe;
use splat4d_workflow::inspecting::{Conformance, InspectOptions, Inspection, conformance, inspect};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  splat4d info my-take            cameras, frames, split, findings, memory estimate
  splat4d info my-take --check    exit code 2 if it does not look healthy, for scripts
  splat4d info my-take --doctor   problems per camera and remedies (writes ./doctor/doctor.html)
  splat4d info runs/knight        recipe, progress, scores
  splat4d info scene.ply --json   Gaussians, SH degree, bounds, opacity and scales, damage
  splat4d info scene.s4d --strict every deviation from the format's specification";

/// Print what a capture, run or file contains, and whether it looks healthy
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// A capture folder, a run, a scene.safetensors, a checkpoint, a .s4d or a 3DGS .ply
    #[arg(value_name = "ANY")]
    path: PathBuf,
    /// Read a capture with images reduced by k
    #[arg(long, value_name = "K")]
    downscale: Option<usize>,
    /// Read a capture with these views held out: camera=0,10 or every=8 or none
    #[arg(long, value_name = "RULE")]
    hold_out: Option<String>,
    /// Read a capture with the images of this folder, such as images_4
    #[arg(long, value_name = "NAME")]
    images: Option<String>,
    /// Read a capture's poses in this convention: opencv, opengl, inverse, transposed or xyzw, or several joined by +
    #[arg(long, value_name = "CONVENTION")]
    poses: Option<String>,
    /// Read a capture with a setting, such as capture.sequence=photos, repeatable
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Check a capture's images and poses, and write doctor.html and doctor.json
    #[arg(long)]
    doctor: bool,
    /// Fail with exit code 2 if it does not look healthy
    #[arg(long)]
    check: bool,
    /// Check a .s4d against the whole specification of the format; fail with exit code 2 if it deviates
    #[arg(long, conflicts_with = "doctor")]
    strict: bool,
    /// Folder of --doctor's output
    #[arg(short, long, value_name = "FOLDER", default_value = "doctor", requires = "doctor")]
    output: PathBuf,
    #[command(flatten)]
    storage: StorageArgs,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    if args.strict {
        return strict(&args.path, console);
    }
    let options = InspectOptions { recipe: recipe(args)?, doctor: args.doctor.then(|| args.output.clone()) };
    let mut found = read(args, &options, console)?;
    let healthy = found.is_healthy();
    if console.json() {
        found.troubles.append(&mut found.listed);
        found.json["healthy"] = json!(healthy);
        found.json["troubles"] = json!(found.troubles);
        console.emit(&found.json);
        return args.verdict(healthy);
    }
    for trouble in &found.troubles {
        found.text += &format!("! {}\n", in_line(trouble));
    }
    let verdict = match (healthy, found.poses_unchecked) {
        (false, _) => "does not look healthy, see above",
        (true, true) => "looks healthy, but whether its poses are right was not checked, see above",
        (true, false) => "looks healthy",
    };
    console.report(&format!("{}{verdict}", found.text), healthy);
    let next = match found.json["type"].as_str() {
        Some("capture") => Some("train"),
        Some("run") if found.json["scene"].is_null() => None,
        Some("run" | "scene" | "playback" | "ply") => Some("view"),
        _ => None,
    };
    next.filter(|_| healthy).iter().for_each(|verb| console.next(verb, &args.path));
    args.verdict(healthy)
}

#[cfg(feature = "storage")]
fn read(args: &Args, options: &InspectOptions, console: &Console) -> anyhow::Result<Inspection> {
    if storage::is_address(&args.path) {
        return Ok(splat4d_workflow::storage::info(&args.path, options, &args.storage.open(), console)?);
    }
    Ok(inspect(&args.path, options, console)?)
}

#[cfg(not(feature = "storage"))]
fn read(args: &Args, options: &InspectOptions, console: &Console) -> anyhow::Result<Inspection> {
    let Args { path, storage: _, .. } = args;
    if storage::is_address(path) { storage::refused() } else { Ok(inspect(path, options, console)?) }
}

/// Prints how a playback file deviates from its specification.
fn strict(path: &Path, console: &Console) -> anyhow::Result<()> {
    let Conformance { version, deviations } = conformance(path)?;
    let conforms = deviations.is_empty();
    let mut text: String = deviations.iter().map(|what| format!("! {}\n", in_line(what))).collect();
    let verdict = if conforms { "conforms" } else { "does not conform" };
    text += &format!("{verdict} to the format, version {}.{}", version[0], version[1]);
    if console.json() {
        console.emit(&json!({
            "type": "playback", "version": version, "conforms": conforms, "deviations": deviations,
        }));
    } else {
        console.report(&text, conforms);
    }
    if conforms {
        return Ok(());
    }
    let remedy = "The deviations are listed above. Readers accept the file; its writer should be corrected.";
    Err(Error::input("deviates from the format's specification").at(path.display()).remedy(remedy).into())
}

/// Options of reading a capture.
fn recipe(args: &Args) -> anyhow::Result<Recipe> {
    let mut recipe = Recipe::default();
    if let Some(k) = args.downscale {
        recipe.set(&format!("downscale={k}"))?;
    }
    if let Some(rule) = &args.hold_out {
        recipe.set(&format!("hold_out={}", toml::Value::String(rule.clone())))?;
    }
    for (setting, value) in [("capture.images", &args.images), ("capture.poses", &args.poses)] {
        if let Some(value) = value {
            recipe.set(&format!("{setting}={}", toml::Value::String(value.clone())))?;
        }
    }
    for assignment in &args.set {
        recipe.set(assignment).map_err(|e| e.at("--set"))?;
    }
    Ok(recipe)
}

impl Args {
    /// Errors: with --check, what does not look healthy.
    fn verdict(&self, healthy: bool) -> anyhow::Result<()> {
        if healthy || !self.check {
            return Ok(());
        }
        let remedy = "The findings are listed above; without --check they do not change the exit code.";
        Err(Error::input("does not look healthy").at(self.path.display()).remedy(remedy).into())
    }
}
