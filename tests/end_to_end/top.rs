//! `conicflow top` on a terminal of 80 columns and 24 lines.

use crate::processes::at_work;
use crate::support::{TRACKING, TRACKING_STAGES, signal, terminal};
use rustix::process::Signal;
use rustix::termios::{Winsize, tcsetwinsize};
use std::io::Read;
use std::os::fd::OwnedFd;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

const COLUMNS: usize = 80;
const LINES: usize = 24;
/// The sequence with which `top` clears the screen.
const CLEAR: &str = "\x1b[H\x1b[2J";
const DEADLINE: Duration = Duration::from_secs(60);

/// Opens a terminal. Returns the end of the program, and the output of the program screen by screen.
fn screens() -> (OwnedFd, Receiver<String>) {
    let (mut outer, inner) = terminal();
    let size = Winsize { ws_row: LINES as u16, ws_col: COLUMNS as u16, ws_xpixel: 0, ws_ypixel: 0 };
    tcsetwinsize(&inner, size).unwrap();
    let (sender, screens) = channel();
    std::thread::spawn(move || {
        let (mut text, mut bytes) = (String::new(), [0; 4096]);
        while let Ok(length @ 1..) = outer.read(&mut bytes) {
            text.push_str(&String::from_utf8_lossy(&bytes[..length]));
            let mut parts: Vec<String> = text.split(CLEAR).map(str::to_owned).collect();
            text = parts.pop().unwrap_or_default();
            parts
                .into_iter()
                .filter(|screen| !screen.is_empty())
                .for_each(|screen| sender.send(screen).unwrap_or_default());
        }
    });
    (inner, screens)
}

#[test]
fn top_fits_its_terminal_and_is_redrawn() {
    let (playground, run) = at_work(TRACKING, 50);
    let (inner, screens) = screens();
    let mut command = playground.command(&["top"]);
    let mut top = command.stdout(inner.try_clone().unwrap()).stderr(inner).spawn().unwrap();
    drop(command);
    let seen = [screens.recv_timeout(DEADLINE).unwrap(), screens.recv_timeout(DEADLINE).unwrap()];
    for screen in &seen {
        let lines: Vec<&str> = screen.lines().collect();
        assert!(lines.len() <= LINES, "{} lines:\n{screen}", lines.len());
        assert!(lines.iter().all(|line| line.chars().count() <= COLUMNS), "too wide:\n{screen}");
        assert_eq!(lines[0], "tracking", "{screen}");
        for stage in TRACKING_STAGES {
            assert!(lines.iter().any(|line| line.starts_with(stage)), "no `{stage}`:\n{screen}");
        }
    }
    assert_ne!(seen[0], seen[1], "it counts on");
    // The signal is not SIGINT: if a shell starts the tests in the background, they and their children ignore SIGINT.
    signal(top.id(), Signal::TERM);
    top.wait().unwrap();
    run.end();
}
