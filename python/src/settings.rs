//! Conversion of cameras, noise models and parameters from Python: four numbers, words as in the pipeline file, and dictionaries
//! with its keys.

use crate::{argument, fault};
use conicflow_dataflow::Config;
use conicflow_dataflow::pipeline::value_fault;
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::{ConfigFault, DEPTH_SCALES_M, Hinted, NoiseModel};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyBool, PyByteArray, PyBytes, PyCFunction};
use serde_json::Value as Json;

/// The hint when the camera is missing.
pub(crate) const CAMERA: &str = "give camera=(fx, fy, cx, cy) in pixels, such as (525.0, 525.0, 319.5, 239.5), or a matrix K, \
                                 row by row";

/// Hints for camera objects of other libraries, by an attribute that identifies them.
const OF_OTHERS: [(&str, &str); 4] = [
    ("k", "of a CameraInfo of ROS 2 give camera=info.k"),
    ("K", "of a CameraInfo of ROS 1 give camera=info.K"),
    ("ppx", "of intrinsics of RealSense give camera=(i.fx, i.fy, i.ppx, i.ppy)"),
    ("intrinsic_matrix", "of intrinsics of Open3D give camera=i.intrinsic_matrix"),
];

/// Converts the intrinsics of a camera: `(fx, fy, cx, cy)` in pixels, or a matrix K.
pub(crate) fn intrinsics(camera: &Bound<'_, PyAny>) -> PyResult<Intrinsics> {
    let rows = || camera.extract::<[[f64; 3]; 3]>().map(|rows| rows.as_flattened().to_vec());
    let is_text = camera.is_instance_of::<PyBytes>() || camera.is_instance_of::<PyByteArray>();
    let numbers: Option<Vec<f64>> = camera.extract().or_else(|_| rows()).ok().filter(|_| !is_text);
    let numbers = numbers.ok_or_else(|| {
        let hint = OF_OTHERS.iter().find(|(attribute, _)| camera.hasattr(*attribute).unwrap_or(false));
        let what = format!("`camera` is {}, expected four numbers or a matrix K", argument::describe(camera));
        fault::kind(what, hint.map_or(CAMERA, |(_, hint)| hint))
    })?;
    let (fx, fy, cx, cy) = match numbers[..] {
        [fx, fy, cx, cy] => (fx, fy, cx, cy),
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] => (fx, fy, cx, cy),
        [_, _, _, _, _, _, _, _, _] => {
            let what = format!("`camera` is no matrix K [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: {numbers:?}");
            return Err(fault::value(what, "give K row by row: of one that goes column by column its transpose"));
        }
        _ => {
            let what = format!("`camera` has {} numbers, expected four, or the nine of a matrix K", numbers.len());
            return Err(fault::value(what, CAMERA));
        }
    };
    let intrinsics = Intrinsics { fx, fy, cx, cy };
    if intrinsics.are_usable() {
        Ok(intrinsics)
    } else {
        let what = "`camera`: focal lengths are 1 to 1,000,000 pixels, and a principal point is no farther away";
        Err(fault::value(format!("{what}, but they are {numbers:?}"), CAMERA))
    }
}

/// Converts the metres per unit of a depth pixel.
pub(crate) fn scale(given: &Bound<'_, PyAny>) -> PyResult<f64> {
    let hint = "it is metres per unit: 0.001 for millimetres, 0.0002 for TUM RGB-D, which has 5000 units in a metre";
    let scale = argument::number("scale", given, hint)?;
    if DEPTH_SCALES_M.contains(&scale) {
        return Ok(scale);
    }
    let (least, most) = (DEPTH_SCALES_M.start(), DEPTH_SCALES_M.end());
    Err(fault::value(format!("`scale` is {scale}, allowed is from {least:e} to {most} metres per unit"), hint))
}

/// Converts the noise model of a sensor: a word, or a dictionary with coefficients.
pub(crate) fn noise(noise: Option<&Bound<'_, PyAny>>) -> PyResult<NoiseModel> {
    let Some(noise) = noise else { return Ok(NoiseConfig::default().into()) };
    Ok(read::<NoiseConfig>("noise", noise)?.into())
}

/// Converts parameters with the names of the pipeline file; missing ones have their defaults. `faults` checks them beyond their
/// ranges.
pub(crate) fn parameters<T: Config>(
    name: &str,
    given: Option<&Bound<'_, PyAny>>,
    faults: fn(&T) -> Vec<ConfigFault>,
) -> PyResult<T> {
    let Some(given) = given else { return Ok(T::default()) };
    let parameters = read(name, given)?;
    match faults(&parameters).into_iter().next() {
        Some(ConfigFault { key, what, hint }) => Err(fault::value(format!("`{name}`, `{key}`: {what}"), hint)),
        None => Ok(parameters),
    }
}

/// Converts words and dictionaries as in the pipeline file, with the same checks.
fn read<T: Config>(name: &str, value: &Bound<'_, PyAny>) -> PyResult<T> {
    let hint = "give numbers, words and dictionaries, by the keys that docs/pipeline.schema.json tells";
    let py = value.py();
    // NumPy's numbers and arrays become plain ones.
    let plain = PyCFunction::new_closure(py, None, None, |arguments, _| -> PyResult<Py<PyAny>> {
        let given = arguments.get_item(0)?;
        if given.hasattr("tolist")? {
            return given.call_method0("tolist").map(Bound::unbind);
        }
        Err(PyTypeError::new_err(format!("has {}, which is no number, word or dictionary", argument::describe(&given))))
    })?;
    let settings = [("default", plain.into_any()), ("allow_nan", PyBool::new(py, false).to_owned().into_any())];
    let text = py.import("json")?.call_method("dumps", (value,), Some(&settings.into_py_dict(py)?));
    let text: String = text
        .map_err(|error| {
            if error.is_instance_of::<PyTypeError>(py) {
                fault::kind(format!("`{name}` {}", error.value(py)), hint)
            } else {
                fault::value(format!("`{name}` is {}, expected finite numbers", argument::describe(value)), hint)
            }
        })?
        .extract()?;
    let value_json: Json =
        serde_json::from_str(&text).map_err(|error| fault::value(format!("`{name}` is {text}: {error}"), hint))?;
    if let Some(Hinted { what, hint, .. }) = value_fault::<T>(name, &value_json) {
        return Err(fault::value(what, hint));
    }
    serde_json::from_value(value_json).map_err(|error| fault::value(format!("`{name}` is {text}: {error}"), hint))
}
