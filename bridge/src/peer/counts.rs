//! The counters of an edge.

use conicflow_dataflow::relay::ThrottledWarning;
use conicflow_dataflow::{EdgeReport, InputCounts, lock};
use std::fmt::Arguments;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

/// Counts of one edge, written by its thread and read by another.
#[derive(Debug, Default)]
pub(crate) struct EdgeCounts {
    pub messages: AtomicU64,
    pub wire_bytes: AtomicU64,
    pub memory_bytes: AtomicU64,
    pub lost: AtomicU64,
    pub resent: AtomicU64,
    pub stale: AtomicU64,
    /// Messages not sent because no machine wanted them, with `latest`.
    pub unwanted: AtomicU64,
    /// Malformed messages, dropped when encoding or decoding.
    pub malformed: AtomicU64,
    /// Malformed messages that count as lost on a lossless edge: genuine ones, not those that a third party has sent.
    pub refused: AtomicU64,
    pub age_ns: AtomicU64,
    input: Mutex<InputCounts>,
}

impl EdgeCounts {
    /// Returns counters that continue from the report and the record of an earlier bridge process of the run.
    pub(crate) fn after(earlier: &EdgeReport, input: InputCounts) -> Self {
        let &EdgeReport { messages, wire_bytes, memory_bytes, lost, resent, stale, malformed, refused, .. } = earlier;
        Self {
            messages: messages.into(),
            wire_bytes: wire_bytes.into(),
            memory_bytes: memory_bytes.into(),
            lost: lost.into(),
            resent: resent.into(),
            stale: stale.into(),
            malformed: malformed.into(),
            refused: refused.into(),
            // The report's `malformed` includes these.
            input: InputCounts { malformed: 0, ..input }.into(),
            ..Self::default()
        }
    }

    /// The counters of the reader in shared memory, for an outgoing edge.
    pub(crate) fn input(&self) -> MutexGuard<'_, InputCounts> {
        lock(&self.input)
    }

    pub(crate) fn add(counter: &AtomicU64, count: u64) {
        counter.fetch_add(count, Ordering::Relaxed);
    }

    /// Returns the present counts, with rates since an earlier report, `seconds` ago.
    pub(crate) fn report(&self, topic: &str, direction: &str, earlier: &EdgeReport, seconds: f64) -> EdgeReport {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let (messages, wire_bytes) = (count(&self.messages), count(&self.wire_bytes));
        let of_input = self.input().malformed;
        let per_second = |now: u64, before: u64| now.saturating_sub(before) as f64 / seconds.max(1e-3);
        EdgeReport {
            topic: topic.to_owned(),
            direction: direction.to_owned(),
            messages,
            rate_hz: per_second(messages, earlier.messages),
            bandwidth_mbps: per_second(wire_bytes, earlier.wire_bytes) / 1e6,
            wire_bytes,
            memory_bytes: count(&self.memory_bytes),
            lost: count(&self.lost),
            resent: count(&self.resent),
            stale: count(&self.stale),
            malformed: count(&self.malformed) + of_input,
            refused: count(&self.refused) + of_input,
            age_ms: count(&self.age_ns) as f64 / 1e6,
        }
    }
}

/// Counts the malformed messages of an edge, and logs them now and then.
pub(crate) struct MalformedCounter {
    counts: Arc<EdgeCounts>,
    warning: Mutex<ThrottledWarning>,
}

impl MalformedCounter {
    pub(crate) fn new(counts: Arc<EdgeCounts>) -> Self {
        Self { counts, warning: Mutex::default() }
    }

    /// Counts a malformed message that is lost, and logs what is wrong with it.
    pub(crate) fn lose(&self, what: Arguments<'_>) {
        EdgeCounts::add(&self.counts.refused, 1);
        self.add(what);
    }

    /// Counts a malformed message, and logs what is wrong with it.
    pub(crate) fn add(&self, what: Arguments<'_>) {
        EdgeCounts::add(&self.counts.malformed, 1);
        lock(&self.warning).warn(what);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_computed_since_the_previous_report() {
        let counts = EdgeCounts::default();
        EdgeCounts::add(&counts.messages, 30);
        EdgeCounts::add(&counts.wire_bytes, 5_000_000);
        EdgeCounts::add(&counts.age_ns, 3_000_000);
        let earlier = EdgeReport { messages: 10, wire_bytes: 1_000_000, ..EdgeReport::default() };
        let report = counts.report("objects", "out", &earlier, 2.0);
        assert_eq!((report.messages, report.rate_hz, report.bandwidth_mbps, report.age_ms), (30, 10.0, 2.0, 3.0));
    }

    #[test]
    fn each_message_left_out_is_counted_as_malformed_even_when_it_is_not_logged() {
        let counts = Arc::<EdgeCounts>::default();
        let left_out = MalformedCounter::new(Arc::clone(&counts));
        (0..3).for_each(|_| left_out.add(format_args!("its image has no pixels")));
        assert_eq!(counts.report("depth", "out", &EdgeReport::default(), 1.0).malformed, 3);
        counts.input().malformed = 2;
        left_out.lose(format_args!("its image is too large"));
        let EdgeReport { malformed, refused, .. } = counts.report("depth", "out", &EdgeReport::default(), 1.0);
        assert_eq!((malformed, refused), (6, 3), "what others have put in is nobody's loss");
    }
}
