//! Keyword options of a call.

use cv_core::Named;
use pyo3::IntoPyObjectExt;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyString};

/// The keyword arguments of a call: each is taken by name; unknown ones are refused at the end.
pub(crate) struct Options<'py> {
    function: &'static str,
    given: Option<Bound<'py, PyDict>>,
    /// Names of the options.
    known: Vec<&'static str>,
    /// If set, names and defaults are recorded and no options are read.
    record: Option<Bound<'py, PyDict>>,
}

impl<'py> Options<'py> {
    pub(crate) fn new(function: &'static str, given: Option<&Bound<'py, PyDict>>) -> Self {
        Self { function, given: given.cloned(), known: Vec::new(), record: None }
    }

    /// Records names and defaults instead of reading options.
    pub(crate) fn recording(py: Python<'py>, function: &'static str) -> Self {
        Self { function, given: None, known: Vec::new(), record: Some(PyDict::new(py)) }
    }

    /// Returns the recorded options.
    pub(crate) fn recorded(self) -> PyResult<Bound<'py, PyDict>> {
        self.record.ok_or_else(|| PyValueError::new_err("nothing was recorded"))
    }

    /// Records the default of an option that is taken as an object.
    pub(crate) fn default<T: IntoPyObject<'py>>(&self, name: &'static str, default: T) -> PyResult<()> {
        self.note(name, default)
    }

    fn note<T: IntoPyObject<'py>>(&self, name: &'static str, default: T) -> PyResult<()> {
        let Some(record) = &self.record else { return Ok(()) };
        let default = default.into_bound_py_any(record.py())?;
        if !record.contains(name)? {
            record.set_item(name, default)?;
        }
        Ok(())
    }

    /// Returns the given value of an option.
    fn given(&mut self, name: &'static str) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.known.push(name);
        match &self.given {
            Some(given) => given.get_item(name),
            None => Ok(None),
        }
    }

    /// Makes the error of a value of the wrong type.
    fn wrong(&self, py: Python<'py>, name: &str, error: &PyErr) -> PyErr {
        let text = format!("{}(): {name}: {}", self.function, error.value(py));
        if error.is_instance_of::<PyTypeError>(py) { PyTypeError::new_err(text) } else { PyValueError::new_err(text) }
    }

    /// Converts the value of an option to its type.
    pub(crate) fn extract<T>(&self, name: &str, value: &Bound<'py, PyAny>) -> PyResult<T>
    where
        T: for<'a> FromPyObject<'a, 'py, Error: Into<PyErr>>,
    {
        match value.extract::<T>() {
            Ok(value) => Ok(value),
            Err(error) => Err(self.wrong(value.py(), name, &error.into())),
        }
    }

    /// Reads an option with a default; `None` means the default.
    pub(crate) fn set<T>(&mut self, name: &'static str, value: &mut T) -> PyResult<()>
    where
        T: for<'a> FromPyObject<'a, 'py, Error: Into<PyErr>> + IntoPyObject<'py> + Clone,
    {
        self.note(name, value.clone())?;
        if let Some(given) = self.given(name)?.filter(|given| !given.is_none()) {
            *value = self.extract(name, &given)?;
        }
        Ok(())
    }

    /// Reads an option that `None` disables.
    pub(crate) fn set_optional<T>(&mut self, name: &'static str, value: &mut Option<T>) -> PyResult<()>
    where
        T: for<'a> FromPyObject<'a, 'py, Error: Into<PyErr>> + IntoPyObject<'py> + Clone,
    {
        self.note(name, value.clone())?;
        if let Some(given) = self.given(name)? {
            *value = if given.is_none() { None } else { Some(self.extract(name, &given)?) };
        }
        Ok(())
    }

    /// Reads an option without a default.
    pub(crate) fn take<T>(&mut self, name: &'static str) -> PyResult<Option<T>>
    where
        T: for<'a> FromPyObject<'a, 'py, Error: Into<PyErr>>,
    {
        self.note(name, None::<bool>)?;
        match self.given(name)?.filter(|given| !given.is_none()) {
            Some(given) => Ok(Some(self.extract(name, &given)?)),
            None => Ok(None),
        }
    }

    /// Reads an option without a default, as an object.
    pub(crate) fn take_any(&mut self, name: &'static str) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.note(name, None::<bool>)?;
        Ok(self.given(name)?.filter(|given| !given.is_none()))
    }

    /// Reads a named value; a number is accepted if the names are numbers.
    pub(crate) fn set_named<T: Named>(&mut self, name: &'static str, value: &mut T) -> PyResult<()> {
        self.note(name, value.name())?;
        if let Some(given) = self.given(name)?.filter(|given| !given.is_none()) {
            *value = self.named(name, &given)?;
        }
        Ok(())
    }

    /// Reads a named value without a default.
    pub(crate) fn take_named<T: Named>(&mut self, name: &'static str) -> PyResult<Option<T>> {
        self.note(name, None::<bool>)?;
        match self.given(name)?.filter(|given| !given.is_none()) {
            Some(given) => Ok(Some(self.named(name, &given)?)),
            None => Ok(None),
        }
    }

    fn named<T: Named>(&self, name: &str, given: &Bound<'py, PyAny>) -> PyResult<T> {
        T::from_name(&self.text(name, given)?)
            .map_err(|error| PyValueError::new_err(format!("{}(): {name}: {error}", self.function)))
    }

    /// Converts a string or an integer to a name.
    fn text(&self, name: &str, given: &Bound<'py, PyAny>) -> PyResult<String> {
        if !given.is_instance_of::<PyString>() && (given.is_instance_of::<PyBool>() || given.extract::<i64>().is_err())
        {
            let (function, kind) = (self.function, given.get_type());
            return Err(PyTypeError::new_err(format!("{function}(): {name} must be a string, not {}", kind.name()?)));
        }
        Ok(given.str()?.to_string())
    }

    /// Refuses unknown options, with a suggestion.
    pub(crate) fn finish(self) -> PyResult<()> {
        let Some(given) = &self.given else { return Ok(()) };
        for key in given.keys() {
            let key = key.str()?.to_string();
            if self.known.iter().any(|known| *known == key) {
                continue;
            }
            let nearest = self.known.iter().min_by_key(|known| distance(&key, known));
            let advice = match nearest.filter(|known| distance(&key, known) <= 1 + key.len() / 3) {
                Some(known) => format!("did you mean '{known}'?"),
                None => format!("there are {}", self.known.join(", ")),
            };
            let text = format!("{}() got an unexpected keyword argument '{key}'; {advice}", self.function);
            return Err(PyTypeError::new_err(text));
        }
        Ok(())
    }
}

/// Computes the Levenshtein distance in O(length²).
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, letter) in a.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], i + 1);
        for j in 0..b.len() {
            let changed = diagonal + usize::from(letter != b[j]);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}
