//! Features and their head (the full model of Spacetime Gaussians) through the whole chain.

use super::*;
use crate::Result;
use splat4d::layers::{Evaluation, Head, LayerTape};
use splat4d::motion::spacetime::FeatureSpec;
use splat4d::motion::{At, Cache};
use splat4d::scene::{HeadKeys, Rows, SplatGrads};

/// Gaussians with features, and where `beside` a still layer that has none; nothing is at its start.
fn featured<F: Real>(life: LifeKind, detach: bool, beside: bool) -> Scene<F> {
    let mut p = cloud::<F>(12, life, 31);
    let features = Some(FeatureSpec { seed: 4 });
    let spec = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach, origin: 0.1, features });
    let motion = build_as(&spec, &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        let weights = p.info(key).space == Space::Fixed;
        shake(&mut p, key, if weights { 0.6 } else { 0.2 }, 1);
    }
    let mut scene = Scene { head: Head::Features, ..one_layer(p, motion, life) };
    if beside {
        let still = build_as(&Spec::Still, &mut Params::new(0, 1, &[])).unwrap();
        let plain = one_layer(cloud::<F>(5, LifeKind::Infinite, 22), still, LifeKind::Infinite);
        scene.layers.splice(0..0, plain.layers);
    }
    scene
}

#[test]
fn every_gradient_of_features_and_head_equals_finite_differences() {
    for (life, beside) in [(LifeKind::GaussHalf, false), (LifeKind::Infinite, true)] {
        let scene = featured(life, false, beside);
        let reached = check_gradients(&scene, &shots(&[(0, 0.0), (1, 0.13), (2, 0.13)]), &Vec::new());
        let own = if beside { &reached[1] } else { &reached[0] };
        assert_reached(own, &["geometry", "sh", "velocities", "rotation_rates", "features", "head.in", "head.out"]);
        assert!(beside || own.iter().any(|(n, g)| n == "life" && *g > 1e-7));
        assert!(!beside || reached[0].iter().any(|(n, g)| n == "sh" && *g > 1e-7));
    }
}

/// With `detach` Δ is a constant to features too: the lifespan's centre learns from opacity alone.
#[test]
fn detached_features_give_lifespans_no_gradient() {
    let gradient = |detach: bool| {
        let scene = featured::<f64>(LifeKind::GaussHalf, detach, false);
        let (layer, mut d) = (&scene.layers[0], Grads::new(&scene.layers[0].params));
        let (mut tape, t) = (splat4d::motion::Tape::default(), Time(0.17));
        let q = At { p: &layer.params, of: Space::Gaussians, rows: Rows::All, t };
        layer.motion.at(&q, &Cache::default(), &mut tape);
        let (d_out, mut d_color) = (tape.out.zeros_like(), Table::new(&[("channels", 9)], q.len()));
        (0..q.len()).for_each(|j| d_color.write(j, 0, [1.0; 9]));
        let grads = SplatGrads { out: &d_out, color: Some(&d_color), weights: None };
        let d_time = layer.motion.backward(&q, &Cache::default(), &mut tape, &grads, &mut Cache::default(), &mut d);
        let features = layer.params.find("features").unwrap();
        let sums = [3, 4, 5].map(|c| (0..q.len()).map(|r| layer.params[features].get(r, c)).sum::<f64>());
        assert!((d_time - sums.iter().sum::<f64>()).abs() < 1e-12, "time itself is never detached");
        assert!((0..q.len()).all(|r| d.table(features).get(r, 0) == 1.0));
        (0..q.len()).map(|r| d.table(LIFE).get(r, 0).abs()).sum::<f64>()
    };
    assert_eq!(gradient(true), 0.0);
    assert!(gradient(false) > 0.1);
}

/// The synthetic capture, whose ball changes its colour with time and with the position it is seen from.
struct Changing(Made);

impl Frames for Changing {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn camera(&self, i: usize) -> &Camera {
        self.0.camera(i)
    }

    fn time(&self, i: usize) -> Time {
        self.0.time(i)
    }

    fn rig(&self, i: usize) -> usize {
        self.0.rig(i)
    }

    fn name(&self, i: usize) -> String {
        self.0.name(i)
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        self.0.load(i, out)?;
        let (mask, side) = (out.mask.take().expect("it has masks"), self.camera(i).forward()[0]);
        let change = [2.5 * (self.time(i).0 - 0.1), 0.15 * side, -1.5 * (self.time(i).0 - 0.1)];
        for (c, change) in change.into_iter().enumerate() {
            out.color.plane_mut(c).iter_mut().zip(&mask.data).for_each(|(x, m)| *x += *m * change as f32);
        }
        Ok(())
    }
}

/// Mean squared error over all frames.
fn error_of(scene: &Scene<f32>, frames: &dyn Frames) -> f64 {
    let (mut renderer, mut image) = (Renderer::new(RenderConfig::default()), Image::default());
    let (mut picture, mut instant, mut sum) = (Picture::default(), Evaluation::default(), 0.0);
    for i in 0..frames.len() {
        frames.load(i, &mut picture).unwrap();
        scene.at(frames.time(i), &mut instant);
        renderer.render(&render::Shot::new(&scene.splats(&instant), frames.camera(i), scene.background), &mut image);
        let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
        let pairs = image.color.data.iter().zip(&picture.color.data);
        sum += pairs.map(square).sum::<f64>() / image.color.data.len() as f64;
    }
    sum / frames.len() as f64
}

#[test]
fn colours_that_change_with_time_and_view_are_learnt_better_with_a_head() {
    let frames: Arc<dyn Frames> = Arc::new(Changing(Made::new(6, 3, 24)));
    let learn = |features: Option<FeatureSpec>| {
        // Everything stays for the whole clip: no new colour can appear by birth.
        let mut p = cloud::<f32>(160, LifeKind::Infinite, 4);
        let spec = SpacetimeSpec { order: 1, origin: 0.1, features, ..SpacetimeSpec::default() };
        let motion = build_as(&Spec::Spacetime(spec), &mut p).unwrap();
        let mut scene = one_layer(p, motion, LifeKind::Infinite);
        if features.is_some() {
            scene.head = Head::Features;
        }
        let mut columns = [&ORDINARY[..], &[("velocities", 0.03)]].concat();
        columns.extend([("view_features", 0.02), ("time_features", 0.1), ("head.in", 0.005), ("head.out", 0.005)]);
        let stage = Stage { groups: groups(&columns), ..Stage::new("colours", 400) };
        let mut t = trainer_on(frames.clone(), scene, vec![stage], 160);
        finish_stage(&mut t);
        -10.0 * error_of(t.scene(), frames.as_ref()).log10()
    };
    let (plain, full) = (learn(None), learn(Some(FeatureSpec { seed: 4 })));
    println!("plain {plain:.2} dB, full {full:.2} dB");
    assert!(full > plain + 1.0, "{full:.2} dB with a head, {plain:.2} dB without");
}

#[test]
fn row_edits_carry_features_along() {
    let mut scene = featured::<f32>(LifeKind::GaussHalf, false, false);
    let key = scene.layers[0].params.find("features").unwrap();
    let (first, head) = (scene.layers[0].params[key].read::<6>(7, 0), HeadKeys::of(&scene.layers[0].params).unwrap());
    let weights = scene.layers[0].params[head.first].clone();
    let mut edit = splat4d::scene::RowEdit::prune(Space::Gaussians, (0..12).map(|r| r > 4));
    edit.push(7, splat4d::scene::Born::Clone);
    scene.layers[0].edit(&edit, &Rng::new(1, "edit", 0));
    let params = &scene.layers[0].params;
    assert_eq!((params[key].read::<6>(2, 0), params[key].read::<6>(7, 0)), (first, first));
    assert_eq!((params[key].rows(), &params[head.first]), (8, &weights));
    let mut tape = LayerTape::default();
    tape.request(Space::Gaussians, Rows::All, Time(0.1));
    scene.layers[0].at(&Cache::default(), &mut tape);
    assert_eq!(tape.out().rows(), 8);
}
