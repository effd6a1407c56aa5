//! The trainer's image loss: photometric, mask, and a gain and offset a camera where exposures differ.

use super::chain::{ImageLoss, PictureGrads, View, Wanted};
use crate::loss::image::frequency::Frequency;
use crate::loss::image::{ImageTerms, entropy, flow, normal, tv};
use crate::loss::photometric::Photometric;
pub use crate::loss::terms::Segmentation;
use crate::optim::Moments;
use splat4d::render::Image;
use splat4d::scene::{Grads, Key, Params, Planes, Space};

/// A gain exp(m) and an offset c a camera and channel: columns m 3, c 3. The cameras' mean is held at the identity, so that
/// the scene keeps the rig's mean exposure and held-out cameras are drawn with it.
/// Source: Luiten et al. 2024 (gain and offset a camera); the fixed mean is ours.
#[derive(Debug)]
pub struct Exposure {
    /// One table [cameras, 6].
    pub params: Params<f32>,
    /// Its moments.
    pub moments: Moments<f32>,
    key: Key,
    grads: Grads<f32>,
    trained: Vec<usize>,
}

impl Exposure {
    /// The identity for every camera; only the `trained` ones ever change.
    pub fn new(cameras: usize, trained: Vec<usize>) -> Self {
        let mut params = Params::new(0, 0, &[]);
        let key = params
            .entry("exposure", Space::Fixed, &[("exposure", 6)], cameras, |_| {})
            .expect("a new table fits itself");
        Self { moments: Moments::new(&params), grads: Grads::new(&params), params, key, trained }
    }

    /// The table's key.
    pub fn key(&self) -> Key {
        self.key
    }

    /// Forgets what the last views gave.
    pub fn rest(&mut self) {
        self.grads.clear(&self.params);
    }

    /// One Adam step with what the last views gave. Returns whether all was finite.
    pub fn step(&mut self, rate: f64) -> bool {
        let mut rates = vec![None; self.key.0 as usize];
        rates.push(Some(vec![rate; 6]));
        let finite = self.moments.step(&mut self.params, &mut self.grads, &rates, &[]).is_empty();
        self.grads.clear(&self.params);
        let table = &mut self.params[self.key];
        for col in 0..6 {
            let sum: f64 = self.trained.iter().map(|&c| f64::from(table.get(c, col))).sum();
            let mean = (sum / self.trained.len().max(1) as f64) as f32;
            self.trained.iter().for_each(|&c| *table.get_mut(c, col) -= mean);
        }
        finite
    }
}

/// See the module's documentation.
pub struct TrainLoss {
    photometric: Photometric,
    /// Has scratch of its own, for one plane.
    masks: Photometric,
    lambda_mask: f32,
    /// Where cameras learn an exposure.
    pub exposure: Option<Exposure>,
    exposed: Planes<f32>,
    /// Where masks are compared with what Gaussians say of the foreground.
    pub segmentation: Option<Segmentation>,
    /// Further terms.
    pub terms: ImageTerms,
    /// Share of the stage that is done, in [0, 1).
    pub progress: f64,
    frequency: Frequency<f32>,
    /// L1 of the last view.
    pub l1: f64,
    /// SSIM of the last view.
    pub ssim: f64,
    /// Mean squared error of the last view, in [0, 1] colours, over the pixels that count.
    pub mse: f64,
}

impl TrainLoss {
    /// Shares of D-SSIM and of the mask loss.
    pub fn new(lambda_dssim: f64, lambda_mask: f64, exposure: Option<Exposure>) -> Self {
        Self {
            photometric: Photometric::new(lambda_dssim as f32),
            masks: Photometric::new(lambda_dssim as f32),
            lambda_mask: lambda_mask as f32,
            exposure,
            exposed: Planes::default(),
            segmentation: None,
            terms: ImageTerms::default(),
            progress: 0.0,
            frequency: Frequency::default(),
            l1: 0.0,
            ssim: 0.0,
            mse: 0.0,
        }
    }
}

impl ImageLoss<f32> for TrainLoss {
    fn wanted(&self) -> Wanted {
        let t = &self.terms;
        Wanted { depth: t.depth_tv > 0.0 || t.depth_normal > 0.0, normals: t.depth_normal > 0.0, flow: t.flow > 0.0 }
    }

    fn share(&self) -> Option<&str> {
        self.segmentation.as_ref().map(|s| s.column.as_str())
    }

    fn eval(&mut self, view: &View<'_, f32>, image: &Image<f32>, d: &mut PictureGrads<f32>) -> f64 {
        let row = self.exposure.as_ref().map(|e| e.params[e.key].read::<6>(view.rig, 0));
        if let Some(row) = row {
            self.exposed.clone_from(&image.color);
            for c in 0..3 {
                let gain = row[c].exp();
                self.exposed.plane_mut(c).iter_mut().for_each(|x| *x = *x * gain + row[3 + c]);
            }
        }
        let shown = if row.is_some() { &self.exposed } else { &image.color };
        let value = self.photometric.loss_and_grad(shown, view.truth, view.weight, &mut d.color);
        let mut total = value.total;
        let terms = self.terms;
        if terms.tv > 0.0 {
            total += tv::total_variation(shown, terms.tv, &mut d.color);
        }
        if terms.frequency > 0.0 {
            let (progress, weight) = (self.progress, terms.frequency);
            total += self.frequency.loss_and_grad(shown, view.truth, progress, weight, &mut d.color);
        }
        (self.l1, self.ssim, self.mse) = (value.l1, value.ssim, value.mse);
        if let (Some(row), Some(e)) = (row, &mut self.exposure) {
            let mut d_row = [0.0f32; 6];
            for c in 0..3 {
                let gain = row[c].exp();
                let (mut d_gain, mut d_offset) = (0.0f64, 0.0f64);
                for (g, x) in d.color.plane_mut(c).iter_mut().zip(image.color.plane(c)) {
                    d_offset += f64::from(*g);
                    d_gain += f64::from(*g * x * gain);
                    *g *= gain;
                }
                (d_row[c], d_row[3 + c]) = (d_gain as f32, d_offset as f32);
            }
            e.grads.of([e.key])[0].add(view.rig, 0, d_row);
        }
        if let Some(mask) = view.mask.filter(|_| self.lambda_mask > 0.0) {
            d.uses_alpha = true;
            let scale = self.lambda_mask / mask.pixels() as f32;
            let mut sum = 0.0f64;
            for ((d, a), m) in d.alpha.data.iter_mut().zip(&image.alpha.data).zip(&mask.data) {
                let e = a - m;
                sum += f64::from(e.abs());
                *d = if e > 0.0 {
                    scale
                } else if e < 0.0 {
                    -scale
                } else {
                    0.0
                };
            }
            total += sum * f64::from(scale);
        }
        total + self.segment(view, image, d) + self.beside(view, image, d)
    }
}

impl TrainLoss {
    /// What Gaussians say of the foreground, against the mask.
    fn segment(&mut self, view: &View<'_, f32>, image: &Image<f32>, d: &mut PictureGrads<f32>) -> f64 {
        let (Some(segmentation), Some(mask), Some(at)) = (&self.segmentation, view.mask, d.share) else { return 0.0 };
        d.uses_extra = true;
        let plane =
            |values: &[f32]| Planes { channels: 1, height: mask.height, width: mask.width, data: values.to_vec() };
        let (shown, mut d_shown) = (plane(image.extra.plane(at)), plane(d.extra.plane(at)));
        let value = self.masks.loss_and_grad(&shown, mask, view.weight, &mut d_shown);
        let weight = segmentation.weight as f32;
        d.extra.plane_mut(at).iter_mut().zip(&d_shown.data).for_each(|(d, x)| *d = weight * x);
        value.total * segmentation.weight
    }

    /// The terms that look at alpha, depth and further channels.
    fn beside(&self, view: &View<'_, f32>, image: &Image<f32>, d: &mut PictureGrads<f32>) -> f64 {
        let terms = &self.terms;
        let mut total = 0.0;
        if terms.mask_entropy > 0.0 {
            d.uses_alpha = true;
            total += entropy::mask_entropy(&image.alpha, terms.mask_entropy, &mut d.alpha);
        }
        if terms.depth_tv > 0.0 {
            (d.uses_alpha, d.uses_depth) = (true, true);
            let (depth, alpha) = (&image.depth, &image.alpha);
            total += tv::depth_smoothness(depth, alpha, view.truth, terms.depth_tv, &mut d.depth, &mut d.alpha);
        }
        if let Some(first) = d.normals {
            (d.uses_alpha, d.uses_depth, d.uses_extra) = (true, true, true);
            let normals = part(&image.extra, first);
            let mut d_normals = Planes::new(3, normals.height, normals.width);
            let pictures = [&image.depth, &image.alpha, &normals];
            let grads = [&mut d.depth, &mut d.alpha, &mut d_normals];
            total += normal::depth_normal(view.camera, pictures, terms.depth_normal, grads);
            put(&mut d.extra, first, &d_normals);
        }
        if let (Some(first), Some(truth)) = (d.flow, &view.flow) {
            d.uses_extra = true;
            let drawn = part(&image.extra, first);
            let mut d_drawn = Planes::new(3, drawn.height, drawn.width);
            total += flow::flow(&drawn, truth.vectors, terms.flow, &mut d_drawn);
            put(&mut d.extra, first, &d_drawn);
        }
        total
    }
}

/// Three channels from `first` on.
fn part(planes: &Planes<f32>, first: usize) -> Planes<f32> {
    let n = planes.pixels();
    let data = planes.data[first * n..(first + 3) * n].to_vec();
    Planes { channels: 3, height: planes.height, width: planes.width, data }
}

/// Puts three channels at `first`.
fn put(planes: &mut Planes<f32>, first: usize, channels: &Planes<f32>) {
    let n = planes.pixels();
    planes.data[first * n..(first + 3) * n].copy_from_slice(&channels.data);
}
