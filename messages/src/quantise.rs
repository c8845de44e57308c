//! Conversion of depths in metres to 16-bit units, in which depth images travel.

use crate::{INVALID_FAR, INVALID_NEAR};

/// Metres per unit: a tenth of a millimetre, which is finer than any sensor and reaches to 6.5 m; for larger depths a quarter of
/// a millimetre, which reaches to 16.38 m.
const SCALES: [f64; 2] = [0.0001, COARSEST_SCALE];
/// The coarsest unit of depths, in metres.
pub const COARSEST_SCALE: f64 = 0.000_25;

/// Returns the finest scale (metres per unit) that holds the largest of these depths, or else the coarsest.
/// `metres_per_z` is the unit of `depths`.
pub fn finest_scale(depths: &[f32], metres_per_z: f64) -> f64 {
    let metres = depths.iter().map(|&z| f64::from(z) * metres_per_z).filter(|z| z.is_finite());
    let largest = metres.fold(0.0, f64::max);
    let [fine, coarse] = SCALES;
    if largest / fine < f64::from(INVALID_FAR) - 0.5 { fine } else { coarse }
}

/// Converts a depth to units; returns 0, no measurement, if it is below one unit, out of range, or not a number.
pub fn quantise(z: f32, units_per_z: f64) -> u16 {
    let units = f64::from(z) * units_per_z + 0.5;
    if units >= 1.0 && units < f64::from(INVALID_FAR) { units as u16 } else { INVALID_NEAR }
}

/// Whether a depth exceeds the range of the units.
pub fn is_too_far(z: f32, units_per_z: f64) -> bool {
    let units = f64::from(z) * units_per_z + 0.5;
    units.is_finite() && units >= f64::from(INVALID_FAR)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depths_are_rounded_and_missing_ones_are_zero() {
        let units = |z: f32| quantise(z, 1e4);
        assert_eq!([1.0, 0.00004, 6.6, f32::NAN, f32::INFINITY, -1.0].map(units), [10_000, 0, 0, 0, 0, 0]);
        assert_eq!(units(1.000_06), 10_001);
        assert!(is_too_far(6.6, 1e4) && !is_too_far(f32::NAN, 1e4) && !is_too_far(6.5, 1e4));
    }

    #[test]
    fn depths_beyond_the_last_unit_hold_no_measurement_and_are_too_far() {
        let most = f32::from(INVALID_FAR - 1);
        assert_eq!([most, most + 0.5].map(|z| quantise(z, 1.0)), [INVALID_FAR - 1, INVALID_NEAR]);
        assert_eq!([most, most + 0.5].map(|z| is_too_far(z, 1.0)), [false, true]);
    }

    #[test]
    fn the_scale_is_the_finest_that_holds_the_farthest_depth() {
        assert_eq!(finest_scale(&[0.5, 6.5, f32::NAN], 1.0), 0.0001);
        assert_eq!(finest_scale(&[6.6], 1.0), 0.000_25);
        assert_eq!(finest_scale(&[6600.0], 0.001), 0.000_25, "of depths in millimetres");
        assert_eq!(finest_scale(&[100.0], 1.0), 0.000_25, "the coarsest");
        assert_eq!(finest_scale(&[], 1.0), 0.0001);
    }
}
