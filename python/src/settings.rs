//! Camera, noise and parameters as Python gives them: four numbers, the words of the pipeline file, and dictionaries with its
//! keys.

use crate::fault;
use conicflow_dataflow::Config;
use conicflow_dataflow::pipeline::value_fault;
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::{ConfigFault, Hinted, NoiseModel};
use pyo3::prelude::*;
use serde_json::Value as Json;

/// What to write where the camera is wanted.
pub(crate) const CAMERA: &str = "give camera=(fx, fy, cx, cy) in pixels, such as (525.0, 525.0, 319.5, 239.5); of a matrix K these are \
                      K[0, 0], K[1, 1], K[0, 2], K[1, 2]";

/// The intrinsics of a camera: `(fx, fy, cx, cy)` in pixels.
pub(crate) fn intrinsics(camera: &Bound<'_, PyAny>) -> PyResult<Intrinsics> {
    let numbers: Vec<f64> = camera.extract().map_err(|_| {
        let came = camera.repr().map_or_else(|_| "something else".to_owned(), |text| text.to_string());
        fault::kind(format!("`camera` is {came}, expected four numbers"), CAMERA)
    })?;
    let &[fx, fy, cx, cy] = &numbers[..] else {
        return Err(fault::value(format!("`camera` has {} numbers, expected four", numbers.len()), CAMERA));
    };
    let intrinsics = Intrinsics { fx, fy, cx, cy };
    if intrinsics.are_usable() {
        Ok(intrinsics)
    } else {
        let what = "`camera`: focal lengths are 1 to 1,000,000 pixels, and a principal point is no farther away";
        Err(fault::value(format!("{what}, but they are {numbers:?}"), CAMERA))
    }
}

/// The noise of a sensor: a word, or a dictionary with coefficients.
pub(crate) fn noise(noise: Option<&Bound<'_, PyAny>>) -> PyResult<NoiseModel> {
    let Some(noise) = noise else { return Ok(NoiseConfig::default().into()) };
    Ok(read::<NoiseConfig>("noise", noise)?.into())
}

/// Parameters by their names in the pipeline file; those that are left out have their defaults. `faults` tells what is wrong
/// with them although each is in its range.
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

/// What is described by words and dictionaries as in the pipeline file, and checked as there.
fn read<T: Config>(name: &str, value: &Bound<'_, PyAny>) -> PyResult<T> {
    let hint = "the words and keys are those of the pipeline file: `conicflow nodes` lists them";
    let text = value.py().import("json")?.call_method1("dumps", (value,));
    let text: String = text.map_err(|error| fault::kind(format!("`{name}`: {error}"), hint))?.extract()?;
    let said: Json =
        serde_json::from_str(&text).map_err(|error| fault::value(format!("`{name}` is {text}: {error}"), hint))?;
    if let Some(Hinted { what, hint, .. }) = value_fault::<T>(name, &said) {
        return Err(fault::value(what, hint));
    }
    serde_json::from_value(said).map_err(|error| fault::value(format!("`{name}` is {text}: {error}"), hint))
}
