//! Further inputs of a stage: read when a message of the driving input is there, without waking the stage themselves.

use conicflow_messages::{Ellipse, Kind, Message, Object, Track};

/// A further input that a node takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Side {
    /// Its name in `inputs = { name = "topic" }`.
    pub name: &'static str,
    /// What it carries.
    pub kind: Kind,
    /// Which of its messages is wanted.
    pub pick: Pick,
}

/// Which message of a further input goes with a message of the driving one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pick {
    /// The newest there is.
    Latest,
    /// The one made from the same frame.
    SameFrame,
}

/// A message of any kind.
#[derive(Clone, Copy, Debug)]
pub enum AnyMessage<'a> {
    /// A depth image.
    Depth(Message<'a, u16>),
    /// A list of ellipses.
    Ellipses(Message<'a, Ellipse>),
    /// A list of objects.
    Objects(Message<'a, Object>),
    /// A list of tracks.
    Tracks(Message<'a, Track>),
}

/// The messages of the further inputs that go with one step; each may be missing.
#[derive(Clone, Debug, Default)]
pub struct Sides<'a>(pub Vec<(&'static str, AnyMessage<'a>)>);

impl<'a> Sides<'a> {
    fn find(&self, name: &str) -> Option<AnyMessage<'a>> {
        self.0.iter().find(|(side, _)| *side == name).map(|(_, message)| *message)
    }

    /// The depth image of the input `name`.
    pub fn depth(&self, name: &str) -> Option<Message<'a, u16>> {
        if let Some(AnyMessage::Depth(message)) = self.find(name) { Some(message) } else { None }
    }

    /// The ellipses of the input `name`.
    pub fn ellipses(&self, name: &str) -> Option<Message<'a, Ellipse>> {
        if let Some(AnyMessage::Ellipses(message)) = self.find(name) { Some(message) } else { None }
    }

    /// The objects of the input `name`.
    pub fn objects(&self, name: &str) -> Option<Message<'a, Object>> {
        if let Some(AnyMessage::Objects(message)) = self.find(name) { Some(message) } else { None }
    }

    /// The tracks of the input `name`.
    pub fn tracks(&self, name: &str) -> Option<Message<'a, Track>> {
        if let Some(AnyMessage::Tracks(message)) = self.find(name) { Some(message) } else { None }
    }
}
