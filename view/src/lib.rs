//! A page that shows in a browser what a camera sees and what was found in it: the depth image with outlines, the same in space,
//! the list, the graph of stages.
//!
//! In the order in which a frame meets them: a [`Gatherer`] brings depth images and lists of the same frame together; a
//! [`Display`] holds what is to be seen now; a [`Server`] hands it to browsers that ask. Nothing here knows where frames come
//! from: a running pipeline, a recording and a sink feed the same display.
//!
//! Browsers ask, and are answered with the newest there is. So nobody waits for a slow one, and where nobody asks nothing is
//! done.

mod access;
mod display;
mod frame;
mod gatherer;
pub mod outline;
mod page;
mod request;
mod response;
mod server;

pub use access::{Listen, ListenFault};
pub use display::{About, Command, Display, Player};
pub use frame::{Depth, Frame, List};
pub use gatherer::Gatherer;
pub use server::{ServeError, Server};
