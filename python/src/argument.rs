//! Conversion of numbers and words, with errors that say what was given, what was expected, and how to convert it.

use crate::fault;
use pyo3::prelude::*;
use pyo3::types::PyString;

/// The hint for a time in nanoseconds.
const STAMP: &str = "of seconds give round(seconds * 1e9), of a stamp of ROS stamp.sec * 10**9 + stamp.nanosec";

/// Maximum length of a value in an error, in characters.
const MOST_SHOWN: usize = 80;

/// Describes a given value for an error.
pub(crate) fn describe(given: &Bound<'_, PyAny>) -> String {
    let kind = given.get_type().name().map_or_else(|_| String::new(), |name| name.to_string());
    let text = given.repr().map_or_else(|_| String::new(), |text| text.to_string());
    if given.is_none() {
        text
    } else if let Ok(shape) = given.getattr("shape")
        && shape.is_truthy().unwrap_or(false)
    {
        format!("a {kind} of shape {shape}")
    } else if text.is_empty() || text.starts_with('<') || text.contains('\n') || text.chars().count() > MOST_SHOWN {
        format!("a value of type {kind}")
    } else {
        format!("{text} ({kind})")
    }
}

/// Converts an integer from 0 to `most`.
pub(crate) fn whole(name: &str, given: &Bound<'_, PyAny>, most: u64, hint: &str) -> PyResult<u64> {
    if let Ok(number) = given.extract::<u64>()
        && number <= most
    {
        return Ok(number);
    }
    let what = format!("`{name}` is {}, expected a whole number from 0 to {most}", describe(given));
    let is_whole = given.py().import("operator")?.call_method1("index", (given,)).is_ok();
    Err(if is_whole { fault::value(what, hint) } else { fault::kind(what, hint) })
}

/// Converts a time in nanoseconds.
pub(crate) fn stamp_ns(given: &Bound<'_, PyAny>) -> PyResult<u64> {
    let hint = [
        ("nanosec", "give stamp.sec * 10**9 + stamp.nanosec"),
        ("nanoseconds", "give stamp.nanoseconds"),
        ("timestamp", "give round(stamp.timestamp() * 1e9)"),
    ];
    let hint = hint.iter().find(|(attribute, _)| given.hasattr(*attribute).unwrap_or(false)).map(|(_, hint)| *hint);
    let is_datetime64 = given.get_type().name().is_ok_and(|name| name == "datetime64");
    let hint = hint.or(is_datetime64.then_some("give int(stamp.astype(\"datetime64[ns]\").astype(int))"));
    whole("stamp_ns", given, u64::MAX, hint.unwrap_or(STAMP))
}

/// Converts a number.
pub(crate) fn number(name: &str, given: &Bound<'_, PyAny>, hint: &str) -> PyResult<f64> {
    given.extract().map_err(|_| fault::kind(format!("`{name}` is {}, expected a number", describe(given)), hint))
}

/// Converts a word.
pub(crate) fn word(name: &str, given: &Bound<'_, PyAny>, hint: &str) -> PyResult<String> {
    let word = given.cast::<PyString>().map(|word| word.to_string());
    word.map_err(|_| fault::kind(format!("`{name}` is {}, expected a str", describe(given)), hint))
}
