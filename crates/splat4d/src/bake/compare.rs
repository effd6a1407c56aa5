//! Baked against model: both rendered, from some cameras at some times.

use crate::Result;
use crate::format::playback::{Node, Primitive};
use crate::layers::{ALPHA_MIN, Evaluation, Scene};
use crate::math::quat;
use crate::math::sh::{MAX_COEFFS, rgb_to_dc};
use crate::math::sym3;
use crate::render::{Backend, Image, Shot};
use crate::scene::splats::{SPLAT_COLUMNS, Splats};
use crate::scene::{Camera, Color, Part, Rows, Table, Time};

/// PSNR where two images are the same, dB: rounding to 8 bits alone would give about 59.
const SAME: f64 = 99.0;

/// Similarity of the baked scene to the model.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Likeness {
    /// PSNR of all pixels together, dB.
    pub psnr: f64,
    /// The worst image's PSNR, dB.
    pub worst_psnr: f64,
    /// Second of the worst image.
    pub worst_time: f64,
    /// Images compared.
    pub pictures: usize,
}

/// The primitives of one time as splats; memory is reused.
#[derive(Debug)]
pub(crate) struct Moment {
    out: Table<f32>,
    sh: Table<f32>,
}

impl Default for Moment {
    fn default() -> Self {
        Self { out: Table::new(&SPLAT_COLUMNS, 0), sh: Table::new(&[("sh", 3 * MAX_COEFFS)], 0) }
    }
}

impl Moment {
    /// Takes what the nodes show at `time`, in their order. `time` is clamped to `clip`.
    pub(crate) fn fill<'a>(&mut self, nodes: impl IntoIterator<Item = &'a Node>, clip: [f64; 2], time: f64) {
        let t = time.max(clip[0]).min(clip[1]);
        let shown: Vec<(&Primitive, f64)> = nodes
            .into_iter()
            .filter(|n| n.from <= t && t < n.to)
            .flat_map(|n| n.primitives.iter().map(|p| (p, strength(p, t))))
            .filter(|(_, strength)| *strength >= ALPHA_MIN)
            .collect();
        self.out.resize(shown.len());
        self.sh.resize(shown.len());
        for (j, (p, strength)) in shown.into_iter().enumerate() {
            let delta = t - p.center;
            let mean = std::array::from_fn::<f32, 3, _>(|k| (p.mean[k] + f64::from(p.velocity[k]) * delta) as f32);
            let half = p.turn.map(|w| 0.5 * delta * f64::from(w));
            let q = p.quat.map(f64::from);
            let step = quat::product([0.0, half[0], half[1], half[2]], q);
            let q = quat::normalize(std::array::from_fn(|i| q[i] + step[i])).0;
            let cov = sym3::from_quat_log_scales(q, p.scales.map(|s| f64::from(s).ln()));
            self.out.write(j, 0, mean);
            self.out.write(j, 3, cov.map(|x| x as f32));
            self.out.write(j, 9, [strength as f32]);
            self.sh.write(j, 0, p.base_color.map(rgb_to_dc));
            self.sh.write(j, 3, p.sh_rest);
        }
    }

    /// The splats taken by [`fill`](Self::fill).
    pub(crate) fn splats(&self) -> Splats<'_> {
        let color = Color::Sh { table: &self.sh, rows: Rows::All, weights: None, base: false };
        Splats { parts: vec![Part::new(&self.out, color)], head: None }
    }
}

/// o·σ
fn strength(p: &Primitive, t: f64) -> f64 {
    if p.half_width == f64::INFINITY {
        return f64::from(p.opacity);
    }
    let over = ((t - p.center).abs() - p.half_width).max(0.0) / p.softness;
    f64::from(p.opacity) * (-0.5 * over * over).exp()
}

/// The baked scene that is compared with its model.
#[derive(Clone, Copy, Debug)]
pub enum Shown<'a> {
    /// Primitives before they are rounded into a file.
    Nodes(&'a [Node]),
    /// A scene read back from a file.
    File(&'a Scene<f32>),
}

/// Renders the baked scene and the model from these cameras at these times, clamped to the clip, and compares.
/// `progress` is called with the finished and the total number of images; `false` ends the comparison with those.
/// `None`: nothing was compared. Errors: the backend's.
pub fn compare(
    scene: &Scene<f32>,
    baked: Shown<'_>,
    shots: &[(f64, Camera)],
    backend: &mut dyn Backend,
    progress: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<Likeness>> {
    let (mut instant, mut moment) = (Evaluation::default(), Moment::default());
    let (mut truth, mut copy) = (Image::default(), Image::default());
    let mut played = Evaluation::default();
    let (mut sum, mut pixels, mut done) = (0.0, 0.0, 0);
    let mut worst = (f64::INFINITY, 0.0);
    for of_time in shots.chunk_by(|a, b| a.0 == b.0) {
        // Players stop at the clip's ends; a model continues beyond them.
        let time = of_time[0].0.max(scene.clip[0]).min(scene.clip[1]);
        scene.at(Time(time), &mut instant);
        match baked {
            Shown::Nodes(nodes) => moment.fill(nodes, scene.clip, time),
            Shown::File(file) => file.at(Time(time), &mut played),
        }
        let splats = match baked {
            Shown::Nodes(_) => moment.splats(),
            Shown::File(file) => file.splats(&played),
        };
        let model = scene.splats(&instant);
        for (_, camera) in of_time {
            backend.render(&Shot::new(&model, camera, scene.background), &mut truth)?;
            backend.render(&Shot::new(&splats, camera, scene.background), &mut copy)?;
            let square = |(a, b): (&f32, &f32)| f64::from(a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).powi(2);
            let error: f64 = truth.color.data.iter().zip(&copy.color.data).map(square).sum();
            let count = truth.color.data.len() as f64;
            let own = psnr(error / count.max(1.0));
            if own < worst.0 {
                worst = (own, time);
            }
            (sum, pixels, done) = (sum + error, pixels + count, done + 1);
            if !progress(done, shots.len()) {
                return Ok(likeness(sum, pixels, worst, done));
            }
        }
    }
    Ok(likeness(sum, pixels, worst, done))
}

fn likeness(sum: f64, pixels: f64, (worst_psnr, worst_time): (f64, f64), pictures: usize) -> Option<Likeness> {
    (pixels > 0.0).then(|| Likeness { psnr: psnr(sum / pixels), worst_psnr, worst_time, pictures })
}

fn psnr(mse: f64) -> f64 {
    (-10.0 * mse.log10()).min(SAME)
}
