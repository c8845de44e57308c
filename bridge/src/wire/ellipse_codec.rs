//! Lossless compression of lists of ellipses.
//!
//! Most numbers of an ellipse follow from the others: a circle has one radius; its centre in the camera frame lies on the plane
//! of its scan line; its depths are whole multiples of the sensor's unit. Both sides compute such numbers as [`expected`], and
//! only the difference of the bits is sent, which is 0 nearly always and otherwise no longer than the number. Integers are sent
//! as differences from the ellipse before. The resulting words are ordered by significance: the highest bytes of all words,
//! number by number, then their second ones and so on, so that equal bytes stand side by side. The compressed list is a `u32`
//! with the count of ellipses, then for each of the eight significances, the highest first, a `u32` with its length and its
//! compressed bytes, all little-endian.

use super::compression::{pack, unpack};
use super::encoding::MAX_MESSAGE;
use bytemuck::{Pod, Zeroable};
use conicflow_dataflow::pipeline::Compression;
use conicflow_messages::{Ellipse, Header, Scan};
use std::array;
use std::mem::offset_of;
use std::ops::Range;

const WHOLE: usize = 8;
const REAL: usize = real_at(size_of::<Ellipse>());
/// How many numbers an ellipse has.
const NUMBERS: usize = WHOLE + REAL;
/// The indices of `beyond` among the real numbers.
const BEYOND: Range<usize> = real_at(offset_of!(Ellipse, beyond))..real_at(offset_of!(Ellipse, contour));
/// The number of bytes, by significance, of a word.
const LEVELS: usize = 8;

/// An [`Ellipse`] as an array of numbers.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Numbers {
    whole: [u32; WHOLE],
    real: [f64; REAL],
}

const _: () = assert!(size_of::<Numbers>() == size_of::<Ellipse>());

/// The number of real numbers before byte `at` of an ellipse.
const fn real_at(at: usize) -> usize {
    (at - WHOLE * size_of::<u32>()) / size_of::<f64>()
}

/// The words of an ellipse that are compressed: small, or equal to others, where possible.
type Words = [u64; NUMBERS];

/// Appends a compressed list to `bytes`.
pub(super) fn compress(
    header: &Header,
    items: &[Ellipse],
    how: Compression,
    bytes: &mut Vec<u8>,
) -> Result<(), String> {
    // The words of all ellipses number by number, as they lie in the planes.
    let (mut words, mut before) = (vec![0; items.len() * NUMBERS], [0; WHOLE]);
    for (index, item) in items.iter().enumerate() {
        let of_item = words[index..].iter_mut().step_by(items.len());
        of_item.zip(to_words(header, item, &mut before)).for_each(|(place, word)| *place = word);
    }
    bytes.extend(length_of(items)?);
    for level in (0..LEVELS).rev() {
        let plane: Vec<_> = words.iter().map(|word| (word >> (8 * level)) as u8).collect();
        let packed = pack(how, &plane)?;
        bytes.extend(length_of(&packed)?);
        bytes.extend_from_slice(&packed);
    }
    Ok(())
}

fn length_of<V>(values: &[V]) -> Result<[u8; 4], String> {
    u32::try_from(values.len()).map(u32::to_le_bytes).map_err(|error| error.to_string())
}

/// Decompresses a list into `items`, which is overwritten.
pub(super) fn decompress(
    header: &Header,
    mut bytes: &[u8],
    how: Compression,
    items: &mut Vec<Ellipse>,
) -> Result<(), String> {
    let count = take_length(&mut bytes)?;
    if count > MAX_MESSAGE / size_of::<Ellipse>() {
        return Err(format!("{count} ellipses, allowed are {}", MAX_MESSAGE / size_of::<Ellipse>()));
    }
    let mut words = vec![0_u64; count * NUMBERS];
    for _ in 0..LEVELS {
        let length = take_length(&mut bytes)?;
        let (packed, rest) = bytes.split_at_checked(length).ok_or("less bytes than a list claims to have")?;
        let plane = unpack(how, packed, words.len())?;
        words.iter_mut().zip(&*plane).for_each(|(word, &byte)| *word = *word << 8 | u64::from(byte));
        bytes = rest;
    }
    let mut before = [0; WHOLE];
    items.clear();
    items.extend((0..count).map(|index| {
        let of_item = array::from_fn(|number| words[number * count + index]);
        from_words(header, &of_item, &mut before)
    }));
    if bytes.is_empty() { Ok(()) } else { Err("more bytes than the list needs".to_owned()) }
}

fn take_length(bytes: &mut &[u8]) -> Result<usize, String> {
    let (length, rest) = bytes.split_first_chunk::<4>().ok_or("a list without its length")?;
    *bytes = rest;
    Ok(u32::from_le_bytes(*length) as usize)
}

fn to_words(header: &Header, item: &Ellipse, before: &mut [u32; WHOLE]) -> Words {
    let numbers: Numbers = bytemuck::cast(*item);
    let expected = expected(header, item);
    let mut words = [0; NUMBERS];
    for (index, whole) in numbers.whole.into_iter().enumerate() {
        words[index] = u64::from(zigzag(whole.wrapping_sub(before[index])));
    }
    for (index, real) in numbers.real.into_iter().enumerate() {
        words[WHOLE + index] = match BEYOND.contains(&index) {
            true => to_steps(real, header.depth_scale),
            false => real.to_bits().wrapping_sub(expected.real[index].to_bits()),
        };
    }
    *before = numbers.whole;
    words
}

fn from_words(header: &Header, words: &Words, before: &mut [u32; WHOLE]) -> Ellipse {
    let mut numbers = Numbers::zeroed();
    for (index, whole) in numbers.whole.iter_mut().enumerate() {
        *whole = unzigzag(words[index] as u32).wrapping_add(before[index]);
    }
    *before = numbers.whole;
    for (index, real) in numbers.real.iter_mut().enumerate() {
        let word = words[WHOLE + index];
        *real = if BEYOND.contains(&index) { from_steps(word, header.depth_scale) } else { f64::from_bits(word) };
    }
    // `expected` uses only numbers for which nothing is expected: these are decoded already.
    let expected = expected(header, &bytemuck::cast(numbers));
    for (real, expected) in numbers.real.iter_mut().zip(expected.real) {
        *real = f64::from_bits(real.to_bits().wrapping_add(expected.to_bits()));
    }
    bytemuck::cast(numbers)
}

/// Returns the numbers of an ellipse that follow from the others, by basic arithmetic, which is the same on every machine; 0 for
/// numbers that do not follow.
fn expected(header: &Header, item: &Ellipse) -> Numbers {
    let radius = item.semi_axes[0];
    let mut moments = [0.0; conicflow_messages::MOMENTS];
    moments[0] = f64::from(item.points);
    let center = center(header, item);
    let circle = Ellipse {
        center: if center.iter().all(|x| x.is_finite()) { center } else { [0.0; 3] },
        semi_axes: [0.0, radius],
        half_width: radius,
        half_depth: radius,
        moments,
        ..Ellipse::default()
    };
    bytemuck::cast(circle)
}

/// Returns the centre in the camera frame from the centre in the plane of the scan line.
fn center(header: &Header, item: &Ellipse) -> [f64; 3] {
    let ([s, t], line, camera) = (item.plane_center, f64::from(item.line), &header.camera);
    let slope = match item.direction() {
        Scan::Row => (line - camera.cy) / camera.fy,
        Scan::Column => (line - camera.cx) / camera.fx,
    };
    let stretch = (1.0 + slope * slope).sqrt();
    let (across, forward) = (t * slope / stretch, t / stretch);
    match item.direction() {
        Scan::Row => [s, across, forward],
        Scan::Column => [across, s, forward],
    }
}

/// Returns `value` as a number of steps, if it is an exact multiple below 2^32; otherwise the complement of its bits. A
/// complement below 2^32 would be that of a NaN.
fn to_steps(value: f64, step: f64) -> u64 {
    let steps = (value / step).round() as u32;
    let is_exact = (f64::from(steps) * step).to_bits() == value.to_bits();
    if is_exact { u64::from(steps) } else { !value.to_bits() }
}

fn from_steps(word: u64, step: f64) -> f64 {
    u32::try_from(word).map_or_else(|_| f64::from_bits(!word), |steps| f64::from(steps) * step)
}

/// Maps 0, -1, 1, -2, 2.. to 0, 1, 2, 3, 4..
fn zigzag(difference: u32) -> u32 {
    (difference << 1) ^ (difference >> 31).wrapping_neg()
}

fn unzigzag(code: u32) -> u32 {
    (code >> 1) ^ (code & 1).wrapping_neg()
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Camera;
    use proptest::prelude::*;

    const HOW: [Compression; 2] = [Compression::Lz4, Compression::Zstd];

    fn header() -> Header {
        let camera = Camera { width: 640, height: 480, fx: 525.0, fy: 520.0, cx: 319.5, cy: 239.5 };
        Header { camera, depth_scale: 0.001, ..Header::default() }
    }

    /// Compresses and decompresses a list; returns it and the number of compressed bytes.
    fn sent(items: &[Ellipse], how: Compression) -> (Vec<Ellipse>, usize) {
        let (mut bytes, mut back) = (Vec::new(), Vec::new());
        compress(&header(), items, how, &mut bytes).unwrap();
        decompress(&header(), &bytes, how, &mut back).unwrap();
        (back, bytes.len())
    }

    /// A circle as the extractor makes it, whose independent numbers are noise.
    fn circle(line: u32, scan: u32) -> Ellipse {
        let noise = |index: u32| f64::from(line * 37 + index).sin();
        let mut moments = [0.0; conicflow_messages::MOMENTS];
        moments.iter_mut().zip(0..).for_each(|(moment, index)| *moment = noise(index));
        let points = 20 + line % 7;
        moments[0] = f64::from(points);
        let mut circle = Ellipse {
            scan,
            line,
            first: 100 + line % 5,
            last: 130,
            points,
            plane_center: [noise(20), 2.0 + noise(21)],
            semi_axes: [0.1 + noise(22).abs(); 2],
            correlation_px: 3.25,
            beyond: [1.234, 0.0],
            moments,
            ..Ellipse::default()
        };
        (circle.half_width, circle.half_depth) = (circle.semi_axes[0], circle.semi_axes[0]);
        circle.center = center(&header(), &circle);
        circle
    }

    #[test]
    fn values_that_follow_from_the_rest_of_an_ellipse_take_no_bytes() {
        let circles: Vec<_> = (0..600).map(|index| circle(index % 300, index / 300)).collect();
        // Seventeen numbers are independent; equal numbers compress to nearly nothing.
        for how in HOW {
            let (back, bytes) = sent(&circles, how);
            assert!(back == circles);
            assert!(bytes < 600 * 17 * 8, "{how:?}: {bytes} bytes");
        }
        let derived =
            |item: &Ellipse| (item.center, item.semi_axes[1], item.half_width, item.half_depth, item.moments[0]);
        for circle in circles {
            assert_eq!(derived(&bytemuck::cast(expected(&header(), &circle))), derived(&circle));
        }
    }

    #[test]
    fn the_expected_centre_lies_in_the_plane_of_its_scan_line() {
        for (scan, slope) in [(0, (100.0 - 239.5) / 520.0), (1, (100.0 - 319.5) / 525.0)] {
            let item = circle(100, scan);
            let ([x, y, z], [s, t]) = (center(&header(), &item), item.plane_center);
            let (along, across) = if item.direction() == Scan::Row { (x, y) } else { (y, x) };
            assert!((across / z - slope).abs() < 1e-12, "scan {scan}: {across} at {z}");
            assert!((along - s).abs() < 1e-12 && (across.hypot(z) - t).abs() < 1e-12, "scan {scan}");
        }
    }

    #[test]
    fn multiples_of_a_step_are_distinguished_from_other_numbers() {
        for (value, word) in [(0.0, 0), (1.234, 1234), (-0.0, !(-0.0_f64).to_bits()), (1e-320, !1e-320_f64.to_bits())] {
            assert_eq!(to_steps(value, 0.001), word);
            assert_eq!(from_steps(word, 0.001).to_bits(), value.to_bits());
        }
    }

    #[test]
    fn a_list_that_claims_more_than_it_has_is_refused() {
        let mut bytes = Vec::new();
        compress(&header(), &[circle(1, 0)], Compression::Zstd, &mut bytes).unwrap();
        for claim in [0, 2, 20_000, u32::MAX] {
            let claimed = [&claim.to_le_bytes(), &bytes[4..]].concat();
            assert!(decompress(&header(), &claimed, Compression::Zstd, &mut Vec::new()).is_err(), "{claim}");
        }
        let most = (MAX_MESSAGE / size_of::<Ellipse>()) as u32;
        for (claim, is_too_long) in [(most, false), (most + 1, true)] {
            let claimed = [&claim.to_le_bytes(), &bytes[4..]].concat();
            let refused = decompress(&header(), &claimed, Compression::Zstd, &mut Vec::new()).unwrap_err();
            assert_eq!(refused.contains("allowed are"), is_too_long, "{refused}");
        }
        for cut in [0, 4, 7, bytes.len() - 1] {
            assert!(decompress(&header(), &bytes[..cut], Compression::Zstd, &mut Vec::new()).is_err(), "{cut}");
        }
        bytes.push(0);
        assert!(decompress(&header(), &bytes, Compression::Zstd, &mut Vec::new()).is_err());
    }

    proptest! {
        #[test]
        fn any_numbers_are_decoded_bit_for_bit(
            whole in prop::collection::vec(any::<[u32; WHOLE]>(), 0..6),
            real in prop::collection::vec(any::<u64>().prop_map(f64::from_bits), REAL),
        ) {
            let mut items = vec![Ellipse::zeroed(); whole.len()];
            for (item, whole) in items.iter_mut().zip(whole) {
                let numbers: &mut Numbers = bytemuck::cast_mut(item);
                numbers.whole = whole;
                let finite = real.iter().map(|number| if number.is_finite() { *number } else { -0.0 });
                numbers.real.iter_mut().zip(finite).for_each(|(slot, number)| *slot = number);
            }
            for how in HOW {
                let back = sent(&items, how).0;
                prop_assert_eq!(bytemuck::cast_slice::<_, u8>(&back), bytemuck::cast_slice::<_, u8>(&items));
            }
        }
    }
}
