//! The requirements on items that cross a process border, and their form in JSON.

use crate::Header;
use bytemuck::{Pod, Zeroable};
use serde::{Serialize, Serializer};
use std::fmt;

/// One item of a message: plain old data with a name and a version.
///
/// A program from outside may define its own item types: it implements this trait, and the pipeline file describes the same
/// layout under `[item.NAME]`, so that programs without the type can check, show and carry its items.
pub trait Item: Pod + fmt::Debug + Send + Sync + 'static {
    /// The word for a list of such items in the pipeline file, in JSON and in errors.
    const NAME: &'static str;
    /// Name and version of the memory layout; two processes exchange items only if both have the same.
    const TYPE_NAME: &'static str;
    /// A number of items that few messages exceed, for which memory is reserved.
    const USUAL_LENGTH: usize = 64;
    /// Whether a message is an image, with one item per pixel of the header's camera.
    const IS_IMAGE: bool = false;
    /// Whether items are counted by their [`Item::label`]; a run then also reports that there were none.
    const IS_COUNTED: bool = false;

    /// Checks items that came from another process: their number, their enum values, and that numbers are finite.
    ///
    /// # Errors
    /// The fault of the first faulty item.
    fn check(header: &Header, items: &[Self]) -> Result<(), Malformed>;

    /// The name under which the item is counted (`"sphere"`), if it is.
    fn label(&self) -> Option<&'static str> {
        None
    }
}

/// An item that has a form in JSON.
pub trait ToJson: Item {
    /// The JSON of an item, with keys in a fixed order.
    fn to_json(&self) -> impl Serialize;

    /// The JSON of a message: its list or, for an image, a summary.
    fn message_to_json(message: &Message<'_, Self>) -> impl Serialize {
        List(message.items)
    }
}

struct List<'a, T>(&'a [T]);

impl<T: ToJson> Serialize for List<'_, T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(ToJson::to_json))
    }
}

/// Why a message from another process was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("malformed {kind}: {what}")]
pub struct Malformed {
    /// The expected content: [`Item::NAME`].
    pub kind: String,
    /// The fault.
    pub what: String,
}

impl Malformed {
    /// A fault of a message of kind `kind`.
    pub fn new(kind: &str, what: impl Into<String>) -> Self {
        Self { kind: kind.to_owned(), what: what.into() }
    }
}

/// Returns the fault of the first faulty item as an error.
pub(crate) fn check_each<T: Item>(items: &[T], fault: impl Fn(&T) -> Option<&'static str>) -> Result<(), Malformed> {
    match items.iter().enumerate().find_map(|(index, item)| Some((index, fault(item)?))) {
        Some((index, fault)) => Err(Malformed::new(T::NAME, format!("item {index} {fault}"))),
        None => Ok(()),
    }
}

/// The item of a message that does not exist; a source's input and a sink's output.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Nothing;

impl Item for Nothing {
    const NAME: &'static str = "nothing";
    const TYPE_NAME: &'static str = "conicflow.Nothing.v1";
    const USUAL_LENGTH: usize = 0;

    fn check(_: &Header, _: &[Self]) -> Result<(), Malformed> {
        Err(Malformed::new(Self::NAME, "such a message does not exist"))
    }
}

/// A byte of an item whose type is known only at run time: the input of a stage that reads lists of any type.
#[repr(transparent)]
#[derive(Clone, Copy, Debug, Pod, Zeroable, PartialEq, Eq)]
pub struct AnyByte(pub u8);

impl Item for AnyByte {
    const NAME: &'static str = "any list";
    const TYPE_NAME: &'static str = "conicflow.AnyByte.v1";

    /// Accepts all bytes: the code that knows the type has checked them.
    fn check(_: &Header, _: &[Self]) -> Result<(), Malformed> {
        Ok(())
    }
}

/// A message as a stage reads it, borrowed from the memory that it was written to.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a, T> {
    /// Frame, camera and times.
    pub header: &'a Header,
    /// The pixels or the list.
    pub items: &'a [T],
}

/// Whether all of `numbers` are finite.
pub(crate) fn finite(numbers: &[f64]) -> bool {
    numbers.iter().all(|number| number.is_finite())
}
