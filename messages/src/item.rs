//! The kinds of message, and what an item of one has to fulfil to cross a process border.

use crate::Header;
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};
use std::fmt;

/// What a topic carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// No message at all: the input of a source, the output of a sink.
    Nothing,
    /// Depth images.
    Depth,
    /// Lists of [`crate::Ellipse`].
    Ellipses,
    /// Lists of [`crate::Object`].
    Objects,
    /// Lists of [`crate::Track`].
    Tracks,
}

impl Kind {
    /// The word for it in the pipeline file, in JSON and in errors.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nothing => "nothing",
            Self::Depth => "depth",
            Self::Ellipses => "ellipses",
            Self::Objects => "objects",
            Self::Tracks => "tracks",
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One item of a message: plain old data with a name and a version.
pub trait Item: Pod + fmt::Debug + Send + Sync + 'static {
    /// The kind of message that is made of these items.
    const KIND: Kind;
    /// Name and version of the memory layout; two processes exchange items only if theirs are the same.
    const TYPE_NAME: &'static str;

    /// Whether items that came from another process make sense: length, enum values, finite numbers.
    ///
    /// # Errors
    /// What is wrong with the first faulty item.
    fn check(header: &Header, items: &[Self]) -> Result<(), Malformed>;

    /// What the item is called when items are counted (`"sphere"`), if they are.
    fn label(&self) -> Option<&'static str> {
        None
    }
}

/// Why a message from another process was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("malformed {kind}: {what}")]
pub struct Malformed {
    /// The kind of message.
    pub kind: Kind,
    /// What is wrong with it.
    pub what: String,
}

impl Malformed {
    pub(crate) fn new(kind: Kind, what: impl Into<String>) -> Self {
        Self { kind, what: what.into() }
    }
}

/// The item of a message that does not exist; a source's input and a sink's output.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Nothing;

impl Item for Nothing {
    const KIND: Kind = Kind::Nothing;
    const TYPE_NAME: &'static str = "conicflow.Nothing.v1";

    fn check(_: &Header, _: &[Self]) -> Result<(), Malformed> {
        Err(Malformed::new(Kind::Nothing, "such a message does not exist"))
    }
}

/// A message as a stage reads it: borrowed from the memory where it was written.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a, T> {
    /// Frame, camera and times.
    pub header: &'a Header,
    /// The pixels or the list.
    pub items: &'a [T],
}

/// All of `numbers` are finite.
pub(crate) fn finite(numbers: &[f64]) -> bool {
    numbers.iter().all(|number| number.is_finite())
}
