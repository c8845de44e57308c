//! Messages as Python objects. A list is copied, because it is short; an image is lent in shared memory, for as long as the
//! message or any array of it lives. The number of lent images is limited, because a writer's memory is.

use crate::owned::Owned;
use crate::{array, fault, record};
use bytemuck::{cast_slice, cast_slice_mut};
use conicflow_dataflow::{AnyMessage, ItemType, RetainedMessage};
use conicflow_messages::{Header, Hinted};
use pyo3::exceptions::PyBufferError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyDict, PyList};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Maximum number of images of one topic that a program may hold, including the one it asks for.
const MOST_LENT: usize = 4;

/// Lends the images of one topic.
#[derive(Clone, Default)]
pub(crate) struct Lender(Arc<Lent>);

/// The number of images that are lent.
#[derive(Default)]
struct Lent(AtomicUsize);

/// Counts one image while it is lent.
struct Loan(Arc<Lent>);

impl Drop for Loan {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Lender {
    /// Checks that one more image can be lent.
    pub(crate) fn look(&self, topic: &str) -> PyResult<()> {
        let lent = self.0.0.load(Ordering::Relaxed);
        if lent < MOST_LENT {
            return Ok(());
        }
        let what = format!("{lent} images of topic `{topic}` are still held, which is as many as can be");
        let hint = "keep copies (message.image.copy()), and let go of messages and arrays that you are done with";
        Err(PyBufferError::new_err(Hinted::new(what, hint).to_string()))
    }

    fn lend(&self) -> Loan {
        self.0.0.fetch_add(1, Ordering::Relaxed);
        Loan(Arc::clone(&self.0))
    }
}

/// One message of a topic: the time and the camera of its frame, and its items.
///
/// A list is copied. An image is lent: `image` lies in shared memory, is read-only, and only a few can be held at a time; keep
/// copies of more. It is lent to this process only: a forked child, such as one of `multiprocessing`, needs a copy,
/// `message.image.copy()`. An array that it inherits without a copy shows other images later.
#[pyclass(frozen, module = "conicflow")]
pub(crate) struct Message {
    header: Header,
    item: ItemType,
    /// The name of its topic.
    #[pyo3(get)]
    topic: String,
    /// Time from when the source had the frame until the message came, in milliseconds; None if unknown.
    #[pyo3(get)]
    latency_ms: Option<f64>,
    content: Content,
    number: usize,
    /// For a message that drives a stage: the messages of the further inputs that belong to it, by input name; each may be
    /// missing.
    #[pyo3(get)]
    inputs: Py<PyDict>,
    items: PyOnceLock<Py<PyList>>,
}

/// The bytes of a message.
enum Content {
    /// In the memory of its writer.
    Lent(Owned<(RetainedMessage, Loan)>),
    /// In this process, aligned for any item type.
    Own { words: Box<[u64]>, length: usize },
}

impl Message {
    /// Converts a message of `topic` that was received at `received_ns` on the monotonic clock.
    pub(crate) fn new<'py>(
        py: Python<'py>,
        topic: &str,
        item: &ItemType,
        message: RetainedMessage,
        received_ns: u64,
        lender: &Lender,
    ) -> PyResult<Bound<'py, Self>> {
        let (header, number) = (*message.header(), message.bytes().len() / item.size());
        let content = if item.is_image() {
            lender.look(topic)?;
            Content::Lent(Owned::new((message, lender.lend())))
        } else {
            let length = message.bytes().len();
            let mut words = vec![0_u64; length.div_ceil(size_of::<u64>())];
            cast_slice_mut(&mut words)[..length].copy_from_slice(message.bytes());
            Content::Own { words: words.into(), length }
        };
        let (item, topic) = (item.clone(), topic.to_owned());
        let latency_ms = header.latency_ms(received_ns);
        let inputs = PyDict::new(py).unbind();
        Bound::new(py, Self { header, item, topic, latency_ms, content, number, inputs, items: PyOnceLock::new() })
    }

    pub(crate) fn header(&self) -> &Header {
        &self.header
    }

    pub(crate) fn item(&self) -> &ItemType {
        &self.item
    }

    /// The bytes of the items; an error if they are lent to another process.
    pub(crate) fn bytes(&self) -> PyResult<&[u8]> {
        match &self.content {
            Content::Lent(lent) => lent.here().map(|(message, _)| message.bytes()).ok_or_else(|| {
                let what = "this image was lent to another process, from which this one was forked";
                let hint = "give a child a copy, message.image.copy(), or let it read the topic itself";
                PyBufferError::new_err(Hinted::new(what, hint).to_string())
            }),
            Content::Own { words, length } => Ok(&cast_slice(words)[..*length]),
        }
    }

    /// The messages of the further inputs.
    pub(crate) fn inputs<'a, 'py>(&'a self, py: Python<'py>) -> &'a Bound<'py, PyDict> {
        self.inputs.bind(py)
    }
}

#[pymethods]
impl Message {
    /// The item type: "depth", "ellipses", "objects", "tracks", "velocities", or the name of an item type of the file.
    #[getter]
    fn kind(&self) -> &str {
        self.item.name()
    }

    /// Number of the frame.
    #[getter]
    fn sequence(&self) -> u64 {
        self.header.sequence
    }

    /// Time of capture in nanoseconds.
    #[getter]
    fn stamp_ns(&self) -> u64 {
        self.header.stamp_ns
    }

    /// Name of the frame's file, or of its source.
    #[getter]
    fn source(&self) -> &str {
        self.header.source.as_str().unwrap_or_default()
    }

    /// Intrinsics of the camera: (fx, fy, cx, cy) in pixels.
    #[getter]
    fn camera(&self) -> (f64, f64, f64, f64) {
        let camera = &self.header.camera;
        (camera.fx, camera.fy, camera.cx, camera.cy)
    }

    /// (width, height) of the camera's images, in pixels.
    #[getter]
    fn size(&self) -> (u32, u32) {
        (self.header.camera.width, self.header.camera.height)
    }

    /// Metres per unit of a depth pixel.
    #[getter]
    fn scale(&self) -> f64 {
        self.header.depth_scale
    }

    /// The depth noise of the sensor: floor_m, growth_per_m, knee_m, step_per_m.
    #[getter]
    fn noise<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let noise = &self.header.noise;
        let coefficients = PyDict::new(py);
        for (name, value) in [
            ("floor_m", noise.floor_m),
            ("growth_per_m", noise.growth_per_m),
            ("knee_m", noise.knee_m),
            ("step_per_m", noise.step_per_m),
        ] {
            coefficients.set_item(name, value)?;
        }
        Ok(coefficients)
    }

    /// The camera's pose, three rows of `[R | t]` with t in metres; None if unknown.
    #[getter]
    fn world_from_camera(&self) -> Option<[[f64; 4]; 3]> {
        self.header.pose().copied()
    }

    /// The items as records; empty for an image.
    #[getter]
    fn items<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let items = self.items.get_or_try_init(py, || {
            let bytes = if self.item.is_image() { &[] } else { self.bytes()? };
            Ok::<_, PyErr>(record::list(py, &self.item, bytes)?.unbind())
        })?;
        Ok(items.bind(py).clone())
    }

    /// The items as a read-only NumPy array with their layout; for an image the same as `image`.
    #[getter]
    fn array<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        array::of_message(slf)
    }

    /// A depth image, rows and columns of `uint16` in units of `scale` metres; 0 and 65535: no measurement. It is not copied, and
    /// read-only. Give a child process a copy, `message.image.copy()`.
    #[getter]
    fn image<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        if slf.get().item.is_image() {
            return array::of_message(slf);
        }
        let what = format!("topic `{}` carries {}, no images", slf.get().topic, slf.get().item.name());
        Err(fault::kind(what, "its items are message.items, and message.array for NumPy"))
    }

    /// The line that `json_sink` writes for this message; for an image a summary.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut line = Vec::new();
        AnyMessage { header: &self.header, item: &self.item, bytes: self.bytes()? }
            .write_json(self.latency_ms, &mut line)
            .map_err(|error| fault::from_error(&error))?;
        py.import("json")?.call_method1("loads", (PyBytes::new(py, &line),))
    }

    /// Number of items; for an image, of pixels.
    fn __len__(&self) -> usize {
        self.number
    }

    /// A message is true even without items.
    fn __bool__(&self) -> bool {
        true
    }

    /// Refuses copies: the message is memory of this process, or lent to it.
    fn __reduce__(&self) -> PyResult<Py<PyAny>> {
        let hint = "pickle message.items, message.image.copy() or message.to_dict()";
        Err(fault::kind("a message cannot be copied or pickled", hint))
    }

    fn __repr__(&self) -> String {
        let (number, kind) = (self.number, self.item.name());
        format!("Message(topic='{}', sequence={}, {number} of {kind})", self.topic, self.header.sequence)
    }
}
