//! What an examination finds.

use std::error::Error;

/// Something that is wrong: an error that says what to do about it.
pub type Finding = Box<dyn Error>;
