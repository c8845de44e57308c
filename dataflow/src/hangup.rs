//! The signals that end or suspend a program. SIGHUP (the terminal has gone) is not handled if it is ignored at the start, as
//! under `nohup`: the program is then to outlive its terminal.
//!
//! SIGINT is handled even if it is ignored at the start: shells ignore it for all processes that a script starts in the
//! background, and such a script ends a run by that signal.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGTSTP};
use std::fs::read_to_string;

/// Linux's file with the signals that this process ignores, as a bit mask; the lowest bit is signal 1.
const STATUS: &str = "/proc/self/status";
/// Start of the line with the ignored signals in [`STATUS`].
const IGNORED: &str = "SigIgn:";

/// The signals that end this program; has to be called before any handler is installed.
pub(crate) fn ending_signals() -> Vec<i32> {
    // If the file cannot be read, no signal counts as ignored.
    let is_ignored = read_to_string(STATUS).is_ok_and(|status| is_ignored(SIGHUP, &status));
    [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|signal| *signal != SIGHUP || !is_ignored).collect()
}

/// The signal of Ctrl-Z, unless it is ignored; has to be called before its handler is installed.
pub(crate) fn stopping_signal() -> Option<i32> {
    let is_ignored = read_to_string(STATUS).is_ok_and(|status| is_ignored(SIGTSTP, &status));
    (!is_ignored).then_some(SIGTSTP)
}

fn is_ignored(signal: i32, status: &str) -> bool {
    let mask = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix(IGNORED)?.trim(), 16).ok());
    mask.is_some_and(|mask| mask & (1 << (signal - 1)) != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signal_is_ignored_where_its_bit_says_so() {
        let status =
            |mask: &str| format!("Name:\tsh\nSigBlk:\t0000000000000001\nSigIgn:\t{mask}\nSigCgt:\t0000000000000001\n");
        assert!(is_ignored(SIGHUP, &status("0000000000000001")) && is_ignored(SIGHUP, &status("0000000000001003")));
        assert!(!is_ignored(SIGHUP, &status("0000000000001002")) && is_ignored(SIGINT, &status("0000000000001002")));
        assert!(!is_ignored(SIGHUP, "") && !is_ignored(SIGHUP, &status("none")));
    }
}
