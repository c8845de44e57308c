//! Side inputs of a stage: read when the driving input has a message; they do not wake the stage themselves.

use crate::item_type::{AnyMessage, ItemType};
use bytemuck::cast_slice;
use conicflow_messages::{Item, Message};

/// A side input that a node takes.
#[derive(Clone, Copy, Debug)]
pub struct SideInput {
    /// Its name in `inputs = { name = "topic" }`.
    pub name: &'static str,
    /// Kind of its messages: [`Item::NAME`].
    pub kind: &'static str,
    /// Which of its messages is read.
    pub pairing: Pairing,
    pub(crate) item: fn() -> ItemType,
}

impl SideInput {
    /// An input of which the newest message is read.
    pub const fn latest<T: Item>(name: &'static str) -> Self {
        Self { name, kind: T::NAME, pairing: Pairing::Latest, item: ItemType::of::<T> }
    }

    /// An input of which the message from the same frame as the driving one is read.
    pub const fn same_frame<T: Item>(name: &'static str) -> Self {
        Self { name, kind: T::NAME, pairing: Pairing::SameFrame, item: ItemType::of::<T> }
    }
}

/// Which message of a side input belongs to a message of the driving one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pairing {
    /// The newest message.
    Latest,
    /// The message from the same frame.
    SameFrame,
}

/// The messages of the side inputs that belong to one step; each may be missing.
#[derive(Clone, Debug, Default)]
pub struct SideInputs<'a>(pub(crate) Vec<(&'a str, AnyMessage<'a>)>);

impl<'a> SideInputs<'a> {
    /// Adds a message of the input `name`.
    #[must_use]
    pub fn with<T: Item>(mut self, name: &'a str, message: Message<'a, T>) -> Self {
        let (header, bytes) = (message.header, cast_slice(message.items));
        self.0.push((name, AnyMessage { header, item: const { &ItemType::of::<T>() }, bytes }));
        self
    }

    /// The message of the input `name`, if it has items of this type.
    pub fn get<T: Item>(&self, name: &str) -> Option<Message<'a, T>> {
        let (_, message) = self.0.iter().find(|(side, _)| *side == name)?;
        message.typed()
    }
}
