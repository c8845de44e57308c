//! Items as Python objects, with the keys of their line of JSON as attributes.
//!
//! A record keeps the item itself, so that it can be tracked or sent on bit for bit. Its attributes are read by Python's JSON
//! reader from what [`AnyMessage::write_json`] writes.

use crate::fault;
use bytemuck::{bytes_of, cast_slice, cast_slice_mut, pod_read_unaligned};
use conicflow_dataflow::{AnyMessage, BUILT_IN, ItemType};
use conicflow_messages::{
    COARSEST_SCALE, Camera, Ellipse, Header, Item, Object, ObjectKind, Scan, ToJson, Track, Velocity,
};
use numpy::IntoPyArray;
use numpy::ndarray::arr2;
use pyo3::exceptions::PyAttributeError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyDict, PyList, PyString, PyTuple};

/// One item of a message. Its attributes are the keys that `json_sink` writes; keys that only other shapes have are None.
#[pyclass(frozen, subclass, module = "conicflow")]
pub(crate) struct Record {
    item: ItemType,
    /// Its bytes, aligned for any item type.
    words: Box<[u64]>,
    shown: PyOnceLock<Py<PyDict>>,
}

/// A sphere, cylinder or cone in the camera frame (x right, y down, z forward); attributes that only other shapes have are None.
///
/// kind: "sphere", "cylinder" or "cone"; in arrays 0, 1 or 2.
/// center: [x, y, z] of a sphere; for others the middle of the visible part, on the axis; metres.
/// radius: metres; None for a cone.
/// axis: unit vector; for a cone from the apex to the base; None for a sphere.
/// length: of the visible part along the axis, metres; None for a sphere.
/// apex, half_angle, base_radius, top_radius: of a cone, metres and radians; the radii at the wide and the narrow end of the
///     visible part.
/// sigma: standard deviations: center [x, y, z], radius (of a cone at its center) and length in metres, axis and half_angle in
///     radians.
/// covariance: of the center, NumPy array 3x3, square metres.
/// rms: root mean square distance of the points from the surface in excess of the noise, metres.
/// points, rows: measurements and scan lines that support it.
/// arc: visible part of the circumference, radians.
/// confidence: probability that it is an object of this shape; None if the method does not estimate it.
#[pyclass(frozen, extends = Record, name = "Object", module = "conicflow")]
struct PyObjectRecord;

#[pymethods]
impl PyObjectRecord {
    /// Covariance of the center, NumPy array 3x3, square metres.
    #[getter]
    fn covariance<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        matrix(slf.as_super(), |object: Object| object.sigma.center)
    }
}

/// A tracked object in the camera frame (x right, y down, z forward); attributes that only other shapes have are None.
///
/// id: identity, constant during the life of the track.
/// state: "tentative", "confirmed", or "coasting" while it is not seen; in arrays 0, 1 or 2.
/// age, misses: frames since it was first seen, and since it was last seen.
/// velocity: [x, y, z] of the center, metres per second.
/// velocity_covariance: of the velocity, NumPy array 3x3, square metres per square second.
/// kind: "sphere", "cylinder" or "cone"; in arrays 0, 1 or 2.
/// center: [x, y, z] of a sphere; for others the middle of the visible part, on the axis; metres.
/// radius: metres; None for a cone.
/// axis: unit vector; for a cone from the apex to the base; None for a sphere.
/// length: of the visible part along the axis, metres; None for a sphere.
/// apex, half_angle, base_radius, top_radius: of a cone, metres and radians; the radii at the wide and the narrow end of the
///     visible part.
/// sigma: standard deviations: center [x, y, z], radius (of a cone at its center) and length in metres, axis and half_angle in
///     radians, velocity [x, y, z] in metres per second.
/// covariance: of the center, NumPy array 3x3, square metres.
/// rms: root mean square distance of the points from the surface in excess of the noise, metres.
/// points, rows: measurements and scan lines that support it.
/// arc: visible part of the circumference, radians.
/// confidence: probability that it is an object of this shape; None if the method does not estimate it.
#[pyclass(frozen, extends = Record, name = "Track", module = "conicflow")]
struct PyTrack;

#[pymethods]
impl PyTrack {
    /// Covariance of the center, NumPy array 3x3, square metres.
    #[getter]
    fn covariance<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        matrix(slf.as_super(), |track: Track| track.object.sigma.center)
    }

    /// Covariance of the velocity, NumPy array 3x3, square metres per square second.
    #[getter]
    fn velocity_covariance<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        matrix(slf.as_super(), |track: Track| track.velocity_covariance)
    }
}

/// Returns a matrix of an item as a NumPy array.
fn matrix<'py, T: Item>(
    record: &Bound<'py, Record>,
    of: impl FnOnce(T) -> [[f64; 3]; 3],
) -> PyResult<Bound<'py, PyAny>> {
    let item = record.get().item_as::<T>().ok_or_else(|| fault::value("it is an item of another type", ""))?;
    Ok(arr2(&of(item)).into_pyarray(record.py()).into_any())
}

/// An arc of a scan line, in the camera frame.
///
/// scan, line: "row" or "column" (in arrays 0 or 1), and its number.
/// first, last: the first and the last pixel.
/// points: number of points.
/// center: [x, y, z], metres.
/// semi_axes: the longer first, metres.
/// angle: between the direction across the view and the longer axis, in the plane of the line, radians.
/// rms: root mean square distance of the points in excess of the noise, metres.
/// arc: angle that the points span, radians.
#[pyclass(frozen, extends = Record, name = "Ellipse", module = "conicflow")]
struct PyEllipse;

/// A velocity command.
///
/// linear, angular: [x, y, z], metres and radians per second.
/// frame: the coordinate frame, "camera" or "world"; in arrays 0 or 1.
#[pyclass(frozen, extends = Record, name = "Velocity", module = "conicflow")]
struct PyVelocity;

/// Adds the classes of records to the module.
pub(crate) fn add_to(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(unpickled, module)?)?;
    module.add_class::<Record>()?;
    module.add_class::<PyObjectRecord>()?;
    module.add_class::<PyTrack>()?;
    module.add_class::<PyEllipse>()?;
    module.add_class::<PyVelocity>()
}

/// Restores a record that [`Record::__reduce__`] has pickled.
#[pyfunction(name = "_record")]
fn unpickled<'py>(py: Python<'py>, layout: &str, bytes: &[u8]) -> PyResult<Bound<'py, PyAny>> {
    let item = BUILT_IN.iter().find(|item| item.layout() == layout && item.size() == bytes.len());
    let item = item.ok_or_else(|| fault::value("it was pickled by another version", "find the objects anew"))?;
    // Only the items are checked, whatever their camera: its image gets the pixels that an arc needs.
    let (width, height) = Record::new(item, bytes).item_as::<Ellipse>().map_or((1, 1), |ellipse| {
        let (line, along) = (ellipse.line.saturating_add(1), ellipse.last.saturating_add(1));
        if ellipse.direction() == Scan::Row { (along, line) } else { (line, along) }
    });
    let camera = Camera { width, height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
    let header = Header { camera, depth_scale: COARSEST_SCALE, ..Header::default() };
    item.check(&header, bytes).map_err(|error| fault::from_error(&error))?;
    Record::new(item, bytes).into_python(py)
}

/// Returns built-in items as a list of records.
pub(crate) fn list_of<'py, T: ToJson>(py: Python<'py>, items: &[T]) -> PyResult<Bound<'py, PyList>> {
    list(py, &ItemType::shown::<T>(), cast_slice(items))
}

/// Returns the items in `bytes` as a list of records.
pub(crate) fn list<'py>(py: Python<'py>, item: &ItemType, bytes: &[u8]) -> PyResult<Bound<'py, PyList>> {
    let records = bytes.chunks_exact(item.size()).map(|bytes| Record::new(item, bytes).into_python(py));
    PyList::new(py, records.collect::<PyResult<Vec<_>>>()?)
}

impl Record {
    fn new(item: &ItemType, bytes: &[u8]) -> Self {
        let mut words = vec![0_u64; bytes.len().div_ceil(size_of::<u64>())];
        cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self { item: item.clone(), words: words.into(), shown: PyOnceLock::new() }
    }

    /// Converts it to the Python class of its item type.
    fn into_python(self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        Ok(match self.item.name() {
            Object::NAME => Bound::new(py, (PyObjectRecord, self))?.into_any(),
            Track::NAME => Bound::new(py, (PyTrack, self))?.into_any(),
            Ellipse::NAME => Bound::new(py, (PyEllipse, self))?.into_any(),
            Velocity::NAME => Bound::new(py, (PyVelocity, self))?.into_any(),
            _ => Bound::new(py, self)?.into_any(),
        })
    }

    /// The item type.
    pub(crate) fn item(&self) -> &ItemType {
        &self.item
    }

    /// The bytes of the item.
    pub(crate) fn bytes(&self) -> &[u8] {
        &cast_slice(&self.words)[..self.item.size()]
    }

    /// The item, if it is of this type.
    pub(crate) fn item_as<T: Item>(&self) -> Option<T> {
        self.item.fits(const { &ItemType::of::<T>() }).then(|| pod_read_unaligned(self.bytes()))
    }

    /// Its JSON as a dictionary, which is made once.
    fn shown<'py>(&self, py: Python<'py>) -> PyResult<&Bound<'py, PyDict>> {
        Ok(self.shown.get_or_try_init(py, || Ok::<_, PyErr>(self.to_dict(py)?.unbind()))?.bind(py))
    }
}

#[pymethods]
impl Record {
    /// The item as `json_sink` writes it, to the last digit.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let message = AnyMessage { header: &Header::default(), item: &self.item, bytes: self.bytes() };
        let mut line = Vec::new();
        message.write_json(None, &mut line).map_err(|error| fault::from_error(&error))?;
        let line = py.import("json")?.call_method1("loads", (PyBytes::new(py, &line),))?;
        Ok(line.get_item(self.item.name())?.get_item(0)?.cast_into()?)
    }

    fn __getattr__<'py>(&self, py: Python<'py>, name: &Bound<'py, PyString>) -> PyResult<Bound<'py, PyAny>> {
        let known = keys(py, &self.item)?;
        let shown = self.shown(py)?;
        match shown.get_item(name)? {
            Some(value) if value.is_instance_of::<PyList>() => value.call_method0("copy"),
            Some(value) => with_attributes(py, value, known.map(|known| known.get_item(name)).transpose()?.flatten()),
            // Another shape has this attribute.
            None if known.is_some_and(|known| known.contains(name).unwrap_or(false)) => Ok(py.None().into_bound(py)),
            None => Err(PyAttributeError::new_err(format!(
                "an item of {} has no `{name}`\n  hint: it has {}",
                self.item.name(),
                shown.keys().str()?
            ))),
        }
    }

    /// The attributes of the class, and the keys of its items, including those of other shapes.
    fn __dir__<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyList>> {
        let (py, record) = (slf.py(), slf.get());
        let names = slf.get_type().dir()?;
        let keys = keys(py, &record.item)?.map_or_else(|| record.shown(py).cloned(), Ok)?.keys();
        names.call_method1("extend", (keys,))?;
        Ok(names)
    }

    /// Supports copying and pickling by the item's bytes; another version of the layout refuses them.
    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        if !self.item.is_built_in() {
            let what = format!("an item of {} cannot be copied or pickled", self.item.name());
            return Err(fault::kind(what, "keep its to_dict(), or the array of its message"));
        }
        let make = py.import("conicflow._conicflow")?.getattr("_record")?;
        (make, (self.item.layout(), PyBytes::new(py, self.bytes()))).into_pyobject(py)
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|other| self.item.fits(&other.get().item) && self.words == other.get().words)
    }

    fn __hash__(&self) -> u64 {
        use std::hash::{DefaultHasher, Hash, Hasher};
        let mut hasher = DefaultHasher::new();
        self.words.hash(&mut hasher);
        hasher.finish()
    }

    fn __repr__(slf: &Bound<'_, Self>) -> PyResult<String> {
        let shown = slf.get().shown(slf.py())?;
        let fields: PyResult<Vec<String>> =
            shown.iter().map(|(key, value)| Ok(format!("{key}={}", value.repr()?))).collect();
        Ok(format!("{}({})", slf.get_type().name()?, fields?.join(", ")))
    }
}

/// Returns all keys that items of a type can have, including those of other shapes, each with `None` or with its nested keys.
fn keys<'py>(py: Python<'py>, item: &ItemType) -> PyResult<Option<Bound<'py, PyDict>>> {
    static KEYS: PyOnceLock<[(&str, Py<PyDict>); 2]> = PyOnceLock::new();
    let known = KEYS.get_or_try_init(py, || {
        let shapes = ObjectKind::ALL.map(|kind| Object { kind: kind.code(), confidence: 1.0, ..Object::default() });
        let tracks = shapes.map(|object| Track { object, ..Track::default() });
        Ok::<_, PyErr>([(Object::NAME, keys_of(py, &shapes)?.unbind()), (Track::NAME, keys_of(py, &tracks)?.unbind())])
    })?;
    let found = known.iter().find(|(name, _)| *name == item.name());
    Ok(found.map(|(_, keys)| keys.bind(py).clone()))
}

/// Returns the union of the keys of these examples.
fn keys_of<'py, T: ToJson>(py: Python<'py>, examples: &[T]) -> PyResult<Bound<'py, PyDict>> {
    let keys = PyDict::new(py);
    for example in examples {
        for (key, value) in Record::new(const { &ItemType::shown::<T>() }, bytes_of(example)).to_dict(py)?.iter() {
            let Ok(nested) = value.cast_into::<PyDict>() else {
                keys.set_item(key, py.None())?;
                continue;
            };
            if !keys.contains(&key)? {
                keys.set_item(&key, PyDict::new(py))?;
            }
            let below = keys.as_any().get_item(&key)?;
            for name in nested.keys() {
                below.set_item(name, py.None())?;
            }
        }
    }
    Ok(keys)
}

/// Converts a dictionary to an object with attributes; attributes that only other shapes have are `None`.
fn with_attributes<'py>(
    py: Python<'py>,
    value: Bound<'py, PyAny>,
    keys: Option<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let Ok(fields) = value.cast::<PyDict>() else { return Ok(value) };
    let all = PyDict::new(py);
    if let Some(keys) = keys.as_ref().and_then(|keys| keys.cast::<PyDict>().ok()) {
        all.update(keys.as_mapping())?;
    }
    for (name, value) in fields.iter() {
        let own = if value.is_instance_of::<PyList>() { value.call_method0("copy")? } else { value };
        all.set_item(name, own)?;
    }
    py.import("types")?.getattr("SimpleNamespace")?.call((), Some(&all))
}
