//! Arrays become Gaussians and scenes: static ones, paths with a pose per time, polynomials in time with lifespans, and
//! frames without common Gaussians.

use crate::arrays::{finite, numbers};
use crate::errors::{OrRaise, bad_input};
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use splat4d::layers::{Layer, Scene};
use splat4d::math::logit;
use splat4d::math::sh::{MAX_COEFFS, rgb_to_dc};
use splat4d::motion::spacetime::{ROTATION_RATES, VELOCITIES};
use splat4d::motion::tracked::{POSE, Tracked, TrackedSpec};
use splat4d::motion::{Motion, Spacetime, SpacetimeSpec, Still};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use std::sync::Arc;

/// Opacities are kept this far from 0 and 1, where logits are infinite.
const OPACITY_MARGIN: f64 = 1e-6;
/// The squared length below which a quaternion has no direction in f32.
const NO_DIRECTION: f64 = 1e-20;
/// Highest order of the polynomials that positions may follow.
const MAX_ORDER: usize = 3;

/// Numbers of one Gaussian each, unconverted: `rows` times `width`, and the axis of times before them, if there is one.
pub(crate) struct Given {
    what: &'static str,
    times: Option<usize>,
    pub(crate) rows: usize,
    pub(crate) width: usize,
    pub(crate) data: Vec<f32>,
}

impl Given {
    /// An array [N, ...shape] or, where `timed`, [T, N, ...shape]; `None` in a shape represents any number.
    pub(crate) fn new(
        value: &Bound<'_, PyAny>,
        what: &'static str,
        shape: &[Option<usize>],
        timed: bool,
    ) -> PyResult<Self> {
        let array = numbers::<f32>(value, what)?;
        let all = array.shape();
        let fits = |skip: usize| {
            all.len() == skip + shape.len() && all[skip..].iter().zip(shape).all(|(n, s)| s.is_none_or(|s| *n == s))
        };
        let leading = match (fits(1), timed && fits(2)) {
            (true, _) => 1,
            (_, true) => 2,
            _ => {
                let axes: String = shape.iter().map(|s| s.map_or(", K".into(), |s| format!(", {s}"))).collect();
                let over_time = if timed { format!(" or [T, N{axes}]") } else { String::new() };
                let remedy = format!("Give an array [N{axes}]{over_time}");
                return Err(bad_input(format!("{what} has the shape {all:?}"), &remedy));
            }
        };
        let width: usize = all[leading..].iter().product();
        let (times, rows) = if leading == 2 { (Some(all[0]), all[1]) } else { (None, all[0]) };
        let data: Vec<f32> = array.as_array().iter().copied().collect();
        if let Some(bad) = data.iter().position(|x| !x.is_finite()) {
            let row = bad / width.max(1) % rows.max(1);
            return Err(bad_input(format!("row {row} of {what} holds NaN or infinity"), "Leave such Gaussians out"));
        }
        Ok(Self { what, times, rows, width, data })
    }

    fn row(&self, time: usize, row: usize) -> &[f32] {
        let time = if self.times.is_some() { time } else { 0 };
        let first = (time * self.rows + row) * self.width;
        &self.data[first..first + self.width]
    }

    fn read<const N: usize>(&self, time: usize, row: usize) -> [f32; N] {
        self.row(time, row).try_into().expect("the shape was checked")
    }

    /// Errors: another number of Gaussians than `rows`.
    pub(crate) fn expect_rows(&self, rows: usize) -> PyResult<()> {
        if self.rows == rows {
            return Ok(());
        }
        let what = format!("{} has {} rows, but there are {rows} means", self.what, self.rows);
        Err(bad_input(what, "Give one row for each Gaussian"))
    }
}

/// Activated arrays of all Gaussians, as for gsplat's `rasterization`.
pub(crate) struct Shapes {
    pub(crate) means: Given,
    pub(crate) quats: Given,
    pub(crate) scales: Given,
    pub(crate) opacities: Given,
    pub(crate) sh: Given,
}

impl Shapes {
    /// Reads the arrays; `timed`: means and quats may have an axis of times before that of Gaussians.
    ///
    /// Errors: shapes, numbers that are not finite, quaternions of length 0, scales that are not positive, opacities
    /// outside [0, 1], both or neither of `sh` and `colors`.
    pub(crate) fn new(
        means: &Bound<'_, PyAny>,
        quats: &Bound<'_, PyAny>,
        scales: &Bound<'_, PyAny>,
        opacities: &Bound<'_, PyAny>,
        sh: Option<&Bound<'_, PyAny>>,
        colors: Option<&Bound<'_, PyAny>>,
        timed: bool,
    ) -> PyResult<Self> {
        let means = Given::new(means, "means", &[Some(3)], timed)?;
        let quats = Given::new(quats, "quats", &[Some(4)], timed)?;
        let scales = Given::new(scales, "scales", &[Some(3)], false)?;
        let opacities = Given::new(opacities, "opacities", &[], false)?;
        let sh = match (sh, colors) {
            (Some(sh), None) => {
                let sh = Given::new(sh, "sh", &[None, Some(3)], false)?;
                let coefficients = sh.width / 3;
                if !(1..=MAX_COEFFS).any(|k| k == coefficients && [1, 4, 9, 16].contains(&k)) {
                    return Err(bad_input(
                        format!("sh has {coefficients} coefficients per Gaussian"),
                        "Give 1, 4, 9 or 16 (degrees 0 to 3)",
                    ));
                }
                sh
            }
            (None, Some(colors)) => {
                let mut base = Given::new(colors, "colors", &[Some(3)], false)?;
                base.data.iter_mut().for_each(|c| *c = rgb_to_dc(*c));
                base
            }
            _ => return Err(bad_input("colours need exactly one of `sh` and `colors`", "Give one of both")),
        };
        let rows = means.rows;
        [&quats, &scales, &opacities, &sh].iter().try_for_each(|given| given.expect_rows(rows))?;
        let refuse = |what: String, remedy: &str| Err(bad_input(what, remedy));
        let squared = |q: &[f32]| q.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
        if let Some(bad) = quats.data.chunks_exact(4).position(|q| squared(q) < NO_DIRECTION) {
            return refuse(format!("row {} of quats has the length 0", bad % rows), "No rotation is [1, 0, 0, 0]");
        }
        if let Some(bad) = scales.data.iter().position(|s| *s <= 0.0) {
            let remedy = "Give standard deviations in scene units, above 0 (not their logarithms)";
            return refuse(format!("row {} of scales is not positive", bad / 3), remedy);
        }
        if let Some(bad) = opacities.data.iter().position(|o| !(0.0..=1.0).contains(o)) {
            let remedy = "Give opacities from 0 to 1 (not their logits)";
            return refuse(format!("opacity {bad} is {}", opacities.data[bad]), remedy);
        }
        Ok(Self { means, quats, scales, opacities, sh })
    }

    /// The arrays at their first time as parameters.
    pub(crate) fn params(&self, life: LifeKind) -> Params<f32> {
        let rows = self.means.rows;
        let mut params = Params::new(rows, self.sh.width / 3, life.columns());
        let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
        for row in 0..rows {
            geometry.write(row, 0, self.means.read::<3>(0, row));
            geometry.write(row, QUAT, self.quats.read::<4>(0, row));
            geometry.write(row, LOG_SCALE, self.scales.read::<3>(0, row).map(f32::ln));
            let opacity = f64::from(self.opacities.row(0, row)[0]);
            geometry.set(row, OPACITY, logit(opacity, OPACITY_MARGIN) as f32);
            self.sh.row(0, row).iter().enumerate().for_each(|(k, x)| sh.set(row, k, *x));
        }
        params
    }
}

/// Motion and lifespans of Gaussians.
pub(crate) struct Moving<'a, 'py> {
    /// [T] seconds of the poses.
    pub(crate) times: Option<&'a Bound<'py, PyAny>>,
    /// [N, 3] or [N, P, 3], scene units / s^p.
    pub(crate) velocities: Option<&'a Bound<'py, PyAny>>,
    /// [N, 4], 1/s.
    pub(crate) rotation_rates: Option<&'a Bound<'py, PyAny>>,
    /// [N] seconds.
    pub(crate) centers: Option<&'a Bound<'py, PyAny>>,
    /// [N] seconds.
    pub(crate) durations: Option<&'a Bound<'py, PyAny>>,
    pub(crate) fps: f64,
}

/// A layer of Gaussians, and the clip in which they are seen.
pub(crate) fn layer(shapes: &Shapes, moving: &Moving<'_, '_>) -> PyResult<(Layer<f32>, [f64; 2])> {
    let steps = match (shapes.means.times, shapes.quats.times) {
        (Some(a), Some(b)) if a != b => {
            return Err(bad_input(format!("means have {a} times, quats {b}"), "Give both for the same times"));
        }
        (a, b) => a.or(b),
    };
    let polynomial = moving.velocities.is_some() || moving.rotation_rates.is_some();
    if steps.is_some() && (polynomial || moving.durations.is_some()) {
        return Err(bad_input(
            "poses at several times cannot be combined with velocities, rotation rates or durations",
            "Give either arrays [T, N, ...], or velocities around `centers`",
        ));
    }
    if moving.centers.is_some() != moving.durations.is_some() {
        return Err(bad_input("one of `centers` and `durations` is missing", "Give both, or neither"));
    }
    match steps {
        Some(steps) => tracked(shapes, moving, steps),
        None if moving.times.is_some() => Err(bad_input(
            "`times` belong to means or quats [T, N, ...], and these have no axis of times",
            "Leave `times` out, or give a pose for each time",
        )),
        None => spacetime(shapes, moving, polynomial),
    }
}

/// A pose at each of several times.
fn tracked(shapes: &Shapes, moving: &Moving<'_, '_>, steps: usize) -> PyResult<(Layer<f32>, [f64; 2])> {
    let times: Vec<f64> = match moving.times {
        Some(times) => numbers::<f64>(times, "times")?.as_array().iter().copied().collect(),
        None => (0..steps).map(|k| k as f64 / moving.fps).collect(),
    };
    let increase = times.windows(2).all(|w| w[0] < w[1]) && times.iter().all(|t| t.is_finite());
    if times.len() != steps || !increase || steps == 0 {
        return Err(bad_input(
            format!("{} times were given for {steps} poses", times.len()),
            "Give one increasing time in seconds for each pose, at least one",
        ));
    }
    let clip = [times[0], times[steps - 1]];
    let mut params = shapes.params(LifeKind::Infinite);
    let model = Tracked::new(&TrackedSpec { times, foreground: false }, &mut params).or_raise()?;
    for step in 1..steps {
        let page = &mut params[model.page(step)];
        for row in 0..shapes.means.rows {
            let ([x, y, z], [qw, qx, qy, qz]) = (shapes.means.read::<3>(step, row), shapes.quats.read::<4>(step, row));
            page.write::<POSE>(row, 0, [x, y, z, qw, qx, qy, qz]);
        }
    }
    Ok((Layer::new("arrays", params, Arc::new(model), LifeKind::Infinite), clip))
}

/// Polynomials around the centres of lifespans, or around second 0 where there are none.
fn spacetime(shapes: &Shapes, moving: &Moving<'_, '_>, polynomial: bool) -> PyResult<(Layer<f32>, [f64; 2])> {
    let rows = shapes.means.rows;
    let given = |value: Option<&Bound<'_, PyAny>>, what, shape: &[Option<usize>]| {
        let given = value.map(|v| Given::new(v, what, shape, false)).transpose()?;
        given.iter().try_for_each(|g| g.expect_rows(rows))?;
        Ok::<_, PyErr>(given)
    };
    let flat = |value: &Bound<'_, PyAny>| Ok::<_, PyErr>(numbers::<f32>(value, "velocities")?.shape().len() == 2);
    let velocities = match moving.velocities {
        Some(v) if flat(v)? => given(Some(v), "velocities", &[Some(3)])?,
        v => given(v, "velocities", &[None, Some(3)])?,
    };
    let rates = given(moving.rotation_rates, "rotation_rates", &[Some(4)])?;
    let (centers, durations) = (given(moving.centers, "centers", &[])?, given(moving.durations, "durations", &[])?);
    let order = velocities.as_ref().map_or(0, |v| v.width / 3);
    if order > MAX_ORDER {
        return Err(bad_input(
            format!("velocities have {order} orders per Gaussian"),
            "Give at most 3: velocity, and the coefficients of the second and third power of time",
        ));
    }
    let kind = if durations.is_some() { LifeKind::GaussHalf } else { LifeKind::Infinite };
    let mut params = shapes.params(kind);
    let mut clip = if polynomial { [0.0, 1.0] } else { [0.0; 2] };
    if let (Some(centers), Some(durations)) = (&centers, &durations) {
        if let Some(bad) = durations.data.iter().position(|d| *d <= 0.0) {
            return Err(bad_input(format!("duration {bad} is not positive"), "Give standard deviations in seconds"));
        }
        let life = &mut params[LIFE];
        (0..rows).for_each(|row| life.write(row, 0, [centers.data[row], durations.data[row].ln()]));
        let of = |side: f32| move |(c, d): (&f32, &f32)| f64::from(c + side * d);
        let ends = |side| centers.data.iter().zip(&durations.data).map(of(side));
        if rows > 0 {
            clip = [ends(-1.0).fold(f64::INFINITY, f64::min), ends(1.0).fold(f64::NEG_INFINITY, f64::max)];
        }
    }
    let motion: Arc<dyn Motion> = if polynomial {
        let spec = SpacetimeSpec { order, rotation: rates.is_some(), ..SpacetimeSpec::default() };
        let model = Spacetime::new(spec, &mut params).or_raise()?;
        for (name, given) in [(VELOCITIES, &velocities), (ROTATION_RATES, &rates)] {
            if let Some(given) = given {
                let key = params.find(name).expect("the model has made its tables");
                (0..rows).for_each(|row| {
                    given.row(0, row).iter().enumerate().for_each(|(k, x)| params[key].set(row, k, *x));
                });
            }
        }
        Arc::new(model)
    } else {
        Arc::new(Still)
    };
    Ok((Layer::new("arrays", params, motion, kind), clip))
}

/// Metadata of a scene.
pub(crate) struct About<'a, 'py> {
    pub(crate) clip: Option<[f64; 2]>,
    pub(crate) fps: f64,
    pub(crate) up: Option<&'a Bound<'py, PyAny>>,
    pub(crate) background: Option<&'a Bound<'py, PyAny>>,
}

/// The up direction unless stated: that of the y axis, as in graphics programs.
const UP: [f64; 3] = [0.0, 1.0, 0.0];

impl About<'_, '_> {
    /// Frames per second. Errors: not a positive number.
    pub(crate) fn checked_fps(&self) -> PyResult<f64> {
        let fps = self.fps;
        if fps > 0.0 && fps.is_finite() {
            Ok(fps)
        } else {
            Err(bad_input(format!("fps is {fps}"), "Give a positive number"))
        }
    }

    /// The scene of these layers.
    pub(crate) fn scene(&self, layers: Vec<Layer<f32>>, clip: [f64; 2]) -> PyResult<Scene<f32>> {
        let clip = self.clip.unwrap_or(clip);
        if !(clip[0] <= clip[1] && clip.iter().all(|t| t.is_finite())) {
            return Err(bad_input(format!("invalid clip {clip:?}"), "Give its first and last second"));
        }
        let up = match self.up {
            Some(up) => finite::<3>(up, "up")?,
            None => UP,
        };
        let length = up.iter().map(|x| x * x).sum::<f64>().sqrt();
        if length == 0.0 {
            return Err(bad_input("up has the length 0", "Give a direction, for instance [0, 1, 0]"));
        }
        let background = self.background.map(|b| finite::<3>(b, "background")).transpose()?;
        Ok(Scene {
            layers,
            clip,
            fps: self.checked_fps()?,
            up: up.map(|x| x / length),
            background: background.unwrap_or_default().map(|x| x as f32),
            ..Scene::default()
        })
    }
}
