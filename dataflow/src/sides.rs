//! Further inputs of a stage: read when a message of the driving input is there, without waking the stage themselves.

use crate::item_type::{AnyMessage, ItemType};
use bytemuck::cast_slice;
use conicflow_messages::{Item, Message};

/// A further input that a node takes.
#[derive(Clone, Copy, Debug)]
pub struct Side {
    /// Its name in `inputs = { name = "topic" }`.
    pub name: &'static str,
    /// What it carries: [`Item::NAME`].
    pub kind: &'static str,
    /// Which of its messages is wanted.
    pub pick: Pick,
    pub(crate) item: fn() -> ItemType,
}

impl Side {
    /// An input of which the newest message is read.
    pub const fn latest<T: Item>(name: &'static str) -> Self {
        Self { name, kind: T::NAME, pick: Pick::Latest, item: ItemType::of::<T> }
    }

    /// An input of which that message is read which was made from the same frame as the driving one.
    pub const fn same_frame<T: Item>(name: &'static str) -> Self {
        Self { name, kind: T::NAME, pick: Pick::SameFrame, item: ItemType::of::<T> }
    }
}

/// Which message of a further input goes with a message of the driving one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pick {
    /// The newest there is.
    Latest,
    /// The one made from the same frame.
    SameFrame,
}

/// The messages of the further inputs that go with one step; each may be missing.
#[derive(Clone, Debug, Default)]
pub struct Sides<'a>(pub(crate) Vec<(&'static str, AnyMessage<'a>)>);

impl<'a> Sides<'a> {
    /// The same with a message of the input `name`.
    #[must_use]
    pub fn with<T: Item>(mut self, name: &'static str, message: Message<'a, T>) -> Self {
        let (header, bytes) = (message.header, cast_slice(message.items));
        self.0.push((name, AnyMessage { header, item: const { &ItemType::of::<T>() }, bytes }));
        self
    }

    /// The message of the input `name`, which carries items of this type.
    pub fn get<T: Item>(&self, name: &str) -> Option<Message<'a, T>> {
        let (_, message) = self.0.iter().find(|(side, _)| *side == name)?;
        message.typed()
    }
}
