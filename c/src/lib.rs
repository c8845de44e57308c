//! The detector for C: implements `conicflow.h`, in the order of that file.
//!
//! This is a border. Pointers and sizes from C are checked as far as possible; errors, including panics, are returned as a text
//! ([`fault`]) and never unwind into C. [`Camera`] and [`Object`] cross it as they are in memory.

#![allow(unsafe_code)] // C passes pointers

mod fault;
mod image;

use conicflow_detection::noise::NoiseName;
use conicflow_detection::{Camera, Detector, Object};
use conicflow_messages::Hinted;
use image::Image;
use std::ffi::{CStr, c_char, c_int};
use std::ptr;

/// The version as a C string.
const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => c"",
};

/// The detector that C has a pointer to.
pub struct CDetector {
    detector: Detector,
    camera: Camera,
    /// The objects of the last image, which C reads here.
    objects: Vec<Object>,
    /// The pixels of the last image, for images with gaps between rows.
    units: Vec<u16>,
    metres: Vec<f32>,
}

/// See `conicflow.h`.
///
/// # Safety
/// `camera` is null or points to a camera; `noise` is null or points to a text that ends in a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn conicflow_create(
    camera: *const Camera,
    depth_scale: f64,
    noise: *const c_char,
) -> *mut CDetector {
    let created = fault::catch(|| {
        // SAFETY: null, or the caller guarantees it; any bits are a camera.
        let camera = *unsafe { camera.as_ref() }.ok_or_else(|| is_null("camera"))?;
        // SAFETY: the caller guarantees it if it is not null.
        let noise = (!noise.is_null()).then(|| unsafe { CStr::from_ptr(noise) });
        create(camera, depth_scale, noise)
    });
    created.map_or(ptr::null_mut(), |detector| Box::into_raw(Box::new(detector)))
}

fn create(camera: Camera, depth_scale: f64, noise: Option<&CStr>) -> Result<CDetector, Hinted> {
    let noise = noise.map_or(Ok(NoiseName::KinectV1), |name| name.to_string_lossy().parse::<NoiseName>());
    let noise = noise.map_err(|error| Hinted::new(format!("`noise`: {error}"), "NULL is \"kinect_v1\""))?;
    let detector = Detector::new(camera).noise(noise.model()).depth_scale(depth_scale);
    detector.check().map_err(|error| error.hinted())?;
    Ok(CDetector { detector, camera, objects: Vec::new(), units: Vec::new(), metres: Vec::new() })
}

/// See `conicflow.h`.
///
/// # Safety
/// `detector` is null or was made by [`conicflow_create`], has not been freed, and no other thread uses it. `depth` is null or
/// points to as many rows as its camera has, at distances of `row_bytes`. `objects` is null or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn conicflow_detect(
    detector: *mut CDetector,
    depth: *const u16,
    row_bytes: usize,
    objects: *mut *const Object,
) -> c_int {
    // SAFETY: the caller guarantees the conditions.
    unsafe {
        answer(detector, objects, |CDetector { detector, camera, units, .. }| {
            let pixels = Image { first: depth, row_bytes }.pixels(camera, units)?;
            detector.try_detect(pixels).map_err(|error| error.hinted())
        })
    }
}

/// See `conicflow.h`.
///
/// # Safety
/// As for [`conicflow_detect`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn conicflow_detect_metres(
    detector: *mut CDetector,
    depth: *const f32,
    row_bytes: usize,
    objects: *mut *const Object,
) -> c_int {
    // SAFETY: the caller guarantees the conditions.
    unsafe {
        answer(detector, objects, |CDetector { detector, camera, metres, .. }| {
            let pixels = Image { first: depth, row_bytes }.pixels(camera, metres)?;
            detector.try_detect_f32(pixels).map_err(|error| error.hinted())
        })
    }
}

/// Runs the detector; returns the number of objects and sets `objects` to the first.
///
/// # Safety
/// `detector` is null or points to a detector that nothing else uses; `objects` is null or can be written.
unsafe fn answer(
    detector: *mut CDetector,
    objects: *mut *const Object,
    find: impl FnOnce(&mut CDetector) -> Result<Vec<Object>, Hinted>,
) -> c_int {
    let count = fault::catch(|| {
        // SAFETY: null, or the caller guarantees it.
        let detector = unsafe { detector.as_mut() }.ok_or_else(|| is_null("detector"))?;
        if objects.is_null() {
            return Err(is_null("objects"));
        }
        detector.objects = find(detector)?;
        let first = detector.objects.first().map_or(ptr::null(), ptr::from_ref);
        // SAFETY: the caller guarantees it; the target may be uninitialised.
        unsafe { objects.write(first) };
        // The detector reports a few dozen objects at most.
        Ok(c_int::try_from(detector.objects.len()).unwrap_or(c_int::MAX))
    });
    count.unwrap_or(-1)
}

/// See `conicflow.h`.
///
/// # Safety
/// `detector` is null or was made by [`conicflow_create`], has not been freed, and nothing else uses it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn conicflow_free(detector: *mut CDetector) {
    if !detector.is_null() {
        // SAFETY: it came from a box in `conicflow_create`, and is freed once.
        let detector = unsafe { Box::from_raw(detector) };
        fault::catch(|| {
            drop(detector);
            Ok(())
        });
    }
}

/// See `conicflow.h`.
#[unsafe(no_mangle)]
pub extern "C" fn conicflow_error() -> *const c_char {
    fault::last()
}

/// See `conicflow.h`.
#[unsafe(no_mangle)]
pub extern "C" fn conicflow_version() -> *const c_char {
    VERSION.as_ptr()
}

fn is_null(name: &str) -> Hinted {
    Hinted::new(format!("`{name}` is NULL"), "conicflow.h says what is wanted there")
}
