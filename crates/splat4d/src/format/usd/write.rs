//! Writing: one field of Gaussians below one transform, with time samples for what changes.

use super::{COEFFICIENTS, DEGREE, FIELD, OPACITIES, ORIENTATIONS, POSITIONS, SCALES};
use crate::format::Warnings;
use crate::format::bytes::scale_of_log;
use crate::format::dialect::WriteOptions;
use crate::layers::{Constant, HIDDEN, Scene};
use crate::math::quat;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, Result};
use std::io::Write;

/// Most frames of a clip that is written.
const MAX_FRAMES: f64 = 1e5;
/// Share of a frame by which a clip may miss its last one.
const LAST: f64 = 1e-6;
/// Extent of a Gaussian in standard deviations.
const REACH: f32 = 3.0;
/// Cosine from which a direction counts as an axis.
const ALONG: f64 = 1.0 - 1e-6;
/// Bytes that are formatted before they are written.
const BUFFER: usize = 1 << 20;

/// Writes a scene, whose clip becomes time samples where it moves.
///
/// Errors: a clip of too many frames; no Gaussians; the scene has a head; the sink's.
pub(super) fn write(scene: &Scene<f32>, options: &WriteOptions, out: &mut dyn Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let fps = if scene.fps > 0.0 { scene.fps } else { DEFAULT_FPS };
    let mut frames = Constant::new(scene, times(scene, fps)?)?;
    if frames.is_empty() {
        return Err(Error::input("no Gaussian is visible at any frame")
            .remedy("Choose another time, or train the scene again."));
    }
    warnings.counted(scene.len() - frames.len(), scene.len(), "are never visible at a frame and were left out");
    let axis = if aligned(options.up, [0.0, 0.0, 1.0]) { "Z" } else { "Y" };
    if axis == "Y" && !aligned(options.up, [0.0, 1.0, 0.0]) {
        warnings.add("USD has y up and z up only: the file states y up, but the scene's up direction is another one");
    }
    let survey = Survey::of(&mut frames);
    let codes: Vec<f64> = frames.times().iter().map(|t| code(t * fps)).collect();
    let mut text = Text { out, buffer: Vec::with_capacity(BUFFER + 64) };
    let (start, end) = (codes[0], codes[codes.len() - 1]);
    text.put("#usda 1.0\n(\n    defaultPrim = \"Scene\"\n")?;
    text.put(&format!("    doc = \"splat4d {}\"\n", env!("CARGO_PKG_VERSION")))?;
    if codes.len() > 1 {
        text.put(&format!("    startTimeCode = {start}\n    endTimeCode = {end}\n"))?;
        text.put(&format!("    timeCodesPerSecond = {fps}\n    framesPerSecond = {fps}\n"))?;
    }
    text.put(&format!("    metersPerUnit = 1\n    upAxis = \"{axis}\"\n)\n\n"))?;
    text.put(&format!(
        "def Xform \"Scene\" (\n    kind = \"component\"\n)\n{{\n    def {FIELD} \"Gaussians\"\n    {{\n"
    ))?;
    let [low, high] = survey.extent;
    text.put("        float3[] extent = [")?;
    text.tuple(&low)?;
    text.put(", ")?;
    text.tuple(&high)?;
    text.put("]\n")?;
    let coefficients = frames.frame(0)[SH].width() / 3;
    text.put(&format!("        uniform int {DEGREE} = {}\n", coefficients.isqrt() - 1))?;
    text.put("        uniform token projectionModeHint = \"perspective\"\n")?;
    text.put("        uniform token sortingModeHint = \"zDepth\"\n")?;
    for (array, varies) in ARRAYS.iter().zip(survey.varies) {
        text.array(array, &codes[..if varies { codes.len() } else { 1 }], &mut frames)?;
    }
    text.put("    }\n}\n")?;
    text.flush()?;
    Ok(warnings)
}

/// Seconds of the frames; one where nothing moves.
fn times(scene: &Scene<f32>, fps: f64) -> Result<Vec<f64>> {
    let [from, to] = scene.clip;
    let count = if scene.is_moving() { ((to - from) * fps + LAST).floor() + 1.0 } else { 1.0 };
    if !(1.0..=MAX_FRAMES).contains(&count) {
        return Err(Error::input(format!("the clip from {from} to {to} s has {count} frames at {fps} per second"))
            .remedy("Write one time (--time T), or a part of the clip."));
    }
    Ok((0..count as usize).map(|i| from + i as f64 / fps).collect())
}

/// A time code; those of frames are whole.
fn code(x: f64) -> f64 {
    if (x - x.round()).abs() < LAST { x.round() } else { x }
}

fn aligned(up: [f64; 3], axis: [f64; 3]) -> bool {
    up.iter().zip(axis).map(|(a, b)| a * b).sum::<f64>() >= ALONG
}

/// An array of a field: type and name, and how a row is written.
struct Array {
    kind: &'static str,
    name: &'static str,
    write: fn(&Params, usize, &mut Text<'_>) -> Result<()>,
}

const ARRAYS: [Array; 5] = [
    Array { kind: "point3f", name: POSITIONS, write: |p, row, text| text.tuple(&p[GEOMETRY].read::<3>(row, 0)) },
    Array { kind: "quatf", name: ORIENTATIONS, write: |p, row, text| text.tuple(&orientation(p, row)) },
    Array { kind: "float3", name: SCALES, write: |p, row, text| text.tuple(&scales(p, row)) },
    Array { kind: "float", name: OPACITIES, write: |p, row, text| text.number(opacity(p, row)) },
    Array {
        kind: "float3",
        name: COEFFICIENTS,
        write: |p, row, text| {
            let sh = &p[SH];
            (0..sh.width() / 3).try_for_each(|k| {
                text.put(if k > 0 { ", " } else { "" })?;
                text.tuple(&sh.read::<3>(row, 3 * k))
            })
        },
    },
];

/// w x y z, unit.
fn orientation(p: &Params, row: usize) -> [f32; 4] {
    quat::normalize(p[GEOMETRY].read::<4>(row, QUAT).map(f64::from)).0.map(|x| x as f32)
}

fn scales(p: &Params, row: usize) -> [f32; 3] {
    p[GEOMETRY].read::<3>(row, LOG_SCALE).map(scale_of_log)
}

fn opacity(p: &Params, row: usize) -> f32 {
    let logit = p[GEOMETRY].get(row, OPACITY);
    if logit <= HIDDEN { 0.0 } else { 1.0 / (1.0 + (-logit).exp()) }
}

/// Attributes that change over the clip, and its box.
struct Survey {
    varies: [bool; ARRAYS.len()],
    extent: [[f32; 3]; 2],
}

impl Survey {
    fn of(frames: &mut Constant<'_>) -> Self {
        let first = frames.frame(0).clone();
        let mut survey = Self { varies: [false; 5], extent: [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]] };
        for i in 0..frames.times().len() {
            let now = frames.frame(i);
            let differ = |first_column: usize, end: usize| {
                let columns = (first_column..end).all(|c| {
                    let same = |row: usize| now[GEOMETRY].get(row, c) == first[GEOMETRY].get(row, c);
                    (0..now.len()).all(same)
                });
                !columns
            };
            let sh = now[SH] != first[SH];
            let changed =
                [differ(0, 3), differ(QUAT, QUAT + 4), differ(LOG_SCALE, OPACITY), differ(OPACITY, OPACITY + 1), sh];
            survey.varies = std::array::from_fn(|k| survey.varies[k] || changed[k]);
            for row in 0..now.len() {
                let reach = REACH * scales(now, row).into_iter().fold(0.0, f32::max);
                let mean = now[GEOMETRY].read::<3>(row, 0);
                let [low, high] = &mut survey.extent;
                (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(mean[k] - reach), high[k].max(mean[k] + reach)));
            }
        }
        survey
    }
}

/// Text on its way to the sink.
struct Text<'a> {
    out: &'a mut dyn Write,
    buffer: Vec<u8>,
}

impl Text<'_> {
    fn array(&mut self, array: &Array, codes: &[f64], frames: &mut Constant<'_>) -> Result<()> {
        let head = format!("        {}[] {}", array.kind, array.name);
        if codes.len() == 1 {
            self.put(&format!("{head} = ["))?;
            self.rows(array, frames.frame(0))?;
            self.put("]")?;
        } else {
            self.put(&format!("{head}.timeSamples = {{\n"))?;
            for (i, code) in codes.iter().enumerate() {
                self.put(&format!("            {code}: ["))?;
                self.rows(array, frames.frame(i))?;
                self.put("],\n")?;
            }
            self.put("        }")?;
        }
        // As NVIDIA's converter states it, so that programs need not derive it from the degree.
        let each = frames.frame(0)[SH].width() / 3;
        let note = format!(" (\n            elementSize = {each}\n            interpolation = \"vertex\"\n        )\n");
        self.put(if array.name == COEFFICIENTS { &note } else { "\n" })
    }

    fn rows(&mut self, array: &Array, params: &Params) -> Result<()> {
        for row in 0..params.len() {
            self.put(if row > 0 { ", " } else { "" })?;
            (array.write)(params, row, self)?;
        }
        Ok(())
    }

    fn tuple(&mut self, values: &[f32]) -> Result<()> {
        for (k, x) in values.iter().enumerate() {
            self.put(if k > 0 { ", " } else { "(" })?;
            self.number(*x)?;
        }
        self.put(")")
    }

    /// The shortest text that is read as the same number.
    fn number(&mut self, x: f32) -> Result<()> {
        let begin = self.buffer.len();
        write!(self.buffer, "{x:?}").expect("memory takes all bytes");
        if self.buffer[begin..].ends_with(b".0") {
            self.buffer.truncate(self.buffer.len() - 2);
        }
        Ok(())
    }

    fn put(&mut self, text: &str) -> Result<()> {
        self.buffer.extend(text.as_bytes());
        if self.buffer.len() < BUFFER { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<()> {
        self.out.write_all(&self.buffer).map_err(|e| Error::io("the Gaussians could not be written", e))?;
        self.buffer.clear();
        Ok(())
    }
}
