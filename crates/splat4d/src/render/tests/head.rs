//! The feature head against the oracle, matrices written out, and finite differences.

use super::*;
use crate::render::head::NEAREST;
use crate::scene::head::{BASE, FEATURES, FURTHER, HIDDEN, INPUTS};
use crate::scene::{HeadWeights, Params};

/// The scene of the other tests, whose direct colours have features, and a network.
#[derive(Clone)]
struct Headed {
    scene: Scene<f64>,
    first: Vec<f64>,
    second: Vec<f64>,
}

impl Headed {
    fn new(n: usize, size: f64) -> Self {
        let mut scene = scene(33, n, size);
        let rng = Rng::new(5, "head", 0);
        scene.direct = noise(rng.fork(1), &[("channels", FEATURES)], n + 6, 0.5, 0.5);
        let numbers =
            |k: u64, count: usize| -> Vec<f64> { (0..count).map(|i| 0.7 * rng.fork(k).normal(i as u64)).collect() };
        let mut first: Vec<f64> = numbers(2, HIDDEN * INPUTS);
        // The camera is far down z: every hidden number is above zero somewhere.
        first.iter_mut().skip(FURTHER + 2).step_by(INPUTS).for_each(|w| *w = -1.0);
        Self { scene, first, second: numbers(3, 3 * HIDDEN) }
    }

    fn splats(&self) -> Splats<'_, f64> {
        let head = HeadWeights { first: &self.first, second: &self.second };
        Splats { head: Some(head), ..self.scene.splats() }
    }

    fn draw(&self, view: &Camera, background: [f64; 3]) -> Image<f64> {
        let mut out = Image::default();
        Renderer::new(smooth()).render(&shot(&self.splats(), view, background, Some(&self.scene.extra)), &mut out);
        out
    }
}

#[test]
fn images_with_a_head_equal_the_oracle() {
    // Odd sizes end in the middle of sixteen pixels and of eight rows.
    for (w, h) in [(1, 1), (17, 3), (33, 21), (64, 40)] {
        let (s, view) = (Headed::new(20, 0.3), camera(w, h));
        let mut truth = oracle::render(&shot(&s.splats(), &view, BACKGROUND, Some(&s.scene.extra)), &smooth());
        let (worst, _) = difference(&s.draw(&view, BACKGROUND), &truth, 0.0);
        assert!(worst < F64_TOLERANCE, "{w}x{h}: {worst}");
        let mut plain = Image::default();
        Renderer::new(smooth()).render(&shot(&s.splats(), &view, BACKGROUND, None), &mut plain);
        assert_eq!((plain.extra.channels, plain.extra.data.len()), (0, 0), "the head's channels are its own");
        truth.extra = Planes::new(0, h, w);
        assert!(difference(&plain, &truth, 0.0).0 < F64_TOLERANCE);
    }
}

/// A 1x1 convolution is a matrix product a pixel: the image of the nine channels, multiplied by hand.
#[test]
fn the_network_is_a_matrix_product_a_pixel() {
    let (s, view) = (Headed::new(20, 0.3), camera(33, 21));
    let got = s.draw(&view, BACKGROUND).color;
    // Without a head the same splats are rendered with their features as further channels.
    let n = s.scene.splats().len();
    let mut channels = Table::new(&[("further", FURTHER)], n);
    for j in 0..s.scene.direct.rows() {
        channels.write(n - s.scene.direct.rows() + j, 0, s.scene.direct.read::<FURTHER>(j, BASE));
    }
    let mut blended = Image::default();
    Renderer::new(smooth()).render(&shot(&s.scene.splats(), &view, BACKGROUND, Some(&channels)), &mut blended);
    let eye = view.center();
    let squashed = eye.map(|x| x / (1.0 + crate::math::se3::norm(eye)));
    for (x, y) in [(0, 0), (16, 9), (32, 20), (5, 14)] {
        let at = view.unproject([x as f64 + 0.5, y as f64 + 0.5], 3.0);
        let to: [f64; 3] = std::array::from_fn(|k| at[k] - eye[k]);
        let length = to.iter().map(|t| t * t).sum::<f64>().sqrt();
        let mut input: Vec<f64> = (0..FURTHER).map(|c| blended.extra.get(c, y, x)).collect();
        input.extend(squashed);
        input.extend(to.map(|t| t / length));
        let product = |w: &[f64], x: &[f64]| w.iter().zip(x).map(|(w, x)| w * x).sum::<f64>();
        let hidden: Vec<f64> = s.first.chunks(INPUTS).map(|row| product(row, &input).max(0.0)).collect();
        for (c, row) in s.second.chunks(HIDDEN).enumerate() {
            let base = blended.color.get(c, y, x);
            let near = base.clamp(NEAREST, 1.0 - NEAREST);
            let logit = (near / (1.0 - near)).ln() + (base - near) / (near * (1.0 - near));
            let color = (logit + product(row, &hidden)).sigmoid();
            assert!((got.get(c, y, x) - color).abs() < 1e-9, "pixel {x} {y}: {} and {color}", got.get(c, y, x));
        }
    }
}

#[test]
fn a_head_at_its_start_gives_the_image_without_one() {
    let mut s = Headed::new(20, 0.3);
    let mut p = Params::<f64>::new(0, 1, &[]);
    let keys = crate::scene::HeadKeys::new(7, &mut p).unwrap();
    let start = keys.weights(&p);
    (s.first, s.second) = (start.first.to_vec(), start.second.to_vec());
    assert!(s.first.iter().any(|w| *w != 0.0) && s.second.iter().all(|w| *w == 0.0));
    for j in 0..s.scene.direct.rows() {
        let color = s.scene.direct.read::<3>(j, 0).map(|c| c.clamp(0.01, 0.99));
        s.scene.direct.write(j, 0, color);
    }
    let view = camera(40, 33);
    let mut plain = Image::default();
    Renderer::new(smooth()).render(&shot(&s.scene.splats(), &view, BACKGROUND, None), &mut plain);
    let got = s.draw(&view, BACKGROUND);
    let (mut inside, mut worst) = (0, 0.0f64);
    for (a, b) in got.color.data.iter().zip(&plain.color.data) {
        // Outside of what 8 bits can say the sigmoid holds colours within 0 and 1.
        if (NEAREST..=1.0 - NEAREST).contains(b) {
            inside += 1;
            worst = worst.max((a - b).abs());
        }
        assert!((0.0..=1.0).contains(a) && (a - b.clamp(0.0, 1.0)).abs() < 0.5 * NEAREST);
    }
    assert!(inside > got.color.data.len() / 2 && worst < 1e-12, "{worst} over {inside} numbers");
}

#[test]
fn every_gradient_of_a_head_equals_finite_differences() {
    let (s, view) = (Headed::new(8, 0.4), camera(37, 22));
    let loss = Loss::new(&view, s.scene.extra.width());
    let mut renderer = Renderer::new(smooth());
    let (mut out, mut d, mut own) = (Image::default(), RenderGrads::default(), s.scene.own.zeros_like());
    let extra = Some(&s.scene.extra);
    renderer.render(&shot(&s.splats(), &view, BACKGROUND, extra), &mut out);
    let mut d_sh = [Some(&mut own), None, None];
    renderer.backward(&shot(&s.splats(), &view, BACKGROUND, extra), &loss.grads(), &mut d_sh, &mut d);
    let check = |pick: &dyn Fn(&mut Headed) -> &mut f64, got: f64, what: &str| {
        let mut moved = s.clone();
        *pick(&mut moved) += 1e-5;
        let up = loss.of(&moved.draw(&view, BACKGROUND));
        *pick(&mut moved) -= 2e-5;
        close((up - loss.of(&moved.draw(&view, BACKGROUND))) / 2e-5, got, what);
    };
    let head = d.head.as_ref().unwrap();
    assert!(head.first.iter().chain(&head.second).all(|g| g.abs() > 1e-9), "every weight matters");
    (0..HIDDEN * INPUTS).for_each(|i| check(&|s| &mut s.first[i], head.first[i], &format!("W₁ {i}")));
    (0..3 * HIDDEN).for_each(|i| check(&|s| &mut s.second[i], head.second[i], &format!("W₂ {i}")));
    let channels = d.parts[2].color.as_ref().unwrap();
    for (j, c) in (0..3).flat_map(|j| (0..FEATURES).map(move |c| (j, c))) {
        check(&|s| s.scene.direct.get_mut(j, c), channels.get(j, c), &format!("channel {c} of splat {j}"));
    }
    for (p, c) in (0..3).flat_map(|p| (0..10).map(move |c| (p, c))) {
        check(&|s| s.scene.outs[p].get_mut(1, c), d.parts[p].out.get(1, c), &format!("part {p} column {c}"));
    }
    for c in 0..5 {
        let got = d.extra.as_ref().unwrap().get(9, c);
        check(&|s| s.scene.extra.get_mut(9, c), got, &format!("extra {c}"));
    }
    let id = s.scene.ids[1] as usize;
    (0..6).for_each(|c| check(&|s| s.scene.own.get_mut(id, c), own.get(id, c), &format!("own SH {c}")));
    for c in 0..3 {
        let over = |h: f64| {
            let mut b = BACKGROUND;
            b[c] += h;
            loss.of(&s.draw(&view, b))
        };
        close((over(1e-5) - over(-1e-5)) / 2e-5, d.background[c], "background");
    }
    for k in 0..6 {
        let at = |h: f64| {
            let moved = Camera { cam_from_world: nudge(k, h).after(&view.cam_from_world), ..view.clone() };
            loss.of(&s.draw(&moved, BACKGROUND))
        };
        close((at(1e-6) - at(-1e-6)) / 2e-6, d.camera[k], &format!("pose {k}"));
    }
    // An image without a head leaves no gradient of one behind.
    renderer.render(&shot(&s.scene.splats(), &view, BACKGROUND, extra), &mut out);
    renderer.backward(
        &shot(&s.scene.splats(), &view, BACKGROUND, extra),
        &loss.grads(),
        &mut [None, None, None],
        &mut d,
    );
    assert!(d.head.is_none());
}

#[test]
fn a_head_gives_the_same_bits_for_any_threads() {
    let s = Headed::new(60, 0.2);
    let (scene, first, second) =
        (s.scene.cast::<f32>(), s.first.iter().map(|&x| x as f32).collect::<Vec<_>>(), s.second);
    let second: Vec<f32> = second.iter().map(|&x| x as f32).collect();
    let view = camera(83, 59);
    let bits = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let head = Some(HeadWeights { first: &first, second: &second });
            let splats = Splats { head, ..scene.splats() };
            let (mut out, mut d) = (Image::default(), RenderGrads::default());
            let mut renderer = Renderer::new(complete());
            renderer.render(&shot(&splats, &view, BACKGROUND.map(|b| b as f32), None), &mut out);
            let color = out.color.clone();
            let grads = ImageGrads { color: &color, alpha: None, depth: None, extra: None };
            renderer.backward(
                &shot(&splats, &view, BACKGROUND.map(|b| b as f32), None),
                &grads,
                &mut [None, None, None],
                &mut d,
            );
            let head = d.head.unwrap();
            let channels = d.parts[2].color.as_ref().unwrap().data().to_vec();
            let all = out.color.data.iter().chain(&head.first).chain(&head.second).chain(&channels);
            all.map(|x| x.to_bits()).collect::<Vec<_>>()
        })
    };
    assert!(bits(1) == bits(4));
}
