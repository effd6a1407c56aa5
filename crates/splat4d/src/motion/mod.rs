//! Motion models: from parameters and a time to splats. A model does not depend on pixels; it is a pure function of its
//! parameters.
//!
//! A model has no hidden state. Sequential ones (state space, filters) scan in [`Motion::prepare`], add to the scan's
//! gradient in [`Motion::backward`], and run the reverse scan in [`Motion::finish`]; pointwise ones leave those empty.

pub mod arap;
pub mod control;
pub mod deform;
pub mod edited;
pub mod filtered;
pub mod hexplane;
pub(crate) mod lanes;
pub mod native4d;
mod outside;
pub(crate) mod registry;
pub mod skin;
pub mod spacetime;
pub mod ssm;
pub mod still;
pub mod tracked;
pub mod warp;

use crate::math::{Real, Rng, Sim3};
use crate::scene::params::LOG_SCALE;
use crate::scene::splats::SPLAT_COLUMNS;
use crate::scene::table::{TableMut, par_split};
use crate::scene::{Color, GEOMETRY, Grads, Key, Params, RowEdit, Rows, SH, Space, SplatGrads, Table, Time};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::sync::Arc;

use registry::registry;

pub use outside::{MakeMotion, is_registered, register};
pub(crate) use registry::Model;
pub use registry::{Capabilities, Phase, Polynomial, Slices};
pub use spacetime::{Spacetime, SpacetimeSpec};
pub use still::Still;

/// One query to a motion model.
#[derive(Clone, Copy, Debug)]
pub struct At<'a, F = f32> {
    /// The layer's parameters.
    pub p: &'a Params<F>,
    /// Gaussians, or nodes (evaluated as splats: node losses, node warm-up).
    pub of: Space,
    /// Which rows.
    pub rows: Rows<'a>,
    /// When.
    pub t: Time,
}

impl<F: Real> At<'_, F> {
    /// Number of requested splats.
    pub fn len(&self) -> usize {
        self.rows.len(self.p.rows_of(self.of))
    }

    /// Whether no splat is requested.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A model's typed scratch, owned by the step and reused.
#[derive(Default)]
pub struct Slot(Option<Box<dyn Any + Send + Sync>>);

impl Slot {
    /// The value of type T, made by `Default` when absent or of another type.
    pub fn get_or_default<T: Any + Send + Sync + Default>(&mut self) -> &mut T {
        if !self.0.as_ref().is_some_and(|b| b.is::<T>()) {
            self.0 = Some(Box::new(T::default()));
        }
        self.0.as_mut().and_then(|b| b.downcast_mut()).expect("the slot was just filled with this type")
    }

    /// The value of type T, if there.
    pub fn get<T: Any>(&self) -> Option<&T> {
        self.0.as_ref().and_then(|b| b.downcast_ref())
    }
}

impl std::fmt::Debug for Slot {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(if self.0.is_some() { "Slot(filled)" } else { "Slot(empty)" })
    }
}

/// Values that a model computes once per step for all queries together; the gradient is another one.
pub type Cache = Slot;

/// One result, and what the model needs to remember of it for its backward.
#[derive(Debug, Default)]
pub struct Tape<F = f32> {
    /// [splats, 10], see [`SPLAT_COLUMNS`].
    pub out: Table<F>,
    /// The model's own.
    pub own: Slot,
}

impl<F: Real> Tape<F> {
    /// Makes `out` a splat table of `rows` rows, keeping the allocation.
    pub fn start(&mut self, rows: usize) {
        if self.out.width() == 0 {
            self.out = Table::new(&SPLAT_COLUMNS, rows);
        } else {
            self.out.resize(rows);
        }
    }
}

// The list of models: a model is its file and an entry here.
registry! {
    models {
        /// Nothing moves.
        Still = "still" => &Still;
        /// Explicit kinematics around each Gaussian's lifespan.
        Spacetime(s: SpacetimeSpec) = "spacetime" => s;
        /// A perceptron or a hash grid deforms a canonical cloud.
        DeformMlp(s: deform::DeformSpec) = "deform-mlp" => s;
        /// Six feature planes deform a canonical cloud.
        Hexplane(s: hexplane::HexplaneSpec) = "hexplane" => s;
        /// Positions and rotations at every frame.
        Tracked(s: tracked::TrackedSpec) = "tracked" => s;
        /// Gaussians of space and time.
        Native4d(s: native4d::Native4dSpec) = "native4d" => s;
        /// Gaussians skinned to control nodes.
        Control(s: control::ControlSpec) = "control" => s;
        /// Control nodes driven by a state-space model.
        Ssm(s: ssm::SsmSpec) = "ssm" => s;
    }
    wrappers {
        /// A temporal filter around any of them.
        Filtered(s: filtered::FilteredSpec) = "filtered" => s;
        /// A change on top of any of them.
        Edited(s: edited::EditedSpec) = "edited" => s;
    }
    foreign {
        /// Gaussians that follow nodes by residuals (SC-GS).
        Warp(s: warp::WarpSpec) = "warp" => s;
    }
}

impl Spec {}

/// A motion model. Immutable: a spec and keys.
pub trait Motion<F: Real = f32>: Any + Send + Sync {
    /// Plain data from which [`build`] makes this model again.
    fn spec(&self) -> Spec;

    /// Once per step, before any `at`, with all its queries: scans, filters, neighbours, node poses.
    fn prepare(&self, _p: &Params<F>, _q: &[At<'_, F>], _cache: &mut Cache) {}

    /// Fills `tape.out` [rows, 10] for one query; random access in t.
    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>);

    /// Source of the splats' colour; the layer's SH unless a model states otherwise.
    fn color<'a>(&self, q: &At<'a, F>, _tape: &'a Tape<F>) -> Color<'a, F> {
        Color::Sh { table: &q.p[SH], rows: q.rows, weights: None, base: true }
    }

    /// The VJP of `at` (and of `color`, unless it is the layer's SH): adds to `d` and `d_cache`, returns dL/dt.
    ///
    /// Must not read the opacity column of `tape.out`: the layer has multiplied it by the lifespan.
    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64;

    /// Once per step, after every `backward`: the VJP of `prepare`.
    fn finish(&self, _p: &Params<F>, _q: &[At<'_, F>], _cache: &mut Cache, _d_cache: &mut Cache, _d: &mut Grads<F>) {}

    /// After a row edit has gathered every table: what copying alone cannot do (re-timed clones, 4D split offsets).
    fn on_edit(&self, _p: &mut Params<F>, _edit: &RowEdit, _rng: &Rng) {}

    /// Makes Gaussian `row` `factor` times as large in space (splits and relocations do). Models whose size is not in
    /// `log_scales` scale what they have instead.
    fn resize(&self, p: &mut Params<F>, row: usize, factor: f64) {
        p[GEOMETRY].add(row, LOG_SCALE, [F::of(factor.ln()); 3]);
    }

    /// For models whose lifespan is not the layer's: fills [N, 2] with (centre, log width) of a `GaussHalf` life and
    /// returns true. False: the layer's own lifespan table states it.
    fn life(&self, _p: &Params<F>, _out: &mut Table<F>) -> bool {
        false
    }

    /// Properties that others act on. A model from outside the library that declares none promises nothing.
    fn capabilities(&self) -> Capabilities {
        self.spec().capabilities().unwrap_or_default()
    }

    /// Takes a similarity into the model's own tables, as the layer takes it into geometry and colours. False: it
    /// cannot, and nothing has changed.
    fn apply_transform(&self, _p: &mut Params<F>, _frame: &Sim3) -> bool {
        false
    }

    /// The same motion on tables without features for a pixel head; `None`: it has none, or cannot be without them. Keys of
    /// all other tables stay.
    fn without_features(&self) -> Option<Arc<dyn Motion<F>>> {
        None
    }

    /// The motion as a polynomial in time, if it is one.
    fn polynomial(&self) -> Option<Polynomial> {
        None
    }

    /// The motion as slices of Gaussians of space and time, if it is that.
    fn slices(&self) -> Option<Slices> {
        None
    }

    /// The table whose first columns are positions and quaternions at t, if all other geometry is constant.
    fn pose_table(&self, _t: Time) -> Option<Key> {
        None
    }

    /// Bytes that training keeps of one query about `rows` Gaussians until its backward, next to the result and its
    /// gradient: for estimates of memory.
    fn scratch_bytes(&self, p: &Params<F>, rows: usize) -> u64;

    /// The same model in a phase of training; tables are not changed. `None`: the model has no phases.
    fn with_phase(&self, _phase: &Phase) -> Option<Arc<dyn Motion<F>>> {
        None
    }

    /// dμ/dt in scene units per second, [rows, 3]: central differences over ± `VELOCITY_STEP` unless a model has
    /// better.
    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        central_velocity(self, q, out);
    }
}

/// dμ/dt by central differences over ± `VELOCITY_STEP`.
pub(crate) fn central_velocity<F: Real, M: Motion<F> + ?Sized>(model: &M, q: &At<'_, F>, out: &mut Table<F>) {
    let sides = [-VELOCITY_STEP, VELOCITY_STEP].map(|h| {
        let side = At { t: Time(q.t.0 + h), ..*q };
        let (mut cache, mut tape) = (Cache::default(), Tape::default());
        model.prepare(q.p, &[side], &mut cache);
        model.at(&side, &cache, &mut tape);
        tape.out
    });
    *out = Table::new(&[("velocity", 3)], q.len());
    for j in 0..q.len() {
        let (a, b) = (sides[0].read::<3>(j, 0), sides[1].read::<3>(j, 0));
        out.write(j, 0, std::array::from_fn::<F, 3, _>(|k| (b[k] - a[k]) / F::of(2.0 * VELOCITY_STEP)));
    }
}

/// Half the step of the default velocity: half a frame at 60 frames per second, seconds.
pub(crate) const VELOCITY_STEP: f64 = 1.0 / 120.0;

/// Calls `f(j, id, tables)` for every requested row, in parallel over runs of table rows, and returns the sum of the
/// results in a fixed order. `tables` are views that hold row `id`; j is the compact row. Models that can, use `lanes`.
pub fn for_rows<F: Real, const N: usize>(
    tables: [&mut Table<F>; N],
    rows: Rows<'_>,
    f: impl Fn(usize, usize, &mut [TableMut<'_, F>; N]) -> f64 + Sync,
) -> f64 {
    par_split(tables.map(Table::view_mut), &|mut views| {
        let (first, end) = (views[0].first, views[0].first + views[0].rows);
        let (from, to) = match rows {
            Rows::All => (first, end),
            Rows::Some(ids) => {
                (ids.partition_point(|&i| (i as usize) < first), ids.partition_point(|&i| (i as usize) < end))
            }
        };
        (from..to).map(|j| f(j, rows.id(j), &mut views)).sum()
    })
}

/// Fills compact rows of `out` in parallel: `f(j, id)` gives row j's values from column 0 on.
pub fn fill_rows<F: Real, const W: usize>(out: &mut Table<F>, rows: Rows<'_>, f: impl Fn(usize) -> [F; W] + Sync) {
    par_split([out.view_mut()], &|[mut view]| {
        for j in view.first..view.first + view.rows {
            view.write(j, 0, f(rows.id(j)));
        }
        0.0
    });
}
