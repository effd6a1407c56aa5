//! Motion models written in Python (`splat4d.Motion`): the library requests the Gaussians at a time, and passes their
//! gradient to the model. The library manages the model's tables: density control copies and removes rows, Adam updates
//! them, checkpoints and scenes store them.

use crate::arrays::{numbers, rows, shaped};
use crate::errors::{OrRaise, bad_input};
use crate::loss::Raised;
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::Result;
use splat4d::math::logit;
use splat4d::motion::still::{activate, activate_backward};
use splat4d::motion::{At, Cache, Motion, Phase, Spec, Still, Tape};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Color, GEOMETRY, Grads, Key, Params, SH, Space, SplatGrads, Table};
use splat4d_train::methods::{OwnMotion, Rate};
use std::sync::Arc;

/// Names of tables that every layer has.
const TAKEN: [&str; 13] = [
    "geometry",
    "means",
    "quats",
    "log_scales",
    "opacity_logits",
    "sh",
    "life",
    "life_centers",
    "life_log_widths",
    "life_log_softness",
    "time",
    "features",
    "labels",
];
/// Bytes that a query leaves for its backward, a Gaussian: raw and activated rows here and in Python.
const SCRATCH: u64 = 256;
/// Opacities are kept this far from 0 and 1, where logits are infinite.
const OPACITY_MARGIN: f32 = 1e-6;

/// The Python object, and what it states about itself.
pub(crate) struct Hook {
    object: Py<PyAny>,
    name: String,
    /// Tables with a row per Gaussian: name and width.
    per_gaussian: Vec<(&'static str, usize)>,
    /// Arrays that all Gaussians share: name, shape, first values.
    shared: Vec<(String, Vec<usize>, Vec<f32>)>,
    colors: bool,
    pub(crate) raised: Arc<Raised>,
}

impl Hook {
    /// Makes the model of a `splat4d.Motion` known by its name. Errors: its declaration is invalid.
    pub(crate) fn register(motion: &Bound<'_, PyAny>) -> PyResult<Arc<Self>> {
        let get = |name: &str| {
            motion.getattr(name).map_err(|_| bad_input(format!("the motion has no `{name}`"), "Give a splat4d.Motion"))
        };
        let dict = |name: &'static str| {
            get(name)?
                .cast_into::<PyDict>()
                .map_err(|_| bad_input(format!("`{name}` of the motion is not a dict"), "Give a dict"))
        };
        let (name, warmup, colors) = (get("name")?.extract()?, get("warmup")?.extract()?, get("colors")?.extract()?);
        let mut hook = Self {
            object: motion.clone().unbind(),
            name,
            per_gaussian: Vec::new(),
            shared: Vec::new(),
            colors,
            raised: Arc::default(),
        };
        for (table, width) in dict("per_gaussian")?.iter() {
            let (table, width): (String, usize) = (table.extract()?, width.extract()?);
            if width == 0 {
                return Err(bad_input(
                    format!("`{table}` has 0 numbers per Gaussian"),
                    "Give 1 or more, or leave it out",
                ));
            }
            hook.check(&table)?;
            hook.per_gaussian.push((String::leak(table), width));
        }
        for (array, value) in dict("shared")?.iter() {
            let array: String = array.extract()?;
            hook.check(&array)?;
            let value = numbers::<f32>(&value, "a shared array")?;
            let data: Vec<f32> = value.as_array().iter().copied().collect();
            if data.is_empty() || data.iter().any(|x| !x.is_finite()) {
                let remedy = "Give an array of finite numbers";
                return Err(bad_input(format!("the shared array `{array}` is empty or not finite"), remedy));
            }
            hook.shared.push((array, value.shape().to_vec(), data));
        }
        let mut rates = Vec::new();
        for (column, rate) in dict("rates")?.iter() {
            let column: String = column.extract()?;
            let known =
                hook.per_gaussian.iter().any(|(n, _)| *n == column) || hook.shared.iter().any(|s| s.0 == column);
            if !known {
                let remedy = "Name arrays of `per_gaussian` and `shared`; the others learn at the recipe's rates";
                return Err(bad_input(format!("there is a rate for `{column}`, and no such array"), remedy));
            }
            let [start, end] = match rate.extract::<f64>() {
                Ok(rate) => [rate; 2],
                Err(_) => rate.extract::<[f64; 2]>()?,
            };
            rates.push((column, Rate { start, end }));
        }
        let hook = Arc::new(hook);
        let made = hook.clone();
        let make = Arc::new(move |p: &mut Params<f32>| PyMotion::make(&made, p));
        OwnMotion { name: hook.name.clone(), make, rates, warmup }.register().or_raise()?;
        Ok(hook)
    }

    /// Its name in recipes.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Errors: the name of an array is taken.
    fn check(&self, name: &str) -> PyResult<()> {
        let own = self.per_gaussian.iter().map(|(n, _)| *n).chain(self.shared.iter().map(|s| s.0.as_str()));
        if TAKEN.contains(&name) || own.into_iter().any(|n| n == name) || name.contains('@') || name.is_empty() {
            return Err(bad_input(format!("no array of a motion can be called `{name}`"), "Choose another name"));
        }
        Ok(())
    }
}

/// The model.
struct PyMotion {
    hook: Arc<Hook>,
    per_gaussian: Vec<Key>,
    shared: Vec<Key>,
    /// There are only the canonical Gaussians, and Python is not called.
    rests: bool,
}

/// State of a result for its backward.
#[derive(Default)]
struct ResultState {
    tape: Option<Py<PyAny>>,
    /// Mean, quaternion, log scales and opacity logit of every splat, as Python gave them.
    raw: Vec<[f32; 11]>,
    colors: Table<f32>,
}

impl PyMotion {
    fn make(hook: &Arc<Hook>, p: &mut Params<f32>) -> Result<Arc<dyn Motion>> {
        let rows = p.len();
        let own = hook.per_gaussian.iter();
        let per_gaussian = own.map(|&(n, width)| p.entry(n, Space::Gaussians, &[(n, width)], rows, |_| {}));
        let per_gaussian = per_gaussian.collect::<Result<Vec<Key>>>()?;
        let shared = hook.shared.iter().map(|(n, _, data)| p.array(n, data.len(), |to| to.copy_from_slice(data)));
        let shared = shared.collect::<Result<Vec<Key>>>()?;
        Ok(Arc::new(Self { hook: hook.clone(), per_gaussian, shared, rests: false }))
    }

    /// Whether colours are the model's.
    fn colors(&self) -> bool {
        self.hook.colors && !self.rests
    }

    /// The arguments of a query: raw parameters of the requested rows, and the shared arrays.
    fn arguments<'py>(&self, py: Python<'py>, q: &At<'_>) -> PyResult<Bound<'py, PyDict>> {
        let (n, geometry) = (q.len(), &q.p[GEOMETRY]);
        let ids = || (0..n).map(|j| q.rows.id(j));
        let out = PyDict::new(py);
        out.set_item("means", rows(py, ids().map(|id| geometry.read::<3>(id, 0)).collect())?)?;
        out.set_item("quats", rows(py, ids().map(|id| geometry.read::<4>(id, QUAT)).collect())?)?;
        out.set_item("log_scales", rows(py, ids().map(|id| geometry.read::<3>(id, LOG_SCALE)).collect())?)?;
        let logits: Vec<f32> = ids().map(|id| geometry.get(id, OPACITY)).collect();
        out.set_item("opacity_logits", shaped(py, logits, &[n])?)?;
        let table = |key: Key| {
            let (table, width) = (&q.p[key], q.p[key].width());
            ids().flat_map(move |id| (0..width).map(move |k| table.get(id, k))).collect::<Vec<f32>>()
        };
        out.set_item("sh", shaped(py, table(SH), &[n, q.p[SH].width() / 3, 3])?)?;
        for (&(name, width), key) in self.hook.per_gaussian.iter().zip(&self.per_gaussian) {
            out.set_item(name, shaped(py, table(*key), &[n, width])?)?;
        }
        for ((name, shape, data), key) in self.hook.shared.iter().zip(&self.shared) {
            let values = q.p[*key].data()[..data.len()].to_vec();
            out.set_item(name, shaped(py, values, shape)?)?;
        }
        Ok(out)
    }

    /// Calls Python for the Gaussians at a time.
    fn request(&self, py: Python<'_>, q: &At<'_>) -> PyResult<ResultState> {
        let n = q.len();
        let answer = self.hook.object.bind(py).call_method1("forward", (self.arguments(py, q)?, q.t.0))?;
        let wrong = || bad_input("the motion's forward did not return six arrays", "Return a splat4d.Motion's forward");
        let answer: [Bound<'_, PyAny>; 6] = answer.extract().map_err(|_| wrong())?;
        let [means, quats, scales, opacities, colors, tape] = &answer;
        let read = |value: &Bound<'_, PyAny>, what: &str, width: usize| -> PyResult<Vec<f32>> {
            let array = numbers::<f32>(value, what)?;
            let wanted: &[usize] = if width == 1 { &[n] } else { &[n, width] };
            if array.shape() != wanted {
                let remedy = format!("Return the shape {wanted:?}: a row for each Gaussian that was given");
                return Err(bad_input(format!("the motion's {what} have the shape {:?}", array.shape()), &remedy));
            }
            let data: Vec<f32> = array.as_array().iter().copied().collect();
            match data.iter().position(|x| !x.is_finite()) {
                Some(bad) => Err(bad_input(
                    format!("row {} of the motion's {what} holds NaN or infinity at {} s", bad / width, q.t.0),
                    "Return finite numbers",
                )),
                None => Ok(data),
            }
        };
        let (means, quats) = (read(means, "means", 3)?, read(quats, "quats", 4)?);
        let (scales, opacities) = (read(scales, "scales", 3)?, read(opacities, "opacities", 1)?);
        if let Some(bad) = scales.iter().position(|s| *s <= 0.0) {
            let what = format!("row {} of the motion's scales is not positive at {} s", bad / 3, q.t.0);
            return Err(bad_input(what, "Return standard deviations, for instance exp(log_scales)"));
        }
        if let Some(bad) = opacities.iter().position(|o| !(0.0..=1.0).contains(o)) {
            let what = format!("row {bad} of the motion's opacities is {} at {} s", opacities[bad], q.t.0);
            return Err(bad_input(what, "Return opacities from 0 to 1, for instance sigmoid(opacity_logits)"));
        }
        let raw = (0..n).map(|j| {
            std::array::from_fn(|c| match c {
                0..QUAT => means[3 * j + c],
                QUAT..LOG_SCALE => quats[4 * j + c - QUAT],
                LOG_SCALE..OPACITY => scales[3 * j + c - LOG_SCALE].ln(),
                _ => logit(opacities[j], OPACITY_MARGIN),
            })
        });
        let raw = raw.collect();
        let mut table = Table::default();
        if self.colors() {
            let given = read(colors, "colours", 3)?;
            table = Table::new(&[("color", 3)], n);
            (0..n).for_each(|j| table.write(j, 0, [given[3 * j], given[3 * j + 1], given[3 * j + 2]]));
        }
        Ok(ResultState { tape: Some(tape.clone().unbind()), raw, colors: table })
    }

    /// Passes Python the gradient to a result, and adds the returned gradients to the tables'. Returns dL/dt.
    fn hand_back(
        &self,
        py: Python<'_>,
        q: &At<'_>,
        answer: &ResultState,
        d_out: &SplatGrads<'_>,
        d: &mut Grads,
    ) -> PyResult<f64> {
        let n = q.len();
        let (mut means, mut quats, mut scales) = (vec![[0.0; 3]; n], vec![[0.0; 4]; n], vec![[0.0; 3]; n]);
        let mut opacities = vec![0.0; n];
        for (j, raw) in answer.raw.iter().enumerate() {
            let row = d_out.out.read::<10>(j, 0);
            let back = activate_backward(*raw, row);
            means[j].copy_from_slice(&back[..QUAT]);
            quats[j].copy_from_slice(&back[QUAT..LOG_SCALE]);
            // dL/ds = dL/d log s / s.
            scales[j] = std::array::from_fn(|k| back[LOG_SCALE + k] / raw[LOG_SCALE + k].exp());
            opacities[j] = row[9];
        }
        let colors = match d_out.color.filter(|_| self.colors()) {
            Some(table) => rows(py, (0..n).map(|j| table.read::<3>(j, 0)).collect())?,
            None => py.None(),
        };
        let arguments = (
            answer.tape.as_ref(),
            rows(py, means)?,
            rows(py, quats)?,
            rows(py, scales)?,
            shaped(py, opacities, &[n])?,
            colors,
        );
        let back = self.hook.object.bind(py).call_method1("backward", arguments)?;
        let back = back.cast_into::<PyDict>().map_err(|_| {
            bad_input(
                "the motion's backward did not return a dict",
                "Return a gradient for each array that learns, by name",
            )
        })?;
        let mut d_time = 0.0;
        for (name, value) in back.iter() {
            let name: String = name.extract()?;
            if name == "time" {
                d_time = value.extract()?;
                continue;
            }
            let array = numbers::<f32>(&value, "a gradient of the motion")?;
            let data: Vec<f32> = array.as_array().iter().copied().collect();
            if data.iter().any(|x| !x.is_finite()) {
                return Err(bad_input(
                    format!("the motion's gradient to `{name}` holds NaN or infinity at {} s", q.t.0),
                    "Return finite numbers",
                ));
            }
            let unknown = || {
                bad_input(
                    format!("the motion's backward returned `{name}`, which is not one of its arrays"),
                    "Return the names that forward is given",
                )
            };
            let (key, first, width, by_row) = match name.as_str() {
                "means" => (GEOMETRY, 0, 3, true),
                "quats" => (GEOMETRY, QUAT, 4, true),
                "log_scales" => (GEOMETRY, LOG_SCALE, 3, true),
                "opacity_logits" => (GEOMETRY, OPACITY, 1, true),
                "sh" => (SH, 0, q.p[SH].width(), true),
                _ => match self.hook.per_gaussian.iter().position(|(n, _)| *n == name) {
                    Some(i) => (self.per_gaussian[i], 0, self.hook.per_gaussian[i].1, true),
                    None => {
                        let i = self.hook.shared.iter().position(|s| s.0 == name).ok_or_else(unknown)?;
                        (self.shared[i], 0, self.hook.shared[i].2.len(), false)
                    }
                },
            };
            let wanted = if by_row { n * width } else { width };
            if data.len() != wanted {
                let what = format!("the motion's gradient to `{name}` has {} numbers, not {wanted}", data.len());
                return Err(bad_input(what, "Return the shape of the array that forward is given"));
            }
            let [table] = d.of([key]);
            if by_row {
                for (j, row) in data.chunks_exact(width).enumerate() {
                    row.iter().enumerate().for_each(|(k, x)| *table.get_mut(q.rows.id(j), first + k) += x);
                }
            } else {
                table.data_mut().iter_mut().zip(&data).for_each(|(to, x)| *to += x);
            }
        }
        Ok(d_time)
    }
}

impl Motion for PyMotion {
    fn spec(&self) -> Spec {
        Spec::Custom(self.hook.name.clone())
    }

    fn at(&self, q: &At<'_>, cache: &Cache, tape: &mut Tape) {
        if self.rests || q.is_empty() {
            return Still.at(q, cache, tape);
        }
        let answer = Python::attach(|py| self.request(py, q)).unwrap_or_else(|error| {
            self.hook.raised.raise(error);
            // The canonical Gaussians: the caller gets the error.
            let raw = |j| q.p[GEOMETRY].read::<11>(q.rows.id(j), 0);
            let mut colors = Table::default();
            if self.colors() {
                colors = Table::new(&[("color", 3)], q.len());
            }
            ResultState { tape: None, raw: (0..q.len()).map(raw).collect(), colors }
        });
        tape.start(q.len());
        answer.raw.iter().enumerate().for_each(|(j, raw)| tape.out.write(j, 0, activate(*raw)));
        *tape.own.get_or_default() = answer;
    }

    fn color<'a>(&self, q: &At<'a>, tape: &'a Tape) -> Color<'a> {
        match tape.own.get::<ResultState>() {
            Some(answer) if self.colors() && !q.is_empty() => Color::Direct { table: &answer.colors },
            _ => Color::Sh { table: &q.p[SH], rows: q.rows, weights: None, base: true },
        }
    }

    fn backward(
        &self,
        q: &At<'_>,
        cache: &Cache,
        tape: &mut Tape,
        d_out: &SplatGrads<'_>,
        d_cache: &mut Cache,
        d: &mut Grads,
    ) -> f64 {
        if self.rests || q.is_empty() {
            return Still.backward(q, cache, tape, d_out, d_cache, d);
        }
        let answer = std::mem::take(tape.own.get_or_default::<ResultState>());
        if answer.tape.is_none() {
            return 0.0; // a failed query has no gradient; the error is raised later
        }
        Python::attach(|py| self.hand_back(py, q, &answer, d_out, d)).unwrap_or_else(|error| {
            self.hook.raised.raise(error);
            0.0
        })
    }

    fn scratch_bytes(&self, _p: &Params, rows: usize) -> u64 {
        SCRATCH * rows as u64
    }

    fn with_phase(&self, phase: &Phase) -> Option<Arc<dyn Motion>> {
        let (per_gaussian, shared) = (self.per_gaussian.clone(), self.shared.clone());
        Some(Arc::new(Self { hook: self.hook.clone(), per_gaussian, shared, rests: phase.rests }))
    }
}

/// Raises the exception that a motion of the scene has raised.
pub(crate) fn raise(scene: &splat4d::layers::Scene<f32>) -> PyResult<()> {
    for layer in &scene.layers {
        let motion: &dyn std::any::Any = &*layer.motion;
        if let Some(error) = motion.downcast_ref::<PyMotion>().and_then(|m| m.hook.raised.take()) {
            return Err(error);
        }
    }
    Ok(())
}
