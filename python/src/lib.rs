//! The Python module `conicflow`: the detector and the tracker on NumPy arrays, the topics of running pipelines, and stages
//! and sources written in Python.
//!
//! Each of these interfaces has a file: [`detector`], [`tracker`], [`read`], [`stage`], [`source`]. Their data are [`record`]s,
//! [`message`]s and [`depth_array`]s. Nothing of a pipeline is opened before it is needed.

mod argument;
mod array;
mod depth_array;
mod detector;
mod fault;
mod joined;
mod message;
mod owned;
mod payload;
mod read;
mod record;
mod settings;
mod source;
mod stage;
mod tracker;

use conicflow_messages::Hinted;
use pyo3::exceptions::PyImportError;
use pyo3::prelude::*;

/// The compiled part of `conicflow`.
#[pymodule]
fn _conicflow(module: &Bound<'_, PyModule>) -> PyResult<()> {
    expect_numpy(module.py())?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_function(wrap_pyfunction!(detector::detect, module)?)?;
    module.add_class::<detector::PyDetector>()?;
    module.add_class::<tracker::PyTracker>()?;
    module.add_function(wrap_pyfunction!(read::read, module)?)?;
    module.add_class::<read::Reader>()?;
    module.add_class::<message::Message>()?;
    module.add_function(wrap_pyfunction!(stage::stage, module)?)?;
    module.add_class::<stage::Stage>()?;
    module.add_function(wrap_pyfunction!(source::source, module)?)?;
    module.add_class::<source::Source>()?;
    module.add_function(wrap_pyfunction!(array::dtype_of, module)?)?;
    module.add_function(wrap_pyfunction!(payload::of_records, module)?)?;
    module.add_function(wrap_pyfunction!(log, module)?)?;
    record::add_to(module)
}

/// Checks that NumPy is installed, without loading it: otherwise the first array would fail in the middle of a call.
fn expect_numpy(py: Python<'_>) -> PyResult<()> {
    if !py.import("importlib.util")?.call_method1("find_spec", ("numpy",))?.is_none() {
        return Ok(());
    }
    let hint = "`pip install numpy`, or `sudo apt install python3-numpy`";
    Err(PyImportError::new_err(Hinted::new("conicflow needs NumPy, which is not installed", hint).to_string()))
}

/// Logs a text like a stage in Rust, with level "error", "warn" or "info".
#[pyfunction]
fn log(py: Python<'_>, level: &str, text: &str) {
    py.detach(|| match level {
        "error" => tracing::error!("{text}"),
        "warn" => tracing::warn!("{text}"),
        _ => tracing::info!("{text}"),
    });
}
