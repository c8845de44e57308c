//! Keys of `conicflow run` at a terminal: space pauses or resumes the run, `.` or the right arrow makes one frame.
//!
//! A separate process reads them. However the launcher ends, even by SIGKILL, that process restores the terminal's modes; and if
//! that process dies, the launcher restores them. At Ctrl-Z the launcher ends it before the run stops, as the terminal belongs to
//! the shell then, and starts another one when the run continues. The modes are left alone if another program has changed them
//! since, such as a shell that waits for a line, or if the run is in the background.

use anyhow::{Context, Result};
use conicflow_dataflow::{PauseRequest, RunningPipeline, lock};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::process::{Pid, Signal, getpgrp, getppid, kill_process, set_parent_process_death_signal};
use rustix::termios::{LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr};
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use signal_hook::iterator::Signals;
use std::io::{IsTerminal, Write, stderr, stdin};
use std::process::{Child, Command};
use std::sync::Mutex;
use std::thread::sleep;
use std::time::Duration;

/// The hidden command by which this program reads keys.
pub const NAME: &str = "keys";
/// Period at which a run in the background checks whether it came to the foreground.
const FOREGROUND_CHECK_PERIOD: Duration = Duration::from_millis(200);
/// Starts the process that reads keys. It has to set the modes of a terminal that a shell has taken back (without SIGTTOU), and
/// has to be ended by the launcher, not stopped by Ctrl-Z.
const START: &str = "trap '' TTOU TSTP; exec \"$@\"";
/// Bytes of the right arrow, in both modes of a terminal.
const RIGHT: [&[u8]; 2] = [b"\x1b[C", b"\x1bOC"];

/// Reads the keys of a run until it is dropped.
pub struct Keys;

impl Keys {
    /// Starts reading the keys for a pipeline, if there is a terminal; the run goes on if that fails.
    pub fn read_for(pipeline: &str) -> Self {
        *lock(&READER) = Reader::start(pipeline);
        Self
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        lock(&READER).take();
    }
}

/// Calls `stop`, which stops the run, and reads no keys meanwhile.
pub fn stop_without(stop: &dyn Fn()) {
    let Some(ended) = lock(&READER).take() else { return stop() };
    let pipeline = ended.pipeline.clone();
    drop(ended);
    stop();
    *lock(&READER) = Reader::start(&pipeline);
}

/// The process that reads the keys of this run; dropping it ends the process and restores the terminal.
struct Reader {
    pipeline: String,
    process: Child,
    /// Modes of the terminal before, if the run is in its foreground.
    before: Option<Termios>,
}

static READER: Mutex<Option<Reader>> = Mutex::new(None);

impl Reader {
    fn start(pipeline: &str) -> Option<Self> {
        if !stdin().is_terminal() {
            return None;
        }
        let before = is_foreground().then(|| tcgetattr(stdin()).ok()).flatten();
        let own = std::process::id().to_string();
        let mut command = Command::new("sh");
        command.args(["-c", START, "sh"]).arg(std::env::current_exe().ok()?).args([NAME, pipeline, &own]);
        Some(Self { pipeline: pipeline.to_owned(), process: command.spawn().ok()?, before })
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        if let Some(process) = Pid::from_raw(self.process.id().cast_signed()) {
            // The process may be stopped, or gone.
            kill_process(process, Signal::TERM).ok();
            kill_process(process, Signal::CONT).ok();
        }
        self.process.wait().ok();
        if let Some(before) = &self.before
            && is_foreground()
        {
            // Nothing else can be done with a terminal that refuses its modes.
            tcsetattr(stdin(), OptionalActions::Now, before).ok();
        }
    }
}

/// Whether this process's job is in the foreground of the terminal.
fn is_foreground() -> bool {
    tcgetpgrp(stdin()).is_ok_and(|group| group == getpgrp())
}

/// A terminal that passes keys on as they are pressed; its modes are restored in the end.
#[derive(Default)]
struct Terminal {
    /// Modes before this process changed them.
    before: Option<Termios>,
    /// Modes as this process has set them.
    taken: Option<Termios>,
}

impl Terminal {
    fn take(&mut self) -> Result<()> {
        if self.taken.is_some() {
            return Ok(());
        }
        let before = match &self.before {
            Some(before) => before,
            None => self.before.insert(tcgetattr(stdin())?),
        };
        let mut by_key = before.clone();
        // Ctrl-C and Ctrl-Z keep their meaning.
        by_key.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
        by_key.special_codes[SpecialCodeIndex::VMIN] = 1;
        by_key.special_codes[SpecialCodeIndex::VTIME] = 0;
        tcsetattr(stdin(), OptionalActions::Now, &by_key)?;
        self.taken = Some(by_key);
        Ok(())
    }

    /// Restores the modes, unless another program has changed them since.
    fn give_back(&mut self) {
        let Some((before, taken)) = self.before.as_ref().zip(self.taken.take()) else { return };
        let modes = |terminal: &Termios| (terminal.input_modes, terminal.output_modes, terminal.local_modes);
        if tcgetattr(stdin()).is_ok_and(|now| modes(&now) == modes(&taken)) {
            tcsetattr(stdin(), OptionalActions::Now, before).ok();
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.give_back();
    }
}

/// Obeys the keys until the launcher, the process `launcher`, has ended or sends a signal.
///
/// # Errors
/// There is no terminal, or signals cannot be received.
pub fn read(pipeline: &str, launcher: i32) -> Result<()> {
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP, SIGQUIT])?;
    let mut terminal = Terminal::default();
    while getppid().is_some_and(|parent| parent.as_raw_nonzero().get() == launcher) {
        // After Ctrl-C the launcher ends the run, and then this process.
        if signals.pending().any(|signal| signal != SIGINT) {
            return Ok(());
        }
        if is_foreground() {
            terminal.take().context("the terminal gives no keys")?;
            let Some(pressed) = next_keys()? else { return Ok(()) };
            requests(&pressed).for_each(|request| obey(pipeline, request));
        } else {
            terminal.taken = None;
            sleep(FOREGROUND_CHECK_PERIOD);
        }
    }
    Ok(())
}

/// Returns the keys pressed within [`FOREGROUND_CHECK_PERIOD`]; `None` if the terminal is gone.
fn next_keys() -> Result<Option<Vec<u8>>> {
    let input = stdin();
    let mut ready = [PollFd::new(&input, PollFlags::IN)];
    let patience = Timespec { tv_sec: 0, tv_nsec: FOREGROUND_CHECK_PERIOD.as_nanos() as i64 };
    match poll(&mut ready, Some(&patience)) {
        // Reading in the background would stop the whole job.
        Ok(0) | Err(Errno::INTR) => return Ok(Some(Vec::new())),
        Ok(_) if !is_foreground() => return Ok(Some(Vec::new())),
        Ok(_) => {}
        Err(error) => return Err(error.into()),
    }
    let mut keys = [0; 64];
    match rustix::io::read(&input, &mut keys) {
        Ok(0) | Err(Errno::IO) => Ok(None),
        Ok(length) => Ok(Some(keys[..length].to_vec())),
        Err(Errno::INTR) => Ok(Some(Vec::new())),
        Err(error) => Err(error.into()),
    }
}

/// Returns the requests of these keys; other keys have no effect.
fn requests(mut keys: &[u8]) -> impl Iterator<Item = PauseRequest> {
    std::iter::from_fn(move || {
        while let Some((first, rest)) = keys.split_first() {
            let arrow = RIGHT.iter().find(|arrow| keys.starts_with(arrow));
            let request = match first {
                b' ' => Some(PauseRequest::Toggle),
                b'.' => Some(PauseRequest::Step),
                _ => arrow.map(|_| PauseRequest::Step),
            };
            keys = arrow.map_or(rest, |arrow| &keys[arrow.len()..]);
            if request.is_some() {
                return request;
            }
        }
        None
    })
}

fn obey(pipeline: &str, request: PauseRequest) {
    let paused = RunningPipeline::find(Some(pipeline), "its name").and_then(|running| running.pause(request));
    let notice = match paused {
        Ok(sources) if sources.paused && !sources.live.is_empty() => {
            let live = sources.live.join("`, `");
            Some(format!("`{live}` cannot be paused, and goes on"))
        }
        Ok(_) => None,
        Err(error) => Some(error.to_string()),
    };
    // Overwrites the line with the progress.
    notice.into_iter().for_each(|notice| {
        writeln!(stderr(), "\r\x1b[K{notice}").ok();
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use PauseRequest::{Step, Toggle};

    #[test]
    fn known_keys_are_requests_and_other_keys_are_ignored() {
        let requested = |keys: &[u8]| requests(keys).collect::<Vec<_>>();
        assert_eq!(requested(b" "), [Toggle]);
        assert_eq!(requested(b". \x1b[C\x1bOC"), [Step, Toggle, Step, Step]);
        assert_eq!(requested(b"\x1b[D\x1b[A\x1b[1;5Cq\r\x03\xff"), [] as [PauseRequest; 0]);
    }
}
