//! Files within their bytes and their time, of the worst model there is.

use super::*;
use crate::events::ignore;
use splat4d::layers::Layer;
use splat4d::math::Rng;
use splat4d::motion::still::activate;
use splat4d::motion::{At, Cache, Motion, Spec, Tape, fill_rows};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Grads, LifeKind, Params, SH, SplatGrads};
use splat4d_train::run::Stopwatch;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

const FPS: f64 = 30.0;
const GAUSSIANS: usize = 150;
const FRAMES: f64 = 40.0;

/// In every frame every Gaussian is somewhere else, and each look at one takes `cost` microseconds of a clock of its
/// own.
#[derive(Clone, Default)]
struct Leaps {
    clock: Arc<AtomicU64>,
    cost: u64,
}

impl Leaps {
    fn stopwatch(&self) -> Stopwatch {
        let clock = self.clock.clone();
        Stopwatch::of(move || clock.load(Ordering::Relaxed) as f64 * 1e-6)
    }
}

impl Motion<f32> for Leaps {
    fn spec(&self) -> Spec {
        Spec::Custom("leaps".into())
    }

    fn scratch_bytes(&self, _p: &Params<f32>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, f32>, _cache: &Cache, tape: &mut Tape<f32>) {
        tape.start(q.len());
        self.clock.fetch_add(self.cost * q.len() as u64, Ordering::Relaxed);
        let frame = (q.t.0 * FPS).round() as u64;
        fill_rows(&mut tape.out, q.rows, |id| {
            let rng = Rng::new(4, "leap", id as u64 * 1000 + frame);
            let mut row = q.p[GEOMETRY].read::<11>(id, 0);
            (0..3).for_each(|k| row[k] += 0.3 * rng.normal(k as u64) as f32);
            activate(row)
        });
    }

    fn backward(
        &self,
        _q: &At<'_, f32>,
        _cache: &Cache,
        _tape: &mut Tape<f32>,
        _d_out: &SplatGrads<'_, f32>,
        _d_cache: &mut Cache,
        _d: &mut Grads<f32>,
    ) -> f64 {
        0.0
    }
}

fn source(motion: &Leaps) -> Source {
    let mut params = Params::new(GAUSSIANS, 1, LifeKind::Infinite.columns());
    for i in 0..GAUSSIANS {
        let rng = Rng::new(9, "cloud", i as u64);
        let geometry = &mut params[GEOMETRY];
        (0..3).for_each(|k| geometry.set(i, k, rng.normal(k as u64) as f32));
        geometry.set(i, QUAT, 1.0);
        (0..3).for_each(|k| geometry.set(i, LOG_SCALE + k, -2.0));
        geometry.set(i, OPACITY, 1.0);
        (0..3).for_each(|k| params[SH].set(i, k, rng.normal(9 + k as u64) as f32));
    }
    let layers = vec![Layer::new("leaps", params, Arc::new(motion.clone()), LifeKind::Infinite)];
    Source::own(Scene { layers, clip: [0.0, (FRAMES - 1.0) / FPS], fps: FPS, up: [0.0, 1.0, 0.0], ..Scene::default() })
}

fn cooked(motion: &Leaps, baking: &Baking) -> Cooked {
    let console: &dyn Listener = &ignore;
    bake_like(&source(motion), "leaps", &Baking { poster: false, ..baking.clone() }, console).unwrap()
}

#[test]
fn a_file_keeps_its_size_limit_and_reports_the_size_it_would_need() {
    let bytes = 40_000;
    let Cooked { packed, likeness, needs } =
        cooked(&Leaps::default(), &Baking { bytes: Some(bytes), ..Baking::default() });
    let found = packed.bytes.len() as f64;
    assert!((0.7..=TOO_LARGE).contains(&(found / bytes as f64)), "{found} bytes of {bytes}");
    assert_eq!(playback::read(&packed.bytes).unwrap().len(), packed.baked.report.primitives);
    let (like, needs) = (likeness.unwrap(), needs.expect("leaps are not 40 dB in a few segments each"));
    assert!(like.psnr < LIKE && needs.bytes > 2 * bytes, "{like:?} {needs:?}");
    let words = Needs { psnr: 40.0, bytes: 60 << 20, more: false }.in_words(32.1, 8 << 20);
    assert_eq!(words, "32.1 dB against the model at 8.0 MiB; 40 dB needs about 60.0 MiB (option `size`)");
    // The default is what was learnt, and a rate.
    let default = budget(&source(&Leaps::default()).scene) as f64;
    assert!(
        (default - (4.0 * 14.0 * GAUSSIANS as f64 + BYTES_A_SECOND * (FRAMES - 1.0) / FPS)).abs() < 2.0,
        "{default}"
    );
}

/// All samples of the model would take three times the minutes there are.
#[test]
fn a_slow_model_is_baked_in_time() {
    let seconds = 30.0;
    let all = GAUSSIANS as f64 * FRAMES;
    let slow = Leaps { cost: (3.0 * 1e6 * seconds / all) as u64, ..Leaps::default() };
    let deadline = Deadline::of(slow.stopwatch(), Some(seconds / 60.0));
    let Cooked { packed, likeness, .. } = cooked(&slow, &Baking { deadline, ..Baking::default() });
    let taken = slow.stopwatch().seconds();
    assert!(taken > 0.0 && taken <= 1.1 * seconds, "{taken} s of {seconds}");
    assert!(playback::read(&packed.bytes).unwrap().len() >= GAUSSIANS);
    assert!(likeness.is_none_or(|l| l.pictures > 0));
    // Nothing is left at all: there is a file all the same.
    let none = Deadline::of(slow.stopwatch(), Some(0.0));
    let late = cooked(&slow, &Baking { deadline: none, ..Baking::default() });
    assert!(late.likeness.is_none() && playback::read(&late.packed.bytes).is_ok());
}

/// An edit may hide everything.
#[test]
fn a_file_without_a_visible_gaussian_is_written_with_a_warning() {
    let mut hidden = source(&Leaps::default());
    let geometry = &mut hidden.scene.layers[0].params[GEOMETRY];
    (0..GAUSSIANS).for_each(|i| geometry.set(i, OPACITY, -20.0));
    let folder = tempfile::tempdir().unwrap();
    let (out, warned) = (folder.path().join("hidden.s4d"), std::cell::RefCell::new(String::new()));
    let listen = |event: &crate::events::Event<'_>| {
        if let crate::events::Event::Warning(text) = event {
            warned.borrow_mut().push_str(text);
        }
    };
    let baking = Baking { poster: false, ..Baking::default() };
    let report = bake_into(&hidden, "hidden", &out, &baking, &listen).unwrap();
    assert!(warned.borrow().contains("no Gaussian of the scene is visible"), "{}", warned.borrow());
    assert_eq!(report["baking"]["primitives"], 0);
    assert!(playback::read(&std::fs::read(&out).unwrap()).is_ok());
}

#[test]
fn a_ladder_is_reported_rung_by_rung_and_stated_in_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("ladder.s4d");
    let baking = Baking { poster: false, ladder: vec![0.4, 50.0], ..Baking::default() };
    let said = std::cell::RefCell::new(String::new());
    let listen = |event: &crate::events::Event<'_>| {
        if let crate::events::Event::Result(text) = event {
            said.borrow_mut().push_str(text);
        }
    };
    let report = bake_into(&source(&Leaps::default()), "ladder", &out, &baking, &listen).unwrap();
    let rungs = report["ladder"].as_array().unwrap();
    assert_eq!(rungs.len(), 2, "{report:#}");
    let number = |k: usize, key: &str| rungs[k][key].as_f64().unwrap();
    assert!(number(0, "most") <= 0.4 && number(0, "rate") == 0.4, "{report:#}");
    assert!(number(0, "gaussians") < number(1, "gaussians") && number(0, "bytes") < number(1, "bytes"));
    assert_eq!(number(1, "gaussians"), report["baking"]["primitives"].as_f64().unwrap());
    assert!(number(0, "psnr") > 5.0 && number(0, "psnr") < 60.0 && rungs[1]["psnr"].is_null());
    assert!(number(0, "bits_a_gaussian") > 100.0, "{report:#}");
    assert!(said.borrow().contains("rung 1 of 2: 0.40 Mbit/s"), "{}", said.borrow());
    let index = playback::Index::parse(&std::fs::read(&out).unwrap(), None).unwrap();
    assert_eq!(ladder::in_words(&ladder::rungs(&index)).len(), 2);
    let wrong = Baking { ladder: vec![8.0, 4.0], ..Baking::default() };
    let error = bake_into(&source(&Leaps::default()), "wrong", &out, &wrong, &ignore).unwrap_err().to_string();
    assert!(error.contains("invalid ladder 8,4"), "{error}");
}
