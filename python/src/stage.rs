//! Stages in Python: the program iterates over its messages in a loop of its own, and behaves like a stage in Rust.

use crate::fault;
use crate::joined::{self, Inputs, Joined, PlaceInRun};
use crate::message::{Lender, Message};
use crate::payload::{HeaderChange, Payload};
use conicflow_dataflow::ports::Polled;
use conicflow_dataflow::{ItemType, PulledStage, join_as_stage};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::time::Duration;

/// Maximum time between checks for Python signals.
const INTERRUPT_CHECK_PERIOD: Duration = Duration::from_millis(100);

/// A stage of a pipeline, made by `conicflow.stage()`.
///
/// with conicflow.stage() as stage:
///     for message in stage:
///         stage.send([each for each in message.items if each.kind == "sphere"])
///
/// The loop ends at the end of the input, when the run ends, and when the stage is replaced. If the loop raises an exception, the
/// stage is restarted as the pipeline file says; an exception before the first message ends the run. A message without a `send`
/// results in an empty list.
#[pyclass(frozen, extends = Joined, module = "conicflow")]
pub(crate) struct Stage {
    pulled: PlaceInRun<PulledStage>,
    topic: String,
    item: Option<ItemType>,
    lender: Lender,
    inputs: Inputs,
}

/// Joins the run as the stage whose `program` `conicflow run` has started as this process.
///
/// same_frame: the further `inputs` whose message of the same frame is wanted; for the others it is the latest message.
#[pyfunction]
#[pyo3(signature = (*, same_frame = Vec::new()))]
pub(crate) fn stage(py: Python<'_>, same_frame: Vec<String>) -> PyResult<Bound<'_, Stage>> {
    let pulled = joined::join(py, || join_as_stage(&same_frame))?;
    let joined = Joined::new(py, pulled.as_ref().map(|pulled| (pulled.context(), pulled.parameters())))?;
    let (topic, item) = pulled
        .as_ref()
        .map(|pulled| pulled.input())
        .map_or((String::new(), None), |(topic, item)| (topic.to_owned(), Some(item.clone())));
    let (lender, inputs) = (Lender::default(), Inputs::default());
    Bound::new(py, (Stage { pulled: PlaceInRun::new(pulled), topic, item, lender, inputs }, joined))
}

#[pymethods]
impl Stage {
    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, Message>>> {
        if self.item.as_ref().is_some_and(ItemType::is_image) {
            self.lender.look(&self.topic)?;
        }
        loop {
            py.check_signals()?;
            let polled = py.detach(|| match &mut *self.pulled.lock()? {
                Some(pulled) => pulled.pull(INTERRUPT_CHECK_PERIOD).map_err(|error| fault::run(&error)),
                None => Ok(Polled::Over),
            })?;
            match (polled, &self.item) {
                (Polled::Pending, _) => {}
                (Polled::Message((message, received_ns)), Some(item)) => {
                    let message = Message::new(py, &self.topic, item, message, received_ns, &self.lender)?;
                    let found = self.pulled.lock()?.as_ref().map(|pulled| joined::found(pulled.side_inputs()));
                    self.inputs.add_all(message.get().inputs(py), found.unwrap_or_default(), received_ns)?;
                    return Ok(Some(message));
                }
                _ => return Ok(None),
            }
        }
    }

    /// Sends the result for the message: a list of records, a NumPy array of `dtype`, a message as received, or a depth image.
    ///
    /// The header is that of the message, except for keyword arguments: camera, scale, noise, stamp_ns, source, sequence,
    /// world_from_camera. Waits while a lossless reader has no room. Raises ValueError for items that no reader would accept.
    #[pyo3(signature = (items, **header))]
    fn send(slf: &Bound<'_, Self>, items: &Bound<'_, PyAny>, header: Option<&Bound<'_, PyDict>>) -> PyResult<()> {
        let Some(output) = &slf.as_super().get().context.output else {
            return Err(fault::value("this stage has no `output` in the pipeline file", "name a topic there"));
        };
        let (payload, change) = (Payload::new(output, items)?, HeaderChange::new(header)?);
        let stage = slf.get();
        slf.py().detach(|| match &mut *stage.pulled.lock()? {
            Some(pulled) => pulled
                .send(|header| change.apply(header, &payload), &payload.bytes)
                .map_err(|error| fault::from_error(&error)),
            None => Ok(()),
        })
    }

    /// Adds to a counter that `conicflow top` shows, and the summary with `--log debug` or where nothing was found.
    #[pyo3(signature = (name, times = None), text_signature = "($self, name, times=1)")]
    fn count(&self, py: Python<'_>, name: &str, times: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        self.pulled.count(py, name, times)
    }

    #[pyo3(signature = (kind, exception, _traceback))]
    fn __exit__(
        &self,
        py: Python<'_>,
        kind: &Bound<'_, PyAny>,
        exception: &Bound<'_, PyAny>,
        _traceback: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        self.pulled.leave(py, kind, exception)
    }
}
