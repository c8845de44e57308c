//! The payload that a stage or source in Python sends: records, an array with the layout of the items, a message as received, or
//! a depth image; and the header fields that it sets.

use crate::depth_array::DepthArray;
use crate::message::Message;
use crate::record::Record;
use crate::tracker::pose;
use crate::{argument, array, fault, settings};
use conicflow_dataflow::ItemType;
use conicflow_messages::{Header, NoiseModel, Text, finest_scale, quantise};
use numpy::{PyUntypedArray, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyByteArray, PyBytes, PyDict};

/// The bytes of items, and the header fields that follow from them.
pub(crate) struct Payload {
    pub(crate) bytes: Vec<u8>,
    /// Size of an image: columns and rows.
    size: Option<(u32, u32)>,
    /// Metres per unit, if the image was in metres.
    scale: Option<f64>,
}

impl Payload {
    /// Converts the given items.
    pub(crate) fn new(item: &ItemType, given: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(message) = given.cast::<Message>() {
            let message = message.get();
            expect(item, message.item())?;
            let camera = &message.header().camera;
            let size = item.is_image().then_some((camera.width, camera.height));
            return Ok(Self { bytes: message.bytes()?.to_vec(), size, scale: None });
        }
        if item.is_image() {
            return Self::image(given);
        }
        let bytes = match given.cast::<PyUntypedArray>() {
            Ok(array) => structured(item, array)?,
            Err(_) => bytes_of_records(item, given)?,
        };
        Ok(Self { bytes, size: None, scale: None })
    }

    fn image(given: &Bound<'_, PyAny>) -> PyResult<Self> {
        let image = DepthArray::new(given)?;
        let size = Some(image.size()?);
        match &image {
            DepthArray::Units(pixels) => {
                Ok(Self { bytes: bytemuck::cast_slice(pixels.as_slice()?).to_vec(), size, scale: None })
            }
            DepthArray::Metres(metres) => {
                image.warn_of_units(given.py())?;
                let metres = metres.as_slice()?;
                let scale = finest_scale(metres, 1.0);
                let units: Vec<u16> = metres.iter().map(|&z| quantise(z, 1.0 / scale)).collect();
                Ok(Self { bytes: bytemuck::cast_slice(&units).to_vec(), size, scale: Some(scale) })
            }
        }
    }
}

/// Checks that items of one type can be sent as another.
fn expect(item: &ItemType, sent: &ItemType) -> PyResult<()> {
    if item.fits(sent) {
        return Ok(());
    }
    let what = format!("the output carries {}, but {} were to be sent", item.name(), sent.name());
    Err(fault::kind(what, "the pipeline file says what it carries: output = { topic = \"..\", kind = \"..\" }"))
}

/// Returns the bytes of records of this type.
fn bytes_of_records(item: &ItemType, given: &Bound<'_, PyAny>) -> PyResult<Vec<u8>> {
    let mut bytes = Vec::new();
    let items = given.try_iter().map_err(|_| {
        let what = format!("the items are {}, expected a list of records or a NumPy array", argument::describe(given));
        fault::kind(what, "of one record give a list with it, where there is none an empty list")
    })?;
    for each in items {
        let each = each?;
        let record = each.cast::<Record>().ok().filter(|record| item.fits(record.get().item())).ok_or_else(|| {
            let type_name = each.get_type().name().map_or_else(|_| String::new(), |name| name.to_string());
            let hint = "records of conicflow are of one kind, such as Object of objects; the pipeline file says which an output carries";
            fault::kind(format!("a {type_name} is no item of {}", item.name()), hint)
        })?;
        bytes.extend_from_slice(record.get().bytes());
    }
    Ok(bytes)
}

fn structured(item: &ItemType, array: &Bound<'_, PyUntypedArray>) -> PyResult<Vec<u8>> {
    let expected = array::dtype(array.py(), item)?;
    if array.ndim() != 1 || !array.dtype().eq(&expected)? {
        let what =
            format!("the array has {} dimensions of {}, expected one of {expected}", array.ndim(), array.dtype());
        let hint =
            format!("make it by numpy.zeros(n, dtype=conicflow.dtype(\"{}\")), or that of the stage", item.name());
        return Err(fault::kind(what, hint));
    }
    let bytes = array.call_method0("tobytes")?;
    Ok(bytes.cast::<PyBytes>()?.as_bytes().to_vec())
}

/// Converts records to a writable NumPy array of `dtype(kind)`.
///
/// kind: "ellipses", "objects", "tracks" or "velocities".
/// records: a list of records, such as `detect` returns; an empty list gives an empty array.
#[pyfunction]
#[pyo3(name = "array")]
pub(crate) fn of_records<'py>(py: Python<'py>, kind: &str, records: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let item = array::called(kind)?;
    let bytes = PyByteArray::new(py, &bytes_of_records(item, records)?);
    py.import("numpy")?.call_method1("frombuffer", (bytes, array::dtype(py, item)?))
}

/// The header fields that a program sets, by argument name.
#[derive(Default)]
pub(crate) struct HeaderChange {
    camera: Option<(f64, f64, f64, f64)>,
    scale: Option<f64>,
    noise: Option<NoiseModel>,
    stamp_ns: Option<u64>,
    source: Option<String>,
    sequence: Option<u64>,
    pose: Option<[[f64; 4]; 3]>,
}

impl HeaderChange {
    /// Parses the named arguments of `send`.
    pub(crate) fn new(arguments: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let mut change = Self::default();
        for (name, value) in arguments.into_iter().flat_map(|arguments| arguments.iter()) {
            match name.extract::<String>()?.as_str() {
                _ if value.is_none() => {}
                "camera" => {
                    let of = settings::intrinsics(&value)?;
                    change.camera = Some((of.fx, of.fy, of.cx, of.cy));
                }
                "scale" => change.scale = Some(settings::scale(&value)?),
                "noise" => change.noise = Some(settings::noise(Some(&value))?),
                "stamp_ns" => change.stamp_ns = Some(argument::stamp_ns(&value)?),
                "source" => {
                    change.source = Some(argument::word("source", &value, "give the name of the frame's file")?);
                }
                "sequence" => {
                    let hint = "give the number of the frame, or none";
                    change.sequence = Some(argument::whole("sequence", &value, u64::MAX, hint)?);
                }
                "world_from_camera" => change.pose = Some(pose(&value)?),
                other => {
                    let known = "camera, scale, noise, stamp_ns, source, sequence, world_from_camera";
                    return Err(fault::kind(format!("send() has no argument `{other}`"), format!("it has {known}")));
                }
            }
        }
        Ok(change)
    }

    /// The sequence number, if one was given.
    pub(crate) fn sequence(&self) -> Option<u64> {
        self.sequence
    }

    /// Sets the given header fields, and those that follow from the payload.
    pub(crate) fn apply(self, header: &mut Header, payload: &Payload) {
        if let Some((width, height)) = payload.size {
            (header.camera.width, header.camera.height) = (width, height);
        }
        if let Some((fx, fy, cx, cy)) = self.camera {
            (header.camera.fx, header.camera.fy, header.camera.cx, header.camera.cy) = (fx, fy, cx, cy);
        }
        // An image in metres was converted to units of its own scale.
        header.depth_scale = payload.scale.or(self.scale).unwrap_or(header.depth_scale);
        header.noise = self.noise.unwrap_or(header.noise);
        header.stamp_ns = self.stamp_ns.unwrap_or(header.stamp_ns);
        header.sequence = self.sequence.unwrap_or(header.sequence);
        if let Some(source) = &self.source {
            header.source = Text::new(source);
        }
        if let Some(pose) = self.pose {
            header.set_pose(pose);
        }
    }
}
