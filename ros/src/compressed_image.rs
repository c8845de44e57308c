//! `sensor_msgs/CompressedImage` as written by the plugin `compressedDepth` of image_transport: 12 bytes with the quantisation of
//! depths in metres, then a PNG or RVL image.
//!
//! Source: ros-perception/image_transport_plugins, `compressed_depth_image_transport/src/codec.cpp`.

use crate::image::{Depths, Encoding, check_size};
use crate::{Reader, Stamped, Undecodable, rvl};
use png::{BitDepth, ColorType, Decoder, Limits};
use std::io::Cursor;

/// Memory that the decoder of a PNG may allocate besides the image.
const PNG_MEMORY_BYTES: usize = 64 << 20;

/// A compressed image.
#[derive(Clone, Debug, PartialEq)]
pub struct CompressedImage<'a> {
    /// Time of capture and frame of the camera.
    pub stamped: Stamped<'a>,
    /// The encoding of the pixels and the compression, such as `16UC1; compressedDepth png`.
    pub format: &'a str,
    data: &'a [u8],
}

/// The compression of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Code {
    Png,
    Rvl,
}

impl<'a> CompressedImage<'a> {
    /// Decodes a message without its pixels.
    ///
    /// # Errors
    /// It is no such message.
    pub fn read(message: &'a [u8]) -> Result<Self, Undecodable> {
        let mut reader = Reader::new(message)?;
        Ok(Self { stamped: reader.stamped()?, format: reader.text()?, data: reader.bytes()? })
    }

    /// Whether its format is that of a depth image.
    pub fn is_depth(&self) -> bool {
        self.format.contains("compressedDepth")
    }

    fn encoding(&self) -> Result<(Encoding, Code), Undecodable> {
        let (encoding, code) = self.format.split_once(';').unwrap_or((self.format, "compressedDepth"));
        let code = match code.trim() {
            "compressedDepth" | "compressedDepth png" => Some(Code::Png),
            "compressedDepth rvl" => Some(Code::Rvl),
            _ => None,
        };
        Encoding::of(encoding.trim()).zip(code).ok_or_else(|| {
            let what = format!(
                "the format is `{}`, expected `16UC1` or `32FC1` with `compressedDepth`, `compressedDepth png` or \
                 `compressedDepth rvl`",
                self.format
            );
            Undecodable::hinted(what, "name the topic of a depth image")
        })
    }

    /// Decodes the width, the height and the depths.
    ///
    /// # Errors
    /// It is no compressed depth image, or it is damaged.
    pub fn depths(&self) -> Result<((u32, u32), Depths), Undecodable> {
        let (encoding, code) = self.encoding()?;
        let Some((&[_, _, _, _, a0, a1, a2, a3, b0, b1, b2, b3], image)) = self.data.split_first_chunk::<12>() else {
            return Err(Undecodable::new(format!("{} bytes, expected a header of 12 and an image", self.data.len())));
        };
        let (a, b) = (f32::from_le_bytes([a0, a1, a2, a3]), f32::from_le_bytes([b0, b1, b2, b3]));
        let (size, units) = match code {
            Code::Png => png(image)?,
            Code::Rvl => rvl_image(image)?,
        };
        if encoding != Encoding::Metres {
            return Ok((size, Depths::Units(units)));
        }
        // Inverse depth in equal steps: v = a / z + b; 0: no measurement.
        let metres = |v: u16| if v == 0 { f32::NAN } else { a / (f32::from(v) - b) };
        Ok((size, Depths::Metres(units.into_iter().map(metres).collect())))
    }
}

fn png(file: &[u8]) -> Result<((u32, u32), Vec<u16>), Undecodable> {
    let fault = |error: png::DecodingError| Undecodable::new(format!("the PNG in it: {error}"));
    let mut decoder = Decoder::new_with_limits(Cursor::new(file), Limits { bytes: PNG_MEMORY_BYTES });
    decoder.set_ignore_text_chunk(true);
    let info = decoder.read_header_info().map_err(fault)?;
    let (size, bits, color) = (info.size(), info.bit_depth, info.color_type);
    if (bits, color) != (BitDepth::Sixteen, ColorType::Grayscale) {
        return Err(Undecodable::new(format!("a PNG of {bits:?} bits {color:?} in it, expected 16 bits grey")));
    }
    check_size(size.0, size.1)?;
    let mut reader = decoder.read_info().map_err(fault)?;
    let mut bytes = vec![0; size.0 as usize * size.1 as usize * 2];
    reader.next_frame(&mut bytes).map_err(fault)?;
    Ok((size, bytes.as_chunks().0.iter().map(|pixel| u16::from_be_bytes(*pixel)).collect()))
}

fn rvl_image(image: &[u8]) -> Result<((u32, u32), Vec<u16>), Undecodable> {
    let Some((&[w0, w1, w2, w3, h0, h1, h2, h3], code)) = image.split_first_chunk::<8>() else {
        return Err(Undecodable::new(format!("{} bytes of RVL, expected the size and an image", image.len())));
    };
    let size = (u32::from_le_bytes([w0, w1, w2, w3]), u32::from_le_bytes([h0, h1, h2, h3]));
    check_size(size.0, size.1)?;
    Ok((size, rvl::decode(code, size.0 as usize * size.1 as usize)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Writer;
    use crate::rvl::tests::encode;

    const PIXELS: [u16; 6] = [0, 1000, 1001, 65535, 0, 40000];

    fn message(format: &str, header: [f32; 2], image: &[u8]) -> Vec<u8> {
        let mut writer = Writer::new(Vec::new());
        let config = [1_u32.to_le_bytes(), header[0].to_le_bytes(), header[1].to_le_bytes()].concat();
        let data = [&config, image].concat();
        writer.stamped(Stamped { stamp_ns: 3, frame_id: "camera" }).text(format);
        writer.bytes(data.len(), data.iter().copied());
        writer.finish()
    }

    fn png_of(color: ColorType, bits: BitDepth, bytes: &[u8]) -> Vec<u8> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, 3, 2);
        encoder.set_color(color);
        encoder.set_depth(bits);
        encoder.write_header().unwrap().write_image_data(bytes).unwrap();
        file
    }

    fn grey() -> Vec<u8> {
        png_of(ColorType::Grayscale, BitDepth::Sixteen, &PIXELS.map(u16::to_be_bytes).concat())
    }

    fn rvl_of() -> Vec<u8> {
        [&3_u32.to_le_bytes()[..], &2_u32.to_le_bytes(), &encode(&PIXELS)].concat()
    }

    fn depths(message: &[u8]) -> Result<((u32, u32), Depths), Undecodable> {
        CompressedImage::read(message)?.depths()
    }

    #[test]
    fn units_are_decoded_from_png_and_rvl() {
        for (format, image) in [
            ("16UC1; compressedDepth", grey()),
            ("16UC1; compressedDepth png", grey()),
            ("16UC1", grey()),
            ("16UC1; compressedDepth rvl", rvl_of()),
        ] {
            let message = message(format, [0.0; 2], &image);
            assert_eq!(depths(&message).unwrap(), ((3, 2), Depths::Units(PIXELS.to_vec())), "{format}");
        }
    }

    #[test]
    fn metres_are_decoded_from_inverse_depths() {
        for (format, image) in [("32FC1; compressedDepth png", grey()), ("32FC1; compressedDepth rvl", rvl_of())] {
            let (size, depths) = depths(&message(format, [2000.0, 1.0], &image)).unwrap();
            let Depths::Metres(metres) = depths else { panic!("{depths:?}") };
            assert_eq!((size, metres[1], metres[2]), ((3, 2), 2000.0 / 999.0, 2.0));
            assert!(metres[0].is_nan() && metres[4].is_nan());
        }
    }

    #[test]
    fn malformed_images_are_refused() {
        let error = |format: &str, image: &[u8]| depths(&message(format, [0.0; 2], image)).unwrap_err().to_string();
        assert!(error("jpeg", &grey()).starts_with("the format is `jpeg`, expected `16UC1` or `32FC1`"));
        assert!(error("16UC1; compressedDepth zip", &grey()).starts_with("the format is `16UC1; compressedDepth zip`"));
        assert!(error("16UC1; compressedDepth", &grey()[..50]).starts_with("the PNG in it: "));
        let colour = png_of(ColorType::Rgb, BitDepth::Eight, &[0; 18]);
        assert!(error("16UC1; compressedDepth", &colour).starts_with("a PNG of Eight bits Rgb in it"));
        assert_eq!(error("16UC1; compressedDepth rvl", &[1; 5]), "5 bytes of RVL, expected the size and an image");
        assert!(error("16UC1; compressedDepth rvl", &[0xff; 12]).starts_with("an image of 4294967295x4294967295"));
        assert!(error("16UC1; compressedDepth rvl", &rvl_of()[..12]).starts_with("the RVL code is broken after"));
    }
}
