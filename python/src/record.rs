//! Items as Python sees them: what was found or came, with the keys of its line of JSON as attributes.
//!
//! A record keeps the item itself, so that it can be tracked or sent on to the bit. What it shows of it is what
//! [`AnyMessage::write_json`] writes, read by Python's own reader.

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

/// One item of a message. Its attributes are the keys that `json_sink` writes; what only other shapes have is None.
#[pyclass(frozen, subclass, module = "conicflow")]
pub(crate) struct Record {
    item: ItemType,
    /// Its bytes, as it has to lie in memory.
    words: Box<[u64]>,
    shown: PyOnceLock<Py<PyDict>>,
}

/// A sphere, cylinder or cone in the camera frame (x right, y down, z forward); what only other shapes have is None.
///
/// kind: "sphere", "cylinder" or "cone"; in arrays 0, 1 or 2.
/// center: [x, y, z] of a sphere; else the middle of the visible part, on the axis; metres.
/// radius: metres; None for a cone.
/// axis: unit vector, of a cone from the apex to the base; None for a sphere.
/// length: of the visible part along the axis, metres; None for a sphere.
/// apex, half_angle, base_radius, top_radius: of a cone, metres and radians; the radii at the wide and the narrow end of the
///     visible part.
/// sigma: standard deviations: center [x, y, z], radius (of a cone at its center) and length in metres, axis and half_angle in
///     radians.
/// covariance: of the center, NumPy array 3x3, square metres.
/// rms: root mean square distance of the points from the surface beyond what noise explains, metres.
/// points, rows: measurements and scan lines that support it.
/// arc: visible part of the circumference, radians.
/// confidence: probability that it is an object of this shape; None where the method does not tell.
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

/// A tracked object in the camera frame (x right, y down, z forward); what only other shapes have is None.
///
/// id: its identity, the same from the first sight to the last.
/// state: "tentative", "confirmed", or "coasting" while it is not seen; in arrays 0, 1 or 2.
/// age, misses: frames since its first sight, and since it was last seen.
/// velocity: [x, y, z] of the center, metres per second.
/// velocity_covariance: of that, NumPy array 3x3, square metres per square second.
/// kind: "sphere", "cylinder" or "cone"; in arrays 0, 1 or 2.
/// center: [x, y, z] of a sphere; else the middle of the visible part, on the axis; metres.
/// radius: metres; None for a cone.
/// axis: unit vector, of a cone from the apex to the base; None for a sphere.
/// length: of the visible part along the axis, metres; None for a sphere.
/// apex, half_angle, base_radius, top_radius: of a cone, metres and radians; the radii at the wide and the narrow end of the
///     visible part.
/// sigma: standard deviations: center [x, y, z], radius (of a cone at its center) and length in metres, axis and half_angle in
///     radians, velocity [x, y, z] in metres per second.
/// covariance: of the center, NumPy array 3x3, square metres.
/// rms: root mean square distance of the points from the surface beyond what noise explains, metres.
/// points, rows: measurements and scan lines that support it.
/// arc: visible part of the circumference, radians.
/// confidence: probability that it is an object of this shape; None where the method does not tell.
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

/// A matrix of an item as a NumPy array.
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
/// first, last: its first and its last pixel.
/// points: number of points.
/// center: [x, y, z], metres.
/// semi_axes: the longer first, metres.
/// angle: from the direction across the view to the longer axis, in the plane of the line, radians.
/// rms: root mean square distance of the points beyond the noise, metres.
/// arc: angle that the points span, radians.
#[pyclass(frozen, extends = Record, name = "Ellipse", module = "conicflow")]
struct PyEllipse;

/// A velocity that is to be taken.
///
/// linear, angular: [x, y, z], metres and radians per second.
/// frame: "camera" or "world", whose axes are meant; in arrays 0 or 1.
#[pyclass(frozen, extends = Record, name = "Velocity", module = "conicflow")]
struct PyVelocity;

/// Makes the classes of records known.
pub(crate) fn add_to(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(unpickled, module)?)?;
    module.add_class::<Record>()?;
    module.add_class::<PyObjectRecord>()?;
    module.add_class::<PyTrack>()?;
    module.add_class::<PyEllipse>()?;
    module.add_class::<PyVelocity>()
}

/// A record of one of the classes, as [`Record::__reduce__`] tells of it.
#[pyfunction(name = "_record")]
fn unpickled<'py>(py: Python<'py>, layout: &str, bytes: &[u8]) -> PyResult<Bound<'py, PyAny>> {
    let item = BUILT_IN.iter().find(|item| item.layout() == layout && item.size() == bytes.len());
    let item = item.ok_or_else(|| fault::value("it was pickled by another version", "find the objects anew"))?;
    // Of whatever camera they are, the items alone are to make sense: its images have the pixels that an arc needs.
    let (width, height) = Record::new(item, bytes).item_as::<Ellipse>().map_or((1, 1), |ellipse| {
        let (line, along) = (ellipse.line.saturating_add(1), ellipse.last.saturating_add(1));
        if ellipse.direction() == Scan::Row { (along, line) } else { (line, along) }
    });
    let camera = Camera { width, height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
    let header = Header { camera, depth_scale: COARSEST_SCALE, ..Header::default() };
    item.check(&header, bytes).map_err(|error| fault::told(&error))?;
    Record::new(item, bytes).into_python(py)
}

/// Items that this program knows, as a list of records.
pub(crate) fn list_of<'py, T: ToJson>(py: Python<'py>, items: &[T]) -> PyResult<Bound<'py, PyList>> {
    list(py, &ItemType::shown::<T>(), cast_slice(items))
}

/// The items in `bytes` as a list of records.
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

    /// In the class of its items.
    fn into_python(self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        Ok(match self.item.name() {
            Object::NAME => Bound::new(py, (PyObjectRecord, self))?.into_any(),
            Track::NAME => Bound::new(py, (PyTrack, self))?.into_any(),
            Ellipse::NAME => Bound::new(py, (PyEllipse, self))?.into_any(),
            Velocity::NAME => Bound::new(py, (PyVelocity, self))?.into_any(),
            _ => Bound::new(py, self)?.into_any(),
        })
    }

    /// What it is.
    pub(crate) fn item(&self) -> &ItemType {
        &self.item
    }

    /// Its bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        &cast_slice(&self.words)[..self.item.size()]
    }

    /// The item, if it is of this type.
    pub(crate) fn item_as<T: Item>(&self) -> Option<T> {
        self.item.fits(const { &ItemType::of::<T>() }).then(|| pod_read_unaligned(self.bytes()))
    }

    /// What JSON says of it, read once.
    fn shown<'py>(&self, py: Python<'py>) -> PyResult<&Bound<'py, PyDict>> {
        Ok(self.shown.get_or_try_init(py, || Ok::<_, PyErr>(self.to_dict(py)?.unbind()))?.bind(py))
    }
}

#[pymethods]
impl Record {
    /// What `json_sink` writes for this item, to the last digit.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let message = AnyMessage { header: &Header::default(), item: &self.item, bytes: self.bytes() };
        let mut line = Vec::new();
        message.write_json(None, &mut line).map_err(|error| fault::told(&error))?;
        let line = py.import("json")?.call_method1("loads", (PyBytes::new(py, &line),))?;
        Ok(line.get_item(self.item.name())?.get_item(0)?.cast_into()?)
    }

    fn __getattr__<'py>(&self, py: Python<'py>, name: &Bound<'py, PyString>) -> PyResult<Bound<'py, PyAny>> {
        let known = keys(py, &self.item)?;
        let shown = self.shown(py)?;
        match shown.get_item(name)? {
            Some(value) if value.is_instance_of::<PyList>() => value.call_method0("copy"),
            Some(value) => with_attributes(py, value, known.map(|known| known.get_item(name)).transpose()?.flatten()),
            // What this shape does not have, another has.
            None if known.is_some_and(|known| known.contains(name).unwrap_or(false)) => Ok(py.None().into_bound(py)),
            None => Err(PyAttributeError::new_err(format!(
                "an item of {} has no `{name}`\n  hint: it has {}",
                self.item.name(),
                shown.keys().str()?
            ))),
        }
    }

    /// What its class has, and the keys of its items, those of other shapes included.
    fn __dir__<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyList>> {
        let (py, record) = (slf.py(), slf.get());
        let names = slf.get_type().dir()?;
        let keys = keys(py, &record.item)?.map_or_else(|| record.shown(py).cloned(), Ok)?.keys();
        names.call_method1("extend", (keys,))?;
        Ok(names)
    }

    /// How it is copied and pickled: by its bytes, which another version of the layout refuses.
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

/// All keys that items of a type can have, those of another shape included, each with `None` or with the keys below it.
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

/// The keys of all these examples together.
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

/// A value with attributes in place of keys, where it has keys; those that only other shapes have are `None`.
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
