//! The common part of stages and sources in Python: context and parameters, further inputs, and failures.

use crate::message::{Lender, Message};
use crate::owned::Owned;
use crate::{argument, fault};
use conicflow_dataflow::{
    Context, ItemType, ProcessError, PulledSource, PulledStage, RetainedMessage, RunError, Stop, lock,
};
use pyo3::exceptions::PySystemExit;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::collections::BTreeMap;
use std::io::{Write, stderr};
use std::sync::{Mutex, MutexGuard};

/// Exit code of a stage that could not be initialised: a restart would not help.
const REFUSED: i32 = 2;

/// The part of a stage or source in Python that does not depend on its type: its place in the run.
#[pyclass(frozen, subclass, name = "Joined", module = "conicflow")]
pub(crate) struct Joined {
    pub(crate) context: Context,
    stop: Owned<Stop>,
    base: String,
    parameters: Py<PyAny>,
}

impl Joined {
    /// Creates it from the context and the parameters; a process that is not wanted any more has neither.
    pub(crate) fn new(py: Python<'_>, given: Option<(&Context, &serde_json::Value)>) -> PyResult<Self> {
        let (context, parameters) = match given {
            Some((context, parameters)) => (context.clone(), parameters.to_string()),
            None => (Context::default(), "{}".to_owned()),
        };
        let parameters = py.import("json")?.call_method1("loads", (parameters,))?.unbind();
        let base = context.base.to_string_lossy().into_owned();
        let stop = Owned::new(context.stop.clone());
        Ok(Self { context, stop, base, parameters })
    }
}

#[pymethods]
impl Joined {
    /// Name of the stage in the pipeline file.
    #[getter]
    fn name(&self) -> &str {
        &self.context.stage
    }

    /// Parameters: all keys of its table in the pipeline file that are not reserved.
    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> Bound<'py, PyAny> {
        self.parameters.bind(py).clone()
    }

    /// Folder of the pipeline file, which relative paths start at.
    #[getter]
    fn base(&self) -> &str {
        &self.base
    }

    /// Number of messages that it had taken (a source: sent) before it was restarted in the same run; 0 at first.
    #[getter]
    fn resume_at(&self) -> u64 {
        self.context.resume_at
    }

    /// Whether the run is to end. Code that runs for seconds or waits for a device has to ask now and then; asking also shows
    /// that the stage is alive.
    #[getter]
    fn stopping(&self) -> PyResult<bool> {
        Ok(self.stop.expect("stage")?.requested())
    }

    /// The layout of the items that it sends, for numpy.zeros(n, dtype=stage.dtype); None without an output.
    #[getter]
    fn dtype<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.context.output.as_ref().map(|item| crate::array::dtype(py, item)).transpose()
    }

    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }
}

/// The Rust side of a stage or a source.
pub(crate) trait Pulls: Send {
    fn count(&mut self, name: &str, times: u64);
    fn frame(&self) -> Option<u64>;
    fn has_begun(&self) -> bool;
    fn end(self) -> Result<(), RunError>;
}

macro_rules! pulls {
    ($($type:ty),+) => {$(
        impl Pulls for $type {
            fn count(&mut self, name: &str, times: u64) {
                Self::count(self, name, times);
            }
            fn frame(&self) -> Option<u64> {
                Self::frame(self)
            }
            fn has_begun(&self) -> bool {
                Self::has_begun(self)
            }
            fn end(self) -> Result<(), RunError> {
                Self::end(self)
            }
        }
    )+};
}

pulls!(PulledStage, PulledSource);

/// A place in the run, until it is left; empty in a process that is not wanted any more.
pub(crate) struct PlaceInRun<T>(Owned<Mutex<Option<T>>>);

impl<T: Pulls> PlaceInRun<T> {
    pub(crate) fn new(pulled: Option<T>) -> Self {
        Self(Owned::new(Mutex::new(pulled)))
    }

    /// Locks the place; fails in a process that was forked from the one that joined the run.
    pub(crate) fn lock(&self) -> PyResult<MutexGuard<'_, Option<T>>> {
        Ok(lock(self.0.expect("stage")?))
    }

    /// Adds to a counter.
    pub(crate) fn count(&self, py: Python<'_>, name: &str, times: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let hint = "counters only grow";
        let times = times.map_or(Ok(1), |times| argument::whole("times", times, u64::MAX, hint))?;
        py.detach(|| self.lock().map(|mut pulled| pulled.iter_mut().for_each(|pulled| pulled.count(name, times))))
    }

    /// Leaves the place at the end of `with`, in order or after a failure. Does nothing in a forked process.
    pub(crate) fn leave(&self, py: Python<'_>, kind: &Bound<'_, PyAny>, exception: &Bound<'_, PyAny>) -> PyResult<()> {
        let Some(pulled) = self.0.here().and_then(|_| self.lock().ok()?.take()) else { return Ok(()) };
        if kind.is_none() {
            return py.detach(|| pulled.end()).map_err(|error| fault::run(&error));
        }
        failed(py, exception, pulled.frame(), pulled.has_begun())
    }
}

/// A message of a further input: the name of the input, the message, and its item type.
pub(crate) type Found = (String, RetainedMessage, ItemType);

/// Copies the messages of further inputs, which are converted after the stage is unlocked: Python may switch threads.
pub(crate) fn found<'a>(inputs: impl Iterator<Item = (&'a str, RetainedMessage, &'a ItemType)>) -> Vec<Found> {
    inputs.map(|(name, message, item)| (name.to_owned(), message, item.clone())).collect()
}

/// The lenders for the images of further inputs.
#[derive(Default)]
pub(crate) struct Inputs(Mutex<BTreeMap<String, Lender>>);

impl Inputs {
    /// Adds messages to a dictionary, by the names of their inputs.
    pub(crate) fn add_all(&self, all: &Bound<'_, PyDict>, found: Vec<Found>, received_ns: u64) -> PyResult<()> {
        for (name, message, item) in found {
            let lender = lock(&self.0).entry(name.clone()).or_default().clone();
            all.set_item(&name, Message::new(all.py(), &name, &item, message, received_ns, &lender)?)?;
        }
        Ok(())
    }
}

/// Joins the run, which from then on tells this process when to end: Python would otherwise raise KeyboardInterrupt in the middle
/// of a step. A process without a place keeps its own SIGINT handler.
pub(crate) fn join<T: Send>(py: Python<'_>, join: impl FnOnce() -> Result<T, ProcessError> + Send) -> PyResult<T> {
    // Only the main thread can set signal handlers; elsewhere they are left alone.
    let before = be_interrupted_by(py, None).ok();
    py.detach(join).map_err(|error| {
        before.map(|before| be_interrupted_by(py, Some(before)));
        refusal(py, &error)
    })
}

/// Sets the handler of SIGINT, by default that of the system; returns the handler before.
fn be_interrupted_by<'py>(py: Python<'py>, handler: Option<Bound<'py, PyAny>>) -> PyResult<Bound<'py, PyAny>> {
    let signal = py.import("signal")?;
    let handler = handler.map_or_else(|| signal.getattr("SIG_DFL"), Ok)?;
    signal.call_method1("signal", (signal.getattr("SIGINT")?, handler))
}

/// Converts a refusal to a Python exception: outside of a run a RuntimeError, within one the end of the process.
fn refusal(py: Python<'_>, error: &ProcessError) -> PyErr {
    if matches!(error, ProcessError::NoRun(_)) {
        return fault::run(error);
    }
    say(py, &format!("error: {error}"));
    PySystemExit::new_err(i32::from(error.exit_code()))
}

/// Reports at which frame an exception was raised; one before the first frame ends the process as one that could not be
/// initialised.
fn failed(py: Python<'_>, exception: &Bound<'_, PyAny>, frame: Option<u64>, begun: bool) -> PyResult<()> {
    let exits = exception.is_instance_of::<PySystemExit>();
    if let Some(frame) = frame {
        // Python prints the exception itself, unless it ends the program.
        let what = if exits { format!(" {}", exception.repr()?) } else { String::new() };
        say(py, &format!("error: at frame {frame}:{what}"));
    }
    if begun || exits {
        return Ok(());
    }
    py.import("traceback")?
        .call_method1("print_exception", (exception.get_type(), exception, exception.getattr("__traceback__")?))?;
    Err(PySystemExit::new_err(REFUSED))
}

/// Writes a line to standard error; a failed write is ignored.
fn say(py: Python<'_>, line: &str) {
    py.detach(|| writeln!(stderr(), "{line}").ok());
}
