//! Checks numbers of a scene file while it is read, so that errors name line and column.

use nalgebra::Vector3;
use serde::Deserialize;
use serde::de::{Deserializer, Error};

/// A finite number above zero.
#[derive(Clone, Copy, Deserialize)]
pub struct Positive(#[serde(deserialize_with = "positive")] pub f64);

/// Three finite numbers.
#[derive(Clone, Copy, Deserialize)]
pub struct Vector(#[serde(deserialize_with = "vector")] pub Vector3<f64>);

/// A unit vector.
#[derive(Clone, Copy, Deserialize)]
pub struct Direction(#[serde(deserialize_with = "direction")] pub Vector3<f64>);

/// A unit quaternion `[x, y, z, w]`.
#[derive(Clone, Copy, Deserialize)]
pub struct Quaternion(#[serde(deserialize_with = "quaternion")] pub [f64; 4]);

/// A finite number.
pub fn finite<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, |_| true, "a finite number")
}

fn checked<'de, D: Deserializer<'de>>(
    deserializer: D,
    is_right: fn(f64) -> bool,
    expected: &str,
) -> Result<f64, D::Error> {
    let number = f64::deserialize(deserializer)?;
    let is_right = number.is_finite() && is_right(number);
    if is_right { Ok(number) } else { Err(D::Error::custom(format!("expected {expected}, got {number}"))) }
}

/// A finite number above zero.
fn positive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, |number| number > 0.0, "a number above zero")
}

/// A finite number, zero or above.
pub fn not_negative<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, |number| number >= 0.0, "zero or a number above it")
}

/// A share from 0 to 1.
pub fn share<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, |number| (0.0..=1.0).contains(&number), "a number from 0 to 1")
}

/// Three finite numbers.
pub fn vector<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vector3<f64>, D::Error> {
    let numbers = <[f64; 3]>::deserialize(deserializer)?;
    if numbers.iter().all(|number| number.is_finite()) {
        Ok(numbers.into())
    } else {
        Err(D::Error::custom(format!("expected three finite numbers, got {numbers:?}")))
    }
}

/// Three numbers above zero.
pub fn size<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vector3<f64>, D::Error> {
    let size = vector(deserializer)?;
    if size.min() > 0.0 {
        Ok(size)
    } else {
        Err(D::Error::custom(format!("expected three numbers above zero, got {:?}", size.as_slice())))
    }
}

/// A direction of any length but zero, normalised.
pub fn direction<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vector3<f64>, D::Error> {
    let unit = vector(deserializer)?.try_normalize(1e-9);
    unit.ok_or_else(|| D::Error::custom("expected a direction, got a vector of length zero"))
}

/// A quaternion `[x, y, z, w]` of any length but zero, normalised.
fn quaternion<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 4], D::Error> {
    let numbers = <[f64; 4]>::deserialize(deserializer)?;
    let length = numbers.iter().map(|number| number * number).sum::<f64>().sqrt();
    if length.is_finite() && length > 1e-9 {
        Ok(numbers.map(|number| number / length))
    } else {
        Err(D::Error::custom(format!("expected a quaternion `[x, y, z, w]`, got {numbers:?}")))
    }
}
