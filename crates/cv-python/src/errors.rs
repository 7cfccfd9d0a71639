//! Conversion of library errors to exceptions, with their numbers as attributes.

use crate::results::to_python;
use cv_io::{FormatError, IoError};
use pyo3::exceptions::PyFileNotFoundError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use serde::Serialize;
use serde_json::{Map, Value};
use std::io::ErrorKind;

/// A library error: its message, and its numbers as data.
pub(crate) trait JobError: std::error::Error + Serialize + Send + 'static {}
impl<E: std::error::Error + Serialize + Send + 'static> JobError for E {}

/// An error of a job that can be converted to an exception.
pub(crate) trait Refused: Send {
    fn exception(&self, py: Python<'_>) -> PyErr;
}

impl<E: JobError> Refused for E {
    fn exception(&self, py: Python<'_>) -> PyErr {
        refused(py, self)
    }
}

/// Makes the exception of an error: the class of `epipole.errors` that is named after the innermost variant, with its fields.
pub(crate) fn refused(py: Python<'_>, error: &impl JobError) -> PyErr {
    let (mut variants, mut fields) = (Vec::new(), Map::new());
    match serde_json::to_value(error) {
        Ok(value) => flatten(value, &mut variants, &mut fields),
        Err(error) => return internal(&format!("an error that cannot be serialized: {error}")),
    }
    match made(py, &variants, &fields, &error.to_string()) {
        Ok(error) | Err(error) => error,
    }
}

fn made(py: Python<'_>, variants: &[String], fields: &Map<String, Value>, words: &str) -> PyResult<PyErr> {
    let attributes = PyDict::new(py);
    for (name, value) in fields {
        attributes.set_item(name, to_python(py, value)?)?;
    }
    let error = py.import("epipole.errors")?.call_method1("_made", (PyList::new(py, variants)?, words, attributes))?;
    Ok(PyErr::from_value(error))
}

/// Converts a reason to data: `kind`, the name of the innermost variant, and the fields.
pub(crate) fn reason<'py>(py: Python<'py>, reason: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let value = serde_json::to_value(reason).map_err(|error| internal(&error.to_string()))?;
    let (mut variants, mut fields) = (Vec::new(), Map::new());
    flatten(value, &mut variants, &mut fields);
    let all = PyDict::new(py);
    all.set_item("kind", variants.last())?;
    for (name, value) in fields {
        all.set_item(name, to_python(py, &value)?)?;
    }
    Ok(all.into_any())
}

/// Collects the names of variants from the outside in, and the fields of all of them. An error is `{"Variant": {"field": …}}`, or a name alone; a nested error is
/// the variant's content, or its field `source`.
fn flatten(value: Value, variants: &mut Vec<String>, fields: &mut Map<String, Value>) {
    match value {
        Value::String(name) => variants.push(name),
        Value::Object(mut object) => {
            let variant = match object.keys().next() {
                Some(name) if object.len() == 1 && name.starts_with(|c: char| c.is_ascii_uppercase()) => name.clone(),
                _ => {
                    let source = object.remove("source");
                    fields.extend(object);
                    if let Some(source) = source {
                        flatten(source, variants, fields);
                    }
                    return;
                }
            };
            let content = object.remove(&variant).unwrap_or_default();
            variants.push(variant);
            if !content.is_string() {
                flatten(content, variants, fields);
            }
        }
        _ => {}
    }
}

/// Makes the exception of a bug of this package.
pub(crate) fn internal(words: &str) -> PyErr {
    Python::attach(|py| {
        let class = py.import("epipole.errors").and_then(|errors| errors.getattr("InternalError"));
        let text = format!("{words} (a bug in epipole: please report it)");
        match class.and_then(|class| class.call1((text,))) {
            Ok(error) => PyErr::from_value(error),
            Err(error) => error,
        }
    })
}

/// Makes the exception of a file that cannot be read or written.
pub(crate) fn of_file(py: Python<'_>, error: &IoError) -> PyErr {
    let path = error.path.display().to_string();
    if let FormatError::Os(reason) = &error.reason
        && reason.kind() == ErrorKind::NotFound
    {
        return PyFileNotFoundError::new_err((reason.raw_os_error(), "No such file or directory", path));
    }
    let mut fields = Map::new();
    fields.insert("path".to_owned(), Value::String(path));
    match made(py, &["File".to_owned()], &fields, &error.to_string()) {
        Ok(error) | Err(error) => error,
    }
}

/// Makes the exception of an invalid argument, with its numbers.
pub(crate) fn of_argument(py: Python<'_>, variant: &str, fields: &[(&str, Value)], words: &str) -> PyErr {
    let fields = fields.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect();
    match made(py, &[variant.to_owned()], &fields, words) {
        Ok(error) | Err(error) => error,
    }
}
