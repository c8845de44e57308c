//! What an item of a message has to be to cross a process border, and how it looks in JSON.

use crate::Header;
use bytemuck::{Pod, Zeroable};
use serde::{Serialize, Serializer};
use std::fmt;

/// One item of a message: plain old data with a name and a version.
///
/// A program of one's own can have item types of its own: it implements this, and the pipeline file describes the same
/// layout under `[item.NAME]`, so that programs which do not know the type can check, show and carry it.
pub trait Item: Pod + fmt::Debug + Send + Sync + 'static {
    /// What a topic with such items carries: the word in the pipeline file, in JSON and in errors.
    const NAME: &'static str;
    /// Name and version of the memory layout; two processes exchange items only if theirs are the same.
    const TYPE_NAME: &'static str;
    /// Items of a message, which few exceed: room is made for as many.
    const USUAL_LENGTH: usize = 64;
    /// Whether a message is an image: as many items as the header's camera has pixels.
    const IS_IMAGE: bool = false;
    /// Whether items are counted by their [`Item::label`]; a run then also tells that there was none.
    const IS_COUNTED: bool = false;

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

/// An item that has a form in JSON.
pub trait ToJson: Item {
    /// The item as it is written, keys in order.
    fn to_json(&self) -> impl Serialize;

    /// What is written of a message: its list, or of an image a summary.
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
    /// What the message should carry: [`Item::NAME`].
    pub kind: String,
    /// What is wrong with it.
    pub what: String,
}

impl Malformed {
    /// A fault of a message that should carry `kind`.
    pub fn new(kind: &str, what: impl Into<String>) -> Self {
        Self { kind: kind.to_owned(), what: what.into() }
    }
}

/// Looks for the first item that has a fault.
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

/// A byte of an item whose type is known only when the program runs: the input of a stage that takes a list of any type.
#[repr(transparent)]
#[derive(Clone, Copy, Debug, Pod, Zeroable, PartialEq, Eq)]
pub struct AnyByte(pub u8);

impl Item for AnyByte {
    const NAME: &'static str = "any list";
    const TYPE_NAME: &'static str = "conicflow.AnyByte.v1";

    /// Whoever knows the type has checked them.
    fn check(_: &Header, _: &[Self]) -> Result<(), Malformed> {
        Ok(())
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
