//! The fixed chain of one step: `motion.at → render → loss → render.backward → motion.backward`.
//!
//! Views and the questions of losses that look at several times are merged: one `prepare`, one `at` and one `backward`
//! for every distinct (layer, space, time), one `finish`.

pub use super::channels::Wanted;
use super::channels::{Channels, Later};
pub use crate::capture::frames::FlowTruth;
pub use crate::learner::Observation;
pub use crate::loss::terms::{ParamLoss, Probe, ProbeLoss, StepInfo};
use splat4d::layers::{LayerTape, Scene};
use splat4d::math::Real;
use splat4d::motion::{At, Cache};
use splat4d::render::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer};
use splat4d::scene::table::halve;
use splat4d::scene::{Camera, Color, Grads, Key, Params, Planes, Rows, SH, Space, SplatGrads, Splats, Table, Time};
use std::time::{Duration, Instant as Clock};

/// Draws splats and takes gradients back; [`Renderer`] is the one in use, tests put the oracle here.
pub trait Draw<F: Real>: Send {
    /// Fills `out`; `extra` [all splats, C] holds further channels.
    fn render(
        &mut self,
        splats: &Splats<'_, F>,
        camera: &Camera,
        background: [F; 3],
        extra: Option<&Table<F>>,
        out: &mut Image<F>,
    );
    /// The VJP of the last `render`; see [`Renderer::backward`].
    fn backward(
        &mut self,
        splats: &Splats<'_, F>,
        camera: &Camera,
        background: [F; 3],
        extra: Option<&Table<F>>,
        grads: &ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    );
    /// Pixel radius of every splat of the last `render`, 0 where culled.
    fn radii(&self) -> &[F];
    /// The settings, to change the SH degree between steps.
    fn config(&mut self) -> &mut RenderConfig;
}

impl<F: Real> Draw<F> for Renderer<F> {
    fn render(
        &mut self,
        splats: &Splats<'_, F>,
        camera: &Camera,
        background: [F; 3],
        extra: Option<&Table<F>>,
        out: &mut Image<F>,
    ) {
        Renderer::render(self, splats, camera, background, extra, out);
    }

    fn backward(
        &mut self,
        splats: &Splats<'_, F>,
        camera: &Camera,
        background: [F; 3],
        extra: Option<&Table<F>>,
        grads: &ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) {
        Renderer::backward(self, splats, camera, background, extra, grads, d_sh, d);
    }

    fn radii(&self) -> &[F] {
        Renderer::radii(self)
    }

    fn config(&mut self) -> &mut RenderConfig {
        &mut self.config
    }
}

/// One picture that the scene is compared with.
#[derive(Clone, Copy, Debug)]
pub struct View<'a, F = f32> {
    /// From where.
    pub camera: &'a Camera,
    /// When.
    pub t: Time,
    /// Colour behind the scene.
    pub background: [F; 3],
    /// The truth, 3 channels.
    pub truth: &'a Planes<F>,
    /// Foreground mask, 1 channel.
    pub mask: Option<&'a Planes<F>>,
    /// Pixels that count, 1 channel.
    pub weight: Option<&'a Planes<F>>,
    /// Where its pixels go, as far as that is known.
    pub flow: Option<FlowTruth<'a, F>>,
    /// The frame's number in the capture, for messages.
    pub frame: usize,
    /// The camera's number in the capture, for the exposure.
    pub rig: usize,
}

/// The gradient to a picture, as a loss fills it.
#[derive(Clone, Debug, Default)]
pub struct PictureGrads<F = f32> {
    /// To colour, [3, h, w]: to be overwritten.
    pub color: Planes<F>,
    /// To alpha, [1, h, w]: begins as zeros.
    pub alpha: Planes<F>,
    /// To Σ z α T, [1, h, w]: begins as zeros, where depth is drawn.
    pub depth: Planes<F>,
    /// To the further channels, [C, h, w]: begins as zeros.
    pub extra: Planes<F>,
    /// Whether alpha takes part; to be set.
    pub uses_alpha: bool,
    /// Whether depth does.
    pub uses_depth: bool,
    /// Whether further channels do.
    pub uses_extra: bool,
    /// First further channel of the normals, where they are drawn.
    pub normals: Option<usize>,
    /// First further channel of the flow, where it is drawn.
    pub flow: Option<usize>,
    /// The further channel of [`ImageLoss::share`], where it is drawn.
    pub share: Option<usize>,
}

impl<F: Real> PictureGrads<F> {
    /// Zeros in the shape of `image`, nothing used.
    pub fn begin(&mut self, image: &Image<F>) {
        let (h, w) = (image.color.height, image.color.width);
        self.alpha.reset(1, h, w);
        self.depth.reset(image.depth.channels, h, w);
        self.extra.reset(image.extra.channels, h, w);
        (self.uses_alpha, self.uses_depth, self.uses_extra) = (false, false, false);
        (self.normals, self.flow, self.share) = (None, None, None);
    }
}

/// Compares a picture with its truth.
pub trait ImageLoss<F: Real> {
    /// What is to be drawn beside colour and alpha.
    fn wanted(&self) -> Wanted {
        Wanted::default()
    }
    /// A column group of one logit a Gaussian whose sigmoid is to be drawn as a further channel of views that have a mask
    /// (0 in layers without that column).
    fn share(&self) -> Option<&str> {
        None
    }
    /// The loss; overwrites `d.color`, adds to what else it uses and says so.
    fn eval(&mut self, view: &View<'_, F>, image: &Image<F>, d: &mut PictureGrads<F>) -> f64;
}

/// Where a step's time went.
#[derive(Clone, Copy, Debug, Default)]
pub struct Timings {
    /// `prepare` and `at`.
    pub motion: Duration,
    /// Drawing.
    pub render: Duration,
    /// Image, probe and parameter losses with their gradients.
    pub loss: Duration,
    /// The renderer's VJP.
    pub render_backward: Duration,
    /// The motion's VJP and `finish`.
    pub motion_backward: Duration,
}

/// The result of a step.
#[derive(Clone, Debug, Default)]
pub struct StepReport {
    /// All losses together.
    pub loss: f64,
    /// The image loss of every view.
    pub view_losses: Vec<f64>,
    /// dL/dt of every view's time: the same number for views at one time, which share it.
    pub d_times: Vec<f64>,
    /// dL/d pose of every view, left perturbation (ρ, θ).
    pub d_cameras: Vec<[f64; 6]>,
    /// Where the time went.
    pub timings: Timings,
}

/// One distinct (layer, space, time) of a step.
struct Ask<F: Real> {
    layer: usize,
    tape: LayerTape<F>,
    /// Whether the gradients below are this step's.
    begun: bool,
    d_out: Table<F>,
    d_color: Option<Table<F>>,
    d_weights: Option<Table<F>>,
    d_time: f64,
}

/// The chain's arena: reused from step to step.
pub struct Chain<F: Real = f32> {
    asks: Vec<Ask<F>>,
    spare: Vec<Ask<F>>,
    caches: Vec<(Cache, Cache)>,
    image: Image<F>,
    d_image: PictureGrads<F>,
    d_render: RenderGrads<F>,
    /// Number of `Motion::at` calls of the last step, for tests and reports.
    pub at_calls: usize,
}

impl<F: Real> Default for Chain<F> {
    fn default() -> Self {
        Self {
            asks: Vec::new(),
            spare: Vec::new(),
            caches: Vec::new(),
            image: Image::default(),
            d_image: PictureGrads::default(),
            d_render: RenderGrads::default(),
            at_calls: 0,
        }
    }
}

/// The losses of a step.
pub struct Losses<'a, F: Real> {
    /// Compares pictures.
    pub image: &'a mut dyn ImageLoss<F>,
    /// Look at several times.
    pub probes: &'a [Box<dyn ProbeLoss<F>>],
    /// Look at raw parameters.
    pub params: &'a [Box<dyn ParamLoss<F>>],
}

impl<F: Real> Chain<F> {
    /// One step: adds all gradients to `d` (one a layer, cleared by the caller). `observe` is told of every view.
    pub fn step(
        &mut self,
        scene: &Scene<F>,
        views: &[View<'_, F>],
        info: &StepInfo,
        draw: &mut dyn Draw<F>,
        losses: &mut Losses<'_, F>,
        d: &mut [Grads<F>],
        observe: &mut dyn FnMut(Observation<'_, F>),
    ) -> StepReport {
        assert_eq!(d.len(), scene.layers.len(), "a gradient a layer is needed");
        let mut report = StepReport::default();
        let clock = Clock::now();
        let probes: Vec<Vec<Probe>> = losses.probes.iter().map(|l| l.probes(scene, info)).collect();
        self.ask(scene, views, losses.image.wanted(), &probes);
        self.caches.resize_with(scene.layers.len(), Default::default);
        for (layer, (cache, d_cache)) in self.caches.iter_mut().enumerate() {
            *d_cache = Cache::default();
            let questions = questions(&self.asks, scene, layer);
            scene.layers[layer].motion.prepare(&scene.layers[layer].params, &questions, cache);
        }
        self.at_calls = self.asks.len();
        for ask in &mut self.asks {
            scene.layers[ask.layer].at(&self.caches[ask.layer].0, &mut ask.tape);
            (ask.begun, ask.d_time) = (false, 0.0);
            d[ask.layer].activate(ask.tape.space(), ask.tape.rows());
        }
        report.timings.motion = clock.elapsed();
        for view in views {
            self.view(scene, view, draw, losses.image, d, observe, &mut report);
        }
        let clock = Clock::now();
        for ask in self.asks.iter_mut().filter(|a| !a.begun) {
            reset_like(&mut ask.d_out, ask.tape.out());
            (ask.d_color, ask.d_weights) = (None, None);
        }
        for (loss, probes) in losses.probes.iter().zip(&probes) {
            if !probes.is_empty() {
                report.loss += self.probe(scene, loss.as_ref(), probes);
            }
        }
        for loss in losses.params {
            report.loss += loss.eval(scene, info, d);
        }
        report.timings.loss += clock.elapsed();
        let clock = Clock::now();
        for ask in &mut self.asks {
            let (cache, d_cache) = &mut self.caches[ask.layer];
            let d_out = SplatGrads { out: &ask.d_out, color: ask.d_color.as_ref(), weights: ask.d_weights.as_ref() };
            ask.d_time = scene.layers[ask.layer].backward(cache, &mut ask.tape, &d_out, d_cache, &mut d[ask.layer]);
        }
        for (layer, (cache, d_cache)) in self.caches.iter_mut().enumerate() {
            let questions = questions(&self.asks, scene, layer);
            let l = &scene.layers[layer];
            l.motion.finish(&l.params, &questions, cache, d_cache, &mut d[layer]);
        }
        report.timings.motion_backward = clock.elapsed();
        for view in views {
            let of_view = |a: &&Ask<F>| a.tape.space() == Space::Gaussians && a.tape.time() == view.t;
            report.d_times.push(self.asks.iter().filter(of_view).map(|a| a.d_time).sum());
        }
        report
    }

    /// Collects the distinct questions: what views see is what is alive, probes add their rows.
    fn ask(&mut self, scene: &Scene<F>, views: &[View<'_, F>], wanted: Wanted, probes: &[Vec<Probe>]) {
        self.spare.append(&mut self.asks);
        for view in views {
            for (layer, l) in scene.layers.iter().enumerate() {
                if self.find(layer, Space::Gaussians, view.t).is_none() {
                    let mut ask = self.spare.pop().unwrap_or_else(Ask::new);
                    ask.layer = layer;
                    ask.tape.ask_active(l, view.t);
                    self.asks.push(ask);
                }
            }
        }
        for probe in probes.iter().flatten() {
            for &t in &probe.times {
                self.ask_rows(probe.layer, probe.of, probe.rows.as_deref().map_or(Rows::All, Rows::Some), t);
            }
        }
        for (view, flow) in views.iter().filter_map(|v| Some((v, v.flow.as_ref().filter(|_| wanted.flow)?))) {
            for layer in 0..scene.layers.len() {
                let i = self.find(layer, Space::Gaussians, view.t).expect("every view's time was asked");
                match self.asks[i].tape.rows() {
                    Rows::All => self.ask_rows(layer, Space::Gaussians, Rows::All, flow.to),
                    Rows::Some(ids) => {
                        let ids = ids.to_vec();
                        self.ask_rows(layer, Space::Gaussians, Rows::Some(&ids), flow.to);
                    }
                }
            }
        }
    }

    /// Asks for rows at a time, beside those that are asked already.
    fn ask_rows(&mut self, layer: usize, of: Space, wanted: Rows<'_>, t: Time) {
        let Some(i) = self.find(layer, of, t) else {
            let mut ask = self.spare.pop().unwrap_or_else(Ask::new);
            ask.layer = layer;
            ask.tape.ask(of, wanted, t);
            self.asks.push(ask);
            return;
        };
        let tape = &mut self.asks[i].tape;
        match (tape.rows(), wanted) {
            (Rows::All, _) => {}
            (_, Rows::All) => tape.ask(of, Rows::All, t),
            (Rows::Some(a), Rows::Some(b)) => {
                let both = union(a, b);
                tape.ask(of, Rows::Some(&both), t);
            }
        }
    }

    fn find(&self, layer: usize, of: Space, t: Time) -> Option<usize> {
        self.asks.iter().position(|a| a.layer == layer && a.tape.space() == of && a.tape.time() == t)
    }

    /// Draws one view, compares it, and takes the gradient back to its splats.
    fn view(
        &mut self,
        scene: &Scene<F>,
        view: &View<'_, F>,
        draw: &mut dyn Draw<F>,
        loss: &mut dyn ImageLoss<F>,
        d: &mut [Grads<F>],
        observe: &mut dyn FnMut(Observation<'_, F>),
        report: &mut StepReport,
    ) {
        let asked: Vec<usize> = (0..scene.layers.len())
            .map(|layer| self.find(layer, Space::Gaussians, view.t).expect("every view's time was asked"))
            .collect();
        let parts = asked.iter().enumerate().map(|(layer, &i)| scene.layers[layer].part(&self.asks[i].tape)).collect();
        let splats = Splats { parts, head: scene.head_weights() };
        let clock = Clock::now();
        let wanted = loss.wanted();
        let column = loss.share().filter(|_| view.mask.is_some()).map(str::to_owned);
        let keys: Vec<Option<(Key, usize)>> = match &column {
            Some(column) => scene.layers.iter().map(|l| logit_of(&l.params, column)).collect(),
            None => Vec::new(),
        };
        let share = keys.iter().any(Option::is_some).then(|| self.share(scene, &asked, &keys));
        let ways = view.flow.as_ref().filter(|_| wanted.flow).map(|f| self.ways(f.to, &asked));
        let channels = {
            let parts: Vec<&Table<F>> = asked.iter().map(|&i| self.asks[i].tape.out()).collect();
            let later: Vec<Later<'_, F>> = ways.iter().flatten().map(|w| w.later(&self.asks)).collect();
            let flow = view.flow.as_ref().filter(|_| ways.is_some()).map(|f| (f, &later[..]));
            Channels::new(wanted, view.camera, &parts, flow, share.as_deref())
        };
        let extra = channels.as_ref().map(|c| &c.table);
        draw.config().depth = wanted.depth;
        draw.render(&splats, view.camera, view.background, extra, &mut self.image);
        report.timings.render += clock.elapsed();
        let clock = Clock::now();
        let d_image = &mut self.d_image;
        d_image.begin(&self.image);
        d_image.normals = channels.as_ref().and_then(Channels::normals);
        d_image.flow = channels.as_ref().and_then(Channels::flow);
        d_image.share = channels.as_ref().and_then(Channels::share);
        let value = loss.eval(view, &self.image, d_image);
        report.loss += value;
        report.view_losses.push(value);
        report.timings.loss += clock.elapsed();
        let clock = Clock::now();
        let grads = ImageGrads {
            color: &d_image.color,
            alpha: d_image.uses_alpha.then_some(&d_image.alpha),
            depth: d_image.uses_depth.then_some(&d_image.depth),
            extra: d_image.uses_extra.then_some(&d_image.extra),
        };
        let mut d_sh: Vec<Option<&mut Table<F>>> = d
            .iter_mut()
            .zip(&splats.parts)
            .map(|(d, part)| match part.color {
                Color::Sh { base: true, .. } => {
                    let [table] = d.of([SH]);
                    Some(table)
                }
                _ => None,
            })
            .collect();
        draw.backward(&splats, view.camera, view.background, extra, &grads, &mut d_sh, &mut self.d_render);
        report.d_cameras.push(self.d_render.camera);
        if let (Some((layer, keys)), Some(head)) = (scene.head_keys(), &self.d_render.head) {
            let [first, second] = d[layer].of([keys.first, keys.second]);
            first.data_mut().iter_mut().zip(&head.first).for_each(|(d, x)| *d += *x);
            second.data_mut().iter_mut().zip(&head.second).for_each(|(d, x)| *d += *x);
        }
        let mut first = 0;
        for (layer, &i) in asked.iter().enumerate() {
            let count = splats.parts[layer].out.rows();
            observe(Observation {
                layer,
                rows: self.asks[i].tape.rows(),
                mean2d: &self.d_render.mean2d[first..first + count],
                radii: &draw.radii()[first..first + count],
            });
            first += count;
        }
        drop(splats);
        for (&i, part) in asked.iter().zip(&mut self.d_render.parts) {
            let ask = &mut self.asks[i];
            if ask.begun {
                add_table(&mut ask.d_out, &part.out);
                add_optional(&mut ask.d_color, part.color.as_ref());
                add_optional(&mut ask.d_weights, part.weights.as_ref());
            } else {
                // Nothing to add to: the renderer gets the ask's old tables to overwrite.
                ask.begun = true;
                std::mem::swap(&mut ask.d_out, &mut part.out);
                std::mem::swap(&mut ask.d_color, &mut part.color);
                std::mem::swap(&mut ask.d_weights, &mut part.weights);
            }
        }
        if let (Some(channels), Some(d_table)) = (&channels, &self.d_render.extra)
            && self.d_image.uses_extra
        {
            Self::further(&mut self.asks, view, channels, d_table, &asked, ways.as_deref());
            if let (Some(share), Some(column)) = (&share, channels.share()) {
                self.share_backward(&asked, &keys, share, (d_table, column), d);
            }
        }
        report.timings.render_backward += clock.elapsed();
    }

    /// The sigmoid of a logit of every splat; 0 where the layer has none.
    fn share(&self, scene: &Scene<F>, asked: &[usize], keys: &[Option<(Key, usize)>]) -> Vec<F> {
        let mut out = Vec::new();
        for ((&i, key), layer) in asked.iter().zip(keys).zip(&scene.layers) {
            let (rows, count) = (self.asks[i].tape.rows(), self.asks[i].tape.out().rows());
            let value = |j: usize| key.map_or(F::ZERO, |(key, col)| layer.params[key].get(rows.id(j), col).sigmoid());
            out.extend((0..count).map(value));
        }
        out
    }

    /// The VJP of [`share`](Self::share), from one column of the further channels' gradient.
    fn share_backward(
        &self,
        asked: &[usize],
        keys: &[Option<(Key, usize)>],
        share: &[F],
        (d_table, column): (&Table<F>, usize),
        d: &mut [Grads<F>],
    ) {
        let mut first = 0;
        for ((&i, key), d) in asked.iter().zip(keys).zip(d.iter_mut()) {
            let (rows, count) = (self.asks[i].tape.rows(), self.asks[i].tape.out().rows());
            if let Some((key, col)) = *key {
                let [d] = d.of([key]);
                for j in 0..count {
                    let s = share[first + j];
                    *d.get_mut(rows.id(j), col) += d_table.get(first + j, column) * s * (F::ONE - s);
                }
            }
            first += count;
        }
    }

    /// Where the splats of a view are at another time: by layer an ask and its rows.
    fn ways(&self, to: Time, asked: &[usize]) -> Vec<Way> {
        let way = |(layer, &i): (usize, &usize)| {
            let ask = self.find(layer, Space::Gaussians, to).expect("a flow's time was asked");
            let (from, then) = (&self.asks[i].tape, &self.asks[ask].tape);
            let row = |id: usize| match then.rows() {
                Rows::All => id as u32,
                Rows::Some(ids) => ids.binary_search(&(id as u32)).map_or(u32::MAX, |r| r as u32),
            };
            Way { ask, rows: (0..from.out().rows()).map(|j| row(from.rows().id(j))).collect() }
        };
        asked.iter().enumerate().map(way).collect()
    }

    /// The VJP of a view's further channels.
    fn further(
        asks: &mut [Ask<F>],
        view: &View<'_, F>,
        channels: &Channels<F>,
        d_table: &Table<F>,
        asked: &[usize],
        ways: Option<&[Way]>,
    ) {
        let mut first = 0;
        for (layer, &i) in asked.iter().enumerate() {
            let way = ways.map(|w| &w[layer]).filter(|w| w.ask != i);
            if let Some(way) = way.filter(|w| !asks[w.ask].begun) {
                let ask = &mut asks[way.ask];
                reset_like(&mut ask.d_out, ask.tape.out());
                (ask.d_color, ask.d_weights, ask.begun) = (None, None, true);
            }
            let mut d_out = std::mem::take(&mut asks[i].d_out);
            let mut d_later = way.map(|w| std::mem::take(&mut asks[w.ask].d_out));
            let later = way.map(|w| w.later(asks));
            let flow = view.flow.as_ref().zip(later.as_ref()).zip(d_later.as_mut()).map(|((f, l), d)| (f, l, d));
            channels.backward(view.camera, asks[i].tape.out(), first, d_table, &mut d_out, flow);
            first += d_out.rows();
            asks[i].d_out = d_out;
            if let (Some(way), Some(d)) = (way, d_later) {
                asks[way.ask].d_out = d;
            }
        }
    }

    /// Shows a loss the rows it asked for and scatters its gradient back.
    fn probe(&mut self, scene: &Scene<F>, loss: &dyn ProbeLoss<F>, probes: &[Probe]) -> f64 {
        let mut places = Vec::new();
        let mut seen = Vec::new();
        for probe in probes {
            let mut tables = Vec::new();
            let mut place = Vec::new();
            for &t in &probe.times {
                let i = self.find(probe.layer, probe.of, t).expect("every probe's time was asked");
                let out = self.asks[i].tape.out();
                let index: Vec<u32> = match (self.asks[i].tape.rows(), &probe.rows) {
                    (_, None) => (0..out.rows() as u32).collect(),
                    (Rows::All, Some(rows)) => rows.clone(),
                    (Rows::Some(ids), Some(rows)) => rows
                        .iter()
                        .map(|r| ids.binary_search(r).expect("the asked rows hold the probe's rows") as u32)
                        .collect(),
                };
                tables.push(out.gather(&index));
                place.push((i, index));
            }
            seen.push(tables);
            places.push(place);
        }
        let mut d: Vec<Vec<Table<F>>> = seen.iter().map(|t| t.iter().map(Table::zeros_like).collect()).collect();
        let value = loss.eval(scene, probes, &seen, &mut d);
        for (place, tables) in places.iter().zip(&d) {
            for ((i, index), table) in place.iter().zip(tables) {
                let d_out = &mut self.asks[*i].d_out;
                for (j, &row) in index.iter().enumerate() {
                    d_out.add(row as usize, 0, table.read::<10>(j, 0));
                }
            }
        }
        value
    }

    /// The last view drawn.
    pub fn image(&self) -> &Image<F> {
        &self.image
    }
}

impl<F: Real> Ask<F> {
    fn new() -> Self {
        Self {
            layer: 0,
            tape: LayerTape::default(),
            begun: false,
            d_out: Table::default(),
            d_color: None,
            d_weights: None,
            d_time: 0.0,
        }
    }
}

/// The table and column of a layer's logit of that name.
fn logit_of<F: Real>(params: &Params<F>, column: &str) -> Option<(Key, usize)> {
    params.keys().find_map(|k| params[k].column(column).map(|(first, _)| (k, first)))
}

/// An ask, and its row of every splat of a view (`u32::MAX`: none).
struct Way {
    ask: usize,
    rows: Vec<u32>,
}

impl Way {
    fn later<'a, F: Real>(&'a self, asks: &'a [Ask<F>]) -> Later<'a, F> {
        Later { out: asks[self.ask].tape.out(), rows: &self.rows }
    }
}

fn questions<'a, F: Real>(asks: &'a [Ask<F>], scene: &'a Scene<F>, layer: usize) -> Vec<At<'a, F>> {
    asks.iter().filter(|a| a.layer == layer).map(|a| a.tape.question(&scene.layers[layer].params)).collect()
}

fn union(a: &[u32], b: &[u32]) -> Vec<u32> {
    let mut out = Vec::with_capacity(a.len() + b.len());
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let next = match (a.get(i), b.get(j)) {
            (Some(&x), Some(&y)) => x.min(y),
            (Some(&x), None) => x,
            (None, Some(&y)) => y,
            (None, None) => unreachable!("the loop's condition holds one of them"),
        };
        i += usize::from(a.get(i) == Some(&next));
        j += usize::from(b.get(j) == Some(&next));
        out.push(next);
    }
    out
}

/// Makes `d` an all-zero table in the shape of `like`, keeping the allocation.
fn reset_like<F: Real>(d: &mut Table<F>, like: &Table<F>) {
    if d.width() == like.width() {
        d.resize(like.rows());
        d.fill(F::ZERO);
    } else {
        *d = like.zeros_like();
    }
}

fn add_table<F: Real>(to: &mut Table<F>, from: &Table<F>) {
    assert_eq!((to.rows(), to.width()), (from.rows(), from.width()), "gradients of one ask have one shape");
    halve([to.view_mut()], &|[to]| {
        let from = &from.data()[to.first * to.width..];
        to.data.iter_mut().zip(from).for_each(|(a, b)| *a += *b);
        0.0
    });
}

fn add_optional<F: Real>(to: &mut Option<Table<F>>, from: Option<&Table<F>>) {
    match (to, from) {
        (Some(to), Some(from)) => add_table(to, from),
        (to @ None, Some(from)) => *to = Some(from.clone()),
        (_, None) => {}
    }
}
