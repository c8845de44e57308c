//! Reports of a stage on whether the router is reached.

use crate::Middleware;
use std::time::{Duration, Instant};

/// How long the router may take to answer before the stage reports it.
const ROUTER_TIMEOUT: Duration = Duration::from_secs(1);

/// Watches the link to the router.
pub(crate) struct Link {
    connect: String,
    /// Since when the router is not reached.
    missing: Option<Instant>,
    is_reported: bool,
}

impl Link {
    pub(crate) fn new(connect: &[String]) -> Self {
        Self { connect: connect.join("`, `"), missing: None, is_reported: false }
    }

    /// Logs a change; returns whether the router is reached.
    pub(crate) fn look(&mut self, middleware: &impl Middleware) -> bool {
        let connect = &self.connect;
        if middleware.is_joined() {
            self.missing = None;
            if std::mem::take(&mut self.is_reported) {
                tracing::info!("the router at `{connect}` is reached");
            }
            return true;
        }
        if self.missing.get_or_insert_with(Instant::now).elapsed() > ROUTER_TIMEOUT && !self.is_reported {
            self.is_reported = true;
            tracing::warn!(
                "no router of ROS 2 is reached at `{connect}`; it is tried again\n  \
                 hint: start one on the robot, `ros2 run rmw_zenoh_cpp rmw_zenohd` or `zenohd`; does `connect` name its address?"
            );
        }
        false
    }
}
