//! Depth images as 16-bit grey PNGs: distinguished from colour images by their header, decoded straight into the message.

use anyhow::{Context as _, Result, bail, ensure};
use conicflow_messages::{Hinted, MAX_PIXELS};
use png::{BitDepth, ColorType, Decoder, Info, Reader};
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

/// Hint of the errors about unreadable files.
pub(super) const HINT: &str = "depth images are 16-bit grey PNGs; copy or record this one anew, or take it out";

/// The kind of image in a PNG.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Content {
    /// 16-bit grey: width and height.
    Depth(u32, u32),
    /// Anything else: colour, or grey of 8 bits or fewer.
    Picture(BitDepth, ColorType),
}

impl Content {
    fn of(info: &Info) -> Result<Self> {
        if (info.bit_depth, info.color_type) != (BitDepth::Sixteen, ColorType::Grayscale) {
            return Ok(Self::Picture(info.bit_depth, info.color_type));
        }
        let frames = info.animation_control().map_or(1, |animation| animation.num_frames);
        ensure!(
            frames <= 1,
            Hinted::new(format!("it has {frames} frames, of which one would be read"), "write a file for each frame")
        );
        let (width, height) = info.size();
        let pixels = u64::from(width) * u64::from(height);
        ensure!(pixels <= MAX_PIXELS, "{width}x{height} pixels, which is more than the {MAX_PIXELS} that are read");
        Ok(Self::Depth(width, height))
    }

    /// Describes the kind of image for errors.
    pub(super) fn name(self) -> String {
        let (bits, color) = match self {
            Self::Depth(..) => (BitDepth::Sixteen, ColorType::Grayscale),
            Self::Picture(bits, color) => (bits, color),
        };
        let color = match color {
            ColorType::Grayscale => "grey",
            ColorType::GrayscaleAlpha => "grey and transparent",
            ColorType::Rgb | ColorType::Rgba | ColorType::Indexed => "colour",
        };
        format!("{}-bit {color} PNG", bits as u8)
    }

    /// Returns width and height of a depth image.
    ///
    /// # Errors
    /// The PNG is no depth image.
    pub(super) fn depth_size(self) -> Result<(u32, u32)> {
        match self {
            Self::Depth(width, height) => Ok((width, height)),
            Self::Picture(..) => bail!(Hinted::new(
                format!("this is no depth image ({}), expected 16-bit grey", self.name()),
                "depth images are 16-bit grey PNGs; this one may be a colour image, or a depth image that was \
                 rendered for the eye"
            )),
        }
    }
}

/// Reads the header of a PNG file.
///
/// # Errors
/// The file cannot be read or is no PNG.
pub(super) fn probe(path: &Path) -> Result<Content> {
    let file = File::open(path)?;
    let mut decoder = Decoder::new(BufReader::with_capacity(64, file));
    let info = decoder.read_header_info().context("the header of the PNG")?;
    Content::of(info)
}

/// Decodes a PNG file of `width` x `height` pixels; only the byte order changes.
///
/// # Errors
/// The file is no depth image of that size, or damaged.
pub(super) fn decode(file: &[u8], size: (u32, u32), pixels: &mut [u16]) -> Result<()> {
    let mut reader = open(Cursor::new(file))?;
    let got = Content::of(reader.info())?.depth_size()?;
    ensure!(got == size, "{}x{} pixels, expected {}x{}", got.0, got.1, size.0, size.1);
    ensure!(
        pixels.len() == size.0 as usize * size.1 as usize,
        "{} places for {}x{} pixels",
        pixels.len(),
        size.0,
        size.1
    );
    reader.next_frame(bytemuck::cast_slice_mut(pixels)).context("the pixels of the PNG")?;
    for pixel in pixels {
        *pixel = u16::from_be(*pixel);
    }
    Ok(())
}

fn open<R: BufRead + Seek>(read: R) -> Result<Reader<R>> {
    let mut decoder = Decoder::new(read);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    decoder.read_info().context("the header of the PNG")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::image_source::fixtures::{png_bytes, png16};
    use png::Encoder;

    #[test]
    fn pixels_are_decoded_in_native_byte_order() {
        let pixels: Vec<u16> = (0..12).map(|i| i * 0x0123 + 1).collect();
        let mut decoded = vec![0; 12];
        decode(&png16(4, 3, &pixels), (4, 3), &mut decoded).unwrap();
        assert_eq!(decoded, pixels);
    }

    #[test]
    fn an_image_without_depths_is_refused() {
        let error = |file: &[u8], size| format!("{:#}", decode(file, size, &mut [0; 12]).unwrap_err());
        let good = png16(4, 3, &(0..12).map(|i| i * 4001).collect::<Vec<_>>());
        let rgb = png_bytes(4, 3, ColorType::Rgb, BitDepth::Eight, &[9; 36]);
        assert!(
            error(&rgb, (4, 3))
                .starts_with("this is no depth image (8-bit colour PNG), expected 16-bit grey\n  hint: ")
        );
        assert_eq!(error(&good, (4, 2)), "4x3 pixels, expected 4x2");
        assert!(error(&good[..good.len() - 20], (4, 3)).starts_with("the pixels of the PNG: "));
        assert!(error(&good[..20], (4, 3)).starts_with("the header of the PNG: "));
        assert!(error(b"no PNG at all", (4, 3)).starts_with("the header of the PNG: "));
    }

    #[test]
    fn an_animated_png_is_refused() {
        let mut file = Vec::new();
        let mut encoder = Encoder::new(&mut file, 4, 3);
        encoder.set_color(ColorType::Grayscale);
        encoder.set_depth(BitDepth::Sixteen);
        encoder.set_animated(2, 0).unwrap();
        let mut writer = encoder.write_header().unwrap();
        (0..2).for_each(|_| writer.write_image_data(&[7; 24]).unwrap());
        writer.finish().unwrap();
        let error = format!("{:#}", decode(&file, (4, 3), &mut [0; 12]).unwrap_err());
        assert_eq!(error, "it has 2 frames, of which one would be read\n  hint: write a file for each frame");
    }

    #[test]
    fn an_impossible_size_is_refused_from_the_header() {
        let mut file = png16(4, 3, &[1; 12]);
        file[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        let check = crc32(&file[12..29]);
        file[29..33].copy_from_slice(&check.to_be_bytes());
        let error = format!("{:#}", decode(&file, (4, 3), &mut [0; 12]).unwrap_err());
        assert!(error.starts_with("16384x16384 pixels, which is more than the 67108864 that are read"), "{error}");
    }

    fn crc32(bytes: &[u8]) -> u32 {
        let step = |crc: u32| if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 };
        !bytes.iter().fold(!0, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |crc, _| step(crc)))
    }
}
