//! Findings of the checks.

use std::error::Error;

/// A problem: an error with a hint.
pub type Finding = Box<dyn Error>;
