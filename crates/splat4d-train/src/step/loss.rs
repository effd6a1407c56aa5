//! The trainer's image loss: a list of terms, on images as their cameras expose them.

use crate::loss::image::{ImageTerm, LossGrads, Needs, Shown, View};
use crate::loss::photometric::Photometric;
use crate::loss::terms::StepInfo;
use crate::train_state::Exposure;
use splat4d::render::{Comparison, Target};
use splat4d::scene::Planes;

/// The loss on images: terms, in the order in which their values and gradients are summed. The exposure of the view's
/// camera is between the rendered image and all of them.
pub struct TrainLoss {
    terms: Vec<Box<dyn ImageTerm>>,
    exposed: Planes<f32>,
    /// L1 of the last view.
    pub l1: f64,
    /// SSIM of the last view.
    pub ssim: f64,
    /// Sum over the step's views of the mean squared error, in [0, 1] colours, over the pixels that count.
    squares: f64,
    views: usize,
}

impl TrainLoss {
    /// These terms, such as a recipe's ([`loss::image::terms`](crate::loss::image::terms)).
    pub(crate) fn new(terms: Vec<Box<dyn ImageTerm>>) -> Self {
        Self { terms, exposed: Planes::default(), l1: 0.0, ssim: 0.0, squares: 0.0, views: 0 }
    }

    /// The loss of 3DGS alone, with this share of D-SSIM.
    pub fn photometric(dssim: f64) -> Self {
        Self::new(vec![Box::new(Photometric::new(dssim as f32))])
    }

    /// Adds a term, of this library or of a caller's own.
    pub fn push(&mut self, term: impl ImageTerm + 'static) {
        self.push_boxed(Box::new(term));
    }

    /// The same.
    pub(crate) fn push_boxed(&mut self, term: Box<dyn ImageTerm>) {
        self.terms.push(term);
    }

    /// The loss of one step: these terms, then those of the stage, on images as their cameras expose them.
    pub(crate) fn of_step<'a>(
        &'a mut self,
        stage: &'a mut [Box<dyn ImageTerm>],
        exposure: Option<&'a mut Exposure>,
    ) -> StepLoss<'a> {
        (self.squares, self.views) = (0.0, 0);
        StepLoss { run: self, stage, exposure }
    }

    /// Mean squared error over the views of the last step.
    pub(crate) fn mse(&self) -> f64 {
        self.squares / self.views.max(1) as f64
    }
}

/// The image loss of one step; see [`TrainLoss::of_step`].
pub(crate) struct StepLoss<'a> {
    run: &'a mut TrainLoss,
    stage: &'a mut [Box<dyn ImageTerm>],
    exposure: Option<&'a mut Exposure>,
}

impl ImageTerm for StepLoss<'_> {
    fn needs(&self, view: &View<'_>) -> Needs {
        let mut needs = Needs::default();
        self.run.terms.iter().chain(&*self.stage).for_each(|term| needs.join(term.needs(view)));
        needs
    }

    fn eval(&mut self, info: &StepInfo, view: &View<'_>, drawn: &Shown<'_>, d: &mut LossGrads) -> f64 {
        let run = &mut *self.run;
        let mut shown = *drawn;
        if let Some(exposure) = &self.exposure {
            exposure.show(view.rig, view.t, drawn.color, &mut run.exposed);
            shown.color = &run.exposed;
        }
        let mut total = 0.0;
        for term in run.terms.iter_mut().chain(&mut *self.stage) {
            total += term.eval(info, view, &shown, d);
            if let Some(measured) = term.measured() {
                (run.l1, run.ssim) = (measured.l1, measured.ssim);
                run.squares += measured.mse;
            }
        }
        run.views += 1;
        if let Some(exposure) = &mut self.exposure {
            exposure.respond_backward(view.rig, view.t, drawn.color, d.color.add());
        }
        total
    }

    fn target<'a>(&self, view: &View<'a>) -> Option<Target<'a>> {
        let mut terms = self.run.terms.iter().chain(&*self.stage).filter(|term| term.applies_to(view));
        let (Some(only), None) = (terms.next(), terms.next()) else { return None };
        let response = self.exposure.as_ref().map(|exposure| exposure.response(view.rig, view.t));
        only.target(view).map(|target| Target { response, ..target })
    }

    fn compared(&mut self, view: &View<'_>, comparison: &Comparison) -> f64 {
        let run = &mut *self.run;
        let mut total = 0.0;
        for term in run.terms.iter_mut().chain(&mut *self.stage).filter(|term| term.applies_to(view)) {
            total += term.compared(view, comparison);
            if let Some(measured) = term.measured() {
                (run.l1, run.ssim) = (measured.l1, measured.ssim);
                run.squares += measured.mse;
            }
        }
        run.views += 1;
        if let (Some(exposure), Some(d)) = (&mut self.exposure, &comparison.d_response) {
            exposure.add_gradient(view.rig, view.t, d);
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::image::Channel;
    use splat4d::math::{Rng, Se3};
    use splat4d::render::Image;
    use splat4d::scene::{Camera, Time};

    const SIZE: usize = 12;
    const RIG: usize = 1;
    /// Its matrix without the identity, and its offsets.
    const ROW: [f32; 12] = [0.2, 0.03, -0.02, 0.01, -0.1, 0.04, -0.03, 0.02, 0.05, 0.02, 0.0, -0.03];

    /// A caller's own term: Σ w·image with random weights, and what it saw.
    struct Own {
        seen: std::sync::Arc<std::sync::Mutex<Vec<f32>>>,
    }

    fn weight(i: usize) -> f32 {
        Rng::new(2, "own", 0).normal(i as u64) as f32
    }

    impl ImageTerm for Own {
        fn needs(&self, _: &View<'_>) -> Needs {
            Needs { depth: false, extra: vec![Channel::Normals] }
        }

        fn eval(&mut self, _: &StepInfo, _: &View<'_>, shown: &Shown<'_>, d: &mut LossGrads) -> f64 {
            *self.seen.lock().unwrap() = shown.color.data.clone();
            d.color.add().data.iter_mut().enumerate().for_each(|(i, d)| *d += weight(i));
            shown.color.data.iter().enumerate().map(|(i, x)| f64::from(x * weight(i))).sum()
        }
    }

    fn planes(purpose: &str) -> Planes<f32> {
        let rng = Rng::new(1, purpose, 0);
        let mut out = Planes::new(3, SIZE, SIZE);
        out.data.iter_mut().enumerate().for_each(|(i, x)| *x = rng.uniform(i as u64) as f32);
        out
    }

    fn exposure() -> Exposure {
        let mut exposure = Exposure::new(2, vec![0, 1]);
        let key = exposure.key();
        exposure.params[key].write(RIG, 0, ROW);
        exposure
    }

    /// Value and gradient to the rendered colours of one view.
    fn eval(
        loss: &mut TrainLoss,
        stage: &mut [Box<dyn ImageTerm>],
        color: &Planes<f32>,
        exposure: &mut Exposure,
    ) -> (f64, Vec<f32>) {
        let (camera, truth) = (Camera::with_fov_y(Se3::IDENTITY, 0.8, SIZE, SIZE), planes("truth"));
        let view = View {
            camera: &camera,
            t: Time(0.0),
            background: [0.0; 3],
            truth: &truth,
            mask: None,
            weight: None,
            depth: None,
            flow: None,
            measured: None,
            tracks: None,
            frame: 0,
            rig: RIG,
            shutter: None,
        };
        let info = StepInfo { iteration: 0, times: vec![view.t], seed: 0, progress: 0.0 };
        let image = Image { color: color.clone(), ..Image::default() };
        let mut d = LossGrads::default();
        d.begin(&image);
        let mut step = loss.of_step(stage, Some(exposure));
        assert!(!step.needs(&view).depth);
        let value = step.eval(&info, &view, &Shown::new(&image, &[]), &mut d);
        (value, d.grads().color.data.clone())
    }

    #[test]
    fn a_custom_loss_gets_the_exposed_render_and_adds_its_gradient() {
        let color = planes("color");
        let seen = std::sync::Arc::<std::sync::Mutex<Vec<f32>>>::default();
        let mut plain = TrainLoss::photometric(0.2);
        let (value, d) = eval(&mut plain, &mut [], &color, &mut exposure());
        for of_stage in [false, true] {
            let mut loss = TrainLoss::photometric(0.2);
            let own = Own { seen: seen.clone() };
            let mut stage: Vec<Box<dyn ImageTerm>> = Vec::new();
            if of_stage {
                stage.push(Box::new(own));
            } else {
                loss.push(own);
            }
            let (total, d_both) = eval(&mut loss, &mut stage, &color, &mut exposure());
            let seen = seen.lock().unwrap();
            let (mut own_value, pixels) = (0.0, SIZE * SIZE);
            for (i, &x) in seen.iter().enumerate() {
                let (c, p) = (i / pixels, i % pixels);
                let mixed: f32 = (0..3).map(|k| ROW[3 * c + k] * color.plane(k)[p]).sum();
                assert!((x - (color.data[i] + mixed + ROW[9 + c])).abs() < 1e-6, "the camera's matrix and offset");
                let own: f32 = (0..3).map(|k| ROW[3 * k + c] * weight(k * pixels + p)).sum::<f32>() + weight(i);
                assert!((d_both[i] - (d[i] + own)).abs() < 1e-5 * (1.0 + own.abs()), "{i}");
                own_value += f64::from(x * weight(i));
            }
            assert!((total - value - own_value).abs() < 1e-4 * own_value.abs().max(1.0));
            assert_eq!((loss.l1, loss.ssim, loss.mse()), (plain.l1, plain.ssim, plain.mse()));
        }
    }

    #[test]
    fn exposures_have_the_gradient_of_the_value() {
        let color = planes("color");
        let mut loss = TrainLoss::photometric(0.0);
        loss.push(crate::loss::image::tv::TotalVariation(0.3));
        let mut e = exposure();
        eval(&mut loss, &mut [], &color, &mut e);
        // Small: every pixel whose difference changes its sign within a step is a kink of L1.
        let (key, h) = (e.key(), 1e-4f32);
        let got = e.grads.table(key).read::<12>(RIG, 0);
        for (col, got) in got.into_iter().enumerate() {
            let mut at = |by: f32| {
                let mut moved = exposure();
                *moved.params[key].get_mut(RIG, col) += by;
                eval(&mut loss, &mut [], &color, &mut moved).0
            };
            let fd = (at(h) - at(-h)) / f64::from(2.0 * h);
            assert!((fd - f64::from(got)).abs() < 0.02 * (0.05 + fd.abs()), "column {col}: {fd} {got}");
        }
    }
}
