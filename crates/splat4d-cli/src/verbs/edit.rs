//! `edit`: a list of edits replayed on any scene, and single edits from the command line.

use super::convert;
use crate::baking::title;
use crate::console::Console;
use crate::editing::{self, Bring};
use crate::files::grouped;
use crate::source::{Source, not_empty};
use serde_json::json;
use splat4d::edit::{Context, Edits, Expr, Step, count, replay};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Moments of the clip for which --count prints how many are visible.
const MOMENTS: usize = 5;

const EXAMPLES: &str = "\
Examples:
  splat4d edit runs/take edits.toml -o clean.safetensors     replay a list of edits
  splat4d edit runs/take --count 'box(-1,-1,0, 1,1,2)'       count; nothing is changed
  splat4d edit runs/take --delete 'sphere(0,0,3, 0.5)' -o take.s4d
  splat4d edit runs/take --crop 'box(-2,-2,0, 2,2,2)' --save edits.toml -o take.s4d
  splat4d edit runs/take --floaters 0.5 -o clean.safetensors    PSNR before and after
  splat4d edit runs/take --subject -o subject.s4d            by the capture's masks
  splat4d edit take.s4d --layer 'page 3' -o part.ply         one layer only

A list can also recolour, move by key frames, retime, merge scenes and drag: docs/edit.md. Steps run in order, those of \
options after those of the file. OUT is replaced only if everything succeeds.";

/// Edit a scene in time: select, delete, hide, recolour, move, retime, merge, drag
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run or scene: everything that `convert` reads
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// The list of edits
    #[arg(value_name = "EDITS.toml")]
    edits: Option<PathBuf>,
    /// The file to write; its extension selects the format
    #[arg(short, long, value_name = "OUT", required_unless_present = "count")]
    output: Option<PathBuf>,
    /// Print how many Gaussians a selection contains, over time, and change nothing
    #[arg(long, value_name = "SELECTION", conflicts_with = "output")]
    count: Option<String>,
    /// Delete a selection
    #[arg(long, value_name = "SELECTION")]
    delete: Vec<String>,
    /// Delete all but a selection
    #[arg(long, value_name = "SELECTION")]
    crop: Option<String>,
    /// Delete all but this layer
    #[arg(long, value_name = "NAME")]
    layer: Option<String>,
    /// Delete all but the subject, by the capture's masks
    #[arg(long, conflicts_with = "background")]
    subject: bool,
    /// Delete the subject, by the capture's masks
    #[arg(long)]
    background: bool,
    /// Delete floaters: Gaussians that few views support and held-out ones do not need; strength 0 (none) to 1
    #[arg(long, value_name = "STRENGTH")]
    floaters: Option<f64>,
    /// A note stored in the .s4d, such as who is shown and who may use it
    #[arg(long, value_name = "TEXT")]
    note: Option<String>,
    /// Write no provenance into a .s4d
    #[arg(long, conflicts_with = "note")]
    no_provenance: bool,
    /// Write the list including the steps of these options
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
}

impl Args {
    /// The steps of the options, in the order of the help.
    fn steps(&self) -> Vec<Step> {
        let crop = |select: String| Step::Crop { select };
        let delete = self.delete.iter().map(|s| Step::Delete { select: s.clone() });
        let kept = self.crop.clone().map(crop);
        let layer = self.layer.as_ref().map(|name| crop(format!("layer(\"{name}\")")));
        let subject = self.subject.then(|| crop("subject".into()));
        let background = self.background.then(|| Step::Delete { select: "subject".into() });
        let floaters = self.floaters.map(|strength| Step::Floaters { strength });
        delete.chain(kept).chain(layer).chain(subject).chain(background).chain(floaters).collect()
    }
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    // What cannot be written is better known before the work.
    if let Some(output) = &args.output {
        convert::check_output(output)?;
    }
    let list = args.edits.as_deref().map(editing::read).transpose()?.unwrap_or_default();
    let edits = editing::with_steps(list, args.steps());
    let mut source = Source::open(&args.scene)?.finite();
    not_empty(&source.scene, &args.scene)?;
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    let listed: Vec<&Path> = args.edits.iter().map(PathBuf::as_path).collect();
    for file in args.output.iter().chain(&args.save) {
        // A list may be saved with more steps in its own place.
        let others = if args.save.as_ref() == Some(file) { &[] } else { &listed[..] };
        source.keep(&args.scene, file, others)?;
    }
    let title = title(&source, &args.scene);
    edits.check(&title)?;
    if edits.steps.is_empty() && args.count.is_none() {
        return Err(Error::input("nothing to do")
            .remedy("Give a list of edits, or an option such as --delete; see --help.")
            .into());
    }
    let bring = Bring::new(&source, args.edits.as_deref(), console)?;
    let before = source.scene.len();
    let (scene, done) = replay(&edits.steps, source.scene.clone(), &bring, &mut |done, all| {
        console.phase("editing", done, all);
    })?;
    console.clear();
    for step in &done {
        console.say(&format!("{}: {} Gaussians", step.step, grouped(step.selected)));
    }
    if let Some(text) = &args.count {
        return Ok(tell(text, &scene, &bring, console)?);
    }
    console.say(&format!("{} Gaussians of {} in {} layers", grouped(scene.len()), grouped(before), scene.layers.len()));
    console.emit(&json!({"type": "edited", "before": before, "gaussians": scene.len(), "layers": scene.layers.len(),
        "steps": done}));
    source.scene = scene;
    let earlier = source.provenance.take();
    source.provenance = (!args.no_provenance).then(|| editing::provenance(&source, earlier, &edits, args.note.clone()));
    if let Some(path) = &args.save {
        editing::write(path, &Edits { scene: Some(title), ..edits })?;
        console.written(path);
    }
    let output = args.output.clone().expect("clap asks for an output where nothing is counted");
    convert::write(&convert::Args::plain(args.scene.clone(), output), source, console)
}

/// How many a selection holds, and of them how many can be seen when.
fn tell(text: &str, scene: &splat4d::layers::Scene<f32>, context: &dyn Context, console: &Console) -> Result<()> {
    let [start, end] = scene.clip;
    let mut times: Vec<f64> = (0..MOMENTS).map(|i| start + (end - start) * i as f64 / (MOMENTS - 1) as f64).collect();
    times.dedup();
    let (all, seen) = count(&Expr::parse(text)?, scene, &times, context)?;
    console.clear();
    console.say(&format!("{text}: {} of {} Gaussians", grouped(all), grouped(scene.len())));
    for (t, n) in times.iter().zip(&seen) {
        console.say(&format!("{t:>9.3} s  {} visible", grouped(*n)));
    }
    console.emit(&json!({"type": "count", "selection": text, "gaussians": all, "of": scene.len(),
        "seen": times.iter().zip(&seen).map(|(t, n)| json!([t, n])).collect::<Vec<_>>()}));
    Ok(())
}
