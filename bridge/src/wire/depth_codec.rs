//! Lossless compression of depth images. Neighbouring pixels differ little, so the differences along each row are zigzag-coded,
//! split into a plane of low bytes and one of high bytes, and compressed.

use super::compression::{pack, unpack};
use conicflow_dataflow::pipeline::Compression;

/// Appends the compressed pixels of an image of `width` columns to `bytes`.
pub(super) fn compress(pixels: &[u16], width: usize, how: Compression, bytes: &mut Vec<u8>) -> Result<(), String> {
    if how == Compression::None {
        bytes.extend(pixels.iter().flat_map(|pixel| pixel.to_le_bytes()));
    } else {
        bytes.extend(pack(how, &split(pixels, width))?);
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
    pixels.clear();
    if how == Compression::None {
        pixels.extend(unpacked.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])));
    } else {
        join(&unpacked, width, pixels);
    }
    Ok(())
}

/// Returns the differences along the rows: all low bytes, then all high bytes.
fn split(pixels: &[u16], width: usize) -> Vec<u8> {
    let (mut low, mut high) = (Vec::with_capacity(2 * pixels.len()), Vec::with_capacity(pixels.len()));
    for row in pixels.chunks(width.max(1)) {
        let mut left = 0;
        for &pixel in row {
            let [small, large] = zigzag(pixel.wrapping_sub(left)).to_le_bytes();
            low.push(small);
            high.push(large);
            left = pixel;
        }
    }
    low.append(&mut high);
    low
}

fn join(planes: &[u8], width: usize, pixels: &mut Vec<u16>) {
    let (low, high) = planes.split_at(planes.len() / 2);
    for (low, high) in low.chunks(width.max(1)).zip(high.chunks(width.max(1))) {
        let mut left = 0_u16;
        for (&small, &large) in low.iter().zip(high) {
            left = left.wrapping_add(unzigzag(u16::from_le_bytes([small, large])));
            pixels.push(left);
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
