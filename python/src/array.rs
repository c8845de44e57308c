//! NumPy arrays of messages: read-only views of images and lists in memory, and the layouts of items.

#![allow(unsafe_code)] // NumPy borrows memory of a Python object

use crate::fault;
use crate::message::Message;
use bytemuck::try_cast_slice;
use conicflow_dataflow::pipeline::suggestion;
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_messages::{Ellipse, Item, Object, ObjectSigma, Track, Velocity};
use numpy::ndarray::{ArrayView, ArrayView1, ArrayView2, Dimension};
use numpy::{Element, PyArray, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyTuple};
use std::mem::offset_of;

/// Returns the items of a message as an array with their layout; an image has rows and columns. The array is read-only, and keeps
/// the message alive while it or any view of it exists.
pub(crate) fn of_message<'py>(message: &Bound<'py, Message>) -> PyResult<Bound<'py, PyAny>> {
    let (item, bytes) = (message.get().item(), message.get().bytes()?);
    if item.is_image() {
        let camera = &message.get().header().camera;
        let shape = (camera.height as usize, camera.width as usize);
        let pixels = try_cast_slice::<_, u16>(bytes).unwrap_or_default();
        let pixels = ArrayView2::from_shape(shape, pixels).map_err(|error| fault::from_error(&error))?;
        return Ok(lent(&pixels, message)?.into_any());
    }
    let bytes = lent(&ArrayView1::from(bytes), message)?;
    bytes.call_method1("view", (dtype(message.py(), item)?,))
}

/// Returns the items in a message as a read-only array.
fn lent<'py, T: Element, D: Dimension>(
    items: &ArrayView<'_, T, D>,
    message: &Bound<'py, Message>,
) -> PyResult<Bound<'py, PyArray<T, D>>> {
    // SAFETY: the items belong to the message, which is the base of the array and kept alive by it; they neither move nor change
    // before it is dropped. The base has no writable buffer, so NumPy cannot make the array writable again.
    let array = unsafe { PyArray::borrow_from_array(items, message.clone().into_any()) };
    let locked = array.try_readwrite().map_err(|error| fault::from_error(&error))?;
    drop(locked.make_nonwriteable());
    Ok(array)
}

/// Returns the layout of the items "depth", "ellipses", "objects", "tracks" or "velocities", for numpy.zeros(n, dtype=..);
/// metres, radians and seconds.
#[pyfunction]
#[pyo3(name = "dtype")]
pub(crate) fn dtype_of<'py>(py: Python<'py>, kind: &str) -> PyResult<Bound<'py, PyAny>> {
    dtype(py, called(kind)?)
}

/// Returns the built-in item type of this name.
pub(crate) fn called(kind: &str) -> PyResult<&'static ItemType> {
    BUILT_IN.iter().find(|row| row.name() == kind).ok_or_else(|| {
        let hint = suggestion(kind, BUILT_IN.iter().map(ItemType::name), "kinds");
        fault::value(format!("no items are called `{kind}`"), hint)
    })
}

/// Returns the NumPy dtype of items.
pub(crate) fn dtype<'py>(py: Python<'py>, item: &ItemType) -> PyResult<Bound<'py, PyAny>> {
    match item.name() {
        u16::NAME => u16::dtype(py),
        _ if !item.is_built_in() => described(py, item),
        Object::NAME => Object::dtype(py),
        Track::NAME => Track::dtype(py),
        Ellipse::NAME => Ellipse::dtype(py),
        _ => Velocity::dtype(py),
    }
}

/// Returns the dtype of items that the pipeline file describes: fields without padding.
fn described<'py>(py: Python<'py>, item: &ItemType) -> PyResult<Bound<'py, PyAny>> {
    let fields = PyList::empty(py);
    for field in item.described_layout().into_iter().flat_map(|layout| layout.fields()) {
        let (element, count) = field.type_text.split_once('[').unwrap_or((&field.type_text, ""));
        let count = count.trim_end_matches(']').trim();
        let code = match element.trim() {
            "text" => format!("S{count}"),
            // NumPy's name of `f64` is `f8`.
            number => format!("{count}{}{}", &number[..1], number[1..].parse::<usize>().unwrap_or(8) / 8),
        };
        fields.append((&field.name, code))?;
    }
    py.import("numpy")?.call_method1("dtype", (fields,))
}

/// A type with a NumPy dtype.
trait Typed {
    fn dtype(py: Python<'_>) -> PyResult<Bound<'_, PyAny>>;
}

type Dtype = for<'py> fn(Python<'py>) -> PyResult<Bound<'py, PyAny>>;

/// Returns the dtype function of a field's type.
const fn field<S, F: Typed>(_: fn(&S) -> &F) -> Dtype {
    F::dtype
}

impl<T: Typed, const N: usize> Typed for [T; N] {
    fn dtype(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        let item = T::dtype(py)?;
        let shape = PyTuple::new(py, [N])?.add(item.getattr("shape")?)?;
        py.import("numpy")?.call_method1("dtype", ((item.getattr("base")?, shape),))
    }
}

macro_rules! numbers {
    ($($number:ty),+) => {$(
        impl Typed for $number {
            fn dtype(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
                Ok(numpy::dtype::<$number>(py).into_any())
            }
        }
    )+};
}

numbers!(u16, u32, u64, f32, f64);

/// Implements `Typed` for structs, with the fields at the compiler's offsets.
macro_rules! structs {
    ($($type:ty: $($name:ident),+;)+) => {$(
        impl Typed for $type {
            fn dtype(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
                let fields = [$((stringify!($name), offset_of!($type, $name), field(|item: &$type| &item.$name))),+];
                struct_dtype(py, size_of::<$type>(), &fields)
            }
        }
    )+};
}

structs! {
    ObjectSigma: center, axis, radius, length, half_angle;
    Object: kind, points, rows, confidence, center, axis, radius, length, half_angle, base_radius, top_radius, apex, sigma, rms, arc;
    Track: id, state, age, misses, reserved, object, velocity, velocity_covariance;
    Ellipse: scan, line, first, last, points, beyond_px, unbiased, line_step, center, plane_center, semi_axes, angle, half_width,
        half_depth, rms, arc, sigma, correlation_px, shared_lines, averaged_lines, beyond, contour, ends, origin, moments;
    Velocity: linear, angular, frame, reserved;
}

fn struct_dtype<'py>(
    py: Python<'py>,
    size: usize,
    fields: &[(&'static str, usize, Dtype)],
) -> PyResult<Bound<'py, PyAny>> {
    let formats = fields.iter().map(|(.., dtype)| dtype(py)).collect::<PyResult<Vec<_>>>()?;
    let layout = PyDict::new(py);
    layout.set_item("names", fields.iter().map(|(name, ..)| *name).collect::<Vec<_>>())?;
    layout.set_item("formats", formats)?;
    layout.set_item("offsets", fields.iter().map(|(_, offset, _)| *offset).collect::<Vec<_>>())?;
    layout.set_item("itemsize", size)?;
    py.import("numpy")?.call_method1("dtype", (layout,))
}
