//! Shows the progress of a run: one line that is rewritten on a terminal, or a line every ten seconds elsewhere.

use super::summary::Summary;
use crate::log::CLEAR_LINE;
use std::io::{IsTerminal, Write, stderr, stdin};
use std::time::{Duration, Instant};

/// Period of the progress on a terminal.
const ON_A_TERMINAL: Duration = Duration::from_millis(250);
/// Period of the progress in a log.
const IN_A_LOG: Duration = Duration::from_secs(10);
/// Window over which the rate is measured.
const RATE_WINDOW: Duration = Duration::from_secs(2);

/// Shows progress on standard error.
pub(crate) struct Progress {
    place: Box<dyn Write>,
    quiet: bool,
    terminal: bool,
    /// Whether a user can press keys.
    has_keys: bool,
    shown: Instant,
    window: (Instant, u64),
    rate_hz: f64,
}

impl Progress {
    pub(crate) fn new(quiet: bool) -> Self {
        let now = Instant::now();
        let (terminal, has_keys) = (stderr().is_terminal(), stdin().is_terminal());
        Self { place: Box::new(stderr()), quiet, terminal, has_keys, shown: now, window: (now, 0), rate_hz: 0.0 }
    }

    /// Shows the state of a run, if the period is over.
    pub(crate) fn show(&mut self, summary: &Summary) {
        let finished = summary.finished();
        let passed = self.window.0.elapsed();
        if passed > RATE_WINDOW || (self.rate_hz == 0.0 && finished > 0) {
            self.rate_hz = finished.saturating_sub(self.window.1) as f64 / passed.as_secs_f64();
            self.window = (Instant::now(), finished);
        }
        if !self.is_due() {
            return;
        }
        self.shown = Instant::now();
        let line = self.line(summary, finished);
        // A failed write does not end the run.
        if self.terminal { write!(self.place, "{CLEAR_LINE}{line}") } else { writeln!(self.place, "{line}") }.ok();
        self.place.flush().ok();
    }

    fn is_due(&self) -> bool {
        let period = if self.terminal { ON_A_TERMINAL } else { IN_A_LOG };
        !self.quiet && self.shown.elapsed() >= period
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

    /// Clears the line of the terminal.
    pub(crate) fn clear(&mut self) {
        if self.terminal && !self.quiet {
            write!(self.place, "{CLEAR_LINE}").ok();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::summary::tests::lossless;
    use super::*;
    use crate::status::{InputCounts, Life, Pausing};
    use std::io::{Read, Seek};

    /// A run whose source has sent 40 of 50 frames, of which a sink has finished 38.
    fn run(pausing: Pausing) -> Summary {
        let mut run = lossless(InputCounts::default(), "writer");
        run.stages[0].planned.wiring.output = None;
        run.stages[0].status.as_mut().unwrap().steps = 38;
        let source = run.stages[1].status.as_mut().unwrap();
        source.total = 50;
        source.set_life(Life::Running);
        source.set_pausing(pausing);
        run
    }

    #[test]
    fn a_line_tells_how_far_a_run_is_and_what_keys_there_are_to_pause_it() {
        let line = |pausing: Pausing, has_keys: bool| {
            let progress = Progress { has_keys, rate_hz: 12.34, ..Progress::new(true) };
            progress.line(&run(pausing), 38)
        };
        let said = "test: 1 s, 38/50 frames, 12.3 Hz, 0 objects, 0 dropped";
        for (pausing, has_keys, further) in [
            (Pausing::Cannot, true, ""),
            (Pausing::Cannot, false, ""),
            (Pausing::Goes, true, " (space: pause)"),
            (Pausing::Goes, false, ""),
            (Pausing::Stands, true, ", paused (space: go on, .: one frame)"),
            (Pausing::Stands, false, ", paused"),
        ] {
            assert_eq!(line(pausing, has_keys), format!("{said}{further}"));
        }
    }

    #[test]
    fn a_terminal_is_written_to_more_often_than_a_log() {
        let is_due = |terminal: bool, seconds: u64| {
            let shown = Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
            Progress { terminal, shown, ..Progress::new(false) }.is_due()
        };
        assert_eq!([is_due(true, 1), is_due(false, 1), is_due(false, 11)], [true, false, true]);
        assert!(!Progress { terminal: false, ..Progress::new(false) }.is_due(), "it has just begun");
    }

    #[test]
    fn a_terminal_keeps_one_line_which_goes_at_the_end_a_log_keeps_all_and_who_wants_it_quiet_gets_none() {
        let written = |terminal: bool, quiet: bool| {
            let (mut file, mut text) = (tempfile::tempfile().unwrap(), String::new());
            let place = Box::new(file.try_clone().unwrap());
            let shown = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
            let new = Progress::new(quiet);
            let mut progress = Progress { place, terminal, has_keys: false, shown, rate_hz: 9.0, ..new };
            (0..2).for_each(|_| progress.show(&run(Pausing::Goes)));
            progress.clear();
            file.rewind().unwrap();
            file.read_to_string(&mut text).unwrap();
            text
        };
        let line = "test: 1 s, 38/50 frames, 9.0 Hz, 0 objects, 0 dropped";
        assert_eq!(written(true, false), format!("{CLEAR_LINE}{line}{CLEAR_LINE}"));
        assert_eq!(written(false, false), format!("{line}\n"));
        assert_eq!([true, false].map(|terminal| written(terminal, true)), [""; 2]);
    }

    #[test]
    fn the_rate_is_that_of_what_was_finished_since_the_window_began() {
        let shown = |seconds: u64, finished: u64, rate_hz: f64| {
            let began = Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
            let mut progress = Progress { window: (began, finished), rate_hz, ..Progress::new(true) };
            let before = progress.shown;
            progress.show(&run(Pausing::Cannot));
            assert_eq!(progress.shown, before, "it is quiet");
            (progress.rate_hz, progress.window.1)
        };
        let (rate_hz, finished) = shown(4, 8, 100.0);
        assert!((1.0..=7.5).contains(&rate_hz) && finished == 38, "30 frames in four seconds or more, {rate_hz} Hz");
        assert_eq!(shown(0, 8, 100.0), (100.0, 8), "it is too early for another");
        let (first_hz, finished) = shown(0, 0, 0.0);
        assert!(first_hz > 100.0 && finished == 38, "the first is told at once, {first_hz} Hz");
    }
}
