//! The registry of motion models: the properties that a model declares, and the macro that turns the list in
//! [`motion`](super) into [`Spec`](super::Spec), its names and [`build`](super::build).

use super::Motion;
use crate::Result;
use crate::math::Real;
use crate::scene::life::CENTER;
use crate::scene::params::QUAT;
use crate::scene::{GEOMETRY, Key, LIFE, Params};
use std::sync::Arc;

/// A built-in model as plain data: the payload of its entry in the list.
pub(crate) trait Model {
    /// Makes the model, and in `p` the tables it needs (or claims the loaded ones).
    ///
    /// Errors: numbers that are out of their ranges, loaded arrays of the wrong shape.
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>>;

    /// The properties that the rest of the library may rely on.
    fn capabilities(&self) -> Capabilities;
}

/// Properties of a motion model that others act on, in place of its name. The default promises nothing: it is that of a
/// model from outside the library.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capabilities {
    /// Something may depend on time, next to the layer's lifespan.
    pub moves: bool,
    /// Gaussians may turn as they move.
    pub rotates: bool,
    /// Birth and death are the model's own ([`Motion::life`]), and the layer needs no lifespan table.
    pub own_life: bool,
    /// State runs forward in time: a result at t depends on no number that represents a later time, so that what
    /// follows can be learnt or cut off without a change of what was.
    pub causal: bool,
    /// Fixed cameras that must see every time for the model to be learnt.
    pub fixed_cameras: usize,
    /// Blocks of spherical harmonics in the layer's SH table.
    pub color_blocks: usize,
}

impl Default for Capabilities {
    fn default() -> Self {
        Self { moves: true, rotates: true, own_life: false, causal: false, fixed_cameras: 0, color_blocks: 1 }
    }
}

/// A phase of training, which a stage gives to its models: parts that are not in use yet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Phase {
    /// The canonical Gaussians are all there is, and only they learn.
    pub rests: bool,
    /// Levels of detail in use, the coarsest first; none: all.
    pub levels: Option<usize>,
}

/// Motion as a polynomial in time around the centre of each Gaussian's lifespan: what files of kinematic Gaussians
/// hold, and what bakes without a fit where it is straight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Polynomial {
    /// Order in Δ, seconds from the centre; 0: positions stay.
    pub order: usize,
    /// Table of the coefficients of position, [N, 3·order], scene units / s^k; none where the order is 0.
    pub velocities: Option<Key>,
    /// Table of quaternion rates, [N, 4], 1/s; none: rotations stay.
    pub rotation_rates: Option<Key>,
    /// Centre for Gaussians that have infinite lifespans, seconds.
    pub origin: f64,
    /// Whether Δ is a constant, so that the lifespan's centre learns from opacity alone.
    pub detached: bool,
}

/// Motion as slices of Gaussians of space and time (see [`native4d`](super::native4d)): what all of them share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slices {
    /// Table of the columns beyond the geometry.
    pub own: Key,
    /// κ, scene units per second.
    pub speed: f64,
    /// Least c, scene units².
    pub floor: f64,
    /// Largest log scale in time, log seconds.
    pub ceiling: f64,
    /// Blocks of spherical harmonics that change with time.
    pub harmonics: usize,
    /// Their period, seconds.
    pub period: f64,
}

impl Polynomial {
    /// Whether all motion is linear without rotation.
    pub(crate) fn is_straight(&self) -> bool {
        self.order <= 1 && self.rotation_rates.is_none()
    }

    /// Displacement of a row's mean from the centre of its lifespan to `delta` seconds later, scene units.
    pub fn travel<F: Real>(&self, p: &Params<F>, row: usize, delta: f64) -> [f64; 3] {
        let mut out = [0.0; 3];
        let Some(key) = self.velocities else { return out };
        for k in (0..self.order).rev() {
            let v = p[key].read::<3>(row, 3 * k);
            (0..3).for_each(|axis| out[axis] = (out[axis] + v[axis].f64()) * delta);
        }
        out
    }

    /// Moves the centre of a row's lifespan by `shift` seconds and keeps its path and rotation, for models of every
    /// order: what it showed at any time it shows still, but for its lifespan. Colours that change with time begin
    /// again at the centre.
    ///
    /// Panics: the layer's Gaussians have infinite lifespans.
    pub fn recentre<F: Real>(&self, p: &mut Params<F>, row: usize, shift: f64) {
        assert!(p[LIFE].width() > 0, "a Gaussian without lifespan has no temporal centre to move");
        let travel = self.travel(p, row, shift);
        p[GEOMETRY].add(row, 0, travel.map(F::of));
        if let Some(key) = self.velocities {
            // Taylor's shift: of v₁Δ + v₂Δ² + v₃Δ³ around Δ = shift.
            let mut v = [[0.0; 3]; MAX_ORDER];
            (0..self.order).for_each(|k| v[k] = p[key].read::<3>(row, 3 * k).map(Real::f64));
            for axis in 0..3 {
                let [v1, v2, v3] = v.map(|v| v[axis]);
                v[0][axis] = v1 + shift * (2.0 * v2 + shift * 3.0 * v3);
                v[1][axis] = v2 + shift * 3.0 * v3;
            }
            (0..self.order).for_each(|k| p[key].write(row, 3 * k, v[k].map(F::of)));
        }
        if let Some(key) = self.rotation_rates {
            let rate = p[key].read::<4>(row, 0);
            p[GEOMETRY].add(row, QUAT, rate.map(|w| F::of(w.f64() * shift)));
        }
        let center = p[LIFE].get(row, CENTER).f64() + shift;
        p[LIFE].set(row, CENTER, F::of(center));
    }
}

/// Generates `Spec`, the names and all functions of specs from the list of models.
///
/// `models` train by themselves, `wrappers` around another one, `foreign` ones are read from other programs' files. An entry names the variant, what binds its payload and
/// the payload's type, the model's name, and a reference to what implements `Model`.
macro_rules! registry {
    (
        models { $($(#[$doc:meta])* $variant:ident $(($bound:ident: $spec:ty))? = $name:literal => $model:expr;)* }
        wrappers { $($(#[$w_doc:meta])* $w_variant:ident($w_bound:ident: $w_spec:ty) = $w_name:literal => $wrapper:expr;)* }
        foreign { $($(#[$f_doc:meta])* $f_variant:ident($f_bound:ident: $f_spec:ty) = $f_name:literal => $foreign:expr;)* }
    ) => {
        /// A model as plain data: what files store, and all that [`build`] needs to make it again.
        ///
        /// Its JSON form is an object whose `model` is the model's name, next to the fields of its spec.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "model")]
        #[non_exhaustive]
        pub enum Spec {
            $($(#[$doc])* #[serde(rename = $name)] $variant $(($spec))?,)*
            $($(#[$w_doc])* #[serde(rename = $w_name)] $w_variant($w_spec),)*
            $($(#[$f_doc])* #[serde(rename = $f_name)] $f_variant($f_spec),)*
            /// A model from outside this library; it can be built from a file where it is
            /// [registered](register).
            #[serde(skip)]
            Custom(String),
        }

        /// Names of the models that train by themselves.
        pub const MODELS: &[&str] = &[$($name),*];

        /// Names of all models that the library can build, with those that wrap another or are only read.
        pub const BUILT_IN: &[&str] = &[$($name,)* $($w_name,)* $($f_name),*];

        impl Spec {
            /// The name that `--motion` takes and files store.
            pub fn name(&self) -> &str {
                match self {
                    $(Spec::$variant $(($bound))? => { $(let _ = $bound;)? $name })*
                    $(Spec::$w_variant(_) => $w_name,)*
                    $(Spec::$f_variant(_) => $f_name,)*
                    Spec::Custom(name) => name,
                }
            }

            /// The model inside a wrapper. `None`: it wraps none.
            pub(crate) fn inner(&self) -> Option<&Spec> {
                match self {
                    $(Spec::$w_variant(spec) => Some(&spec.inner),)*
                    _ => None,
                }
            }

            /// Whether [`build`] can make it.
            pub(crate) fn is_built_in(&self) -> bool {
                !matches!(self, Spec::Custom(_))
            }

            /// Properties of the model; none for one from outside, which declares its own
            /// ([`Motion::capabilities`]).
            pub fn capabilities(&self) -> Option<Capabilities> {
                match self {
                    $(Spec::$variant $(($bound))? => Some(Model::capabilities($model)),)*
                    $(Spec::$w_variant($w_bound) => Some(Model::capabilities($wrapper)),)*
                    $(Spec::$f_variant($f_bound) => Some(Model::capabilities($foreign)),)*
                    Spec::Custom(_) => None,
                }
            }
        }

        /// Makes the model, and in `p` the tables it needs (or claims the loaded ones).
        ///
        /// Errors: a `Spec::Custom` that is not registered; numbers out of their ranges; loaded arrays of the wrong
        /// shape.
        pub fn build(spec: &Spec, p: &mut Params) -> Result<Arc<dyn Motion>> {
            build_as(spec, p)
        }

        /// As [`build`], over any kind of numbers: gradients are checked in f64. It is apart so that the models over
        /// f32 are compiled once, here, and not again in every crate that makes one.
        pub fn build_as<F: Real>(spec: &Spec, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
            match spec {
                $(Spec::$variant $(($bound))? => Model::build($model, p),)*
                $(Spec::$w_variant($w_bound) => Model::build($wrapper, p),)*
                $(Spec::$f_variant($f_bound) => Model::build($foreign, p),)*
                Spec::Custom(name) => outside::build(name, p).unwrap_or_else(|| {
                    Err(Error::input(format!("motion model `{name}` is not one of this version's"))
                        .remedy(format!("Known are: {}. A newer splat4d may have more", BUILT_IN.join(", "))))
                }),
            }
        }
    };
}
pub(super) use registry;

/// Highest order of the polynomial.
pub(crate) const MAX_ORDER: usize = 3;
