//! Sources in Python: the program sends its messages in a loop of its own, and behaves like a source in Rust.

use crate::fault;
use crate::joined::{self, Inputs, Joined, PlaceInRun};
use crate::payload::{HeaderChange, Payload};
use crate::settings;
use conicflow_dataflow::{PulledSource, join_as_source, monotonic_ns, report_frame, unix_ns};
use conicflow_messages::{Header, NoiseModel, Text};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::sync::atomic::{AtomicBool, Ordering};

/// A source of a pipeline, made by `conicflow.source()`.
///
/// with conicflow.source() as source:
///     for number in source:
///         source.send(camera.read(), camera=(fx, fy, cx, cy), scale=0.001, noise="realsense_d435")
///
/// Iterating yields the number of each frame when it is due by the parameter `rate_hz`, if there is one. It is the number of the
/// next message that is sent: if none is sent, the same number comes again. The loop ends when the run ends, when the wanted
/// number of frames is made, and when the source is replaced; the stream ends with the loop.
#[pyclass(frozen, extends = Joined, module = "conicflow")]
pub(crate) struct Source {
    pulled: PlaceInRun<PulledSource>,
    inputs: Inputs,
    /// Whether the size and depth of the images were logged.
    is_told: AtomicBool,
}

/// Joins the run as the source whose `program` `conicflow run` has started as this process.
///
/// total: total number of messages that it will send, if known.
#[pyfunction]
#[pyo3(signature = (*, total = None))]
pub(crate) fn source(py: Python<'_>, total: Option<u64>) -> PyResult<Bound<'_, Source>> {
    let pulled = joined::join(py, || join_as_source(total))?;
    let joined = Joined::new(py, pulled.as_ref().map(|pulled| (pulled.context(), pulled.parameters())))?;
    let is_told = AtomicBool::new(joined.context.resume_at > 0);
    Bound::new(py, (Source { pulled: PlaceInRun::new(pulled), inputs: Inputs::default(), is_told }, joined))
}

impl Source {
    /// The default header of a frame.
    fn header(name: &str) -> Header {
        let (noise, source) = (NoiseModel::KINECT_V1, Text::new(name));
        Header { depth_scale: 0.001, noise, stamp_ns: unix_ns(), source, ..Header::default() }
    }

    /// Logs once what the images are like, so that a wrong scale is noticed.
    fn tell(&self, name: &str, header: &Header, pixels: &[u16]) {
        let is_told = report_frame("images", name, &header.camera, header.depth_scale, pixels);
        self.is_told.fetch_or(is_told, Ordering::Relaxed);
    }
}

#[pymethods]
impl Source {
    /// The counters of this source before it was restarted.
    #[getter]
    fn counted<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyDict>> {
        let counted = PyDict::new(slf.py());
        for (name, times) in &slf.as_super().get().context.counted {
            counted.set_item(name, times)?;
        }
        Ok(counted)
    }

    /// The latest messages of the further inputs, by input name, as of the present frame; each may be missing.
    #[getter]
    fn inputs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = py.detach(|| {
            Ok::<_, PyErr>(self.pulled.lock()?.as_ref().map(|pulled| joined::found(pulled.side_inputs())))
        })?;
        let found = found.unwrap_or_default();
        let inputs = PyDict::new(py);
        self.inputs.add_all(&inputs, found, monotonic_ns())?;
        Ok(inputs)
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<u64>> {
        py.check_signals()?;
        py.detach(|| match &mut *self.pulled.lock()? {
            Some(pulled) => pulled.next_number().map_err(|error| fault::run(&error)),
            None => Ok(None),
        })
    }

    /// Sends a message: a depth image, a list of records, or a NumPy array of `dtype`.
    ///
    /// Keyword arguments: camera (fx, fy, cx, cy), required for depth images; scale, metres per unit, default 0.001; noise,
    /// default "kinect_v1"; stamp_ns, default now; source, its name; sequence, a frame number of its own, which has to rise;
    /// world_from_camera. Waits while a lossless reader has no room. Raises ValueError for items that no reader would accept.
    #[pyo3(signature = (items, **header))]
    fn send(slf: &Bound<'_, Self>, items: &Bound<'_, PyAny>, header: Option<&Bound<'_, PyDict>>) -> PyResult<()> {
        let (source, context) = (slf.get(), &slf.as_super().get().context);
        let Some(output) = &context.output else { return Ok(()) };
        let (payload, change) = (Payload::new(output, items)?, HeaderChange::new(header)?);
        let mut header = Self::header(&context.stage);
        let wanted = change.sequence();
        change.apply(&mut header, &payload);
        if output.is_image() && !header.camera.has_intrinsics() {
            return Err(fault::value("a depth image needs its camera", settings::CAMERA));
        }
        slf.py().detach(|| match &mut *source.pulled.lock()? {
            Some(pulled) => {
                let next = pulled.sequence();
                if let Some(wanted) = wanted.filter(|wanted| *wanted < next) {
                    let what = format!("`sequence` is {wanted}, but numbers of frames rise");
                    return Err(fault::value(what, format!("give {next} or more, or none")));
                }
                pulled.send(header, &payload.bytes).map_err(|error| fault::from_error(&error))?;
                if output.is_image() && !source.is_told.load(Ordering::Relaxed) {
                    source.tell(&context.stage, &header, bytemuck::cast_slice(&payload.bytes));
                }
                Ok(())
            }
            None => Ok(()),
        })
    }

    /// Adds to a counter that the summary of the run shows.
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
