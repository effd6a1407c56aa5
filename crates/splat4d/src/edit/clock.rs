//! Windows and clocks of layers.

use crate::layers::{ALWAYS, Layer};
use crate::math::Rng;
use crate::motion::edited::{Change, Edited, FadeKey, PathKey};
use crate::motion::filtered::Filtered;
use crate::motion::{Motion, Spacetime, Still};
use crate::scene::life::{CENTER, LOG_SOFTNESS, LOG_WIDTH};
use crate::scene::{KeyMasks, LIFE, RowEdit, Space};
use crate::{Error, ErrorKind, Result};
use std::any::Any;
use std::sync::Arc;

/// The layer restricted to from ≤ t < to, without Gaussians that are invisible then; none where no Gaussian is left.
pub(super) fn window(layer: &Layer<f32>, [from, to]: [f64; 2]) -> Option<Layer<f32>> {
    let span = [layer.span[0].max(from), layer.span[1].min(to)];
    if span[0] >= span[1] {
        return None;
    }
    let mut out = Layer { span, ..layer.clone() };
    let seen: Vec<bool> = out.spans().iter().map(|[from, to]| from <= to).collect();
    if !seen.contains(&true) {
        return None;
    }
    if seen.contains(&false) {
        out.edit(&RowEdit::prune(Space::Gaussians, seen.into_iter()), &Rng::new(0, "edit", 0));
    }
    Some(out)
}

/// Number of the layer's Gaussians that [`window`] keeps.
pub(super) fn seen_in(layer: &Layer<f32>, [from, to]: [f64; 2]) -> usize {
    let span = [layer.span[0].max(from), layer.span[1].min(to)];
    if span[0] >= span[1] {
        return 0;
    }
    // By lifespan, for any window: those alive in it.
    layer.spans().iter().filter(|[first, last]| first.max(span[0]) <= last.min(span[1])).count()
}

/// The layer on another clock: what it showed at s = rate·t + offset it shows at t.
///
/// Errors: a filter around a model whose motion depends on its lifespans.
pub(super) fn retime(layer: &mut Layer<f32>, rate: f64, offset: f64) -> Result<()> {
    let outside = |s: f64| (s - offset) / rate;
    // Before the lifespans change: models that read them take the same clock in their own tables.
    layer.motion = retimed(&layer.motion.clone(), rate, offset, layer)?;
    if layer.span != ALWAYS {
        let ends = layer.span.map(outside);
        layer.span = [ends[0].min(ends[1]), ends[0].max(ends[1])];
    }
    let table = &mut layer.params[LIFE];
    if table.width() > 0 {
        let slower = -rate.abs().ln() as f32;
        for row in 0..table.rows() {
            let center = outside(f64::from(table.get(row, CENTER)));
            table.set(row, CENTER, center as f32);
            table.add(row, LOG_WIDTH, [slower]);
            if table.width() > LOG_SOFTNESS {
                table.add(row, LOG_SOFTNESS, [slower]);
            }
        }
    }
    if let Some(masks) = &layer.masks {
        layer.masks = Some(Arc::new(remasked(masks, rate, outside)));
    }
    Ok(())
}

fn remasked(masks: &KeyMasks, rate: f64, outside: impl Fn(f64) -> f64) -> KeyMasks {
    let keys = masks.times().len();
    let old = |k: usize| if rate > 0.0 { k } else { keys - 1 - k };
    let mut out = KeyMasks::new((0..keys).map(|k| outside(masks.times()[old(k)])).collect(), masks.rows());
    for k in 0..keys {
        (0..masks.rows()).filter(|&row| masks.get(old(k), row)).for_each(|row| out.set(k, row));
    }
    out
}

fn retimed(motion: &Arc<dyn Motion>, rate: f64, offset: f64, layer: &mut Layer<f32>) -> Result<Arc<dyn Motion>> {
    let outside = |s: f64| (s - offset) / rate;
    if let Some(edited) = Edited::of(motion.as_ref()) {
        match edited.change() {
            Change::Clock { rate: own, offset: shift } => {
                let change = Change::Clock { rate: own * rate, offset: own * offset + shift };
                return Ok(Arc::new(edited.with(edited.inner().clone(), change)));
            }
            // A drag's tables are in the order of its times.
            Change::Drag(_) if rate < 0.0 => return clocked(motion, rate, offset, layer),
            _ => {}
        }
        let inner = retimed(edited.inner(), rate, offset, layer)?;
        let change = match edited.change().clone() {
            Change::Path { about, keys } => {
                let keys = keys.into_iter().map(|k| PathKey { t: outside(k.t), ..k });
                Change::Path { about, keys: rising(keys.collect(), rate) }
            }
            Change::Fade { keys } => {
                let keys = keys.into_iter().map(|k| FadeKey { t: outside(k.t), ..k });
                Change::Fade { keys: rising(keys.collect(), rate) }
            }
            Change::Drag(mut spec) => {
                spec.times.iter_mut().for_each(|t| *t = outside(*t));
                Change::Drag(spec)
            }
            same => same,
        };
        return Ok(Arc::new(edited.with(inner, change)));
    }
    let any: &dyn Any = motion.as_ref();
    if let Some(model) = any.downcast_ref::<Spacetime>() {
        return Ok(Arc::new(model.retimed(rate, offset, &mut layer.params)));
    }
    if any.is::<Still>() { Ok(motion.clone()) } else { clocked(motion, rate, offset, layer) }
}

/// A clock around the model, which must not read the lifespans that are about to change.
fn clocked(motion: &Arc<dyn Motion>, rate: f64, offset: f64, layer: &mut Layer<f32>) -> Result<Arc<dyn Motion>> {
    if reads_lifespans(motion.as_ref()) && layer.params[LIFE].width() > 0 {
        return Err(Error::new(ErrorKind::Unsupported, format!("layer `{}` cannot be retimed", layer.name))
            .remedy("Bake the scene first; baked scenes can"));
    }
    Ok(Arc::new(Edited::around(motion.clone(), Change::Clock { rate, offset }, &mut layer.params)?))
}

fn reads_lifespans(motion: &dyn Motion) -> bool {
    let any: &dyn Any = motion;
    any.is::<Spacetime>()
        || Filtered::of(motion).is_some_and(|f| reads_lifespans(f.inner().as_ref()))
        || Edited::of(motion).is_some_and(|e| reads_lifespans(e.inner().as_ref()))
}

fn rising<K>(mut keys: Vec<K>, rate: f64) -> Vec<K> {
    if rate < 0.0 {
        keys.reverse();
    }
    keys
}
