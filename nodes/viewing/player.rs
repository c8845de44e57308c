//! Plays a recording on the page, as its time line says: on, paused, frame by frame, from anywhere, faster or slower.
//!
//! Where the recording has depth images, each is a frame, with what was recorded of the same stamp and number; else each list is.
//! A second recording of the same frames is shown with it: what both have found, and what only one has.

use crate::recording::files::Files;
use crate::sources::WrittenIn;
use crate::sources::mcap_source::{Config, Replay, Replayed, has_own};
use anyhow::{Context as _, Error, Result};
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_lab::score::pairing::{Difference, pair_up};
use conicflow_messages::{Header, Hinted, Item, Object, Track};
use conicflow_view::{Command, Compared, Depth, Display, Frame, List, Pair, Player as Told};
use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often is looked whether the program is to end, and whether somebody looks.
const END_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// A frame that is later than this does not make those behind it hurry.
const LATE: Duration = Duration::from_millis(250);
/// So far back is looked for the frame before, at first.
const BACK_NS: u64 = 100_000_000;
/// The slowest and the fastest that a recording is played.
const SPEEDS: (f64, f64) = (0.01, 100.0);
/// Lists of a frame are looked for among so many that come after it, at most.
const MOST_LISTS: usize = 64;

/// A recording and where it is.
pub struct Player {
    display: Arc<Display>,
    /// What sets the pace: the depth images, or where there are none, the lists.
    frames: Replay,
    /// The lists beside the depth images.
    lists: Option<Lists>,
    /// Those of a second recording of the same frames.
    other: Option<Lists>,
    begin_ns: u64,
    end_ns: u64,
    /// When the frame that is shown was written.
    at_ns: u64,
    next: Option<Replayed>,
    /// Whether what comes next could not be read.
    is_cut_off: bool,
    /// What is to be said of the recording while it can be read.
    notice: Option<String>,
    plays: bool,
    speed: f64,
    /// So many steps are still to be made; back, where it is negative.
    steps: i32,
    /// When a frame of which time was, or is to be, shown.
    anchor: Option<(Instant, u64)>,
}

fn built_in<T: Item>() -> Result<&'static ItemType> {
    BUILT_IN.iter().find(|item| item.name() == T::NAME).with_context(|| format!("no item type `{}`", T::NAME))
}

/// What was found, list by list.
struct Lists {
    replay: Replay,
    /// What tells whether a list is of a frame.
    key: fn(&Header) -> Key,
    /// Lists that were read, for this frame and those that follow.
    read: VecDeque<Replayed>,
}

/// Stamp, start of the source and number of a frame.
type Key = (u64, u64, u64);

/// Within a recording.
fn key(header: &Header) -> Key {
    (header.stamp_ns, header.epoch, header.sequence)
}

/// From recording to recording: the same frame was sent by another start of its source.
fn key_elsewhere(header: &Header) -> Key {
    (header.stamp_ns, 0, header.sequence)
}

impl Lists {
    /// The tracks of a recording, or where there are none, the objects; none where there are neither.
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

    /// What was found in a frame, where that was recorded; lists of frames before it are passed over.
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
    /// Opens a recording, with the depth images of `topic` where it has several, and shows its first frame; with it what was
    /// found in the same frames in the recording `against`.
    ///
    /// # Errors
    /// There is none, or it has neither depth images nor objects nor tracks, or `against` has neither of the latter.
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
        display.tell(|about| {
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

    /// Plays until this program is told to end. A place that cannot be read is told on the page, which pauses there.
    pub fn play(&mut self, told: &AtomicBool) {
        while !told.load(Ordering::Relaxed) {
            if let Err(error) = self.play_on() {
                self.stop_at(&error);
            }
        }
    }

    /// Pauses where the recording cannot be read, which is told until it can be.
    fn stop_at(&mut self, error: &Error) {
        tracing::warn!("{error:#}");
        self.display.tell(|about| about.notice = Some(format!("{error:#}")));
        self.plays = false;
        self.tell();
    }

    /// Does what comes next: what somebody wants, or a step, or the next frame, or a while of nothing.
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
            self.tell();
        }
        Ok(())
    }

    /// When the next frame is to be shown; never while the recording is paused, or nobody looks.
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
        self.tell();
        Ok(())
    }

    /// Shows the next frame; false where there is none. One that could not be read is looked for once more.
    fn advance(&mut self) -> Result<bool> {
        if self.is_cut_off {
            self.seek(self.at_ns.saturating_add(1))?;
        }
        let Some(frame) = self.next.take() else { return Ok(false) };
        // It is shown also where the one behind it cannot be read, which is read also where this one cannot be shown.
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

    /// Makes one of the steps that are still to be made, so that another command waits for one at most. They stop at the ends of
    /// the recording.
    fn step(&mut self) -> Result<()> {
        let left = std::mem::take(&mut self.steps);
        let is_there = if left > 0 { self.advance()? } else { self.go_back()? };
        if is_there {
            self.steps = left - left.signum();
        }
        Ok(())
    }

    /// Shows the first frame that was written at `at_ns` or later, or the last of all.
    fn go_to(&mut self, at_ns: u64) -> Result<()> {
        self.seek(at_ns)?;
        if !self.advance()? {
            self.at_ns = at_ns.saturating_add(1);
            self.go_back()?;
        }
        Ok(())
    }

    /// Shows the frame before the one that is shown: looks for it ever farther back. False where there is none; the first is
    /// shown then.
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
        // Where it is goes with the frame.
        self.tell();
        self.display.tell(|about| about.notice.clone_from(&self.notice));
        self.display.show(frame);
        Ok(())
    }

    fn tell(&self) {
        let seconds = |ns: u64| ns.saturating_sub(self.begin_ns) as f64 * 1e-9;
        let (at_s, length_s) = (seconds(self.at_ns), seconds(self.end_ns));
        self.display.tell_player(Told { at_s, length_s, plays: self.plays, speed: self.speed });
    }
}

/// How a file is called.
fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn no_lists(path: &Path) -> Error {
    let what = format!("`{}` has neither objects nor tracks to compare with", path.display());
    Hinted::new(what, "`conicflow compare --record FOLDER` writes two recordings that can be compared").into()
}

/// What another recording has of the same frame, matched with what this one has.
fn compare(own: &List, other: List) -> Compared {
    let (a, b) = (own.objects(), other.objects());
    let pair = |(first, second): (usize, usize)| {
        let Difference { position_m, radius_m, .. } = Difference::of(&a[first], &b[second]);
        Pair { own: first, other: second, position_m, radius_m }
    };
    let pairs = pair_up(&a, &b).both.into_iter().map(pair).collect();
    Compared { list: other, pairs }
}

/// What a message of a list says was found.
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

    /// A recording of these frames, without depth images.
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
    fn steps_end_where_the_recording_begins_and_ends() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        record(&path, 0..9);
        let mut player = Player::open(&path, None, None, Arc::default()).unwrap();
        // At its beginning no step back is lost: the next one on shows the second frame.
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
    fn what_comes_before_a_place_that_cannot_be_read_is_shown_and_what_comes_behind_it_once_that_can_be_read() {
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
            display.tell(|about| noticed.clone_from(&about.notice));
            noticed
        };
        fs::rename(&second, &away).unwrap();
        assert!(player.advance().unwrap());
        // Again and again, and not from the beginning.
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
