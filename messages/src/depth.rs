//! Depth images: one `u16` per pixel, row by row, in units of the header's `depth_scale`.

use crate::{Header, Item, Malformed, Message, ToJson};
use serde::Serialize;

/// The pixel holds no measurement.
pub const INVALID_NEAR: u16 = 0;
/// The pixel holds no measurement, as some sensors write it.
pub const INVALID_FAR: u16 = u16::MAX;

/// Whether a depth pixel holds a measurement.
#[inline]
pub fn is_measured(pixel: u16) -> bool {
    pixel != INVALID_NEAR && pixel != INVALID_FAR
}

/// The median of the measurements, in units of the header's `depth_scale`.
pub fn median_depth(pixels: &[u16]) -> Option<u16> {
    let mut measured: Vec<_> = pixels.iter().copied().filter(|&pixel| is_measured(pixel)).collect();
    if measured.is_empty() {
        return None;
    }
    let middle = measured.len() / 2;
    Some(*measured.select_nth_unstable(middle).1)
}

impl Item for u16 {
    const NAME: &'static str = "depth";
    const TYPE_NAME: &'static str = "conicflow.DepthPixel.v1";
    const USUAL_LENGTH: usize = 640 * 480;
    const IS_IMAGE: bool = true;

    fn check(header: &Header, items: &[Self]) -> Result<(), Malformed> {
        let (width, height) = (header.camera.width, header.camera.height);
        if width == 0 || height == 0 || items.len() as u64 != u64::from(width) * u64::from(height) {
            let what = format!("{} pixels in a frame of {width}x{height}", items.len());
            return Err(Malformed::new(Self::NAME, what));
        }
        Ok(())
    }
}

impl ToJson for u16 {
    fn to_json(&self) -> impl Serialize {
        *self
    }

    fn message_to_json(message: &Message<'_, Self>) -> impl Serialize {
        let Header { camera, depth_scale, .. } = message.header;
        ImageSummary {
            width: camera.width,
            height: camera.height,
            measured: message.items.iter().filter(|&&pixel| is_measured(pixel)).count(),
            median_m: median_depth(message.items).map(|depth| f64::from(depth) * depth_scale),
        }
    }
}

/// An image in JSON: its size, how many pixels measured something, and the median of those in metres.
#[derive(Serialize)]
struct ImageSummary {
    width: u32,
    height: u32,
    measured: usize,
    median_m: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Camera;

    #[test]
    fn the_number_of_pixels_has_to_match_the_header() {
        let camera = Camera { width: 4, height: 3, ..Camera::default() };
        let header = Header { camera, ..Header::default() };
        assert!(u16::check(&header, &[0; 12]).is_ok());
        let error = u16::check(&header, &[0; 11]).unwrap_err();
        assert_eq!(error.to_string(), "malformed depth: 11 pixels in a frame of 4x3");
        for (width, height) in [(640, 0), (0, 480)] {
            let header = Header { camera: Camera { width, height, ..camera }, ..header };
            assert!(u16::check(&header, &[]).is_err(), "{width}x{height}");
        }
    }

    #[test]
    fn pixels_that_hold_no_measurement_are_neither_counted_nor_part_of_the_median() {
        let camera = Camera { width: 3, height: 2, ..Camera::default() };
        let header = Header { camera, depth_scale: 0.001, ..Header::default() };
        let values =
            |items: &[u16]| serde_json::to_string(&u16::message_to_json(&Message { header: &header, items })).unwrap();
        let expected = r#"{"width":3,"height":2,"measured":3,"median_m":1.5}"#;
        assert_eq!(values(&[INVALID_NEAR, 1000, 1500, INVALID_FAR, 2500, INVALID_NEAR]), expected);
        let blank = r#"{"width":3,"height":2,"measured":0,"median_m":null}"#;
        assert_eq!(values(&[INVALID_NEAR, INVALID_FAR, 0, 0, 0, 0]), blank);
    }
}
