//! What is to be seen now: the newest frame and what is told around it, for any number of threads that show it to browsers.

use crate::frame::Frame;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// No more browsers than this are shown frames at the same time.
const MAX_BROWSERS: usize = 12;
/// A browser that has not asked for so long has left.
const LEFT: Duration = Duration::from_secs(3);
/// No more wishes of browsers than this wait.
const MAX_COMMANDS: usize = 32;

/// What is told around the frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct About {
    /// What is shown: the name of a pipeline, or of a recording's file.
    pub title: String,
    /// The names of two variants that are compared; else none.
    pub variants: Vec<String>,
    /// Why there is nothing to be seen, or what one should know of what is.
    pub notice: Option<String>,
    /// The pipelines that run, where one may be chosen.
    pub pipelines: Vec<String>,
    /// The topics with depth images, where one may be chosen.
    pub depth_topics: Vec<String>,
    /// The one whose images are shown.
    pub depth_topic: Option<String>,
    /// The stages and what joins them: `wiring` as planned, with `activity` as measured.
    pub graph: Json,
    /// Whether the run that is shown is paused; none of a recording.
    pub run: Option<Run>,
}

/// Whether the sources of a run stand still.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Run {
    /// Whether any can.
    pub can_pause: bool,
    /// Those that cannot, and go on.
    pub live: Vec<String>,
    /// Whether the others do.
    pub paused: bool,
}

/// How a recording is played.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Player {
    /// Where it is, in seconds from its beginning.
    pub at_s: f64,
    /// How long it is.
    pub length_s: f64,
    /// Whether it goes on by itself.
    pub plays: bool,
    /// How many seconds pass in one.
    pub speed: f64,
}

/// A wish of a browser. Of a run none changes more than whether its recorded or simulated sources stand still.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// Show another pipeline.
    Pipeline {
        /// Its name.
        name: String,
    },
    /// Show another camera's images.
    DepthTopic {
        /// The topic.
        name: String,
    },
    /// Let the recording, or the run, go on.
    Play,
    /// Let it stand still.
    Pause,
    /// Show the next frame, or the one before.
    Step {
        /// So many frames on; back, where it is negative. A run makes one more, and goes back to none.
        by: i32,
    },
    /// Go somewhere else in the recording.
    Seek {
        /// Where to, in seconds from its beginning.
        at_s: f64,
    },
    /// Play it faster or slower.
    Speed {
        /// How many seconds pass in one.
        factor: f64,
    },
}

/// What is to be seen now.
#[derive(Default)]
pub struct Display {
    state: Mutex<State>,
    changed: Condvar,
    wished: Condvar,
}

#[derive(Default)]
struct State {
    frame: Option<Arc<Frame>>,
    /// How many frames there were.
    frames: u64,
    about: Arc<About>,
    player: Option<Player>,
    /// How often something else was told.
    told: u64,
    /// When each browser asked last.
    browsers: BTreeMap<String, Instant>,
    commands: VecDeque<Command>,
}

/// What a browser has not seen yet.
pub(crate) struct Update {
    pub(crate) frame: Option<Arc<Frame>>,
    pub(crate) frames: u64,
    pub(crate) about: Option<Arc<About>>,
    pub(crate) player: Option<Player>,
    pub(crate) told: u64,
}

/// Why a browser is shown nothing: there are enough of them.
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

    /// Changes what is told around the frames.
    pub fn tell(&self, change: impl FnOnce(&mut About)) {
        let mut state = self.state();
        let mut about = (*state.about).clone();
        change(&mut about);
        if about != *state.about {
            state.about = Arc::new(about);
            state.told += 1;
            drop(state);
            self.changed.notify_all();
        }
    }

    /// Tells how a recording is played; where it is goes with the frames.
    pub fn tell_player(&self, player: Player) {
        let mut state = self.state();
        let same_way = |known: &Player| known.plays == player.plays && known.speed == player.speed;
        if !state.player.as_ref().is_some_and(same_way) {
            state.told += 1;
        }
        state.player = Some(player);
        drop(state);
        self.changed.notify_all();
    }

    /// Whether somebody looks. Frames that nobody sees need not be brought here.
    pub fn is_watched(&self) -> bool {
        self.state().browsers.values().any(|asked| asked.elapsed() < LEFT)
    }

    /// The oldest wish, waited for no longer than this.
    pub fn next_command(&self, patience: Duration) -> Option<Command> {
        let state = self.state();
        let waited = self.wished.wait_timeout_while(state, patience, |state| state.commands.is_empty());
        waited.unwrap_or_else(PoisonError::into_inner).0.commands.pop_front()
    }

    /// Takes a wish; one more than there is room for takes the place of the oldest.
    pub(crate) fn wish(&self, command: Command) {
        let mut state = self.state();
        if state.commands.len() == MAX_COMMANDS {
            state.commands.pop_front();
        }
        state.commands.push_back(command);
        drop(state);
        self.wished.notify_all();
    }

    /// What a browser has not seen that knows the first `frames` frames and `told` things; waits for it no longer than
    /// `patience`.
    pub(crate) fn look(&self, browser: &str, frames: u64, told: u64, patience: Duration) -> Result<Update, TooMany> {
        let mut state = self.state();
        state.browsers.retain(|_, asked| asked.elapsed() < LEFT);
        if !state.browsers.contains_key(browser) && state.browsers.len() >= MAX_BROWSERS {
            return Err(TooMany { limit: MAX_BROWSERS });
        }
        state.browsers.insert(browser.to_owned(), Instant::now());
        let has_nothing_new = |state: &mut State| state.frames == frames && state.told == told;
        let waited = self.changed.wait_timeout_while(state, patience, has_nothing_new);
        let state = waited.unwrap_or_else(PoisonError::into_inner).0;
        Ok(Update {
            frame: state.frame.clone().filter(|_| state.frames != frames),
            frames: state.frames,
            about: Some(Arc::clone(&state.about)).filter(|_| state.told != told),
            player: state.player,
            told: state.told,
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
    fn who_asks_is_given_the_newest_frame_once() {
        let display = Display::default();
        assert!(!display.is_watched());
        [1, 2, 3].into_iter().for_each(|sequence| display.show(frame(sequence)));
        let look = display.look("a", 0, 0, LONG).unwrap();
        assert_eq!((look.frame.unwrap().header.sequence, look.frames), (3, 3));
        assert!(look.about.is_none() && display.is_watched());
        assert!(display.look("a", look.frames, look.told, NOT_AT_ALL).unwrap().frame.is_none());
        display.tell(|about| about.title = "tabletop".to_owned());
        display.tell(|about| about.title = "tabletop".to_owned());
        let look = display.look("a", look.frames, look.told, LONG).unwrap();
        assert_eq!((look.about.unwrap().title.as_str(), look.told), ("tabletop", 1));
    }

    #[test]
    fn who_waits_is_woken_by_a_frame() {
        let display = Arc::new(Display::default());
        let waiting = Arc::clone(&display);
        let waits = std::thread::spawn(move || waiting.look("a", 0, 0, LONG).unwrap().frames);
        display.show(frame(1));
        assert_eq!(waits.join().unwrap(), 1);
    }

    #[test]
    fn there_are_only_so_many_browsers() {
        let display = Display::default();
        for number in 0..MAX_BROWSERS {
            assert!(display.look(&number.to_string(), 0, 0, NOT_AT_ALL).is_ok());
        }
        assert_eq!(display.look("one more", 0, 0, NOT_AT_ALL).err(), Some(TooMany { limit: MAX_BROWSERS }));
        assert!(display.look("3", 0, 0, NOT_AT_ALL).is_ok(), "who is there already stays");
    }

    #[test]
    fn wishes_are_read_and_kept_in_bounds() {
        let wish = |text: &str| serde_json::from_str::<Command>(text);
        assert_eq!(wish(r#"{"do":"step","by":-1}"#).unwrap(), Command::Step { by: -1 });
        assert_eq!(wish(r#"{"do":"play"}"#).unwrap(), Command::Play);
        assert!(wish(r#"{"do":"stop_the_robot"}"#).is_err() && wish(r#"{"do":"seek","at_s":"x"}"#).is_err());
        let display = Display::default();
        (0..100).for_each(|by| display.wish(Command::Step { by }));
        let first = display.next_command(NOT_AT_ALL);
        assert_eq!(first, Some(Command::Step { by: 100 - MAX_COMMANDS as i32 }));
    }
}
