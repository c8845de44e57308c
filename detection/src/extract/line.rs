//! One scan line, or a window of it: its measurements, split into runs at jumps and holes.

use super::view::{DepthBuffer, JUMP_BATCH, View};
use conicflow_geometry::{Pinhole, Scan, ScanPlane};
use conicflow_messages::is_measured;
use std::ops::Range;

/// Number of pixels that are copied at once if all of them are measured.
const GATHERED: usize = 32; // [algorithmic]

/// A scan line; its buffers are used again for the next line.
#[derive(Debug)]
pub(super) struct RayLine {
    pub number: u32,
    pub plane: ScanPlane,
    window: Range<u32>,
    /// Number of measurements.
    count: usize,
    buffer: DepthBuffer,
    /// Pixel of each measurement.
    pixels: Vec<u32>,
    /// Depth of each measurement, in units of the image.
    depths: Vec<u16>,
    /// Depth of each measurement, in metres.
    metres: Vec<f64>,
    /// Number of neighbours on either side that count in each measurement; empty where lines are not averaged.
    pairs: Vec<u16>,
    runs: Vec<Range<usize>>,
}

impl Default for RayLine {
    fn default() -> Self {
        Self {
            number: 0,
            plane: Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 }.plane(Scan::Row, 0.0),
            window: 0..0,
            count: 0,
            buffer: DepthBuffer::default(),
            pixels: Vec::new(),
            depths: Vec::new(),
            metres: Vec::new(),
            pairs: Vec::new(),
            runs: Vec::new(),
        }
    }
}

impl RayLine {
    /// Reads the pixels `window` of a scan line and splits them at jumps and holes.
    pub fn read(&mut self, view: &View, image: &[u16], line: u32, window: Range<u32>) {
        (self.number, self.plane) = (line, view.plane(line));
        if self.pixels.len() < window.len() {
            self.pixels.resize(window.len(), 0);
            self.depths.resize(window.len(), 0);
            self.metres.resize(window.len(), 0.0);
        }
        let mut buffer = std::mem::take(&mut self.buffer);
        let (depths, pairs) = view.depths(image, line, &window, &mut buffer);
        self.gather_pairs(depths, pairs);
        self.count = self.gather(view, window.start, depths);
        self.buffer = buffer;
        self.split(view);
        self.window = window;
    }

    /// Copies the measured pixels from `first` on without gaps; returns their number.
    fn gather(&mut self, view: &View, first: u32, pixels: &[u16]) -> usize {
        let mut count = 0;
        for (batch, first) in pixels.chunks(GATHERED).zip((first..).step_by(GATHERED)) {
            if batch.iter().fold(true, |all, depth| all & is_measured(*depth)) {
                self.depths[count..count + batch.len()].copy_from_slice(batch);
                self.pixels[count..count + batch.len()].iter_mut().zip(first..).for_each(|(pixel, at)| *pixel = at);
                count += batch.len();
                continue;
            }
            for (pixel, &depth) in (first..).zip(batch) {
                // Every pixel is written, but only a measured one is counted, so that no branch depends on the image.
                (self.pixels[count], self.depths[count]) = (pixel, depth);
                count += usize::from(is_measured(depth));
            }
        }
        for (metres, &depth) in self.metres[..count].iter_mut().zip(&self.depths) {
            *metres = f64::from(depth) * view.scale;
        }
        count
    }

    /// Copies the numbers of averaged lines on either side of the measured pixels; `pairs` is empty where lines are not averaged.
    fn gather_pairs(&mut self, depths: &[u16], pairs: &[u16]) {
        self.pairs.clear();
        for (depths, pairs) in depths.chunks(GATHERED).zip(pairs.chunks(GATHERED)) {
            if depths.iter().fold(true, |all, depth| all & is_measured(*depth)) {
                self.pairs.extend_from_slice(pairs);
            } else {
                let measured = depths.iter().zip(pairs).filter(|(depth, _)| is_measured(**depth));
                self.pairs.extend(measured.map(|(_, pairs)| *pairs));
            }
        }
    }

    fn split(&mut self, view: &View) {
        self.runs.clear();
        let (pixels, depths) = (&self.pixels[..self.count], &self.depths[..self.count]);
        let mut start = 0;
        for first in (0..self.count).step_by(JUMP_BATCH) {
            for at in places(&view.jumps(None).doubtful(&pixels[first..], &depths[first..])) {
                let last = first + at;
                let pairs = self.pairs.get(last..last + 2).map(|pairs| pairs[0].min(pairs[1]));
                if view.jumps(pairs).splits(depths[last], depths[last + 1], pixels[last + 1] - pixels[last]) {
                    self.runs.push(start..last + 1);
                    start = last + 1;
                }
            }
        }
        self.runs.extend((self.count > start).then_some(start..self.count));
    }

    /// Number of runs.
    pub fn runs(&self) -> usize {
        self.runs.len()
    }

    /// Number of points of a run.
    pub fn run_length(&self, index: usize) -> usize {
        self.runs[index].len()
    }

    /// Returns the measurements of a run.
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
            pairs: self.pairs.get(points.clone()).unwrap_or_default(),
            neighbors: [
                [1, 2].map(|by| self.measurement(points.start.checked_sub(by)?)),
                [0, 1].map(|by| self.measurement(points.end + by)),
            ],
            open,
        }
    }

    /// Returns the pixel and the depth of a measurement; `None` beyond the last.
    fn measurement(&self, index: usize) -> Option<(u32, u16)> {
        (index < self.count).then(|| (self.pixels[index], self.depths[index]))
    }
}

/// Returns the positions of the ones among zeros and ones.
fn places(flags: &[u8; JUMP_BATCH]) -> impl Iterator<Item = usize> {
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
    /// Depths, in units of the image.
    pub depths: &'a [u16],
    /// Depths, in metres.
    pub metres: &'a [f64],
    /// Number of neighbours on either side that count in each; empty where lines are not averaged.
    pub pairs: &'a [u16],
    /// Pixel and depth of the two measurements before the run and of the two after it, the nearer first, within the window.
    pub neighbors: [[Option<(u32, u16)>; 2]; 2],
    /// Whether the run may continue beyond the window, before its first point and after its last.
    pub open: [bool; 2],
}
