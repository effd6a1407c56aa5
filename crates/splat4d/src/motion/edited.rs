//! `edited`: any model with a change that its own tables cannot represent: another clock, a key-framed position, other
//! colours, a fade, a drag of control nodes. Changes on changes are models around models.
//!
//! | change | result at t, from the inner result |
//! |---|---|
//! | `clock` | that at s = rate·t + offset |
//! | `path` | μ' = A(t) μ + b(t), Σ' = A Σ Aᵀ, colours turn along; A = scale times rotation |
//! | `color` | other spherical harmonics ([`ColorMap`]) |
//! | `fade` | opacity times a factor of t |
//! | `drag` | μ' = M μ + b, Σ' = Q Σ Qᵀ, blended of the node offsets that pull the Gaussian ([`DragSpec`]) |
//!
//! Lifespans are the layer's: a clock for the model must also be given to the layer's lifespans. Nodes are evaluated by
//! the model inside. Gradients pass through to the tables inside; the changes themselves are not learnt.

mod color;
mod drag;
mod path;
#[cfg(test)]
mod tests;

pub use color::ColorMap;
pub use drag::DragSpec;
pub(crate) use drag::{NodeOffset, NodeOffsets};
pub(crate) use path::eased;
pub use path::{FadeKey, PathKey};

use super::{At, Cache, Capabilities, Model, Motion, Phase, Spec, Tape, central_velocity};
use crate::math::sh::{MAX_COEFFS, degree_of};
use crate::math::sh_rotation::sh_rotation;
use crate::math::vec3::dot;
use crate::math::{Real, Rng, Sim3};
use crate::scene::splats::{COV, SPLAT_COLUMNS, SPLAT_OPACITY};
use crate::scene::table::par_split;
use crate::scene::{Color, Grads, Params, RowEdit, SH, Space, SplatGrads, Table, Time};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::sync::Arc;

/// Half the step of the central difference to t, seconds: a thousandth of a frame at 30 frames a second.
const STEP: f64 = 1.0 / 30_000.0;

/// A change on top of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Change {
    /// The model is queried at s = rate·t + offset.
    Clock {
        /// Seconds inside a second outside; below zero: backwards; never zero.
        rate: f64,
        /// Seconds.
        offset: f64,
    },
    /// A similarity that changes with time.
    Path {
        /// The point about which it turns and grows, scene units.
        about: [f64; 3],
        /// At rising times; the first and the last hold outside of them.
        keys: Vec<PathKey>,
    },
    /// Other colours.
    Color {
        /// From colour to colour.
        map: ColorMap,
    },
    /// Opacity times a factor.
    Fade {
        /// At rising times; the first and the last hold outside of them.
        keys: Vec<FadeKey>,
    },
    /// Control nodes pull Gaussians elsewhere.
    Drag(DragSpec),
}

impl Change {
    fn check(&self) -> Result<()> {
        let bad = |what: &str| {
            Err(Error::input(format!("an edited model's {what}"))
                .remedy("The file is damaged or was written by another program; export it again"))
        };
        match self {
            Change::Clock { rate, offset } if !(rate.is_finite() && *rate != 0.0 && offset.is_finite()) => {
                bad("clock has no rate, or a rate of zero")
            }
            Change::Path { about, keys } if !path::sound(about, keys) => {
                bad("path has no keys, or keys that are not similarities")
            }
            Change::Fade { keys } if !path::sound_fades(keys) => bad("fade has no keys, or factors beyond 0 to 1"),
            Change::Color { map } if !map.is_sound() => bad("colours are mapped by numbers that are none"),
            Change::Drag(spec) => spec.check(),
            _ => Ok(()),
        }
    }

    /// Whether the result depends on t next to the model's own.
    fn moves(&self) -> bool {
        match self {
            Change::Clock { .. } | Change::Color { .. } => false,
            Change::Path { keys, .. } => keys.len() > 1,
            Change::Fade { keys } => keys.len() > 1,
            Change::Drag(_) => true,
        }
    }

    /// Whether colours are others than the model's.
    fn paints(&self) -> bool {
        match self {
            Change::Color { .. } => true,
            Change::Path { keys, .. } => keys.iter().any(|k| k.turn != PathKey::default().turn),
            _ => false,
        }
    }
}

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditedSpec {
    /// The model inside.
    pub inner: Box<Spec>,
    /// The change around it.
    pub change: Change,
}

impl Model for EditedSpec {
    /// Makes the model inside, then the tables of a drag.
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        let inner = super::build_as(&self.inner, p)?;
        Ok(Arc::new(Edited::around(inner, self.change.clone(), p)?))
    }

    fn capabilities(&self) -> Capabilities {
        capabilities(self.inner.capabilities().unwrap_or_default(), &self.change)
    }
}

fn capabilities(inner: Capabilities, change: &Change) -> Capabilities {
    let backwards = matches!(change, Change::Clock { rate, .. } if *rate < 0.0);
    let turns = matches!(change, Change::Path { .. } | Change::Drag(_)) && change.moves();
    Capabilities {
        // What does not move is taken from its tables, which carry no information about a change.
        moves: inner.moves || !matches!(change, Change::Clock { .. }),
        rotates: inner.rotates || turns,
        causal: inner.causal && !backwards,
        ..inner
    }
}

/// See the module's documentation.
pub(crate) struct Edited<F: Real = f32> {
    inner: Arc<dyn Motion<F>>,
    change: Change,
    /// Location of a drag's numbers.
    drag: Option<drag::Keys>,
}

/// Similarity applied to a result at one time.
enum Placed<'a, F> {
    Same,
    All(Affine<F>),
    Each(drag::Pulls<'a, F>),
}

/// μ' = M μ + b, Σ' = Q Σ Qᵀ
#[derive(Clone, Copy)]
struct Affine<F> {
    m: [[F; 3]; 3],
    b: [F; 3],
    q: [[F; 3]; 3],
}

/// State of a result.
struct Own<F> {
    inner: Tape<F>,
    /// Colours where they are others than the model's.
    paint: Table<F>,
    d_inner: Table<F>,
}

impl<F: Real> Default for Own<F> {
    fn default() -> Self {
        Self { inner: Tape::default(), paint: Table::default(), d_inner: Table::default() }
    }
}

impl<F: Real> Edited<F> {
    /// Puts a change around a model that is there already; of a drag the tables are made, or those of a file claimed.
    ///
    /// Errors: a change out of its ranges, loaded arrays of the wrong shape.
    pub(crate) fn around(inner: Arc<dyn Motion<F>>, change: Change, p: &mut Params<F>) -> Result<Self> {
        change.check()?;
        let drag = match &change {
            Change::Drag(spec) => Some(drag::Keys::new(spec, p)?),
            _ => None,
        };
        Ok(Self { inner, change, drag })
    }

    /// The edited model that a layer moves by, if it does.
    pub(crate) fn of(motion: &dyn Motion<F>) -> Option<&Self> {
        (motion as &dyn Any).downcast_ref()
    }

    /// The model inside.
    pub(crate) fn inner(&self) -> &Arc<dyn Motion<F>> {
        &self.inner
    }

    /// The change around it.
    pub(crate) fn change(&self) -> &Change {
        &self.change
    }

    /// Writes the numbers of a drag into its tables. Panics: the change is not a drag, or has another shape.
    pub(crate) fn fill_drag(&self, from: &NodeOffsets, p: &mut Params<F>) {
        let (Change::Drag(spec), Some(keys)) = (&self.change, &self.drag) else { panic!("this edit drags nothing") };
        keys.fill(spec, from, p);
    }

    /// The same tables with another model inside and another change of the same kind.
    pub(crate) fn with(&self, inner: Arc<dyn Motion<F>>, change: Change) -> Self {
        Self { inner, change, drag: self.drag }
    }

    /// The query to the model inside.
    fn inside<'a>(&self, q: &At<'a, F>) -> At<'a, F> {
        match self.change {
            Change::Clock { rate, offset } => At { t: Time(rate * q.t.0 + offset), ..*q },
            _ => *q,
        }
    }

    /// Whether the result inside is the result.
    fn passes(&self, q: &At<'_, F>) -> bool {
        q.of != Space::Gaussians || matches!(self.change, Change::Clock { .. })
    }

    fn placed<'a>(&self, p: &'a Params<F>, t: f64) -> Placed<'a, F> {
        match (&self.change, &self.drag) {
            (Change::Path { about, keys }, _) => {
                let at = path::at(*about, keys, t);
                let m = at.linear();
                Placed::All(Affine { m, b: at.translation.map(F::of), q: m })
            }
            (Change::Drag(spec), Some(keys)) => Placed::Each(drag::Pulls::at(spec, keys, p, t)),
            _ => Placed::Same,
        }
    }

    fn factor(&self, t: f64) -> F {
        match &self.change {
            Change::Fade { keys } => F::of(path::factor(keys, t)),
            _ => F::ONE,
        }
    }

    /// Fills `out` with the splats `inner`, changed as at time t.
    fn place(&self, q: &At<'_, F>, t: f64, inner: &Table<F>, out: &mut Table<F>) {
        let (placed, factor) = (self.placed(q.p, t), self.factor(t));
        par_split([out.view_mut()], &|[mut view]| {
            for j in view.first..view.first + view.rows {
                let mut row = inner.read::<WIDTH>(j, 0);
                row[SPLAT_OPACITY] *= factor;
                if let Some(a) = placed.of(q.rows.id(j)) {
                    let mean: [F; 3] = std::array::from_fn(|i| dot(a.m[i], [row[0], row[1], row[2]]) + a.b[i]);
                    let cov = congruence(&a.q, std::array::from_fn(|k| row[COV + k]));
                    row[..3].copy_from_slice(&mean);
                    row[COV..SPLAT_OPACITY].copy_from_slice(&cov);
                }
                view.write(j, 0, row);
            }
            0.0
        });
    }

    /// Colours of the result `inner` after the change at time t; leaves `out` empty where they are the model's own.
    fn paint(&self, q: &At<'_, F>, t: f64, inner: &Tape<F>, out: &mut Table<F>) {
        if !self.change.paints() {
            return;
        }
        let color = self.inner.color(q, inner);
        let width = block_width(&color);
        if out.width() == width {
            out.resize(q.len());
        } else {
            let name = if matches!(color, Color::Direct { .. }) { "direct" } else { "sh" };
            *out = Table::new(&[(name, width)], q.len());
        }
        let turn = self.turn(t);
        let direct = matches!(color, Color::Direct { .. });
        par_split([out.view_mut()], &|[mut view]| {
            let mut row = vec![F::ZERO; width];
            for j in view.first..view.first + view.rows {
                flatten(&color, j, &mut row);
                match (&self.change, &turn) {
                    (Change::Color { map }, _) if direct => map.colors(&mut row),
                    (Change::Color { map }, _) => map.harmonics(&mut row),
                    (_, Some(m)) if !direct => rotate(m, &mut row, false),
                    _ => {}
                }
                row.iter().enumerate().for_each(|(k, x)| view.write(j, k, [*x]));
            }
            0.0
        });
    }

    /// The matrix of the spherical harmonics at time t of a path.
    fn turn(&self, t: f64) -> Option<Turn> {
        let Change::Path { about, keys } = &self.change else { return None };
        Some(sh_rotation(&path::at(*about, keys, t).rotation))
    }

    /// The VJP of [`paint`](Self::paint): adds dL/d(SH) where the table is the layer's own, fills what goes to the
    /// model inside otherwise.
    fn paint_back(
        &self,
        q: &At<'_, F>,
        inner: &Tape<F>,
        d_paint: &Table<F>,
        d: &mut Grads<F>,
    ) -> (Option<Table<F>>, Option<Table<F>>) {
        let color = self.inner.color(q, inner);
        let (width, turn) = (block_width(&color), self.turn(q.t.0));
        let direct = matches!(color, Color::Direct { .. });
        let weights_of = |c: &Color<'_, F>| match c {
            Color::Sh { weights, .. } => weights.map(|w| w.zeros_like()),
            Color::Direct { .. } => None,
        };
        let (mut d_weights, mut d_color) = (weights_of(&color), None);
        let base = matches!(color, Color::Sh { base: true, .. });
        if !base {
            d_color = Some(Table::new(&[("d_color", table_width(&color))], q.len()));
        }
        let (mut row, mut seen) = (vec![F::ZERO; width], vec![F::ZERO; width]);
        for j in 0..q.len() {
            row.iter_mut().enumerate().for_each(|(k, x)| *x = d_paint.get(j, k));
            match (&self.change, &turn) {
                (Change::Color { map }, _) => {
                    flatten(&color, j, &mut seen);
                    if direct { map.colors_back(&seen, &mut row) } else { map.harmonics_back(&seen, &mut row) }
                }
                (_, Some(m)) if !direct => rotate(m, &mut row, true),
                _ => {}
            }
            let (to, at) = match &mut d_color {
                Some(table) => (table, j),
                None => {
                    let [table] = d.of([SH]);
                    (table, q.rows.id(j))
                }
            };
            let Color::Sh { table, rows, weights: Some(w), .. } = color else {
                row.iter().enumerate().for_each(|(k, x)| *to.get_mut(at, k) += *x);
                continue;
            };
            for b in 0..w.width() {
                let values = (0..width).map(|k| row[k] * table.get(rows.id(j), b * width + k));
                let along: F = values.sum();
                (0..width).for_each(|k| *to.get_mut(at, b * width + k) += w.get(j, b) * row[k]);
                d_weights.as_mut().expect("there are weights").set(j, b, along);
            }
        }
        (d_color, d_weights)
    }

    /// Σ d_out · ∂out/∂t at a fixed inner result, by central differences.
    fn d_time(&self, q: &At<'_, F>, own: &Own<F>, d_out: &SplatGrads<'_, F>) -> f64 {
        if !self.change.moves() {
            return 0.0;
        }
        let side = |h: f64| {
            let mut out = Table::new(&SPLAT_COLUMNS, q.len());
            self.place(q, q.t.0 + h, &own.inner.out, &mut out);
            let mut paint = Table::default();
            if d_out.color.is_some() {
                self.paint(q, q.t.0 + h, &own.inner, &mut paint);
            }
            (out, paint)
        };
        let (before, after) = (side(-STEP), side(STEP));
        let mut sum = along(d_out.out, &before.0, &after.0);
        if let Some(d_color) = d_out.color.filter(|_| self.change.paints()) {
            sum += along(d_color, &before.1, &after.1);
        }
        sum / (2.0 * STEP)
    }
}

/// Numbers of a splat.
const WIDTH: usize = SPLAT_OPACITY + 1;
type Turn = [[f64; MAX_COEFFS]; MAX_COEFFS];

/// Σ d · (b − a)
fn along<F: Real>(d: &Table<F>, a: &Table<F>, b: &Table<F>) -> f64 {
    let row =
        |j: usize| (0..d.width()).map(|k| d.get(j, k).f64() * (b.get(j, k).f64() - a.get(j, k).f64())).sum::<f64>();
    (0..d.rows()).map(row).sum()
}

impl<F: Real> Placed<'_, F> {
    #[inline(always)]
    fn of(&self, id: usize) -> Option<Affine<F>> {
        match self {
            Placed::Same => None,
            Placed::All(a) => Some(*a),
            Placed::Each(pulls) => pulls.of(id),
        }
    }
}

/// Q S Qᵀ of a symmetric matrix as xx, xy, xz, yy, yz, zz.
#[inline(always)]
fn congruence<F: Real>(q: &[[F; 3]; 3], [xx, xy, xz, yy, yz, zz]: [F; 6]) -> [F; 6] {
    let s = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let half: [[F; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| dot(q[i], [s[0][k], s[1][k], s[2][k]])));
    let at = |i: usize, k: usize| dot(half[i], q[k]);
    [at(0, 0), at(0, 1), at(0, 2), at(1, 1), at(1, 2), at(2, 2)]
}

fn transposed<F: Real>(a: &[[F; 3]; 3]) -> [[F; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|k| a[k][i]))
}

fn table_width<F: Real>(color: &Color<'_, F>) -> usize {
    match color {
        Color::Sh { table, .. } | Color::Direct { table } => table.width(),
    }
}

/// Numbers of a colour: those of one block of coefficients.
fn block_width<F: Real>(color: &Color<'_, F>) -> usize {
    match color {
        Color::Sh { table, weights, .. } => table.width() / weights.map_or(1, |w| w.width().max(1)),
        Color::Direct { table } => table.width(),
    }
}

/// The colour of splat j, blocks added up.
fn flatten<F: Real>(color: &Color<'_, F>, j: usize, out: &mut [F]) {
    let width = out.len();
    for (k, out) in out.iter_mut().enumerate() {
        *out = match color {
            Color::Sh { table, rows, weights: Some(w), .. } => {
                (0..w.width()).map(|b| w.get(j, b) * table.get(rows.id(j), b * width + k)).sum()
            }
            Color::Sh { table, rows, .. } => table.get(rows.id(j), k),
            Color::Direct { table } => table.get(j, k),
        };
    }
}

/// Turns coefficients (3k + channel) by `m`, or with `back` by its transpose; degrees do not mix.
fn rotate<F: Real>(m: &Turn, row: &mut [F], back: bool) {
    let degree = degree_of(row.len() / 3).unwrap_or(0);
    for l in 1..=degree {
        let range = l * l..(l + 1) * (l + 1);
        for c in 0..3 {
            let old: [F; MAX_COEFFS] =
                std::array::from_fn(|k| if range.contains(&k) { row[3 * k + c] } else { F::ZERO });
            for k in range.clone() {
                let cell = |i: usize| F::of(if back { m[i][k] } else { m[k][i] });
                row[3 * k + c] = range.clone().map(|i| cell(i) * old[i]).sum();
            }
        }
    }
}

impl<F: Real> Motion<F> for Edited<F> {
    fn spec(&self) -> Spec {
        Spec::Edited(EditedSpec { inner: Box::new(self.inner.spec()), change: self.change.clone() })
    }

    fn capabilities(&self) -> Capabilities {
        capabilities(self.inner.capabilities(), &self.change)
    }

    fn with_phase(&self, phase: &Phase) -> Option<Arc<dyn Motion<F>>> {
        Some(Arc::new(self.with(self.inner.with_phase(phase)?, self.change.clone())))
    }

    /// Those of the model inside, its result and its colours.
    fn scratch_bytes(&self, p: &Params<F>, rows: usize) -> u64 {
        self.inner.scratch_bytes(p, rows) + (rows * (2 * WIDTH + p[SH].width()) * size_of::<F>()) as u64
    }

    fn prepare(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache) {
        let inside: Vec<At<'_, F>> = q.iter().map(|q| self.inside(q)).collect();
        self.inner.prepare(p, &inside, cache);
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        if self.passes(q) {
            return self.inner.at(&self.inside(q), cache, tape);
        }
        tape.start(q.len());
        let own = tape.own.get_or_default::<Own<F>>();
        self.inner.at(q, cache, &mut own.inner);
        self.place(q, q.t.0, &own.inner.out, &mut tape.out);
        let mut paint = std::mem::take(&mut own.paint);
        self.paint(q, q.t.0, &own.inner, &mut paint);
        own.paint = paint;
    }

    fn color<'a>(&self, q: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        if self.passes(q) {
            return self.inner.color(&self.inside(q), tape);
        }
        let own = tape.own.get::<Own<F>>().expect("`at` came first");
        match self.inner.color(q, &own.inner) {
            color if !self.change.paints() => color,
            Color::Direct { .. } => Color::Direct { table: &own.paint },
            Color::Sh { .. } => {
                Color::Sh { table: &own.paint, rows: crate::scene::Rows::All, weights: None, base: false }
            }
        }
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        if self.passes(q) {
            let rate = if let Change::Clock { rate, .. } = self.change { rate } else { 1.0 };
            return rate * self.inner.backward(&self.inside(q), cache, tape, d_out, d_cache, d);
        }
        let own = tape.own.get_or_default::<Own<F>>();
        let d_time = self.d_time(q, own, d_out);
        let (placed, factor) = (self.placed(q.p, q.t.0), self.factor(q.t.0));
        let mut d_inner = std::mem::take(&mut own.d_inner);
        if d_inner.width() == 0 {
            d_inner = d_out.out.zeros_like();
        }
        d_inner.resize(q.len());
        par_split([d_inner.view_mut()], &|[mut view]| {
            for j in view.first..view.first + view.rows {
                let mut row = d_out.out.read::<WIDTH>(j, 0);
                row[SPLAT_OPACITY] *= factor;
                if let Some(a) = placed.of(q.rows.id(j)) {
                    let g = [row[0], row[1], row[2]];
                    let mean: [F; 3] = std::array::from_fn(|i| (0..3).map(|k| a.m[k][i] * g[k]).sum());
                    // An off-diagonal's gradient represents both of its positions.
                    let h = F::HALF;
                    let [xx, xy, xz, yy, yz, zz]: [F; 6] = std::array::from_fn(|k| row[COV + k]);
                    let back = congruence(&transposed(&a.q), [xx, h * xy, h * xz, yy, h * yz, zz]);
                    let two = F::TWO;
                    let cov = [back[0], two * back[1], two * back[2], back[3], two * back[4], back[5]];
                    row[..3].copy_from_slice(&mean);
                    row[COV..SPLAT_OPACITY].copy_from_slice(&cov);
                }
                view.write(j, 0, row);
            }
            0.0
        });
        let mut inside = SplatGrads { out: &d_inner, color: d_out.color, weights: d_out.weights };
        let painted = match d_out.color.filter(|_| self.change.paints()) {
            Some(d_paint) => self.paint_back(q, &own.inner, d_paint, d),
            None => (None, None),
        };
        if self.change.paints() {
            (inside.color, inside.weights) = (painted.0.as_ref(), painted.1.as_ref());
        }
        let d_inside = self.inner.backward(q, cache, &mut own.inner, &inside, d_cache, d);
        own.d_inner = d_inner;
        d_time + d_inside
    }

    fn finish(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache, d_cache: &mut Cache, d: &mut Grads<F>) {
        let inside: Vec<At<'_, F>> = q.iter().map(|q| self.inside(q)).collect();
        self.inner.finish(p, &inside, cache, d_cache, d);
    }

    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, rng: &Rng) {
        self.inner.on_edit(p, edit, rng);
    }

    fn resize(&self, p: &mut Params<F>, row: usize, factor: f64) {
        self.inner.resize(p, row, factor);
    }

    fn life(&self, p: &Params<F>, out: &mut Table<F>) -> bool {
        let own = self.inner.life(p, out);
        if let (true, Change::Clock { rate, offset }) = (own, &self.change) {
            for row in 0..out.rows() {
                let [center, log_width] = out.read::<2>(row, 0);
                out.write(row, 0, [F::of((center.f64() - offset) / rate), log_width - F::of(rate.abs().ln())]);
            }
        }
        own
    }

    /// Places inside a path or a drag are not the world's: only what is next to them can take a frame in.
    fn apply_transform(&self, p: &mut Params<F>, frame: &Sim3) -> bool {
        match self.change {
            Change::Path { .. } | Change::Drag(_) => false,
            _ => self.inner.apply_transform(p, frame),
        }
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        match self.change {
            Change::Path { .. } | Change::Drag(_) => central_velocity(self, q, out),
            Change::Clock { rate, .. } => {
                self.inner.velocity(&self.inside(q), out);
                out.data_mut().iter_mut().for_each(|v| *v *= F::of(rate));
            }
            _ => self.inner.velocity(q, out),
        }
    }
}
