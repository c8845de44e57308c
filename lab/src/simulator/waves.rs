//! A smooth, constant random image: the bend of a camera's lens and calibration.

use crate::random::CounterRng;

/// Returns normal deviates of variance one for each pixel, row by row: cubic B-splines between knots `length_px` apart.
pub fn waves([width, height]: [u32; 2], length_px: f64, dice: &CounterRng) -> Vec<f64> {
    let count = |size: u32| (f64::from(size) / length_px) as usize + 4;
    let (columns, rows) = (count(width), count(height));
    let knots: Vec<f64> = (0..columns * rows).map(|knot| dice.gaussian(knot as u64)).collect();
    let mut field = Vec::with_capacity(width as usize * height as usize);
    for v in 0..height {
        let (row, down) = weights(f64::from(v) / length_px);
        for u in 0..width {
            let (column, across) = weights(f64::from(u) / length_px);
            let (mut sum, mut squares) = (0.0, 0.0);
            for (j, down) in down.into_iter().enumerate() {
                for (i, across) in across.into_iter().enumerate() {
                    sum += down * across * knots[(row + j) * columns + column + i];
                    squares += (down * across) * (down * across);
                }
            }
            field.push(sum / squares.sqrt());
        }
    }
    field
}

/// Returns the first of the four knots that contribute at a position, and their weights.
fn weights(place: f64) -> (usize, [f64; 4]) {
    let knot = place.floor();
    let t = place - knot;
    let s = 1.0 - t;
    let middle = |t: f64| (2.0 / 3.0 - t * t * (1.0 - 0.5 * t)).max(0.0);
    (knot as usize, [s * s * s / 6.0, middle(t), middle(s), t * t * t / 6.0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variance_is_one_and_neighbours_are_alike_over_a_knot() {
        let (size, length) = ([400, 300], 10.0);
        let field = waves(size, length, &CounterRng::new(1, 2));
        let product = |lag: usize| {
            let pairs = field.chunks_exact(400).flat_map(|row| row.iter().zip(&row[lag..]));
            pairs.map(|(a, b)| a * b).sum::<f64>() / ((400 - lag) * 300) as f64
        };
        assert!((product(0) - 1.0).abs() < 0.1, "{}", product(0));
        assert!(product(10) / product(0) > 0.4 && product(40).abs() < 0.15, "{} {}", product(10), product(40));
    }
}
