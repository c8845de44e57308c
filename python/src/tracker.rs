//! The tracker: objects of successive frames in, tracks out.

use crate::{argument, detector, fault, record, settings};
use conicflow_dataflow::lock;
use conicflow_detection::{Tracker, TrackerParameters};
use conicflow_messages::is_rotation;
use pyo3::prelude::*;
use pyo3::types::PyList;
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Tracks objects over successive frames of one camera, or of several cameras with known poses: gives them an identity, a
/// velocity and a filtered shape.
///
/// parameters: a dictionary with parameters of the node `kalman_tracker`; missing ones have their defaults.
#[pyclass(frozen, name = "Tracker", module = "conicflow")]
pub(crate) struct PyTracker {
    tracker: Mutex<Tracker>,
    stamps: Mutex<Stamps>,
}

/// No camera takes frames at shorter intervals than this ...
const TOO_CLOSE_NS: u64 = 100_000;
/// ... this many times in a row.
const TIMES: u32 = 3;

/// Detects stamps in milliseconds or microseconds, which should be in nanoseconds.
#[derive(Default)]
struct Stamps {
    /// By camera number: the last stamp, and how many times in a row it was too close to the one before.
    last: BTreeMap<u32, (u64, u32)>,
    has_warned: bool,
}

impl Stamps {
    /// Returns whether to warn, once: frames of a camera seem to come too fast. Stamps that stand still or go back are ignored.
    fn look(&mut self, camera: u32, stamp_ns: u64) -> bool {
        let (last, times) = self.last.get(&camera).copied().unwrap_or((stamp_ns, 0));
        let is_close = stamp_ns > last && stamp_ns - last < TOO_CLOSE_NS;
        let times = if is_close { times + 1 } else { 0 };
        self.last.insert(camera, (stamp_ns, times));
        let warns = times >= TIMES && !self.has_warned;
        self.has_warned |= warns;
        warns
    }
}

#[pymethods]
impl PyTracker {
    #[new]
    #[pyo3(signature = (parameters = None))]
    fn new(parameters: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let parameters = settings::parameters("parameters", parameters, TrackerParameters::faults)?;
        Ok(Self { tracker: Mutex::new(Tracker::new(parameters)), stamps: Mutex::default() })
    }

    /// Updates the tracks with the objects of a frame; returns the tracks that are alive, by identity, in the camera frame.
    ///
    /// objects: those that `detect` found in the frame.
    /// stamp_ns: time of capture in nanoseconds, an integer. If stamps stand still or go back, the parameter
    ///     `assumed_rate_hz` is used instead.
    /// world_from_camera: the camera's pose, 3x4 or 4x4, `[R | t]` with t in metres. None: the last pose, or a camera at rest.
    /// camera: number of the camera, for several cameras with poses. An object that one camera alone sees is not missed by
    /// others.
    #[pyo3(
        signature = (objects, stamp_ns, world_from_camera = None, camera = None),
        text_signature = "($self, objects, stamp_ns, world_from_camera=None, camera=0)"
    )]
    fn update<'py>(
        &self,
        py: Python<'py>,
        objects: &Bound<'py, PyAny>,
        stamp_ns: &Bound<'py, PyAny>,
        world_from_camera: Option<&Bound<'py, PyAny>>,
        camera: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyList>> {
        let (objects, stamp_ns) = (detector::objects(objects)?, argument::stamp_ns(stamp_ns)?);
        let camera = match camera {
            Some(camera) => argument::whole("camera", camera, u32::MAX.into(), "number the cameras from 0")? as u32,
            None => 0,
        };
        let pose = world_from_camera.map(pose).transpose()?;
        if pose.is_none() && camera > 0 {
            let hint = "give `world_from_camera` with each frame: only so are several cameras in one world";
            return Err(fault::value("a camera by its number has no pose", hint));
        }
        if py.detach(|| lock(&self.stamps).look(camera, stamp_ns)) {
            let what = "frames come less than 0.1 ms apart by `stamp_ns`, which is in nanoseconds";
            let hint = "of milliseconds give stamp * 10**6, of microseconds stamp * 1000";
            fault::warn(py, what, hint)?;
        }
        let tracks = py.detach(|| {
            let mut tracker = lock(&self.tracker);
            match pose {
                Some(pose) => tracker.update_from(camera, &objects, stamp_ns, pose).map(<[_]>::to_vec),
                None => Ok(tracker.update(&objects, stamp_ns).to_vec()),
            }
        });
        record::list_of(py, &tracks.map_err(|error| fault::from_error(&error))?)
    }

    /// Refuses copies: the tracker is memory of this process.
    fn __reduce__(&self) -> PyResult<Py<PyAny>> {
        Err(fault::kind("a Tracker cannot be copied or pickled", "make one where it is used: Tracker(parameters)"))
    }
}

/// Converts a pose: three rows of four numbers, or the four rows of a homogeneous matrix.
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
