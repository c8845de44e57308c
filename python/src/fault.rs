//! How errors reach Python: as its own exceptions, with the text that every part of the project gives them.

use conicflow_messages::Hinted;
use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyUserWarning, PyValueError};
use pyo3::{PyErr, PyResult, PyTypeInfo, Python};
use std::error::Error;
use std::ffi::CString;

/// A value that cannot be used.
pub(crate) fn value(what: impl Into<String>, hint: impl Into<String>) -> PyErr {
    PyValueError::new_err(Hinted::new(what, hint).to_string())
}

/// A value of the wrong type.
pub(crate) fn kind(what: impl Into<String>, hint: impl Into<String>) -> PyErr {
    PyTypeError::new_err(Hinted::new(what, hint).to_string())
}

/// An error of the library, which tells itself what to do.
pub(crate) fn told(error: &dyn Error) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// What goes wrong with a pipeline; it tells itself what to do.
pub(crate) fn run(error: &dyn Error) -> PyErr {
    PyRuntimeError::new_err(error.to_string())
}

/// Warns of what can be meant, but hardly is.
pub(crate) fn warn(py: Python<'_>, what: &str, hint: &str) -> PyResult<()> {
    let text = CString::new(Hinted::new(what, hint).to_string())?;
    PyErr::warn(py, &PyUserWarning::type_object(py), &text, 1)
}
