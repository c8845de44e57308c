//! Paints a depth image in the colours of the page of `conicflow view`: near is warm, far is cold, no measurement is black. Also
//! draws the scale of these colours.

use super::canvas::{Box2, Canvas, Colour, Size};
use conicflow_lab::quantile::at_rank;
use conicflow_messages::is_measured;

/// Colour of pixels without a measurement.
const HOLE: Colour = [10, 13, 19];
/// Colours at positions along the scale, from near to far.
const STOPS: [(f64, Colour); 7] = [
    (0.0, [255, 222, 158]),
    (0.14, [250, 172, 96]),
    (0.32, [222, 104, 78]),
    (0.5, [158, 66, 104]),
    (0.68, [94, 58, 128]),
    (0.85, [50, 52, 112]),
    (1.0, [26, 40, 78]),
];
/// Number of colours of the scale; more cannot be distinguished.
const SHADES: usize = 256;

/// Largest length of the scale, in pixels.
const LONGEST_PX: i64 = 96;

/// Returns the colour at a position on the scale, from 0 to 1.
fn colour_at(part: f64) -> Colour {
    let next = STOPS.iter().position(|(stop, _)| *stop >= part).unwrap_or(STOPS.len() - 1).max(1);
    let ((from, near), (to, far)) = (STOPS[next - 1], STOPS[next]);
    let share = ((part - from) / (to - from)).clamp(0.0, 1.0);
    [0, 1, 2].map(|i| (f64::from(near[i]) + share * (f64::from(far[i]) - f64::from(near[i]))).round() as u8)
}

/// Paints depth images; keeps a buffer for a frame's depths.
#[derive(Debug)]
pub(super) struct DepthView {
    near_m: Option<f64>,
    far_m: Option<f64>,
    measured: Vec<u16>,
    shades: Vec<Colour>,
    /// Depths of the first and the last colour in the last painted image, in metres.
    range_m: Option<[f64; 2]>,
}

impl DepthView {
    /// Creates a painter; depths of the warmest and the coldest colour (in metres) that are not given are chosen for each frame.
    pub(super) fn new(near_m: Option<f64>, far_m: Option<f64>) -> Self {
        let shades = (0..SHADES).map(|shade| colour_at(shade as f64 / (SHADES - 1) as f64)).collect();
        Self { near_m, far_m, measured: Vec::new(), shades, range_m: None }
    }

    /// Begins a picture that has no depth image yet.
    pub(super) fn begin(&mut self) {
        self.range_m = None;
    }

    /// Paints the whole canvas, which is `zoom` times as large as the image; `scale` is in metres per unit.
    pub(super) fn paint(&mut self, pixels: &[u16], width: u32, scale: f64, (zoom, canvas): (u32, &mut Canvas)) {
        let (low, high) = self.usual_range(pixels);
        let near = self.near_m.map_or(low, |near_m| near_m / scale);
        let far = self.far_m.map_or(high, |far_m| far_m / scale).max(near + 1.0);
        let slope = (SHADES - 1) as f64 / (far - near);
        for (row, line) in (0..).zip(pixels.chunks_exact(width.max(1) as usize)) {
            for (column, &depth) in (0..).zip(line) {
                let shade = ((f64::from(depth) - near) * slope).clamp(0.0, (SHADES - 1) as f64) as usize;
                canvas.dot(column, row, zoom, if is_measured(depth) { self.shades[shade] } else { HOLE });
            }
        }
        self.range_m = Some([near * scale, far * scale]);
    }

    /// Draws the scale of the last painted image, with its right end at `right`; returns its left end.
    pub(super) fn draw_scale(&self, canvas: &mut Canvas, (right, top): (i64, i64), size: Size) -> i64 {
        let Some([near, far]) = self.range_m else { return right };
        let length = (i64::from(canvas.size().0) / 5).clamp(16, LONGEST_PX);
        let (line, style) = (size.line(), (size, false, [228, 233, 242], 1.0));
        let ends = [near, far].map(|end| format!("{end:.2} m"));
        let left = right - size.width(&ends[1]);
        canvas.text((left, top), &ends[1], style);
        let bar = left - size.width(" ") - length;
        for step in 0..length {
            let shade = (step * (SHADES as i64 - 1) / (length - 1)) as usize;
            let column = Box2 { left: bar + step, top: top + line / 4, width: 1, height: line / 2 };
            canvas.fill(column, self.shades[shade], 1.0);
        }
        let begin = bar - size.width(&ends[0]) - size.width(" ");
        canvas.text((begin, top), &ends[0], style);
        begin
    }

    /// Returns the depths at 1 and 97 percent of the measurements.
    fn usual_range(&mut self, pixels: &[u16]) -> (f64, f64) {
        if self.near_m.is_some() && self.far_m.is_some() {
            return (0.0, 1.0);
        }
        self.measured.clear();
        self.measured.extend(pixels.iter().filter(|&&depth| is_measured(depth)));
        let count = self.measured.len();
        let mut at = |rank| at_rank(&mut self.measured, rank, u16::cmp).map_or(65535.0, f64::from);
        (at(count / 100), at((count - count / 33).min(count.saturating_sub(1))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn painted(view: &mut DepthView, pixels: &[u16]) -> Vec<Colour> {
        let mut canvas = Canvas::default();
        canvas.begin(pixels.len() as u32, 1);
        view.paint(pixels, pixels.len() as u32, 0.001, (1, &mut canvas));
        canvas.bytes().as_chunks().0.to_vec()
    }

    #[test]
    fn near_is_warm_far_is_cold_holes_are_black() {
        let row = painted(&mut DepthView::new(None, None), &[0, 500, 1000, 1500, 65535]);
        assert_eq!((row[0], row[4]), (HOLE, HOLE));
        let warmth = |colour: Colour| i32::from(colour[0]) - i32::from(colour[2]);
        assert!(warmth(row[1]) > warmth(row[2]) && warmth(row[2]) > warmth(row[3]) && warmth(row[3]) < 0, "{row:?}");
        assert_eq!(painted(&mut DepthView::new(None, None), &[0, 65535]), [HOLE, HOLE]);
    }

    #[test]
    fn a_fixed_range_does_not_depend_on_the_frame() {
        let mut view = DepthView::new(Some(1.0), Some(3.0));
        let row = painted(&mut view, &[500, 1000, 2000, 3000, 9000]);
        let [near, far] = [STOPS[0].1, STOPS[6].1];
        assert_eq!([row[0], row[1], row[3], row[4]], [near, near, far, far]);
        let middle = STOPS[3].1;
        assert!(row[2].iter().zip(middle).all(|(part, expected)| part.abs_diff(expected) <= 2), "{:?}", row[2]);
        assert_eq!(view.range_m, Some([1.0, 3.0]));
    }

    #[test]
    fn single_far_outliers_do_not_reduce_the_contrast() {
        let mut pixels = vec![1000, 1100];
        pixels.extend((0..200).map(|i| 1000 + i % 100));
        pixels.push(9000);
        let row = painted(&mut DepthView::new(None, None), &pixels);
        assert!(row[2][0] - row[101][0] > 150);
    }

    #[test]
    fn the_scale_runs_from_the_near_to_the_far_colour_and_names_both_depths() {
        let mut view = DepthView::new(Some(1.0), Some(3.0));
        painted(&mut view, &[1000]);
        let mut canvas = Canvas::default();
        canvas.begin(500, 16);
        let begin = view.draw_scale(&mut canvas, (500, 0), Size::Small);
        let middle: Vec<Colour> = canvas.bytes().as_chunks().0[8 * 500..9 * 500].to_vec();
        let bar = 500 - Size::Small.width("3.00 m ") - 96;
        assert_eq!((middle[bar as usize], middle[bar as usize + 95]), (STOPS[0].1, STOPS[6].1));
        assert_eq!(begin, bar - Size::Small.width("1.00 m "));
        view.begin();
        assert_eq!(view.draw_scale(&mut canvas, (500, 0), Size::Small), 500, "no image, no scale");
    }
}
