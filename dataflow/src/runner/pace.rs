//! Timing of a source: it makes or sends messages at its rate, or at the intervals of their stamps, and not while the run is
//! paused.

use crate::pause::{Pause, Turn};
use crate::status::{Pausing, StatusFile};
use crate::stop::Stop;
use std::time::{Duration, Instant};

/// Longest period, 30 years: longer ones count as never due, and any clock can represent this one.
const LONGEST_PERIOD_S: f64 = 1e9;
/// A waiting source checks this often for a pause.
const PAUSE_CHECK_PERIOD: Duration = Duration::from_millis(20);
/// A wait for a stamp that is longer than this is logged, as an observer could take the run for stalled.
const LONG: Duration = Duration::from_secs(5); // [algorithmic]

/// Timing that a source asks for.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Rhythm {
    /// Messages per second; 0: as fast as they are taken.
    pub(crate) rate_hz: f64,
    /// Messages are sent at the intervals of their stamps, whatever the rate.
    pub(crate) keeps_stamps: bool,
    /// Whether it can be paused.
    pub(crate) can_pause: bool,
}

/// Times a source's messages: each is due at a fixed time, however long the previous one took.
#[derive(Debug)]
pub(crate) struct Pace {
    period: Duration,
    keeps_stamps: bool,
    due: Option<Instant>,
    /// Stamp of the previous message.
    stamp_ns: Option<u64>,
    stop: Stop,
    pause: Pause,
}

impl Pace {
    /// Pace of a source with this rhythm; `pause` pauses it, if it can be paused.
    pub(crate) fn new(rhythm: Rhythm, stop: Stop, pause: Pause) -> Self {
        let Rhythm { rate_hz, keeps_stamps, can_pause } = rhythm;
        let period_s = if rate_hz > 0.0 { (1.0 / rate_hz).min(LONGEST_PERIOD_S) } else { 0.0 };
        let pause = if can_pause { pause } else { Pause::default() };
        Self { period: Duration::from_secs_f64(period_s), keeps_stamps, due: None, stamp_ns: None, stop, pause }
    }

    /// Waits until the next message is to be made, or the run is to end, and calls `meanwhile` now and then. A source that fell
    /// behind by more than one message does not hurry to catch up.
    pub(crate) fn wait_to_make(&mut self, record: &mut StatusFile, meanwhile: impl FnMut()) {
        if self.keeps_stamps {
            return;
        }
        let now = Instant::now();
        let due = self.due.map_or(now, |due| due + self.period);
        let is_late = now.saturating_duration_since(due) > self.period;
        self.due = Some(if is_late { now } else { due });
        self.wait_until(due, record, meanwhile);
    }

    /// Waits until a message with this stamp is to be sent, after the interval between its stamp and the previous one, or until
    /// the run is to end. A late message does not make the next ones hurry. Without a stamp it waits only while the run is
    /// paused.
    pub(crate) fn wait_to_send(&mut self, stamp_ns: Option<u64>, record: &mut StatusFile, meanwhile: impl FnMut()) {
        if !self.keeps_stamps {
            return;
        }
        let now = Instant::now();
        let since_last = stamp_ns.zip(self.stamp_ns).map_or(0, |(stamp_ns, last_ns)| stamp_ns.saturating_sub(last_ns));
        let due = self.due.and_then(|due| due.checked_add(Duration::from_nanos(since_last)));
        let due = due.filter(|due| *due > now).unwrap_or(now);
        (self.due, self.stamp_ns) = (Some(due), stamp_ns);
        if let Some(warning) = long_wait(due.saturating_duration_since(now)) {
            tracing::warn!("{warning}");
        }
        self.wait_until(due, record, meanwhile);
    }

    fn wait_until(&mut self, due: Instant, record: &mut StatusFile, mut meanwhile: impl FnMut()) {
        while !self.stop.requested() {
            let turn = self.pause.turn();
            record_pausing(record, turn);
            let left = due.saturating_duration_since(Instant::now());
            let pause = match turn {
                Turn::Go if left.is_zero() => return,
                Turn::Go => left.min(PAUSE_CHECK_PERIOD),
                Turn::Stand => PAUSE_CHECK_PERIOD,
                Turn::Step => {
                    // The next message is due one period after this one, not after this one's due time.
                    self.due = Some(Instant::now());
                    return;
                }
            };
            meanwhile();
            std::thread::sleep(pause);
        }
    }
}

/// Message to log for a long wait for the next stamp.
fn long_wait(wait: Duration) -> Option<String> {
    let what = "later by its stamp, and is waited for";
    let hint = "did a clock jump while it was recorded? `rate_hz` plays it at a rate, whatever the stamps; 0: at once";
    let wait_s = wait.as_secs();
    (wait > LONG).then(|| format!("the next frame is {wait_s} s {what}\n  hint: {hint}"))
}

/// Records whether the source is paused, if that has changed.
fn record_pausing(record: &mut StatusFile, turn: Turn) {
    let pausing = if turn == Turn::Go { Pausing::Goes } else { Pausing::Stands };
    if ![Pausing::Cannot, pausing].contains(&record.status.pausing()) {
        record.status.set_pausing(pausing);
        record.write();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pause::{PAUSE_FILE, PauseFile, PauseRequest};

    fn rhythm(rate_hz: f64) -> Rhythm {
        Rhythm { rate_hz, keeps_stamps: false, can_pause: true }
    }

    #[test]
    fn every_rate_has_a_period_that_the_clock_can_tell() {
        let mut record = StatusFile::nowhere();
        for rate_hz in [f64::MIN_POSITIVE, 1e-320, 1e-20, 1e-9, f64::MAX, f64::INFINITY, 0.0, f64::NAN] {
            let stop = Stop::default();
            let mut pace = Pace::new(rhythm(rate_hz), stop.clone(), Pause::default());
            pace.wait_to_make(&mut record, || ());
            stop.request();
            (0..3).for_each(|_| pace.wait_to_make(&mut record, || ()));
        }
    }

    #[test]
    fn every_stamp_is_due_at_a_time_that_the_clock_can_tell() {
        let (stop, mut record) = (Stop::default(), StatusFile::nowhere());
        let rhythm = Rhythm { keeps_stamps: true, ..Rhythm::default() };
        let mut pace = Pace::new(rhythm, stop.clone(), Pause::default());
        let begin = Instant::now();
        [5, 40_000_000, 3, 3].into_iter().for_each(|stamp_ns| pace.wait_to_send(Some(stamp_ns), &mut record, || ()));
        assert!(begin.elapsed() >= Duration::from_nanos(39_999_995), "as far apart as the stamps");
        stop.request();
        [u64::MAX, 0, u64::MAX].into_iter().for_each(|stamp_ns| pace.wait_to_send(Some(stamp_ns), &mut record, || ()));
    }

    #[test]
    fn a_long_wait_for_a_stamp_is_told() {
        assert_eq!(long_wait(LONG), None);
        assert!(
            long_wait(Duration::from_secs(3600)).unwrap().starts_with("the next frame is 3600 s later by its stamp")
        );
    }

    #[test]
    fn messages_are_due_one_period_after_the_other_and_who_fell_far_behind_begins_anew() {
        let (stop, mut record) = (Stop::default(), StatusFile::nowhere());
        // A source that is to end does not wait.
        stop.request();
        let mut pace = Pace::new(rhythm(4.0), stop, Pause::default());
        let mut due = |pace: &mut Pace| {
            pace.wait_to_make(&mut record, || ());
            pace.due.unwrap()
        };
        let [first, second, third] = [(); 3].map(|()| due(&mut pace));
        assert_eq!([second - first, third - second], [Duration::from_millis(250); 2]);
        let now = Instant::now();
        pace.due = now.checked_sub(Duration::from_secs(10));
        assert!(due(&mut pace) >= now, "what was missed is not made up for");
    }

    /// Many steps of a slow source, after which it is due as if there had been one.
    #[test]
    fn steps_are_made_at_once_and_a_step_does_not_put_off_what_follows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(PAUSE_FILE);
        PauseFile::create(&path, 7).unwrap();
        let word = PauseFile::open(&path, 7).unwrap();
        let pause = Pause::obey(PauseFile::open(&path, 7).ok());
        let mut record = StatusFile::nowhere();
        record.status.set_pausing(Pausing::Goes);
        let hour = Duration::from_secs(3600);
        let mut pace = Pace::new(rhythm(1.0 / hour.as_secs_f64()), Stop::default(), pause);
        pace.wait_to_make(&mut record, || ());
        for _ in 0..5 {
            word.change(PauseRequest::Step).unwrap();
            pace.wait_to_make(&mut record, || ());
            assert_eq!(record.status.pausing(), Pausing::Stands);
        }
        assert!(pace.due.unwrap() <= Instant::now(), "five hours are not waited for");
    }
}
