//! RVL, a lossless code for depth images: alternating runs of zeros and of measurements. Each measurement is coded as the
//! difference from the one before, in groups of three bits.
//!
//! Source: A. D. Wilson, "Fast lossless depth image compression", ISS 2017.

use crate::Undecodable;

/// A reader of four-bit groups from little-endian 32-bit words, the highest group first. A group has three bits of a number, the
/// least significant group first, and above them a flag that more groups follow.
struct Groups<'a> {
    words: std::slice::Chunks<'a, u8>,
    word: u32,
    left: u32,
}

impl Groups<'_> {
    fn number(&mut self) -> Option<u32> {
        let (mut number, mut shift) = (0, 0);
        loop {
            if self.left == 0 {
                let mut bytes = [0; 4];
                let word = self.words.next()?;
                bytes[..word.len()].copy_from_slice(word);
                (self.word, self.left) = (u32::from_le_bytes(bytes), 8);
            }
            let group = self.word >> 28;
            (self.word, self.left) = (self.word << 4, self.left - 1);
            // Eleven groups have more bits than a number.
            number |= (group & 7).checked_shl(shift)?;
            shift += 3;
            if group & 8 == 0 {
                return Some(number);
            }
        }
    }
}

/// Decodes an image of `pixels` pixels.
///
/// # Errors
/// The code is too short, or has more pixels.
pub(crate) fn decode(code: &[u8], pixels: usize) -> Result<Vec<u16>, Undecodable> {
    let fault = |decoded: usize| Undecodable::new(format!("the RVL code is broken after {decoded} of {pixels} pixels"));
    let mut groups = Groups { words: code.chunks(4), word: 0, left: 0 };
    let (mut image, mut previous) = (Vec::with_capacity(pixels), 0_u16);
    while image.len() < pixels {
        let room = |image: &Vec<u16>| pixels - image.len();
        let mut run = |image: &Vec<u16>| groups.number().map(|run| run as usize).filter(|run| *run <= room(image));
        let zeros = run(&image).ok_or_else(|| fault(image.len()))?;
        image.resize(image.len() + zeros, 0);
        let measured = run(&image).ok_or_else(|| fault(image.len()))?;
        if zeros + measured == 0 {
            return Err(fault(image.len()));
        }
        for _ in 0..measured {
            let zigzag = groups.number().ok_or_else(|| fault(image.len()))?;
            let difference = (zigzag >> 1) ^ (zigzag & 1).wrapping_neg();
            previous = previous.wrapping_add(difference as u16);
            image.push(previous);
        }
    }
    Ok(image)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Encodes an image, for tests.
    pub(crate) fn encode(image: &[u16]) -> Vec<u8> {
        let mut groups = Vec::new();
        let mut number = |mut number: u32| loop {
            let group = number & 7;
            number >>= 3;
            groups.push(group | if number > 0 { 8 } else { 0 });
            if number == 0 {
                break;
            }
        };
        let (mut rest, mut previous) = (image, 0_i32);
        while !rest.is_empty() {
            let zeros = rest.iter().take_while(|&&pixel| pixel == 0).count();
            let measured = rest[zeros..].iter().take_while(|&&pixel| pixel != 0).count();
            number(zeros as u32);
            number(measured as u32);
            for &pixel in &rest[zeros..zeros + measured] {
                let difference = i32::from(pixel) - previous;
                number(((difference << 1) ^ (difference >> 31)) as u32);
                previous = i32::from(pixel);
            }
            rest = &rest[zeros + measured..];
        }
        groups
            .chunks(8)
            .flat_map(|word| {
                let word = word.iter().enumerate().fold(0_u32, |word, (at, group)| word | group << (28 - 4 * at));
                word.to_le_bytes()
            })
            .collect()
    }

    #[test]
    fn an_image_encoded_by_hand_is_decoded() {
        // No zeros, one measurement, +5: zigzag 10 = 0b1_010, in groups 1010 and 0001.
        assert_eq!(decode(&0x01a1_0000_u32.to_le_bytes(), 1).unwrap(), [5]);
    }

    #[test]
    fn encoded_images_are_decoded_exactly() {
        let images: [&[u16]; 4] = [&[0; 9], &[1, 65535, 1, 0, 0, 40000], &[0, 0, 7, 7, 7, 0, 3], &[1000; 100]];
        for image in images {
            assert_eq!(decode(&encode(image), image.len()).unwrap(), image);
        }
    }

    #[test]
    fn broken_code_is_refused() {
        let code = encode(&[1, 65535, 1, 0, 0, 40000]);
        assert!(decode(&code[..4], 6).is_err());
        assert!(decode(&code, 5).is_err(), "more pixels than the image has");
        assert_eq!(decode(&[0; 64], 6).unwrap_err().to_string(), "the RVL code is broken after 0 of 6 pixels");
        assert!(decode(&[0xff; 64], 6).is_err(), "a number without end");
    }
}
