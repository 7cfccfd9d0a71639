//! Results as Python objects: frozen dataclasses of `python/epipole/_results.py` over arrays.

use pyo3::IntoPyObjectExt;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyNone};
use serde::Serialize;
use serde_json::Value;

/// A field of a result.
pub(crate) type Field<'py> = (&'static str, Bound<'py, PyAny>);

/// Makes a result: the dataclass of that name with these fields.
pub(crate) fn made<'py>(
    py: Python<'py>,
    class: &str,
    fields: impl IntoIterator<Item = Field<'py>>,
) -> PyResult<Bound<'py, PyAny>> {
    let all = PyDict::new(py);
    for (name, value) in fields {
        all.set_item(name, value)?;
    }
    py.import("epipole._results")?.getattr(class)?.call((), Some(&all))
}

/// Converts any value to an object.
pub(crate) fn object<'py, T: IntoPyObject<'py>>(py: Python<'py>, value: T) -> PyResult<Bound<'py, PyAny>> {
    value.into_bound_py_any(py)
}

/// Converts stage names and seconds to a dict.
pub(crate) fn stages<'py>(py: Python<'py>, stages: &[(&'static str, f64)]) -> PyResult<Bound<'py, PyAny>> {
    let all = PyDict::new(py);
    for (name, seconds) in stages {
        // Repeated stages are summed.
        let before: f64 = all.get_item(name)?.map_or(Ok(0.0), |v| v.extract())?;
        all.set_item(name, before + seconds)?;
    }
    Ok(all.into_any())
}

/// Converts data to plain objects.
pub(crate) fn data<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let value = serde_json::to_value(value).map_err(|e| crate::errors::internal(&e.to_string()))?;
    to_python(py, &value)
}

/// Converts JSON to plain objects.
pub(crate) fn to_python<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    match value {
        Value::Null => Ok(PyNone::get(py).to_owned().into_any()),
        Value::Bool(value) => value.into_bound_py_any(py),
        Value::Number(number) => match (number.as_i64(), number.as_u64()) {
            (Some(value), _) => value.into_bound_py_any(py),
            (None, Some(value)) => value.into_bound_py_any(py),
            _ => number.as_f64().into_bound_py_any(py),
        },
        Value::String(text) => text.into_bound_py_any(py),
        Value::Array(values) => {
            let list = PyList::empty(py);
            for value in values {
                list.append(to_python(py, value)?)?;
            }
            // Immutable, as the results are.
            Ok(list.to_tuple().into_any())
        }
        Value::Object(fields) => {
            let all = PyDict::new(py);
            for (name, value) in fields {
                all.set_item(name, to_python(py, value)?)?;
            }
            Ok(all.into_any())
        }
    }
}
