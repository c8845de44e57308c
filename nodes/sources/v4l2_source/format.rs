//! The depth formats of Linux drivers, and the layout of the pixels in a buffer.
//!
//! After the kernel's documentation of V4L2, "Depth Formats": Z16 has 16 bits a pixel, little-endian; INZI has two planes of the
//! same size one after the other, infrared and then depth as Z16. Y16 is grey of 16 bits: some cameras send depth as that.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// A pixel format with depths.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DepthFormat {
    /// `Z16 `: depth.
    Z16,
    /// `INZI`: infrared and depth.
    Inzi,
    /// `Y16 `: grey, which is depth with some cameras and infrared with others.
    Y16,
}

impl DepthFormat {
    /// Formats that always hold depth, the preferred one first.
    pub const CERTAIN: [Self; 2] = [Self::Z16, Self::Inzi];
    const ALL: [Self; 3] = [Self::Z16, Self::Inzi, Self::Y16];

    /// The format's four letters in V4L2.
    pub const fn fourcc(self) -> [u8; 4] {
        match self {
            Self::Z16 => *b"Z16 ",
            Self::Inzi => *b"INZI",
            Self::Y16 => *b"Y16 ",
        }
    }

    /// Returns the format with these letters.
    pub fn of(fourcc: [u8; 4]) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.fourcc() == fourcc)
    }

    /// The format's word in a pipeline file.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Z16 => "z16",
            Self::Inzi => "inzi",
            Self::Y16 => "y16",
        }
    }
}

/// The layout of a stream's images in its buffers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Pixel format.
    pub format: DepthFormat,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from one row to the next, as the driver reports them; 0: rows have no gaps.
    pub bytes_per_line: u32,
}

/// Error for a buffer that is shorter than an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Short {
    /// Number of bytes in the buffer.
    pub bytes: usize,
    /// Number of bytes of an image.
    pub expected: usize,
}

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "an image with {} of {} bytes", self.bytes, self.expected)
    }
}

impl Layout {
    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Copies the depths of a buffer.
    ///
    /// # Errors
    /// The buffer ends before the image does.
    pub fn unpack(&self, buffer: &[u8], image: &mut [u16]) -> Result<(), Short> {
        let row = self.width as usize * 2;
        let (begin, stride) = match self.format {
            // INZI's bytes per line count both planes, although one follows the other.
            DepthFormat::Inzi => (row * self.height as usize, row),
            DepthFormat::Z16 | DepthFormat::Y16 => (0, row.max(self.bytes_per_line as usize)),
        };
        let expected = begin + stride * (self.height as usize).saturating_sub(1) + row;
        let Some(plane) = buffer.get(begin..expected) else {
            return Err(Short { bytes: buffer.len(), expected });
        };
        for (line, pixels) in plane.chunks(stride).zip(image.chunks_exact_mut(self.width as usize)) {
            for (bytes, pixel) in line.chunks_exact(2).zip(pixels) {
                *pixel = u16::from_le_bytes([bytes[0], bytes[1]]);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(format: DepthFormat, bytes_per_line: u32) -> Layout {
        Layout { format, width: 3, height: 2, bytes_per_line }
    }

    fn unpacked(layout: &Layout, buffer: &[u8]) -> Result<Vec<u16>, Short> {
        let mut image = vec![9; layout.pixels()];
        layout.unpack(buffer, &mut image).map(|()| image)
    }

    const ROWS: [u8; 12] = [1, 0, 2, 0, 3, 1, 4, 0, 5, 0, 255, 255];
    const DEPTHS: [u16; 6] = [1, 2, 259, 4, 5, 65535];

    #[test]
    fn rows_lie_with_and_without_gaps() {
        for format in [DepthFormat::Z16, DepthFormat::Y16] {
            for bytes_per_line in [0, 6] {
                assert_eq!(unpacked(&layout(format, bytes_per_line), &ROWS).unwrap(), DEPTHS);
            }
            let padded = [&ROWS[..6], &[7, 7], &ROWS[6..]].concat();
            assert_eq!(unpacked(&layout(format, 8), &padded).unwrap(), DEPTHS, "the last row needs no gap");
            assert_eq!(unpacked(&layout(format, 8), &[&padded[..], &[7; 90]].concat()).unwrap(), DEPTHS);
        }
    }

    #[test]
    fn depth_is_the_second_plane_of_inzi() {
        let buffer = [[7_u8; 12], ROWS].concat();
        assert_eq!(unpacked(&layout(DepthFormat::Inzi, 12), &buffer).unwrap(), DEPTHS);
        let short = unpacked(&layout(DepthFormat::Inzi, 12), &ROWS).unwrap_err();
        assert_eq!(short, Short { bytes: 12, expected: 24 });
    }

    #[test]
    fn a_buffer_that_ends_too_early_is_refused() {
        for bytes in [0, 1, 11] {
            let short = unpacked(&layout(DepthFormat::Z16, 6), &ROWS[..bytes]).unwrap_err();
            assert_eq!(short, Short { bytes, expected: 12 });
        }
        assert!(unpacked(&layout(DepthFormat::Z16, 8), &ROWS).is_err(), "the rows would overlap");
    }

    #[test]
    fn format_codes_are_those_of_the_kernel() {
        for format in DepthFormat::ALL {
            assert_eq!(DepthFormat::of(format.fourcc()), Some(format));
        }
        assert_eq!(DepthFormat::of(*b"YUYV"), None);
    }
}
