//! The signals that end a program, or stop it until it is told to go on, but for the one that says that the terminal has gone
//! (SIGHUP) where whoever started it wants it to outlive that: `nohup` and its like have that signal ignored, and it stays so.
//!
//! SIGINT is heard also where it is ignored at the start: shells do that to all that scripts start in the background, and such a
//! script ends a run by that signal.

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGTSTP};
use std::fs::read_to_string;

/// Where Linux tells which signals a process ignores, as bits, of which the lowest is that of signal 1.
const STATUS: &str = "/proc/self/status";
const IGNORED: &str = "SigIgn:";

/// The signals that end this program; to be asked before any of them is received.
pub(crate) fn ending_signals() -> Vec<i32> {
    // Where nobody tells, none is ignored.
    let is_ignored = read_to_string(STATUS).is_ok_and(|status| is_ignored(SIGHUP, &status));
    [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|signal| *signal != SIGHUP || !is_ignored).collect()
}

/// The signal of Ctrl-Z, if this program is not to ignore it; to be asked before it is received.
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
