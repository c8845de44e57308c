//! NumPy arrays of messages: images and lists as they lie in memory, which cannot be written, and the layout of items.

#![allow(unsafe_code)] // NumPy is lent memory that belongs to a Python object

use crate::fault;
use crate::message::Message;
use bytemuck::try_cast_slice;
use conicflow_dataflow::pipeline::suggestion;
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_messages::{Ellipse, Item, Object, ObjectSigma, Track, Velocity};
use numpy::ndarray::{ArrayView, ArrayView1, ArrayView2, Dimension};
use numpy::{Element, PyArray, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use std::mem::offset_of;

/// The items of a message as an array of their layout, an image with its rows and columns. It cannot be written, and keeps the
/// message alive as long as it, or any view of it, lives.
pub(crate) fn of_message<'py>(message: &Bound<'py, Message>) -> PyResult<Bound<'py, PyAny>> {
    let (item, bytes) = (message.get().item(), message.get().bytes());
    if item.is_image() {
        let camera = &message.get().header().camera;
        let shape = (camera.height as usize, camera.width as usize);
        let pixels = try_cast_slice::<_, u16>(bytes).unwrap_or_default();
        let pixels = ArrayView2::from_shape(shape, pixels).map_err(|error| fault::told(&error))?;
        return Ok(lent(&pixels, message)?.into_any());
    }
    let bytes = lent(&ArrayView1::from(bytes), message)?;
    bytes.call_method1("view", (dtype(message.py(), item)?,))
}

/// What lies in a message as an array that cannot be written.
fn lent<'py, T: Element, D: Dimension>(
    items: &ArrayView<'_, T, D>,
    message: &Bound<'py, Message>,
) -> PyResult<Bound<'py, PyArray<T, D>>> {
    // SAFETY: the items are those of the message, which is the base of the array, which holds it; they neither move nor change
    // before it is gone. Without a buffer of its own to write it gives NumPy no leave to make the array writable again.
    let array = unsafe { PyArray::borrow_from_array(items, message.clone().into_any()) };
    let locked = array.try_readwrite().map_err(|error| fault::told(&error))?;
    drop(locked.make_nonwriteable());
    Ok(array)
}

/// The layout of the items "depth", "ellipses", "objects", "tracks" or "velocities", for numpy.zeros(n, dtype=..); metres, radians
/// and seconds.
#[pyfunction]
#[pyo3(name = "dtype")]
pub(crate) fn dtype_of<'py>(py: Python<'py>, kind: &str) -> PyResult<Bound<'py, PyAny>> {
    let Some(item) = BUILT_IN.iter().find(|row| row.name() == kind) else {
        let hint = suggestion(kind, BUILT_IN.iter().map(ItemType::name), "kinds");
        return Err(fault::value(format!("no items are called `{kind}`"), hint));
    };
    dtype(py, item)
}

/// The layout of items, as NumPy knows it.
pub(crate) fn dtype<'py>(py: Python<'py>, item: &ItemType) -> PyResult<Bound<'py, PyAny>> {
    let layout = match item.name() {
        u16::NAME => return py.import("numpy")?.call_method1("dtype", ("u2",)),
        _ if !item.is_built_in() => return described(py, item),
        Object::NAME => &OBJECT,
        Track::NAME => &TRACK,
        Ellipse::NAME => &ELLIPSE,
        _ => &VELOCITY,
    };
    layout.dtype(py)
}

/// The layout of items that the pipeline file describes: fields without holes between them.
fn described<'py>(py: Python<'py>, item: &ItemType) -> PyResult<Bound<'py, PyAny>> {
    let fields = PyList::empty(py);
    for field in item.described_layout().into_iter().flat_map(|layout| layout.fields()) {
        let (element, count) = field.type_text.split_once('[').unwrap_or((&field.type_text, ""));
        let count = count.trim_end_matches(']').trim();
        let code = match element.trim() {
            "text" => format!("S{count}"),
            // `f64` is `f8` there.
            number => format!("{count}{}{}", &number[..1], number[1..].parse::<usize>().unwrap_or(8) / 8),
        };
        fields.append((&field.name, code))?;
    }
    py.import("numpy")?.call_method1("dtype", (fields,))
}

/// The layout of a struct.
struct Layout {
    size: usize,
    fields: &'static [(&'static str, usize, Code)],
}

/// What a field is.
enum Code {
    /// In NumPy's words.
    Plain(&'static str),
    /// A struct.
    Nested(&'static Layout),
}

use Code::{Nested, Plain};

impl Layout {
    fn dtype<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (names, formats, offsets) = (PyList::empty(py), PyList::empty(py), PyList::empty(py));
        for (name, offset, code) in self.fields {
            names.append(name)?;
            offsets.append(offset)?;
            match code {
                Plain(code) => formats.append(code)?,
                Nested(layout) => formats.append(layout.dtype(py)?)?,
            }
        }
        let layout = PyDict::new(py);
        layout.set_item("names", names)?;
        layout.set_item("formats", formats)?;
        layout.set_item("offsets", offsets)?;
        layout.set_item("itemsize", self.size)?;
        py.import("numpy")?.call_method1("dtype", (layout,))
    }
}

/// The layout of a struct by its fields, each where the compiler puts it.
macro_rules! layout {
    ($type:ty: $($field:ident = $code:expr),+ $(,)?) => {
        Layout { size: size_of::<$type>(), fields: &[$((stringify!($field), offset_of!($type, $field), $code)),+] }
    };
}

static SIGMA: Layout = layout!(ObjectSigma:
    center = Plain("(3,3)f8"),
    axis = Plain("f8"),
    radius = Plain("f8"),
    length = Plain("f8"),
    half_angle = Plain("f8"),
);

static OBJECT: Layout = layout!(Object:
    kind = Plain("u4"),
    points = Plain("u4"),
    rows = Plain("u4"),
    confidence = Plain("f4"),
    center = Plain("3f8"),
    axis = Plain("3f8"),
    radius = Plain("f8"),
    length = Plain("f8"),
    half_angle = Plain("f8"),
    base_radius = Plain("f8"),
    top_radius = Plain("f8"),
    apex = Plain("3f8"),
    sigma = Nested(&SIGMA),
    rms = Plain("f8"),
    arc = Plain("f8"),
);

static TRACK: Layout = layout!(Track:
    id = Plain("u8"),
    state = Plain("u4"),
    age = Plain("u4"),
    misses = Plain("u4"),
    reserved = Plain("u4"),
    object = Nested(&OBJECT),
    velocity = Plain("3f8"),
    velocity_covariance = Plain("(3,3)f8"),
);

static ELLIPSE: Layout = layout!(Ellipse:
    scan = Plain("u4"),
    line = Plain("u4"),
    first = Plain("u4"),
    last = Plain("u4"),
    points = Plain("u4"),
    beyond_px = Plain("u4"),
    unbiased = Plain("u4"),
    line_step = Plain("u4"),
    center = Plain("3f8"),
    plane_center = Plain("2f8"),
    semi_axes = Plain("2f8"),
    angle = Plain("f8"),
    half_width = Plain("f8"),
    half_depth = Plain("f8"),
    rms = Plain("f8"),
    arc = Plain("f8"),
    sigma = Plain("f8"),
    shared_px = Plain("f8"),
    shared_lines = Plain("f8"),
    beyond = Plain("2f8"),
    contour = Plain("2f8"),
    ends = Plain("(2,2)f8"),
    origin = Plain("2f8"),
    moments = Plain("15f8"),
);

static VELOCITY: Layout = layout!(Velocity:
    linear = Plain("3f8"),
    angular = Plain("3f8"),
    frame = Plain("u4"),
    reserved = Plain("u4"),
);
