//! The work behind `compress`: rounds until size limit and quality guard are met, the file, scores, comparison and
//! report.

use crate::activity::Activity;
use crate::adopting::{self, OnCapture};
use crate::baking;
use crate::device::chosen;
use crate::draw::{Channel, Painter, antialias};
use crate::evaluating::{self, Measure};
use crate::events::{Listener, Recorded};
use crate::measure::{SIZE, Side, Subject, What, in_turns, measured_views_of};
use crate::report::compress::{Compressed, Guard, REMOVED, Step, Tried, VIEWS};
use crate::report::pictures;
use crate::run_folder::{self, COMPRESS, ORDER, Origin, Run};
use crate::sound;
use crate::source::{Source, not_empty, read_scene};
use crate::{files, playable, report};
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::device::Device;
use splat4d::format::playback::{Meta, PagesDraft, Summary, WriteConfig, with_extras, write_pages};
use splat4d::layers::Scene;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::{Capture, Frame, ImageStore};
use splat4d_train::compress::{self, Compression, Job, Level};
use splat4d_train::eval::run::{EvalOptions, Scores, assess};
use splat4d_train::event::Event;
use splat4d_train::output::{FolderContent, Input, Mixes, OutputFolder, Request};
use splat4d_train::path_text::in_command;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::{TrainOptions, checkpoint, corrected};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Times that the guard (or the size) may request another round.
const MOST_TRIES: usize = 3;
/// The guard reduces the pruning by this share.
const GENTLER: f64 = 0.5;

/// Settings that the user requested; they are in [`ORDER`], so that an interrupted compression can read them.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CompressJob {
    /// The run that is compressed, or the scene of another program.
    #[serde(with = "splat4d_train::path_text")]
    pub source: PathBuf,
    /// The capture of a scene of another program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on: Option<OnCapture>,
    pub level: u8,
    /// Most dB that training views may lose; 0: no guard.
    pub guard: f64,
    /// Whether the user set the share to prune: then the guard only warns.
    pub asked: bool,
    /// Most bytes of the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_bytes: Option<u64>,
    /// Whether the unpruned scene is trained on for as many steps, to compare with.
    pub unpruned: bool,
    /// Whether settings are the level's own, so that a size may choose others.
    pub free: bool,
    /// Attempts that the guard or the size refused.
    #[serde(default)]
    pub tried: Vec<Tried>,
    pub settings: Compression,
}

/// Default of [`CompressOptions::guard`], dB: less is not seen in a moving image.
pub const GUARD: f64 = 0.5;

/// Options of [`compress()`].
#[derive(Clone, Debug)]
pub struct CompressOptions {
    /// The capture that a scene of another program shows; that scene becomes a run in the output's folder `original`.
    /// `None`: a run is compressed.
    pub on: Option<OnCapture>,
    /// Output folder. `None`: `RUN-compressed`, or `RUN-compressed-2` and so on if it exists.
    pub output: Option<PathBuf>,
    /// Replace the run in the output folder once the new run has begun.
    pub force: bool,
    /// 0: the plain file; 1: quantised and fine-tuned; 2: also pruned and masked, coarser codes, a smaller palette.
    pub level: u8,
    /// Share of the Gaussians to remove, 0 to 0.98. `None`: the level's.
    pub prune: Option<f64>,
    /// Score of Gaussians: change, share, both, opacity, light-gaussian, pup or speedy. `None`: change.
    pub score: Option<String>,
    /// Coarsen and prune until the file has at most this many bytes.
    pub max_bytes: Option<u64>,
    /// Total steps of fine-tuning. `None`: a share of the run's steps, by level.
    pub fine_tune: Option<usize>,
    /// Largest loss of training views, dB; beyond it half as much is pruned, at most twice (with `prune`: only a
    /// warning). 0: no guard.
    pub guard: f64,
    /// Also train the unpruned scene for as many steps, and compare with it.
    pub unpruned: bool,
    /// Settings of the level to change, as `key=value`.
    pub set: Vec<String>,
    /// Evaluate, guard, compare and report.
    pub eval: bool,
    /// Image size (width, height) at which playback is timed.
    pub size: [usize; 2],
    /// Device that renders during fine-tuning; the CPU does the rest.
    pub device: Device,
    /// Options of the evaluation.
    pub measure: Measure,
}

impl Default for CompressOptions {
    fn default() -> Self {
        Self {
            on: None,
            output: None,
            force: false,
            level: 2,
            prune: None,
            score: None,
            max_bytes: None,
            fine_tune: None,
            guard: GUARD,
            unpruned: false,
            set: Vec::new(),
            eval: true,
            size: SIZE,
            device: Device::Auto,
            measure: Measure::default(),
        }
    }
}

impl CompressOptions {
    /// The level's settings, then the options, then every `set`.
    fn settings(&self, iterations: usize) -> Result<Compression> {
        let mut settings = Compression::level(Level::new(self.level)?, iterations);
        if let Some(share) = self.prune {
            if self.level < 2 {
                return Err(Error::input(format!("option `prune` belongs to level 2, not to level {}", self.level))
                    .remedy("Leave option `level` out."));
            }
            settings.prune = share;
        }
        if let Some(steps) = self.fine_tune {
            // As the level shares its own steps.
            let all = settings.steps();
            settings.fine_tune = (settings.fine_tune * steps).checked_div(all).unwrap_or(0);
            settings.quantise = steps - settings.fine_tune;
        }
        if let Some(name) = &self.score {
            settings.set(&format!("spatial={name}")).map_err(|e| e.at("option `score`"))?;
        }
        for assignment in &self.set {
            settings.set(assignment).map_err(|e| e.at("option `set`"))?;
        }
        if !settings.codec {
            return Err(Error::input("`codec` = false is for studies: it makes no file").remedy("Leave it out."));
        }
        Ok(settings)
    }
}

/// Makes a trained run smaller and faster to play: prunes, masks, quantises, fine-tunes, measures before and after.
/// With [`on`](CompressOptions::on), `run` is any scene instead: a file, numbered files, an output folder. Returns the folder of the result, a run with `scene.s4d` and `report.html`.
///
/// Errors: the run is unfinished or its capture has moved; no scene; options that do not fit together; `stop` was raised,
/// after a checkpoint was saved ([`resume`] continues).
///
/// ```no_run
/// use splat4d_workflow::compressing::{CompressOptions, compress};
/// use splat4d_workflow::events::ignore;
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let options = CompressOptions { max_bytes: Some(500_000), ..CompressOptions::default() };
/// let small = compress("runs/knight".as_ref(), &options, &AtomicBool::new(false), &ignore)?;
/// println!("{}", small.join("scene.s4d").display());
/// # Ok(())
/// # }
/// ```
pub fn compress(run: &Path, options: &CompressOptions, stop: &AtomicBool, listener: &dyn Listener) -> Result<PathBuf> {
    options.measure.check()?;
    let work = Work::begin(run, options, listener)?.on(chosen(options.device, DOES, listener)).timed_at(options.size);
    work.run(options.eval, &options.measure, stop, listener)
}

/// What the device does.
const DOES: &str = "fine-tuning";

/// Continues a compression from its newest checkpoint. Of the options only `eval`, `size`, `device` and `measure`
/// count.
///
/// Errors: the folder contains no compression; those of [`compress()`].
pub fn resume(dir: &Path, options: &CompressOptions, stop: &AtomicBool, listener: &dyn Listener) -> Result<PathBuf> {
    options.measure.check()?;
    let work = Work::reopen(dir)?.on(chosen(options.device, DOES, listener)).timed_at(options.size);
    work.run(options.eval, &options.measure, stop, listener)
}

impl CompressJob {
    fn text(&self) -> String {
        toml::to_string(self).expect("an order is plain data")
    }

    /// Reads what [`text`](Self::text) made. Errors: damage; settings out of range.
    pub(crate) fn read(text: &str) -> Result<Self> {
        let order: Self = toml::from_str(text).map_err(|e| {
            Error::input(format!("it is not readable: {}", e.message())).remedy("Start again: splat4d compress RUN.")
        })?;
        order.settings.check()?;
        Ok(order)
    }
}

/// Message for the first Ctrl-C during fine-tuning.
const SAVING: &str = "stopping: a checkpoint is being saved";
/// Name of this verb in an owner's record.
const COMMAND: &str = "compress";

/// Reports whether the stop flag is polled after this event: steps poll it, the start of a stage (scores, baking,
/// masks) does not for seconds.
fn report_polling(event: &Event, kept: &str, console: &dyn Listener) {
    match event {
        Event::Phase { .. } => console.stop_not_polled(kept),
        _ => console.stop_polled(SAVING),
    }
}

/// A compression in its folder.
pub struct Work {
    dir: PathBuf,
    folder: OutputFolder,
    order: CompressJob,
    /// Whether this call began it.
    fresh: bool,
    /// Renders while it is tuned. Not part of the order: it may continue on another device.
    device: Device,
    /// Image size at which playback is timed. Not part of the order: it changes no result.
    size: [usize; 2],
}

impl Work {
    /// A compression of a run, not started yet, or the unfinished one of the same options in the same folder.
    ///
    /// Errors: the run is unfinished; options that do not fit together; the folder cannot be written, or is not to be.
    pub fn begin(source: &Path, options: &CompressOptions, console: &dyn Listener) -> Result<Self> {
        let iterations = match &options.on {
            Some(on) if Run::is(source) => {
                return Err(Error::input("it is a run, which has its own capture")
                    .at(source.display())
                    .remedy(format!("Leave option `capture` {} out.", on.capture.display())));
            }
            Some(on) => on.recipe()?.run.iterations,
            None if !Run::is(source) && source.exists() => {
                return Err(Error::input("not a run: compression needs the images that a scene was trained on")
                    .at(source.display())
                    .remedy("State the capture with option `capture`, or make a plain file with `splat4d bake`."));
            }
            None => trained_steps(source)?,
        };
        let absolute = |path: &Path| std::path::absolute(path).map_err(|e| files::cannot_read(path, e));
        let on = options.on.clone().map(|on| Ok::<_, Error>(OnCapture { capture: absolute(&on.capture)?, ..on }));
        let order = CompressJob {
            source: absolute(source)?,
            on: on.transpose()?,
            level: options.level,
            guard: options.guard,
            max_bytes: options.max_bytes,
            unpruned: options.unpruned,
            asked: options.prune.is_some() || options.set.iter().any(|s| s.trim_start().starts_with("prune")),
            free: options.set.is_empty() && options.fine_tune.is_none(),
            settings: options.settings(iterations)?,
            tried: Vec::new(),
        };
        let dir = options.output.clone().unwrap_or_else(|| {
            let mut name = source.file_name().unwrap_or(OsStr::new("run")).to_owned();
            name.push("-compressed");
            let dir = run_folder::free_folder(&source.with_file_name(name));
            console.result(&format!("the result is written to {}", dir.display()));
            dir
        });
        Self::place(dir, order, options.force)
    }

    fn place(dir: PathBuf, order: CompressJob, force: bool) -> Result<Self> {
        let asked = order.text();
        let origin = if order.on.is_some() { Origin::default() } else { Run::open(&order.source)?.origin() };
        let mut inputs = vec![Input::new(&order.source, if order.on.is_some() { "the scene" } else { "the run" })];
        inputs.extend(origin.inputs());
        inputs.extend(order.on.iter().map(|on| Input::new(&on.capture, "the capture")));
        let request = Request { command: COMMAND, inputs: &inputs, asked: &asked, force, mixes: Mixes::Anything };
        let (folder, found) = OutputFolder::begin(&dir, &request)?;
        if found == FolderContent::Unfinished && dir.join(ORDER).is_file() {
            return Self::opened(&dir, folder);
        }
        let work = Self { dir, folder, order, fresh: true, device: Device::Cpu, size: SIZE };
        work.save()?;
        Ok(work)
    }

    /// The same, tuned on this device.
    pub fn on(self, device: Device) -> Self {
        Self { device, ..self }
    }

    /// The same, with playback timed at this image size (width, height).
    pub fn timed_at(self, size: [usize; 2]) -> Self {
        Self { size, ..self }
    }

    /// The compression in a folder, to continue it. Errors: there is none.
    pub fn reopen(dir: &Path) -> Result<Self> {
        let path = dir.join(ORDER);
        if !path.is_file() {
            return Err(Error::input("this folder contains no compression")
                .at(dir.display())
                .remedy("Give the folder that `splat4d compress` wrote, or start again: splat4d compress RUN."));
        }
        Self::opened(dir, OutputFolder::amend(dir, COMMAND)?)
    }

    fn opened(dir: &Path, folder: OutputFolder) -> Result<Self> {
        let path = dir.join(ORDER);
        let order = CompressJob::read(&files::read_text(&path)?).map_err(|e| e.at(path.display()))?;
        Ok(Self { dir: dir.to_owned(), folder, order, fresh: false, device: Device::Cpu, size: SIZE })
    }

    fn save(&self) -> Result<()> {
        files::write(&self.dir.join(ORDER), self.order.text().as_bytes())
    }

    /// The run that is compressed: of a scene of another program its copy in this folder.
    fn original(&self) -> PathBuf {
        if self.order.on.is_some() { self.dir.join(ORIGINAL) } else { self.order.source.clone() }
    }

    /// Makes a scene of another program a run, where that has not been done.
    fn adopt(&self, console: &dyn Listener) -> Result<()> {
        match &self.order.on {
            Some(on) if !Run::is_finished(&self.original()) => {
                console.phase("reading the scene", 0, 0);
                adopting::adopt(&self.order.source, on, &self.original(), console)
            }
            _ => Ok(()),
        }
    }

    /// Compresses, measures and reports. What fails before the first step leaves nothing behind.
    pub fn run(mut self, eval: bool, measure: &Measure, stop: &AtomicBool, console: &dyn Listener) -> Result<PathBuf> {
        let done = self.work(eval, measure, stop, &Recorded::new(console));
        if done.is_err() && self.fresh && checkpoint::list(&self.dir).is_empty() {
            self.folder.abandon();
        } else if done.is_ok() {
            self.folder.finished();
        } else {
            self.folder.begun();
        }
        done.map(|()| self.dir)
    }

    /// Until size and guard are content.
    fn work(&mut self, eval: bool, measure: &Measure, stop: &AtomicBool, recorded: &Recorded<'_>) -> Result<()> {
        let console: &dyn Listener = recorded;
        console.stop_not_polled(&self.kept());
        self.adopt(console)?;
        let source = Source::open(&self.original())?;
        not_empty(&source.scene, &self.order.source)?;
        source.scene.without_head("a playback file")?;
        let run = source.run.as_ref().expect("a compression begins with a run");
        console.phase("reading the capture", 0, 0);
        let (mut capture, recipe) = run.open_capture()?;
        corrected::apply(&mut capture, &run.path)?;
        let original = Original { scene: &source.scene, recipe, capture: Arc::new(capture), run: &run.path };
        let before = if eval { Some(original.scores(original.scene, stop, console)?) } else { None };
        let shown = before.as_ref().filter(|_| self.order.on.is_some()).and_then(|scores| scores.train("PSNR"));
        if let Some(psnr) = shown.filter(|psnr| *psnr < UNLIKE) {
            console.warn(&format!(
                "training views of the scene have {psnr:.1} dB: its axes, unit or origin are probably not those of the capture. \
                 `splat4d convert --up AXIS` turns a scene"
            ));
        }
        self.choose_size(&original, console)?;
        let (file, after) = loop {
            console.stop_polled(SAVING);
            let compressed = self.compress(&original, stop, console)?;
            console.stop_not_polled(&self.kept());
            let file = self.write_file(&compressed, original.scene, console)?;
            let Some(before) = &before else { break (file, None) };
            let scene = read_scene(&self.dir.join("scene.safetensors"))?;
            let after = evaluating::scores(&self.dir, &scene, measure, stop, console)?;
            if !self.refused(before, &after, file.bytes, console)? {
                break (file, Some(after));
            }
            self.drop_removed()?;
        };
        if after.is_some() {
            self.draw_removed(&original)?;
        }
        self.drop_removed()?;
        if let (Some(before), Some(after)) = (before, after) {
            let compared = self.compare(&source, &original, [&before, &after], stop, recorded)?;
            print_summary(&compared, self.size, console);
            let text = serde_json::to_string_pretty(&compared).expect("results are plain data");
            files::write(&self.dir.join(COMPRESS), text.as_bytes())?;
            evaluating::amend(&self.dir, [("notes".into(), json!(recorded.warnings()))])?;
            console.written(&report::write(&Run::open(&self.dir)?)?);
        }
        console.written(&self.dir.join(playable::FILE));
        if let Some(command) = baking::ladder::again(&playable::ladder(&self.order.source), &self.dir) {
            console.result(&format!("the bitrate ladder of the source is not kept; bake it again: {command}"));
        }
        console.emit(&json!({"type": "compressed", "run": self.dir.to_string_lossy(), "bytes": file.bytes}));
        Ok(())
    }

    /// Message if Ctrl-C ends it.
    fn kept(&self) -> String {
        format!("finished work is kept: splat4d compress --resume {} continues", in_command(&self.dir))
    }

    /// Scores before and after, measured together.
    fn compare(
        &self,
        source: &Source,
        original: &Original<'_>,
        [before, after]: [&Scores; 2],
        stop: &AtomicBool,
        recorded: &Recorded<'_>,
    ) -> Result<Compressed> {
        let console: &dyn Listener = recorded;
        let unpruned = if self.order.unpruned {
            console.stop_polled(SAVING);
            let trained = self.train_unpruned(original, stop, console)?;
            console.stop_not_polled(&self.kept());
            Some(trained)
        } else {
            None
        };
        let smooth = antialias(original.recipe.appearance.antialias);
        let read = |path: &Path| -> Result<Arc<[u8]>> { Ok(files::read(path)?.into()) };
        let file = read(&self.dir.join(playable::FILE))?;
        let plain = playable::of_run(&self.original());
        let plain = if plain.is_file() { Some(read(&plain)?) } else { None };
        let mut subjects = vec![What::Scene(original.scene), What::File(file)];
        subjects.extend(plain.into_iter().map(What::File));
        subjects.extend(unpruned.iter().map(|(scene, _)| What::Scene(scene)));
        let subjects: Vec<Subject<'_>> = subjects.into_iter().map(|what| Subject { what, antialias: smooth }).collect();
        let measured_views = measured_views_of(source, self.size)?;
        let sides =
            in_turns(&subjects, &measured_views, &mut |done, total| console.phase("timing playback", done, total))?;
        console.clear();
        let mut sides = sides.into_iter();
        let mut next = || sides.next().expect("a side for every subject");
        let order = &self.order;
        let loss = before.train("PSNR").zip(after.train("PSNR")).map(|(was, is)| was - is);
        Ok(Compressed {
            source: order.source.clone(),
            level: Some(order.level),
            settings: serde_json::to_value(&order.settings).expect("settings are plain data"),
            before: next().scored(before),
            after: next().scored(after),
            plain: (subjects.len() - usize::from(unpruned.is_some()) > 2).then(&mut next),
            unpruned: unpruned.as_ref().map(|(_, scores)| next().scored(scores)),
            stages: steps(&Run::open(&self.dir)?),
            guard: loss.filter(|_| order.guard > 0.0).map(|loss_db| Guard {
                loss_db,
                limit_db: order.guard,
                passed: loss_db <= order.guard,
            }),
            tried: order.tried.clone(),
            warnings: recorded.warnings(),
            activity: [Activity::of(original.scene), Activity::of(&read_scene(&self.dir.join("scene.safetensors"))?)],
        })
    }

    /// Scenes of what the rounds of pruning removed, in their order; a round without steps may have none.
    fn removed(&self) -> Vec<PathBuf> {
        let named = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with("removed-"));
        let mut files: Vec<PathBuf> =
            std::fs::read_dir(&self.dir).into_iter().flatten().flatten().map(|e| e.path()).filter(named).collect();
        files.sort();
        files
    }

    /// Deletes them: they are as large as the original, and only a compression that was stopped needs them.
    fn drop_removed(&self) -> Result<()> {
        self.removed().iter().try_for_each(|f| std::fs::remove_file(f).map_err(|e| files::cannot_write(f, e)))
    }

    /// Draws the Gaussians that pruning removed, alone on black, in the held-out views that the report shows.
    fn draw_removed(&self, original: &Original<'_>) -> Result<()> {
        let mut all = Scene::default();
        for file in self.removed() {
            let one = read_scene(&file)?;
            let layers = all.layers.into_iter().chain(one.layers.iter().cloned()).collect();
            all = Scene { layers, ..one };
        }
        if all.is_empty() {
            return Ok(());
        }
        let held: Vec<&Frame> = original.capture.held.iter().map(|&i| &original.capture.frames[i]).collect();
        files::make_folder(&self.dir.join(REMOVED))?;
        let mut painter = Painter::new(&all, [0.0; 3], original.recipe.appearance.antialias, false);
        for i in pictures::spread(held.len(), VIEWS) {
            let image = painter.picture(&held[i].view, held[i].time.0, Channel::Color, [0.0, 1.0]);
            files::write(&self.dir.join(REMOVED).join(format!("{i:05}.png")), &image.png())?;
        }
        Ok(())
    }

    /// The original, trained on for as many steps as fine-tuning took, nothing removed and nothing quantised.
    fn train_unpruned(
        &self,
        original: &Original<'_>,
        stop: &AtomicBool,
        console: &dyn Listener,
    ) -> Result<(Scene<f32>, Scores)> {
        let settings = Compression {
            prune: 0.0,
            rounds: 1,
            fine_tune: self.order.settings.steps(),
            codec: false,
            mask_interval: 0,
            ..self.order.settings.clone()
        };
        let folder = self.dir.join(UNPRUNED);
        files::make_folder(&folder)?;
        console.result("training the unpruned scene for as many more steps, to compare");
        let job = original.job(&settings);
        let options = TrainOptions { device: self.device, ..TrainOptions::default() };
        let done = compress::compress(&job, &folder, &options, stop, &mut |event| {
            report_polling(event, &self.kept(), console);
            console.event(event);
        })?;
        console.clear();
        if done.outcome.interrupted {
            return Err(self.interrupted(done.outcome.iteration));
        }
        let scene = read_scene(&folder.join("scene.safetensors"))?;
        let scores = original.scores(&scene, stop, console)?;
        Ok((scene, scores))
    }

    fn interrupted(&self, step: usize) -> Error {
        Error::new(ErrorKind::Interrupted, format!("compressing was stopped after step {step} and saved"))
            .remedy(format!("Continue with: splat4d compress --resume {}", in_command(&self.dir)))
    }

    /// For a size limit, the gentlest settings within it.
    fn choose_size(&mut self, original: &Original<'_>, console: &dyn Listener) -> Result<()> {
        let begun = !checkpoint::list(&self.dir).is_empty() || !self.order.tried.is_empty();
        let Some(most) = self.order.max_bytes.filter(|_| !begun) else { return Ok(()) };
        let sound = sound::of_run(&Run::open(original.run)?).ok().flatten();
        let sound_bytes = sound.map_or(0, |s| s.mp4.len() as u64);
        let settings = self.order.settings.clone();
        let scores = compress::scores(&original.job(&settings), &mut |d, t| console.phase("scoring Gaussians", d, t))?;
        let cameras = compress::cameras(&original.capture);
        let (chosen, trials) = compress::fit(
            original.scene,
            &scores,
            &settings,
            self.order.free,
            &cameras,
            [most, BESIDES + sound_bytes],
            &mut |done, total| console.phase("searching for the size", done, total),
        )?;
        console.clear();
        let last = trials.iter().rev().find(|t| t.prune == chosen.prune).expect("the chosen one was tried");
        console.result(&format!(
            "to fit into {}, {:.0} % of the Gaussians are pruned ({} before fine-tuning)",
            files::human_bytes(most),
            100.0 * chosen.prune,
            files::human_bytes(last.bytes)
        ));
        self.order.settings = chosen;
        self.save()
    }

    /// One attempt, or the rest of one.
    fn compress(
        &self,
        original: &Original<'_>,
        stop: &AtomicBool,
        console: &dyn Listener,
    ) -> Result<compress::Compressed> {
        run_folder::write_cameras(&self.dir, &original.capture)?;
        let job = original.job(&self.order.settings);
        let options = TrainOptions { device: self.device, ..TrainOptions::default() };
        let compressed = compress::compress(&job, &self.dir, &options, stop, &mut |event| {
            run_folder::on_event(&self.folder, event);
            report_polling(event, &self.kept(), console);
            console.event(event);
        })?;
        console.clear();
        if compressed.outcome.interrupted {
            return Err(self.interrupted(compressed.outcome.iteration));
        }
        Ok(compressed)
    }

    /// Writes `scene.s4d`.
    fn write_file(
        &self,
        compressed: &compress::Compressed,
        original: &Scene<f32>,
        console: &dyn Listener,
    ) -> Result<Summary> {
        console.phase("writing", 0, 0);
        let source = Source::open(&self.dir)?;
        let views = source.views()?;
        let (stage, cameras) = (source.stage(&views), baking::distinct(&views));
        let pages = compressed.pages.as_ref().expect("the command's settings have a codec");
        let run = source.run.as_ref().expect("it was opened as a run");
        let antialias = run.recipe().is_ok_and(|r| r.appearance.antialias);
        let outline = baking::Outline::of_pages(pages, original);
        let meta = Meta { title: run.name(), ..baking::meta(&source.scene, &outline, &stage, &cameras) };
        let poster = baking::poster(&source.scene, &stage, antialias);
        let draft = PagesDraft { meta: &meta, ..pages.draft(poster.as_deref()) };
        let config = WriteConfig { depths: self.order.settings.depths, ..WriteConfig::default() };
        let mut bytes = Vec::new();
        let mut summary = write_pages(&draft, &config, &mut bytes)?;
        if source.sound.is_some() {
            bytes = with_extras(&bytes, None, source.sound.as_ref())?;
            summary.bytes = bytes.len() as u64;
        }
        files::write(&self.dir.join(playable::FILE), &bytes)?;
        Ok(summary)
    }

    /// Whether size or guard need another attempt; then the order is changed, and the folder is ready for it.
    fn refused(&mut self, before: &Scores, after: &Scores, bytes: u64, console: &dyn Listener) -> Result<bool> {
        let (Some(was), Some(is)) = (before.train("PSNR"), after.train("PSNR")) else { return Ok(false) };
        let settings = &self.order.settings;
        let (loss, prune) = (was - is, settings.prune);
        let lost = self.order.guard > 0.0 && loss > self.order.guard;
        let large = self.order.max_bytes.filter(|most| bytes > *most);
        let gentler = self.order.max_bytes.is_none() && !self.order.asked && prune > 0.0;
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
                return Err(Error::input(over).remedy("Give a smaller option `max_mb`."));
            }
            return Ok(false);
        }
        console.result(&format!("repeating with {:.0} % pruned instead of {:.0} %", 100.0 * next, 100.0 * prune));
        self.order.tried.push(Tried { prune, bytes, psnr: is });
        self.order.settings.prune = next;
        self.folder.clear()?;
        self.save()?;
        self.adopt(console)?;
        Ok(true)
    }
}

/// Scene that is compressed, with its capture and recipe.
struct Original<'a> {
    scene: &'a Scene<f32>,
    capture: Arc<Capture>,
    recipe: Recipe,
    /// The run that learnt it.
    run: &'a Path,
}

impl Original<'_> {
    fn job<'a>(&'a self, settings: &'a Compression) -> Job<'a> {
        Job { source: self.scene, capture: self.capture.clone(), recipe: &self.recipe, settings, run: Some(self.run) }
    }

    /// The scores of a scene of this capture, without a trace in any folder.
    fn scores(&self, scene: &Scene<f32>, stop: &AtomicBool, console: &dyn Listener) -> Result<Scores> {
        let store = Arc::new(ImageStore::new(self.capture.clone(), self.recipe.run.image_memory as usize));
        let options = EvalOptions {
            antialias: self.recipe.appearance.antialias,
            pictures: false,
            exposures_of: Some(self.run.to_owned()),
            ..EvalOptions::default()
        };
        let scores = assess(scene, &self.capture, &store, 0, &options, stop, &mut |event| console.event(event))?;
        console.clear();
        Ok(scores)
    }
}

/// PSNR of training views below which a scene shows something else than the capture, dB. Our choice: the bundled scene with its axes turned
/// has 8, rendered where it was trained 34.
const UNLIKE: f64 = 15.0;
/// Bytes of a file next to its Gaussians: a poster, cameras, a path.
const BESIDES: u64 = 48 << 10;
/// Margin below the size for another attempt.
const AGAIN_MARGIN: f64 = 0.01;

/// Training steps of a finished run.
fn trained_steps(path: &Path) -> Result<usize> {
    let run = Run::open(path)?;
    if !Run::is_finished(path) {
        return Err(Run::unfinished(path, "the run is unfinished"));
    }
    Ok(run.iteration().or_else(|| run.recipe().ok().map(|r| r.run.iterations)).unwrap_or(1))
}

/// The folder, in that of a compression, of the run that a scene of another program becomes.
const ORIGINAL: &str = "original";

/// The folder, in that of a compression, of the unpruned scene that was trained on.
const UNPRUNED: &str = "unpruned";

/// Name in metrics.csv of the time behind the last stage.
const DONE: &str = "done";

/// Training steps and seconds of each stage, from `metrics.csv`'s rows.
fn steps(run: &Run) -> Vec<Step> {
    let mut out: Vec<Step> = Vec::new();
    let mut before = (0, 0.0);
    for row in &run.metrics {
        // The row of the very last step is behind the last stage.
        if row.stage != DONE && out.last().is_none_or(|s| s.name != row.stage) {
            before = out.iter().fold((0, 0.0), |b, s| (b.0 + s.steps, b.1 + s.seconds));
            out.push(Step { name: row.stage.clone(), ..Step::default() });
        }
        let Some(step) = out.last_mut() else { continue };
        step.steps = row.iteration as usize - before.0;
        step.seconds = row.seconds - before.1;
        step.gaussians = row.gaussians as usize;
    }
    out
}

/// Before and after in a few lines.
fn print_summary(compared: &Compressed, size: [usize; 2], console: &dyn Listener) {
    let fair = compared.fair();
    let name = if compared.unpruned.is_some() { "unpruned, same additional steps" } else { "before" };
    let line = |name: &str, side: &Side| {
        let number = |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
        format!(
            "{name}: {} Gaussians, {} ({} as floats), PSNR {} dB, dynamic regions {} dB, SSIM {}, {:.0} frames/s at \
             {}x{}",
            files::grouped(side.gaussians),
            files::human_bytes(side.bytes),
            files::human_bytes(side.float_bytes),
            number(side.psnr, 2),
            number(side.psnr_dynamic, 2),
            number(side.ssim, 4),
            side.fps,
            size[0],
            size[1],
        )
    };
    console.result(&line(name, fair));
    console.result(&line("after", &compared.after));
    if let Some(times) = compared.smaller() {
        let faster = compared.after.fps / fair.fps;
        // The alternative comes first: the plain file, and not the floats of the run.
        let plain = compared.plain.as_ref().filter(|plain| plain.bytes > 0);
        let plain = plain.map_or_else(String::new, |plain| {
            format!(
                "{:.1} times smaller than the plain playback file, ",
                plain.bytes as f64 / compared.after.bytes as f64
            )
        });
        // Floats are never shipped: their figure is used only without a plain file.
        let smaller = match plain.is_empty() {
            true => format!("{times:.1} times smaller than 32-bit floats, "),
            false => plain,
        };
        console.result(&format!("{smaller}{faster:.2} times as fast"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::events;
    use std::cell::RefCell;

    #[test]
    fn the_start_of_a_stage_may_be_ended_and_its_steps_are_saved() {
        let seen = RefCell::new(Vec::new());
        let listen = |event: &events::Event<'_>| match event {
            events::Event::StopPolled(_) => seen.borrow_mut().push("polled"),
            events::Event::StopNotPolled(kept) => seen.borrow_mut().push(if *kept == "kept" { "ends" } else { "?" }),
            _ => {}
        };
        let scoring = Event::Phase { name: "scoring Gaussians".into(), done: 1, total: 2 };
        for event in [scoring, Event::Warning { message: "a step's".into() }] {
            report_polling(&event, "kept", &listen);
        }
        assert_eq!(*seen.borrow(), ["ends", "polled"]);
    }
}
