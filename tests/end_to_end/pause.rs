//! Pauses a run and steps it by single frames, by keys at its terminal and from the page, and checks that the terminal is as
//! before afterwards.

use crate::support::{Playground, Started, TRACKING, example, signal, terminal, tracking_behind, wait_until};
use crate::view::{Page, items, recording};
use rustix::fs::{CWD, Mode, OFlags, mkfifoat};
use rustix::process::Signal;
use rustix::termios::{LocalModes, tcgetattr};
use serde_json::json;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// A terminal that only the test uses.
struct Terminal {
    keys: File,
    inner: OwnedFd,
    /// Text that programs have written to the terminal.
    text: Arc<Mutex<String>>,
}

impl Terminal {
    /// Opens a terminal. `None` if no program can give a process its own session, or this shell is not installed.
    fn open(shell: &str) -> Option<Self> {
        let is_there = |program: &str, argument| Command::new(program).arg(argument).output().is_ok();
        if !is_there("setsid", "--version") || !is_there(shell, "-c") {
            eprintln!("SKIPPED: there is no `setsid`, or no `{shell}`; keys at a terminal were not pressed");
            return None;
        }
        let ((keys, inner), text) = (terminal(), Arc::<Mutex<String>>::default());
        let (mut written, all) = (keys.try_clone().unwrap(), Arc::clone(&text));
        thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(length @ 1..) = written.read(&mut bytes) {
                all.lock().unwrap().push_str(&String::from_utf8_lossy(&bytes[..length]));
            }
        });
        Some(Self { keys, inner, text })
    }

    /// A command that starts a program in its own session, with this terminal as controlling terminal.
    fn command(&self, playground: &Playground, program: &[&str]) -> Command {
        let mut command = playground.command_of("setsid".as_ref(), &[&["--ctty"], program].concat());
        let end = || self.inner.try_clone().unwrap();
        command.stdin(end()).stdout(end()).stderr(end());
        command
    }

    fn press(&mut self, keys: &str) {
        self.keys.write_all(keys.as_bytes()).unwrap();
    }

    /// Ends the shell at the terminal by a command, because the shell ignores SIGTERM.
    fn leave(&mut self, shell: Started) {
        self.press("exit 0\n");
        shell.wait().expect_code(0);
    }

    /// Whether the terminal delivers each key when it is pressed, without an echo.
    fn gives_keys(&self) -> bool {
        let modes = tcgetattr(&self.inner).unwrap().local_modes;
        !modes.intersects(LocalModes::ICANON | LocalModes::ECHO)
    }

    /// Whether the modes of the terminal are as before the run.
    fn is_as_before(&self) -> bool {
        tcgetattr(&self.inner).unwrap().local_modes.contains(LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG)
    }
}

const PROGRAM: &str = env!("CARGO_BIN_EXE_conicflow");

/// The process of the playground that runs `conicflow` with this word as its first argument.
fn process_with(playground: &Playground, word: &str) -> Option<u32> {
    let arguments = |process: &u32| std::fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
    playground.processes().into_iter().find(|process| {
        let text = arguments(process);
        text.split('\0').next() == Some(PROGRAM) && text.split('\0').nth(1) == Some(word)
    })
}

/// Waits until the run is paused and all frames are delivered. Returns the number of the last frame.
fn standing_at(playground: &Playground) -> u64 {
    let mut last = 0;
    wait_until("the run stands still", || {
        let source = playground.top_stage("source");
        last = playground.newest("tracks.jsonl");
        source["paused"] == true && source["rate_hz"] == 0.0 && source["messages"] == last + 1
    });
    last
}

/// Asserts that a run stays paused for this number of seconds, which is longer than a stage may be silent and longer than the run
/// is to last.
fn pause_goes_on(playground: &Playground, seconds: u64) {
    let paused = std::time::Instant::now();
    while paused.elapsed().as_secs() < seconds {
        assert!(playground.top_stage("source")["paused"] == true, "it is paused for longer than that");
    }
}

#[test]
fn keys_pause_and_step_a_run_and_a_pause_does_not_count_as_hanging() {
    let playground = Playground::with_pipeline(
        &TRACKING.replace("rate_hz    = 0", "rate_hz    = 40\nrestart    = { when = \"on_failure\", hang_s = 3 }"),
    );
    let Some(mut terminal) = Terminal::open("sh") else { return };
    let mut run = Started::watched(terminal.command(&playground, &[PROGRAM, "run"]));
    run.wait_until("it delivers", || playground.newest("tracks.jsonl") > 5);
    run.wait_until("the terminal gives keys", || terminal.gives_keys());
    terminal.press(" ");
    let at = standing_at(&playground);
    for (number, key) in [".", "\x1b[C", "\x1bOC"].into_iter().enumerate() {
        terminal.press(key);
        run.wait_until("a step is made", || playground.newest("tracks.jsonl") == at + 1 + number as u64);
    }
    pause_goes_on(&playground, 4);
    assert_eq!(standing_at(&playground), at + 3, "and no more");
    assert_eq!(playground.top_stage("source")["starts"], 1, "who is paused does not hang");
    assert!(terminal.text.lock().unwrap().contains(", paused (space: go on"), "the progress says so");
    terminal.press("x \x1b[A");
    run.wait_until("it goes on", || playground.newest("tracks.jsonl") > at + 20);
    terminal.press("\x03");
    assert_eq!(run.wait().code, Some(0), "{}", terminal.text.lock().unwrap());
    assert!(terminal.is_as_before());
    let sequences = playground.sequences("tracks.jsonl");
    assert_eq!(sequences, (0..sequences.len() as u64).collect::<Vec<_>>(), "nothing is lost");
}

#[test]
fn a_paused_run_ends_in_order_and_its_clock_stops() {
    let playground = Playground::with_pipeline(TRACKING);
    let Some(mut terminal) = Terminal::open("sh") else { return };
    let program = [PROGRAM, "run", "--set", "source.rate_hz=40", "--for", "10s"];
    let mut run = Started::watched(terminal.command(&playground, &program));
    run.wait_until("it delivers", || playground.newest("tracks.jsonl") > 5);
    terminal.press(" ");
    let at = standing_at(&playground);
    pause_goes_on(&playground, 11);
    terminal.press("\x03");
    assert_eq!(run.wait().code, Some(0), "{}", terminal.text.lock().unwrap());
    assert_eq!(playground.newest("tracks.jsonl"), at);
    assert!(terminal.is_as_before());
}

#[test]
fn the_terminal_is_given_back_after_a_crash_and_while_the_run_is_stopped() {
    let playground = Playground::with_pipeline(TRACKING);
    let Some(mut terminal) = Terminal::open("dash") else { return };
    // `dash` does not change the modes of its terminal, so only `conicflow` can restore them.
    let shell = Started::watched(terminal.command(&playground, &["dash", "-i"]));
    let begin = |terminal: &mut Terminal| {
        terminal.press(&format!("{PROGRAM} run --set source.rate_hz=20\n"));
        wait_until("the terminal gives keys", || terminal.gives_keys());
        wait_until("it delivers", || playground.newest("tracks.jsonl") > 3);
    };
    begin(&mut terminal);
    terminal.press("\x1a");
    wait_until("it is given back while the run is stopped", || terminal.is_as_before());
    terminal.press("fg\n");
    wait_until("it gives keys again", || terminal.gives_keys());
    terminal.press(" ");
    standing_at(&playground);
    // A killed launcher cannot restore the modes of the terminal, so the process that reads the keys has to.
    signal(process_with(&playground, "run").unwrap(), Signal::KILL);
    wait_until("it is given back after a crash", || terminal.is_as_before());
    wait_until("nothing is left", || process_with(&playground, "keys").is_none());

    std::fs::remove_file(playground.path("tracks.jsonl")).unwrap();
    begin(&mut terminal);
    signal(process_with(&playground, "keys").unwrap(), Signal::KILL);
    wait_until("who reads the keys has gone", || process_with(&playground, "keys").is_none());
    assert!(terminal.gives_keys());
    terminal.press("\x03");
    wait_until("the launcher gives it back", || terminal.is_as_before());
    wait_until("the run is over", || process_with(&playground, "run").is_none());
    terminal.leave(shell);
}

#[test]
fn a_run_in_the_background_leaves_the_terminal_alone() {
    let playground = Playground::with_pipeline(TRACKING);
    let Some(mut terminal) = Terminal::open("dash") else { return };
    let shell = Started::watched(terminal.command(&playground, &["dash", "-i"]));
    terminal.press(&format!("{PROGRAM} run --quiet --set source.rate_hz=20 &\n"));
    wait_until("it delivers", || playground.newest("tracks.jsonl") > 3);
    wait_until("somebody would read keys", || process_with(&playground, "keys").is_some());
    let at = playground.newest("tracks.jsonl");
    terminal.press(" ");
    wait_until("it goes on", || playground.newest("tracks.jsonl") > at + 20);
    assert!(terminal.is_as_before());
    terminal.press("\nfg\n");
    wait_until("it has come to the foreground", || terminal.gives_keys());
    terminal.press(" ");
    standing_at(&playground);
    terminal.press("\x03");
    wait_until("it is given back", || terminal.is_as_before());
    terminal.leave(shell);
}

#[test]
fn the_page_pauses_a_replay_steps_it_and_lets_it_go_on() {
    let playground = Playground::new();
    recording(&playground, "60");
    let source = "node = \"mcap_source\"\npath = \"run.mcap\"\nloop = true";
    playground.write("pipeline.toml", &tracking_behind(source, "lossless"));
    let _run = playground.start(&["run"]);
    let page = Page::open(&playground, &[]);
    page.wait_for_state("the run can be paused", |json| {
        json["about"]["run"] == json!({ "can_pause": true, "live": [], "paused": false })
    });
    assert_eq!(page.send_command(&json!({ "do": "pause" })), 204);
    page.wait_for_state("it is paused", |json| json["about"]["run"]["paused"] == true);
    let at = standing_at(&playground);
    for sequence in at + 1..at + 4 {
        assert_eq!(page.send_command(&json!({ "do": "step", "by": 1 })), 204);
        let (json, pixels) = page.frame("the next frame", |json| json["frame"]["sequence"] == sequence);
        assert!(!items(&json).is_empty() && !pixels.is_empty(), "with all that belongs to it");
    }
    assert_eq!(standing_at(&playground), at + 3);
    assert_eq!(page.send_command(&json!({ "do": "play" })), 204);
    page.frame("it goes on", |json| json["frame"]["sequence"].as_u64() > Some(at + 20));
    page.wait_for_state("and says so", |json| json["about"]["run"]["paused"] == false);
}

#[test]
fn a_step_is_shown_to_a_browser_that_did_not_ask_for_a_while() {
    let playground = Playground::with_pipeline(&TRACKING.replace("rate_hz    = 0", "rate_hz    = 20"));
    let _run = playground.start(&["run"]);
    let page = Page::open(&playground, &[]);
    page.frame("tracks", |json| !items(json).is_empty());
    assert_eq!(page.send_command(&json!({ "do": "pause" })), 204);
    let at = standing_at(&playground);
    // A browser that draws slowly may send no request for five seconds. After this time the run no longer counts the page as an
    // onlooker.
    let away = std::time::Instant::now();
    while away.elapsed().as_secs() < 5 {
        playground.top();
    }
    assert_eq!(page.send_command(&json!({ "do": "step", "by": 1 })), 204);
    assert_eq!(standing_at(&playground), at + 1);
    page.frame("the step", |json| json["frame"]["sequence"] == at + 1);
}

/// A camera of 32x24 pixels that writes its frames into a pipe, whether the frames are read or not.
struct Camera {
    /// Number of frames for which the pipe had room.
    taken: Arc<AtomicU64>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Camera {
    fn start(playground: &Playground) -> Self {
        let path = playground.path("depth.z16");
        mkfifoat(CWD, &path, Mode::RUSR | Mode::WUSR).unwrap();
        // The test opens the pipe for reading, too, so that it is open before and after the run. A full pipe does not block the
        // camera.
        let pipe = rustix::fs::open(&path, OFlags::RDWR | OFlags::NONBLOCK, Mode::empty()).unwrap();
        let (taken, is_over) = (Arc::<AtomicU64>::default(), Arc::<AtomicBool>::default());
        let (count, ends) = (Arc::clone(&taken), Arc::clone(&is_over));
        let thread = thread::spawn(move || {
            // An image has less than 4096 bytes, so that each write is atomic.
            let image = [0xe8, 0x03].repeat(32 * 24);
            while !ends.load(Ordering::Relaxed) {
                let written = rustix::io::write(&pipe, &image);
                count.fetch_add(u64::from(written == Ok(image.len())), Ordering::Relaxed);
                thread::sleep(Duration::from_millis(10));
            }
        });
        Self { taken, is_over, thread: Some(thread) }
    }

    /// The stage that reads the frames of this camera.
    fn stage() -> String {
        let program = example("raw_camera");
        format!(
            r#"
[stage.camera]
program     = ["{program}"]
output      = {{ topic = "camera_depth", kind = "depth" }}
path        = "depth.z16"
depth_scale = 0.001
camera      = {{ width = 32, height = 24, fx = 30.0, fy = 30.0, cx = 15.5, cy = 11.5 }}
noise       = {{ floor_m = 0.0, growth_per_m = 0.002, knee_m = 0.0, step_per_m = 0.0 }}
"#
        )
    }

    /// Number of frames for which the pipe had room so far.
    fn taken(&self) -> u64 {
        self.taken.load(Ordering::Relaxed)
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

/// Number of frames that do not all fit into the pipe (64 KiB). If the camera has written so many, a stage has read some of them.
const MORE_THAN_WAIT: u64 = 100;

#[test]
fn a_camera_is_emptied_while_the_rest_of_the_run_is_paused() {
    let sink = "\n[stage.lines]\nnode = \"row_ellipse_extractor\"\ninput = \"camera_depth\"\noutput = \"camera_ellipses\"\n\
                [stage.camera_json]\nnode = \"json_sink\"\ninput = \"camera_ellipses\"\npath = \"camera.jsonl\"\n";
    let slowly = TRACKING.replace("rate_hz    = 0", "rate_hz    = 20");
    let playground = Playground::with_pipeline(&format!("{slowly}{}{sink}", Camera::stage()));
    let Some(mut terminal) = Terminal::open("sh") else { return };
    let camera = Camera::start(&playground);
    let mut run = Started::watched(terminal.command(&playground, &[PROGRAM, "run"]));
    run.wait_until("both deliver", || playground.newest("tracks.jsonl") > 5 && playground.newest("camera.jsonl") > 5);
    run.wait_until("the terminal gives keys", || terminal.gives_keys());
    terminal.press(" ");
    let notice = "`camera` cannot be paused, and goes on";
    let written = Arc::clone(&terminal.text);
    run.wait_until("it is said", || written.lock().unwrap().contains(notice));
    let at = standing_at(&playground);
    let (taken, newest) = (camera.taken(), playground.newest("camera.jsonl"));
    run.wait_until("its frames are taken", || camera.taken() > taken + MORE_THAN_WAIT);
    run.wait_until("and worked on", || playground.newest("camera.jsonl") > newest + MORE_THAN_WAIT / 2);
    assert_eq!(playground.newest("tracks.jsonl"), at, "while the others stand still");
    terminal.press(" ");
    run.wait_until("it goes on", || playground.newest("tracks.jsonl") > at + 5);
    terminal.press("\x03");
    assert_eq!(run.wait().code, Some(0), "{}", terminal.text.lock().unwrap());
}

#[test]
fn a_run_of_live_cameras_cannot_be_paused_and_reports_it() {
    let sink = "[stage.shown]\nnode = \"view_sink\"\ninput = \"camera_depth\"\nlisten = \"127.0.0.1:0\"\n";
    let playground = Playground::with_pipeline(&format!("name = \"live\"\n{}{sink}", Camera::stage()));
    let Some(mut terminal) = Terminal::open("sh") else { return };
    let camera = Camera::start(&playground);
    let mut run = Started::watched(terminal.command(&playground, &[PROGRAM, "run"]));
    let written = Arc::clone(&terminal.text);
    run.wait_until("the page is offered", || written.lock().unwrap().contains("in a browser"));
    let page = Page::of_stage(&written.lock().unwrap());
    let live = json!({ "can_pause": false, "live": ["camera"], "paused": false });
    page.wait_for_state("a camera cannot be paused", |json| json["about"]["run"] == live);
    assert_eq!(page.send_command(&json!({ "do": "pause" })), 204);
    run.wait_until("the terminal gives keys", || terminal.gives_keys());
    terminal.press(" ");
    let notice = "`live` cannot be paused: `camera` is live";
    run.wait_until("it is said", || written.lock().unwrap().contains(notice));
    let (taken, mut frames) = (camera.taken(), 0);
    run.wait_until("its frames are taken", || camera.taken() > taken + MORE_THAN_WAIT);
    page.frame("it goes on", |json| {
        frames += 1;
        frames > 3 && json["about"]["run"] == live
    });
}
