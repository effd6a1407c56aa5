//! Fields of Gaussians as a scene: static ones unchanged, animated ones as segments between their time samples.

use super::lexer::Value;
use super::stage::{Attribute, Prim, Stage};
use super::{COEFFICIENTS, DEGREE, FIELD, OPACITIES, ORIENTATIONS, POSITIONS, SCALES, damaged, unsupported};
use crate::Result;
use crate::format::Warnings;
use crate::format::dialect::{Opened, Y_UP, still};
use crate::format::linear::{Linear, from_linear};
use crate::layers::{ALPHA_MIN, Layer, Scene};
use crate::math::quat;
use crate::math::sh::MAX_DEGREE;
use crate::motion::tracked::{Tracked, TrackedSpec};
use crate::motion::{Spacetime, SpacetimeSpec};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{GEOMETRY, LifeKind, Params, SH};
use std::borrow::Cow;
use std::sync::Arc;

/// Up in stages with z up.
const Z_UP: [f64; 3] = [0.0, 0.0, 1.0];
/// A segment begins this share of a frame before its time sample, so that rounding of times does not choose the one
/// before.
const EARLY: f64 = 1e-6;
/// Most time samples of a field.
const MOST_TIMES: usize = 100_000;
/// Gaussians that samples may become in any case; more only with as many numbers in the file.
const ALWAYS: usize = 1 << 16;

/// The scene of a layer. Errors: no Gaussians, or only in other files; arrays that do not fit each other.
pub(super) fn opened(stage: &Stage) -> Result<Opened> {
    let mut warnings = Warnings::default();
    let (mut layers, mut clip): (Vec<Layer<f32>>, Option<[f64; 2]>) = (Vec::new(), None);
    for (i, prim) in stage.prims.iter().enumerate().filter(|(_, p)| p.shown && p.kind == FIELD) {
        let (frame, moves) = stage.place(i)?;
        if moves {
            warnings.add(format!("a transform of {} is animated: its first time sample is read", prim.name));
        }
        let field = Field::of(prim, stage.codes_per_second).map_err(|e| e.at(format!("prim {}", prim.name)))?;
        if let [first, .., last] = field.times[..] {
            let whole = clip.get_or_insert([first, last]);
            *whole = [whole[0].min(first), whole[1].max(last)];
        }
        for mut layer in field.layers(&mut warnings)? {
            layer.frame = frame;
            layer.apply_transform();
            layers.push(layer);
        }
    }
    if layers.is_empty() {
        let composed = stage.composed || stage.prims.iter().any(|p| p.composed);
        let elsewhere = if composed { "; it refers to other files, which are not read" } else { "" };
        return Err(unsupported(format!("this USD file holds no Gaussians ({FIELD}){elsewhere}")));
    }
    let unit = stage.meters_per_unit;
    if unit.is_finite() && unit != 1.0 {
        warnings.add(format!("the file's unit is {unit} m: coordinates are read as they are"));
    }
    if layers.len() > 1 && clip.is_none() {
        layers.iter_mut().enumerate().for_each(|(i, l)| l.name = format!("gaussians {i}"));
    }
    let fps = if clip.is_some() { stage.codes_per_second } else { DEFAULT_FPS };
    let scene = Scene { layers, clip: clip.unwrap_or_default(), fps, ..still(Params::new(0, 1, &[])) };
    Ok(Opened { up: Some(if stage.z_up { Z_UP } else { Y_UP }), ..Opened::from((scene, warnings)) })
}

/// An attribute's values at times of its own.
struct Track<'a> {
    /// Seconds; empty for a value without time.
    times: Vec<f64>,
    values: Vec<&'a [f32]>,
}

impl<'a> Track<'a> {
    /// The attribute `name`, in single precision if it is there, else in half precision.
    fn of(prim: &'a Prim, name: &str, codes_per_second: f64) -> Option<Self> {
        let found = |name: &str| prim.attributes.get(name).filter(|a| a.value.is_some() || !a.samples.is_empty());
        let attribute: &Attribute = found(name).or_else(|| found(&format!("{name}h")))?;
        let array = |value: &'a Value| match value {
            Value::Array(all) => Some(&all[..]),
            _ => None,
        };
        let samples = attribute.samples.iter().filter_map(|(code, v)| Some((code / codes_per_second, array(v)?)));
        let (times, mut values): (Vec<f64>, Vec<&[f32]>) = samples.unzip();
        if times.is_empty() {
            values = vec![attribute.value.as_ref().and_then(array)?];
        }
        Some(Self { times: if values.len() > 1 { times } else { Vec::new() }, values })
    }

    /// The value at a time: linear between samples of one length, else the one before.
    fn at(&self, t: f64) -> Cow<'a, [f32]> {
        let after = self.times.partition_point(|x| *x <= t);
        let last = self.values.len() - 1;
        let (a, b) = (self.values[after.saturating_sub(1).min(last)], self.values[after.min(last)]);
        if after == 0 || after > last || a.len() != b.len() || self.times[after - 1] == t {
            return Cow::Borrowed(a);
        }
        let share = ((t - self.times[after - 1]) / (self.times[after] - self.times[after - 1])) as f32;
        a.iter().zip(b).map(|(a, b)| a + (b - a) * share).collect()
    }
}

/// A field of Gaussians.
struct Field<'a> {
    positions: Track<'a>,
    orientations: Option<Track<'a>>,
    scales: Option<Track<'a>>,
    opacities: Option<Track<'a>>,
    coefficients: Option<Track<'a>>,
    degree: usize,
    /// All times at which something has a sample, seconds, rising; one where nothing moves.
    times: Vec<f64>,
}

impl<'a> Field<'a> {
    fn of(prim: &'a Prim, codes_per_second: f64) -> Result<Self> {
        let track = |name: &str| Track::of(prim, name, codes_per_second);
        let positions = track(POSITIONS).ok_or_else(|| damaged("it has no positions"))?;
        let degree = prim.attributes.get(DEGREE).and_then(|a| a.value.as_ref()?.number());
        // The schema's fallback is 3.
        let degree = degree.unwrap_or(MAX_DEGREE as f64);
        if !(0.0..=16.0).contains(&degree) {
            return Err(damaged(format!("its spherical harmonics have degree {degree}")));
        }
        let mut field = Self {
            positions,
            orientations: track(ORIENTATIONS),
            scales: track(SCALES),
            opacities: track(OPACITIES),
            coefficients: track(COEFFICIENTS),
            degree: degree as usize,
            times: Vec::new(),
        };
        let tracks = [Some(&field.positions), field.orientations.as_ref(), field.scales.as_ref()];
        let tracks = tracks.into_iter().chain([field.opacities.as_ref(), field.coefficients.as_ref()]);
        let mut times: Vec<f64> = tracks.flatten().flat_map(|t| t.times.iter().copied()).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        if times.iter().any(|t| !t.is_finite()) || times.len() > MOST_TIMES {
            return Err(damaged("its time codes are not finite, or too many"));
        }
        field.times = if times.is_empty() { vec![0.0] } else { times };
        Ok(field)
    }

    /// Numbers that the file has for it.
    fn size(&self) -> usize {
        let tracks = [Some(&self.positions), self.orientations.as_ref(), self.scales.as_ref()];
        let tracks = tracks.into_iter().chain([self.opacities.as_ref(), self.coefficients.as_ref()]);
        tracks.flatten().flat_map(|t| &t.values).map(|v| v.len()).sum()
    }

    /// All Gaussians at a time. Attributes that are missing or too short are what the schema falls back to.
    fn params(&self, t: f64, warnings: &mut Warnings) -> Result<Params> {
        let positions = self.positions.at(t);
        let count = positions.len() / 3;
        let mut at = |track: &Option<Track<'a>>, name: &str, width: usize| {
            let values = track.as_ref().map(|track| track.at(t));
            let long = values.as_ref().is_some_and(|v| v.len() >= width * count);
            if !long && count > 0 {
                let mut one = Warnings::default();
                one.add(format!("{name} are missing or fewer than {POSITIONS}: the schema's fallback is used"));
                warnings.append(one);
            }
            values.filter(|_| long)
        };
        let quats = at(&self.orientations, ORIENTATIONS, 4);
        let scales = at(&self.scales, SCALES, 3);
        let alphas = at(&self.opacities, OPACITIES, 1);
        let stride = 3 * (self.degree + 1) * (self.degree + 1);
        let sh = at(&self.coefficients, COEFFICIENTS, stride);
        let degree = if sh.is_some() { self.degree.min(MAX_DEGREE) } else { 0 };
        let mut params = Params::new(count, (degree + 1) * (degree + 1), &[]);
        let [geometry, colors] = params.get_mut([GEOMETRY, SH]);
        for row in 0..count {
            geometry.write(row, 0, [positions[3 * row], positions[3 * row + 1], positions[3 * row + 2]]);
            let q = quats.as_ref().map_or([1.0, 0.0, 0.0, 0.0], |q| std::array::from_fn(|k| q[4 * row + k]));
            geometry.write(row, QUAT, q);
            let s = scales.as_ref().map_or([1.0; 3], |s| std::array::from_fn(|k| s[3 * row + k]));
            geometry.write(row, LOG_SCALE, s);
            geometry.set(row, OPACITY, alphas.as_ref().map_or(1.0, |a| a[row]));
            if let Some(sh) = &sh {
                (0..colors.width()).for_each(|k| colors.set(row, k, sh[stride * row + k]));
            }
        }
        let mut layer = still(params).layers.remove(0);
        warnings.append(from_linear(&mut layer, Linear::Scales));
        warnings.append(from_linear(&mut layer, Linear::Opacities));
        Ok(layer.params)
    }

    fn layers(&self, warnings: &mut Warnings) -> Result<Vec<Layer<f32>>> {
        if self.degree > MAX_DEGREE && self.coefficients.is_some() {
            warnings.add(format!("spherical harmonics above degree {MAX_DEGREE} are left out"));
        }
        let first = self.params(self.times[0], warnings)?;
        if self.times.len() == 1 {
            return Ok(still(first).layers);
        }
        let most = ALWAYS.max(self.size());
        if first.len().saturating_mul(self.times.len()) > most {
            return Err(damaged(format!("it has {} time samples of {} Gaussians", self.times.len(), first.len())));
        }
        let moves = |track: &Option<Track<'_>>| track.as_ref().is_some_and(|t| !t.times.is_empty());
        let one_length = self.positions.values.iter().all(|v| v.len() == self.positions.values[0].len());
        if one_length && ![&self.scales, &self.opacities, &self.coefficients].into_iter().any(moves) {
            return self.tracked(first, warnings).map(|layer| vec![layer]);
        }
        let mut layers = Vec::with_capacity(self.times.len());
        let (mut now, mut rows) = (first, 0);
        for i in 0..self.times.len() {
            let next = self.times.get(i + 1).map(|t| self.params(*t, warnings)).transpose()?;
            let layer = self.segment(i, &now, next.as_ref())?;
            rows += layer.params.len();
            if rows > most {
                return Err(damaged(format!("its {} time samples are more Gaussians than it has numbers", i + 1)));
            }
            layers.push(layer);
            now = next.unwrap_or_default();
        }
        Ok(layers)
    }

    /// Positions and rotations that move, all else unchanged.
    fn tracked(&self, first: Params, warnings: &mut Warnings) -> Result<Layer<f32>> {
        let mut params = first;
        let spec = TrackedSpec { times: self.times.clone(), foreground: false };
        let motion = Tracked::new(&spec, &mut params)?;
        for (k, t) in self.times.iter().enumerate().skip(1) {
            let now = self.params(*t, warnings)?;
            let page = &mut params[motion.page(k)];
            (0..now.len()).for_each(|row| page.write(row, 0, now[GEOMETRY].read::<7>(row, 0)));
        }
        Ok(Layer::new("gaussians", params, Arc::new(motion), LifeKind::Infinite))
    }

    /// The Gaussians that are visible at a time, on their way to where they are at the next one.
    fn segment(&self, i: usize, now: &Params, next: Option<&Params>) -> Result<Layer<f32>> {
        let least = ((ALPHA_MIN / (1.0 - ALPHA_MIN)).ln()) as f32;
        let rows: Vec<usize> = (0..now.len()).filter(|r| now[GEOMETRY].get(*r, OPACITY) >= least).collect();
        let kind = LifeKind::Infinite;
        let mut params = Params::new(rows.len(), now[SH].width() / 3, kind.columns());
        let origin = self.times[i];
        let spec = SpacetimeSpec { order: 1, rotation: true, detach: false, origin, features: None };
        let motion = Spacetime::new(spec, &mut params)?;
        let next = next.filter(|next| next.len() == now.len());
        let seconds = self.times.get(i + 1).map_or(1.0, |t| t - origin);
        let [geometry, sh, path, rates] = params.get_mut([GEOMETRY, SH, motion.velocities(), motion.rates()]);
        for (to, &from) in rows.iter().enumerate() {
            let own = now[GEOMETRY].read::<11>(from, 0);
            let unit = |p: &Params| quat::normalize(p[GEOMETRY].read::<4>(from, QUAT).map(f64::from)).0;
            let q = unit(now);
            geometry.write(to, 0, own);
            geometry.write(to, QUAT, q.map(|x| x as f32));
            (0..sh.width()).for_each(|k| sh.set(to, k, now[SH].get(from, k)));
            let Some(next) = next else { continue };
            let there = next[GEOMETRY].read::<3>(from, 0);
            path.write(
                to,
                0,
                std::array::from_fn::<f32, 3, _>(|k| ((f64::from(there[k]) - f64::from(own[k])) / seconds) as f32),
            );
            let p = unit(next);
            let sign = if q.iter().zip(p).map(|(a, b)| a * b).sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
            rates.write(to, 0, std::array::from_fn::<f32, 4, _>(|k| ((sign * p[k] - q[k]) / seconds) as f32));
        }
        let mut layer = Layer::new(format!("segment {i}"), params, Arc::new(motion), kind);
        // A frame's time is computed in several ways; all of them are within the segment that begins there.
        let start = |i: usize| self.times[i] - EARLY * (self.times[i] - self.times[i - 1]);
        let from = if i == 0 { f64::NEG_INFINITY } else { start(i) };
        layer.span = [from, if i + 1 < self.times.len() { start(i + 1) } else { f64::INFINITY }];
        Ok(layer)
    }
}
