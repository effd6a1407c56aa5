//! Conversion of `native4d` layers to `spacetime` and back. A Gaussian of space and time is a slice that moves at a
//! constant velocity, and a lifespan: exactly a `spacetime` one of order 1 with a `GaussHalf` life.

use super::Layer;
use crate::math::{Real, quat, sym3};
use crate::motion::native4d::{LONGEST, Native4d, Native4dSpec, SHORTEST, Sliced, TABLE};
use crate::motion::spacetime::VELOCITIES;
use crate::motion::{Motion, Spacetime, SpacetimeSpec, Spec};
use crate::scene::life::{CENTER, LOG_WIDTH};
use crate::scene::params::{LOG_SCALE, QUAT};
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use crate::{Error, Result};
use std::borrow::Cow;
use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::Arc;

/// No scale is written smaller than this, scene units: its logarithm must be a number.
const SMALLEST: f64 = 1e-12;

fn cannot(what: &str, remedy: &str) -> Error {
    Error::input(what.to_owned()).remedy(remedy.to_owned())
}

/// The layer as a polynomial of time where its model is one in other numbers (`native4d`); else the layer unchanged.
///
/// Errors: those of `to_spacetime`.
pub(crate) fn with_polynomial<F: Real>(layer: &Layer<F>) -> Result<Cow<'_, Layer<F>>> {
    match layer.motion.spec() {
        Spec::Native4d(_) => to_spacetime(layer).map(Cow::Owned),
        _ => Ok(Cow::Borrowed(layer)),
    }
}

/// A `native4d` layer as a `spacetime` one of order 1 with a `GaussHalf` life: the same image at every time.
///
/// Errors: the layer moves otherwise; its colours change with time, or it has another life in addition to its own.
pub(crate) fn to_spacetime<F: Real>(layer: &Layer<F>) -> Result<Layer<F>> {
    let Spec::Native4d(spec) = layer.motion.spec() else {
        return Err(cannot("this layer is not of the model native4d", "Give one that is"));
    };
    if spec.harmonics > 0 {
        return Err(cannot(
            "spacetime does not support colours that change with time",
            "Train with sh_harmonics=0, or bake the scene",
        ));
    }
    if layer.life != LifeKind::Infinite {
        return Err(cannot("this layer has a lifespan in addition to native4d's own", "Bake the scene"));
    }
    let own = layer.params.find(TABLE).expect("a native4d layer has its table");
    let rows = layer.params.len();
    let mut p = Params::<F>::new(rows, layer.params[SH].width() / 3, LifeKind::GaussHalf.columns());
    let motion = Spacetime::new(SpacetimeSpec::default(), &mut p)?;
    p[GEOMETRY] = layer.params[GEOMETRY].clone();
    p[SH] = layer.params[SH].clone();
    for row in 0..rows {
        let g = Sliced::of(&spec, &layer.params, own, row);
        let (q, logs) = sym3::to_quat_log_scales(g.cov, SMALLEST);
        p[GEOMETRY].write(row, QUAT, q.map(F::of));
        p[GEOMETRY].write(row, LOG_SCALE, logs.map(F::of));
        p[motion.velocities()].write(row, 0, g.velocity.map(F::of));
        p[LIFE].set(row, CENTER, F::of(g.time));
        p[LIFE].set(row, LOG_WIDTH, F::of(g.width.ln()));
    }
    Ok(Layer { params: p, motion: Arc::new(motion), life: LifeKind::GaussHalf, ..layer.clone() })
}

/// A `spacetime` layer as a `native4d` one with the given spec (its harmonics start at zero): the same image at every
/// time, where the lifespans are within the spec's bounds.
///
/// Errors: the layer moves otherwise, along curves, turns, or its lifespan is not Gaussian; a spec out of its ranges.
#[cfg_attr(not(test), expect(dead_code, reason = "tests compare the two models by it"))]
pub(crate) fn to_native4d<F: Real>(layer: &Layer<F>, spec: Native4dSpec) -> Result<Layer<F>> {
    let own_spec = match layer.motion.spec() {
        Spec::Spacetime(SpacetimeSpec { features: Some(_), .. }) => {
            return Err(cannot("native4d does not support features", "Train with features=none"));
        }
        Spec::Spacetime(s) if s.order <= 1 && !s.rotation => s,
        _ => {
            return Err(cannot(
                "only a spacetime layer of motion order 0 or 1 without rotation rates is one of native4d",
                "Train with motion_order=1 and rotation_rate=false",
            ));
        }
    };
    // exp(−u²) is the same life as exp(−½u²) with a width √2 times as large.
    let unit = match layer.life {
        LifeKind::GaussHalf => 1.0,
        LifeKind::GaussOne => FRAC_1_SQRT_2,
        _ => {
            return Err(cannot(
                "native4d supports only Gaussian lifespans",
                "Train with life=gauss-half or life=gauss-one",
            ));
        }
    };
    let rows = layer.params.len();
    let mut p = Params::<F>::new(rows, layer.params[SH].width() / 3, &[]);
    p[GEOMETRY] = layer.params[GEOMETRY].clone();
    p[SH] = layer.params[SH].clone();
    let motion = Native4d::new(spec, &mut p)?;
    let velocities = layer.params.find(VELOCITIES).filter(|_| own_spec.order == 1);
    for row in 0..rows {
        let g = layer.params[GEOMETRY].read::<11>(row, 0).map(Real::f64);
        let [time, log_width] = layer.params[LIFE].read::<2>(row, 0).map(Real::f64);
        let q = quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]]).0;
        let sliced = Sliced {
            mean: [g[0], g[1], g[2]],
            velocity: velocities.map_or([0.0; 3], |v| layer.params[v].read::<3>(row, 0).map(Real::f64)),
            cov: sym3::from_quat_log_scales(q, [g[LOG_SCALE], g[LOG_SCALE + 1], g[LOG_SCALE + 2]]),
            time,
            width: (log_width.exp() * unit).clamp(SHORTEST, LONGEST),
        };
        sliced.write(&spec, &mut p, motion.own(), row);
    }
    let life = LifeKind::Infinite;
    Ok(Layer { params: p, motion: Arc::new(motion) as Arc<dyn Motion<F>>, life, ..layer.clone() })
}
