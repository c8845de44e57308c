//! A page that shows in a browser what a camera sees and what was found in it: the depth image with outlines, the same in space,
//! the list, the graph of stages.
//!
//! In the order in which a frame meets them: a [`Gatherer`] brings depth images and lists of the same frame together; a
//! [`Display`] holds what is to be seen now; a [`Server`] hands it to browsers that ask for the [`Page`]. Nothing here knows
//! where frames come from: a running pipeline, a recording and a sink feed the same display.
//!
//! Browsers ask, and are answered with the newest there is. So nobody waits for a slow one, and where nobody asks nothing is
//! done. The server serves other [`Answer`]s as well, such as a run's metrics.

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
pub use server::{Answer, ServeError, Server, give_way};
