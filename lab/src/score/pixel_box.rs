//! Boxes in the image of a recorded frame that someone drew by hand, about what was not measured.

use anyhow::{Result, bail};
use conicflow_messages::{Camera, Hinted};
use serde::Deserialize;

/// A box as it stands in a truth file.
#[derive(Clone, Debug, Deserialize)]
pub struct BoxEntry {
    #[serde(default)]
    what: String,
    /// Pixels: left, top, right, bottom.
    #[serde(rename = "box")]
    corners: Option<[f64; 4]>,
}

/// A box about something.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelBox {
    /// What it is.
    pub what: String,
    corners: [f64; 4],
}

impl BoxEntry {
    /// The box; `None` where there is but a word for what is seen.
    ///
    /// # Errors
    /// Its corners have no pixel between them.
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
    /// Whether a point of the camera's frame is seen in the box: `u = cx + fx x / z`, `v = cy + fy y / z`.
    pub fn shows(&self, camera: &Camera, [x, y, z]: &[f64; 3]) -> bool {
        let [left, top, right, bottom] = self.corners;
        let (u, v) = (camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z);
        *z > 0.0 && (left..=right).contains(&u) && (top..=bottom).contains(&v)
    }
}
