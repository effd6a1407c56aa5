//! The work behind `compress`: rounds until size and guard are content, the file, scores, comparison and report.

use crate::baking;
use crate::console::Console;
use crate::finish::{self, Measure};
use crate::run_folder::{self, cameras_json};
use crate::source::{Source, not_empty, read_scene};
use crate::{files, interrupt};
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::format::playback::{Meta, PagesDraft, Summary, WriteConfig, write_pages};
use splat4d::layers::Scene;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::{Capture, ImageStore};
use splat4d_train::compress::{self, Compressed, Compression, Job};
use splat4d_train::eval::run::{EvalOptions, Evaluation, assess};
use splat4d_train::recipe::Recipe;
use splat4d_train::train::TrainOptions;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The order's file in the run folder.
pub(crate) const ORDER: &str = "compress.toml";
/// What became of it, for machines and the report.
pub(crate) const REPORT: &str = "compress.json";
/// Times that the guard (or the size) may ask for another round.
const MOST_TRIES: usize = 3;
/// The guard takes back this share of the pruning.
const GENTLER: f64 = 0.5;

/// What the user wants; it lies in [`ORDER`], so that an interrupted compression knows it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Order {
    /// The run that is compressed.
    pub source: PathBuf,
    pub level: u8,
    /// Most dB that training views may lose; 0: no guard.
    pub guard: f64,
    /// Most bytes of the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_bytes: Option<u64>,
    /// Whether settings are the level's own, so that a size may choose others.
    pub free: bool,
    /// Attempts that the guard or the size refused.
    #[serde(default)]
    pub tried: Vec<Tried>,
    pub settings: Compression,
}

/// One attempt.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Tried {
    pub prune: f64,
    pub bytes: u64,
    /// Over training views, dB.
    pub psnr: f64,
}

/// A compression in its folder.
pub(crate) struct Work {
    dir: PathBuf,
    order: Order,
}

impl Work {
    /// A new compression. Errors: the folder cannot be written.
    pub(crate) fn begin(dir: PathBuf, order: Order) -> Result<Self> {
        files::make_folder(&dir)?;
        let work = Self { dir, order };
        work.save()?;
        Ok(work)
    }

    /// The compression in a folder, to continue it. Errors: there is none.
    pub(crate) fn reopen(dir: &Path) -> Result<Self> {
        let path = dir.join(ORDER);
        if !path.is_file() {
            return Err(Error::input("this folder holds no compression")
                .at(dir.display())
                .remedy("Give the folder that `splat4d compress` wrote, or begin anew: splat4d compress RUN."));
        }
        let order: Order = toml::from_str(&files::read_text(&path)?).map_err(|e| {
            Error::input(format!("it is not readable: {}", e.message()))
                .at(path.display())
                .remedy("Begin anew: splat4d compress RUN.")
        })?;
        order.settings.check().map_err(|e| e.at(path.display()))?;
        Ok(Self { dir: dir.to_owned(), order })
    }

    fn save(&self) -> Result<()> {
        let text = toml::to_string(&self.order).expect("an order is plain data");
        files::write(&self.dir.join(ORDER), text.as_bytes())
    }

    /// Compresses until size and guard are content, then measures and reports.
    pub(crate) fn run(mut self, eval: bool, measure: &Measure, console: &Console) -> anyhow::Result<()> {
        let stop = interrupt::flag("stopping: a checkpoint is being saved");
        let source = Source::open(&self.order.source)?;
        not_empty(&source.scene, &self.order.source)?;
        let run = source.run.as_ref().ok_or_else(|| {
            Error::input("is no run: compressing needs the pictures that a scene was trained on")
                .at(self.order.source.display())
                .remedy("Give a run folder, or make a plain file with `splat4d bake`.")
        })?;
        console.phase("reading the capture", 0, 0);
        let (capture, recipe) = run.open_capture()?;
        let original = Original { scene: &source.scene, recipe, capture: Arc::new(capture) };
        let before = if eval { Some(original.scores(console)?) } else { None };
        self.choose_size(&original, console)?;
        let file = loop {
            let compressed = self.compress(&original, &stop, console)?;
            let file = self.write_file(&compressed, console)?;
            let Some(before) = &before else { break file };
            let after = finish::scores(&self.dir, &read_scene(&self.dir.join("scene.safetensors"))?, measure, console)?;
            if !self.refused(before, &after, file.bytes, console)? {
                break file;
            }
        };
        console.clear();
        console.written(&self.dir.join("scene.splat4d"));
        console.emit(&json!({"type": "compressed", "run": self.dir, "bytes": file.bytes}));
        Ok(())
    }

    /// Where the file must stay within a size, the gentlest settings that do.
    fn choose_size(&mut self, original: &Original<'_>, console: &Console) -> anyhow::Result<()> {
        let begun = !splat4d_train::train::checkpoint::list(&self.dir).is_empty() || !self.order.tried.is_empty();
        let Some(most) = self.order.max_bytes.filter(|_| !begun) else { return Ok(()) };
        let settings = self.order.settings.clone();
        let scores = compress::scores(&original.job(&settings), &mut |d, t| console.phase("scoring Gaussians", d, t))?;
        let cameras = compress::cameras(&original.capture);
        let (chosen, trials) = compress::fit(
            original.scene,
            &scores,
            &settings,
            self.order.free,
            &cameras,
            [most, BESIDES],
            &mut |done, total| console.phase("looking for a size", done, total),
        )?;
        console.clear();
        let last = trials.iter().rev().find(|t| t.prune == chosen.prune).expect("what was chosen was tried");
        console.say(&format!(
            "to fit into {}, {:.0} % of the Gaussians are pruned ({} before fine-tuning)",
            files::human_bytes(most),
            100.0 * chosen.prune,
            files::human_bytes(last.bytes)
        ));
        self.order.settings = chosen;
        Ok(self.save()?)
    }

    /// One attempt, or the rest of one.
    fn compress(&self, original: &Original<'_>, stop: &AtomicBool, console: &Console) -> anyhow::Result<Compressed> {
        files::write(&self.dir.join("cameras.json"), &serde_json::to_vec(&cameras_json(&original.capture))?)?;
        let job = original.job(&self.order.settings);
        let options = TrainOptions::default();
        let compressed = compress::compress(&job, &self.dir, &options, stop, &mut |event| console.event(event))?;
        console.clear();
        if compressed.outcome.interrupted {
            let what = format!("compressing was stopped after step {} and saved", compressed.outcome.iteration);
            return Err(Error::new(ErrorKind::Interrupted, what)
                .remedy(format!("Continue with: splat4d compress --resume {}", self.dir.display()))
                .into());
        }
        Ok(compressed)
    }

    /// Writes `scene.splat4d`.
    fn write_file(&self, compressed: &Compressed, console: &Console) -> anyhow::Result<Summary> {
        console.phase("writing", 0, 0);
        let source = Source::open(&self.dir)?;
        let views = source.views()?;
        let (stage, cameras) = (source.stage(&views), baking::distinct(&views));
        let pages = compressed.pages.as_ref().expect("the command's settings have a codec");
        let run = source.run.as_ref().expect("it was opened as a run");
        let antialias = run.recipe().is_ok_and(|r| r.antialias);
        let outline = baking::Outline::of_pages(pages);
        let meta = Meta { title: run.name(), ..baking::meta(&source.scene, &outline, &stage, &cameras) };
        let poster = baking::poster(&source.scene, &stage, antialias);
        let draft = PagesDraft { meta: &meta, ..pages.draft(poster.as_deref()) };
        let config = WriteConfig { depths: self.order.settings.depths, ..WriteConfig::default() };
        let mut bytes = Vec::new();
        let summary = write_pages(&draft, &config, &mut bytes)?;
        files::write(&self.dir.join("scene.splat4d"), &bytes)?;
        Ok(summary)
    }

    /// Whether size or guard want another attempt; then the order is changed, and the folder is ready for it.
    fn refused(
        &mut self,
        before: &Evaluation,
        after: &Evaluation,
        bytes: u64,
        console: &Console,
    ) -> anyhow::Result<bool> {
        let (Some(was), Some(is)) = (before.train("PSNR"), after.train("PSNR")) else { return Ok(false) };
        let settings = &self.order.settings;
        let (loss, prune) = (was - is, settings.prune);
        let lost = self.order.guard > 0.0 && loss > self.order.guard;
        let large = self.order.max_bytes.filter(|most| bytes > *most);
        let gentler = self.order.max_bytes.is_none() && prune > 0.0;
        let next = match large {
            // What is left shrinks as the file must, and a little more.
            Some(most) => 1.0 - (1.0 - prune) * (1.0 - AGAIN_MARGIN) * most as f64 / bytes as f64,
            None if lost && gentler => prune * GENTLER,
            None => prune,
        };
        if lost {
            console.warn(&format!(
                "training views lost {loss:.2} dB, more than the guard allows ({} dB)",
                self.order.guard
            ));
        }
        if next == prune || self.order.tried.len() + 1 >= MOST_TRIES {
            if let Some(most) = large {
                let over = format!("the file has {bytes} bytes, more than {most}");
                return Err(Error::input(over).remedy("Give a smaller --max-mb.").into());
            }
            return Ok(false);
        }
        console.say(&format!("again, with {:.0} % pruned instead of {:.0} %", 100.0 * next, 100.0 * prune));
        self.order.tried.push(Tried { prune, bytes, psnr: is });
        self.order.settings.prune = next;
        run_folder::clear(&self.dir)?;
        self.save()?;
        Ok(true)
    }
}

/// What is compressed.
struct Original<'a> {
    scene: &'a Scene<f32>,
    capture: Arc<Capture>,
    recipe: Recipe,
}

impl Original<'_> {
    fn job<'a>(&'a self, settings: &'a Compression) -> Job<'a> {
        Job { source: self.scene, capture: self.capture.clone(), recipe: &self.recipe, settings }
    }

    /// Its scores, without a trace in its folder.
    fn scores(&self, console: &Console) -> anyhow::Result<Evaluation> {
        let store = ImageStore::new(self.capture.clone(), self.recipe.image_memory as usize);
        let options = EvalOptions { antialias: self.recipe.antialias, pictures: false, ..EvalOptions::default() };
        let scores = assess(self.scene, &self.capture, &store, 0, &options, &mut |event| console.event(event))?;
        console.clear();
        Ok(scores)
    }
}

/// Bytes of a file beside its Gaussians: a poster, cameras, a path.
const BESIDES: u64 = 48 << 10;
/// Room that another attempt leaves below the size.
const AGAIN_MARGIN: f64 = 0.01;
