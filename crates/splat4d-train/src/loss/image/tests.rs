//! Terms as a list: what they need, how gradients add up, and what was a special case of the trainer.

use super::*;
use crate::loss::image::segmentation::Segmentation;
use crate::loss::terms::StepInfo;
use crate::recipe::Recipe;
use splat4d::math::Se3;
use splat4d::render::Image;
use splat4d::scene::{Camera, Planes, Time};

const SIZE: [usize; 2] = [6, 9];

fn image() -> Image<f64> {
    let [h, w] = SIZE;
    Image {
        color: check::planes("color", [3, h, w], 0.0, 1.0),
        alpha: check::planes("alpha", [1, h, w], 0.1, 0.9),
        depth: check::planes("depth", [1, h, w], 1.0, 2.0),
        extra: Planes::new(0, h, w),
    }
}

fn view<'a, F>(camera: &'a Camera, truth: &'a Planes<F>, mask: Option<&'a Planes<F>>) -> View<'a, F>
where
    F: Real,
{
    View {
        camera,
        t: Time(0.0),
        background: [F::ZERO; 3],
        truth,
        mask,
        weight: None,
        depth: None,
        flow: None,
        measured: None,
        tracks: None,
        frame: 0,
        rig: 0,
        shutter: None,
    }
}

fn info() -> StepInfo {
    StepInfo { iteration: 0, times: vec![Time(0.0)], seed: 0, progress: 0.5 }
}

fn camera() -> Camera {
    Camera::with_fov_y(Se3::IDENTITY, 0.8, SIZE[1], SIZE[0])
}

#[test]
fn the_gradient_of_a_list_is_the_sum_of_its_terms_in_any_order() {
    let (image, camera, truth) = (image(), camera(), check::planes("truth", [3, SIZE[0], SIZE[1]], 0.0, 1.0));
    let view = view(&camera, &truth, None);
    let run = |terms: &mut [&mut dyn ImageTerm<f64>]| {
        let mut d = LossGrads::default();
        d.begin(&image);
        let shown = Shown::new(&image, &[]);
        let value: f64 = terms.iter_mut().map(|t| t.eval(&info(), &view, &shown, &mut d)).sum();
        (value, d.grads().color.data.clone(), d.grads().alpha.map(|p| p.data.clone()))
    };
    let (photometric, tv) =
        (|| Photometric::<f64>::with_simd(0.2, splat4d::simd::Simd::detect()), tv::TotalVariation(0.7));
    let (a, b) = (run(&mut [&mut photometric()]), run(&mut [&mut tv.clone()]));
    let sum: Vec<f64> = a.1.iter().zip(&b.1).map(|(a, b)| a + b).collect();
    for both in [run(&mut [&mut photometric(), &mut tv.clone()]), run(&mut [&mut tv.clone(), &mut photometric()])] {
        // Two orders of a sum differ in their last digit.
        let near = |x: f64, y: f64| (x - y).abs() <= 1e-12 * (1.0 + y.abs());
        assert!(near(both.0, a.0 + b.0) && both.1.iter().zip(&sum).all(|(x, y)| near(*x, *y)), "{both:?}");
        assert!(both.2.is_none(), "alpha has no gradient where no term touches it");
    }
    let (value, color, alpha) = run(&mut [&mut entropy::MaskEntropy(1.0)]);
    assert!(value > 0.0 && alpha.is_some() && color.iter().all(|d| *d == 0.0));
}

#[test]
fn the_mask_pulls_alpha_where_there_is_a_mask() {
    let (image, camera) = (image(), camera());
    let truth = Planes::new(3, SIZE[0], SIZE[1]);
    let mut mask = Planes::new(1, SIZE[0], SIZE[1]);
    mask.data.iter_mut().enumerate().for_each(|(i, m)| *m = f64::from(u8::from(i % 3 > 0)));
    let run = |alpha: &Planes<f64>, d_alpha: &mut Planes<f64>, mask: Option<&Planes<f64>>| {
        let (image, mut d) = (Image { alpha: alpha.clone(), ..image.clone() }, LossGrads::default());
        d.begin(&image);
        let value = mask::Mask(0.4).eval(&info(), &view(&camera, &truth, mask), &Shown::new(&image, &[]), &mut d);
        d.alpha.add().data.iter().zip(&mut d_alpha.data).for_each(|(from, to)| *to += from);
        value
    };
    let masked = |p: &[Planes<f64>], d: &mut [Planes<f64>]| run(&p[0], &mut d[0], Some(&mask));
    let value = |p: &[Planes<f64>]| masked(p, &mut [Planes::new(1, SIZE[0], SIZE[1])]);
    assert!(check::gradients(std::slice::from_ref(&image.alpha), masked, value) > 0.1);
    let mut d = Planes::new(1, SIZE[0], SIZE[1]);
    assert_eq!(run(&image.alpha, &mut d, None), 0.0);
    assert!(d.data.iter().all(|d| *d == 0.0));
}

#[test]
fn channels_that_terms_need_are_rendered_once_in_a_fixed_order() {
    let (camera, truth) = (camera(), Planes::new(3, SIZE[0], SIZE[1]));
    let mask = Planes::new(1, SIZE[0], SIZE[1]);
    let mut needs = Needs::default();
    let seg = Segmentation::new("foreground", 1.0, 0.2);
    let normals = normal::DepthNormal(1.0);
    for mask in [Some(&mask), None] {
        let view = view::<f32>(&camera, &truth, mask);
        needs = Needs::default();
        needs.join(seg.needs(&view));
        needs.join(normals.needs(&view));
        needs.join(normals.needs(&view));
        needs.join(flow::Flow(1.0).needs(&view));
        let mut channels = vec![Channel::Normals];
        channels.extend(mask.map(|_| Channel::Sigmoid("foreground".into())));
        assert_eq!(needs, Needs { depth: true, extra: channels }, "flow is drawn only where it is known");
    }
    needs.join(Needs { depth: false, extra: vec![Channel::Flow] });
    assert_eq!(needs.extra, [Channel::Normals, Channel::Flow]);
}

#[test]
fn a_recipe_lists_the_terms_that_have_a_weight() {
    // Known depth costs nothing where there is none, and counts where there is.
    let mut recipe = Recipe::default().with(|r| r.loss.depth = 0.0);
    let count = |r: &Recipe| terms(&r.loss).len();
    assert_eq!(count(&recipe), 1, "colours alone");
    for setting in ["tv", "frequency", "mask", "mask_entropy", "depth_tv", "depth_normal", "depth", "flow", "tracks"] {
        let before = count(&recipe);
        recipe.set(&format!("loss.{setting}=0.1")).unwrap();
        assert_eq!(count(&recipe), before + 1, "{setting}");
    }
}
