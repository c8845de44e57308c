//! Depth images as NumPy arrays: two dimensions of `uint16` or `float32`, with any stride. A contiguous array is read in place;
//! any other is copied once.

use crate::fault;
use conicflow_messages::{COARSEST_SCALE, MAX_PIXELS, MAX_SIDE_PX, is_too_far};
use numpy::{PyArrayDescrMethods, PyReadonlyArray2, PyUntypedArray, PyUntypedArrayMethods, dtype};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyString};

/// The expected type, for errors.
const EXPECTED: &str = "expected a NumPy array of two dimensions, (rows, columns), of uint16 (in units of `scale`) or of \
                        float32 (in metres, NaN: not measured)";

/// Maximum number of channels of an image.
const CHANNELS: usize = 4;

/// Every how many pixels one is checked for wrong units.
const LOOKED_AT: usize = 97;

/// A depth image.
pub(crate) enum DepthArray<'py> {
    /// In units of the depth scale.
    Units(PyReadonlyArray2<'py, u16>),
    /// In metres.
    Metres(PyReadonlyArray2<'py, f32>),
}

impl<'py> DepthArray<'py> {
    /// Checks `depth` and borrows its pixels.
    pub(crate) fn new(depth: &Bound<'py, PyAny>) -> PyResult<Self> {
        let py = depth.py();
        let Ok(array) = depth.cast::<PyUntypedArray>() else {
            let type_name = depth.get_type().name()?;
            let hint = if depth.is_none() {
                "was the file read? cv2.imread returns None for one that it cannot find or read"
            } else if depth.is_instance_of::<PyString>() || depth.hasattr("__fspath__")? {
                "read the file first, such as by cv2.imread(path, cv2.IMREAD_UNCHANGED)"
            } else if depth.is_instance_of::<PyBytes>() {
                "numpy.frombuffer(depth, numpy.uint16).reshape(height, width) may do"
            } else {
                "numpy.asarray(depth) may do"
            };
            return Err(fault::kind(format!("`depth` is of type {type_name}, {EXPECTED}"), hint));
        };
        if array.hasattr("mask")? {
            return Err(fault::kind(
                format!("`depth` is a masked array, {EXPECTED}"),
                "pass depth.filled(0): 0 means that nothing was measured",
            ));
        }
        if array.ndim() != 2 {
            let hint = match array.shape() {
                [] => "was the file read? an image has rows and columns",
                [_] => "depth.reshape(height, width)",
                [_, _, channels] if *channels <= CHANNELS => {
                    "of an image with channels pass the one with the depth: depth[:, :, 0]"
                }
                _ => "pass one image after another: `for image in depth`",
            };
            return Err(fault::value(format!("`depth` has the shape {:?}, {EXPECTED}", array.shape()), hint));
        }
        let of_units = array.dtype().is_equiv_to(&dtype::<u16>(py));
        if !of_units && !array.dtype().is_equiv_to(&dtype::<f32>(py)) {
            let hint =
                "depth.astype(numpy.float32) for metres, depth.astype(numpy.uint16) for millimetres and other units";
            return Err(fault::kind(format!("`depth` has the type {}, {EXPECTED}", array.dtype()), hint));
        }
        let whole = whole(array)?;
        Ok(if of_units { Self::Units(whole.extract()?) } else { Self::Metres(whole.extract()?) })
    }

    /// Warns if most of an image in metres is out of range: it may be in millimetres.
    pub(crate) fn warn_of_units(&self, py: Python<'_>) -> PyResult<()> {
        let Self::Metres(array) = self else { return Ok(()) };
        let looked_at = || array.as_slice().into_iter().flatten().step_by(LOOKED_AT);
        let measured = looked_at().filter(|z| z.is_finite() && **z > 0.0).count();
        let too_far = looked_at().filter(|z| is_too_far(**z, 1.0 / COARSEST_SCALE)).count();
        if 2 * too_far <= measured {
            return Ok(());
        }
        let what = "most of `depth` is beyond 16.38 m, and float32 is in metres";
        let hint = "of millimetres pass depth.astype(numpy.uint16), or depth * numpy.float32(0.001)";
        fault::warn(py, what, hint)
    }

    /// The size: columns and rows.
    pub(crate) fn size(&self) -> PyResult<(u32, u32)> {
        let shape = match self {
            Self::Units(array) => array.shape(),
            Self::Metres(array) => array.shape(),
        };
        let (height, width) = (shape[0], shape[1]);
        let is_side = |pixels| (1..=MAX_SIDE_PX as usize).contains(&pixels);
        if is_side(width) && is_side(height) && (width * height) as u64 <= MAX_PIXELS {
            return Ok((width as u32, height as u32));
        }
        let what = format!(
            "`depth` is {width}x{height} pixels, expected 1 to {MAX_SIDE_PX} along a side and {MAX_PIXELS} in all"
        );
        let is_empty = width == 0 || height == 0;
        Err(fault::value(
            what,
            if is_empty { "was the image read, or cut?" } else { "is it one image, as (rows, columns)?" },
        ))
    }
}

/// Returns the array itself if it is contiguous, or a contiguous copy.
fn whole<'py>(array: &Bound<'py, PyUntypedArray>) -> PyResult<Bound<'py, PyAny>> {
    let is_aligned: bool = array.getattr("flags")?.getattr("aligned")?.extract()?;
    if array.is_c_contiguous() && is_aligned {
        Ok(array.clone().into_any())
    } else {
        array.call_method1("copy", ("C",))
    }
}
