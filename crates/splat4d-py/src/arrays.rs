//! NumPy in and out: rows are moved, not copied; images are the renderer's planes seen as [h, w, channels].

use crate::errors::bad_input;
use numpy::{IntoPyArray, PyArray1, PyArray3, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::scene::Planes;

/// Rows of N numbers as an array [rows, N], without a copy.
pub(crate) fn rows<const N: usize>(py: Python<'_>, rows: Vec<[f32; N]>) -> PyResult<Py<PyAny>> {
    let count = rows.len();
    shaped(py, rows.into_flattened(), &[count, N])
}

/// Numbers as an array of a shape that has as many, without a copy.
pub(crate) fn shaped<T: numpy::Element>(py: Python<'_>, numbers: Vec<T>, shape: &[usize]) -> PyResult<Py<PyAny>> {
    let flat: Bound<'_, PyArray1<T>> = numbers.into_pyarray(py);
    Ok(flat.reshape(shape.to_vec())?.into_any().unbind())
}

/// Planes [c, h, w] as an image [h, w, c] that shares the memory.
pub(crate) fn picture(py: Python<'_>, planes: Planes<f32>) -> PyResult<Bound<'_, PyAny>> {
    let shape = [planes.channels, planes.height, planes.width];
    let array: Bound<'_, PyArray3<f32>> = planes.data.into_pyarray(py).reshape(shape)?;
    array.call_method1("transpose", (1, 2, 0))
}

/// One plane as [h, w].
pub(crate) fn plane(py: Python<'_>, planes: Planes<f32>) -> PyResult<Py<PyAny>> {
    shaped(py, planes.data, &[planes.height, planes.width])
}

/// Anything that NumPy makes an array of, as numbers of type T; a copy only where it must be. `what` names it in
/// errors.
pub(crate) fn numbers<'py, T: numpy::Element>(
    value: &Bound<'py, PyAny>,
    what: &str,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    let py = value.py();
    let wanted = numpy::dtype::<T>(py);
    let options = PyDict::new(py);
    options.set_item("dtype", &wanted)?;
    let array = py.import("numpy")?.call_method("asarray", (value,), Some(&options)).map_err(|e| {
        let remedy = format!("Give an array or a list of numbers ({wanted})");
        bad_input(format!("{what}: expected an array of numbers ({})", e.value(py)), &remedy)
    })?;
    let array = array.cast_into::<PyArrayDyn<T>>().map_err(PyErr::from)?;
    Ok(array.readonly())
}

/// Finite numbers [rows, N].
pub(crate) fn finite_rows<const N: usize>(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<[f64; N]>> {
    let array = numbers::<f64>(value, what)?;
    if array.ndim() != 2 || array.shape()[1] != N {
        return Err(bad_input(format!("{what} has the shape {:?}", array.shape()), &format!("Give an array [N, {N}]")));
    }
    let flat: Vec<f64> = array.as_array().iter().copied().collect();
    if let Some(bad) = flat.iter().position(|x| !x.is_finite()) {
        return Err(bad_input(format!("row {} of {what} holds NaN or infinity", bad / N), "Leave such rows out"));
    }
    Ok(flat.chunks_exact(N).map(|row| std::array::from_fn(|k| row[k])).collect())
}

/// N finite numbers.
pub(crate) fn finite<const N: usize>(value: &Bound<'_, PyAny>, what: &str) -> PyResult<[f64; N]> {
    let array = numbers::<f64>(value, what)?;
    let flat: Vec<f64> = array.as_array().iter().copied().collect();
    match <[f64; N]>::try_from(flat) {
        Ok(all) if array.ndim() == 1 && all.iter().all(|x| x.is_finite()) => Ok(all),
        _ => Err(bad_input(format!("{what} are not {N} finite numbers"), &format!("Give {N} numbers"))),
    }
}

/// Type of an image's numbers.
pub(crate) enum Kind {
    /// From 0 to 255.
    Bytes,
    /// Nominally from 0 to 1.
    Floats,
}

/// Anything that NumPy makes an array of, in its own type of numbers, if images may have that one.
pub(crate) fn pixels<'py>(value: &Bound<'py, PyAny>, what: &str) -> PyResult<(Bound<'py, PyAny>, Kind)> {
    let array = value.py().import("numpy")?.call_method1("asarray", (value,)).map_err(|e| {
        bad_input(format!("{what} is not an array ({})", e.value(value.py())), "Give an image [height, width, 3]")
    })?;
    let dtype = array.getattr("dtype")?;
    let kind: (String, usize) = (dtype.getattr("kind")?.extract()?, dtype.getattr("itemsize")?.extract()?);
    match (kind.0.as_str(), kind.1) {
        ("u", 1) => Ok((array, Kind::Bytes)),
        ("f", _) => Ok((array, Kind::Floats)),
        _ => Err(bad_input(format!("{what} has the dtype {dtype}"), "Give float32 from 0 to 1, or uint8")),
    }
}

/// An image [h, w, 3], as floats nominally from 0 to 1 or 8-bit numbers, as planes.
pub(crate) fn planes(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Planes<f32>> {
    let (value, kind) = pixels(value, what)?;
    let array = numbers::<f32>(&value, what)?;
    let &[height, width, 3] = array.shape() else {
        return Err(bad_input(format!("{what} has the shape {:?}", array.shape()), "Give an image [height, width, 3]"));
    };
    if height * width == 0 {
        return Err(bad_input(format!("{what} has {width}x{height} pixels"), "Give an image with pixels"));
    }
    let mut out = Planes::new(3, height, width);
    let view = array.as_array();
    for (c, plane) in out.data.chunks_exact_mut(height * width).enumerate() {
        let channel = view.index_axis(numpy::ndarray::Axis(2), c);
        let numbers = plane.iter_mut().zip(channel.iter());
        // Divided as images in files are, so that the same bytes are the same numbers.
        match kind {
            Kind::Bytes => numbers.for_each(|(o, x)| *o = x / 255.0),
            Kind::Floats => numbers.for_each(|(o, x)| *o = *x),
        }
    }
    match out.data.iter().position(|x| !x.is_finite()) {
        Some(at) => {
            let pixel = at % (height * width);
            let place = format!("row {}, column {}", pixel / width, pixel % width);
            Err(bad_input(format!("{what} holds NaN or infinity at {place}"), "Give numbers from 0 to 1"))
        }
        None => Ok(out),
    }
}

/// A render and its truth, of one size.
pub(crate) fn pair(render: &Bound<'_, PyAny>, truth: &Bound<'_, PyAny>) -> PyResult<(Planes<f32>, Planes<f32>)> {
    let (a, b) = (planes(render, "render")?, planes(truth, "truth")?);
    if (a.height, a.width) != (b.height, b.width) {
        let what = format!("render has {}x{} pixels, truth {}x{}", a.width, a.height, b.width, b.height);
        return Err(bad_input(what, "Give images of one size"));
    }
    Ok((a, b))
}
