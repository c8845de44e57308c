//! How errors reach Python: as its own exceptions, with the text that every part of the project gives them.

use conicflow_messages::Hinted;
use pyo3::PyErr;
use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyValueError};
use std::error::Error;

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
