//! The time that passes between two messages, and whether a message starts a new run.

use conicflow_messages::{Header, Text};

/// Largest difference between the clocks of two sources, in nanoseconds. A source whose first stamp is farther ahead of or behind
/// the shared time, or that falls behind by more, has another clock, and starts now.
const OTHER_CLOCK_NS: i128 = 1_000_000_000; // [tuned]

/// Follows the time stamps of the one or several sources of messages.
#[derive(Clone, Debug)]
pub struct Timeline {
    assumed_period_s: f64,
    /// The shared time of all sources, on the clock of the first.
    now_ns: Option<i128>,
    sources: Vec<Frame>,
}

/// A frame of one source: its last one, or the new one.
#[derive(Clone, Copy, Debug)]
struct Frame {
    stage: Text<32>,
    epoch: u64,
    sequence: u64,
    stamp_ns: u64,
    /// Stamp of the frame in the shared time.
    at_ns: i128,
    /// Time since the frame before; `None` for the first.
    period_ns: Option<i128>,
}

/// The time of a message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Advance {
    /// Index of the source, in the order of their first messages.
    pub source: usize,
    /// Time when the frame was taken, in nanoseconds of the shared time. It is before the newest frame of the other sources only
    /// if the frame is late, which only a shared clock shows.
    pub at_ns: i128,
    /// Seconds since the message before; 0 where the frame is late.
    pub elapsed_s: f64,
    /// Seconds between the previous two messages of this source, the usual gap; infinite before there are two.
    pub usual_s: f64,
    /// Whether the source restarted from its first frame: its earlier frames belong to another run.
    pub new_run: bool,
}

impl Timeline {
    /// Creates a timeline; `assumed_period_s` is the time per frame of a source whose stamps do not advance.
    pub fn new(assumed_period_s: f64) -> Self {
        Self { assumed_period_s, now_ns: None, sources: Vec::new() }
    }

    /// Advances to the time of a message.
    ///
    /// A source that restarts (another epoch) and continues its sequence numbers stays in the same run. The sources share a
    /// clock. A source whose stamps stand still or go back, or are far from those of the others, leaves it: from then on only the
    /// differences of its stamps count. Clocks less than a second apart count as one. A frame that is older than one of another
    /// camera is late, and takes no time.
    pub fn advance(&mut self, header: &Header) -> Advance {
        let mut frame = Frame::of(header);
        let known = self.sources.iter().position(|known| known.stage == frame.stage);
        let source = known.unwrap_or(self.sources.len());
        let new_run = known.is_some_and(|known| frame.begins_after(&self.sources[known]));
        let now_ns = self.now_ns.unwrap_or(frame.at_ns);
        let at_ns = match known {
            Some(_) if new_run => now_ns,
            Some(known) => self.time_after(&self.sources[known], &frame),
            None => frame.at_ns,
        };
        let is_ahead = known.is_none() && at_ns > now_ns + OTHER_CLOCK_NS;
        frame.at_ns = if is_ahead || at_ns < now_ns - OTHER_CLOCK_NS { now_ns } else { at_ns };
        let last = known.map(|known| self.sources[known]);
        frame.period_ns = last.map(|last| frame.at_ns - last.at_ns);
        match known {
            Some(known) => self.sources[known] = frame,
            None => self.sources.push(frame),
        }
        let elapsed_s = self.move_forward(frame.at_ns);
        let usual_s = last.and_then(|last| last.period_ns).map_or(f64::INFINITY, |usual_ns| usual_ns as f64 * 1e-9);
        Advance { source, at_ns: self.taken_at(&frame), elapsed_s, usual_s, new_run }
    }

    /// Returns the time of a message that follows the last one of its source.
    fn time_after(&self, last: &Frame, frame: &Frame) -> i128 {
        let passed_ns = if frame.stamp_ns > last.stamp_ns {
            i128::from(frame.stamp_ns - last.stamp_ns)
        } else {
            let frames = frame.sequence.saturating_sub(last.sequence).max(1);
            (self.assumed_period_s * frames as f64 * 1e9).round() as i128
        };
        last.at_ns.saturating_add(passed_ns)
    }

    /// Moves the shared time forward to `at_ns`; returns the seconds that passed, 0 if that time is past.
    fn move_forward(&mut self, at_ns: i128) -> f64 {
        let now_ns = self.now_ns.unwrap_or(at_ns);
        self.now_ns = Some(now_ns.max(at_ns));
        (at_ns - now_ns).max(0) as f64 * 1e-9
    }

    /// Returns when a frame was taken: now, if its stamps are not on the shared clock.
    fn taken_at(&self, frame: &Frame) -> i128 {
        let is_shared = frame.at_ns == i128::from(frame.stamp_ns);
        self.now_ns.filter(|_| !is_shared).unwrap_or(frame.at_ns)
    }
}

impl Frame {
    fn of(header: &Header) -> Self {
        let &Header { epoch, sequence, stamp_ns, .. } = header;
        Self { stage: header.origin(), epoch, sequence, stamp_ns, at_ns: i128::from(stamp_ns), period_ns: None }
    }

    /// Returns whether the source has restarted from its first frame after `last`.
    fn begins_after(&self, last: &Self) -> bool {
        self.epoch != last.epoch && self.sequence <= last.sequence
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Hop;

    const PERIOD: f64 = 0.04;

    /// The advances of the messages `(stage, epoch, sequence, stamp in ms)`.
    fn advances(messages: &[(&str, u64, u64, u64)]) -> Vec<Advance> {
        let mut timeline = Timeline::new(PERIOD);
        let advance = |&(stage, epoch, sequence, stamp_ms): &(&str, u64, u64, u64)| {
            let mut header = Header { epoch, sequence, stamp_ns: stamp_ms * 1_000_000, ..Header::default() };
            header.add_hop(Hop { stage: Text::new(stage), ..Hop::default() });
            timeline.advance(&header)
        };
        messages.iter().map(advance).collect()
    }

    fn milliseconds(seconds: f64) -> i64 {
        (seconds * 1e3).round() as i64
    }

    /// Elapsed milliseconds; `None` where a new run starts.
    fn elapsed_ms(messages: &[(&str, u64, u64, u64)]) -> Vec<Option<i64>> {
        let elapsed = |advance: &Advance| (!advance.new_run).then_some(milliseconds(advance.elapsed_s));
        advances(messages).iter().map(elapsed).collect()
    }

    /// The lag of each message behind the newest one before it, in milliseconds.
    fn late_ms(messages: &[(&str, u64, u64, u64)]) -> Vec<i64> {
        let mut now_ns = i128::MIN;
        let late_ms = |advance: &Advance| {
            now_ns = now_ns.max(advance.at_ns);
            ((now_ns - advance.at_ns) / 1_000_000) as i64
        };
        advances(messages).iter().map(late_ms).collect()
    }

    #[test]
    fn stamps_are_followed_through_gaps() {
        let times = elapsed_ms(&[("a", 1, 0, 1000), ("a", 1, 1, 1033), ("a", 1, 5, 1166)]);
        assert_eq!(times, [Some(0), Some(33), Some(133)]);
    }

    #[test]
    fn stamps_that_stand_still_or_go_back_are_replaced_by_the_period() {
        let times = elapsed_ms(&[
            ("a", 1, 0, 0),
            ("a", 1, 1, 0),
            ("a", 1, 4, 0),
            ("a", 1, 5, 100),
            ("a", 1, 6, 10),
            ("a", 1, 7, 30),
        ]);
        assert_eq!(times, [Some(0), Some(40), Some(120), Some(100), Some(40), Some(20)]);
    }

    #[test]
    fn a_source_started_anew_goes_on_or_begins() {
        let times = elapsed_ms(&[("a", 1, 7, 900), ("a", 2, 9, 0), ("a", 2, 10, 30), ("a", 3, 0, 0), ("a", 3, 1, 50)]);
        assert_eq!(times, [Some(0), Some(80), Some(30), None, Some(50)]);
    }

    #[test]
    fn two_cameras_share_one_time() {
        let times =
            elapsed_ms(&[("a", 1, 50, 100), ("b", 2, 3, 102), ("b", 2, 4, 135), ("a", 1, 51, 133), ("a", 1, 52, 166)]);
        assert_eq!(times, [Some(0), Some(2), Some(33), Some(0), Some(31)]);
    }

    #[test]
    fn a_camera_that_is_behind_the_others_is_late() {
        let times = [("a", 1, 0, 100), ("b", 2, 0, 60), ("a", 1, 1, 133), ("b", 2, 1, 93), ("b", 2, 2, 140)];
        assert_eq!(late_ms(&times), [0, 40, 0, 40, 0]);
    }

    #[test]
    fn a_clock_of_its_own_tells_nothing_of_how_late_it_is() {
        let times = [("a", 1, 0, 0), ("b", 2, 0, 0), ("b", 2, 1, 0), ("a", 1, 1, 100), ("b", 2, 2, 0)];
        assert_eq!(late_ms(&times), [0; 5]);
    }

    #[test]
    fn one_camera_that_begins_again_takes_no_time_from_the_other() {
        let times = elapsed_ms(&[
            ("a", 1, 50, 10_000),
            ("b", 2, 50, 10_002),
            ("a", 3, 0, 0), // started anew
            ("b", 2, 51, 10_033),
            ("a", 3, 1, 35),
            ("b", 2, 52, 10_066),
            ("b", 2, 53, 5), // goes back
            ("a", 3, 2, 108),
        ]);
        assert_eq!(times, [Some(0), Some(2), None, Some(31), Some(4), Some(29), Some(40), Some(4)]);
    }

    #[test]
    fn a_clock_that_is_seconds_ahead_takes_no_time_from_the_others() {
        let times = elapsed_ms(&[("a", 1, 0, 10_000), ("b", 2, 0, 20_000), ("a", 1, 1, 10_033), ("b", 2, 1, 20_040)]);
        assert_eq!(times, [Some(0), Some(0), Some(33), Some(7)]);
    }

    #[test]
    fn clocks_up_to_a_second_apart_are_one() {
        for (apart_ms, is_one) in [(1000, true), (1001, false)] {
            let told_ms = if is_one { apart_ms } else { 0 };
            let (early, late) = (("a", 1, 0, 10_000), ("b", 2, 0, 10_000 + apart_ms));
            assert_eq!(elapsed_ms(&[early, late]), [Some(0), Some(told_ms as i64)]);
            assert_eq!(late_ms(&[late, early]), [0, told_ms as i64]);
        }
    }

    #[test]
    fn time_goes_on_when_the_camera_that_was_ahead_falls_silent() {
        // Both clocks go on after that of the second camera has jumped ahead by four seconds.
        let times = elapsed_ms(&[
            ("a", 1, 0, 1000),
            ("b", 2, 0, 1000),
            ("b", 2, 1, 5000),
            ("a", 1, 1, 1033),
            ("a", 1, 2, 1066),
        ]);
        assert_eq!(times, [Some(0), Some(0), Some(4000), Some(0), Some(33)]);
    }

    #[test]
    fn a_camera_with_another_clock_begins_now() {
        let year_ns = 1_700_000_000_000;
        let times = elapsed_ms(&[("a", 1, 0, 0), ("b", 2, 0, year_ns), ("a", 1, 1, 33), ("b", 2, 1, year_ns + 40)]);
        assert_eq!(times, [Some(0), Some(0), Some(33), Some(7)]);
    }
}
