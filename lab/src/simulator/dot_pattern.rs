//! The pattern of a projector: dots of random position and brightness, which never change.

use crate::random::CounterRng;

/// Side of the tile that is repeated, in pixels of the camera; wider than any disparity.
const TILE_PX: usize = 512;
/// Cells per pixel, along each side.
const CELLS: usize = 2;
/// Cells along each side of the tile.
const SIDE: usize = TILE_PX * CELLS;
/// Brightness of the dimmest dot, relative to the brightest.
const DIMMEST: f64 = 0.4;

/// Brightness of the projector's image.
#[derive(Clone, Debug)]
pub struct DotPattern {
    cells: Vec<f32>,
}

impl DotPattern {
    /// Creates a pattern with this number of dots per pixel, each a Gaussian of this standard deviation in pixels; overlapping
    /// dots add up.
    pub fn new(dots_per_px: f64, dot_sigma_px: f64, dice: &CounterRng) -> Self {
        let sigma = dot_sigma_px * CELLS as f64;
        let reach = (3.0 * sigma).ceil() as i64;
        let mut cells = vec![0.0; SIDE * SIDE];
        let dots = (dots_per_px * (TILE_PX * TILE_PX) as f64) as u64;
        for dot in 0..dots {
            let [x, y] = [0, 1].map(|i| SIDE as f64 * dice.uniform(3 * dot + i));
            let brightness = DIMMEST + (1.0 - DIMMEST) * dice.uniform(3 * dot + 2);
            for j in -reach..=reach {
                for i in -reach..=reach {
                    let (column, row) = (x.floor() + i as f64, y.floor() + j as f64);
                    let squared = (column - x).powi(2) + (row - y).powi(2);
                    let light = brightness * libm::exp(-0.5 * squared / (sigma * sigma));
                    cells[wrapped(row as i64) * SIDE + wrapped(column as i64)] += light as f32;
                }
            }
        }
        Self { cells }
    }

    /// Returns the brightness at a position in pixels, interpolated linearly between cells.
    #[inline]
    pub fn at(&self, x: f64, y: f64) -> f32 {
        let (x, y) = (x * CELLS as f64, y * CELLS as f64);
        let (left, top) = (x.floor(), y.floor());
        let (across, down) = ((x - left) as f32, (y - top) as f32);
        let (left, top) = (left as i64, top as i64);
        let (columns, rows) = ([wrapped(left), wrapped(left + 1)], [wrapped(top), wrapped(top + 1)]);
        let row = |row: usize| {
            let [one, other] = columns.map(|column| self.cells[row * SIDE + column]);
            one + across * (other - one)
        };
        let (upper, lower) = (row(rows[0]), row(rows[1]));
        upper + down * (lower - upper)
    }
}

#[inline]
fn wrapped(cell: i64) -> usize {
    cell.rem_euclid(SIDE as i64) as usize
}
