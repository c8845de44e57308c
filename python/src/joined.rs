//! What stages and sources in Python have in common: what they are told, their further inputs, and how they fail.

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

/// Exit code of a stage that could not be made ready: to start it anew would not help.
const REFUSED: i32 = 2;

/// What a stage or a source has in Python whatever it makes: its place in the run.
#[pyclass(frozen, subclass, name = "Joined", module = "conicflow")]
pub(crate) struct Joined {
    pub(crate) context: Context,
    stop: Owned<Stop>,
    base: String,
    parameters: Py<PyAny>,
}

impl Joined {
    /// One that is told this when it starts; one that is not wanted any more is told nothing.
    pub(crate) fn new(py: Python<'_>, told: Option<(&Context, &serde_json::Value)>) -> PyResult<Self> {
        let (context, parameters) = match told {
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
    /// Its name in the pipeline file.
    #[getter]
    fn name(&self) -> &str {
        &self.context.stage
    }

    /// Its parameters: all keys of its table in the pipeline file that are not conicflow's own.
    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> Bound<'py, PyAny> {
        self.parameters.bind(py).clone()
    }

    /// Folder of the pipeline file, against which relative paths are meant.
    #[getter]
    fn base(&self) -> &str {
        &self.base
    }

    /// Messages that it took, as a source sent, before it was started anew in the same run; 0 at first.
    #[getter]
    fn resume_at(&self) -> u64 {
        self.context.resume_at
    }

    /// Whether the run is to end. What may take seconds or waits for a device asks now and then: who asks lives.
    #[getter]
    fn stopping(&self) -> PyResult<bool> {
        Ok(self.stop.expect("stage")?.requested())
    }

    /// The layout of the items that it sends, for numpy.zeros(n, dtype=stage.dtype); None where it has no output.
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

/// What fills the place of a stage or a source.
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

/// A place in the run, until it is left; one that is not wanted any more has none.
pub(crate) struct PlaceInRun<T>(Owned<Mutex<Option<T>>>);

impl<T: Pulls> PlaceInRun<T> {
    pub(crate) fn new(pulled: Option<T>) -> Self {
        Self(Owned::new(Mutex::new(pulled)))
    }

    /// What fills it; an error in a process that was forked from the one that joined the run.
    pub(crate) fn lock(&self) -> PyResult<MutexGuard<'_, Option<T>>> {
        Ok(lock(self.0.expect("stage")?))
    }

    /// Adds to a counter.
    pub(crate) fn count(&self, py: Python<'_>, name: &str, times: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let hint = "counters only grow";
        let times = times.map_or(Ok(1), |times| argument::whole("times", times, u64::MAX, hint))?;
        py.detach(|| self.lock().map(|mut pulled| pulled.iter_mut().for_each(|pulled| pulled.count(name, times))))
    }

    /// Leaves it at the end of `with`: in order, or as one that failed. A process that was forked has nothing to leave.
    pub(crate) fn leave(&self, py: Python<'_>, kind: &Bound<'_, PyAny>, exception: &Bound<'_, PyAny>) -> PyResult<()> {
        let Some(pulled) = self.0.here().and_then(|_| self.lock().ok()?.take()) else { return Ok(()) };
        if kind.is_none() {
            return py.detach(|| pulled.end()).map_err(|error| fault::run(&error));
        }
        failed(py, exception, pulled.frame(), pulled.has_begun())
    }
}

/// What was found in a further input: its name, the message, and what that carries.
pub(crate) type Found = (String, RetainedMessage, ItemType);

/// What was found, to be shown when the stage is free again: Python may let another thread at it.
pub(crate) fn found<'a>(inputs: impl Iterator<Item = (&'a str, RetainedMessage, &'a ItemType)>) -> Vec<Found> {
    inputs.map(|(name, message, item)| (name.to_owned(), message, item.clone())).collect()
}

/// Lends the images of further inputs.
#[derive(Default)]
pub(crate) struct Inputs(Mutex<BTreeMap<String, Lender>>);

impl Inputs {
    /// Adds what was found to a dictionary, by the names of the inputs.
    pub(crate) fn add_all(&self, all: &Bound<'_, PyDict>, found: Vec<Found>, received_ns: u64) -> PyResult<()> {
        for (name, message, item) in found {
            let lender = lock(&self.0).entry(name.clone()).or_default().clone();
            all.set_item(&name, Message::new(all.py(), &name, &item, message, received_ns, &lender)?)?;
        }
        Ok(())
    }
}

/// Joins the run, which from then on tells this process when to end: Python would raise KeyboardInterrupt in the midst of a step.
/// A process that has no place keeps its own way to be interrupted.
pub(crate) fn join<T: Send>(py: Python<'_>, join: impl FnOnce() -> Result<T, ProcessError> + Send) -> PyResult<T> {
    // Signals reach only the main thread; where this is another, somebody else has a say in them.
    let before = be_interrupted_by(py, None).ok();
    py.detach(join).map_err(|error| {
        before.map(|before| be_interrupted_by(py, Some(before)));
        refusal(py, &error)
    })
}

/// Lets SIGINT be handled so, or as the system does; how it was before.
fn be_interrupted_by<'py>(py: Python<'py>, handler: Option<Bound<'py, PyAny>>) -> PyResult<Bound<'py, PyAny>> {
    let signal = py.import("signal")?;
    let handler = handler.map_or_else(|| signal.getattr("SIG_DFL"), Ok)?;
    signal.call_method1("signal", (signal.getattr("SIGINT")?, handler))
}

/// How a process learns that it has no place: outside of a run by an exception, within one it ends as any stage does.
fn refusal(py: Python<'_>, error: &ProcessError) -> PyErr {
    if matches!(error, ProcessError::NoRun(_)) {
        return fault::run(error);
    }
    say(py, &format!("error: {error}"));
    PySystemExit::new_err(i32::from(error.exit_code()))
}

/// Tells of an exception at which frame it was raised; one before the first frame ends the process as one that could not be made
/// ready.
fn failed(py: Python<'_>, exception: &Bound<'_, PyAny>, frame: Option<u64>, begun: bool) -> PyResult<()> {
    let exits = exception.is_instance_of::<PySystemExit>();
    if let Some(frame) = frame {
        // Python shows the exception itself, unless it ends the program.
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

/// Writes a line where errors go; whether anybody reads it is not the stage's concern.
fn say(py: Python<'_>, line: &str) {
    py.detach(|| writeln!(stderr(), "{line}").ok());
}
