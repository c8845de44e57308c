//! How much time passed between two messages, and whether a message begins a new run.

use conicflow_messages::{Header, Text};

/// Follows the time stamps of the sources, one or several, that the messages come from.
#[derive(Clone, Debug)]
pub struct Timeline {
    assumed_period_s: f64,
    now_ns: Option<u64>,
    sources: Vec<Sight>,
}

/// The last message of one source.
#[derive(Clone, Copy, Debug)]
struct Sight {
    stage: Text<32>,
    epoch: u64,
    sequence: u64,
    stamp_ns: u64,
}

/// What a message means for the time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Advance {
    /// Seconds since the message before.
    pub elapsed_s: f64,
    /// The source began from its first frame: what was before has nothing to do with it.
    pub new_run: bool,
}

impl Timeline {
    /// Before the first message. Where the stamps of a source do not advance, `assumed_period_s` stands for each frame.
    pub fn new(assumed_period_s: f64) -> Self {
        Self { assumed_period_s, now_ns: None, sources: Vec::new() }
    }

    /// Goes on to the time of a message.
    ///
    /// A source that was started anew (another epoch) and goes on with its sequence numbers is the same run. Stamps count
    /// as they are; a frame that is older than one of another camera takes no time.
    pub fn advance(&mut self, header: &Header) -> Advance {
        let sight = Sight::of(header);
        let Some(last) = self.replace(sight) else {
            return Advance { elapsed_s: self.move_forward(sight.stamp_ns), new_run: false };
        };
        let new_run = sight.epoch != last.epoch && sight.sequence <= last.sequence;
        let stands = sight.stamp_ns <= last.stamp_ns;
        if new_run || stands {
            self.now_ns = Some(sight.stamp_ns);
        }
        let elapsed_s = match (new_run, stands) {
            (true, _) => 0.0,
            (false, true) => self.assumed_period_s * sight.sequence.saturating_sub(last.sequence).max(1) as f64,
            (false, false) => self.move_forward(sight.stamp_ns),
        };
        Advance { elapsed_s, new_run }
    }

    /// Remembers a message, and gives the one before from the same source.
    fn replace(&mut self, sight: Sight) -> Option<Sight> {
        if let Some(known) = self.sources.iter_mut().find(|known| known.stage == sight.stage) {
            return Some(std::mem::replace(known, sight));
        }
        self.sources.push(sight);
        None
    }

    /// Seconds until `stamp_ns`; none if that is past.
    fn move_forward(&mut self, stamp_ns: u64) -> f64 {
        let now_ns = self.now_ns.unwrap_or(stamp_ns);
        self.now_ns = Some(now_ns.max(stamp_ns));
        stamp_ns.saturating_sub(now_ns) as f64 * 1e-9
    }
}

impl Sight {
    fn of(header: &Header) -> Self {
        let stage = header.trace().first().map_or_else(Text::default, |hop| hop.stage);
        Self { stage, epoch: header.epoch, sequence: header.sequence, stamp_ns: header.stamp_ns }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Hop;

    const PERIOD: f64 = 0.04;

    /// Elapsed milliseconds, and where a new run began, for messages `(stage, epoch, sequence, stamp in ms)`.
    fn elapsed_ms(messages: &[(&str, u64, u64, u64)]) -> Vec<Option<i64>> {
        let mut timeline = Timeline::new(PERIOD);
        let advance = |&(stage, epoch, sequence, stamp_ms): &(&str, u64, u64, u64)| {
            let mut header = Header { epoch, sequence, stamp_ns: stamp_ms * 1_000_000, ..Header::default() };
            header.add_hop(Hop { stage: Text::new(stage), ..Hop::default() });
            let advance = timeline.advance(&header);
            (!advance.new_run).then_some((advance.elapsed_s * 1e3).round() as i64)
        };
        messages.iter().map(advance).collect()
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
}
