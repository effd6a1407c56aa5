//! Scores, pruning and masks on synthetic scenes, and on the bundled capture.

mod flicker;
mod scores;
mod transient;

use super::*;
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::step::tests::Made;
use splat4d::layers::{Evaluation, Layer, LayerTape};
use splat4d::math::Rng;
use splat4d::motion::{SpacetimeSpec, Spec, build};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LIFE, LifeKind, Params, Part, Rows, SH, Splats, Time};

/// Cameras, times and width in pixels of the synthetic capture; ten frames per second.
const CAPTURE: (usize, usize, usize) = (3, 9, 40);

/// A layer of Gaussians around the origin, with lifespans of random lengths about random times of the clip.
fn layer(rows: usize, life: LifeKind, seed: u64) -> Layer<f32> {
    let rng = Rng::new(seed, "prune", 0);
    let mut params = Params::new(rows, 1, life.columns());
    for r in 0..rows {
        let rng = rng.fork(r as u64);
        let g = &mut params[GEOMETRY];
        g.write(r, 0, [0u64, 1, 2].map(|k| 2.0 * rng.uniform(k) as f32 - 1.0));
        g.write(r, QUAT, [3u64, 4, 5, 6].map(|k| rng.normal(k) as f32));
        g.write(r, LOG_SCALE, [7u64, 8, 9].map(|k| -2.5 + 0.5 * rng.normal(k) as f32));
        g.set(r, OPACITY, 1.5 * rng.normal(10) as f32);
        params[SH].write(r, 0, [11u64, 12, 13].map(|k| rng.uniform(k) as f32 - 0.5));
        if life != LifeKind::Infinite {
            let width = 0.02 * 50f64.powf(rng.uniform(41));
            params[LIFE].write(r, 0, [0.8 * rng.uniform(40) as f32, width.ln() as f32]);
        }
    }
    let spec = Spec::Spacetime(SpacetimeSpec::default());
    let motion = build(&spec, &mut params).unwrap();
    Layer::new("made up", params, motion, life)
}

/// Two layers, of which one has an infinite lifespan.
fn scene(rows: usize) -> Scene<f32> {
    let layers = vec![layer(rows, LifeKind::GaussHalf, 1), layer(rows / 2, LifeKind::Infinite, 2)];
    Scene { layers, clip: [0.0, 0.8], fps: 10.0, ..Scene::default() }
}

fn made() -> Made {
    Made::new(CAPTURE.0, CAPTURE.1, CAPTURE.2)
}

fn scored(scene: &Scene<f32>, frames: &dyn Frames, config: &ScoreConfig) -> Scores {
    score(scene, frames, config, &mut |_, _| {}).unwrap()
}

/// Renders frame i of a capture.
fn drawn(scene: &Scene<f32>, frames: &dyn Frames, i: usize) -> Image<f32> {
    let (mut instant, mut image) = (Evaluation::default(), Image::default());
    scene.at(frames.time(i), &mut instant);
    let mut renderer = Renderer::new(RenderConfig::default());
    renderer.render(&Shot::new(&scene.splats(&instant), frames.camera(i), [0.1, 0.2, 0.3]), &mut image);
    image
}

fn edit(scene: &mut Scene<f32>, edits: &[RowEdit]) {
    for (layer, edit) in scene.layers.iter_mut().zip(edits) {
        layer.edit(edit, &Rng::new(0, "edit", 0));
    }
}

/// Another capture seen through it: each frame so often, its times stretched.
struct Again {
    inner: Made,
    copies: usize,
    stretch: f64,
}

impl Frames for Again {
    fn len(&self) -> usize {
        self.copies * self.inner.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        self.inner.camera(i / self.copies)
    }
    fn time(&self, i: usize) -> Time {
        Time(self.stretch * self.inner.time(i / self.copies).0)
    }
    fn rig(&self, i: usize) -> usize {
        self.inner.rig(i / self.copies)
    }
    fn name(&self, i: usize) -> String {
        self.inner.name(i / self.copies)
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        self.inner.load(i / self.copies, out)
    }
}

#[test]
fn spatial_scores_sum_to_the_covered_pixels_and_double_with_the_images() {
    let (s, made) = (scene(400), made());
    let scores = scored(&s, &made, &ScoreConfig::default());
    let sum: f64 = scores.spatial.iter().flatten().sum();
    let covered: f64 =
        (0..made.len()).map(|i| drawn(&s, &made, i).alpha.data.iter().map(|&a| f64::from(a)).sum::<f64>()).sum();
    assert!((sum - covered).abs() < 1e-5 * covered && covered > 1000.0, "{sum} {covered}");
    assert_eq!(scores.views, made.len());

    let twice = Again { inner: made, copies: 2, stretch: 1.0 };
    let doubled = scored(&s, &twice, &ScoreConfig::default());
    for (a, b) in scores.layers.iter().flatten().zip(doubled.layers.iter().flatten()) {
        assert!((2.0 * a - b).abs() <= 1e-12 * b, "{a} {b}");
    }
}

#[test]
fn scores_do_not_depend_on_threads_and_report_progress() {
    let (s, made) = (scene(300), made());
    let pool = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    for temporal in Temporal::ALL {
        for combine in Combine::ALL {
            let config = ScoreConfig { temporal: *temporal, combine: *combine, every: 2, ..ScoreConfig::default() };
            let mut heard = Vec::new();
            let one = pool(1).install(|| score(&s, &made, &config, &mut |d, n| heard.push((d, n)))).unwrap();
            assert_eq!(one, pool(3).install(|| scored(&s, &made, &config)), "{temporal} {combine}");
            let n = one.views;
            assert_eq!(heard, (1..=n).map(|d| (d, n)).collect::<Vec<_>>());
            assert!(n < made.len() && n >= CAPTURE.1, "{n} views of {} times", CAPTURE.1);
            assert!(one.layers.iter().flatten().all(|s| s.is_finite() && *s >= 0.0), "{temporal} {combine}");
        }
    }
}

/// The same film at half the frame rate, twice as long: what is measured in frames does not change.
#[test]
fn scores_do_not_depend_on_the_unit_of_the_clock() {
    let (s, made) = (scene(200), made());
    let mut slow = s.clone();
    for r in 0..200 {
        let [center, log_width] = s.layers[0].params[LIFE].read::<2>(r, 0);
        slow.layers[0].params[LIFE].write(r, 0, [2.0 * center, log_width + 2f32.ln()]);
    }
    (slow.clip, slow.fps) = ([0.0, 1.6], 5.0);
    let long = Again { inner: made, copies: 1, stretch: 2.0 };
    for temporal in Temporal::ALL {
        let config = ScoreConfig { temporal: *temporal, ..ScoreConfig::default() };
        let (a, b) = (scored(&s, &long.inner, &config), scored(&slow, &long, &config));
        let total: f64 = a.layers.iter().flatten().sum();
        for (a, b) in a.layers.iter().flatten().zip(b.layers.iter().flatten()) {
            assert!((a - b).abs() <= 1e-4 * (a + total / 600.0), "{temporal}: {a} {b}");
        }
        let other = scored(&s, &long.inner, &ScoreConfig { unit: 3.0, ..config });
        let timed =
            [Temporal::InstantAbs, Temporal::FirstDerivative, Temporal::LiteralSignedClamped].contains(temporal);
        assert!(!timed || other != a, "{temporal}: the unit is looked at");
    }
}

#[test]
fn gaussians_in_no_view_score_zero_and_pruning_them_keeps_the_images() {
    let (mut s, made) = (scene(300), made());
    // Some behind every camera, some dead before the clip, some not finite.
    for r in 0..40 {
        s.layers[0].params[GEOMETRY].set(r, 1, 100.0);
        s.layers[0].params[LIFE].set(40 + r, 0, -30.0);
        s.layers[1].params[GEOMETRY].set(r, LOG_SCALE, f32::NAN);
    }
    let scores = scored(&s, &made, &ScoreConfig::default());
    let unseen: Vec<usize> = scores.layers.iter().map(|l| l.iter().filter(|s| **s == 0.0).count()).collect();
    assert!(unseen[0] >= 80 && unseen[1] >= 40, "{unseen:?}");
    let count = unseen[0] + unseen[1];
    let edits = prune(&s, &scores, count as f64 / s.len() as f64 + 1e-9);
    assert_eq!(edits.iter().map(RowEdit::len).sum::<usize>(), s.len() - count);
    let mut less = s.clone();
    edit(&mut less, &edits);
    for i in 0..made.len() {
        assert_eq!(drawn(&less, &made, i), drawn(&s, &made, i), "frame {i}");
    }
}

#[test]
fn pruning_ranks_all_layers_together_and_keeps_one_gaussian() {
    let s = scene(6);
    let scores = Scores {
        layers: vec![vec![5.0, 1.0, 2.0, 2.0, 9.0, 0.0], vec![2.0, 7.0, 0.5]],
        ..scored(&s, &made(), &ScoreConfig::default())
    };
    let kept = |ratio: f64| prune(&s, &scores, ratio).into_iter().map(|e| e.parent).collect::<Vec<_>>();
    assert_eq!(kept(0.0), [vec![0, 1, 2, 3, 4, 5], vec![0, 1, 2]]);
    assert_eq!(kept(0.35), [vec![0, 2, 3, 4], vec![0, 1]]);
    assert_eq!(kept(0.45), [vec![0, 3, 4], vec![0, 1]], "of equals the first one goes");
    assert_eq!(kept(1.0), [vec![4], vec![]]);
    assert!(prune(&s, &scores, 0.5).iter().all(|e| e.space == Space::Gaussians));
}

/// The rows that a lifespan leaves draw the very image of all rows: what it hides is below the blend's cut-off.
#[test]
fn active_rows_render_the_image_of_all_rows() {
    let (s, made) = (scene(400), made());
    let mut hidden = 0;
    for i in (0..made.len()).step_by(4) {
        let t = made.time(i);
        let draw = |all: bool| {
            let mut tapes: Vec<LayerTape<f32>> = s.layers.iter().map(|_| LayerTape::default()).collect();
            for (layer, tape) in s.layers.iter().zip(&mut tapes) {
                if all {
                    tape.request(Space::Gaussians, Rows::All, t);
                } else {
                    tape.request_active(layer, t);
                }
                layer.at(&splat4d::motion::Cache::default(), tape);
            }
            let parts: Vec<Part<'_, f32>> = s.layers.iter().zip(&tapes).map(|(l, tape)| l.part(tape)).collect();
            let (splats, mut image) = (Splats { parts, head: None }, Image::default());
            let mut renderer = Renderer::new(RenderConfig::default());
            renderer.render(&Shot::new(&splats, made.camera(i), [0.0; 3]), &mut image);
            (splats.len(), image)
        };
        let ((few, culled), (all, whole)) = (draw(false), draw(true));
        assert!(culled == whole, "frame {i}");
        hidden += all - few;
    }
    assert!(hidden > 300, "{hidden}");
}

#[test]
fn keys_are_times_of_frames_with_both_ends() {
    let times: Vec<f64> = (0..12).map(|k| 3.0 + 0.1 * k as f64).collect();
    let at = |interval: usize, times: &[f64]| {
        masks::keys(interval, times, 10.0).iter().map(|k| ((k - 3.0) * 10.0).round() as i32).collect::<Vec<_>>()
    };
    assert_eq!(at(5, &times), [0, 5, 10, 11]);
    assert_eq!(at(0, &times), (0..12).collect::<Vec<_>>());
    assert_eq!(at(100, &times), [0, 11]);
    let holes = [3.0, 3.1, 3.7, 3.8, 4.1];
    assert_eq!(at(4, &holes), [0, 7, 8, 11]);
    assert!(masks::keys(5, &[], 10.0).is_empty());
    assert_eq!(masks::keys(5, &[2.0], 10.0), [2.0]);
}

#[test]
fn masks_contain_gaussians_visible_at_keys_and_between_keys() {
    let (mut s, made) = (scene(500), made());
    // Three rows that live between two keys (at 0, .4 and .8 s) and one that is long over.
    for (row, center) in [(0, 0.2), (1, 0.55), (2, 0.6), (3, -5.0)] {
        s.layers[0].params[LIFE].write(row, 0, [center, 0.02f32.ln()]);
        s.layers[0].params[GEOMETRY].write(row, 0, [0.0, 0.0, 0.0]);
        s.layers[0].params[GEOMETRY].set(row, OPACITY, 2.0);
    }
    // Twenty that are there throughout and that no camera sees.
    for row in 10..30 {
        s.layers[0].params[LIFE].write(row, 0, [0.4, 3f32.ln()]);
        s.layers[0].params[GEOMETRY].write(row, 0, [0.0, 50.0, 0.0]);
        s.layers[0].params[GEOMETRY].set(row, OPACITY, 2.0);
    }
    let whole = s.clone();
    let config = MaskConfig { interval: 4, ..MaskConfig::default() };
    let mut heard = (0, 0);
    key_masks(&mut s, &made, &config, &mut |d, n| heard = (d, n)).unwrap();
    assert_eq!(heard, (3 * CAPTURE.0, 3 * CAPTURE.0));
    let masks = s.layers[0].masks.clone().unwrap();
    assert_eq!(masks.times().len(), 3);
    let bits = |row: usize| [0, 1, 2].map(|k| masks.get(k, row));
    assert_eq!([bits(0), bits(1), bits(2)], [[true, true, false], [false, true, true], [false, true, true]]);
    assert_eq!(bits(3), [false; 3]);
    let mut left_out = 0;
    for i in 0..made.len() {
        let k = i / CAPTURE.0;
        if k.is_multiple_of(4) {
            assert_eq!(drawn(&s, &made, i), drawn(&whole, &made, i), "at a key time nothing is missed: frame {i}");
        }
        let mut ids = [Vec::new(), Vec::new()];
        whole.layers[0].active(made.time(i), &mut ids[0]);
        s.layers[0].active(made.time(i), &mut ids[1]);
        assert!(ids[1].iter().all(|id| ids[0].contains(id)));
        left_out += ids[0].len() - ids[1].len();
    }
    assert!(left_out >= 20 * made.len(), "the filter leaves some out: {left_out}");
    // Again with masks on: they do not count.
    let again = s.clone();
    key_masks(&mut s, &made, &config, &mut |_, _| {}).unwrap();
    assert_eq!(s.layers[0].masks, again.layers[0].masks);
}

#[test]
fn scoring_without_views_is_an_error() {
    let none = Made::new(3, 0, 8);
    let error = score(&scene(4), &none, &ScoreConfig::default(), &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("no training views") && error.contains("--hold-out"), "{error}");
    assert!(key_masks(&mut scene(4), &none, &MaskConfig::default(), &mut |_, _| {}).is_err());
}
