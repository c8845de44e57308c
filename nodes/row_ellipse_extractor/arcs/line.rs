//! One scan line, or a window of it: its measurements, split into runs at jumps and holes.

use super::view::{BATCH, JumpRule, View};
use conicflow_geometry::{Pinhole, Scan, ScanPlane};
use conicflow_messages::is_measured;
use std::ops::Range;

/// A scan line; its buffers are used again for the next.
#[derive(Debug)]
pub(super) struct RayLine {
    pub number: u32,
    pub plane: ScanPlane,
    window: Range<u32>,
    /// The pixels of a column side by side.
    column: Vec<u16>,
    /// Pixel of each measurement ...
    pixels: Vec<u32>,
    /// ... and its depth in units of the image.
    depths: Vec<u16>,
    /// The same in metres.
    metres: Vec<f64>,
    runs: Vec<Range<usize>>,
}

impl Default for RayLine {
    fn default() -> Self {
        Self {
            number: 0,
            plane: Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 }.plane(Scan::Row, 0.0),
            window: 0..0,
            column: Vec::new(),
            pixels: Vec::new(),
            depths: Vec::new(),
            metres: Vec::new(),
            runs: Vec::new(),
        }
    }
}

impl RayLine {
    /// Reads the pixels `window` of a scan line and splits them at jumps and holes.
    pub fn read(&mut self, view: &View, image: &[u16], line: u32, window: Range<u32>) {
        (self.number, self.plane) = (line, view.plane(line));
        self.runs.clear();
        self.pixels.clear();
        self.depths.clear();
        let mut column = std::mem::take(&mut self.column);
        self.split(&view.jumps, window.start, view.depths(image, line, &window, &mut column));
        self.column = column;
        self.metres.clear();
        self.metres.extend(self.depths.iter().map(|&depth| f64::from(depth) * view.scale));
        self.window = window;
    }

    /// Adds the measured ones of the pixels from `first` on, in runs.
    fn split(&mut self, rule: &JumpRule, first: u32, pixels: &[u16]) {
        let mut from = 0;
        for start in (0..pixels.len()).step_by(BATCH) {
            for at in places(&rule.doubtful(&batch(&pixels[start..]))) {
                let end = start + at + 1;
                if pixels.get(end).is_none_or(|&next| rule.splits(pixels[end - 1], next, 1)) {
                    self.add(rule, first + from as u32, &pixels[from..end]);
                    from = end;
                }
            }
        }
        self.add(rule, first + from as u32, &pixels[from..]);
    }

    /// Adds the pixels from `first` on, if they are measured: all of them are, or none. They go on with the last run
    /// or begin a new one.
    fn add(&mut self, rule: &JumpRule, first: u32, depths: &[u16]) {
        let Some(&depth) = depths.first().filter(|depth| is_measured(**depth)) else { return };
        let start = self.depths.len();
        self.depths.extend_from_slice(depths);
        self.pixels.extend((first..).take(depths.len()));
        let goes_on = self
            .measurement(start.wrapping_sub(1))
            .is_some_and(|(pixel, last)| !rule.splits(last, depth, first - pixel));
        match self.runs.last_mut() {
            Some(run) if goes_on => run.end = self.depths.len(),
            _ => self.runs.push(start..self.depths.len()),
        }
    }

    /// Number of runs.
    pub fn runs(&self) -> usize {
        self.runs.len()
    }

    /// Number of points of a run.
    pub fn run_length(&self, index: usize) -> usize {
        self.runs[index].len()
    }

    /// The measurements of a run.
    pub fn run(&self, view: &View, index: usize) -> Points<'_> {
        let points = self.runs[index].clone();
        let ends = [self.pixels[points.start], self.pixels[points.end - 1]];
        let open = [
            ends[0] == self.window.start && ends[0] > 0,
            ends[1] + 1 == self.window.end && self.window.end < view.length,
        ];
        Points {
            pixels: &self.pixels[points.clone()],
            depths: &self.depths[points.clone()],
            metres: &self.metres[points.clone()],
            neighbors: [points.start.checked_sub(1), Some(points.end)].map(|at| self.measurement(at?)),
            open,
        }
    }

    /// Pixel and depth of a measurement, if there are so many.
    fn measurement(&self, index: usize) -> Option<(u32, u16)> {
        Some((*self.pixels.get(index)?, *self.depths.get(index)?))
    }
}

/// The first pixels and the one behind them; zeros follow the last of all.
fn batch(pixels: &[u16]) -> [u16; BATCH + 1] {
    pixels.first_chunk().copied().unwrap_or_else(|| {
        let mut batch = [0; BATCH + 1];
        batch[..pixels.len()].copy_from_slice(pixels);
        batch
    })
}

/// The places of the ones among zeros and ones.
fn places(flags: &[u8; BATCH]) -> impl Iterator<Item = usize> {
    let (words, _) = flags.as_chunks();
    words.iter().zip((0..).step_by(8)).flat_map(|(word, first)| {
        let mut word = u64::from_le_bytes(*word);
        std::iter::from_fn(move || {
            let bit = word.trailing_zeros() as usize;
            word &= word.checked_sub(1)?;
            Some(first + bit / 8)
        })
    })
}

/// The measurements of a run.
#[derive(Clone, Copy, Debug)]
pub(super) struct Points<'a> {
    pub pixels: &'a [u32],
    /// Depths in units of the image, ...
    pub depths: &'a [u16],
    /// ... and in metres.
    pub metres: &'a [f64],
    /// Pixel and depth of the measurements before and behind the run, in the window.
    pub neighbors: [Option<(u32, u16)>; 2],
    /// Whether the run goes on beyond the window, before the first point and behind the last.
    pub open: [bool; 2],
}
