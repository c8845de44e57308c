//! The detector without a pipeline: depth images in, objects out. Other Python threads run while it works.

use crate::depth_array::DepthArray;
use crate::record::{self, Record};
use crate::{argument, fault, settings};
use conicflow_dataflow::lock;
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::{AssemblerParameters, DetectError, Detector, ExtractorParameters};
use conicflow_messages::{Camera, NoiseModel, Object};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use std::cell::RefCell;
use std::sync::{Mutex, MutexGuard};

/// The default: metres per unit.
const MILLIMETRES: f64 = 0.001;

/// The sensor parameters that are needed to interpret the images of a camera.
#[derive(Clone, Copy, PartialEq)]
struct Sensor {
    intrinsics: Intrinsics,
    scale: f64,
    noise: NoiseModel,
}

impl Sensor {
    fn new(
        camera: &Bound<'_, PyAny>,
        scale: Option<&Bound<'_, PyAny>>,
        noise: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let scale = scale.map_or(Ok(MILLIMETRES), settings::scale)?;
        Ok(Self { intrinsics: settings::intrinsics(camera)?, scale, noise: settings::noise(noise)? })
    }

    fn detector(&self, size: (u32, u32)) -> Detector {
        Detector::new(self.intrinsics.camera(size)).noise(self.noise).depth_scale(self.scale)
    }
}

/// A detector, with the sensor and the image size that it was made for.
struct Made {
    sensor: Sensor,
    size: (u32, u32),
    detector: Detector,
}

thread_local! {
    /// The detector of the last [`detect`] call on this thread: its buffers are reused for the next image of the same camera.
    static LAST: RefCell<Option<Made>> = const { RefCell::new(None) };
}

/// Finds spheres, cylinders and cones in one depth image, in the camera frame (x right, y down, z forward). For a sequence of
/// images of one camera use `Detector`: it learns from each image where the camera puts silhouettes.
///
/// depth: NumPy array (rows, columns). `uint16` is in units of `scale`, 0 and 65535: no measurement; `float32` is in
///     metres, and values that are not finite, not above zero or beyond 16.38 m are no measurement. Any stride is accepted; a
///     contiguous array is not copied.
/// camera: (fx, fy, cx, cy) in pixels, or a matrix K, 3x3 or its nine numbers row by row; pixel centres lie at whole numbers.
/// scale: metres per unit of a `uint16` pixel; not used for `float32`.
/// noise: the sensor's depth noise, "kinect_v1", "realsense_d435", "time_of_flight", "ideal", or a dictionary with some of
///     floor_m, growth_per_m, knee_m, step_per_m. None: "kinect_v1".
///
/// Returns a list of `Object`, which is empty if nothing was found. Raises TypeError or ValueError with a hint.
#[pyfunction]
#[pyo3(
    signature = (depth, camera, scale = None, noise = None),
    text_signature = "(depth, camera, scale=0.001, noise=None)"
)]
pub(crate) fn detect<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: &Bound<'py, PyAny>,
    scale: Option<&Bound<'py, PyAny>>,
    noise: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyList>> {
    let image = DepthArray::new(depth)?;
    let (sensor, size) = (Sensor::new(camera, scale, noise)?, image.size()?);
    let found = look(py, &image, |look| {
        LAST.with_borrow_mut(|last| {
            let made = last.take().filter(|made| (made.sensor, made.size) == (sensor, size));
            let made = made.unwrap_or_else(|| Made { sensor, size, detector: sensor.detector(size).alone() });
            look(&mut last.insert(made).detector)
        })
    })?;
    record::list_of(py, &found.map_err(|error| fault::from_error(&error))?)
}

/// The result of a detector for an image.
type Found = Result<Vec<Object>, DetectError>;

/// Runs the detector that `with` provides on an image, while other Python threads continue.
fn look<R: Send>(
    py: Python<'_>,
    image: &DepthArray<'_>,
    with: impl FnOnce(&dyn Fn(&mut Detector) -> Found) -> R + Send,
) -> PyResult<R> {
    image.warn_of_units(py)?;
    Ok(match image {
        DepthArray::Units(array) => {
            let pixels = array.as_slice()?;
            py.detach(|| with(&|detector| detector.try_detect(pixels)))
        }
        DepthArray::Metres(array) => {
            let metres = array.as_slice()?;
            py.detach(|| with(&|detector| detector.try_detect_f32(metres)))
        }
    })
}

/// Finds objects in a sequence of images of one camera; all must have the size of the first. Each image shows where the camera
/// puts silhouettes, which makes measurements in later images more accurate; with `assembler={"pooled": {"contour_memory": 0}}`
/// each image is processed independently, as by `detect`.
///
/// camera, scale, noise: as for `detect`.
/// extractor, assembler: dictionaries with parameters of the nodes `row_ellipse_extractor` and `object_assembler`; missing ones
///     have their defaults.
#[pyclass(frozen, name = "Detector", module = "conicflow")]
pub(crate) struct PyDetector {
    sensor: Sensor,
    parameters: (ExtractorParameters, AssemblerParameters),
    made: Mutex<Option<(Camera, Detector)>>,
}

#[pymethods]
impl PyDetector {
    #[new]
    #[pyo3(
        signature = (camera, scale = None, noise = None, *, extractor = None, assembler = None),
        text_signature = "(camera, scale=0.001, noise=None, *, extractor=None, assembler=None)"
    )]
    fn new(
        camera: &Bound<'_, PyAny>,
        scale: Option<&Bound<'_, PyAny>>,
        noise: Option<&Bound<'_, PyAny>>,
        extractor: Option<&Bound<'_, PyAny>>,
        assembler: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let extractor = settings::parameters("extractor", extractor, ExtractorParameters::faults)?;
        let assembler = settings::parameters("assembler", assembler, AssemblerParameters::faults)?;
        let sensor = Sensor::new(camera, scale, noise)?;
        Ok(Self { sensor, parameters: (extractor, assembler), made: Mutex::default() })
    }

    /// Returns the objects of a depth image, like `detect`.
    fn detect<'py>(&self, py: Python<'py>, depth: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyList>> {
        let image = DepthArray::new(depth)?;
        let size = image.size()?;
        let found = look(py, &image, |look| {
            let mut made = self.made();
            let (camera, detector) = made.get_or_insert_with(|| self.make(size));
            if (camera.width, camera.height) == size { Ok(look(detector)) } else { Err(*camera) }
        })?;
        let found = found.map_err(|Camera { width, height, .. }| {
            let what = format!("the depth image is {}x{}, the first one was {width}x{height}", size.0, size.1);
            fault::value(what, "make a Detector for each size")
        })?;
        record::list_of(py, &found.map_err(|error| fault::from_error(&error))?)
    }

    /// The noise of the last image, near and far, relative to the noise model (standard deviations): far from 1, the model does
    /// not fit the sensor.
    #[getter]
    fn noise_ratios(&self, py: Python<'_>) -> (f64, f64) {
        py.detach(|| self.made().as_ref().map_or((1.0, 1.0), |(_, detector)| detector.noise_ratios().into()))
    }

    /// The reasons why arcs and candidates of the last image were rejected, with their counts.
    #[getter]
    fn rejections<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let rejections: Vec<_> =
            py.detach(|| self.made().iter().flat_map(|(_, detector)| detector.rejections()).collect());
        let counts = PyDict::new(py);
        rejections.into_iter().try_for_each(|(reason, times)| counts.set_item(reason, times))?;
        Ok(counts)
    }

    /// Refuses copies: the detector is memory of this process.
    fn __reduce__(&self) -> PyResult<Py<PyAny>> {
        let hint = "make one where it is used, in each process: Detector(camera, scale, noise)";
        Err(fault::kind("a Detector cannot be copied or pickled", hint))
    }
}

impl PyDetector {
    fn made(&self) -> MutexGuard<'_, Option<(Camera, Detector)>> {
        lock(&self.made)
    }

    /// Creates the detector for images of this size.
    fn make(&self, size: (u32, u32)) -> (Camera, Detector) {
        let (extractor, assembler) = self.parameters.clone();
        (self.sensor.intrinsics.camera(size), self.sensor.detector(size).parameters(extractor, assembler))
    }
}

/// Returns the objects of a list of records.
pub(crate) fn objects(given: &Bound<'_, PyAny>) -> PyResult<Vec<Object>> {
    let mut objects = Vec::new();
    let each = given.try_iter().map_err(|_| {
        let what = format!("`objects` is {}, expected a list of conicflow.Object", argument::describe(given));
        fault::kind(what, "of one object give [object], where nothing was found []")
    })?;
    for (index, each) in each.enumerate() {
        let each = each?;
        let record = each.cast::<Record>().ok().map(|record| record.get());
        let object = record.and_then(|record| record.item_as::<Object>());
        objects.push(object.ok_or_else(|| {
            let type_name = each.get_type().name().map_or_else(|_| String::new(), |name| name.to_string());
            let what = format!("`objects` has a {type_name} at {index}, expected conicflow.Object");
            fault::kind(what, "pass what detect() returned, or the items of a message with objects")
        })?);
    }
    Ok(objects)
}
