//! Lossless compression of depth images. Neighbouring pixels differ little, so the differences along each row are zigzag-coded,
//! split into a plane of low bytes and one of high bytes, and compressed.

use super::compression::{pack, unpack};
use bytemuck::{cast_slice, cast_slice_mut};
use conicflow_dataflow::pipeline::Compression;

/// Appends the compressed pixels of an image of `width` columns to `bytes`.
pub(super) fn compress(pixels: &[u16], width: usize, how: Compression, bytes: &mut Vec<u8>) -> Result<(), String> {
    match how {
        Compression::None => bytes.extend_from_slice(cast_slice(pixels)),
        _ => bytes.extend_from_slice(&pack(how, &split(pixels, width))?),
    }
    Ok(())
}

/// Decompresses the pixels of an image of `width` times `height` into `pixels`, which is overwritten.
pub(super) fn decompress(
    bytes: &[u8],
    (width, height): (usize, usize),
    how: Compression,
    pixels: &mut Vec<u16>,
) -> Result<(), String> {
    let unpacked = unpack(how, bytes, 2 * width * height)?;
    pixels.resize(width * height, 0);
    match how {
        Compression::None => cast_slice_mut(pixels).copy_from_slice(&unpacked),
        _ => join(&unpacked, width, pixels),
    }
    Ok(())
}

/// Returns the differences along the rows: all low bytes, then all high bytes.
fn split(pixels: &[u16], width: usize) -> Vec<u8> {
    let (mut planes, width) = (vec![0; 2 * pixels.len()], width.max(1));
    let (low, high) = planes.split_at_mut(pixels.len());
    for ((row, low), high) in pixels.chunks(width).zip(low.chunks_mut(width)).zip(high.chunks_mut(width)) {
        let mut left = 0;
        for ((&pixel, low), high) in row.iter().zip(low).zip(high) {
            [*low, *high] = zigzag(pixel.wrapping_sub(left)).to_le_bytes();
            left = pixel;
        }
    }
    planes
}

fn join(planes: &[u8], width: usize, pixels: &mut [u16]) {
    let ((low, high), width) = (planes.split_at(pixels.len()), width.max(1));
    for ((row, low), high) in pixels.chunks_mut(width).zip(low.chunks(width)).zip(high.chunks(width)) {
        // First all differences, which do not depend on each other, then their sums.
        for ((difference, &low), &high) in row.iter_mut().zip(low).zip(high) {
            *difference = unzigzag(u16::from_le_bytes([low, high]));
        }
        let mut left = 0_u16;
        for pixel in row {
            left = left.wrapping_add(*pixel);
            *pixel = left;
        }
    }
}

/// Maps 0, -1, 1, -2, 2.. to 0, 1, 2, 3, 4..
fn zigzag(difference: u16) -> u16 {
    let sign = if difference & 0x8000 == 0 { 0 } else { u16::MAX };
    (difference << 1) ^ sign
}

fn unzigzag(code: u16) -> u16 {
    (code >> 1) ^ (code & 1).wrapping_neg()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_difference_of_two_depths_is_decoded_exactly() {
        for difference in 0..=u16::MAX {
            assert_eq!(unzigzag(zigzag(difference)), difference);
        }
        assert_eq!([0, u16::MAX, 1, u16::MAX - 1].map(zigzag), [0, 1, 2, 3]);
    }

    #[test]
    fn a_slanted_plane_takes_a_tenth_of_its_bytes() {
        let pixels: Vec<u16> = (0..640 * 480).map(|index| 800 + (index % 640 + index / 640) as u16 / 3).collect();
        for how in [Compression::Lz4, Compression::Zstd] {
            let mut bytes = Vec::new();
            compress(&pixels, 640, how, &mut bytes).unwrap();
            assert!(bytes.len() < pixels.len() / 5, "{how:?}: {} bytes", bytes.len());
        }
    }
}
