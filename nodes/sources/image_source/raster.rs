//! Depth images as TIFF and NPY files: single images of one channel, 16-bit whole numbers or floating point. They do not describe
//! the camera.

use super::npy::Array;
use anyhow::{Context as _, Result, bail, ensure};
use conicflow_messages::{Hinted, MAX_PIXELS};
use std::io::Cursor;
use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult};

/// Hint of the errors about unreadable TIFFs.
pub(super) const TIFF_HINT: &str = "depth images are TIFFs with one channel of 16-bit whole numbers or 32-bit floating point, \
                                    uncompressed or compressed by LZW, Deflate or PackBits; write this one anew";
/// Hint of the errors about unreadable NPY files.
pub(super) const NPY_HINT: &str = "depth images are arrays of rows and columns, of uint16 or float32; \
                                   `np.save(path, np.ascontiguousarray(depth, dtype=np.uint16))` writes one";

/// The depths of an image, row by row.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Depths {
    /// In units of some length.
    Units(Vec<u16>),
    /// In metres, or in another unit if a scale is given; NaN where there is no measurement.
    Metres(Vec<f32>),
}

impl Depths {
    fn len(&self) -> usize {
        match self {
            Self::Units(depths) => depths.len(),
            Self::Metres(depths) => depths.len(),
        }
    }
}

/// Decodes a TIFF; `size` is the expected width and height.
///
/// # Errors
/// It is damaged, of another size, or no depth image.
pub(super) fn decode_tiff(file: &[u8], size: (u32, u32)) -> Result<Depths> {
    let mut decoder = open_tiff(Cursor::new(file))?;
    expect_size(tiff_size_of(&mut decoder)?, size)?;
    let depths = match decoder.read_image().context("the pixels of the TIFF")? {
        DecodingResult::U16(depths) => Depths::Units(depths),
        DecodingResult::F32(depths) => Depths::Metres(depths),
        DecodingResult::F64(depths) => Depths::Metres(depths.into_iter().map(|depth| depth as f32).collect()),
        _ => bail!(Hinted::new("the TIFF holds numbers of another kind", TIFF_HINT)),
    };
    expect_all(depths, size)
}

/// Width and height of a TIFF that holds a depth image.
///
/// # Errors
/// The file is no TIFF, or its content is no depth image.
pub(super) fn tiff_size<R: std::io::Read + std::io::Seek>(file: R) -> Result<(u32, u32)> {
    tiff_size_of(&mut open_tiff(file)?)
}

fn open_tiff<R: std::io::Read + std::io::Seek>(file: R) -> Result<Decoder<R>> {
    Decoder::new(file).context("the header of the TIFF")
}

fn tiff_size_of<R: std::io::Read + std::io::Seek>(decoder: &mut Decoder<R>) -> Result<(u32, u32)> {
    let color = decoder.colortype().context("the header of the TIFF")?;
    ensure!(
        matches!(color, ColorType::Gray(16 | 32 | 64)),
        Hinted::new(format!("this is no depth image ({color:?}), expected one channel"), TIFF_HINT)
    );
    let what = "a TIFF of several pages, expected one depth image";
    ensure!(!decoder.more_images(), Hinted::new(what, "write each page into a file of its own"));
    let size = decoder.dimensions().context("the header of the TIFF")?;
    few_enough(size)
}

/// Decodes an NPY file; `size` is the expected width and height.
///
/// # Errors
/// It is damaged, of another size, or no depth image.
pub(super) fn decode_npy(mut file: &[u8], size: (u32, u32)) -> Result<Depths> {
    let array = npy_header(&mut file)?;
    expect_size(npy_size_of(&array)?, size)?;
    let depths = match array.number.as_bytes() {
        [.., b'u', b'2'] => Depths::Units(array.numbers(file, u16::from_le_bytes)),
        [.., b'f', b'4'] => Depths::Metres(array.numbers(file, f32::from_le_bytes)),
        _ => Depths::Metres(array.numbers(file, |depth| f64::from_le_bytes(depth) as f32)),
    };
    expect_all(depths, size)
}

/// Width and height of an NPY file that holds a depth image.
///
/// # Errors
/// The file is no NPY file, or its content is no depth image.
pub(super) fn npy_size(mut file: impl std::io::Read) -> Result<(u32, u32)> {
    npy_size_of(&npy_header(&mut file)?)
}

fn npy_header(file: &mut impl std::io::Read) -> Result<Array> {
    Array::read(file).context("the header of the NPY file")
}

fn npy_size_of(array: &Array) -> Result<(u32, u32)> {
    let (shape, number) = (&array.shape, &array.number);
    let &[rows, columns] = &shape[..] else {
        bail!(Hinted::new(format!("an array of shape {shape:?}, expected rows and columns"), NPY_HINT));
    };
    let is_depth = ["u2", "f4", "f8"].iter().any(|known| number.trim_start_matches(['<', '>', '=']) == *known);
    ensure!(is_depth, Hinted::new(format!("an array of '{number}', expected uint16, float32 or float64"), NPY_HINT));
    let is_by_columns = array.is_by_columns && rows > 1 && columns > 1;
    ensure!(!is_by_columns, Hinted::new("an array that lies column by column, expected row by row", NPY_HINT));
    let side = |length: u64| u32::try_from(length).with_context(|| format!("{length} pixels in a row or column"));
    few_enough((side(columns)?, side(rows)?))
}

fn few_enough(size: (u32, u32)) -> Result<(u32, u32)> {
    let pixels = u64::from(size.0) * u64::from(size.1);
    ensure!((1..=MAX_PIXELS).contains(&pixels), "{}x{} pixels, expected 1 to {MAX_PIXELS} of them", size.0, size.1);
    Ok(size)
}

fn expect_size(got: (u32, u32), size: (u32, u32)) -> Result<()> {
    ensure!(got == size, "{}x{} pixels, expected {}x{}", got.0, got.1, size.0, size.1);
    Ok(())
}

fn expect_all(depths: Depths, size: (u32, u32)) -> Result<Depths> {
    let expected = size.0 as usize * size.1 as usize;
    ensure!(depths.len() == expected, "{} numbers for {}x{} pixels", depths.len(), size.0, size.1);
    Ok(depths)
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{CAMERA, depth_m, units};
    use super::super::{Config, Recording};
    use super::*;
    use conicflow_detection::camera::Intrinsics;
    use conicflow_messages::Camera;
    use std::fs;
    use tempfile::TempDir;
    use tiff::encoder::{Compression, TiffEncoder, colortype};

    const SIZE: (u32, u32) = (CAMERA.width, CAMERA.height);

    /// Encodes an NPY file of version 1.
    fn npy(number: &str, order: &str, shape: &str, numbers: &[u8]) -> Vec<u8> {
        let header = format!("{{'descr': '{number}', 'fortran_order': {order}, 'shape': {shape}, }}");
        let length = (10 + header.len() + 1).next_multiple_of(64) - 10;
        let header = format!("{header:<width$}\n", width = length - 1);
        [b"\x93NUMPY\x01\x00", &(length as u16).to_le_bytes()[..], header.as_bytes(), numbers].concat()
    }

    fn tiff<C: colortype::ColorType>(numbers: &[C::Inner], how: Compression) -> Vec<u8>
    where
        [C::Inner]: tiff::encoder::TiffValue,
    {
        let mut file = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut file).unwrap().with_compression(how);
        encoder.write_image::<C>(SIZE.0, SIZE.1, numbers).unwrap();
        file.into_inner()
    }

    /// Writes frames into a folder, and returns the scale and the pixels of the first one.
    fn recorded(files: &[(&str, Vec<u8>)], depth_scale: Option<f64>) -> Result<(f64, Vec<u16>)> {
        let folder = TempDir::new().unwrap();
        files.iter().for_each(|(name, bytes)| fs::write(folder.path().join(name), bytes).unwrap());
        let Camera { fx, fy, cx, cy, .. } = CAMERA;
        let intrinsics = Some(Intrinsics { fx, fy, cx, cy });
        let mut recording = Recording::open(folder.path(), &Config { intrinsics, depth_scale, ..Config::default() })?;
        let frame = recording.load(0)?;
        let mut pixels = vec![0; recording.pixels()];
        recording.decode(&mut pixels)?;
        Ok((frame.depth_scale, pixels))
    }

    fn error_of(files: &[(&str, Vec<u8>)]) -> String {
        format!("{:#}", recorded(files, None).unwrap_err())
    }

    #[test]
    fn whole_numbers_are_depth_units_as_in_a_png() {
        let expected = units(&depth_m(), 0.001);
        let bytes = |to: fn(u16) -> [u8; 2]| expected.iter().flat_map(|unit| to(*unit)).collect::<Vec<u8>>();
        let shape = format!("({}, {})", SIZE.1, SIZE.0);
        for (name, file) in [
            ("1.tiff", tiff::<colortype::Gray16>(&expected, Compression::Uncompressed)),
            ("1.tif", tiff::<colortype::Gray16>(&expected, Compression::Lzw)),
            ("1.TIF", tiff::<colortype::Gray16>(&expected, Compression::Deflate(Default::default()))),
            ("1.npy", npy("<u2", "False", &shape, &bytes(u16::to_le_bytes))),
            ("1.npy", npy(">u2", "False", &shape, &bytes(u16::to_be_bytes))),
        ] {
            assert_eq!(recorded(&[(name, file)], None).unwrap(), (0.001, expected.clone()), "{name}");
        }
    }

    #[test]
    fn floating_point_is_metres_unless_a_scale_says_otherwise() {
        let metres = depth_m();
        let expected = units(&metres, 0.0001);
        let millimetres: Vec<f32> = metres.iter().map(|depth| depth * 1000.0).collect();
        let shape = format!("({}, {})", SIZE.1, SIZE.0);
        let singles: Vec<u8> = metres.iter().flat_map(|depth| depth.to_le_bytes()).collect();
        let doubles: Vec<u8> = metres.iter().flat_map(|depth| f64::from(*depth).to_be_bytes()).collect();
        let near = |got: &[u16]| got.iter().zip(&expected).all(|(got, expected)| got.abs_diff(*expected) <= 1);
        for (name, file, scale) in [
            ("1.tiff", tiff::<colortype::Gray32Float>(&metres, Compression::Deflate(Default::default())), None),
            ("1.tiff", tiff::<colortype::Gray32Float>(&millimetres, Compression::Uncompressed), Some(0.001)),
            ("1.npy", npy("<f4", "False", &shape, &singles), None),
            ("1.npy", npy(">f8", "False", &shape, &doubles), None),
        ] {
            let (scale, pixels) = recorded(&[(name, file)], scale).unwrap();
            assert_eq!(scale, 0.0001, "{name}");
            assert!(near(&pixels) && pixels.contains(&0) && pixels.iter().any(|pixel| *pixel > 10_000), "{name}");
        }
    }

    #[test]
    fn an_image_without_depths_is_refused_with_its_description() {
        let colour = vec![7_u8; 3 * (SIZE.0 * SIZE.1) as usize];
        let colour_error = error_of(&[("1.tiff", tiff::<colortype::RGB8>(&colour, Compression::Uncompressed))]);
        assert!(colour_error.contains("no depth image (RGB(8))"), "{colour_error}");
        let page = vec![7_u16; (SIZE.0 * SIZE.1) as usize];
        let mut two_pages = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut two_pages).unwrap();
        (0..2).for_each(|_| encoder.write_image::<colortype::Gray16>(SIZE.0, SIZE.1, &page).unwrap());
        let pages_error = error_of(&[("1.tiff", two_pages.into_inner())]);
        assert!(pages_error.contains("a TIFF of several pages, expected one depth image"), "{pages_error}");
        let wide = vec![7_u32; (SIZE.0 * SIZE.1) as usize];
        let wide_error = error_of(&[("1.tiff", tiff::<colortype::Gray32>(&wide, Compression::Uncompressed))]);
        assert!(wide_error.contains("numbers of another kind"), "{wide_error}");
        let array =
            |number: &str, order: &str, shape: &str| error_of(&[("1.npy", npy(number, order, shape, &[0; 64]))]);
        assert!(array("<u2", "False", "(2, 4, 4)").contains("shape [2, 4, 4], expected rows and columns\n  hint: "));
        assert!(
            array("<i8", "False", "(2, 4)")
                .contains("an array of '<i8', expected uint16, float32 or float64\n  hint: ")
        );
        assert!(array("<u2", "True", "(4, 8)").contains("column by column"));
        assert!(array("<u2", "False", "(40, 80)").contains("1.npy"), "cut");
        assert!(array("<u2", "False", "(4000000, 8000000)").contains("4000000"));
        assert!(array("<u2", "False", "(4294967296, 4294967296)").contains("4294967296 pixels in a row"));
        assert!(array("<u2", "False", "(18446744073709551616, 4)").contains("the header of the NPY file: it is `{"));
        assert!(array("<u2", "Maybe", "(2, 4)").contains("the header of the NPY file: it is `{"));
        let long = [b"\x93NUMPY\x02\x00", &u32::MAX.to_le_bytes()[..], b"{"].concat();
        assert!(error_of(&[("1.npy", long)]).contains("it has 4294967295 bytes, expected at most 10000"));
        assert!(error_of(&[("1.npy", b"no array".to_vec())]).contains("the header of the NPY file"));
        assert!(error_of(&[("1.tif", b"no image".to_vec())]).contains("the header of the TIFF"));
    }

    #[test]
    fn frames_of_two_kinds_are_not_one_recording() {
        let unit = npy("<u2", "False", "(2, 4)", &[0; 16]);
        let both = error_of(&[("1.npy", unit.clone()), ("2.tiff", unit)]);
        assert!(both.contains("holds TIFF files and NPY files, expected one kind\n  hint: "), "{both}");
    }
}
