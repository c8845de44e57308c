//! The tracker: objects of successive frames in, tracks out.

use crate::{detector, fault, record, settings};
use conicflow_detection::{Tracker, TrackerParameters};
use conicflow_messages::is_rotation;
use pyo3::prelude::*;
use pyo3::types::PyList;
use std::sync::{Mutex, PoisonError};

/// Gives the objects of successive frames of one camera, or of several that tell their poses, an identity, a velocity and a
/// filtered shape.
///
/// parameters: a dictionary with parameters of the node `kalman_tracker`; those that are left out have their defaults.
#[pyclass(frozen, name = "Tracker", module = "conicflow")]
pub(crate) struct PyTracker(Mutex<Tracker>);

#[pymethods]
impl PyTracker {
    #[new]
    #[pyo3(signature = (parameters = None))]
    fn new(parameters: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let parameters = settings::parameters("parameters", parameters, TrackerParameters::faults)?;
        Ok(Self(Mutex::new(Tracker::new(parameters))))
    }

    /// The tracks that are alive after a frame, by identity, in the camera frame.
    ///
    /// objects: those that `detect` found in the frame.
    /// stamp_ns: when it was taken, in nanoseconds.
    /// world_from_camera: the camera's pose, 3x4 or 4x4, `[R | t]` with t in metres. None: as before, or standing still.
    /// camera: which of several cameras with poses, by a number. What one of them alone sees, the others do not miss.
    #[pyo3(signature = (objects, stamp_ns, world_from_camera = None, camera = 0))]
    fn update<'py>(
        &self,
        py: Python<'py>,
        objects: &Bound<'py, PyAny>,
        stamp_ns: u64,
        world_from_camera: Option<&Bound<'py, PyAny>>,
        camera: u32,
    ) -> PyResult<Bound<'py, PyList>> {
        let objects = detector::objects(objects)?;
        let pose = world_from_camera.map(pose).transpose()?;
        if pose.is_none() && camera > 0 {
            let hint = "give `world_from_camera` with each frame: only so are several cameras in one world";
            return Err(fault::value("a camera by its number has no pose", hint));
        }
        let tracks = py.detach(|| {
            let mut tracker = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            match pose {
                Some(pose) => tracker.update_from(camera, &objects, stamp_ns, pose).map(<[_]>::to_vec),
                None => Ok(tracker.update(&objects, stamp_ns).to_vec()),
            }
        });
        record::list_of(py, &tracks.map_err(|error| fault::value(error.to_string(), ""))?)
    }
}

/// A pose: three rows of four numbers, or the four rows of a matrix for homogeneous coordinates.
pub(crate) fn pose(given: &Bound<'_, PyAny>) -> PyResult<[[f64; 4]; 3]> {
    let hint = "give `[R | t]`, 3x4 or 4x4, with a rotation R and t in metres: from the camera to the world";
    let rows: Vec<[f64; 4]> = given
        .extract()
        .map_err(|_| fault::kind("`world_from_camera` is no matrix of numbers with four columns", hint))?;
    let is_last = |row: &[f64; 4]| *row == [0.0, 0.0, 0.0, 1.0];
    let pose = match rows[..] {
        [x, y, z] => [x, y, z],
        [x, y, z, ref last] if is_last(last) => [x, y, z],
        _ => return Err(fault::value("`world_from_camera` is no pose", hint)),
    };
    if is_rotation(&pose) && pose.iter().all(|row| row[3].is_finite()) {
        Ok(pose)
    } else {
        Err(fault::value("`world_from_camera` has no rotation in its first three columns", hint))
    }
}
