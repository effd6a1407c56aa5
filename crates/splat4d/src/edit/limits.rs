//! Limits of the scenes that edit steps may produce: Gaussians in memory, length of the clip, finite numbers.

use super::{Context, Step};
use crate::layers::{Evaluation, Layer, Scene};
use crate::scene::Time;
use crate::scene::time::DEFAULT_FPS;
use crate::{Error, ErrorKind, Result};

/// Bytes that editing, rendering and baking take at once, in those of the scene's tables: the scene before and after a
/// step, and what a playback file is made of, 450 bytes per Gaussian where a table has 60 to 250.
const WORKING: u64 = 8;
/// Most frames of a clip: nine hours at 30 a second. Rendering, baking and sequences go through them.
const MOST_FRAMES: f64 = 1e6;
/// Most changes around a model, each inside the next: readers of JSON take a hundred and some levels.
const MOST_NESTED: usize = 40;
/// Times of the clip at which all numbers are checked to be finite.
const TIMES: usize = 3;

/// Rows and bytes of some Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Size {
    pub(super) rows: u64,
    pub(super) bytes: u64,
}

impl Size {
    fn of(layer: &Layer<f32>) -> Self {
        let tables: usize = layer.params.keys().map(|k| size_of_val(layer.params[k].data())).sum();
        let masks = layer.masks.as_ref().map_or(0, |m| size_of_val(m.words()));
        Self { rows: layer.params.len() as u64, bytes: (tables + masks) as u64 }
    }

    /// Of this many of a layer's Gaussians.
    pub(super) fn part(layer: &Layer<f32>, rows: usize) -> Self {
        let all = Self::of(layer);
        let share = rows as f64 / all.rows.max(1) as f64;
        Self { rows: rows as u64, bytes: (all.bytes as f64 * share) as u64 }
    }

    pub(super) fn of_all(layers: &[Layer<f32>]) -> Self {
        layers.iter().map(Self::of).fold(Self::default(), Self::plus)
    }

    pub(super) fn plus(self, other: Self) -> Self {
        Self { rows: self.rows + other.rows, bytes: self.bytes + other.bytes }
    }
}

/// Refuses a scene of this size before it is made.
pub(super) fn check_room(size: Size, context: &dyn Context) -> Result<()> {
    let Size { rows, bytes } = size;
    let free = context.memory();
    let fits = free.is_none_or(|free| bytes.saturating_mul(WORKING) <= free);
    if fits && u32::try_from(rows).is_ok() {
        return Ok(());
    }
    let gib = |bytes: u64| bytes as f64 / (1u64 << 30) as f64;
    let mut what =
        format!("the scene would have {rows} Gaussians, which take {:.1} GiB to work on", gib(bytes) * WORKING as f64);
    if let Some(free) = free {
        what += &format!("; {:.1} GiB of memory are available", gib(free));
    }
    Err(Error::new(ErrorKind::Memory, what).remedy("Leave the step out, or delete Gaussians before it"))
}

/// Refuses steps that surely outgrow memory before the first of them is taken: copies of everything double a scene
/// until a step removes something. Errors: which step, counted from `before`.
pub(super) fn check_growth(before: usize, steps: &[Step], scene: &Scene<f32>, context: &dyn Context) -> Result<()> {
    let mut size = Size::of_all(&scene.layers);
    for (i, step) in steps.iter().enumerate() {
        match step {
            Step::Duplicate { select, .. } if select.trim() == "all" => {
                size = size.plus(size);
                let at = |e: Error| e.at(format!("edit {} ({})", before + i + 1, step.name()));
                check_room(size, context).map_err(at)?;
            }
            Step::Delete { .. } | Step::Crop { .. } | Step::Cut { .. } | Step::Floaters { .. } => break,
            _ => {}
        }
    }
    Ok(())
}

/// Refuses a clip of this many seconds before anything iterates over it.
pub(super) fn check_clip(clip: [f64; 2], fps: f64) -> Result<()> {
    let fps = if fps > 0.0 && fps.is_finite() { fps } else { DEFAULT_FPS };
    let seconds = clip[1] - clip[0];
    if seconds * fps <= MOST_FRAMES {
        return Ok(());
    }
    Err(Error::input(format!(
        "the clip would last {seconds:.3e} s, {:.3e} frames; {MOST_FRAMES:.0e} are possible",
        seconds * fps
    ))
    .remedy("Give a rate nearer to 1, or a time nearer to the clip"))
}

/// How many changes are around a layer's model, each inside the next.
fn depth(layer: &Layer<f32>) -> usize {
    let spec = layer.motion.spec();
    std::iter::successors(spec.inner(), |inner| inner.inner()).count()
}

/// Errors: numbers of a scene overflowed, in its tables or when it moves; changes that are nested too deeply.
pub(super) fn check_sound(scene: &Scene<f32>) -> Result<()> {
    let overflow =
        |e: Error| Error::input(format!("it makes numbers too large: {}", e.cause())).remedy("Give smaller numbers");
    scene.check_finite().map_err(overflow)?;
    if let Some(layer) = scene.layers.iter().find(|l| depth(l) > MOST_NESTED) {
        let what =
            format!("layer `{}` would have more than {MOST_NESTED} changes over time, one on another", layer.name);
        return Err(Error::input(what).remedy("Put keys of several steps into one"));
    }
    let mut seen = Evaluation::default();
    for i in 0..TIMES {
        let [from, to] = scene.clip;
        let t = from + (to - from) * i as f64 / (TIMES - 1) as f64;
        scene.at(Time(t), &mut seen);
        for (layer, tape) in scene.layers.iter().zip(seen.tapes()) {
            if tape.out().first_non_finite().is_some() {
                let what = format!("it makes numbers too large: layer `{}` at {t} s", layer.name);
                return Err(Error::input(what).remedy("Give smaller numbers"));
            }
        }
    }
    Ok(())
}
