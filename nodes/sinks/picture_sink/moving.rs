//! Writes consecutive pictures as one moving picture (APNG), small enough for a README.
//!
//! Pixels that change too little to be seen stay as they were, so that noise takes no space. The others use a palette of up to
//! 255 colours, the most frequent ones of all pictures.

use super::canvas::{Box2, Canvas};
use super::whole_file::write_whole;
use anyhow::Result;
use png::{BitDepth, BlendOp, ColorType, Compression, Encoder, Filter};
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Largest number of pictures, by the memory that a stage should use: 300 of 640x480 are 180 MB.
const MOST: usize = 300;
/// Largest change of a colour, of 255, that cannot be seen.
const UNSEEN: u8 = 12;
/// Size of the palette, beside one entry for pixels that stay as they were.
const COLOURS: usize = 255;
/// Code of a pixel that stays as it was; it is no colour of 15 bits.
const SAME: u16 = u16::MAX;
/// Shortest and longest duration of a picture, in milliseconds.
const TIMES_MS: (u64, u64) = (20, 10_000);

/// The pictures of a run, kept until its end.
pub(super) struct Moving {
    path: PathBuf,
    width: u32,
    size: Option<(u32, u32)>,
    /// The visible pixels after the last picture.
    seen: Vec<[u8; 3]>,
    /// The pixels of each picture in colours of 15 bits, and its time stamp.
    pictures: Vec<(Vec<u16>, u64)>,
    is_reported: bool,
}

impl Moving {
    /// Creates a moving picture with this file; it is `width` pixels wide, or as wide as narrower pictures.
    pub(super) fn new(path: PathBuf, width: u32) -> Self {
        Self { path, width, size: None, seen: Vec::new(), pictures: Vec::new(), is_reported: false }
    }

    /// Adds a picture, unless there are enough, or it differs in size from those before.
    pub(super) fn add(&mut self, picture: &Canvas, stamp_ns: u64) {
        let (width, height) = picture.size();
        let wide = self.width.min(width);
        let high = (u64::from(height) * u64::from(wide) / u64::from(width)).max(1) as u32;
        let size = *self.size.get_or_insert((wide, high));
        if size != (wide, high) || self.pictures.len() == MOST {
            if !self.is_reported {
                self.is_reported = true;
                let why =
                    if size == (wide, high) { format!("has {MOST} pictures") } else { "is of another size".into() };
                tracing::warn!("`{}` {why}: further ones are left out", self.path.display());
            }
            return;
        }
        let mut small = Canvas::default();
        small.begin(wide, high);
        picture.shrink_into(&mut small, Box2 { left: 0, top: 0, width: wide.into(), height: high.into() });
        let pixels = small.bytes().as_chunks::<3>().0;
        if self.seen.is_empty() {
            self.seen = pixels.to_vec();
            self.pictures.push((pixels.iter().map(coded).collect(), stamp_ns));
            return;
        }
        let change = |(seen, pixel): (&mut [u8; 3], &[u8; 3])| {
            if seen.iter().zip(pixel).all(|(before, now)| before.abs_diff(*now) <= UNSEEN) {
                return SAME;
            }
            *seen = *pixel;
            coded(pixel)
        };
        let picture = self.seen.iter_mut().zip(pixels).map(change).collect();
        self.pictures.push((picture, stamp_ns));
    }

    /// Writes all pictures, if there are any.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn write(&self) -> Result<()> {
        let Some(size) = self.size.filter(|_| !self.pictures.is_empty()) else { return Ok(()) };
        let file = self.encode(size)?;
        write_whole(&self.path, &file)
    }

    fn encode(&self, (width, height): (u32, u32)) -> Result<Vec<u8>> {
        let colours = self.colours();
        let palette = &colours[..colours.len().min(COLOURS)];
        let number = number_of(&colours, palette);
        let mut file = Vec::new();
        let mut encoder = Encoder::new(&mut file, width, height);
        encoder.set_color(ColorType::Indexed);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::High);
        // Neighbouring numbers of the palette are not similar colours, so that filters would not help.
        encoder.set_filter(Filter::NoFilter);
        encoder.set_palette(
            [[0; 3]].into_iter().chain(palette.iter().map(|code| decoded(*code))).flatten().collect::<Vec<_>>(),
        );
        encoder.set_trns(vec![0]);
        encoder.set_animated(self.pictures.len() as u32, 0)?;
        encoder.set_blend_op(BlendOp::Over)?;
        let mut writer = encoder.write_header()?;
        for ((picture, _), time_ms) in self.pictures.iter().zip(self.times_ms()) {
            writer.set_frame_delay(time_ms, 1000)?;
            let numbers: Vec<u8> = picture.iter().map(|code| number.get(code).copied().unwrap_or(0)).collect();
            writer.write_image_data(&numbers)?;
        }
        writer.finish()?;
        Ok(file)
    }

    /// Returns the colours of all pictures, the most frequent first; their order gives their numbers.
    fn colours(&self) -> Vec<u16> {
        let mut counts = BTreeMap::<u16, u64>::new();
        for code in self.pictures.iter().flat_map(|(picture, _)| picture).filter(|code| **code != SAME) {
            *counts.entry(*code).or_default() += 1;
        }
        let mut codes: Vec<_> = counts.into_iter().collect();
        codes.sort_by_key(|(code, count)| (Reverse(*count), *code));
        codes.into_iter().map(|(code, _)| code).collect()
    }

    /// Returns the duration of each picture: until the next one; the last has that of the one before.
    fn times_ms(&self) -> impl Iterator<Item = u16> {
        let stamps: Vec<_> = self.pictures.iter().map(|(_, stamp_ns)| *stamp_ns).collect();
        let mut times: Vec<_> = stamps.windows(2).map(|pair| pair[1].saturating_sub(pair[0]) / 1_000_000).collect();
        times.push(times.last().copied().unwrap_or(TIMES_MS.1));
        times.into_iter().map(|time| time.clamp(TIMES_MS.0, TIMES_MS.1) as u16)
    }
}

/// Encodes a colour in 15 bits.
fn coded(pixel: &[u8; 3]) -> u16 {
    pixel.iter().fold(0, |code, part| (code << 5) | u16::from(part >> 3))
}

/// Returns the middle of the colours with this code.
fn decoded(code: u16) -> [u8; 3] {
    [10, 5, 0].map(|shift| ((code >> shift & 31) << 3) as u8 | 4)
}

/// Returns the number of the nearest colour of the palette for each colour; 0 is reserved for unchanged pixels.
fn number_of(colours: &[u16], palette: &[u16]) -> BTreeMap<u16, u8> {
    let distance = |a: u16, b: u16| -> u32 {
        let apart = |(one, other): (u8, u8)| u32::from(one.abs_diff(other)).pow(2);
        decoded(a).into_iter().zip(decoded(b)).map(apart).sum()
    };
    let nearest = |code: u16| {
        (1..=u8::MAX).zip(palette).min_by_key(|(_, known)| distance(code, **known)).map(|(number, _)| number)
    };
    colours.iter().filter_map(|code| Some((*code, nearest(*code)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::io::BufReader;
    use std::path::Path;

    /// A grey picture of 8x6 pixels with a coloured square.
    fn picture(left: i64, grey: u8, colour: [u8; 3]) -> Canvas {
        let mut canvas = Canvas::default();
        canvas.begin(8, 6);
        canvas.fill(Box2 { left: 0, top: 0, width: 8, height: 6 }, [grey; 3], 1.0);
        canvas.fill(Box2 { left, top: 2, width: 2, height: 2 }, colour, 1.0);
        canvas
    }

    /// The visible pictures of a file one after the other, and their durations in ms.
    fn played(path: &Path) -> Vec<(Vec<[u8; 3]>, u16)> {
        let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
        let palette = reader.info().palette.clone().unwrap().into_owned();
        let count = reader.info().animation_control().unwrap().num_frames;
        let mut seen = vec![[0; 3]; 48];
        let mut frame = || {
            let mut numbers = vec![0; 48];
            reader.next_frame(&mut numbers).unwrap();
            for (pixel, number) in seen.iter_mut().zip(&numbers).filter(|(_, number)| **number != 0) {
                *pixel = palette.as_chunks().0[usize::from(*number)];
            }
            (seen.clone(), reader.info().frame_control().unwrap().delay_num)
        };
        (0..count).map(|_| frame()).collect()
    }

    #[test]
    fn changes_are_drawn_and_noise_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("moving.png");
        let mut moving = Moving::new(path.clone(), 100);
        let orange = [255, 135, 60];
        moving.add(&picture(1, 100, orange), 0);
        moving.add(&picture(4, 100 + UNSEEN, orange), 40_000_000);
        moving.add(&picture(4, 180, orange), 100_000_000);
        moving.write().unwrap();
        let [(first, first_ms), (second, second_ms), (third, third_ms)] = &played(&path)[..] else {
            panic!("not three")
        };
        assert_eq!([first_ms, second_ms, third_ms], [&40, &60, &60]);
        let near = |pixel: [u8; 3], expected: [u8; 3]| pixel.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 4);
        let at = |x: usize| 2 * 8 + x;
        assert!(near(first[at(1)], orange) && near(first[at(4)], [100; 3]));
        assert!(near(second[at(1)], [100 + UNSEEN; 3]) && near(second[at(4)], orange));
        assert_eq!(second[0], first[0], "a change that nobody sees is none");
        assert!(near(third[0], [180; 3]) && near(third[at(4)], orange));
    }

    #[test]
    fn a_moving_picture_has_the_requested_width_and_pictures_of_one_size() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("moving.png");
        let mut moving = Moving::new(path.clone(), 4);
        moving.write().unwrap();
        assert!(!path.exists(), "nothing was drawn");
        moving.add(&picture(0, 9, [200; 3]), 0);
        let mut other = Canvas::default();
        other.begin(9, 9);
        moving.add(&other, 1);
        moving.write().unwrap();
        let reader = png::Decoder::new(BufReader::new(File::open(&path).unwrap())).read_info().unwrap();
        assert_eq!((reader.info().size(), reader.info().animation_control().unwrap().num_frames), ((4, 3), 1));
    }

    #[test]
    fn of_too_many_colours_the_most_frequent_are_kept() {
        let mut moving = Moving::new(PathBuf::new(), 10);
        let all: Vec<u16> = (0..400).chain(100..355).collect();
        moving.pictures.push((all, 0));
        let colours = moving.colours();
        assert!(colours.iter().copied().eq((100..355).chain(0..100).chain(355..400)));
        let file = moving.encode((655, 1)).unwrap();
        let reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        let palette = reader.info().palette.as_ref().unwrap();
        assert_eq!(palette.len(), 3 * 256, "none, and 255 colours");
        assert_eq!((&palette[3..6], &palette[3 * 255..]), (&decoded(100)[..], &decoded(354)[..]));
    }

    #[test]
    fn a_colour_outside_the_palette_becomes_the_nearest_in_it() {
        let (dark, light) = (coded(&[10; 3]), coded(&[200; 3]));
        let brown = coded(&[60, 40, 40]);
        let number = number_of(&[dark, light, brown], &[light, dark]);
        assert_eq!([number[&dark], number[&light], number[&brown]], [2, 1, 2]);
        assert_eq!(decoded(coded(&[255, 135, 60])), [252, 132, 60]);
    }
}
