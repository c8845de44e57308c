//! Shows how far a run is: one line that is rewritten on a terminal, a line now and then without one.

use super::summary::Summary;
use crate::log::CLEAR_LINE;
use std::io::{IsTerminal, Write, stderr, stdin};
use std::time::{Duration, Instant};

const ON_A_TERMINAL: Duration = Duration::from_millis(250);
const IN_A_LOG: Duration = Duration::from_secs(10);
/// The rate is that of the last seconds, not of the whole run.
const RATE_WINDOW: Duration = Duration::from_secs(2);

/// Shows progress on standard error.
pub(crate) struct Progress {
    quiet: bool,
    terminal: bool,
    /// Whether somebody can press keys.
    has_keys: bool,
    shown: Instant,
    window: (Instant, u64),
    rate_hz: f64,
}

impl Progress {
    pub(crate) fn new(quiet: bool) -> Self {
        let now = Instant::now();
        let (terminal, has_keys) = (stderr().is_terminal(), stdin().is_terminal());
        Self { quiet, terminal, has_keys, shown: now, window: (now, 0), rate_hz: 0.0 }
    }

    /// Shows the state of a run, if it is time to.
    pub(crate) fn show(&mut self, summary: &Summary) {
        let finished = summary.finished();
        let passed = self.window.0.elapsed();
        if passed > RATE_WINDOW || (self.rate_hz == 0.0 && finished > 0) {
            self.rate_hz = finished.saturating_sub(self.window.1) as f64 / passed.as_secs_f64();
            self.window = (Instant::now(), finished);
        }
        let period = if self.terminal { ON_A_TERMINAL } else { IN_A_LOG };
        if self.quiet || self.shown.elapsed() < period {
            return;
        }
        self.shown = Instant::now();
        let line = self.line(summary, finished);
        // Progress that cannot be written is not worth ending a run for.
        if self.terminal { write!(stderr(), "{CLEAR_LINE}{line}") } else { writeln!(stderr(), "{line}") }.ok();
        stderr().flush().ok();
    }

    fn line(&self, summary: &Summary, finished: u64) -> String {
        let total = summary.frames().1.map(|total| format!("/{total}")).unwrap_or_default();
        let (can_pause, is_paused) = summary.pausing();
        let paused = match (is_paused, self.has_keys) {
            (true, true) => ", paused (space: go on, .: one frame)",
            (true, false) => ", paused",
            (false, true) if can_pause => " (space: pause)",
            (false, _) => "",
        };
        format!(
            "{}: {:.0} s, {finished}{total} frames, {:.1} Hz, {} objects, {} dropped{paused}",
            summary.pipeline,
            summary.elapsed.as_secs_f64(),
            self.rate_hz,
            summary.objects(),
            summary.dropped(),
        )
    }

    /// Leaves a clean line behind.
    pub(crate) fn clear(&self) {
        if self.terminal && !self.quiet {
            write!(stderr(), "{CLEAR_LINE}").ok();
        }
    }
}
