//! Segmentation: a column of the Gaussians that states who is foreground, rendered and compared with the masks.

use super::{Channel, ImageTerm, LossGrads, Needs, Shown, View};
use crate::loss::photometric::Photometric;
use crate::loss::terms::StepInfo;
use splat4d::scene::Planes;

/// The sigmoid of a column, blended, against the mask with the same functional as colours.
///
/// Source: Luiten et al. 2024, "seg".
#[derive(Debug)]
pub(crate) struct Segmentation {
    channel: Channel,
    weight: f64,
    photometric: Photometric,
    d_shown: Planes<f32>,
}

impl Segmentation {
    /// Of a column group of one logit, with a weight next to the colours' and their share of D-SSIM.
    pub(crate) fn new(column: &str, weight: f64, dssim: f64) -> Self {
        let photometric = Photometric::new(dssim as f32);
        Self { channel: Channel::Sigmoid(column.to_owned()), weight, photometric, d_shown: Planes::default() }
    }
}

impl ImageTerm for Segmentation {
    fn needs(&self, view: &View<'_>) -> Needs {
        Needs { depth: false, extra: view.mask.map(|_| self.channel.clone()).into_iter().collect() }
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_>, shown: &Shown<'_>, d: &mut LossGrads) -> f64 {
        let (Some(mask), Some((first, drawn))) = (view.mask, shown.channel(&self.channel)) else { return 0.0 };
        let value = self.photometric.loss_and_grad(&drawn, mask, view.weight, &mut self.d_shown);
        let weight = self.weight as f32;
        self.d_shown.data.iter_mut().for_each(|d| *d *= weight);
        d.add_extra(first, &self.d_shown);
        value.total * self.weight
    }
}
