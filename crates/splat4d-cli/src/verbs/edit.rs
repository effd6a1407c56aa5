//! `edit`: a list of edits replayed on any scene, and single edits from the command line.

use crate::console::Console;
use splat4d::edit::Step;
use splat4d_workflow::editing::{EditOptions, edit};
use std::path::PathBuf;

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
    let options = EditOptions {
        scene: args.scene.clone(),
        list: args.edits.clone(),
        steps: args.steps(),
        output: args.output.clone(),
        count: args.count.clone(),
        note: args.note.clone(),
        no_provenance: args.no_provenance,
        save: args.save.clone(),
    };
    edit(&options, console)?;
    options.output.iter().for_each(|output| console.next("view", output));
    Ok(())
}
