//! A scene is a sum of layers, each a set of Gaussians with one motion model and one kind of lifespan, rendered
//! together.

mod constant;
mod convert;
mod cross_fade;
mod envelope;
mod evaluation;
mod finite;
mod frame;
mod freeze;
mod mirror;
mod rotate;
#[cfg(test)]
mod tests;

pub use constant::Constant;
pub(crate) use constant::HIDDEN;
pub(crate) use convert::with_polynomial;
#[cfg(test)]
pub(crate) use convert::{to_native4d, to_spacetime};
pub use evaluation::Evaluation;
pub(crate) use evaluation::sweep;
pub use freeze::{Gaussians, freeze, freeze_rows, moment};
pub(crate) use mirror::mirror;
pub use rotate::rotation_between;

use crate::math::{Real, Rng, Sim3};
use crate::motion::{At, Cache, Motion, Tape};
use crate::scene::GEOMETRY;
use crate::scene::params::OPACITY;
use crate::scene::{
    Grads, HeadKeys, HeadWeights, KeyMasks, LIFE, LifeKind, Params, Part, RowEdit, Rows, Space, SplatGrads, Splats,
    Table, Time,
};
use crate::{Error, ErrorKind, Result};
use std::sync::Arc;

/// A splat fainter than this is not rendered, so that a Gaussian below it is not alive (1/255, Kerbl et al. 2023).
pub const ALPHA_MIN: f64 = 1.0 / 255.0;

/// The span of a layer that may be seen at any time.
pub const ALWAYS: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Beginning of the names of layers that show what was predicted, not what was seen.
pub const PREDICTED: &str = "predicted";

/// Name of a layer of static Gaussians on a far sphere around the cameras: a sky, a far landscape. It is seen, and is no
/// part of surfaces and boxes.
pub const FAR_SHELL: &str = "far shell";

/// Gaussians with one motion model and one kind of lifespan.
pub struct Layer<F: Real = f32> {
    /// The user's name for it.
    pub name: String,
    /// All learnable state.
    pub params: Params<F>,
    /// Its motion.
    pub motion: Arc<dyn Motion<F>>,
    /// Lifespans of its Gaussians.
    pub life: LifeKind,
    /// The layer is seen for from ≤ t < to, seconds; [`ALWAYS`] but for pages of a playback file.
    pub span: [f64; 2],
    /// Seconds at the beginning and at the end of the span in which the layer cross-fades with another that shows the
    /// same there: opacity o becomes 1 − (1 − o)^s, s rising from 0 to 1 and falling back to 0. The one of two whose
    /// spans overlap by so much rises as the other falls, and where one Gaussian of each coincides they let through
    /// what one would. Zeros: it begins and ends at once.
    pub cross_fade: [f64; 2],
    /// Visibility masks of the rows over time; none: all rows alive are rendered.
    pub masks: Option<Arc<KeyMasks>>,
    /// The layer's frame: `world_from_layer`, applied to Gaussians after motion and lifespan. Tables, the motion model
    /// and nodes keep the layer's own axes and unit of length.
    pub frame: Sim3,
}

impl<F: Real> Clone for Layer<F> {
    fn clone(&self) -> Self {
        Self {
            name: self.name.clone(),
            params: self.params.clone(),
            motion: self.motion.clone(),
            life: self.life,
            span: self.span,
            cross_fade: self.cross_fade,
            masks: self.masks.clone(),
            frame: self.frame,
        }
    }
}

impl<F: Real> std::fmt::Debug for Layer<F> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Layer({}, {} Gaussians, {:?}, {:?})", self.name, self.params.len(), self.motion.spec(), self.life)
    }
}

/// One layer's result at one time, and the state for its backward.
#[derive(Debug)]
pub struct LayerTape<F = f32> {
    of: Space,
    t: Time,
    all: bool,
    ids: Vec<u32>,
    tape: Tape<F>,
    /// [splats, 5]: σ, ∂σ/∂t, ∂σ/∂log width, ∂σ/∂log softness, the model's opacity; empty where σ is 1.
    life: Table<F>,
    /// [splats, 2]: ∂o'/∂o and ∂o'/∂s of the cross-fade; empty where there is none now.
    faded: Table<F>,
    d_out: Table<F>,
    /// [splats, 10]: `tape.out` in the world; empty where the frame is the identity, and for nodes.
    world: Table<F>,
    /// Gradient to `tape.out` of a framed result.
    d_layer: Table<F>,
}

impl<F: Real> Default for LayerTape<F> {
    fn default() -> Self {
        Self {
            of: Space::Gaussians,
            t: Time(0.0),
            all: true,
            ids: Vec::new(),
            tape: Tape::default(),
            life: Table::default(),
            faded: Table::default(),
            d_out: Table::default(),
            world: Table::default(),
            d_layer: Table::default(),
        }
    }
}

impl<F: Real> LayerTape<F> {
    /// A tape for the query (space, rows, time).
    pub fn request(&mut self, of: Space, rows: Rows<'_>, t: Time) {
        (self.of, self.t) = (of, t);
        self.ids.clear();
        match rows {
            Rows::All => self.all = true,
            Rows::Some(ids) => {
                self.all = false;
                self.ids.extend_from_slice(ids);
            }
        }
    }

    /// Requests the Gaussians of `layer` that are alive at t.
    pub fn request_active(&mut self, layer: &Layer<F>, t: Time) {
        (self.of, self.t) = (Space::Gaussians, t);
        self.all = layer.active(t, &mut self.ids);
    }

    /// The rows requested.
    pub fn rows(&self) -> Rows<'_> {
        if self.all { Rows::All } else { Rows::Some(&self.ids) }
    }

    /// The space requested.
    pub(crate) fn space(&self) -> Space {
        self.of
    }

    /// The time requested.
    pub(crate) fn time(&self) -> Time {
        self.t
    }

    /// [splats, 10], life and frame applied; nodes are in the layer's own axes.
    pub fn out(&self) -> &Table<F> {
        if self.world.width() > 0 { &self.world } else { &self.tape.out }
    }

    /// The query as the motion model gets it.
    pub fn query<'a>(&'a self, p: &'a Params<F>) -> At<'a, F> {
        At { p, of: self.of, rows: self.rows(), t: self.t }
    }
}

impl<F: Real> Layer<F> {
    /// A layer that may be seen at any time, without masks, whose axes are the world's.
    pub fn new(name: impl Into<String>, params: Params<F>, motion: Arc<dyn Motion<F>>, life: LifeKind) -> Self {
        Self {
            name: name.into(),
            params,
            motion,
            life,
            span: ALWAYS,
            cross_fade: [0.0; 2],
            masks: None,
            frame: Sim3::IDENTITY,
        }
    }

    /// Whether t is in the layer's span. A NaN is, so that the trainer's guard finds it.
    pub fn spans_over(&self, t: Time) -> bool {
        !(t.0 < self.span[0] || t.0 >= self.span[1])
    }

    /// The rows alive at t into `ids` (strictly increasing): those whose opacity times life reaches [`ALPHA_MIN`] and
    /// whom the masks admit, none outside the layer's span.
    /// Returns true, and leaves `ids` empty, where every row is meant (infinite lifespan, no masks).
    pub fn active(&self, t: Time, ids: &mut Vec<u32>) -> bool {
        ids.clear();
        if !self.spans_over(t) {
            return false;
        }
        let mut own = Table::new(&[("life", 2)], 0);
        let (table, kind) = if self.motion.life(&self.params, &mut own) {
            (&own, LifeKind::GaussHalf)
        } else {
            (&self.params[LIFE], self.life)
        };
        match (kind, &self.masks) {
            (LifeKind::Infinite, None) => return true,
            (LifeKind::Infinite, Some(_)) => ids.extend(0..self.params.len() as u32),
            _ => envelope::active(&self.params[GEOMETRY], table, kind, t, ids),
        }
        if let Some(masks) = &self.masks {
            masks.retain(t.0, ids);
        }
        false
    }

    /// Life of every row: centre, log width, log softness (seconds; columns that the kind lacks are zero).
    /// The model's own where it has one, otherwise the layer's.
    pub fn lifespans(&self) -> (LifeKind, Vec<[f64; 3]>) {
        let mut own = Table::new(&[("life", 2)], 0);
        let (table, kind) = if self.motion.life(&self.params, &mut own) {
            (&own, LifeKind::GaussHalf)
        } else {
            (&self.params[LIFE], self.life)
        };
        (kind, (0..self.params.len()).map(|id| life_row(table, id).map(Real::f64)).collect())
    }

    /// [from, to] in seconds for every row: when its opacity times life is at least [`ALPHA_MIN`] within the layer's
    /// span; (1, 0) for never.
    pub fn spans(&self) -> Vec<[f64; 2]> {
        let (kind, rows) = self.lifespans();
        let geometry = &self.params[GEOMETRY];
        // The span's end is not part of it, but an interval's is.
        let end = if self.span[1].is_finite() { self.span[1].next_down() } else { self.span[1] };
        let span = |(id, row): (usize, &[f64; 3])| {
            let reach = kind.reach(*row, geometry.get(id, OPACITY).sigmoid().f64(), ALPHA_MIN);
            let (from, to) = ((row[0] - reach).max(self.span[0]), (row[0] + reach).min(end));
            if reach < 0.0 || from > to { [1.0, 0.0] } else { [from, to] }
        };
        rows.iter().enumerate().map(span).collect()
    }

    /// Computes the query in `tape`: the motion model, then the lifespan, the cross-fade and the frame. Nodes have none
    /// of these.
    pub fn at(&self, cache: &Cache, tape: &mut LayerTape<F>) {
        let mut own = std::mem::take(&mut tape.tape);
        self.motion.at(&tape.query(&self.params), cache, &mut own);
        tape.tape = own;
        self.fade(tape);
        self.cross_fade(tape);
        if self.frame.is_identity() || tape.of != Space::Gaussians {
            tape.world = Table::default();
        } else {
            frame::forward(&self.frame, &tape.tape.out, &mut tape.world);
        }
    }

    /// Multiplies the opacities of the result in `tape` by the lifespan.
    fn fade(&self, tape: &mut LayerTape<F>) {
        if self.life == LifeKind::Infinite || tape.of != Space::Gaussians {
            tape.life = Table::default();
            return;
        }
        let table = &self.params[LIFE];
        if tape.life.width() == 0 {
            tape.life = Table::new(&[("sigma", 4), ("opacity", 1)], 0);
        }
        tape.life.resize(tape.tape.out.rows());
        let rows = if tape.all { Rows::All } else { Rows::Some(&tape.ids) };
        envelope::forward(table, self.life, tape.t, rows, &mut tape.tape.out, &mut tape.life);
    }

    /// Cross-fades the opacities of the result in `tape`.
    fn cross_fade(&self, tape: &mut LayerTape<F>) {
        let (share, _) = self.fade_share(tape.t);
        if share == 1.0 || tape.of != Space::Gaussians {
            tape.faded = Table::default();
            return;
        }
        cross_fade::forward(F::of(share), &mut tape.tape.out, &mut tape.faded);
    }

    /// The splats that the last [`at`](Self::at) left in `tape`.
    pub fn part<'a>(&'a self, tape: &'a LayerTape<F>) -> Part<'a, F> {
        let color = self.motion.color(&tape.query(&self.params), &tape.tape);
        let layer_from_world = if tape.of == Space::Gaussians { self.frame.directions() } else { None };
        Part { out: tape.out(), color, layer_from_world }
    }

    /// Means as in the tables, before any motion, in the world.
    pub fn means(&self) -> impl Iterator<Item = [f64; 3]> + '_ {
        let table = &self.params[GEOMETRY];
        (0..table.rows()).map(|row| {
            let mean = table.read::<3>(row, 0).map(F::f64);
            if self.frame.is_identity() { mean } else { self.frame.apply(mean) }
        })
    }

    /// The VJP of [`at`](Self::at): adds to `d` and `d_cache`, returns dL/dt. `d_out.out` is to what `at` returned.
    pub fn backward(
        &self,
        cache: &Cache,
        tape: &mut LayerTape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        d.activate(tape.of, if tape.all { Rows::All } else { Rows::Some(&tape.ids) });
        let mut own = std::mem::take(&mut tape.tape);
        let mut d_motion = std::mem::take(&mut tape.d_out);
        let mut d_layer = std::mem::take(&mut tape.d_layer);
        let mut d_time = 0.0;
        let unframed;
        let d_out = if tape.world.width() == 0 {
            d_out
        } else {
            frame::backward(&self.frame, d_out.out, &mut d_layer);
            unframed = SplatGrads { out: &d_layer, ..*d_out };
            &unframed
        };
        let mut d_fade = Table::default();
        let unfaded;
        let d_out = if tape.faded.width() == 0 {
            d_out
        } else {
            let d_share = cross_fade::backward(d_out.out, &tape.faded, &mut d_fade);
            d_time += d_share * self.fade_share(tape.t).1;
            unfaded = SplatGrads { out: &d_fade, ..*d_out };
            &unfaded
        };
        let query = tape.query(&self.params);
        if tape.life.width() == 0 {
            d_time += self.motion.backward(&query, cache, &mut own, d_out, d_cache, d);
        } else {
            // o_eff = o·σ: the motion gets dL/do = σ·dL/do_eff, the lifespan dL/dσ = o·dL/do_eff.
            envelope::to_motion(d_out.out, &tape.life, &mut d_motion);
            let [d_life] = d.of([LIFE]);
            d_time += envelope::backward(query.rows, d_out.out, &tape.life, d_life);
            let scaled = SplatGrads { out: &d_motion, ..*d_out };
            d_time += self.motion.backward(&query, cache, &mut own, &scaled, d_cache, d);
        }
        tape.tape = own;
        tape.d_out = d_motion;
        tape.d_layer = d_layer;
        d_time
    }

    /// One row edit: gathers every table of its space, then lets the model correct what copying cannot.
    pub fn edit(&mut self, edit: &RowEdit, rng: &Rng) {
        self.params.apply(edit);
        self.masks = self.masks.take().map(|m| Arc::new(m.edited(edit)));
        self.motion.clone().on_edit(&mut self.params, edit, rng);
    }

    /// Makes Gaussian `row` `factor` times as large in space.
    pub fn resize(&mut self, row: usize, factor: f64) {
        self.motion.clone().resize(&mut self.params, row, factor);
    }
}

/// A row of the lifespan table; columns that it does not have are zero.
#[inline(always)]
fn life_row<F: Real>(table: &Table<F>, id: usize) -> [F; 3] {
    match table.width() {
        0 => [F::ZERO; 3],
        2 => {
            let [c, w] = table.read::<2>(id, 0);
            [c, w, F::ZERO]
        }
        _ => table.read::<3>(id, 0),
    }
}

/// Mapping from blended channels to colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Head {
    /// They are the colour.
    #[default]
    Identity,
    /// By the network of Spacetime Gaussians, whose weights are in the first layer that has features. Layers without
    /// features may be next to it: theirs count as zero.
    Features,
}

impl Head {
    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Head::Identity => "identity",
            Head::Features => "features",
        }
    }

    /// The head of that name.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        [Head::Identity, Head::Features].into_iter().find(|h| h.name() == name)
    }
}

/// A sum of layers on one clock.
#[derive(Clone, Debug, Default)]
pub struct Scene<F: Real = f32> {
    /// Splatted together in this order.
    pub layers: Vec<Layer<F>>,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// First and last second of the clip.
    pub clip: [f64; 2],
    /// Frames a second of the clip.
    pub fps: f64,
    /// The direction that is up in the world (unit).
    pub up: [f64; 3],
    /// World coordinates of the scene's origin ([`scene::offset`](crate::scene::offset)): add it to positions of the
    /// scene for those of the world that its capture or file is in. Zero unless they are far from the origin.
    pub offset: [f64; 3],
    /// Mapping from blended channels to colour.
    pub head: Head,
    /// Names of the labels that its Gaussians have logits for ([`scene::labels`](crate::scene::labels)); empty: none.
    pub labels: Vec<String>,
}

impl<F: Real> Scene<F> {
    /// Gaussians in all layers.
    pub fn len(&self) -> usize {
        self.layers.iter().map(|l| l.params.len()).sum()
    }

    /// Whether there is nothing to see.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether anything depends on time: motion, life, or a layer's span.
    pub fn is_moving(&self) -> bool {
        self.layers.iter().any(|l| l.motion.capabilities().moves || l.life != LifeKind::Infinite || l.span != ALWAYS)
    }

    /// Feature channels of its Gaussians ([`scene::features`](crate::scene::features)); 0: none.
    pub fn feature_channels(&self) -> usize {
        let of = |l: &Layer<F>| crate::scene::features::key(&l.params).map_or(0, |key| l.params[key].width());
        self.layers.iter().map(of).max().unwrap_or(0)
    }

    /// Start of the predicted part, seconds; `None`: all of it was observed.
    pub fn predicted_from(&self) -> Option<f64> {
        let predicted = self.layers.iter().filter(|l| l.name.starts_with(PREDICTED));
        predicted.map(|l| l.span[0]).filter(|t| t.is_finite()).min_by(f64::total_cmp)
    }

    /// The scene at time t, for playback: only Gaussians alive then. Query i of `evaluation` becomes layer i.
    pub fn at(&self, t: Time, evaluation: &mut Evaluation<F>) {
        evaluation.begin();
        for (index, layer) in self.layers.iter().enumerate() {
            evaluation.request_active(index, layer, t);
        }
        evaluation.evaluate(&self.layers);
    }

    /// The splats that [`at`](Self::at) left in `evaluation`.
    pub fn splats<'a>(&'a self, evaluation: &'a Evaluation<F>) -> Splats<'a, F> {
        evaluation.splats(self, evaluation.tapes().next().map_or(Time(0.0), |tape| tape.time()))
    }

    /// The layer that holds the head's weights, and their positions there; `None`: there is no head.
    pub fn head_keys(&self) -> Option<(usize, HeadKeys)> {
        match self.head {
            Head::Identity => None,
            Head::Features => self.layers.iter().enumerate().find_map(|(i, l)| Some((i, HeadKeys::of(&l.params)?))),
        }
    }

    /// The head's weights; `None`: there is no head.
    pub(crate) fn head_weights(&self) -> Option<HeadWeights<'_, F>> {
        self.head_keys().map(|(layer, keys)| keys.weights(&self.layers[layer].params))
    }

    /// Errors if Gaussians alone do not determine the image: `what` (a format, a player) does not support a pixel head.
    pub fn without_head(&self, what: &str) -> Result<()> {
        match self.head {
            Head::Identity => Ok(()),
            Head::Features => Err(Error::new(
                ErrorKind::Unsupported,
                format!("{what} cannot hold this scene: a network makes its colours, pixel by pixel (features = full)"),
            )
            .remedy(
                "Give the folder of its run: `bake`, `export` and `convert` fold the network into spherical harmonics as its cameras \
                 see them. Or train with --set features=none",
            )),
        }
    }
}
