//! Boxes in the image of a recorded frame that were drawn by hand around things that were not measured.

use anyhow::{Result, bail};
use conicflow_messages::{Camera, Hinted, plain};
use serde::{Deserialize, Deserializer};

/// A box in a truth file.
#[derive(Clone, Debug, Deserialize)]
pub struct BoxEntry {
    #[serde(default, deserialize_with = "one_line")]
    what: String,
    /// Left, top, right, bottom, in pixels.
    #[serde(rename = "box")]
    corners: Option<[f64; 4]>,
}

/// Reads a text from outside so that it can be shown in a line.
///
/// # Errors
/// The value is no text.
pub fn one_line<'de, D: Deserializer<'de>>(read: D) -> Result<String, D::Error> {
    Ok(plain(&String::deserialize(read)?.replace('\n', "\\n")))
}

/// A box around something.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelBox {
    /// Name of its content.
    pub what: String,
    corners: [f64; 4],
}

impl BoxEntry {
    /// Returns the box; `None` if the entry only has a name.
    ///
    /// # Errors
    /// The corners enclose no pixel.
    pub fn pixel_box(&self) -> Result<Option<PixelBox>> {
        let Some(corners @ [left, top, right, bottom]) = self.corners else { return Ok(None) };
        if !(left < right && top < bottom) {
            bail!(Hinted::new(
                format!("the box {corners:?} of `{}` has no inside", self.what),
                "write [left, top, right, bottom]"
            ));
        }
        Ok(Some(PixelBox { what: self.what.clone(), corners }))
    }
}

impl PixelBox {
    /// Whether the box contains the pixel of a point in the camera's frame: `u = cx + fx x / z`, `v = cy + fy y / z`.
    pub fn shows(&self, camera: &Camera, [x, y, z]: &[f64; 3]) -> bool {
        let [left, top, right, bottom] = self.corners;
        let (u, v) = (camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z);
        *z > 0.0 && (left..=right).contains(&u) && (top..=bottom).contains(&v)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(corners: [f64; 4]) -> Result<Option<PixelBox>> {
        BoxEntry { what: "glass".into(), corners: Some(corners) }.pixel_box()
    }

    #[test]
    fn a_box_shows_what_lies_before_the_camera_between_its_corners() {
        let camera = Camera { width: 640, height: 480, fx: 500.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        let glass = read([420.0, 140.0, 520.0, 200.0]).unwrap().unwrap();
        // Pixel (420, 200) at 2 m is 0.4 m to the right and 0.2 m up, and (520, 140) 0.8 m and 0.5 m.
        for (point, is_shown) in [
            ([0.4, -0.2, 2.0], true),
            ([0.8, -0.5, 2.0], true),
            ([0.39, -0.2, 2.0], false),
            ([0.4, -0.19, 2.0], false),
            ([0.81, -0.5, 2.0], false),
            ([0.8, -0.51, 2.0], false),
            ([-0.6, 0.3, -2.0], false),
        ] {
            assert_eq!(glass.shows(&camera, &point), is_shown, "{point:?}");
        }
    }

    #[test]
    fn a_box_without_an_inside_is_refused_and_a_word_alone_is_none() {
        for corners in [[5.0, 1.0, 5.0, 2.0], [5.0, 2.0, 6.0, 2.0], [6.0, 1.0, 5.0, 2.0], [5.0, 2.0, 6.0, 1.0]] {
            let error = read(corners).unwrap_err().to_string();
            assert!(error.contains("`glass` has no inside"), "{error}");
        }
        assert_eq!(read([f64::NAN, 1.0, 5.0, 2.0]).ok(), None);
        assert_eq!(BoxEntry { what: "wall".into(), corners: None }.pixel_box().unwrap(), None);
    }
}
