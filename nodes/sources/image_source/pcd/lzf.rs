//! LZF decompression, as in binary_compressed PCD.
//!
//! The format of Marc Lehmann's liblzf: a control byte below 32 begins a run of that many plus one literal bytes. Any other one
//! holds a length in its upper three bits (7: one more byte follows); its lower bits and the next byte hold a distance, 1 to
//! 8192, back into the output.

use anyhow::{Context as _, Result, anyhow, bail};

/// Largest number of output bytes per byte of input: 3 bytes copy 264.
pub(super) const MAX_RATIO: usize = 88;

/// Decompresses `input` so that it fills `output` exactly.
///
/// # Errors
/// The input is cut off, refers back beyond its beginning, or holds more or less than `output`.
pub(super) fn decompress(input: &[u8], output: &mut [u8]) -> Result<()> {
    let (mut read, mut written) = (0, 0);
    while let Some(&control) = input.get(read) {
        let control = usize::from(control);
        read += 1;
        if control < 32 {
            let literals = input.get(read..=read + control).ok_or_else(cut_off)?;
            room(output, written, literals.len())?.copy_from_slice(literals);
            (read, written) = (read + literals.len(), written + literals.len());
        } else {
            let (length, distance, used) = reference(control, &input[read..])?;
            room(output, written, length)?;
            copy_back(output, written, distance, length)?;
            (read, written) = (read + used, written + length);
        }
    }
    if written < output.len() {
        bail!("the compressed data holds {written} bytes, expected {}", output.len());
    }
    Ok(())
}

fn cut_off() -> anyhow::Error {
    anyhow!("the compressed data ends in the middle of a run")
}

/// Returns length, distance and number of further bytes of a reference whose control byte has been read.
fn reference(control: usize, rest: &[u8]) -> Result<(usize, usize, usize)> {
    let byte = |index: usize| rest.get(index).copied().map(usize::from).ok_or_else(cut_off);
    let (length, used) = match control >> 5 {
        7 => (7 + byte(0)?, 1),
        short => (short, 0),
    };
    let distance = ((control & 31) << 8) + byte(used)? + 1;
    Ok((length + 2, distance, used + 1))
}

fn room(output: &mut [u8], start: usize, length: usize) -> Result<&mut [u8]> {
    let expected = output.len();
    let end = start + length;
    output
        .get_mut(start..end)
        .with_context(|| format!("the compressed data holds more than the expected {expected} bytes"))
}

/// Copies bytes that may overlap with their copy: a distance of 1 repeats one byte.
fn copy_back(output: &mut [u8], at: usize, distance: usize, length: usize) -> Result<()> {
    let from = at.checked_sub(distance).context("the compressed data refers back beyond its beginning")?;
    // The bytes from `from` on repeat every `distance` bytes, so that each copy may be twice as long as the last.
    let mut done = 0;
    while done < length {
        let part = (distance + done).min(length - done);
        output.copy_within(from..from + part, at + done);
        done += part;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::image_source::fixtures::lzf_compress;

    fn round_trip(data: &[u8]) -> usize {
        let packed = lzf_compress(data);
        let mut unpacked = vec![0; data.len()];
        decompress(&packed, &mut unpacked).unwrap();
        assert_eq!(unpacked, data);
        packed.len()
    }

    #[test]
    fn data_of_literals_alone_is_decompressed() {
        let data: Vec<u8> = (0..200_u32).map(|i| ((i * i * 7919) >> 3) as u8).collect();
        assert!(round_trip(&data) > data.len() * 9 / 10);
        assert_eq!(round_trip(&[]), 0);
    }

    #[test]
    fn short_and_long_near_and_far_repetitions_are_decompressed() {
        assert!(round_trip(&[7; 5000]) < 100, "a run refers to itself");
        let pattern: Vec<u8> = (0..9000_u32).map(|i| ((i % 3000) * 31 % 251) as u8).collect();
        assert!(round_trip(&pattern) < 5000, "references reach back by hundreds of bytes");
    }

    #[test]
    fn a_reference_written_byte_by_byte_is_decompressed() {
        // Three literals, then 2 + 2 bytes from a distance of 3.
        let mut output = [0; 7];
        decompress(&[2, b'a', b'b', b'c', 2 << 5, 2], &mut output).unwrap();
        assert_eq!(&output, b"abcabca");
    }

    #[test]
    fn malformed_input_is_refused() {
        let error = |input: &[u8]| decompress(input, &mut [0; 4]).unwrap_err().to_string();
        assert_eq!(error(&[5, 1, 2]), "the compressed data ends in the middle of a run");
        assert_eq!(error(&[0, 1, 0xe0]), "the compressed data ends in the middle of a run");
        assert_eq!(error(&[0, 1, 0x20, 9]), "the compressed data refers back beyond its beginning");
        assert_eq!(error(&[0, 1, 0xe0, 255, 0]), "the compressed data holds more than the expected 4 bytes");
        assert_eq!(error(&[0, 1]), "the compressed data holds 1 bytes, expected 4");
    }
}
