//! Paints a depth image in grey: near is light, far is dark, and what holds no measurement is dark blue.

use super::canvas::{Canvas, Colour};
use conicflow_lab::quantile::at_rank;
use conicflow_messages::is_measured;

const HOLE: Colour = [14, 20, 52];
const LIGHTEST: f64 = 225.0;
const DARKEST: f64 = 38.0;

/// Paints depth images; keeps room for a frame's depths.
#[derive(Debug, Default)]
pub(super) struct DepthView {
    near_m: Option<f64>,
    far_m: Option<f64>,
    measured: Vec<u16>,
}

impl DepthView {
    /// Paints with the depths of the lightest and the darkest grey in metres; those not given follow each frame.
    pub(super) fn new(near_m: Option<f64>, far_m: Option<f64>) -> Self {
        Self { near_m, far_m, measured: Vec::new() }
    }

    /// Paints all of the canvas; `scale` is in metres per unit.
    pub(super) fn paint(&mut self, pixels: &[u16], scale: f64, canvas: &mut Canvas) {
        let (low, high) = self.usual_range(pixels);
        let near = self.near_m.map_or(low, |near_m| near_m / scale);
        let far = self.far_m.map_or(high, |far_m| far_m / scale).max(near + 1.0);
        let slope = (DARKEST - LIGHTEST) / (far - near);
        for (painted, &depth) in canvas.pixels_mut().zip(pixels) {
            let grey = (LIGHTEST + slope * (f64::from(depth) - near)).clamp(DARKEST, LIGHTEST);
            *painted = if is_measured(depth) { [grey as u8; 3] } else { HOLE };
        }
    }

    /// The depths below which 1 and 97 percent of the measurements lie.
    fn usual_range(&mut self, pixels: &[u16]) -> (f64, f64) {
        if self.near_m.is_some() && self.far_m.is_some() {
            return (0.0, 1.0);
        }
        self.measured.clear();
        self.measured.extend(pixels.iter().filter(|&&depth| is_measured(depth)));
        let count = self.measured.len();
        let mut at = |rank| at_rank(&mut self.measured, rank, u16::cmp).map_or(65535.0, f64::from);
        (at(count / 100), at(count - count / 33))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn painted(view: &mut DepthView, pixels: &[u16]) -> Vec<Colour> {
        let mut canvas = Canvas::default();
        canvas.begin(pixels.len() as u32, 1);
        view.paint(pixels, 0.001, &mut canvas);
        canvas.pixels_mut().map(|pixel| *pixel).collect()
    }

    #[test]
    fn near_is_light_far_is_dark_holes_are_blue() {
        let row = painted(&mut DepthView::default(), &[0, 500, 1000, 1500, 65535]);
        assert_eq!((row[0], row[4]), (HOLE, HOLE));
        assert!(row[1][0] > row[2][0] && row[2][0] > row[3][0]);
        assert_eq!(painted(&mut DepthView::default(), &[0, 65535]), [HOLE, HOLE]);
    }

    #[test]
    fn a_fixed_range_does_not_depend_on_the_frame() {
        let mut view = DepthView::new(Some(1.0), Some(3.0));
        let row = painted(&mut view, &[500, 1000, 2000, 3000, 9000]);
        let greys: Vec<_> = row.iter().map(|colour| colour[0]).collect();
        assert_eq!(greys, [225, 225, 131, 38, 38]);
    }

    #[test]
    fn single_far_outliers_do_not_take_the_contrast() {
        let mut pixels = vec![1000, 1100];
        pixels.extend((0..200).map(|i| 1000 + i % 100));
        pixels.push(9000);
        let row = painted(&mut DepthView::default(), &pixels);
        assert!(row[2][0] - row[101][0] > 150);
    }
}
