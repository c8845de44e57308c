//! The Python module `conicflow`: the detector and the tracker on NumPy arrays, the topics of running pipelines, and stages
//! and sources written in Python.
//!
//! Each file is one of these doors: [`detector`], [`tracker`]. What goes through them are [`record`]s
//! and [`depth_array`]s. Nothing of a pipeline is opened before it is asked for.

mod depth_array;
mod detector;
mod fault;
mod record;
mod settings;
mod tracker;

use pyo3::prelude::*;

/// The compiled part of `conicflow`.
#[pymodule]
fn _conicflow(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_function(wrap_pyfunction!(detector::detect, module)?)?;
    module.add_class::<detector::PyDetector>()?;
    module.add_class::<tracker::PyTracker>()?;
    record::add_to(module)
}
