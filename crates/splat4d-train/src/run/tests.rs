//! Whole runs on a tiny capture on disk: the same bits for any number of threads, after any stop and after a crash;
//! faults that roll back; outputs, memory and checkpoints that are refused.

mod device;
mod observe;
mod on_time;
mod own_loss;

use super::budget::Budget;
use super::checkpoint::write_atomically;
use super::dataset::Dataset;
use super::identity::{identity, recipe_print};
use super::info::read_text;
use super::session::{MAX_STRIKES, ROLLBACK_RATE, Session, restore_newest};
use super::start::TRAIN;
use super::*;
use crate::capture::frames::{Frames, Picture};
use crate::capture::{Capture, ImageStore, Timing};
use crate::event::Event;
use crate::init::Source;
use crate::recipe::{MotionName, Recipe};
use crate::step::tests::Made;
use crate::{ErrorKind, Result};
use serde_json::{Value, json};
use splat4d::format::dialect::WriteOptions;
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::render::{Abilities, Backend, Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Shot};
use splat4d::scene::{Camera, Planes, Table};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tempfile::TempDir;

const SIZE: usize = 24;
const CAMERAS: usize = 4;
const MOMENTS: usize = 3;
const STEPS: usize = 40;

/// Some cameras, the ball as it is at these moments, on disk.
fn capture_on_disk(rig: usize, moments: &[usize]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let made = Made::new(rig, MOMENTS, SIZE);
    let mut picture = Picture::default();
    for i in 0..rig * moments.len() {
        made.load(rig * moments[i / rig] + i % rig, &mut picture).unwrap();
        let path = folder.path().join(format!("images/{}/{:04}.png", i % rig, i / rig));
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let color = |x: u32, y: u32, c: usize| (picture.color.get(c, y as usize, x as usize) * 255.0).round() as u8;
        let pixel = |x: u32, y: u32| image::Rgb([0, 1, 2].map(|c| color(x, y, c)));
        image::RgbImage::from_fn(SIZE as u32, SIZE as u32, pixel).save(path).unwrap();
    }
    let cameras: Vec<Value> = (0..rig)
        .map(|i| {
            let (c, pose) = (made.camera(i), &made.camera(i).cam_from_world);
            let row = |r: usize| {
                let m = pose.rotation[r];
                json!([m[0], m[1], m[2], pose.translation[r]])
            };
            json!({
                "name": format!("cam{i}"), "width": SIZE, "height": SIZE, "fx": c.intrinsics.fx,
                "fy": c.intrinsics.fy, "cx": c.intrinsics.cx, "cy": c.intrinsics.cy,
                "world_to_camera": [row(0), row(1), row(2), [0, 0, 0, 1]], "images": format!("images/{i}/%04d.png"),
            })
        })
        .collect();
    let text = json!({ "version": 1, "fps": 10, "cameras": cameras }).to_string();
    std::fs::write(folder.path().join("capture.json"), text).unwrap();
    folder
}

pub(crate) fn recipe(changes: &[&str]) -> Recipe {
    let mut r = Recipe::default().with(|r| {
        r.run.iterations = STEPS;
        r.init.count = 80;
        r.densify.max_cap = 130;
        r.densify.interval = 6;
        r.densify.from = 6;
        r.densify.until = 30;
        r.run.checkpoint_interval = 10;
        r.init.source = Source::Random;
    });
    changes.iter().for_each(|c| r.set(c).unwrap());
    r
}

/// A folder with the capture and space for runs.
pub(crate) struct Place {
    capture: TempDir,
    runs: TempDir,
}

impl Place {
    pub(crate) fn new() -> Self {
        Self::of(MOMENTS)
    }

    /// Of a longer take: back and forth, so that the ball stays visible.
    pub(crate) fn of(moments: usize) -> Self {
        Self::filmed(CAMERAS, &(0..moments).map(|k| [0, 1, 2, 1][k % 4]).collect::<Vec<_>>())
    }

    /// Of some cameras, the ball as it is at these moments.
    pub(crate) fn filmed(cameras: usize, moments: &[usize]) -> Self {
        Self { capture: capture_on_disk(cameras, moments), runs: tempfile::tempdir().unwrap() }
    }

    pub(crate) fn run(&self, name: &str) -> PathBuf {
        self.runs.path().join(name)
    }

    /// The capture's folder.
    pub(crate) fn source(&self) -> &Path {
        self.capture.path()
    }

    pub(crate) fn open(&self, recipe: &Recipe) -> Arc<Capture> {
        Arc::new(open_capture(self.capture.path(), recipe).unwrap())
    }

    pub(crate) fn train(&self, name: &str, recipe: &Recipe) -> Result<Outcome> {
        let run = self.run(name);
        train(self.open(recipe), recipe.clone(), &run, &TrainOptions::default(), &AtomicBool::new(false), &mut |_| {})
    }

    /// As `train`, with another rendering device and ears.
    fn train_with(
        &self,
        name: &str,
        recipe: &Recipe,
        draw: Box<dyn Backend>,
        stop: &AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Outcome> {
        self.train_on_time(name, recipe, draw, (Stopwatch::start(), None), stop, listen)
    }

    /// As `train_with`, kept to a budget by a clock.
    fn train_on_time(
        &self,
        name: &str,
        recipe: &Recipe,
        draw: Box<dyn Backend>,
        (clock, budget): (Stopwatch, Option<Budget>),
        stop: &AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Outcome> {
        let (run, recipe) = (self.run(name), recipe.resolve());
        let opened = OpenCapture::new(self.open(&recipe), &recipe)?;
        let plan = opened.plan(&recipe);
        let mut trainer = opened.trainer(&recipe, &plan, opened.initial_scene(&recipe, &plan)?)?;
        trainer.set_engine(crate::step::resident::DeviceEngine::new(draw));
        let identity = identity(&opened.capture, &recipe, "");
        let (opened, recipe, run, made_by) = (&opened, &recipe, run.as_path(), TRAIN);
        let session = Session {
            run,
            opened,
            recipe,
            identity,
            made_by,
            estimate: 0,
            snapshots: None,
            clock,
            budget,
            own_loss: false,
            stop,
        };
        let state = session.begin(&trainer, listen)?;
        session.drive(&mut trainer, state, listen)
    }

    pub(crate) fn scene(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.run(name).join("scene.safetensors")).unwrap()
    }

    /// metrics.csv without what depends on the clock.
    fn metrics(&self, name: &str) -> Vec<String> {
        let text = std::fs::read_to_string(self.run(name).join("metrics.csv")).unwrap();
        text.lines().map(|l| l.split(',').take(7).collect::<Vec<_>>().join(",")).collect()
    }
}

fn resume_quietly(run: &Path) -> Result<Outcome> {
    resume(run, &AtomicBool::new(false), &mut |_| {})
}

pub(crate) fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &to.join(entry.file_name()));
        } else {
            std::fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
    }
}

/// The renderer, and something that happens at the n-th image.
struct Meddled<F: FnMut(usize, &mut Image<f32>) + Send> {
    inner: Renderer<f32>,
    drawn: usize,
    meddle: F,
}

fn meddled(meddle: impl FnMut(usize, &mut Image<f32>) + Send + 'static) -> Box<dyn Backend> {
    Box::new(Meddled { inner: Renderer::new(RenderConfig::default()), drawn: 0, meddle })
}

impl<F: FnMut(usize, &mut Image<f32>) + Send> Backend for Meddled<F> {
    fn can(&self, wanted: &Abilities) -> Result<()> {
        self.inner.can(wanted)
    }

    fn render(&mut self, shot: &Shot<'_>, out: &mut Image) -> Result<()> {
        Backend::render(&mut self.inner, shot, out)?;
        self.drawn += 1;
        (self.meddle)(self.drawn, out);
        Ok(())
    }

    fn vjp(
        &mut self,
        shot: &Shot<'_>,
        grads: &ImageGrads<'_>,
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads,
    ) -> Result<()> {
        self.inner.vjp(shot, grads, d_sh, d)
    }

    fn radii(&self) -> &[f32] {
        self.inner.radii()
    }

    fn config(&self) -> &RenderConfig {
        &self.inner.config
    }

    fn name(&self) -> &str {
        "a renderer that something happens to"
    }
}

/// The full model of Spacetime Gaussians; its network learns fast enough to matter in a few steps.
const STG: [&str; 6] =
    ["features=full", "head_lr=0.01", "motion_order=3", "rotation_rate=true", "life=gauss-one", "detach=true"];

/// Recipes that a resume could break: losses with a memory, exposures, both strategies, a reset of opacities, SH steps.
fn recipes() -> Vec<Recipe> {
    vec![
        recipe(&[]),
        recipe(&["lambda_velocity=0.1", "lambda_opacity_life=0.01", "exposure=true", "exposure_lr=0.01"]),
        recipe(&["strategy=adc", "densify_grad_threshold=1e-5", "opacity_reset_interval=8", "batch_size=2"]),
        recipe(&["motion_order=2", "rotation_rate=true", "life=interval", "lambda_velocity=0.1", "strategy=none"]),
        recipe(&["motion=still", "sh_degree=2", "sh_degree_interval=7"]),
        recipe(&["refine.poses=true", "refine.focal=true", "refine.lens=true", "refine.times=true", "batch_size=2"]),
        recipe(&["motion=tracked", "track_feature_lr=0.002", "exposure=true", "exposure_lr=0.01"]),
        recipe(&[&STG[..], &["strategy=adc", "densify_grad_threshold=1e-5"]].concat()),
    ]
}

#[test]
fn cameras_that_are_held_out_do_not_count_for_the_plan() {
    let place = Place::new();
    let fixed = |held: &str| {
        let r = recipe(&[held]);
        plan(&place.open(&r), &r).fixed_cameras
    };
    assert_eq!([fixed("hold_out=none"), fixed("hold_out=camera=0,1")], [CAMERAS, CAMERAS - 2]);
}

/// One whole run on one thread; another is stopped on two threads at a random step and resumed on three.
#[test]
fn neither_threads_nor_a_stop_at_any_step_change_a_byte() {
    let place = Place::new();
    let on = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let [one, two, three] = [1, 2, 3].map(on);
    for (k, recipe) in recipes().iter().enumerate() {
        let (whole, name) = (format!("{k}-whole"), format!("{k}-stopped"));
        one.install(|| place.train(&whole, recipe)).unwrap();
        let at = 1 + Rng::new(8, "stop", k as u64).below(0, (STEPS - 2) * recipe.run.batch_size);
        let stop = Arc::new(AtomicBool::new(false));
        let (flag, steps) = (stop.clone(), at.div_ceil(recipe.run.batch_size));
        let draw = meddled(move |n, _| flag.store(n >= at, Ordering::Relaxed));
        let outcome = two.install(|| place.train_with(&name, recipe, draw, &stop, &mut |_| {})).unwrap();
        assert!(outcome.interrupted && outcome.iteration == steps, "{outcome:?}");
        assert!(!place.run(&name).join("scene.safetensors").exists(), "a stopped run has no scene yet");
        assert!(!three.install(|| resume_quietly(&place.run(&name))).unwrap().interrupted);
        assert!(place.scene(&name) == place.scene(&whole), "recipe {k} stopped after {steps} steps");
        assert_eq!(place.metrics(&name), place.metrics(&whole), "recipe {k} stopped after {steps} steps");
    }
}

#[test]
fn a_killed_run_resumes_from_whatever_is_on_disk() {
    let place = Place::new();
    for (k, recipe) in recipes().iter().enumerate().take(3) {
        let whole = format!("{k}-whole");
        let mut copies = 0;
        let mut listen = |e: &Event| {
            if let Event::Checkpoint { .. } = e {
                let to = place.run(&format!("{k}-{copies}"));
                if place.run(&whole).join("run.json").exists() {
                    copy_folder(&place.run(&whole), &to);
                    copies += 1;
                }
            }
        };
        let (capture, run) = (place.open(recipe), place.run(&whole));
        train(capture, recipe.clone(), &run, &TrainOptions::default(), &AtomicBool::new(false), &mut listen).unwrap();
        assert!(copies >= 3, "{copies}");
        for i in 0..copies {
            let name = format!("{k}-{i}");
            let run = place.run(&name);
            let list = checkpoint::list(&run);
            let newest = std::fs::read(&list[list.len() - 1]).unwrap();
            // A crash in the middle of a write: a stale temporary file. A disk that lost blocks: a newest checkpoint
            // cut short, beyond the sound one.
            std::fs::write(run.join("checkpoints/.00000099.safetensors.123.tmp"), &newest[..newest.len() / 3]).unwrap();
            let mut damaged = newest[..newest.len() / 2].to_vec();
            if i % 2 == 1 {
                // Or one that flipped some bits of its numbers, and nothing of its header.
                damaged = newest.clone();
                (0..40).for_each(|k| damaged[newest.len() - 1 - k * (newest.len() / 80)] ^= 1 << (k % 8));
            }
            std::fs::write(run.join("checkpoints/00000038.safetensors"), &damaged).unwrap();
            let mut warned = 0;
            let stop = AtomicBool::new(false);
            resume(&run, &stop, &mut |e| warned += usize::from(matches!(e, Event::Warning { .. }))).unwrap();
            if i + 1 < copies {
                assert_eq!(warned, 1, "a damaged checkpoint is skipped, and said so");
            }
            assert!(place.scene(&name) == place.scene(&whole), "recipe {k}, crash {i}");
            assert_eq!(place.metrics(&name), place.metrics(&whole), "recipe {k}, crash {i}");
        }
    }
}

#[test]
fn neither_prefetch_nor_image_memory_matters() {
    struct Plain(Arc<Dataset>);
    impl Frames for Plain {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn camera(&self, i: usize) -> &Camera {
            self.0.camera(i)
        }
        fn time(&self, i: usize) -> splat4d::scene::Time {
            self.0.time(i)
        }
        fn rig(&self, i: usize) -> usize {
            self.0.rig(i)
        }
        fn name(&self, i: usize) -> String {
            self.0.name(i)
        }
        fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
            self.0.load(i, out)
        }
    }
    let place = Place::new();
    let plain = recipe(&[]);
    place.train("plain", &plain).unwrap();
    place.train("starved", &recipe(&["image_memory=1"])).unwrap();
    assert!(place.scene("plain") == place.scene("starved"), "the image cache reached a result");
    let r = plain.resolve();
    let opened = OpenCapture::new(place.open(&r), &r).unwrap();
    let plan = opened.plan(&r);
    let mut trainer = opened.trainer(&r, &plan, opened.initial_scene(&r, &plan).unwrap()).unwrap();
    trainer.set_frames(Arc::new(Plain(opened.frames.clone())));
    while !trainer.is_done() {
        trainer.step().unwrap().unwrap();
    }
    let mut bytes = Vec::new();
    splat4d::format::scene::write(trainer.scene(), &mut bytes).unwrap();
    assert!(place.scene("plain") == bytes, "prefetch reached a result");
}

#[test]
fn a_fault_rolls_back_with_smaller_steps_and_names_its_place() {
    let place = Place::new();
    let recipe = recipe(&[]);
    let draw = meddled(|n, image| {
        if n == 17 {
            image.color.data[40] = f32::NAN;
        }
    });
    let mut faults = Vec::new();
    let mut listen = |e: &Event| {
        if let Event::RolledBack { iteration, to, what } = e {
            faults.push((*iteration, *to, what.clone()));
        }
    };
    let outcome = place.train_with("once", &recipe, draw, &AtomicBool::new(false), &mut listen).unwrap();
    assert!(!outcome.interrupted && outcome.iteration == STEPS);
    assert_eq!(faults.len(), 1);
    let (iteration, to, what) = &faults[0];
    assert_eq!((*iteration, *to), (17, 10));
    assert!(what.contains('`') && what.contains("camera cam") && what.contains("frame"), "{what}");
    let info: Value = serde_json::from_str(&read_text(&place.run("once").join("run.json")).unwrap()).unwrap();
    assert_eq!(info["rollbacks"], 1);
    // Half the rates, and they stay so in the checkpoint.
    let opened = OpenCapture::new(place.open(&recipe), &recipe).unwrap();
    let plan = opened.plan(&recipe);
    let mut trainer = opened.trainer(&recipe, &plan, opened.initial_scene(&recipe, &plan).unwrap()).unwrap();
    restore_newest(&place.run("once"), &mut trainer, &identity(&opened.capture, &recipe.resolve(), "")).unwrap();
    assert_eq!((trainer.progress.rate_scale, trainer.progress.strikes), (ROLLBACK_RATE, 1));
    let scene = splat4d::format::scene::read(&place.scene("once")).unwrap();
    assert!(scene.layers.iter().all(|l| l.params.first_non_finite().is_none()));
    let metrics = place.metrics("once");
    let numbers: Vec<usize> = metrics[1..].iter().map(|l| l.split(',').next().unwrap().parse().unwrap()).collect();
    assert!(numbers.windows(2).all(|w| w[0] < w[1]), "no row stands twice: {numbers:?}");
}

#[test]
fn the_third_fault_gives_up() {
    let place = Place::new();
    let draw = meddled(|n, image| {
        if n > 12 {
            image.color.data[7] = f32::INFINITY;
        }
    });
    let mut rolled = 0;
    let mut listen = |e: &Event| rolled += usize::from(matches!(e, Event::RolledBack { .. }));
    let stop = AtomicBool::new(false);
    let error = place.train_with("always", &recipe(&[]), draw, &stop, &mut listen).unwrap_err();
    assert_eq!((error.kind(), rolled), (ErrorKind::Diverged, MAX_STRIKES - 1), "{error}");
    assert!(error.to_string().contains("camera cam"), "{error}");
    assert!(!place.run("always").join("scene.safetensors").exists());
}

#[test]
fn foreign_checkpoints_are_refused_with_a_reason() {
    let place = Place::new();
    let base = recipe(&[]);
    place.train("base", &base).unwrap();
    let copy = |name: &str| {
        copy_folder(&place.run("base"), &place.run(name));
        place.run(name)
    };
    let newest = |run: &Path| checkpoint::list(run).pop().unwrap();
    // Another version, the one before or a later one: the last number called `version` in the header is the
    // checkpoint's own.
    for version in [b'2', b'9'] {
        let run = copy(&format!("version-{version}"));
        let mut bytes = std::fs::read(newest(&run)).unwrap();
        let needle = br#"\"version\":3"#;
        let at = bytes.windows(needle.len()).rposition(|w| w == needle).unwrap();
        bytes[at + needle.len() - 1] = version;
        // A program that changes metadata on purpose leaves the checksums out.
        let key = b"splat4d-crc32";
        let sealed = bytes.windows(key.len()).position(|w| w == key).expect("checkpoints have checksums");
        bytes[sealed] = b'S';
        std::fs::write(newest(&run), &bytes).unwrap();
        let error = resume_quietly(&run).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Unsupported, "{error}");
        let says = format!("version {}, this splat4d continues version 3", char::from(version));
        assert!(error.to_string().contains(&says), "{error}");
        assert!(
            splat4d::format::scene::read(&bytes).is_ok(),
            "its scene can still be rendered and exported, as the error says"
        );
    }
    // Another recipe.
    let run = copy("recipe");
    let other = base.resolve().with(|r| r.rates.feature = 0.004);
    std::fs::write(run.join("recipe.toml"), other.to_toml()).unwrap();
    let error = resume_quietly(&run).unwrap_err().to_string();
    assert!(error.contains("another recipe") && error.contains("start a new run"), "{error}");
    // Settings of memory alone may change.
    let run = copy("memory");
    let other = base.resolve().with(|r| {
        r.run.image_memory = 1 << 20;
        r.run.checkpoint_interval = 7;
    });
    std::fs::write(run.join("recipe.toml"), other.to_toml()).unwrap();
    resume_quietly(&run).unwrap();
    // An older recipe, without tables.
    let run = copy("flat");
    std::fs::write(run.join("recipe.toml"), base.resolve().flat_toml()).unwrap();
    resume_quietly(&run).unwrap();
    // No checkpoint, no run.
    let run = copy("none");
    std::fs::remove_dir_all(run.join("checkpoints")).unwrap();
    assert!(resume_quietly(&run).unwrap_err().to_string().contains("no checkpoint"));
    assert_eq!(resume_quietly(&place.run("nowhere")).unwrap_err().kind(), ErrorKind::Io);
    // Another capture in the same place.
    let path = place.capture.path().join("capture.json");
    let mut capture: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    capture["cameras"][2]["fx"] = json!(21.5);
    std::fs::write(&path, capture.to_string()).unwrap();
    let error = resume_quietly(&copy("capture")).unwrap_err().to_string();
    assert!(error.contains("another capture"), "{error}");
    // A fresh run does not overwrite an old one.
    assert!(place.train("base", &base).unwrap_err().to_string().contains("already holds a run"));
}

#[test]
#[cfg(unix)]
fn unwritable_outputs_and_too_little_memory_are_refused() {
    let place = Place::new();
    let base = recipe(&[]);
    let file = place.run("file");
    std::fs::write(&file, b"x").unwrap();
    // Always through a link in our own folder: a writer that replaced its target would replace the link, no device.
    let full = place.run("full");
    std::os::unix::fs::symlink("/dev/full", &full).unwrap();
    for run in [file.as_path(), full.as_path(), &file.join("below")] {
        let (options, stop) = (TrainOptions::default(), AtomicBool::new(false));
        let error = train(place.open(&base), base.clone(), run, &options, &stop, &mut |_| {}).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Io, "{error}");
        assert!(error.to_string().contains(&run.display().to_string()), "{error}");
    }
    assert_eq!(std::fs::read(&file).unwrap(), b"x");
    let error = write_atomically(&full, b"0123").unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Io, "{error}");
    assert!(full.is_symlink() && !full.metadata().unwrap().is_file(), "a device is never replaced");
    let error = place.train("poor", &recipe(&["memory_limit=100000"])).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Memory, "{error}");
    assert!(error.to_string().contains("max_cap"), "{error}");
    assert!(!place.run("poor").exists(), "nothing half-written");
}

#[test]
fn minutes_fix_a_recipe_that_repeats() {
    let place = Place::new();
    let base = Recipe::default().with(|r| {
        r.init.source = Source::Random;
        r.init.count = 80;
        r.densify.max_cap = 120;
    });
    let options = TrainOptions { minutes: Some(0.005), ..TrainOptions::default() };
    let run = place.run("timed");
    train(place.open(&base), base.clone(), &run, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
    let fixed = Recipe::from_toml(&read_text(&run.join("recipe.toml")).unwrap()).unwrap();
    assert_eq!(fixed.resolve(), fixed, "every schedule is set");
    assert!(fixed.run.iterations >= 50 && fixed.run.iterations != base.run.iterations);
    let schedules = [fixed.densify.from, fixed.densify.until, fixed.densify.interval];
    assert!(schedules.iter().all(|&s| s > 0 && s <= fixed.run.iterations), "{schedules:?}");
    place.train("again", &fixed).unwrap();
    assert!(place.scene("timed") == place.scene("again"));
    for minutes in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = TrainOptions { minutes: Some(minutes), ..TrainOptions::default() };
        let stop = AtomicBool::new(false);
        let run = place.run("bad");
        assert!(train(place.open(&base), base.clone(), &run, &options, &stop, &mut |_| {}).is_err(), "{minutes}");
        assert!(!run.exists());
    }
}

#[test]
fn opaque_captures_get_their_mean_colour_as_background_and_masked_ones_their_own() {
    let (place, recipe) = (Place::new(), recipe(&[]));
    let shown = |capture: Arc<Capture>| {
        let opened = OpenCapture::new(capture, &recipe).unwrap();
        let plan = opened.plan(&recipe);
        let scene = opened.initial_scene(&recipe, &plan).unwrap();
        let background = scene.background;
        assert_eq!(opened.trainer(&recipe, &plan, scene).unwrap().settings.background, background);
        background
    };
    let capture = place.open(&recipe);
    let store = ImageStore::new(capture.clone(), 1 << 20);
    let mean: [f64; 3] = std::array::from_fn(|c| {
        let of = |i: &usize| {
            let color = store.load(*i).unwrap().to_picture().color;
            color.plane(c).iter().map(|v| f64::from(*v)).sum::<f64>() / color.pixels() as f64
        };
        capture.train.iter().map(of).sum::<f64>() / capture.train.len() as f64
    });
    let found = shown(capture.clone());
    // Sixteen images represent all.
    assert!((0..3).all(|c| (f64::from(found[c]) - mean[c]).abs() < 0.02 && mean[c] > 0.05), "{found:?} {mean:?}");
    let told = [0.9, 0.1, 0.4];
    assert_eq!(shown(Arc::new(Capture { background: Some(told), ..Capture::clone(&capture) })), told);
}

#[test]
fn exposure_is_learned_for_rigs_and_photos() {
    let place = Place::new();
    let exposed = |named: bool, changes: &[&str]| {
        let recipe = recipe(changes);
        let capture = Capture { named, ..Capture::clone(&place.open(&recipe)) };
        let opened = OpenCapture::new(Arc::new(capture), &recipe).unwrap();
        let plan = opened.plan(&recipe);
        let scene = opened.initial_scene(&recipe, &plan).unwrap();
        opened.trainer(&recipe, &plan, scene).unwrap().train_state.exposure.is_some()
    };
    let moment = ["exposure=true", "max_frames=1"];
    assert!(exposed(true, &moment) && exposed(false, &["exposure=true"]) && exposed(false, &moment));
    assert!(!exposed(false, &[&moment[..], &["appearance.exposure_single=false"]].concat()));
    assert!(!exposed(true, &["exposure=false"]));
}

/// Cameras that count as photos, whose exposures were brighter and brighter: the run writes what it learnt, and an evaluation shows
/// held-out photos with it.
#[test]
fn photos_are_measured_with_the_exposure_that_was_learnt() {
    use crate::eval::run::{EvalOptions, assess};
    use crate::run::corrected;
    let place = Place::new();
    let recipe = recipe(&["hold_out=camera=1", "max_frames=1"]);
    let capture = Arc::new(Capture { named: false, timing: Timing::Moment, ..Capture::clone(&place.open(&recipe)) });
    let opened = OpenCapture::new(capture.clone(), &recipe).unwrap();
    let plan = opened.plan(&recipe);
    let scene = opened.initial_scene(&recipe, &plan).unwrap();
    let mut trainer = opened.trainer(&recipe, &plan, scene).unwrap();
    let exposure = trainer.train_state.exposure.as_mut().unwrap();
    let key = exposure.key();
    for &camera in exposure.trained().to_vec().iter() {
        exposure.params[key].write(camera, 0, std::array::from_fn::<f32, 12, _>(|k| if k == 9 { 0.1 } else { 0.0 }));
    }
    let folder = place.run("photos");
    std::fs::create_dir_all(&folder).unwrap();
    corrected::write(&folder, &trainer, &capture).unwrap();
    let exposures = corrected::exposures(&capture, &folder).unwrap();
    let held = exposures[capture.held[0]];
    assert!((held[9] - 0.1).abs() < 1e-6 && held[8] == 0.0, "{held:?}");
    // The capture shows what is rendered, in red by a tenth more.
    let store = Arc::new(ImageStore::new(capture.clone(), 1 << 20));
    let red = |exposures_of: Option<PathBuf>| {
        let options = EvalOptions { exposures_of, pictures: true, folder: folder.clone(), ..EvalOptions::default() };
        let scene = trainer.train_state.scene();
        assess(scene, &capture, &store, 7, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
        let image = image::open(folder.join("test/ours_7/renders/00000.png")).unwrap().to_rgb8();
        image.pixels().map(|p| f64::from(p[0]) / 255.0).sum::<f64>() / f64::from(image.width() * image.height())
    };
    let (plain, exposed) = (red(None), red(Some(folder.clone())));
    assert!(plain < 0.85 && (exposed - plain - 0.1).abs() < 0.03, "{plain} {exposed}");
}

#[test]
fn observers_do_not_change_the_bits() {
    let place = Place::new();
    let base = recipe(&["hold_out=camera=0"]);
    place.train("alone", &base).unwrap();
    let run = place.run("watched");
    let options = TrainOptions { snapshots: Some(Duration::ZERO), ..TrainOptions::default() };
    let (mut seen, mut scores) = (Vec::new(), Vec::new());
    let mut listen = |event: &Event| {
        if let Event::Snapshot { iteration, bytes, held_out } = event {
            seen.push((*iteration, bytes.clone()));
            scores.extend(*held_out);
        }
    };
    train(place.open(&base), base.clone(), &run, &options, &AtomicBool::new(false), &mut listen).unwrap();
    assert!(place.scene("alone") == place.scene("watched"), "snapshots must not change a bit of the result");
    assert!(seen.len() >= 2 && seen[0].0 == 1 && seen.last().unwrap().0 == STEPS, "the first and the last are shown");
    assert_eq!(scores.len(), seen.len(), "every snapshot has a held-out score");
    assert!(scores.iter().all(|db| db.is_finite()) && scores.last() > scores.first(), "{scores:?}");
    let last = splat4d::format::playback::read(&seen.last().unwrap().1).unwrap();
    let learnt = splat4d::format::scene::read(&place.scene("watched")).unwrap();
    assert!(last.len() * 10 > learnt.len() * 9 && last.len() <= learnt.len(), "{} of {}", last.len(), learnt.len());
    assert_eq!(last.clip, learnt.clip);
}

#[test]
fn scenes_with_a_head_are_evaluated_with_it_and_not_exported_without() {
    use crate::eval::run::{EvalOptions, evaluate};
    use splat4d::bake::{Options, bake};
    use splat4d::layers::{Head, freeze};
    use splat4d::scene::head::{FURTHER, INPUTS};
    use splat4d::scene::{HeadKeys, Time};
    let place = Place::new();
    let recipe = recipe(&[&STG[..], &["hold_out=camera=0"]].concat());
    let (capture, run) = (place.open(&recipe), place.run("a"));
    let mut warnings = Vec::new();
    let options = TrainOptions { snapshots: Some(Duration::ZERO), ..TrainOptions::default() };
    train(capture.clone(), recipe.clone(), &run, &options, &AtomicBool::new(false), &mut |e| {
        assert!(!matches!(e, Event::Snapshot { .. }));
        if let Event::Warning { message } = e {
            warnings.push(message.clone());
        }
    })
    .unwrap();
    assert!(warnings.len() == 1 && warnings[0].contains("features=none"), "{warnings:?}");
    assert_eq!(Recipe::from_toml(&read_text(&run.join("recipe.toml")).unwrap()).unwrap().appearance.sh_degree, 0);
    let scene = splat4d::format::scene::read(&place.scene("a")).unwrap();
    let (layer, keys) = scene.head_keys().unwrap();
    let params = &scene.layers[layer].params;
    assert_eq!(keys, HeadKeys::of(params).unwrap());
    assert!((0..18).any(|i| params[keys.second].get(i, 0).abs() > 1e-3), "the network has learnt something");
    // Evaluation renders the head: one that is turned up changes the score.
    let mut loud = scene.clone();
    loud.layers[layer].params[keys.second].fill(2.0);
    // Hidden units that the held-out camera wakes, which looks along -x; by chance it may wake none.
    let first = &mut loud.layers[layer].params[keys.first];
    (0..first.rows()).for_each(|i| first.set(i, 0, if i % INPUTS == FURTHER { 1.0 } else { 0.0 }));
    let store = Arc::new(ImageStore::new(capture.clone(), 1 << 20));
    let psnr = |scene: &Scene<f32>, name: &str| {
        let options = EvalOptions { folder: place.run(name), ..EvalOptions::default() };
        let found = evaluate(scene, &capture, &store, 1, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
        found.held("PSNR").unwrap()
    };
    let (with, without) = (psnr(&loud, "with"), psnr(&Scene { head: Head::Identity, ..loud.clone() }, "without"));
    assert!((with - without).abs() > 0.3, "{with:.2} dB, without the head {without:.2} dB");
    for error in [
        bake(&scene, &Options::default(), &mut |_, _| {}).unwrap_err(),
        freeze(&scene, Time(0.1)).unwrap_err(),
        splat4d::format::ply::write_stg(&scene, &WriteOptions::default(), &mut Vec::new()).unwrap_err(),
        splat4d::format::splatv::write(&scene, &WriteOptions::default(), &mut Vec::new()).unwrap_err(),
    ] {
        assert!(error.kind() == ErrorKind::Unsupported && error.to_string().contains("features=none"), "{error}");
    }
    let other = recipe.with(|r| r.run.motion = MotionName::of("hexplane"));
    let error = train(capture, other, &place.run("b"), &TrainOptions::default(), &AtomicBool::new(false), &mut |_| {});
    assert!(error.unwrap_err().to_string().contains("`hexplane` has no features"));
}

#[test]
fn results_report_conditions_and_colour_corrected_psnr() {
    use crate::eval::run::{EvalOptions, Measured, evaluate};
    let place = Place::new();
    let recipe = recipe(&["hold_out=camera=0"]);
    place.train("a", &recipe).unwrap();
    let mut scene = splat4d::format::scene::read(&place.scene("a")).unwrap();
    // The images are opaque, but are declared not to be.
    let open = |background| Arc::new(Capture { background: Some(background), ..(*place.open(&recipe)).clone() });
    let mut measure = |capture: &Arc<Capture>, measured, entry: Option<&str>| {
        let options =
            EvalOptions { folder: place.run("a"), measured, place: entry.map(str::to_owned), ..EvalOptions::default() };
        let store = Arc::new(ImageStore::new(capture.clone(), 1 << 20));
        scene.background = capture.background.unwrap();
        evaluate(&scene, capture, &store, 7, &options, &AtomicBool::new(false), &mut |_| {}).unwrap()
    };
    let (white, black) = (open([1.0; 3]), open([0.0; 3]));
    let own = measure(&white, Measured::Test, None);
    let plain = own.held("PSNR").unwrap();
    assert!(own.held("PSNR-cc").unwrap() > plain, "a run of {STEPS} steps has not learnt its colours");
    // The mean image of the held-out camera, scored by hand where it differs from a frame.
    let store = Arc::new(ImageStore::new(white.clone(), 1 << 20));
    let mut truths = vec![Planes::default(); white.held.len()];
    truths.iter_mut().zip(&white.held).for_each(|(truth, &i)| store.load(i).unwrap().color_into(truth));
    let mean = |p: usize| truths.iter().map(|t| t.data[p]).sum::<f32>() / truths.len() as f32;
    let decibels = truths.iter().map(|truth| {
        let n = truth.pixels();
        let moves = |p: usize| (0..3).any(|c| (truth.data[c * n + p % n] - mean(c * n + p % n)).abs() > 0.05);
        let errors: Vec<f64> =
            (0..3 * n).filter(|&p| moves(p)).map(|p| f64::from(truth.data[p] - mean(p)).powi(2)).collect();
        -10.0 * (errors.iter().sum::<f64>() / errors.len() as f64).log10()
    });
    let still = decibels.sum::<f64>() / truths.len() as f64;
    let found = own.held("PSNR-dynamic-still").expect("the camera is fixed and the scene moves");
    assert!((found - still).abs() < 1e-3, "{found} {still}");
    assert!(
        measure(&black, Measured::Test, Some("test-black")).held("PSNR").unwrap() != plain,
        "another background shows"
    );
    measure(&white, Measured::Train, Some("train"));
    let results: Value = serde_json::from_str(&read_text(&place.run("a").join("results.json")).unwrap()).unwrap();
    for (entry, split, background, views) in [
        (&results["ours_7"], "test", 1.0, 1),
        (&results["test-black"]["ours_7"], "test", 0.0, 1),
        (&results["train"]["ours_7"], "train", 1.0, CAMERAS - 1),
    ] {
        let told = &entry["conditions"];
        assert_eq!((told["split"].as_str(), told["step"].as_u64()), (Some(split), Some(7)));
        assert_eq!(told["background"], json!(vec![background; 3]));
        assert_eq!(told["simd"], json!(splat4d::render::Simd::detect().name()));
        assert_eq!(told["device"], json!("CPU"));
        let cameras = entry["cameras"].as_object().unwrap();
        assert_eq!(cameras.len(), views);
        for camera in cameras.values() {
            assert!(camera["PSNR-cc"].as_f64() >= camera["PSNR"].as_f64() && camera["colour"][2][3].is_number());
        }
    }
    let folder = place.run("a");
    assert!(["test", "test-black", "train"].iter().all(|n| folder.join(n).join("ours_7/renders/00000.png").is_file()));
    let views: Value = serde_json::from_str(&read_text(&folder.join("per_view.json")).unwrap()).unwrap();
    assert!(
        views["ours_7"]["PSNR-cc"]["00002.png"].is_number()
            && views["train"]["ours_7"]["time"]["00008.png"].is_number()
    );
}

#[test]
fn checkpoints_with_flat_recipes_are_read() {
    let recipe = Recipe::from_toml(include_str!("../recipe/tests/flat-changed.toml")).unwrap();
    assert_eq!(recipe_print(&recipe, ""), "c963d9ac12b354b3", "what the code of then made of it");
}
