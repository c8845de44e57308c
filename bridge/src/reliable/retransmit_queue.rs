//! The sending end of an edge's numbering: keeps unacknowledged messages, selects those to retransmit, and gives up messages for
//! a machine that stayed away for too long.

use super::send_log::SendLog;
use super::window::Window;
use crate::peer::heartbeat::Ack;
use crate::wire::{StreamPosition, set_oldest};
use conicflow_dataflow::Receiver;
use conicflow_dataflow::ports::Delivery;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};
#[cfg(test)]
use std::{fmt::Debug, hash::Hash};

/// A message is retransmitted when it was not acknowledged after this time. The interval then doubles each time, up to
/// [`LONGEST_RESEND_AFTER`]: the receiver may be slow and the link good.
const RESEND_AFTER: Duration = Duration::from_millis(250);
/// Longest interval between two retransmissions of a message.
const LONGEST_RESEND_AFTER: Duration = Duration::from_secs(4);
/// How long one end of an edge waits for the other at the end of a stream, if nothing else has to be waited for.
pub(crate) const END_PATIENCE: Duration = Duration::from_secs(5);

/// The messages that have left a machine by one edge and may have to be sent again.
#[cfg_attr(test, derive(Clone))]
pub(crate) struct RetransmitQueue {
    stream: u64,
    next: u64,
    log: SendLog,
    window: Window,
    ends: Vec<End>,
    ended_at: Option<Instant>,
    receivers: Vec<Remote>,
    outage: Duration,
    progress: Instant,
    resend_after: Duration,
    overstated: bool,
}

/// The end of a writer's stream.
#[cfg_attr(test, derive(Clone))]
struct End {
    writer: String,
    number: u64,
    bytes: Vec<u8>,
}

/// The state of one receiving machine.
#[cfg_attr(test, derive(Clone))]
struct Remote {
    machine: String,
    lossless: bool,
    /// Number of the message that the machine expects next.
    expected: u64,
    /// Number of the first message that the machine may need again if its bridge is restarted.
    finished: u64,
    ended: BTreeSet<String>,
    heard: Option<Instant>,
    /// Whether its last acknowledgement covered messages that were not sent.
    overstates: bool,
    /// Whether it wants nothing more for the rest of its run.
    is_done: bool,
}

impl Remote {
    /// Whether it was heard before, but not for the last `limit`.
    fn is_gone(&self, now: Instant, limit: Duration) -> bool {
        self.heard.is_some_and(|heard| now.saturating_duration_since(heard) > limit)
    }
}

impl RetransmitQueue {
    /// Returns the queue of an edge to these machines. It continues the stream of the log that an earlier process has left, or
    /// begins a new one. With `latest`, a message may be delayed for `wait`; a lossless machine that is away is waited for during
    /// `outage`.
    pub(crate) fn new(
        stream: u64,
        log: SendLog,
        receivers: &[Receiver],
        [wait, outage]: [Duration; 2],
        now: Instant,
    ) -> Self {
        let remote = |receiver: &Receiver| Remote {
            machine: receiver.machine.clone(),
            lossless: receiver.delivery == Delivery::Lossless,
            expected: 0,
            finished: 0,
            ended: BTreeSet::new(),
            heard: None,
            overstates: false,
            is_done: false,
        };
        let (stream, next) = log.last().map_or((stream, 0), |last| (last.stream, last.number + 1));
        Self {
            stream,
            next,
            log,
            window: Window::new(wait),
            ends: Vec::new(),
            ended_at: None,
            receivers: receivers.iter().map(remote).collect(),
            outage,
            progress: now,
            resend_after: RESEND_AFTER,
            overstated: false,
        }
    }

    /// The parts that distinguish two queues in a model: all but the times.
    #[cfg(test)]
    pub(super) fn essence(&self) -> impl Hash + PartialEq + Debug + use<> {
        let known = |remote: &Remote| {
            (remote.expected, remote.finished, remote.ended.clone(), remote.heard.is_some(), remote.is_done)
        };
        let ends: Vec<_> = self.ends.iter().map(|end| end.number).collect();
        (self.stream, self.next, ends, self.receivers.iter().map(known).collect::<Vec<_>>(), self.lost())
    }

    /// The messages in the log.
    #[cfg(test)]
    pub(super) fn kept(&self) -> impl Iterator<Item = &Vec<u8>> {
        self.log.since(0)
    }

    /// The receiving machines.
    pub(crate) fn machines(&self) -> Vec<String> {
        self.receivers.iter().map(|remote| remote.machine.clone()).collect()
    }

    /// The machines that want more messages.
    fn waiting(&self) -> impl Iterator<Item = &Remote> {
        self.receivers.iter().filter(|remote| !remote.is_done)
    }

    /// The number of messages that a lossless receiver will not get, including those that earlier processes of this bridge gave
    /// up.
    pub(crate) fn lost(&self) -> u64 {
        self.log.lost()
    }

    /// Whether, since the last call, an acknowledgement covered messages that were not sent. Repetitions are reported once.
    pub(crate) fn take_overstated(&mut self) -> bool {
        std::mem::take(&mut self.overstated)
    }

    /// The number of messages, without ends, that some lossless receiver may not have received yet.
    pub(crate) fn unacknowledged(&self) -> u64 {
        let lacking = self.lacking(|_| true);
        let ends = self.ends.iter().filter(|end| end.number >= lacking).count();
        self.log.since(lacking).count().saturating_sub(ends) as u64
    }

    /// The number of messages that lossless receivers will not get if nothing more is sent.
    pub(crate) fn lost_if_it_ends(&self) -> u64 {
        self.lost() + self.unacknowledged()
    }

    /// Number of the first message that a lossless receiver lacks, among the machines for which `counts` is true.
    fn lacking(&self, counts: impl Fn(&str) -> bool) -> u64 {
        let lossless = self.waiting().filter(|remote| remote.lossless && counts(&remote.machine));
        lossless.map(|remote| remote.expected).min().unwrap_or(self.next)
    }

    /// Whether another message may be sent; `round_trip` returns the round-trip time of a connected machine.
    pub(crate) fn may_send(&mut self, now: Instant, round_trip: impl Fn(&str) -> Option<Duration>) -> bool {
        if self.waiting().any(|remote| remote.lossless) {
            return self.log.has_room();
        }
        let present = self.waiting().filter_map(|remote| Some((remote.expected, round_trip(&remote.machine)?)));
        match present.reduce(|one, other| (one.0.min(other.0), one.1.max(other.1))) {
            Some((next, round_trip)) => self.window.acknowledge(next, round_trip, now),
            None => self.window.clear(),
        }
        self.window.is_open()
    }

    /// Whether a machine wants messages: a lossless one always does, any other one only while it is connected.
    pub(crate) fn is_wanted(&self, alive: impl Fn(&str) -> bool) -> bool {
        self.waiting().any(|remote| remote.lossless || alive(&remote.machine))
    }

    /// The position of the next message.
    pub(crate) fn next_position(&self) -> StreamPosition {
        StreamPosition { stream: self.stream, number: self.next, oldest: self.oldest() }
    }

    fn oldest(&self) -> u64 {
        self.log.oldest().unwrap_or(self.next)
    }

    /// Counts the message that was made for [`RetransmitQueue::next_position`], and keeps it if a receiver is lossless.
    pub(crate) fn sent(&mut self, bytes: &[u8], now: Instant) {
        if self.log.len() == 0 {
            self.progress = now;
        }
        if self.waiting().any(|remote| remote.lossless) {
            self.log.add(self.next, bytes);
        } else {
            self.window.sent(self.next, now);
        }
        self.next += 1;
    }

    /// Counts and keeps the end of a writer's stream, which is sent to each receiver until it acknowledges the end.
    pub(crate) fn sent_end(&mut self, writer: &str, bytes: &[u8], now: Instant) {
        self.ends.push(End { writer: writer.to_owned(), number: self.next, bytes: bytes.to_vec() });
        self.sent(bytes, now);
        self.ended_at = Some(now);
    }

    /// Updates what a machine has received and when it was last heard. If it wanted nothing more before, it is in another run now
    /// and gets the messages that are still kept and those that follow.
    pub(crate) fn acknowledge(&mut self, machine: &str, ack: Option<&Ack>, heard: Option<Instant>, now: Instant) {
        let oldest = self.oldest();
        let Some(remote) = self.receivers.iter_mut().find(|remote| remote.machine == machine) else { return };
        remote.heard = heard;
        if std::mem::take(&mut remote.is_done) {
            remote.finished = oldest;
        }
        // No receiver can have more than was sent: such an acknowledgement is forged, or its machine has taken a forged message.
        let ack = ack.filter(|ack| ack.stream == self.stream);
        let overstates = ack.is_some_and(|ack| ack.next > self.next);
        self.overstated |= overstates && !remote.overstates;
        remote.overstates = overstates;
        let ack = ack.filter(|_| !overstates);
        if let Some(ack) = ack {
            if ack.next > remote.expected {
                (self.progress, self.resend_after) = (now, RESEND_AFTER);
            }
            remote.finished = remote.finished.max(ack.finished.min(ack.next));
        }
        // A restarted bridge has received nothing yet.
        remote.ended = ack.map(|ack| ack.ended.iter().cloned().collect()).unwrap_or_default();
        remote.expected = ack.map_or(0, |ack| ack.next).max(remote.finished);
        self.forget(now);
    }

    /// Drops the messages that all lossless receivers have finished; those that are away for longer than the outage do not count.
    fn forget(&mut self, now: Instant) {
        let lossless = || self.waiting().filter(|remote| remote.lossless);
        let waited_for = lossless().filter(|remote| !remote.is_gone(now, self.outage)).map(|remote| remote.finished);
        let needed = waited_for.min().unwrap_or(self.next);
        let given_up: Vec<u64> = lossless().map(|remote| remote.expected).collect();
        while let Some(number) = self.log.oldest().filter(|number| *number < needed) {
            let is_end = self.ends.iter().any(|end| end.number == number);
            // Count before forgetting: a process killed in between then counts one too many rather than one too few.
            self.log.lose(u64::from(!is_end && given_up.iter().any(|next| number >= *next)));
            self.log.forget_first();
        }
    }

    /// Returns the messages to retransmit now; `alive` says whether a machine can be reached.
    pub(crate) fn due(&mut self, now: Instant, alive: impl Fn(&str) -> bool) -> Vec<Vec<u8>> {
        if now.saturating_duration_since(self.progress) < self.resend_after {
            return Vec::new();
        }
        self.progress = now;
        let oldest = self.oldest();
        let again = self.log.since(self.lacking(&alive));
        // A lossless receiver that lacks earlier messages gets the end in its turn.
        let is_ahead = |remote: &Remote, end: &End| remote.lossless && end.number >= remote.expected;
        let is_unaware = |remote: &Remote, end: &End| !remote.ended.contains(&end.writer) && !is_ahead(remote, end);
        let is_untold = |end: &&End| self.waiting().any(|remote| is_unaware(remote, end) && alive(&remote.machine));
        let ends = self.ends.iter().filter(is_untold).map(|end| &end.bytes);
        let mut messages: Vec<_> = again.chain(ends).cloned().collect();
        messages.iter_mut().for_each(|bytes| set_oldest(bytes, oldest));
        let longer = (2 * self.resend_after).min(LONGEST_RESEND_AFTER);
        self.resend_after = if messages.is_empty() { RESEND_AFTER } else { longer };
        messages
    }

    /// Notes that a machine wants nothing more, until it acknowledges something in another run.
    pub(crate) fn finish(&mut self, machine: &str, now: Instant) {
        self.receivers.iter_mut().filter(|remote| remote.machine == machine).for_each(|remote| remote.is_done = true);
        self.forget(now);
    }

    /// Removes the log's files, so that no later process sends anything again.
    pub(crate) fn close(&mut self) {
        self.log.remove_files();
    }

    /// Whether all receivers have what they must have, or will not get it any more. A lossless machine is waited for until its
    /// readers have heard the end ([`RetransmitQueue::finish`]).
    pub(crate) fn is_settled(&self, now: Instant) -> bool {
        let impatient = self.ended_at.is_some_and(|since| now.saturating_duration_since(since) > END_PATIENCE);
        self.waiting().all(|remote| match remote.lossless {
            // A machine that has acknowledged everything and then falls silent was most likely killed at the end of its run.
            true if remote.finished >= self.next => remote.is_gone(now, END_PATIENCE),
            true => self.log.len() == 0 && remote.is_gone(now, self.outage),
            false => impatient || self.ends.iter().all(|end| remote.ended.contains(&end.writer)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reliable::send_log::CAPACITY;

    const OUTAGE: Duration = Duration::from_secs(10);
    const WAIT: Duration = Duration::from_millis(100);

    fn queue(delivery: Delivery, now: Instant) -> RetransmitQueue {
        RetransmitQueue::new(
            1,
            SendLog::default(),
            &[Receiver { machine: "base".to_owned(), delivery }],
            [WAIT, OUTAGE],
            now,
        )
    }

    fn ack(next: u64, ended: &[&str]) -> Ack {
        let ended = ended.iter().map(|&writer| writer.to_owned()).collect();
        Ack { from: String::new(), topic: String::new(), stream: 1, next, finished: next, ended }
    }

    #[test]
    fn messages_that_are_received_but_not_finished_are_kept_for_a_restarted_bridge() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        (0..4_u8).for_each(|number| queue.sent(&[number; 40], start));
        let received = Ack { finished: 1, ..ack(4, &[]) };
        queue.acknowledge("base", Some(&received), Some(start), start);
        let later = start + RESEND_AFTER;
        assert!(queue.due(later, |_| true).is_empty(), "all of them came");
        assert!(!queue.is_settled(later));
        assert_eq!((queue.next_position().oldest, queue.unacknowledged()), (1, 0));
        queue.acknowledge("base", None, Some(later), later);
        let first_bytes: Vec<_> = queue.due(later + RESEND_AFTER, |_| true).iter().map(|bytes| bytes[0]).collect();
        assert_eq!(first_bytes, [1, 2, 3]);
        queue.acknowledge("base", Some(&ack(4, &[])), Some(later), later);
        assert!(!queue.is_settled(later), "its readers have not heard the end");
        assert!(queue.is_settled(later + END_PATIENCE + WAIT), "it has all, and has fallen silent");
        queue.finish("base", later);
        assert!(queue.is_settled(later));
    }

    #[test]
    fn an_acknowledgement_of_unsent_messages_is_ignored_and_reported_once() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        (0..4_u8).for_each(|number| queue.sent(&[number; 40], start));
        let reported: Vec<_> = [ack(4, &[]), ack(5, &[]), ack(5, &[]), ack(u64::MAX, &[]), ack(4, &[]), ack(9, &[])]
            .iter()
            .map(|ack| {
                queue.acknowledge("base", Some(&Ack { finished: 2, ..ack.clone() }), Some(start), start);
                queue.take_overstated()
            })
            .collect();
        assert_eq!(reported, [false, true, false, false, false, true]);
        assert_eq!((queue.next_position().oldest, queue.take_overstated()), (2, false));
        let other = Ack { stream: 2, ..ack(u64::MAX, &[]) };
        queue.acknowledge("base", Some(&other), Some(start), start);
        assert!(!queue.take_overstated(), "it is of another stream");
    }

    #[test]
    fn a_receiver_that_has_finished_is_sent_nothing_until_its_next_run_which_gets_later_messages() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        (0..3_u8).for_each(|number| queue.sent(&[number; 40], start));
        queue.acknowledge("base", Some(&ack(1, &[])), Some(start), start);
        queue.finish("base", start);
        let later = start + RESEND_AFTER;
        assert!(queue.due(later, |_| true).is_empty() && !queue.is_wanted(|_| true) && queue.is_settled(later));
        assert_eq!((queue.next_position().oldest, queue.lost_if_it_ends()), (3, 0), "nothing is kept for it");
        queue.acknowledge("base", None, Some(later), later);
        assert!(queue.is_wanted(|_| false) && !queue.is_settled(later));
        queue.sent(&[3; 40], later);
        let first_bytes: Vec<_> = queue.due(later + RESEND_AFTER, |_| true).iter().map(|bytes| bytes[0]).collect();
        assert_eq!((first_bytes, queue.next_position().oldest), (vec![3], 3));
    }

    #[test]
    fn a_restarted_receiver_is_sent_the_ends_of_writers_again() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        queue.sent_end("one", &[0; 80], start);
        queue.sent(&[1; 80], start);
        queue.acknowledge("base", Some(&ack(2, &["one"])), Some(start), start);
        let later = start + RESEND_AFTER;
        assert!(queue.due(later, |_| true).is_empty(), "it has all of them");
        queue.sent_end("other", &[2; 80], later);
        queue.acknowledge("base", None, Some(later), later);
        let later = later + RESEND_AFTER;
        let due = queue.due(later, |_| true);
        let expected = [2_u8, 0].map(|message| {
            let mut bytes = vec![message; 80];
            set_oldest(&mut bytes, 2);
            bytes
        });
        assert_eq!(due, expected, "one is not kept any more");
        queue.acknowledge("base", Some(&ack(3, &["one", "other"])), Some(later), later);
        assert!(queue.due(later + 2 * RESEND_AFTER, |_| true).is_empty());
    }

    #[test]
    fn unacknowledged_messages_are_sent_again_and_acknowledged_ones_are_forgotten() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        (0..3_u8).for_each(|number| queue.sent(&[number; 40], start));
        queue.acknowledge("base", Some(&ack(1, &[])), Some(start), start);
        assert!(queue.due(start, |_| true).is_empty());
        let later = start + RESEND_AFTER;
        let first_bytes: Vec<_> = queue.due(later, |_| true).iter().map(|bytes| bytes[0]).collect();
        assert_eq!(first_bytes, [1, 2]);
        queue.acknowledge("base", Some(&ack(3, &[])), Some(later), later);
        assert!(queue.due(later + RESEND_AFTER, |_| true).is_empty());
        assert_eq!((queue.next_position().oldest, queue.lost()), (3, 0));
        queue.finish("base", later);
        assert!(queue.is_settled(later));
    }

    #[test]
    fn an_acknowledgement_of_unsent_messages_settles_nothing() {
        let start = Instant::now();
        let silent = start + 2 * END_PATIENCE;
        let mut queue = queue(Delivery::Lossless, start);
        (0..3_u8).for_each(|number| queue.sent(&[number; 40], start));
        for next in [4, 1 << 63, u64::MAX] {
            queue.acknowledge("base", Some(&ack(next, &["source"])), Some(start), start);
            assert_eq!((queue.unacknowledged(), queue.is_settled(silent)), (3, false));
        }
        queue.acknowledge("base", Some(&ack(3, &[])), Some(start), start);
        assert_eq!((queue.unacknowledged(), queue.is_settled(silent)), (0, true));
    }

    #[test]
    fn neither_new_messages_nor_an_old_acknowledgement_delay_a_retransmission() {
        let begin = Instant::now();
        let mut queue = queue(Delivery::Lossless, begin);
        let start = begin + 4 * RESEND_AFTER;
        queue.sent(&[0; 40], start);
        assert!(queue.due(start, |_| true).is_empty(), "it was sent just now");
        let shortly_before = start + RESEND_AFTER - Duration::from_millis(1);
        queue.sent(&[1; 40], shortly_before);
        queue.acknowledge("base", Some(&ack(0, &[])), Some(shortly_before), shortly_before);
        assert_eq!(queue.due(start + RESEND_AFTER, |_| true).len(), 2);
    }

    #[test]
    fn a_receiver_with_latest_is_sent_nothing_again() {
        let start = Instant::now();
        let receivers = [("base", Delivery::Lossless), ("view", Delivery::Latest)]
            .map(|(machine, delivery)| Receiver { machine: machine.to_owned(), delivery });
        let mut queue = RetransmitQueue::new(1, SendLog::default(), &receivers, [WAIT, OUTAGE], start);
        (0..2).for_each(|_| queue.sent(&[0; 40], start));
        queue.acknowledge("base", Some(&Ack { finished: 0, ..ack(2, &[]) }), Some(start), start);
        assert!(queue.due(start + RESEND_AFTER, |_| true).is_empty());
    }

    #[test]
    fn a_queue_that_is_closed_leaves_nothing_for_another_process() {
        let (folder, start) = (tempfile::tempdir().unwrap(), Instant::now());
        let log = SendLog::in_folder(folder.path().to_owned(), "objects");
        let receiver = Receiver { machine: "base".to_owned(), delivery: Delivery::Lossless };
        let mut queue = RetransmitQueue::new(1, log, &[receiver], [WAIT, OUTAGE], start);
        queue.sent(&[0; 40], start);
        let left = || folder.path().read_dir().unwrap().count();
        assert_eq!(left(), 1);
        queue.close();
        assert_eq!(left(), 0);
    }

    #[test]
    fn messages_given_up_count_as_lost_in_the_next_process_whether_or_not_the_edge_has_ended() {
        let (folder, start) = (tempfile::tempdir().unwrap(), Instant::now());
        let receiver = Receiver { machine: "base".to_owned(), delivery: Delivery::Lossless };
        let open = || {
            let log = SendLog::in_folder(folder.path().to_owned(), "objects");
            RetransmitQueue::new(1, log, std::slice::from_ref(&receiver), [WAIT, OUTAGE], start)
        };
        let mut queue = open();
        (0..3).for_each(|_| queue.sent(&[0; 40], start));
        queue.acknowledge("base", Some(&ack(1, &[])), Some(start), start + OUTAGE + Duration::from_millis(1));
        assert_eq!((open().lost(), open().lost_if_it_ends()), (2, 2));
        queue.close();
        assert_eq!(open().lost(), 2);
    }

    #[test]
    fn retransmissions_to_a_slow_receiver_become_rarer() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        queue.sent(&[0; 40], start);
        let times = |queue: &mut RetransmitQueue, range: std::ops::Range<u32>| {
            range.filter(|tick| !queue.due(start + *tick * FULL, |_| true).is_empty()).collect::<Vec<_>>()
        };
        const FULL: Duration = RESEND_AFTER;
        assert_eq!(times(&mut queue, 1..70), [1, 3, 7, 15, 31, 47, 63]);
        queue.sent(&[1; 40], start + 70 * FULL);
        queue.acknowledge("base", Some(&ack(1, &[])), None, start + 70 * FULL);
        assert_eq!(times(&mut queue, 71..75), [71, 73], "it goes on");
    }

    #[test]
    fn messages_for_a_missing_machine_are_kept_for_the_outage_and_then_counted_as_lost() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Lossless, start);
        (0..CAPACITY).for_each(|_| queue.sent(&[0; 40], start));
        queue.acknowledge("base", None, None, start + 3 * OUTAGE);
        assert!(!queue.log.has_room(), "a machine that was never there is waited for");
        queue.acknowledge("base", None, Some(start), start + OUTAGE);
        assert!(!queue.log.has_room());
        let gone = start + OUTAGE + Duration::from_millis(1);
        assert!(!queue.is_settled(gone), "nothing has been given up yet");
        queue.acknowledge("base", None, Some(start), gone);
        assert!(queue.log.has_room() && queue.is_settled(gone));
        assert_eq!((queue.lost(), queue.next_position().oldest), (CAPACITY as u64, CAPACITY as u64));
    }

    #[test]
    fn at_the_end_messages_given_up_or_unacknowledged_are_lost_to_lossless_receivers() {
        let start = Instant::now();
        let mut lossless = queue(Delivery::Lossless, start);
        (0..3).for_each(|_| lossless.sent(&[0; 40], start));
        assert_eq!(lossless.lost_if_it_ends(), 3);
        lossless.acknowledge("base", Some(&ack(1, &[])), Some(start), start);
        assert_eq!(lossless.lost_if_it_ends(), 2);
        let gone = start + OUTAGE + Duration::from_millis(1);
        lossless.acknowledge("base", Some(&ack(1, &[])), Some(start), gone);
        (0..5).for_each(|_| lossless.sent(&[0; 40], gone));
        assert_eq!((lossless.lost(), lossless.lost_if_it_ends()), (2, 2 + 5));
        let mut latest = queue(Delivery::Latest, start);
        (0..3).for_each(|_| latest.sent(&[0; 40], start));
        latest.acknowledge("base", None, Some(start), gone);
        assert_eq!(latest.lost_if_it_ends(), 0, "nobody has to get them");
    }

    #[test]
    fn with_latest_no_queue_builds_up_on_a_slow_link() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Latest, start);
        assert!(!queue.is_wanted(|_| false) && queue.is_wanted(|_| true));
        let (connected, away) = (|_: &str| Some(Duration::ZERO), |_: &str| None);
        assert!(queue.may_send(start, connected));
        queue.sent(&[1; 40], start);
        assert!(!queue.may_send(start, connected));
        queue.acknowledge("base", Some(&ack(1, &[])), Some(start), start);
        assert!(queue.may_send(start, connected));
        queue.sent(&[2; 40], start);
        queue.sent(&[3; 40], start);
        assert!(!queue.may_send(start, connected));
        assert!(queue.may_send(start, away), "nobody is there to wait for");
    }

    #[test]
    fn with_latest_only_the_end_is_repeated_until_it_is_acknowledged() {
        let start = Instant::now();
        let mut queue = queue(Delivery::Latest, start);
        queue.sent(&[1; 40], start);
        queue.sent_end("source", &[2; 40], start);
        let later = start + RESEND_AFTER;
        assert_eq!(queue.due(later, |_| true).len(), 1);
        assert!(queue.due(later + RESEND_AFTER, |_| false).is_empty(), "nobody can be reached");
        assert!(!queue.is_settled(start + END_PATIENCE));
        assert!(queue.is_settled(start + END_PATIENCE + Duration::from_millis(1)), "nobody is waited for any longer");
        queue.acknowledge("base", Some(&ack(0, &["source"])), Some(later), later);
        assert!(queue.is_settled(later));
    }
}
