//! Plays a recording on the page, under the control of its time line: play, pause, single steps, seek, speed.
//!
//! Where the recording has depth images, each of them is a frame, with the list that has the same stamp and number; else each
//! list is one. A second recording of the same frames can be shown with it: what both have found, and what only one of them has.

use crate::recording::files::Files;
use crate::sources::WrittenIn;
use crate::sources::mcap_source::{Config, Replay, Replayed, has_own};
use anyhow::{Context as _, Error, Result};
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_lab::score::pairing::{Difference, pair_up};
use conicflow_messages::{Header, Hinted, Item, Object, Track};
use conicflow_view::{Command, Compared, Depth, Display, Frame, List, Pair, Player as PlayerState};
use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Period of the checks whether the program is to end, and whether a browser is connected.
const END_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// A frame that is later than this does not make the following ones hurry: the clock starts anew.
const LATE: Duration = Duration::from_millis(250);
/// First distance in time in the search for the previous frame.
const BACK_NS: u64 = 100_000_000;
/// The slowest and the fastest playback speed.
const SPEEDS: (f64, f64) = (0.01, 100.0);
/// Largest number of lists that are read ahead in search of the list of a frame.
const MOST_LISTS: usize = 64;

/// A recording and the playback position in it.
pub struct Player {
    display: Arc<Display>,
    /// Sets the pace: the depth images, or where there are none, the lists.
    frames: Replay,
    /// The lists beside the depth images.
    lists: Option<Lists>,
    /// The lists of a second recording of the same frames.
    other: Option<Lists>,
    begin_ns: u64,
    end_ns: u64,
    /// When the frame on the page was written.
    at_ns: u64,
    next: Option<Replayed>,
    /// Whether the next message could not be read.
    is_cut_off: bool,
    /// The notice on the page while the recording can be read.
    notice: Option<String>,
    plays: bool,
    speed: f64,
    /// Number of steps that are still to be made; negative: backwards.
    steps: i32,
    /// The instant at which a frame was shown, or is to be shown, and the time at which that frame was written.
    anchor: Option<(Instant, u64)>,
}

fn built_in<T: Item>() -> Result<&'static ItemType> {
    BUILT_IN.iter().find(|item| item.name() == T::NAME).with_context(|| format!("no item type `{}`", T::NAME))
}

/// The lists of found objects or tracks.
struct Lists {
    replay: Replay,
    /// The key by which a list is matched with a frame.
    key: fn(&Header) -> Key,
    /// Lists that were read ahead, for this frame and later ones.
    read: VecDeque<Replayed>,
}

/// Stamp, epoch of the source, and sequence number of a frame.
type Key = (u64, u64, u64);

/// The key within one recording.
fn key(header: &Header) -> Key {
    (header.stamp_ns, header.epoch, header.sequence)
}

/// The key across recordings: each run of the source has its own epoch.
fn key_elsewhere(header: &Header) -> Key {
    (header.stamp_ns, 0, header.sequence)
}

impl Lists {
    /// Opens the tracks of a recording, or if it has none, its objects; `None` if it has neither.
    fn open(path: &Path, key: fn(&Header) -> Key) -> Result<Option<Self>> {
        let channels = Files::find(path)?.survey()?;
        let kind = [built_in::<Track>()?, built_in::<Object>()?].into_iter().find(|item| has_own(&channels, item));
        let config = Config { path: Some(path.to_owned()), ..Config::default() };
        let open = |item: &ItemType| Replay::open(&config, Path::new(""), item);
        Ok(kind.map(open).transpose()?.map(|replay| Self { replay, key, read: VecDeque::new() }))
    }

    fn seek(&mut self, from_ns: u64) {
        self.read.clear();
        self.replay.seek(from_ns);
    }

    /// Returns the list of a frame, if it was recorded; skips the lists of earlier frames.
    fn of(&mut self, frame: &Header) -> Result<Option<Replayed>> {
        let key = |replayed: &Replayed| (self.key)(&replayed.header);
        let wanted = (self.key)(frame);
        while self.read.back().is_none_or(|last| key(last) < wanted) && self.read.len() < MOST_LISTS {
            match self.replay.next_message()? {
                Some(list) => self.read.push_back(list),
                None => break,
            }
            while self.read.front().is_some_and(|first| key(first) < wanted) {
                self.read.pop_front();
            }
        }
        while self.read.front().is_some_and(|first| key(first) < wanted) {
            self.read.pop_front();
        }
        let found = self.read.front().is_some_and(|first| key(first) == wanted);
        Ok(if found { self.read.pop_front() } else { None })
    }
}

impl Player {
    /// Opens a recording, with the depth images of `topic` where it has several, and shows its first frame, together with the
    /// list of the same frame in the recording `against`.
    ///
    /// # Errors
    /// There is no recording, it has neither depth images nor objects nor tracks, or `against` has neither objects nor tracks.
    pub fn open(path: &Path, topic: Option<&str>, against: Option<&Path>, display: Arc<Display>) -> Result<Self> {
        let (file, topic_name, written_in) = (Some(path.to_owned()), topic.map(str::to_owned), WrittenIn::CommandLine);
        let config = Config { path: file, topic: topic_name, written_in, ..Config::default() };
        let depths = Replay::open(&config, Path::new(""), built_in::<u16>()?);
        let (frames, lists, notice) = match (depths, Lists::open(path, key)) {
            (Ok(depths), Ok(Some(lists))) => (depths, Some(lists), None),
            (Ok(depths), Ok(None)) => {
                let notice = "the recording has depth images alone; `conicflow detect` finds what is in them";
                (depths, None, Some(notice.to_owned()))
            }
            (Ok(depths), Err(error)) => (depths, None, Some(format!("{error:#}"))),
            (Err(error), Ok(Some(lists))) if topic.is_none() => {
                (lists.replay, None, Some(format!("no depth images: {error:#}")))
            }
            (Err(error), _) => return Err(error),
        };
        let other = against.map(|against| Lists::open(against, key_elsewhere)?.ok_or_else(|| no_lists(against)));
        let (begin_ns, end_ns) = Files::find(path)?.span_ns()?.unwrap_or_default();
        let names: Vec<_> = [Some(path), against].into_iter().flatten().map(name_of).collect();
        display.change_about(|about| {
            about.title = names.join(" | ");
            about.notice.clone_from(&notice);
            about.variants = if against.is_some() { names } else { Vec::new() };
        });
        let mut player = Self {
            display,
            frames,
            lists,
            other: other.transpose()?,
            begin_ns,
            end_ns,
            at_ns: begin_ns,
            next: None,
            is_cut_off: false,
            notice,
            plays: true,
            speed: 1.0,
            steps: 0,
            anchor: None,
        };
        player.read_next()?;
        player.advance()?;
        Ok(player)
    }

    /// Plays until `stop` is set. Where a frame cannot be read, the page shows the error and playback pauses.
    pub fn play(&mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            if let Err(error) = self.play_on() {
                self.stop_at(&error);
            }
        }
    }

    /// Pauses where the recording cannot be read; the error stays on the page until it can be read again.
    fn stop_at(&mut self, error: &Error) {
        tracing::warn!("{error:#}");
        self.display.change_about(|about| about.notice = Some(format!("{error:#}")));
        self.plays = false;
        self.publish_state();
    }

    /// Obeys the next command, makes a step, shows the next frame if it is due, or waits for a while.
    fn play_on(&mut self) -> Result<()> {
        let due = self.due();
        let left =
            due.map_or(END_CHECK_PERIOD, |due| due.saturating_duration_since(Instant::now()).min(END_CHECK_PERIOD));
        if let Some(command) = self.display.next_command(if self.steps == 0 { left } else { Duration::ZERO }) {
            self.obey(&command)?;
        } else if self.steps != 0 {
            self.step()?;
        } else if due.is_some_and(|due| due <= Instant::now()) && !self.advance()? {
            self.plays = false;
            self.publish_state();
        }
        Ok(())
    }

    /// Returns when the next frame is due; `None` while playback is paused or no browser is connected.
    fn due(&mut self) -> Option<Instant> {
        if !self.plays || !self.display.is_watched() {
            self.anchor = None;
            return None;
        }
        let now = Instant::now();
        let next_ns = self.next.as_ref().map_or(self.at_ns, |next| next.written_ns);
        let (start, start_ns) = *self.anchor.get_or_insert((now, self.at_ns));
        let after = Duration::from_nanos(next_ns.saturating_sub(start_ns)).div_f64(self.speed);
        let due = start.checked_add(after).unwrap_or(now);
        if due + LATE < now {
            self.anchor = Some((now, next_ns));
        }
        Some(due)
    }

    fn obey(&mut self, command: &Command) -> Result<()> {
        self.anchor = None;
        let steps = std::mem::take(&mut self.steps);
        match command {
            Command::Play => {
                if self.next.is_none() && !self.is_cut_off {
                    self.go_to(self.begin_ns)?;
                }
                self.plays = true;
            }
            Command::Pause => self.plays = false,
            Command::Step { by } => {
                self.plays = false;
                self.steps = steps.saturating_add(*by);
            }
            Command::Seek { at_s } => {
                let length_s = self.end_ns.saturating_sub(self.begin_ns) as f64 * 1e-9;
                let after_ns = (at_s.clamp(0.0, length_s) * 1e9) as u64;
                self.go_to((self.begin_ns + after_ns).min(self.end_ns))?;
            }
            Command::Speed { factor } => self.speed = factor.clamp(SPEEDS.0, SPEEDS.1),
            Command::Pipeline { .. } | Command::DepthTopic { .. } => {}
        }
        self.publish_state();
        Ok(())
    }

    /// Shows the next frame; false at the end of the recording. A frame that could not be read is tried once more.
    fn advance(&mut self) -> Result<bool> {
        if self.is_cut_off {
            self.seek(self.at_ns.saturating_add(1))?;
        }
        let Some(frame) = self.next.take() else { return Ok(false) };
        // This frame is shown even if the next one cannot be read, and the next one is read even if this one cannot be shown.
        let shown = self.show(frame);
        self.read_next()?;
        shown.map(|()| true)
    }

    fn read_next(&mut self) -> Result<()> {
        (self.next, self.is_cut_off) = (None, true);
        self.next = self.frames.next_message()?;
        self.is_cut_off = false;
        Ok(())
    }

    /// Makes one of the pending steps, so that another command waits for one step at most. The steps stop at the ends of the
    /// recording.
    fn step(&mut self) -> Result<()> {
        let left = std::mem::take(&mut self.steps);
        let is_there = if left > 0 { self.advance()? } else { self.go_back()? };
        if is_there {
            self.steps = left - left.signum();
        }
        Ok(())
    }

    /// Shows the first frame that was written at `at_ns` or later, or else the last one.
    fn go_to(&mut self, at_ns: u64) -> Result<()> {
        self.seek(at_ns)?;
        if !self.advance()? {
            self.at_ns = at_ns.saturating_add(1);
            self.go_back()?;
        }
        Ok(())
    }

    /// Shows the previous frame, which is searched for farther and farther back. If there is none, shows the first frame and
    /// returns false.
    fn go_back(&mut self) -> Result<bool> {
        let (at_ns, mut back_ns) = (self.at_ns, BACK_NS);
        loop {
            let from_ns = at_ns.saturating_sub(back_ns).max(self.begin_ns);
            self.seek(from_ns)?;
            let mut before = None;
            while self.next.as_ref().is_some_and(|next| next.written_ns < at_ns) {
                before = self.next.take();
                self.read_next()?;
            }
            if let Some(before) = before {
                self.show(before)?;
                return Ok(true);
            }
            if from_ns == self.begin_ns {
                self.advance()?;
                return Ok(false);
            }
            back_ns = back_ns.saturating_mul(4);
        }
    }

    fn seek(&mut self, from_ns: u64) -> Result<()> {
        self.frames.seek(from_ns);
        self.lists.iter_mut().chain(&mut self.other).for_each(|lists| lists.seek(from_ns));
        self.read_next()
    }

    fn show(&mut self, shown: Replayed) -> Result<()> {
        self.at_ns = shown.written_ns;
        let mut frame = if self.frames.item().is_image() {
            let pixels = shown.items_as();
            let (mut header, mut found) = (shown.header, List::None);
            if let Some(lists) = &mut self.lists
                && let Some(replayed) = lists.of(&shown.header)?
            {
                (header, found) = (replayed.header, list(lists.replay.item(), &replayed));
            }
            let depth = Some(Arc::new(Depth { header: shown.header, pixels }));
            Frame { header, depth, list: found, ..Frame::default() }
        } else {
            Frame { header: shown.header, list: list(self.frames.item(), &shown), ..Frame::default() }
        };
        if let Some(other) = &mut self.other
            && let Some(replayed) = other.of(&shown.header)?
        {
            frame.compared = Some(compare(&frame.list, list(other.replay.item(), &replayed)));
        }
        // The position goes to the page together with the frame.
        self.publish_state();
        self.display.change_about(|about| about.notice.clone_from(&self.notice));
        self.display.show(frame);
        Ok(())
    }

    fn publish_state(&self) {
        let seconds = |ns: u64| ns.saturating_sub(self.begin_ns) as f64 * 1e-9;
        let (at_s, length_s) = (seconds(self.at_ns), seconds(self.end_ns));
        self.display.publish_player(PlayerState { at_s, length_s, plays: self.plays, speed: self.speed });
    }
}

/// The file name of a path.
fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn no_lists(path: &Path) -> Error {
    let what = format!("`{}` has neither objects nor tracks to compare with", path.display());
    Hinted::new(what, "`conicflow compare --record FOLDER` writes two recordings that can be compared").into()
}

/// Matches the list of the second recording with that of the first for the same frame.
fn compare(own: &List, other: List) -> Compared {
    let (a, b) = (own.objects(), other.objects());
    let pair = |(first, second): (usize, usize)| {
        let Difference { position_m, radius_m, .. } = Difference::of(&a[first], &b[second]);
        Pair { own: first, other: second, position_m, radius_m }
    };
    let pairs = pair_up(&a, &b).both.into_iter().map(pair).collect();
    Compared { list: other, pairs }
}

/// Returns the items of a message as a list of tracks or objects.
fn list(item: &ItemType, message: &Replayed) -> List {
    if item.name() == Track::NAME { List::Tracks(message.items_as()) } else { List::Objects(message.items_as()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::recorder::{Limits, Recorder};
    use conicflow_dataflow::AnyMessage;
    use conicflow_messages::Camera;
    use std::fs;
    use std::ops::Range;

    const SPACING_NS: u64 = 30_000_000;

    /// Writes a recording of these frames, without depth images.
    fn record(path: &Path, sequences: Range<u64>) {
        let recorder = Recorder::create(path, Limits::default(), 0, false).unwrap();
        for sequence in sequences {
            let camera = Camera { width: 4, height: 3, fx: 50.0, fy: 50.0, cx: 1.5, cy: 1.0 };
            let stamp_ns = sequence * SPACING_NS;
            let header = Header { epoch: 1, sequence, stamp_ns, depth_scale: 0.001, camera, ..Header::default() };
            let objects = AnyMessage { header: &header, item: built_in::<Object>().unwrap(), bytes: &[] };
            recorder.write("objects", &objects, None).unwrap();
        }
        recorder.finish().unwrap();
    }

    #[test]
    fn steps_stop_at_the_beginning_and_the_end_of_the_recording() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        record(&path, 0..9);
        let mut player = Player::open(&path, None, None, Arc::default()).unwrap();
        // At the beginning no step back is kept for later: the next step forward shows the second frame.
        for (by, frame) in
            [(0, 0), (-1, 0), (1, 1), (3, 4), (-2, 2), (i32::MIN, 0), (-1_000_000, 0), (1, 1), (i32::MAX, 8)]
        {
            player.obey(&Command::Step { by }).unwrap();
            while player.steps != 0 {
                player.step().unwrap();
            }
            assert_eq!(player.at_ns - player.begin_ns, frame * SPACING_NS, "{by}");
        }
    }

    #[test]
    fn frames_before_an_unreadable_place_are_shown_and_those_behind_it_once_it_can_be_read() {
        let folder = tempfile::tempdir().unwrap();
        let (recording, away) = (folder.path().join("run"), folder.path().join("away.mcap"));
        let [first, second] = ["1.mcap", "2.mcap"].map(|name| recording.join(name));
        fs::create_dir(&recording).unwrap();
        record(&first, 0..3);
        record(&second, 3..6);
        let mut player = Player::open(&recording, None, None, Arc::default()).unwrap();
        let (notice, display) = (player.notice.clone(), Arc::clone(&player.display));
        let noticed = || {
            let mut noticed = None;
            display.change_about(|about| noticed.clone_from(&about.notice));
            noticed
        };
        fs::rename(&second, &away).unwrap();
        assert!(player.advance().unwrap());
        // Repeatedly, and without going back to the beginning.
        for _ in 0..3 {
            player.obey(&Command::Play).unwrap();
            let error = player.advance().unwrap_err();
            player.stop_at(&error);
            assert_eq!(player.at_ns - player.begin_ns, 2 * SPACING_NS);
            assert!(noticed().unwrap().contains("is not there any more") && !player.plays);
        }
        fs::rename(&away, &second).unwrap();
        player.obey(&Command::Play).unwrap();
        assert!(player.advance().unwrap());
        assert_eq!((player.at_ns - player.begin_ns, noticed()), (3 * SPACING_NS, notice));
    }
}
