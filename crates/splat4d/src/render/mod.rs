//! The differentiable renderer: [`Splats`](crate::scene::Splats) and a [`Camera`](crate::scene::Camera) become colour,
//! alpha, depth and further channels, and gradients to an image become gradients to every input and to the camera's
//! pose.
//!
//! Four stages, each public with its VJP: [`project`] (Gaussian → screen ellipse and the bins it touches), [`shade`]
//! (colour along the viewing direction), [`bin`] (sorted lists), [`rasterize`] (blending). [`Renderer`] runs them over
//! one arena that is reused from step to step. [`oracle`] is the slow f64 definition that they are tested against. The
//! renderer does not depend on time.
//!
//! The result has the same bits for any number of threads: every floating-point sum has a fixed order, and nothing is
//! ever added atomically.
//!
//! A network in [`Splats::head`](crate::scene::Splats::head) makes colours of blended channels (`head.rs`), with
//! gradients.

pub(crate) mod backend;
pub mod bin;
mod blend;
mod compare;
mod count;
mod gather;
mod head;
mod importance;
pub mod oracle;
mod parallel;
pub mod project;
pub mod rasterize;
mod resident;
pub mod roofline;
pub mod shade;
#[cfg(test)]
mod tests;

pub use crate::simd::Simd;
pub use backend::{Abilities, Backend, Shot, Tables};
pub use compare::{Comparison, Target};
pub(crate) use count::PairCounts;
pub use importance::{Importance, Sensitivity};
pub use oracle::Oracle;
pub use project::{Projected, ProjectedGrads, View};
pub use resident::{
    KEPT, Moves, Resident, ResidentCameras, ResidentLayer, ResidentNoise, ResidentNumbers, ResidentRule, ResidentStep,
    ResidentStepped, ResidentTable, ResidentTies, ResidentView, RowWeights,
};

use crate::math::Real;
use crate::scene::{HeadGrads, Planes, Table};
use crate::simd;
use bin::Footprint;
use head::Headed;
use project::Projection;
use rasterize::{CHANNELS, Geometry, Pass, PassGrads, PixelGrads, Raster};
use rayon::prelude::*;
use shade::ShadeGrads;
use std::time::Instant;

/// Whether thin splats are dimmed for the low-pass that widens them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Antialias {
    /// As plain 3DGS.
    #[default]
    Off,
    /// Opacity times ρ = √(det Σ0 / det(Σ0 + low_pass·I)), at least .005 (Mip-Splatting, gsplat).
    On,
}

/// Settings of the renderer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderConfig {
    /// α below this is skipped.
    pub alpha_min: f64,
    /// α is never above this.
    pub alpha_max: f64,
    /// A pixel stops before its transmittance would fall below this.
    pub transmittance_min: f64,
    /// Added to the screen covariance, px².
    pub low_pass: f64,
    /// Compensation for the low-pass.
    pub antialias: Antialias,
    /// Whether the backward pass sums absolute gradients ([`RenderGrads::mean2d_abs`]).
    pub abs_grads: bool,
    /// Instructions to use; lowered to those of the machine.
    pub simd: Simd,
    /// Bytes of ground-truth images that a device keeps; 0: a share of its free memory.
    pub device_images: u64,
}

/// The smallest α cut-off that differs from 0: an extent must be finite.
const ALPHA_FLOOR: f64 = 1e-30;
/// α never reaches 1, whatever the configuration: T must stay recoverable.
const ALPHA_CEILING: f64 = 1.0 - 1e-6;

impl RenderConfig {
    /// The cut-off and the ceiling of α that are rendered with.
    pub(crate) fn alpha_limits(&self) -> [f64; 2] {
        [self.alpha_min.max(ALPHA_FLOOR), self.alpha_max.min(ALPHA_CEILING)]
    }
}

impl Default for RenderConfig {
    /// The blend's limits as Kerbl et al. 2023; the best instructions of this machine.
    fn default() -> Self {
        Self {
            alpha_min: 1.0 / 255.0,
            alpha_max: 0.99,
            transmittance_min: 1e-4,
            low_pass: 0.3,
            antialias: Antialias::Off,
            abs_grads: false,
            simd: Simd::detect(),
            device_images: 0,
        }
    }
}

/// A rendered image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Image<F = f32> {
    /// Red, green, blue over the background, not clamped, after the head where there is one, [3, h, w].
    pub color: Planes<F>,
    /// 1 − final transmittance, [1, h, w].
    pub alpha: Planes<F>,
    /// Σ z α T, z in camera axes, [1, h, w]; [0, h, w] where [`Shot::depth`] is off.
    pub depth: Planes<F>,
    /// Further channels, without background, [C, h, w].
    pub extra: Planes<F>,
}

impl<F: Real> Image<F> {
    /// Expected depth D / max(A, `epsilon`), [1, h, w].
    pub fn expected_depth(&self, epsilon: F) -> Planes<F> {
        let mut out = self.depth.clone();
        for (d, &a) in out.data.iter_mut().zip(&self.alpha.data) {
            *d /= a.max(epsilon);
        }
        out
    }
}

/// Gradients to an image; `None` is zero.
#[derive(Clone, Copy, Debug)]
pub struct ImageGrads<'a, F = f32> {
    /// To colour, [3, h, w].
    pub color: &'a Planes<F>,
    /// To alpha, [1, h, w].
    pub alpha: Option<&'a Planes<F>>,
    /// To Σ z α T, [1, h, w].
    pub depth: Option<&'a Planes<F>>,
    /// To the further channels, [C, h, w].
    pub extra: Option<&'a Planes<F>>,
}

/// Gradients to one part of the splats, in its compact rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PartGrads<F = f32> {
    /// [splats, 10]: mean 3, covariance 6 (an off-diagonal represents both its positions), opacity 1.
    pub out: Table<F>,
    /// To direct colours [splats, C], or to SH that is not the layer's own [splats, 3·K·blocks].
    pub color: Option<Table<F>>,
    /// To the weights of SH blocks, [splats, blocks].
    pub weights: Option<Table<F>>,
}

/// Gradients to everything that was rendered.
#[derive(Clone, Debug, Default)]
pub struct RenderGrads<F = f32> {
    /// One per part.
    pub parts: Vec<PartGrads<F>>,
    /// To the further channels, [all splats, C].
    pub extra: Option<Table<F>>,
    /// To the weights of the head, where there is one.
    pub head: Option<HeadGrads<F>>,
    /// To the background.
    pub background: [F; 3],
    /// To a left perturbation exp(ρ, θ)·cam_from_world: ρ 3, θ 3.
    pub camera: [f64; 6],
    /// To the logarithm of the focal lengths, both at once.
    pub focal: f64,
    /// |dL/d mean2d| of every splat, x times width/2 and y times height/2, as densification thresholds assume.
    pub mean2d: Vec<F>,
    /// The same norm of Σ over pixels of |gradient| (AbsGS), if [`RenderConfig::abs_grads`] is on; passes over the
    /// pixels are summed apart. Else 0.
    pub mean2d_abs: Vec<F>,
}

/// Counts of the last render.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RenderStats {
    /// Splats given.
    pub splats: usize,
    /// Splats that touch the image.
    pub visible: usize,
    /// Pairs of bin and splat.
    pub pairs: usize,
}

/// Seconds that the stages of the last render and the last backward took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageSeconds {
    /// Projection and footprints.
    pub project: f64,
    /// Colours.
    pub shade: f64,
    /// Lists, sort and records.
    pub bin: f64,
    /// Blending, all passes, with the writing of the image.
    pub blend: f64,
    /// Blending backward, all passes, with the sums per splat.
    pub blend_backward: f64,
    /// Projection and colours backward.
    pub splats_backward: f64,
}

/// Renders splats and keeps what the backward pass needs. All memory is reused from call to call.
#[derive(Debug)]
pub struct Renderer<F = f32> {
    /// Options; may be changed between renders, not between a render and its backward.
    pub config: RenderConfig,
    size: [usize; 2],
    projected: Vec<Projected<F>>,
    footprints: Vec<Footprint>,
    /// Red, green, blue of every splat.
    channels: Vec<[F; CHANNELS]>,
    /// Depth and further channels of every splat, refilled for each pass.
    extra: Vec<[F; CHANNELS]>,
    raster: Raster<F>,
    d_projected: Vec<ProjectedGrads<F>>,
    d_channels: Vec<[F; CHANNELS]>,
    d_extra: Vec<[F; CHANNELS]>,
    radii: Vec<F>,
    headed: Headed<F>,
    camera_partial: Vec<[f64; project::CAMERA]>,
    center_partial: Vec<[f64; 3]>,
    seconds: StageSeconds,
}

impl<F: Real> Renderer<F> {
    /// A renderer without memory yet.
    pub fn new(config: RenderConfig) -> Self {
        Self {
            config,
            size: [0; 2],
            projected: Vec::new(),
            footprints: Vec::new(),
            channels: Vec::new(),
            extra: Vec::new(),
            raster: Raster::default(),
            d_projected: Vec::new(),
            d_channels: Vec::new(),
            d_extra: Vec::new(),
            radii: Vec::new(),
            headed: Headed::default(),
            camera_partial: Vec::new(),
            center_partial: Vec::new(),
            seconds: StageSeconds::default(),
        }
    }

    /// Renders a shot; see [`Backend::render`], which never fails here.
    pub fn render(&mut self, shot: &Shot<'_, F>, out: &mut Image<F>) {
        if let Some(extra) = shot.extra {
            assert_eq!(extra.rows(), shot.splats.len(), "further channels need one row a splat");
        }
        let Some(head) = shot.splats.head else { return self.blend(shot, out) };
        let mut headed = std::mem::take(&mut self.headed);
        headed.gather(shot.splats, shot.extra);
        self.blend(&Shot { extra: Some(&headed.table), ..*shot }, out);
        let mut clock = Clock::start();
        headed.forward(head, shot.camera, self.config.simd, out);
        self.seconds.blend += clock.lap();
        self.headed = headed;
    }

    /// Renders a shot without its head.
    fn blend(&mut self, shot: &Shot<'_, F>, out: &mut Image<F>) {
        let Shot { splats, camera, background, extra, sh_degree, .. } = *shot;
        let n = splats.len();
        let (w, h) = (camera.width, camera.height);
        let simd = self.config.simd;
        let view = View::new(camera, &self.config);
        self.size = [w, h];
        self.projected.resize(n, Projected::default());
        self.footprints.resize(n, Footprint::default());
        self.channels.resize(n, [F::ZERO; CHANNELS]);
        let mut clock = Clock::start();
        self.radii.resize(n, F::ZERO);
        project::forward(splats, &view, simd, &mut self.projected, &mut self.footprints, &mut self.radii);
        self.seconds.project = clock.lap();
        let projection = Projection { splats, view: &view, simd, projected: &self.projected };
        shade::forward(&projection, sh_degree, &mut self.channels);
        self.seconds.shade = clock.lap();
        self.raster.prepare(&self.projected, &self.footprints, w, h, simd);
        self.seconds.bin = clock.lap();
        self.blend_colors(background);
        let (depths, widths) = (usize::from(shot.depth), extra.map_or(0, Table::width));
        reshape(&mut out.color, 3, h, w);
        reshape(&mut out.alpha, 1, h, w);
        reshape(&mut out.depth, depths, h, w);
        reshape(&mut out.extra, widths, h, w);
        let (red, rest) = out.color.data.split_at_mut(w * h);
        let (green, blue) = rest.split_at_mut(w * h);
        self.raster.picture(background, [red, green, blue], out.alpha.plane_mut(0));
        for first in passes(shot) {
            self.pack(shot, first);
            self.blend_extra();
            for c in first..(depths + widths).min(first + CHANNELS) {
                let plane = if c < depths { out.depth.plane_mut(c) } else { out.extra.plane_mut(c - depths) };
                self.raster.channel(c - first, plane);
            }
        }
        self.seconds.blend = clock.lap();
    }

    /// Blends the colours' pass.
    fn blend_colors(&mut self, background: [F; CHANNELS]) {
        self.raster.blend(&Pass {
            projected: &self.projected,
            footprints: &self.footprints,
            channels: &self.channels,
            background,
            config: &self.config,
        });
    }

    /// Blends the pass that was [packed](Self::pack).
    fn blend_extra(&mut self) {
        self.raster.blend(&Pass {
            projected: &self.projected,
            footprints: &self.footprints,
            channels: &self.extra,
            background: [F::ZERO; CHANNELS],
            config: &self.config,
        });
    }

    /// Fills [`Self::extra`] for the pass that begins with channel `first`; channels that there are not are 0.
    fn pack(&mut self, shot: &Shot<'_, F>, first: usize) {
        let depths = usize::from(shot.depth);
        self.extra.resize(self.projected.len(), [F::ZERO; CHANNELS]);
        let rows = self.extra.par_iter_mut().zip(&self.projected).with_min_len(4096).enumerate();
        rows.for_each(|(j, (row, projected))| {
            *row = std::array::from_fn(|k| match (first + k).checked_sub(depths) {
                None => projected.depth,
                Some(c) => shot.extra.filter(|table| c < table.width()).map_or(F::ZERO, |table| table.get(j, c)),
            });
        });
    }

    /// VJP of the last [`Renderer::render`]; see [`Backend::vjp`], which never fails here.
    pub fn backward(
        &mut self,
        shot: &Shot<'_, F>,
        grads: &ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) {
        let n = shot.splats.len();
        let size = [shot.camera.width, shot.camera.height];
        assert!(
            self.size == size && self.projected.len() == n,
            "backward must follow the render of the same splats and camera: {n} splats now, {} then",
            self.projected.len()
        );
        let plane = |planes: Option<&'_ Planes<F>>, channels: usize| {
            if let Some(p) = planes {
                let shape = [p.channels, p.height, p.width];
                assert_eq!(shape, [channels, size[1], size[0]], "an image's gradient has the image's shape");
            }
        };
        plane(Some(grads.color), 3);
        plane(grads.alpha, 1);
        plane(grads.depth, usize::from(shot.depth));
        plane(grads.extra, shot.extra.map_or(0, Table::width));
        d.head = None;
        match shot.splats.head {
            None => self.backward_blended(shot, grads, d_sh, d),
            Some(head) => self.backward_headed(head, shot, grads, d_sh, d),
        }
    }

    /// VJP of [`Self::blend`].
    fn backward_blended(
        &mut self,
        shot: &Shot<'_, F>,
        grads: &ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) {
        let (splats, simd) = (shot.splats, self.config.simd);
        let (n, size) = (splats.len(), [shot.camera.width, shot.camera.height]);
        let view = View::new(shot.camera, &self.config);
        self.d_projected.resize(n, ProjectedGrads::default());
        self.d_channels.resize(n, [F::ZERO; CHANNELS]);

        let mut clock = Clock::start();
        // The tiles hold the last pass; the colours' come last, and are blended again if that was another.
        let geometry = self.backward_extra(shot, grads, &mut d.extra);
        if passes(shot).next().is_some() {
            self.blend_colors(shot.background);
        }
        let pixels = PixelGrads {
            channels: std::array::from_fn(|c| Some(grads.color.plane(c))),
            alpha: grads.alpha.map(|p| p.plane(0)),
        };
        let pass = Pass {
            projected: &self.projected,
            footprints: &self.footprints,
            channels: &self.channels,
            background: shot.background,
            config: &self.config,
        };
        let mut d_pass = PassGrads { geometry, projected: &mut self.d_projected, channels: &mut self.d_channels };
        let d_background = self.raster.backward(&pass, &pixels, &mut d_pass);
        d.background = std::array::from_fn(|c| F::of(d_background[c]));

        self.seconds.blend_backward = clock.lap();
        // The norms of the screen gradient are what densification reads.
        d.mean2d.resize(n, F::ZERO);
        d.mean2d_abs.resize(n, F::ZERO);
        let half = [F::of(0.5 * size[0] as f64), F::of(0.5 * size[1] as f64)];
        let norm = |v: [F; 2]| {
            let (x, y) = (v[0] * half[0], v[1] * half[1]);
            (x * x + y * y).sqrt()
        };
        let norms = d.mean2d.par_iter_mut().zip(d.mean2d_abs.par_iter_mut());
        self.d_projected.par_iter().zip(norms).with_min_len(2048).for_each(|(row, (mean2d, mean2d_abs))| {
            *mean2d = norm(row.mean2d);
            *mean2d_abs = norm(row.mean2d_abs);
        });

        d.parts.resize_with(splats.parts.len(), PartGrads::default);
        for (part, out) in splats.parts.iter().zip(&mut d.parts) {
            project::reshape(&mut out.out, part.out);
        }
        let mut d_camera = [0.0; project::CAMERA];
        let projection = Projection { splats, view: &view, simd, projected: &self.projected };
        project::backward(&projection, &self.d_projected, &mut d.parts, &mut d_camera, &mut self.camera_partial);
        d.camera.copy_from_slice(&d_camera[..6]);
        d.focal = d_camera[6];
        let (parts, pose, partial) = (&mut d.parts[..], &mut d.camera, &mut self.center_partial);
        let mut d_colors = ShadeGrads { sh: d_sh, parts, pose, partial };
        shade::backward(&projection, shot.sh_degree, &self.channels, &self.d_channels, &mut d_colors);
        self.seconds.splats_backward = clock.lap();
    }

    /// The passes of depth and further channels, last one first: overwrites the geometry's gradient and `d_extra`.
    /// Returns what the colours' pass is to do with the former.
    fn backward_extra(
        &mut self,
        shot: &Shot<'_, F>,
        grads: &ImageGrads<'_, F>,
        d_extra: &mut Option<Table<F>>,
    ) -> Geometry {
        match shot.extra {
            None => *d_extra = None,
            Some(table) => {
                let out = d_extra.get_or_insert_with(|| Table::with_columns(table.columns().to_vec(), 0));
                project::reshape(out, table);
                out.fill(F::ZERO);
            }
        }
        let (depths, widths) = (usize::from(shot.depth), shot.extra.map_or(0, Table::width));
        let plane = |c: usize| match c.checked_sub(depths) {
            None => grads.depth.map(|p| p.plane(0)),
            Some(c) => grads.extra.filter(|_| c < widths).map(|p| p.plane(c)),
        };
        self.d_extra.resize(self.projected.len(), [F::ZERO; CHANNELS]);
        let last = passes(shot).next_back();
        let mut geometry = Geometry::Overwrite;
        for first in passes(shot).rev() {
            let pixels = PixelGrads { channels: std::array::from_fn(|k| plane(first + k)), alpha: None };
            if pixels.channels.iter().all(Option::is_none) {
                continue;
            }
            self.pack(shot, first);
            if Some(first) != last {
                self.blend_extra();
            }
            let pass = Pass {
                projected: &self.projected,
                footprints: &self.footprints,
                channels: &self.extra,
                background: [F::ZERO; CHANNELS],
                config: &self.config,
            };
            let mut d_pass = PassGrads { geometry, projected: &mut self.d_projected, channels: &mut self.d_extra };
            self.raster.backward(&pass, &pixels, &mut d_pass);
            geometry = Geometry::Add;
            for (j, d) in self.d_extra.iter().enumerate() {
                for (k, &d) in d.iter().enumerate() {
                    match (first + k).checked_sub(depths) {
                        None => self.d_projected[j].depth += d,
                        Some(c) if c < widths => d_extra.as_mut().expect("made above").set(j, c, d),
                        Some(_) => {}
                    }
                }
            }
        }
        geometry
    }

    /// Radius of every splat of the last render: 3σ of the larger axis, pixels; 0: not rendered.
    pub(crate) fn radii(&self) -> &[F] {
        &self.radii
    }

    /// Screen ellipses of the last render, one per splat; radius 0: not rendered.
    pub(crate) fn projected(&self) -> &[Projected<F>] {
        &self.projected
    }

    /// Pairs of the last render's blend loop, counted again, slowly; only the last run of bins of an absurd scene.
    pub fn count_pairs(&self) -> PairCounts {
        self.raster.count_pairs(&self.config)
    }

    /// Bytes of memory held.
    pub fn memory_bytes(&self) -> usize {
        let channels = self.channels.capacity() + self.extra.capacity();
        let d_channels = self.d_channels.capacity() + self.d_extra.capacity();
        self.raster.memory_bytes()
            + self.projected.capacity() * size_of::<Projected<F>>()
            + self.footprints.capacity() * size_of::<Footprint>()
            + (channels + d_channels) * size_of::<[F; CHANNELS]>()
            + self.d_projected.capacity() * size_of::<ProjectedGrads<F>>()
            + self.radii.capacity() * size_of::<F>()
    }

    /// Seconds of the stages of the last render and the last backward.
    pub fn stage_seconds(&self) -> StageSeconds {
        self.seconds
    }

    /// Counts of the last render.
    pub fn stats(&self) -> RenderStats {
        RenderStats {
            splats: self.projected.len(),
            visible: self.radii.iter().filter(|&&r| r > F::ZERO).count(),
            pairs: self.raster.pairs(),
        }
    }
}

/// First channels of the passes after that of the colours: depth, if it is rendered, then what the caller gave.
fn passes<F: Real>(shot: &Shot<'_, F>) -> impl DoubleEndedIterator<Item = usize> + use<F> {
    let count = usize::from(shot.depth) + shot.extra.map_or(0, Table::width);
    (0..count.div_ceil(CHANNELS)).map(|pass| pass * CHANNELS)
}

/// Times consecutive stages.
struct Clock(Instant);

impl Clock {
    fn start() -> Self {
        Self(Instant::now())
    }

    /// Seconds since the start or the last lap.
    fn lap(&mut self) -> f64 {
        let now = Instant::now();
        (now - std::mem::replace(&mut self.0, now)).as_secs_f64()
    }
}

/// Sizes an image that is about to be overwritten; pixels keep what they held.
fn reshape<F: Real>(planes: &mut Planes<F>, channels: usize, height: usize, width: usize) {
    (planes.channels, planes.height, planes.width) = (channels, height, width);
    planes.data.resize(channels * height * width, F::ZERO);
}
