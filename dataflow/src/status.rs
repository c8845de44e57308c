//! Record of a running stage: a file of fixed layout in the run's folder, rewritten after each step.
//!
//! Observers read the file; the stage neither notices nor waits, and its counts survive its death. Durations are counted in a
//! histogram with logarithmic buckets, as the record has a fixed size.

use crate::clock::monotonic_ns;
use crate::heartbeat::Heartbeat;
use bytemuck::{Pod, Zeroable};
use conicflow_messages::Text;
use std::fs::{File, OpenOptions};
use std::io;
use std::mem::offset_of;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Maximum number of inputs in a record; further ones are not counted.
pub const MAX_INPUTS: usize = 6;
/// Maximum number of item labels in a record; further ones are not counted.
pub const MAX_LABELS: usize = 8;
/// Maximum number of named counters in a record; further ones are not counted.
pub const MAX_COUNTERS: usize = 40;

/// Run id of stages that were started one by one, without a launcher.
pub const NO_RUN: u64 = 0;

/// First word of a record: name and version of its layout.
const LAYOUT: u64 = 0x636f_6e69_6366_0007;
/// Number of buckets per octave of time: a percentile is accurate within 3 %.
const STEPS: usize = 16;
/// Number of octaves in a histogram of durations: 1 microsecond to 69 seconds.
const OCTAVES: usize = 26;
/// Start of the first octave in nanoseconds; shorter durations count in its first bucket.
const SMALLEST_NS: u64 = 1024;

/// State of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Life {
    /// Started, not yet ready.
    Starting,
    /// At work.
    Running,
    /// Done: it has sent all its messages.
    Ended,
    /// Given up by the launcher; it will not be restarted.
    Gone,
}

impl Life {
    const ALL: [Self; 4] = [Self::Starting, Self::Running, Self::Ended, Self::Gone];

    /// Whether the stage will do nothing more.
    pub fn is_over(self) -> bool {
        matches!(self, Self::Ended | Self::Gone)
    }
}

/// Whether a source is paused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pausing {
    /// The stage cannot be paused: it is a live source, or not a source.
    Cannot,
    /// The source can be paused, and is running.
    Goes,
    /// The source is paused.
    Stands,
}

impl Pausing {
    const ALL: [Self; 3] = [Self::Cannot, Self::Goes, Self::Stands];
}

/// Counts of one input.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct InputCounts {
    /// Name of the topic.
    pub topic: Text<64>,
    /// Number of messages processed.
    pub received: u64,
    /// Number of messages that the writer sent and this input missed: replaced by newer ones, or lost.
    pub dropped: u64,
    /// Number of frames missing in the sequence, wherever they were lost.
    pub gaps: u64,
    /// Number of messages that came twice or out of order, and were skipped.
    pub late: u64,
    /// Number of malformed messages, which were skipped.
    pub malformed: u64,
    /// The last processed message.
    pub last: LastMessage,
}

/// Identity of a message in a stream.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct LastMessage {
    /// The stage that wrote it.
    pub writer: Text<32>,
    /// Its number among the messages of that writer.
    pub number: u64,
    /// The stage that made its frame.
    pub source: Text<32>,
    /// Start number (epoch) of the source that made the frame.
    pub epoch: u64,
    /// Sequence number of the frame at its source.
    pub sequence: u64,
}

/// A named count.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct Counter {
    /// Name.
    pub name: Text<56>,
    /// Count.
    pub count: u64,
}

/// Histogram of durations, with buckets that grow with the duration.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Durations {
    buckets: [[u32; STEPS]; OCTAVES],
}

impl Default for Durations {
    fn default() -> Self {
        Self::zeroed()
    }
}

impl Durations {
    /// Counts a duration in nanoseconds.
    pub fn add(&mut self, ns: u64) {
        let ns = ns.max(SMALLEST_NS);
        let octave = (ns.ilog2() - SMALLEST_NS.ilog2()) as usize;
        let step = ((ns >> (ns.ilog2() - 4)) & 15) as usize;
        let bucket = if octave < OCTAVES { (octave, step) } else { (OCTAVES - 1, STEPS - 1) };
        self.buckets[bucket.0][bucket.1] += 1;
    }

    /// Number of counted durations.
    pub fn count(&self) -> u64 {
        self.buckets.iter().flatten().map(|&count| u64::from(count)).sum()
    }

    /// Number of durations in each octave, with the octave's upper end in seconds; the last octave includes all longer ones.
    pub fn octaves(&self) -> impl Iterator<Item = (f64, u64)> {
        let end = |octave: usize| (SMALLEST_NS << (octave + 1)) as f64 * 1e-9;
        let counted = self.buckets.iter().map(|octave| octave.iter().map(|&count| u64::from(count)).sum());
        counted.enumerate().map(move |(octave, count)| (end(octave), count))
    }

    /// Sum of the durations in seconds, within 3 %.
    pub fn sum_s(&self) -> f64 {
        let counts = self.buckets.iter().flatten().enumerate();
        counts.map(|(index, &count)| f64::from(count) * middle_ns(index) * 1e-9).sum()
    }

    /// Quantile of the durations for `quantile` from 0 to 1; `None` if none was counted.
    pub fn quantile(&self, quantile: f64) -> Option<Duration> {
        let rank = (self.count() as f64 * quantile).ceil().max(1.0) as u64;
        let mut below = 0;
        for (index, &count) in self.buckets.iter().flatten().enumerate() {
            below += u64::from(count);
            if below >= rank {
                return Some(Duration::from_nanos(middle_ns(index) as u64));
            }
        }
        None
    }
}

/// The middle of a bucket, in nanoseconds.
fn middle_ns(index: usize) -> f64 {
    let (octave, step) = (index / STEPS, index % STEPS);
    (SMALLEST_NS << octave) as f64 * (1.0 + (step as f64 + 0.5) / STEPS as f64)
}

/// Intervals between successive messages: their distribution and their exact moments.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Intervals {
    durations: Durations,
    count: u64,
    sum_s: f64,
    sum_squares_s2: f64,
}

impl Intervals {
    /// Counts an interval in nanoseconds.
    pub fn add(&mut self, ns: u64) {
        let seconds = ns as f64 * 1e-9;
        self.durations.add(ns);
        self.count += 1;
        self.sum_s += seconds;
        self.sum_squares_s2 += seconds * seconds;
    }

    /// The intervals that were counted since an earlier state of the same record.
    pub fn since(&self, earlier: &Self) -> Self {
        let mut buckets = self.durations.buckets;
        let before = earlier.durations.buckets.as_flattened();
        buckets.as_flattened_mut().iter_mut().zip(before).for_each(|(now, before)| *now = now.saturating_sub(*before));
        Self {
            durations: Durations { buckets },
            count: self.count.saturating_sub(earlier.count),
            sum_s: self.sum_s - earlier.sum_s,
            sum_squares_s2: self.sum_squares_s2 - earlier.sum_squares_s2,
        }
    }

    /// Shortest and longest interval, within 3 %; `None` if there is none.
    pub fn range(&self) -> Option<(Duration, Duration)> {
        Some((self.durations.quantile(0.0)?, self.durations.quantile(1.0)?))
    }

    /// Mean in seconds; `None` if there is none.
    pub fn mean_s(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum_s / self.count as f64)
    }

    /// Standard deviation in seconds; `None` for fewer than two.
    pub fn standard_deviation_s(&self) -> Option<f64> {
        let count = self.count as f64;
        let mean = self.sum_s / count;
        (self.count > 1).then(|| (self.sum_squares_s2 / count - mean * mean).max(0.0).sqrt())
    }
}

/// The record of one stage.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Status {
    layout: u64,
    /// The run that the counts belong to.
    pub run: u64,
    /// Name of the stage.
    pub stage: Text<32>,
    /// Process id of the stage.
    pub process: u32,
    life: u32,
    /// Total number of messages that there will be; 0 if unknown.
    pub total: u64,
    /// Number of messages processed (by a source: made).
    pub steps: u64,
    /// Number of messages sent.
    pub sent: u64,
    /// Number of bytes of the messages sent.
    pub sent_bytes: u64,
    /// Number of starts of the stage in this run.
    pub starts: u64,
    /// Not 0 if it ended before its input did, because it or the user wanted no more.
    pub had_enough: u64,
    /// Last heartbeat of its process, on the monotonic clock, in nanoseconds.
    pub alive_ns: u64,
    /// The stage that it waits for to take its messages, if it has waited for a tenth of a second.
    pub waits_for: Text<32>,
    pausing: u64,
    /// Counts per input, the driving one first.
    pub inputs: [InputCounts; MAX_INPUTS],
    /// Items sent, by label.
    pub found: [Counter; MAX_LABELS],
    /// Counters of the stage's own.
    pub counters: [Counter; MAX_COUNTERS],
    /// Durations of steps.
    pub compute: Durations,
    /// Time from the sending by the writer to the receipt by this stage.
    pub hop: Durations,
    /// Time from the source's receipt of a frame to this stage's receipt of the message computed from it.
    pub latency: Durations,
    /// Intervals between sent messages.
    pub intervals: Intervals,
}

impl Default for Status {
    fn default() -> Self {
        Self { layout: LAYOUT, ..Self::zeroed() }
    }
}

impl Status {
    /// State of the stage.
    pub fn life(&self) -> Life {
        Life::ALL.get(self.life as usize).copied().unwrap_or(Life::Starting)
    }

    /// Sets the state of the stage.
    pub fn set_life(&mut self, life: Life) {
        self.life = life as u32;
    }

    /// Whether the source is paused.
    pub fn pausing(&self) -> Pausing {
        Pausing::ALL.get(self.pausing as usize).copied().unwrap_or(Pausing::Cannot)
    }

    /// Sets whether the source is paused.
    pub fn set_pausing(&mut self, pausing: Pausing) {
        self.pausing = pausing as u64;
    }

    /// Adds to a named counter.
    pub fn count(&mut self, name: &str, times: u64) {
        add(&mut self.counters, name, times);
    }

    /// Counts a sent item by its label.
    pub fn count_found(&mut self, label: &str) {
        add(&mut self.found, label, 1);
    }

    /// The inputs in use.
    pub fn used_inputs(&self) -> impl Iterator<Item = &InputCounts> {
        self.inputs.iter().filter(|input| input.topic != Text::default())
    }

    /// Whether a process of the run `run` continues this record. Stages that were started one by one share no run, so they never
    /// continue an earlier record.
    fn continues_in(&self, run: u64) -> bool {
        self.run == run && run != NO_RUN
    }

    /// Reads the record in a file; `None` if the file is missing or its layout is another.
    pub fn read(path: &Path) -> Option<Self> {
        let mut status = Self::zeroed();
        File::open(path).ok()?.read_exact_at(bytemuck::bytes_of_mut(&mut status), 0).ok()?;
        (status.layout == LAYOUT).then_some(status)
    }
}

fn add(counters: &mut [Counter], name: &str, times: u64) {
    let text = Text::new(name);
    let slot = counters.iter_mut().find(|slot| slot.name == text || slot.name == Text::default());
    if let Some(slot) = slot {
        slot.name = text;
        slot.count += times;
    }
}

/// The counters in use.
pub fn used(counters: &[Counter]) -> impl Iterator<Item = (&str, u64)> {
    let used = counters.iter().filter(|counter| counter.name != Text::default());
    used.map(|counter| (counter.name.as_str().unwrap_or("?"), counter.count))
}

/// Path of a stage's record.
pub(crate) fn status_path(folder: &Path, stage: &str) -> PathBuf {
    folder.join(format!("{stage}.status"))
}

/// A record and its file.
#[derive(Debug)]
pub struct StatusFile {
    /// The record; [`StatusFile::write`] publishes it.
    pub status: Box<Status>,
    file: Option<File>,
}

impl StatusFile {
    /// A record without a file.
    pub(crate) fn nowhere() -> Self {
        Self { status: Box::default(), file: None }
    }

    /// Opens the record in the file `path`, and continues it if it belongs to the same `run`. Stages that were started one by one
    /// ([`NO_RUN`]) always begin a new record.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn open(path: &Path, run: u64) -> io::Result<Self> {
        let earlier = Status::read(path).filter(|status| status.continues_in(run));
        let status = earlier.unwrap_or_default();
        let file = OpenOptions::new().create(true).truncate(false).read(true).write(true).open(path)?;
        let mut status = Box::new(status);
        status.run = run;
        Ok(Self { status, file: Some(file) })
    }

    /// Loads what another process of the same stage and run has written since this one opened the file.
    pub(crate) fn reload(&mut self) {
        let mut status = Status::zeroed();
        let read = self.file.as_ref().map(|file| file.read_exact_at(bytemuck::bytes_of_mut(&mut status), 0));
        if matches!(read, Some(Ok(()))) && status.layout == LAYOUT && status.continues_in(self.status.run) {
            *self.status = status;
        }
    }

    /// Heartbeat of this process for the time between writes of the record.
    pub(crate) fn heartbeat(&self) -> Option<Heartbeat> {
        let file = self.file.as_ref()?.try_clone().ok()?;
        Some(Heartbeat::new(file, offset_of!(Status, alive_ns), offset_of!(Status, waits_for)))
    }

    /// Publishes the record, which is a heartbeat, too. A failed write (a full disk) only hides the counts.
    pub fn write(&mut self) {
        self.status.alive_ns = monotonic_ns();
        if let Some(file) = &self.file {
            file.write_all_at(bytemuck::bytes_of(&*self.status), 0).ok();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_right_within_four_percent() {
        let mut durations = Durations::default();
        (1..=10_000_u64).for_each(|us| durations.add(us * 1000));
        for (quantile, us) in [(0.5, 5000.0), (0.99, 9900.0), (0.01, 100.0)] {
            let found = durations.quantile(quantile).unwrap().as_secs_f64() * 1e6;
            assert!((found / us - 1.0).abs() < 0.04, "{quantile}: {found} us, not {us}");
        }
        assert_eq!(Durations::default().quantile(0.5), None);
    }

    #[test]
    fn octaves_hold_all_of_them_and_their_sum_is_right_within_four_percent() {
        let mut durations = Durations::default();
        (1..=10_000_u64).for_each(|us| durations.add(us * 1000));
        let below = |end: f64| durations.octaves().take_while(|(upper, _)| *upper <= end).map(|(_, count)| count).sum();
        let counts: [u64; 3] = [0.001_048_576, 0.008_388_608, 80.0].map(below);
        assert_eq!(counts, [1048, 8388, 10_000]);
        assert!((durations.sum_s() / 50.005 - 1.0).abs() < 0.04, "{}", durations.sum_s());
    }

    #[test]
    fn intervals_are_those_since_the_earlier_look() {
        let mut intervals = Intervals::zeroed();
        intervals.add(900_000_000);
        let earlier = intervals;
        assert_eq!((intervals.since(&earlier).range(), intervals.since(&earlier).mean_s()), (None, None));
        assert_eq!(
            (earlier.mean_s(), earlier.standard_deviation_s()),
            (Some(0.9), None),
            "one alone scatters about nothing"
        );
        [20, 40, 30, 30].into_iter().for_each(|ms: u64| intervals.add(ms * 1_000_000));
        let new = intervals.since(&earlier);
        let (shortest, longest) = new.range().unwrap();
        assert!((shortest.as_secs_f64() / 0.02 - 1.0).abs() < 0.04, "{shortest:?}");
        assert!((longest.as_secs_f64() / 0.04 - 1.0).abs() < 0.04, "{longest:?}");
        assert!((new.mean_s().unwrap() - 0.03).abs() < 1e-9, "{:?}", new.mean_s());
        assert!((new.standard_deviation_s().unwrap() - 0.00005_f64.sqrt()).abs() < 1e-7);
    }

    #[test]
    fn the_shortest_and_the_longest_find_a_bucket() {
        let mut durations = Durations::default();
        [0, SMALLEST_NS << OCTAVES, u64::MAX].into_iter().for_each(|ns| durations.add(ns));
        assert_eq!(durations.count(), 3);
    }

    #[test]
    fn a_stage_started_anew_goes_on_counting_in_the_same_run_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.status");
        let mut first = StatusFile::open(&path, 7).unwrap();
        first.status.sent = 12;
        first.status.count("sphere", 3);
        first.write();
        let second = StatusFile::open(&path, 7).unwrap();
        assert_eq!(second.status.sent, 12);
        assert_eq!(used(&second.status.counters).collect::<Vec<_>>(), [("sphere", 3)]);
        assert_eq!(StatusFile::open(&path, 8).unwrap().status.sent, 0);
    }

    #[test]
    fn a_stage_without_a_run_begins_although_its_file_tells_of_another_without_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.status");
        let mut first = StatusFile::open(&path, NO_RUN).unwrap();
        first.status.sent = 3;
        first.write();
        let mut second = StatusFile::open(&path, NO_RUN).unwrap();
        second.reload();
        assert_eq!(second.status.sent, 0);
    }

    #[test]
    fn a_file_of_garbage_is_no_record() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.status");
        std::fs::write(&path, vec![0xa5; 40_000]).unwrap();
        assert!(Status::read(&path).is_none());
    }
}
