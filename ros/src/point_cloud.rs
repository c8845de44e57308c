//! Organised `sensor_msgs/PointCloud2`, with one point per pixel of a depth image: the z of its points is the depth.

use crate::image::check_size;
use crate::{Depths, Reader, Stamped, Undecodable};
use conicflow_messages::Camera;

/// Maximum number of fields of a point; drivers have up to a dozen.
const MOST_FIELDS: u32 = 64;
/// The code of single precision.
pub(crate) const FLOAT32: u8 = 7;
/// Maximum distance of a point from its pixel in the camera, in pixels.
const MOST_PIXELS_OFF: f64 = 1.0;

/// A point cloud.
#[derive(Clone, Debug, PartialEq)]
pub struct PointCloud<'a> {
    /// Time of capture and frame of the camera.
    pub stamped: Stamped<'a>,
    /// Points per row.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
    /// Offsets of x, y and z in a point, each in single precision.
    offsets: [usize; 3],
    is_big_endian: bool,
    /// Bytes per point and per row, with padding.
    point_step: usize,
    row_step: usize,
    data: &'a [u8],
}

impl<'a> PointCloud<'a> {
    /// Decodes a message without its points.
    ///
    /// # Errors
    /// It is no such message, not organised, or too large.
    pub fn read(message: &'a [u8]) -> Result<Self, Undecodable> {
        let mut reader = Reader::new(message)?;
        let stamped = reader.stamped()?;
        let (height, width) = (reader.u32()?, reader.u32()?);
        if height == 1 {
            let hint = "depth_image_proc of ROS makes organised ones; or name the topic of the depth images";
            return Err(Undecodable::hinted("the points are in no rows: the cloud has a height of 1", hint));
        }
        check_size(width, height)?;
        let offsets = offsets(&mut reader)?;
        let is_big_endian = reader.u8()? != 0;
        let [point_step, row_step] = [reader.u32()?, reader.u32()?].map(|bytes| bytes as usize);
        let data = reader.bytes()?;
        let row = width as usize * point_step;
        let is_whole = offsets.iter().all(|offset| offset + 4 <= point_step)
            && row_step >= row
            && data.len() >= row_step * (height as usize - 1) + row;
        if !is_whole {
            return Err(Undecodable::new(format!(
                "{} bytes of points of {point_step} in rows of {row_step}, expected {width}x{height} points",
                data.len()
            )));
        }
        Ok(Self { stamped, width, height, offsets, is_big_endian, point_step, row_step, data })
    }

    /// Decodes the depths of the points, in metres.
    pub fn depths(&self) -> Depths {
        Depths::Metres(self.points().map(|point| self.number(point, self.offsets[2])).collect())
    }

    /// Whether most points lie where this camera sees their pixels.
    pub fn is_of(&self, camera: &Camera) -> bool {
        let (mut near, mut far) = (0_usize, 0_usize);
        for (place, point) in self.points().enumerate() {
            let [x, y, z] = self.offsets.map(|offset| f64::from(self.number(point, offset)));
            if z.is_finite() && z > 0.0 {
                let (column, row) = (place % self.width as usize, place / self.width as usize);
                let off = [camera.fx * x / z + camera.cx - column as f64, camera.fy * y / z + camera.cy - row as f64];
                let is_near = off.iter().all(|pixels| pixels.abs() <= MOST_PIXELS_OFF);
                *if is_near { &mut near } else { &mut far } += 1;
            }
        }
        far <= near
    }

    fn points(&self) -> impl Iterator<Item = &'a [u8]> {
        let (row, point) = (self.width as usize * self.point_step, self.point_step);
        let rows = self.data.chunks(self.row_step).take(self.height as usize);
        rows.flat_map(move |padded| padded[..row].chunks_exact(point))
    }

    fn number(&self, point: &[u8], offset: usize) -> f32 {
        let mut bytes = [0; 4];
        bytes.copy_from_slice(&point[offset..offset + 4]);
        if self.is_big_endian { f32::from_be_bytes(bytes) } else { f32::from_le_bytes(bytes) }
    }
}

/// Reads the offsets of x, y and z in a point.
fn offsets(reader: &mut Reader<'_>) -> Result<[usize; 3], Undecodable> {
    let fields = reader.u32()?;
    if fields > MOST_FIELDS {
        return Err(Undecodable::new(format!("points of {fields} fields")));
    }
    let mut offsets = [None; 3];
    for _ in 0..fields {
        let (name, offset, kind, _count) = (reader.text()?, reader.u32()?, reader.u8()?, reader.u32()?);
        if let Some(axis) = ["x", "y", "z"].iter().position(|axis| *axis == name).filter(|_| kind == FLOAT32) {
            offsets[axis] = Some(offset as usize);
        }
    }
    match offsets {
        [Some(x), Some(y), Some(z)] => Ok([x, y, z]),
        _ => Err(Undecodable::new("the points have no x, y and z in single precision".to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Writer;

    const STAMPED: Stamped<'_> = Stamped { stamp_ns: 7, frame_id: "camera" };
    const CAMERA: Camera = Camera { width: 3, height: 2, fx: 10.0, fy: 10.0, cx: 1.0, cy: 0.5 };

    /// A cloud of 3x2 points with a depth of 1, 2, .. metres, 20 bytes each with x from byte 4 on, in rows of 64.
    fn message(height: u32, to_bytes: fn(f32) -> [u8; 4], is_big_endian: bool, kind: u8) -> Vec<u8> {
        let mut data = Vec::new();
        for (row, column) in [(0.0, 0.0), (0.0, 1.0), (0.0, 2.0), (1.0, 0.0), (1.0, 1.0), (1.0, 2.0)] {
            let z = 1.0 + 3.0 * row + column;
            let point = [0.0, z * (column - 1.0) / 10.0, z * (row - 0.5) / 10.0, z, 9.0_f32];
            data.extend(point.into_iter().flat_map(to_bytes));
            data.extend(if column == 2.0 { &[0_u8; 4][..] } else { &[] });
        }
        let mut writer = Writer::new(Vec::new());
        writer.stamped(STAMPED).u32(height).u32(3).length(3);
        for (name, offset) in [("x", 4), ("y", 8), ("z", 12)] {
            writer.text(name).u32(offset).u8(kind).u32(1);
        }
        writer.u8(is_big_endian.into()).u32(20).u32(64).bytes(data.len(), data.iter().copied()).u8(0);
        writer.finish()
    }

    #[test]
    fn depths_are_read_in_both_byte_orders_with_padding() {
        let little = message(2, f32::to_le_bytes, false, FLOAT32);
        let big = message(2, f32::to_be_bytes, true, FLOAT32);
        for message in [little, big] {
            let cloud = PointCloud::read(&message).unwrap();
            assert_eq!((cloud.stamped, cloud.width, cloud.height), (STAMPED, 3, 2));
            assert_eq!(cloud.depths(), Depths::Metres(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
            assert!(cloud.is_of(&CAMERA));
            assert!(!cloud.is_of(&Camera { fx: 60.0, cy: 4.0, ..CAMERA }), "another camera");
        }
    }

    #[test]
    fn a_cloud_that_is_not_organised_is_refused() {
        let error = |message: &[u8]| PointCloud::read(message).unwrap_err().to_string();
        let good = message(2, f32::to_le_bytes, false, FLOAT32);
        assert!(error(&message(1, f32::to_le_bytes, false, FLOAT32)).starts_with("the points are in no rows"));
        assert!(error(&message(2, f32::to_le_bytes, false, 8)).contains("no x, y and z"));
        let more_rows = message(3, f32::to_le_bytes, false, FLOAT32);
        assert_eq!(error(&more_rows), "128 bytes of points of 20 in rows of 64, expected 3x3 points");
        assert!(error(&good[..good.len() - 9]).contains("the message ends"));
        let steps = good.windows(8).position(|bytes| bytes == [20, 0, 0, 0, 64, 0, 0, 0]).unwrap();
        for (at, bytes) in [(steps, [8, 0, 0, 0]), (steps, [255; 4]), (steps + 4, [0; 4]), (steps + 4, [255; 4])] {
            let mut spoilt = good.clone();
            spoilt[at..at + 4].copy_from_slice(&bytes);
            assert!(error(&spoilt).contains("expected 3x2 points"), "{bytes:?} at {at}");
        }
    }
}
