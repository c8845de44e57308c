//! A web page that shows what a camera sees and what was found in it: the depth image with outlines, a 3D view, the list of
//! objects or tracks, and the graph of stages.
//!
//! In the order in which a frame passes: a [`Gatherer`] combines depth images and lists of the same frame; a [`Display`] holds
//! the present state; a [`Server`] sends it to browsers that request the [`Page`]. Nothing here depends on where frames come
//! from: a running pipeline, a recording and a sink use the same display.
//!
//! Browsers ask, and get the newest state. So nothing waits for a slow browser, and without browsers no work is done. The server
//! also serves other [`Answer`]s, such as a run's metrics.

mod access;
mod browser;
mod display;
mod frame;
mod gatherer;
pub mod outline;
mod page;
mod request;
mod response;
mod server;

pub use access::{Listen, ListenFault};
pub use browser::Page;
pub use display::{About, Command, Display, Player, Run};
pub use frame::{Compared, Depth, Frame, List, Pair};
pub use gatherer::Gatherer;
pub use request::Request;
pub use response::Response;
pub use server::{Answer, ServeError, Server, lower_priority};
