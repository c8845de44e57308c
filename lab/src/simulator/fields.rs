//! How the numbers of a scene file are checked while it is read, so that an error names the line and the column.

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
    let number = f64::deserialize(deserializer)?;
    if number.is_finite() {
        Ok(number)
    } else {
        Err(D::Error::custom(format!("expected a finite number, got {number}")))
    }
}

/// A finite number above zero.
fn positive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    match finite(deserializer)? {
        number if number > 0.0 => Ok(number),
        number => Err(D::Error::custom(format!("expected a number above zero, got {number}"))),
    }
}

/// A finite number, zero or above.
pub fn not_negative<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    match finite(deserializer)? {
        number if number >= 0.0 => Ok(number),
        number => Err(D::Error::custom(format!("expected zero or a number above it, got {number}"))),
    }
}

/// A share from 0 to 1.
pub fn share<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    match finite(deserializer)? {
        number if (0.0..=1.0).contains(&number) => Ok(number),
        number => Err(D::Error::custom(format!("expected a number from 0 to 1, got {number}"))),
    }
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

/// A direction of any length but zero; made a unit vector.
pub fn direction<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vector3<f64>, D::Error> {
    let unit = vector(deserializer)?.try_normalize(1e-9);
    unit.ok_or_else(|| D::Error::custom("expected a direction, got a vector of length zero"))
}

/// A quaternion `[x, y, z, w]` of any length but zero; made a unit quaternion.
fn quaternion<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 4], D::Error> {
    let numbers = <[f64; 4]>::deserialize(deserializer)?;
    let length = numbers.iter().map(|number| number * number).sum::<f64>().sqrt();
    if length.is_finite() && length > 1e-9 {
        Ok(numbers.map(|number| number / length))
    } else {
        Err(D::Error::custom(format!("expected a quaternion `[x, y, z, w]`, got {numbers:?}")))
    }
}
