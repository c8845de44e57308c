//! An RGB image for drawing: dots, antialiased lines clipped to the image, and text.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster};

/// Red, green, blue.
pub(super) type Colour = [u8; 3];

/// A line from point to point, in pixels.
pub(super) type Line = ([f64; 2], [f64; 2]);

/// A rectangle of whole pixels: left, top, width, height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Box2 {
    pub(super) left: i64,
    pub(super) top: i64,
    pub(super) width: i64,
    pub(super) height: i64,
}

impl Box2 {
    /// Whether two rectangles have a pixel in common.
    pub(super) fn overlaps(&self, other: &Self) -> bool {
        self.left < other.left + other.width
            && other.left < self.left + self.width
            && self.top < other.top + other.height
            && other.top < self.top + self.height
    }
}

/// The size of text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Size {
    /// Lines of 16 pixels.
    Small,
    /// Lines of 24 pixels.
    Large,
}

impl Size {
    fn raster(self) -> RasterHeight {
        match self {
            Self::Small => RasterHeight::Size16,
            Self::Large => RasterHeight::Size24,
        }
    }

    /// Height of a line of text, in pixels.
    pub(super) fn line(self) -> i64 {
        self.raster() as i64
    }

    /// Width of a text, in pixels.
    pub(super) fn width(self, text: &str) -> i64 {
        let sign = noto_sans_mono_bitmap::get_raster_width(FontWeight::Regular, self.raster());
        (sign * text.chars().count()) as i64
    }
}

/// An image of three bytes per pixel, row by row.
#[derive(Clone, Debug, Default)]
pub(super) struct Canvas {
    width: u32,
    height: u32,
    bytes: Vec<u8>,
    /// Coverage of each pixel by the lines of a stroke.
    mask: Vec<u8>,
}

impl Canvas {
    /// Makes the canvas black and of this size; its memory is reused.
    pub(super) fn begin(&mut self, width: u32, height: u32) {
        (self.width, self.height) = (width, height);
        let pixels = width as usize * height as usize;
        self.bytes.clear();
        self.bytes.resize(3 * pixels, 0);
        self.mask.clear();
        self.mask.resize(pixels, 0);
    }

    /// Width and height.
    pub(super) fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// The pixels.
    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Returns the index of a pixel's first byte; `None` outside of the image.
    fn index(&self, x: i64, y: i64) -> Option<usize> {
        let inside = (0..i64::from(self.width)).contains(&x) && (0..i64::from(self.height)).contains(&y);
        inside.then(|| 3 * (y * i64::from(self.width) + x) as usize)
    }

    /// Blends a pixel with a colour; `opacity` is 0 to 1.
    fn blend(&mut self, x: i64, y: i64, colour: Colour, opacity: f64) {
        let Some(index) = self.index(x, y) else { return };
        if opacity >= 1.0 {
            return self.bytes[index..index + 3].copy_from_slice(&colour);
        }
        for (byte, part) in self.bytes[index..index + 3].iter_mut().zip(colour) {
            let before = f64::from(*byte);
            *byte = (before + opacity * (f64::from(part) - before)).round() as u8;
        }
    }

    /// Paints a rectangle.
    pub(super) fn fill(&mut self, area: Box2, colour: Colour, opacity: f64) {
        let (right, bottom) = (area.left.saturating_add(area.width), area.top.saturating_add(area.height));
        for y in area.top.max(0)..bottom.min(self.height.into()) {
            for x in area.left.max(0)..right.min(self.width.into()) {
                self.blend(x, y, colour, opacity);
            }
        }
    }

    /// Draws lines as one stroke: pixels where they meet are painted once. Parts outside of the image cost nothing.
    pub(super) fn stroke(&mut self, lines: impl Iterator<Item = Line>, width: f64, colour: Colour, opacity: f64) {
        let mut touched = Vec::new();
        for (from, to) in lines {
            if let Some(line) = self.clipped(from, to, width) {
                self.cover(line, width, &mut touched);
            }
        }
        for pixel in touched {
            let covered = f64::from(std::mem::take(&mut self.mask[pixel])) / 255.0;
            let (x, y) = (pixel % self.width as usize, pixel / self.width as usize);
            self.blend(x as i64, y as i64, colour, opacity * covered);
        }
    }

    /// Returns the visible part of a line.
    pub(super) fn clipped(&self, from: [f64; 2], to: [f64; 2], width: f64) -> Option<Line> {
        let margin = width + 1.0;
        clip(from, to, -margin, [f64::from(self.width) + margin, f64::from(self.height) + margin])
    }

    /// Adds the coverage of pixels by a line of this width.
    fn cover(&mut self, (from, to): Line, width: f64, touched: &mut Vec<usize>) {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let is_steep = dy.abs() > dx.abs();
        let [along, across] = if is_steep { [1, 0] } else { [0, 1] };
        // Across its main direction a line is wider by a factor of at most the square root of two.
        let reach = 0.75 * width + 1.0;
        let (first, last) = (from[along].min(to[along]) - reach, from[along].max(to[along]) + reach);
        let slope = if is_steep { dx / dy } else { dy / dx };
        let slope = if slope.is_finite() { slope } else { 0.0 };
        for step in first.floor() as i64..=last.ceil() as i64 {
            let middle = from[across] + slope * (step as f64 - from[along]);
            for other in (middle - reach).floor() as i64..=(middle + reach).ceil() as i64 {
                let (x, y) = if is_steep { (other, step) } else { (step, other) };
                let distance = distance_from_line([x as f64, y as f64], from, [dx, dy]);
                let covered = (255.0 * (0.5 * width + 0.5 - distance).clamp(0.0, 1.0)).round() as u8;
                let Some(pixel) = self.index(x, y).map(|index| index / 3) else { continue };
                if covered > self.mask[pixel] {
                    if self.mask[pixel] == 0 {
                        touched.push(pixel);
                    }
                    self.mask[pixel] = covered;
                }
            }
        }
    }

    /// Paints a pixel of the frame as a square of `zoom` x `zoom` pixels.
    pub(super) fn dot(&mut self, x: i64, y: i64, zoom: u32, colour: Colour) {
        let side = i64::from(zoom);
        let [left, top] = [x.saturating_mul(side), y.saturating_mul(side)];
        self.fill(Box2 { left, top, width: side, height: side }, colour, 1.0);
    }

    /// Draws text with its upper left corner at `(left, top)`; characters missing in the font become question marks.
    pub(super) fn text(&mut self, (left, top): (i64, i64), text: &str, style: (Size, bool, Colour, f64)) {
        let (size, is_bold, colour, opacity) = style;
        let weight = if is_bold { FontWeight::Bold } else { FontWeight::Regular };
        let mut x = left;
        for sign in text.chars() {
            let raster = get_raster(sign, weight, size.raster()).or_else(|| get_raster('?', weight, size.raster()));
            let Some(raster) = raster else { continue };
            for (y, row) in (top..).zip(raster.rows()) {
                for (x, covered) in (x..).zip(row.iter()).filter(|(_, covered)| **covered > 0) {
                    self.blend(x, y, colour, opacity * f64::from(*covered) / 255.0);
                }
            }
            x += raster.width() as i64;
        }
    }

    /// Draws the canvas, scaled down, into another one; each pixel is the mean of those that it replaces.
    pub(super) fn shrink_into(&self, to: &mut Self, place: Box2) {
        for y in 0..place.height {
            for x in 0..place.width {
                let rows = share(y, place.height, self.height);
                let columns = share(x, place.width, self.width);
                let count = (rows.len() * columns.len()).max(1) as u64;
                let mut sums = [0_u64; 3];
                for row in rows {
                    for column in columns.clone() {
                        let index = 3 * (row * self.width as usize + column);
                        sums.iter_mut()
                            .zip(&self.bytes[index..index + 3])
                            .for_each(|(sum, byte)| *sum += u64::from(*byte));
                    }
                }
                to.blend(place.left + x, place.top + y, sums.map(|sum| (sum / count) as u8), 1.0);
            }
        }
    }
}

/// Returns the range of the `size` pixels that pixel `number` of `of` replaces; at least one.
fn share(number: i64, of: i64, size: u32) -> std::ops::Range<usize> {
    let at = |number: i64| (number * i64::from(size) / of.max(1)) as usize;
    let first = at(number).min(size as usize - 1);
    first..at(number + 1).clamp(first + 1, size as usize)
}

fn distance_from_line(point: [f64; 2], from: [f64; 2], delta: [f64; 2]) -> f64 {
    let offset = [point[0] - from[0], point[1] - from[1]];
    let square = delta[0] * delta[0] + delta[1] * delta[1];
    let along = if square > 0.0 { (offset[0] * delta[0] + offset[1] * delta[1]) / square } else { 0.0 };
    let along = along.clamp(0.0, 1.0);
    (offset[0] - along * delta[0]).hypot(offset[1] - along * delta[1])
}

/// Cuts consecutive lines into dashes of `on` pixels with gaps of `off`.
pub(super) fn dashes(lines: impl Iterator<Item = Line>, on: f64, off: f64) -> Vec<Line> {
    let (mut dashes, mut passed) = (Vec::new(), 0.0);
    for (from, to) in lines {
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        let at = |along: f64| [0, 1].map(|axis| from[axis] + (to[axis] - from[axis]) * along / length);
        let mut along = 0.0;
        while along < length {
            let phase: f64 = (passed + along) % (on + off);
            let is_on = phase < on;
            // After rounding a step must not be zero.
            let end = (along + (if is_on { on } else { on + off } - phase).max(1e-3)).min(length);
            if is_on {
                dashes.push((at(along), at(end)));
            }
            along = end;
        }
        passed += length;
    }
    dashes
}

/// Returns the part of a line inside of a rectangle (Liang and Barsky 1984); `None` if there is none.
fn clip(from: [f64; 2], to: [f64; 2], lower: f64, upper: [f64; 2]) -> Option<Line> {
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    let delta = [to[0] - from[0], to[1] - from[1]];
    for axis in 0..2 {
        for (slope, room) in [(-delta[axis], from[axis] - lower), (delta[axis], upper[axis] - from[axis])] {
            if slope < 0.0 {
                enter = enter.max(room / slope);
            } else if slope > 0.0 {
                leave = leave.min(room / slope);
            } else if room < 0.0 {
                return None;
            }
        }
    }
    // Rounding must not put the ends far outside again.
    let at = |t: f64| [0, 1].map(|axis| (from[axis] + t * delta[axis]).clamp(lower, upper[axis]));
    let finite = delta.iter().chain(&from).all(|number| number.is_finite());
    (finite && enter <= leave).then(|| (at(enter), at(leave)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHITE: Colour = [255; 3];
    const LETTERING: (Size, bool, Colour, f64) = (Size::Small, false, WHITE, 1.0);

    fn canvas(width: u32, height: u32) -> Canvas {
        let mut canvas = Canvas::default();
        canvas.begin(width, height);
        canvas
    }

    fn painted(canvas: &Canvas, least: u8) -> Vec<(usize, usize)> {
        let width = canvas.size().0 as usize;
        let pixels = canvas.bytes().chunks(3).enumerate().filter(|(_, pixel)| pixel[0] >= least);
        pixels.map(|(index, _)| (index % width, index / width)).collect()
    }

    fn stroke(canvas: &mut Canvas, lines: &[Line], width: f64) {
        canvas.stroke(lines.iter().copied(), width, WHITE, 1.0);
    }

    #[test]
    fn lines_go_from_end_to_end_and_are_as_wide_as_asked_for() {
        let mut picture = canvas(12, 9);
        stroke(&mut picture, &[([3.0, 4.0], [8.0, 4.0])], 1.0);
        assert_eq!(painted(&picture, 255), (3..9).map(|x| (x, 4)).collect::<Vec<_>>());
        let mut picture = canvas(12, 9);
        stroke(&mut picture, &[([3.0, 4.0], [8.0, 4.0])], 3.0);
        let column: Vec<_> = painted(&picture, 255).into_iter().filter(|(x, _)| *x == 5).collect();
        assert_eq!(column, [(5, 3), (5, 4), (5, 5)]);
        let mut picture = canvas(9, 9);
        stroke(&mut picture, &[([1.0, 1.0], [7.0, 7.0])], 1.5);
        assert!(painted(&picture, 255).iter().all(|(x, y)| x == y) && painted(&picture, 255).len() >= 7);
        assert!(painted(&picture, 1).len() > painted(&picture, 255).len(), "its edges are smooth");
    }

    #[test]
    fn a_stroke_is_no_stronger_where_its_lines_meet() {
        let mut picture = canvas(9, 9);
        let lines = [([1.0, 4.0], [7.0, 4.0]), ([4.0, 1.0], [4.0, 7.0])];
        picture.stroke(lines.into_iter(), 1.0, WHITE, 0.5);
        let greys: Vec<_> = picture.bytes().iter().filter(|byte| **byte > 0).collect();
        assert!(greys.len() > 20 && greys.iter().all(|grey| **grey <= 128), "{greys:?}");
        picture.stroke(lines.into_iter(), 1.0, WHITE, 0.5);
        assert!(picture.bytes().contains(&192), "a second stroke is");
    }

    #[test]
    fn very_long_lines_are_clipped_and_lines_without_finite_ends_are_not_drawn() {
        let mut picture = canvas(8, 8);
        stroke(&mut picture, &[([-1e9, 4.0], [1e9, 4.0])], 1.0);
        assert_eq!(painted(&picture, 255), (0..8).map(|x| (x, 4)).collect::<Vec<_>>());
        picture.begin(8, 8);
        stroke(&mut picture, &[([f64::NAN, 0.0], [3.0, 3.0]), ([f64::INFINITY, 0.0], [3.0, 3.0])], 1.0);
        stroke(&mut picture, &[([-5.0, -9.0], [20.0, -9.0])], 3.0);
        assert!(painted(&picture, 1).is_empty());
        stroke(&mut picture, &[([-1e300, -1e299], [1e300, 3e299])], 1.0);
        picture.begin(8, 8);
        picture.dot(i64::MAX, i64::MAX, 3, WHITE);
        picture.dot(3, i64::MIN, 3, WHITE);
        picture.text((i64::MAX / 2, 3), "far", LETTERING);
        assert!(painted(&picture, 1).is_empty());
    }

    #[test]
    fn dashes_continue_from_line_to_line() {
        let lines = [([0.0, 0.0], [5.0, 0.0]), ([5.0, 0.0], [5.0, 5.0])];
        let expected = [([0.0, 0.0], [4.0, 0.0]), ([5.0, 1.0], [5.0, 5.0])];
        assert_eq!(dashes(lines.into_iter(), 4.0, 2.0), expected);
        assert!(dashes([([1.0, 1.0], [1.0, 1.0])].into_iter(), 4.0, 2.0).is_empty());
    }

    #[test]
    fn text_has_its_stated_width_and_every_character_of_a_label_is_drawn() {
        let mut picture = canvas(400, 30);
        let text = "#12 cylinder  98 %  r 0.50 ± 0.1 mm, 12.5°";
        picture.text((2, 3), text, LETTERING);
        let painted = painted(&picture, 1);
        let right = painted.iter().map(|(x, _)| *x as i64).max().unwrap();
        let width = Size::Small.width(text);
        assert!(right <= 2 + width && right > 2 + width - Size::Small.width("m"), "{right} of {width}");
        assert!(painted.iter().all(|(x, y)| *x >= 2 && (3..19).contains(y)));
        for sign in "abcdefghijklmnopqrstuvwxyz0123456789±°%#.,:-".chars() {
            assert!(get_raster(sign, FontWeight::Bold, RasterHeight::Size24).is_some(), "{sign}");
        }
    }

    #[test]
    fn a_shrunk_picture_has_the_mean_of_its_pixels() {
        let mut large = canvas(4, 2);
        large.fill(Box2 { left: 0, top: 0, width: 1, height: 2 }, [200; 3], 1.0);
        let mut small = canvas(3, 1);
        large.shrink_into(&mut small, Box2 { left: 1, top: 0, width: 2, height: 1 });
        assert_eq!(small.bytes(), [0, 0, 0, 100, 100, 100, 0, 0, 0]);
        let mut wide = canvas(8, 2);
        large.shrink_into(&mut wide, Box2 { left: 0, top: 0, width: 8, height: 2 });
        assert_eq!(wide.bytes()[..9], [200, 200, 200, 200, 200, 200, 0, 0, 0]);
    }
}
