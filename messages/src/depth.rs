//! Depth images: one `u16` per pixel, row by row, in units of the header's `depth_scale`.

use crate::{Header, Item, Kind, Malformed};

/// The pixel holds no measurement.
pub const INVALID_NEAR: u16 = 0;
/// The pixel holds no measurement, as some sensors write it.
pub const INVALID_FAR: u16 = u16::MAX;

/// Whether a depth pixel holds a measurement.
#[inline]
pub fn is_measured(pixel: u16) -> bool {
    pixel != INVALID_NEAR && pixel != INVALID_FAR
}

impl Item for u16 {
    const KIND: Kind = Kind::Depth;
    const TYPE_NAME: &'static str = "conicflow.DepthPixel.v1";

    fn check(header: &Header, items: &[Self]) -> Result<(), Malformed> {
        let (width, height) = (header.camera.width, header.camera.height);
        if width == 0 || height == 0 || items.len() as u64 != u64::from(width) * u64::from(height) {
            let what = format!("{} pixels in a frame of {width}x{height}", items.len());
            return Err(Malformed::new(Kind::Depth, what));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Camera;

    #[test]
    fn length_has_to_match_the_header() {
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
}
