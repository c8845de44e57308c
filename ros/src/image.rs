//! `sensor_msgs/Image` with a depth image: 16-bit integers, or metres.

use crate::{Reader, Stamped, Undecodable, Writer};
use conicflow_messages::{MAX_PIXELS, MAX_SIDE_PX, finest_scale, is_too_far, quantise};

/// Unit of integer depths in ROS (REP 118), in metres.
const UNIT_M: f64 = 0.001;

/// The encoding of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// `16UC1`: integers, by convention millimetres (REP 118); 0: no measurement.
    Units,
    /// `mono16`: the same bytes, but often the brightness of an infrared image.
    Mono,
    /// `32FC1`: metres; NaN: no measurement.
    Metres,
}

impl Encoding {
    /// Returns the encoding of this name, or `None` if it is not one of depth images.
    pub fn of(words: &str) -> Option<Self> {
        match words {
            "16UC1" => Some(Self::Units),
            "mono16" => Some(Self::Mono),
            "32FC1" => Some(Self::Metres),
            _ => None,
        }
    }

    fn bytes(self) -> usize {
        if self == Self::Metres { 4 } else { 2 }
    }
}

/// The pixels of a depth image, row by row.
#[derive(Clone, Debug, PartialEq)]
pub enum Depths {
    /// In integer units of some length.
    Units(Vec<u16>),
    /// In metres.
    Metres(Vec<f32>),
}

impl Depths {
    /// Converts the pixels to integer units. `depth_scale` is the length of an integer unit, or of 1.0 in single precision, in
    /// metres; by convention a millimetre or a metre, respectively.
    pub fn in_units(self, depth_scale: Option<f64>) -> Units {
        match self {
            Self::Units(pixels) => Units { pixels, depth_scale: depth_scale.unwrap_or(UNIT_M), too_far: 0 },
            Self::Metres(depths) => {
                let metres_per_z = depth_scale.unwrap_or(1.0);
                let scale = finest_scale(&depths, metres_per_z);
                let units_per_z = metres_per_z / scale;
                let too_far = depths.iter().filter(|&&z| is_too_far(z, units_per_z)).count() as u64;
                let pixels = depths.iter().map(|&z| quantise(z, units_per_z)).collect();
                Units { pixels, depth_scale: scale, too_far }
            }
        }
    }
}

/// The pixels of a depth image in integer units.
#[derive(Clone, Debug, PartialEq)]
pub struct Units {
    /// Row by row, in units of `depth_scale`.
    pub pixels: Vec<u16>,
    /// The unit in metres.
    pub depth_scale: f64,
    /// Number of measurements beyond the range of the units, which were dropped.
    pub too_far: u64,
}

/// A `sensor_msgs/Image`.
#[derive(Clone, Debug, PartialEq)]
pub struct Image<'a> {
    /// Time of capture and frame of the camera.
    pub stamped: Stamped<'a>,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// The encoding of the pixels, by its ROS name.
    pub encoding: &'a str,
    is_big_endian: bool,
    /// Bytes per row, with padding.
    step: u32,
    data: &'a [u8],
}

impl<'a> Image<'a> {
    /// Decodes a message without its pixels.
    ///
    /// # Errors
    /// It is no such message, or the image is too large.
    pub fn read(message: &'a [u8]) -> Result<Self, Undecodable> {
        let mut reader = Reader::new(message)?;
        let stamped = reader.stamped()?;
        let (height, width) = (reader.u32()?, reader.u32()?);
        check_size(width, height)?;
        let (encoding, is_big_endian, step) = (reader.text()?, reader.u8()? != 0, reader.u32()?);
        Ok(Self { stamped, width, height, encoding, is_big_endian, step, data: reader.bytes()? })
    }

    /// Returns the encoding of a message's pixels, without checking its size.
    ///
    /// # Errors
    /// It is no such message.
    pub fn encoding_of(message: &'a [u8]) -> Result<&'a str, Undecodable> {
        let mut reader = Reader::new(message)?;
        reader.stamped()?;
        let (_height, _width) = (reader.u32()?, reader.u32()?);
        reader.text()
    }

    /// Decodes the depths of the pixels.
    ///
    /// # Errors
    /// It is no depth image, or has too few bytes.
    pub fn depths(&self) -> Result<Depths, Undecodable> {
        let Some(encoding) = Encoding::of(self.encoding) else {
            let what = format!("pixels are `{}`, expected `16UC1`, `32FC1` or `mono16`", self.encoding);
            return Err(Undecodable::hinted(what, "name the topic of a depth image"));
        };
        let (row, step) = (self.width as usize * encoding.bytes(), self.step as usize);
        // The padding of the last row may be missing.
        if step < row || self.data.len() < step * (self.height as usize - 1) + row {
            return Err(Undecodable::new(format!(
                "{} bytes of pixels in rows of {step}, expected {}x{} pixels of {} bytes",
                self.data.len(),
                self.width,
                self.height,
                encoding.bytes()
            )));
        }
        let rows = self.data.chunks(step).take(self.height as usize).map(|padded| &padded[..row]);
        Ok(match encoding {
            Encoding::Metres => Depths::Metres(numbers(rows, self.is_big_endian, f32::from_le_bytes)),
            Encoding::Units | Encoding::Mono => Depths::Units(numbers(rows, self.is_big_endian, u16::from_le_bytes)),
        })
    }
}

/// Checks the size of an image.
///
/// # Errors
/// It is out of range.
pub(crate) fn check_size(width: u32, height: u32) -> Result<(), Undecodable> {
    let side = |pixels| (1..=MAX_SIDE_PX).contains(&pixels);
    if side(width) && side(height) && u64::from(width) * u64::from(height) <= MAX_PIXELS {
        return Ok(());
    }
    Err(Undecodable::new(format!(
        "an image of {width}x{height} pixels, expected 1 to {MAX_SIDE_PX} a side and {MAX_PIXELS} at most"
    )))
}

fn numbers<'a, const N: usize, T>(
    rows: impl Iterator<Item = &'a [u8]>,
    is_big_endian: bool,
    from_le_bytes: fn([u8; N]) -> T,
) -> Vec<T> {
    let pixels = rows.flat_map(|row| row.as_chunks::<N>().0);
    pixels
        .map(|&(mut bytes)| {
            if is_big_endian {
                bytes.reverse();
            }
            from_le_bytes(bytes)
        })
        .collect()
}

/// Encodes a message with a depth image in integer millimetres.
pub fn write_units(stamped: Stamped<'_>, (width, height): (u32, u32), pixels: &[u16], memory: Vec<u8>) -> Vec<u8> {
    let data = pixels.iter().flat_map(|pixel| pixel.to_le_bytes());
    write(stamped, (width, height), "16UC1", (2, data), memory)
}

/// Encodes a message with a depth image in metres.
pub fn write_metres(
    stamped: Stamped<'_>,
    (width, height): (u32, u32),
    depths: impl Iterator<Item = f32>,
    memory: Vec<u8>,
) -> Vec<u8> {
    let data = depths.flat_map(f32::to_le_bytes);
    write(stamped, (width, height), "32FC1", (4, data), memory)
}

fn write(
    stamped: Stamped<'_>,
    (width, height): (u32, u32),
    encoding: &str,
    (pixel_bytes, data): (u32, impl Iterator<Item = u8>),
    memory: Vec<u8>,
) -> Vec<u8> {
    let mut writer = Writer::new(memory);
    writer.stamped(stamped).u32(height).u32(width).text(encoding).u8(0).u32(pixel_bytes * width);
    writer.bytes(pixel_bytes as usize * width as usize * height as usize, data);
    writer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAMPED: Stamped<'_> = Stamped { stamp_ns: 7, frame_id: "camera" };

    /// An image of 3x2 pixels in rows of `step` bytes.
    fn message(encoding: &str, is_big_endian: bool, step: u32, data: &[u8]) -> Vec<u8> {
        let mut writer = Writer::new(Vec::new());
        writer.stamped(STAMPED).u32(2).u32(3).text(encoding).u8(is_big_endian.into()).u32(step);
        writer.bytes(data.len(), data.iter().copied());
        writer.finish()
    }

    fn depths(message: &[u8]) -> Result<Depths, Undecodable> {
        Image::read(message)?.depths()
    }

    #[test]
    fn units_are_read_in_both_byte_orders_with_padding() {
        let expected = Depths::Units(vec![1, 2, 0x0304, 5, 6, 65535]);
        let little = [1, 0, 2, 0, 4, 3, 9, 9, 5, 0, 6, 0, 255, 255, 9, 9];
        let big = [0, 1, 0, 2, 3, 4, 9, 9, 0, 5, 0, 6, 255, 255];
        for encoding in ["16UC1", "mono16"] {
            assert_eq!(depths(&message(encoding, false, 8, &little)).unwrap(), expected);
            assert_eq!(depths(&message(encoding, true, 8, &big)).unwrap(), expected, "without padding at the end");
        }
    }

    #[test]
    fn metres_are_read_in_both_byte_orders() {
        let numbers = [0.5_f32, 1.0, f32::INFINITY, 2.0, 3.25, 4.0];
        let bytes = |of: fn(f32) -> [u8; 4]| numbers.into_iter().flat_map(of).collect::<Vec<u8>>();
        for (is_big_endian, data) in [(false, bytes(f32::to_le_bytes)), (true, bytes(f32::to_be_bytes))] {
            assert_eq!(depths(&message("32FC1", is_big_endian, 12, &data)).unwrap(), Depths::Metres(numbers.to_vec()));
        }
    }

    #[test]
    fn a_written_image_is_read_back() {
        let pixels = [0, 1, 65535, 4, 5, 6];
        let written = write_units(STAMPED, (3, 2), &pixels, Vec::new());
        let image = Image::read(&written).unwrap();
        assert_eq!((image.stamped, image.width, image.height, image.encoding), (STAMPED, 3, 2, "16UC1"));
        assert_eq!(image.depths().unwrap(), Depths::Units(pixels.to_vec()));
        let metres = [0.5, 1.0, 1.5, 2.0, 3.25, 4.0];
        let written = write_metres(STAMPED, (3, 2), metres.into_iter(), written);
        assert_eq!(depths(&written).unwrap(), Depths::Metres(metres.to_vec()));
    }

    #[test]
    fn depths_beyond_the_last_unit_are_left_out_and_counted() {
        let depths = Depths::Metres(vec![1.0, 16.3, 16.5, 2000.0, f32::INFINITY, f32::NAN]);
        let expected = Units { pixels: vec![4000, 65200, 0, 0, 0, 0], depth_scale: 0.000_25, too_far: 2 };
        assert_eq!(depths.in_units(None), expected);
        let millimetres = Depths::Metres(vec![1000.0, 16300.0]).in_units(Some(0.001));
        assert_eq!(millimetres, Units { pixels: vec![4000, 65200], depth_scale: 0.000_25, too_far: 0 });
        let units = Units { pixels: vec![1, 65535], depth_scale: 0.001, too_far: 0 };
        assert_eq!(Depths::Units(units.pixels.clone()).in_units(None), units);
    }

    #[test]
    fn an_image_without_depths_is_refused() {
        let error = |message: &[u8]| depths(message).unwrap_err().to_string();
        assert!(error(&message("rgb8", false, 9, &[0; 18])).starts_with("pixels are `rgb8`, expected `16UC1`"));
        let short = "13 bytes of pixels in rows of 8, expected 3x2 pixels of 2 bytes";
        assert_eq!(error(&message("16UC1", false, 8, &[0; 13])), short);
        assert!(error(&message("16UC1", false, 5, &[0; 12])).contains("in rows of 5"));
        assert!(error(&message("16UC1", false, 0, &[0; 12])).contains("in rows of 0"));
        let mut huge = message("16UC1", false, 6, &[0; 12]);
        let at = 4 + 8 + 4 + 7 + 1;
        assert_eq!(&huge[at..at + 8], [2, 0, 0, 0, 3, 0, 0, 0]);
        huge[at + 2] = 0xff;
        assert!(error(&huge).starts_with("an image of 3x16711682 pixels"));
        huge[at..at + 4].fill(0);
        assert!(error(&huge).starts_with("an image of 3x0 pixels"));
    }
}
