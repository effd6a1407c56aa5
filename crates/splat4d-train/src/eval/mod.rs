//! Measures renders and writes the scores in the files of 3DGS.
//!
//! [`score_view`] measures one image, a [`Split`] holds the images of the held-out or the training cameras, and
//! [`run::evaluate`] writes `results.json` (means) and `per_view.json` in the layout of the 3DGS scripts.

mod align;
mod colour;
mod conv;
pub mod floaters;
pub mod flow;
pub(crate) mod lpips;
pub mod metrics;
mod report;
pub mod run;
pub mod trajectory;

pub use align::Align;
pub use lpips::{InputScaling, Lpips};
pub use report::{CameraScores, Conditions, Report, Score, Split, View};

use splat4d::scene::Planes;

/// The context of a view in addition to its two images.
#[derive(Clone, Copy, Debug, Default)]
pub struct ViewContext<'a> {
    /// The pixels `[H·W]` that a mask calls foreground; `None` where the capture has no masks.
    pub foreground: Option<&'a [bool]>,
    /// The pixels `[H·W]` that move (`metrics::dynamic_region`); `None` where the camera is not fixed.
    pub dynamic: Option<&'a [bool]>,
    /// A network, and how images enter it; `None` where the user named no weights.
    pub lpips: Option<(&'a Lpips, InputScaling)>,
}

/// All metrics of one view but `PSNR-cc`, which depends on its camera's other views ([`run::assess`]).
///
/// Keys: `PSNR`, `SSIM`, `MS-SSIM`, `D-SSIM`, `PSNR-dynamic`, with masks `PSNR-foreground`, with a network `LPIPS-alex`,
/// `LPIPS-vgg` or `LPIPS-squeeze` (with ` (input 0..1)` behind it for [`InputScaling::Unit`]). Shapes: `[3,H,W]` both; the name is the
/// image's file name. Panics: shapes differ.
pub fn score_view(name: &str, render: &Planes<f32>, truth: &Planes<f32>, context: &ViewContext<'_>) -> View {
    let mut view = View::new(name);
    view.set("PSNR", Score::or(metrics::psnr(render, truth), "the image has no pixels"));
    let ssim = metrics::ssim(render, truth);
    view.set("SSIM", Score::or(ssim, "the image has no pixels"));
    view.set("D-SSIM", Score::or(ssim.map(metrics::d_ssim), "the image has no pixels"));
    let too_small = format!("not defined: the shorter side is below {} pixels", metrics::MS_SSIM_MIN_SIDE);
    view.set("MS-SSIM", Score::or(metrics::ms_ssim(render, truth), too_small));
    if let Some(region) = context.foreground {
        let value = metrics::psnr_region(render, truth, region);
        view.set("PSNR-foreground", Score::or(value, "not defined: the mask holds no foreground"));
    }
    view.set(
        "PSNR-dynamic",
        match context.dynamic {
            None => Score::Undefined("not defined: the camera is not fixed, so it has no temporal mean".into()),
            Some(region) => Score::or(metrics::psnr_region(render, truth, region), "not defined: no pixel moves"),
        },
    );
    if let Some((lpips, scaling)) = context.lpips {
        let label = match scaling {
            InputScaling::Signed => lpips.net().label().to_string(),
            InputScaling::Unit => format!("{} (input 0..1)", lpips.net().label()),
        };
        let value = lpips.distance(render, truth, scaling);
        view.set(&label, Score::or(value, "not defined: the image is too small for the network"));
    }
    view
}
