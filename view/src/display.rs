//! The state that the page shows: the newest frame and information about it, shared by the threads that serve browsers.

use crate::frame::Frame;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Maximum number of browsers that are served at the same time.
const MAX_BROWSERS: usize = 12;
/// A browser that has not asked for this time has left.
const LEFT: Duration = Duration::from_secs(3);
/// Maximum number of commands that wait.
const MAX_COMMANDS: usize = 32;

/// Information about the frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct About {
    /// The name of the pipeline, or of the recording's file.
    pub title: String,
    /// The names of the two variants that are compared, or none.
    pub variants: Vec<String>,
    /// Why there is nothing to see, or a remark about what is shown.
    pub notice: Option<String>,
    /// The running pipelines to choose from, if any.
    pub pipelines: Vec<String>,
    /// The topics with depth images to choose from, if any.
    pub depth_topics: Vec<String>,
    /// The topic whose images are shown.
    pub depth_topic: Option<String>,
    /// The stages and their connections: `wiring` as planned, with `activity` as measured.
    pub graph: Json,
    /// The pause state of the run; `None` for a recording.
    pub run: Option<Run>,
}

/// Whether the sources of a run are paused.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Run {
    /// Whether any source can be paused.
    pub can_pause: bool,
    /// The sources that cannot be paused.
    pub live: Vec<String>,
    /// Whether the others are paused.
    pub paused: bool,
}

/// The state of a recording's playback.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Player {
    /// The position, in seconds from the beginning.
    pub at_s: f64,
    /// The length in seconds.
    pub length_s: f64,
    /// Whether it plays.
    pub plays: bool,
    /// The speed; 1 is real time.
    pub speed: f64,
}

/// A command of a browser. In a run, commands only pause recorded or simulated sources and let them go on.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// Show another pipeline.
    Pipeline {
        /// Its name.
        name: String,
    },
    /// Show the images of another topic.
    DepthTopic {
        /// The topic.
        name: String,
    },
    /// Continue the recording or the run.
    Play,
    /// Pause the recording or the run.
    Pause,
    /// Show the next or the previous frame.
    Step {
        /// The number of frames; negative: back. A run makes one more frame, and cannot go back.
        by: i32,
    },
    /// Go to another position of the recording.
    Seek {
        /// The position, in seconds from the beginning.
        at_s: f64,
    },
    /// Change the speed of the recording.
    Speed {
        /// The speed; 1 is real time.
        factor: f64,
    },
}

/// The state that the page shows.
#[derive(Default)]
pub struct Display {
    state: Mutex<State>,
    changed: Condvar,
    command_queued: Condvar,
}

#[derive(Default)]
struct State {
    frame: Option<Arc<Frame>>,
    /// Number of frames so far.
    frames: u64,
    about: Arc<About>,
    player: Option<Player>,
    /// Number of changes of everything but the frames.
    changes: u64,
    /// When each browser last asked.
    browsers: BTreeMap<String, Instant>,
    commands: VecDeque<Command>,
}

/// The news for a browser.
pub(crate) struct Update {
    pub(crate) frame: Option<Arc<Frame>>,
    pub(crate) frames: u64,
    pub(crate) about: Option<Arc<About>>,
    pub(crate) player: Option<Player>,
    pub(crate) changes: u64,
}

/// Too many browsers are connected.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct TooMany {
    pub(crate) limit: usize,
}

impl Display {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows a frame in place of the one before.
    pub fn show(&self, frame: Frame) {
        let mut state = self.state();
        state.frame = Some(Arc::new(frame));
        state.frames += 1;
        drop(state);
        self.changed.notify_all();
    }

    /// Changes the information about the frames.
    pub fn change_about(&self, change: impl FnOnce(&mut About)) {
        let mut state = self.state();
        let mut about = (*state.about).clone();
        change(&mut about);
        if about != *state.about {
            state.about = Arc::new(about);
            state.changes += 1;
            drop(state);
            self.changed.notify_all();
        }
    }

    /// Updates the playback state; a new position alone is sent with the next frame.
    pub fn publish_player(&self, player: Player) {
        let mut state = self.state();
        let is_unchanged = |known: &Player| known.plays == player.plays && known.speed == player.speed;
        if !state.player.as_ref().is_some_and(is_unchanged) {
            state.changes += 1;
        }
        state.player = Some(player);
        drop(state);
        self.changed.notify_all();
    }

    /// Whether any browser is connected. Otherwise frames need not be fetched.
    pub fn is_watched(&self) -> bool {
        self.state().browsers.values().any(|asked| asked.elapsed() < LEFT)
    }

    /// Waits for a command for at most `patience`; returns the oldest one.
    pub fn next_command(&self, patience: Duration) -> Option<Command> {
        let state = self.state();
        let waited = self.command_queued.wait_timeout_while(state, patience, |state| state.commands.is_empty());
        waited.unwrap_or_else(PoisonError::into_inner).0.commands.pop_front()
    }

    /// Queues a command; a full queue drops the oldest.
    pub(crate) fn queue_command(&self, command: Command) {
        let mut state = self.state();
        if state.commands.len() == MAX_COMMANDS {
            state.commands.pop_front();
        }
        state.commands.push_back(command);
        drop(state);
        self.command_queued.notify_all();
    }

    /// Returns the news for a browser that has seen `frames` frames and `changes` changes of the rest; waits for news for at most
    /// `patience`.
    pub(crate) fn wait_for_update(
        &self,
        browser: &str,
        frames: u64,
        changes: u64,
        patience: Duration,
    ) -> Result<Update, TooMany> {
        let mut state = self.state();
        state.browsers.retain(|_, asked| asked.elapsed() < LEFT);
        if !state.browsers.contains_key(browser) && state.browsers.len() >= MAX_BROWSERS {
            return Err(TooMany { limit: MAX_BROWSERS });
        }
        state.browsers.insert(browser.to_owned(), Instant::now());
        let has_nothing_new = |state: &mut State| state.frames == frames && state.changes == changes;
        let waited = self.changed.wait_timeout_while(state, patience, has_nothing_new);
        let state = waited.unwrap_or_else(PoisonError::into_inner).0;
        Ok(Update {
            frame: state.frame.clone().filter(|_| state.frames != frames),
            frames: state.frames,
            about: Some(Arc::clone(&state.about)).filter(|_| state.changes != changes),
            player: state.player,
            changes: state.changes,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Header;

    const NOT_AT_ALL: Duration = Duration::ZERO;
    const LONG: Duration = Duration::from_secs(60);

    fn frame(sequence: u64) -> Frame {
        Frame { header: Header { sequence, ..Header::default() }, ..Frame::default() }
    }

    #[test]
    fn a_browser_gets_the_newest_frame_once() {
        let display = Display::default();
        assert!(!display.is_watched());
        [1, 2, 3].into_iter().for_each(|sequence| display.show(frame(sequence)));
        let update = display.wait_for_update("a", 0, 0, LONG).unwrap();
        assert_eq!((update.frame.unwrap().header.sequence, update.frames), (3, 3));
        assert!(update.about.is_none() && display.is_watched());
        assert!(display.wait_for_update("a", update.frames, update.changes, NOT_AT_ALL).unwrap().frame.is_none());
        display.change_about(|about| about.title = "tabletop".to_owned());
        display.change_about(|about| about.title = "tabletop".to_owned());
        let update = display.wait_for_update("a", update.frames, update.changes, LONG).unwrap();
        assert_eq!((update.about.unwrap().title.as_str(), update.changes), ("tabletop", 1));
    }

    #[test]
    fn a_waiting_browser_is_woken_by_a_frame() {
        let display = Arc::new(Display::default());
        let waiting = Arc::clone(&display);
        let frames = std::thread::spawn(move || waiting.wait_for_update("a", 0, 0, LONG).unwrap().frames);
        display.show(frame(1));
        assert_eq!(frames.join().unwrap(), 1);
    }

    #[test]
    fn the_number_of_browsers_is_limited() {
        let display = Display::default();
        for number in 0..MAX_BROWSERS {
            assert!(display.wait_for_update(&number.to_string(), 0, 0, NOT_AT_ALL).is_ok());
        }
        assert_eq!(display.wait_for_update("one more", 0, 0, NOT_AT_ALL).err(), Some(TooMany { limit: MAX_BROWSERS }));
        assert!(display.wait_for_update("3", 0, 0, NOT_AT_ALL).is_ok(), "who is there already stays");
    }

    #[test]
    fn commands_are_parsed_and_kept_in_bounds() {
        let parsed = |text: &str| serde_json::from_str::<Command>(text);
        assert_eq!(parsed(r#"{"do":"step","by":-1}"#).unwrap(), Command::Step { by: -1 });
        assert_eq!(parsed(r#"{"do":"play"}"#).unwrap(), Command::Play);
        assert!(parsed(r#"{"do":"stop_the_robot"}"#).is_err() && parsed(r#"{"do":"seek","at_s":"x"}"#).is_err());
        let display = Display::default();
        (0..100).for_each(|by| display.queue_command(Command::Step { by }));
        let first = display.next_command(NOT_AT_ALL);
        assert_eq!(first, Some(Command::Step { by: 100 - MAX_COMMANDS as i32 }));
    }
}
