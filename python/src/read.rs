//! Live topics of a pipeline that runs on this machine, read as an onlooker, for whom no writer waits.

use crate::message::{Lender, Message};
use crate::owned::Owned;
use crate::{argument, fault};
use conicflow_dataflow::ports::Polled;
use conicflow_dataflow::{
    DEFAULT_LOG, ItemType, LOG, Requirements, RunningPipeline, Watcher, lock, log_to_standard_error, monotonic_ns,
};
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Pause between polls without a message.
const POLL_PERIOD: Duration = Duration::from_millis(1);
/// Maximum time between checks for KeyboardInterrupt.
const INTERRUPT_CHECK_PERIOD: Duration = Duration::from_millis(50);

/// An iterator over the messages of topics of a running pipeline, from now on, until the run is over.
#[pyclass(frozen, module = "conicflow")]
pub(crate) struct Reader {
    watcher: Owned<Mutex<Option<Watcher>>>,
    topics: Vec<(String, ItemType, Lender)>,
}

/// Reads the messages of topics of a pipeline that runs on this machine, from now on, until the run is over.
///
/// topics: one name or several; `conicflow topic list` shows them.
/// pipeline: the name of the pipeline, if several run.
///
/// It is an onlooker: no stage waits for it or does more than pass it a pointer, and a slow reader loses messages. Iterating
/// yields each message as a `Message`. Raises RuntimeError with a hint if there is no such pipeline or topic.
#[pyfunction]
#[pyo3(signature = (*topics, pipeline = None))]
pub(crate) fn read(py: Python<'_>, topics: &Bound<'_, PyTuple>, pipeline: Option<&str>) -> PyResult<Reader> {
    let hint = "give each topic by its name: read(\"depth\", \"objects\")";
    let names: Vec<String> =
        topics.iter().map(|topic| argument::word("topic", &topic, hint)).collect::<PyResult<_>>()?;
    if names.is_empty() {
        return Err(fault::kind("read() got no topic", "name one, such as read(\"objects\")"));
    }
    log_to_standard_error(&std::env::var(LOG).unwrap_or_else(|_| DEFAULT_LOG.to_owned()));
    py.detach(|| {
        let running = RunningPipeline::find(pipeline, "pipeline=\"NAME\"").map_err(|error| fault::run(&error))?;
        let requirements = Requirements::of(&running.plan, &[]);
        let mut watched = Vec::new();
        for name in &names {
            let topic = running.expect_topic(name).map_err(|error| fault::run(&error))?;
            requirements.look_for_onlooker(topic).map_err(|error| fault::run(&error))?;
            watched.push((topic.expect_item().map_err(|error| fault::run(&error))?, topic));
        }
        let watcher = Watcher::new(&running, &watched).map_err(|error| fault::run(&error))?;
        let topics = watched.iter().map(|(item, topic)| (topic.name.clone(), (*item).clone(), Lender::default()));
        Ok(Reader { topics: topics.collect(), watcher: Owned::new(Mutex::new(Some(watcher))) })
    })
}

#[pymethods]
impl Reader {
    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, Message>>> {
        let watcher = self.watcher.expect("reader")?;
        for (topic, item, lender) in &self.topics {
            if item.is_image() {
                lender.look(topic)?;
            }
        }
        loop {
            py.check_signals()?;
            let polled = py.detach(|| {
                let mut watcher = lock(watcher);
                let Some(watcher) = &mut *watcher else { return Ok(Polled::Over) };
                let deadline = Instant::now() + INTERRUPT_CHECK_PERIOD;
                loop {
                    match watcher.poll().map_err(|error| fault::run(&error))? {
                        Polled::Pending if Instant::now() < deadline => sleep(POLL_PERIOD),
                        polled => return Ok::<_, PyErr>(polled),
                    }
                }
            })?;
            match polled {
                Polled::Pending => {}
                Polled::Over => {
                    self.close();
                    return Ok(None);
                }
                Polled::Message((index, message)) => {
                    let (topic, item, lender) = &self.topics[index];
                    return Message::new(py, topic, item, Arc::new(message), monotonic_ns(), lender).map(Some);
                }
            }
        }
    }

    /// Stops reading; received messages stay valid. Does nothing in a forked process.
    fn close(&self) {
        if let Some(watcher) = self.watcher.here() {
            lock(watcher).take();
        }
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.close();
    }
}
