//! Conversion of errors to Python exceptions, with the same texts as everywhere in the project.

use conicflow_messages::Hinted;
use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyUserWarning, PyValueError};
use pyo3::{PyErr, PyResult, PyTypeInfo, Python};
use std::error::Error;
use std::ffi::CString;

/// A ValueError.
pub(crate) fn value(what: impl Into<String>, hint: impl Into<String>) -> PyErr {
    PyValueError::new_err(Hinted::new(what, hint).to_string())
}

/// A TypeError.
pub(crate) fn kind(what: impl Into<String>, hint: impl Into<String>) -> PyErr {
    PyTypeError::new_err(Hinted::new(what, hint).to_string())
}

/// A ValueError from an error of the library, which contains its hint.
pub(crate) fn from_error(error: &dyn Error) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// A RuntimeError from an error of a pipeline, which contains its hint.
pub(crate) fn run(error: &dyn Error) -> PyErr {
    PyRuntimeError::new_err(error.to_string())
}

/// Warns of a valid argument that is probably a mistake.
pub(crate) fn warn(py: Python<'_>, what: &str, hint: &str) -> PyResult<()> {
    let text = CString::new(Hinted::new(what, hint).to_string())?;
    PyErr::warn(py, &PyUserWarning::type_object(py), &text, 1)
}
