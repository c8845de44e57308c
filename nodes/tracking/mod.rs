//! Objects to tracks, and tracks to commands.

mod follower;
mod kalman_tracker;

pub use follower::{Follower, FollowerConfig};
pub use kalman_tracker::KalmanTracker;
