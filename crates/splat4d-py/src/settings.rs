//! Keyword arguments as settings of the recipe.

use crate::errors::{OrRaise, bad_input};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d_train::recipe::Recipe;

/// Keyword arguments as names and values in TOML. A setting of a table has two underscores in Python. Errors: a value
/// that no setting can have.
pub(crate) fn assignments(settings: Option<&Bound<'_, PyDict>>) -> PyResult<Vec<(String, String)>> {
    let mut out = Vec::new();
    for (name, value) in settings.into_iter().flatten() {
        let name = name.extract::<String>()?.replacen("__", ".", 1);
        // Numbers of NumPy become Python's.
        let value = value.call_method0("item").unwrap_or(value);
        let text: String = value.py().import("json")?.call_method1("dumps", (&value,))?.extract()?;
        // No setting can be null.
        if value.is_none() {
            return Err(bad_input(format!("`{name}` is None"), "Leave it out for its default"));
        }
        out.push((name, text));
    }
    Ok(out)
}

/// Puts settings into a recipe; their names. Errors: an unknown setting, a wrong type or range.
pub(crate) fn set(recipe: &mut Recipe, settings: Option<&Bound<'_, PyDict>>) -> PyResult<Vec<String>> {
    let mut names = Vec::new();
    for (name, text) in assignments(settings)? {
        recipe.set(&format!("{name}={text}")).or_raise()?;
        names.push(name);
    }
    Ok(names)
}
