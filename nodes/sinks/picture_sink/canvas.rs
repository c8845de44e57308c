//! An RGB image to draw on: dots, lines of any length clipped to the image, and small text.

use super::font;

/// Red, green, blue.
pub(super) type Colour = [u8; 3];

/// An image of three bytes per pixel, row by row.
#[derive(Clone, Debug, Default)]
pub(super) struct Canvas {
    width: u32,
    height: u32,
    bytes: Vec<u8>,
}

impl Canvas {
    /// Makes it black, of that size; the memory is kept.
    pub(super) fn begin(&mut self, width: u32, height: u32) {
        (self.width, self.height) = (width, height);
        self.bytes.clear();
        self.bytes.resize(3 * width as usize * height as usize, 0);
    }

    /// Width and height.
    pub(super) fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// The pixels.
    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The pixels, to be painted in the order of the rows.
    pub(super) fn pixels_mut(&mut self) -> impl Iterator<Item = &mut Colour> {
        self.bytes.as_chunks_mut::<3>().0.iter_mut()
    }

    /// Paints a pixel; one outside of the image is not there.
    pub(super) fn dot(&mut self, x: i64, y: i64, colour: Colour) {
        let inside = (0..i64::from(self.width)).contains(&x) && (0..i64::from(self.height)).contains(&y);
        if !inside {
            return;
        }
        let index = 3 * (y * i64::from(self.width) + x) as usize;
        self.bytes[index..index + 3].copy_from_slice(&colour);
    }

    /// Paints a square of `side` pixels around a point.
    pub(super) fn square(&mut self, [x, y]: [f64; 2], side: u32, colour: Colour) {
        let offset = f64::from(side - side.min(1)) / 2.0;
        let (left, top) = ((x - offset).round() as i64, (y - offset).round() as i64);
        for row in top..top.saturating_add(side.into()) {
            for column in left..left.saturating_add(side.into()) {
                self.dot(column, row, colour);
            }
        }
    }

    /// Draws a straight line; what lies outside of the image costs nothing.
    pub(super) fn line(&mut self, from: [f64; 2], to: [f64; 2], width: u32, colour: Colour) {
        let margin = f64::from(width);
        let upper = [f64::from(self.width) + margin, f64::from(self.height) + margin];
        let Some((from, to)) = clip(from, to, -margin, upper) else { return };
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let steps = dx.abs().max(dy.abs()).ceil().max(1.0);
        for step in 0..=steps as u64 {
            let t = step as f64 / steps;
            self.square([from[0] + t * dx, from[1] + t * dy], width, colour);
        }
    }

    /// Writes text on a dark ground, its lower left corner at `(x, y)`, but inside of the image.
    pub(super) fn text(&mut self, x: f64, y: f64, text: &str, colour: Colour) {
        let scale = if self.height >= 360 { 2 } else { 1 };
        let advance = (font::WIDTH + 1) * scale;
        let width = i64::from(advance) * text.chars().count() as i64 + i64::from(scale);
        let height = i64::from((font::HEIGHT + 2) * scale);
        let left = (x as i64).clamp(0, (i64::from(self.width) - width).max(0));
        let top = (y as i64).saturating_sub(height).clamp(0, (i64::from(self.height) - height).max(0));
        self.darken(left, top, width, height);
        for (index, sign) in text.chars().enumerate() {
            let origin = (left + i64::from(scale) + index as i64 * i64::from(advance), top + i64::from(scale));
            self.sign(origin, sign, scale, colour);
        }
    }

    fn sign(&mut self, (left, top): (i64, i64), sign: char, scale: u32, colour: Colour) {
        let parts = (0..scale * scale).map(|part| (part % scale, part / scale));
        for (x, y) in font::pixels(sign) {
            for (dx, dy) in parts.clone() {
                self.dot(left + i64::from(x * scale + dx), top + i64::from(y * scale + dy), colour);
            }
        }
    }

    fn darken(&mut self, left: i64, top: i64, width: i64, height: i64) {
        let (right, bottom) = (left.saturating_add(width), top.saturating_add(height));
        let (right, bottom) = (right.min(self.width.into()), bottom.min(self.height.into()));
        for row in top..bottom {
            for column in left..right {
                let index = 3 * (row * i64::from(self.width) + column) as usize;
                self.bytes[index..index + 3].iter_mut().for_each(|byte| *byte /= 4);
            }
        }
    }
}

/// The part of a line inside of a rectangle (Liang and Barsky 1984); `None` if there is none.
fn clip(from: [f64; 2], to: [f64; 2], lower: f64, upper: [f64; 2]) -> Option<([f64; 2], [f64; 2])> {
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
    // Rounding must not lead far out again.
    let at = |t: f64| [0, 1].map(|axis| (from[axis] + t * delta[axis]).clamp(lower, upper[axis]));
    let finite = delta.iter().chain(&from).all(|number| number.is_finite());
    (finite && enter <= leave).then(|| (at(enter), at(leave)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHITE: Colour = [255; 3];

    fn canvas(width: u32, height: u32) -> Canvas {
        let mut canvas = Canvas::default();
        canvas.begin(width, height);
        canvas
    }

    fn painted(canvas: &Canvas) -> Vec<(usize, usize)> {
        let width = canvas.size().0 as usize;
        let pixels = canvas.bytes().chunks(3).enumerate().filter(|(_, pixel)| *pixel == WHITE);
        pixels.map(|(index, _)| (index % width, index / width)).collect()
    }

    #[test]
    fn lines_go_from_end_to_end() {
        let mut picture = canvas(8, 8);
        picture.line([1.0, 2.0], [4.0, 5.0], 1, WHITE);
        assert_eq!(painted(&picture), [(1, 2), (2, 3), (3, 4), (4, 5)]);
        let mut picture = canvas(8, 8);
        picture.line([6.0, 3.0], [3.0, 3.0], 1, WHITE);
        assert_eq!(painted(&picture), [(3, 3), (4, 3), (5, 3), (6, 3)]);
    }

    #[test]
    fn endless_lines_are_clipped_and_broken_ones_not_drawn() {
        let mut picture = canvas(8, 8);
        picture.line([-1e9, 4.0], [1e9, 4.0], 1, WHITE);
        assert_eq!(painted(&picture), (0..8).map(|x| (x, 4)).collect::<Vec<_>>());
        picture.begin(8, 8);
        picture.line([f64::NAN, 0.0], [3.0, 3.0], 1, WHITE);
        picture.line([f64::INFINITY, 0.0], [3.0, 3.0], 1, WHITE);
        picture.line([-5.0, -9.0], [20.0, -9.0], 3, WHITE);
        assert!(painted(&picture).is_empty());
        picture.line([-1e300, -1e299], [1e300, 3e299], 1, WHITE);
        picture.begin(8, 8);
        picture.square([1e300, -1e300], 3, WHITE);
        picture.dot(i64::MAX, i64::MAX, WHITE);
        picture.dot(3, i64::MIN, WHITE);
        picture.text(1e300, f64::NAN, "12: cyl 98", WHITE);
        let painted = painted(&picture);
        assert!(!painted.is_empty() && painted.iter().all(|(_, y)| *y < 7), "only the text, moved inside");
    }

    #[test]
    fn a_width_is_kept() {
        let mut picture = canvas(9, 9);
        picture.line([0.0, 4.0], [8.0, 4.0], 3, WHITE);
        assert_eq!(painted(&picture).len(), 27);
    }

    #[test]
    fn text_stays_inside() {
        let mut picture = canvas(40, 20);
        picture.text(38.0, 2.0, "98", WHITE);
        let painted = painted(&picture);
        let expected = font::pixels('9').count() + font::pixels('8').count();
        assert_eq!(painted.len(), expected);
        assert!(painted.iter().all(|(x, y)| *x > 30 && *y < 7));
    }
}
